"""Generalised-alpha: an implicit method of order 2 whose steps follow the motion, not the stiffness.

Place in the pipeline: equations, newton, implicit_step -> **generalised_alpha** -> stepping.

Chung and Hulbert, J. Appl. Mech. 60 (1993) 371-375; for constrained systems at the level of positions
Arnold and Bruels, Multibody Syst. Dyn. 18 (2007) 185-202:

    q1 = q0 + h v0 + h^2 ((1/2 - beta) a0 + beta a1),     v1 = v0 + h ((1 - gamma) a0 + gamma a1)
    (1 - alpha_m) a1 + alpha_m a0 = (1 - alpha_f) v1' + alpha_f v0'
    equations of motion at (q1, v1, v1', lambda1, t1),    Phi(q1) = 0

with coefficients from the spectral radius at infinite frequency.  The joint loads come from v1' and
lambda1, with which the equations of motion hold at the end of every step; integrals of squared loads
and of powers are sums by the trapezoidal rule.  A step of length zero finds the accelerations and
multipliers at a given state: the method starts, and starts again after a jump of the drive, by such a
step.  Newton's method makes corrections with one matrix a step until what is left over is a small share
of the largest joint load so far and the cut joints are closed, or there have been as many as allowed; what
the last one leaves over is part of the result.

How a step is differentiated is said in `implicit_step`.
"""

import functools
import math
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from rfem_jax.description.drives import PrescribedDrive
from rfem_jax.description.methods import Method
from rfem_jax.mechanics import loads
from rfem_jax.mechanics.balance import Balance, evaluate_balance
from rfem_jax.mechanics.condensation import LinkOperator, link_operators, present_operators
from rfem_jax.mechanics.elasticity import dissipated_power
from rfem_jax.mechanics.inputs import DriveInput, impose
from rfem_jax.mechanics.model import Coordinates, State, Topology
from rfem_jax.mechanics.newton import Correction, NewtonMatrix, correction, newton_matrix, residual_of
from rfem_jax.mechanics.realisation import Realisation
from rfem_jax.simulation import equations
from rfem_jax.simulation.equations import Conditions, Integrals, Trajectory, drive_input
from rfem_jax.simulation.implicit_step import solved_step
from rfem_jax.simulation.observation import Instant, balanced_instant

CLOSED = 1e-7  # drift of the cut joints, relative to the length, that Newton's method may leave
# What is left over pushes the mechanism in every step, and after a jump loads are a fraction of the largest
# so far: RMS loads err by up to so many times the tolerance, and derivatives need be no better.  After one
# correction these err by 2e-3 at errors that matter (twenty times that where the errors are so small that loads
# hardly follow them), after every further one by a thirteenth, with steps of 2.5 ms; with 5 ms by 1e-2 and a
# ninth: table in benchmarks/README.md.
ACCURACY_OF_TOLERANCE = 30.0
FIRST_REFINEMENT, FURTHER_REFINEMENT = 5e-3, 1.0 / 13.0


class Memory(NamedTuple):
    """What goes from step to step besides the trajectory: accelerations v', the method's a, multipliers
    (5, C) [N], rates of the integrals, and the solved instant."""

    accelerations: Coordinates
    auxiliary: Coordinates
    multipliers: Array
    rates: Integrals
    instant: Instant


class GeneralisedAlpha(eqx.Module):
    """The method with its coefficients; corrections: Newton's, at most in every step; tolerance: share of
    the largest joint load that may be left over."""

    alpha_m: float = eqx.field(static=True)
    alpha_f: float = eqx.field(static=True)
    beta: float = eqx.field(static=True)
    gamma: float = eqx.field(static=True)
    corrections: int = eqx.field(static=True)
    tolerance: float = eqx.field(static=True)

    def __init__(self, method: Method):
        radius = method.spectral_radius
        self.alpha_m = (2.0 * radius - 1.0) / (radius + 1.0)
        self.alpha_f = radius / (radius + 1.0)
        self.gamma = 0.5 + self.alpha_f - self.alpha_m
        self.beta = 0.25 * (self.gamma + 0.5) ** 2
        self.corrections = method.corrections
        self.tolerance = method.tolerance

    @property
    def refinements(self) -> int:
        """Corrections of a derivative."""
        wanted = ACCURACY_OF_TOLERANCE * self.tolerance
        further = math.log(wanted / FIRST_REFINEMENT) / math.log(FURTHER_REFINEMENT)
        return max(1, 1 + math.ceil(further))

    def factors(self, h):
        """Change of coordinates [s^2] and of rates [s] by a change of the accelerations v1'."""
        share = (1.0 - self.alpha_f) / (1.0 - self.alpha_m)
        return self.beta * h**2 * share, self.gamma * h * share

    def operators(self, realised: Realisation, lengths: Array) -> tuple[LinkOperator | None, ...]:
        """Operators of the links, first axis: step lengths (K,)."""
        return jax.vmap(lambda h: link_operators(realised, *self.factors(h)))(lengths)

    def start(self, conditions: Conditions, trajectory: Trajectory) -> Memory:
        """Nothing remembered: the first step has length zero."""
        cuts = conditions.realised.topology.n_cuts
        nothing = jax.tree.map(jnp.zeros_like, trajectory.velocity)
        rates = jax.tree.map(jnp.zeros_like, trajectory.integrals)
        shapes = jax.eval_shape(
            lambda: self._instant(conditions, trajectory, nothing, jnp.zeros((5, cuts)))
        )
        instant = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
        return Memory(nothing, nothing, jnp.zeros((5, cuts)), rates, instant)

    def _instant(self, conditions, trajectory, accelerations, multipliers):
        scale = conditions.stabilisation.scale
        state = State(trajectory.position, trajectory.velocity)
        drive = drive_input(conditions.drive, jnp.zeros(()), conditions.phase)
        left = evaluate_balance(conditions.realised, state, accelerations, multipliers, drive, scale)
        topology = conditions.realised.topology
        return balanced_instant(topology, left, accelerations, drive, scale, jnp.zeros(()))

    def step(
        self,
        conditions: Conditions,
        operators: tuple[LinkOperator | None, ...],
        t1: Array,
        h: Array,
        trajectory: Trajectory,
        memory: Memory,
        largest: Array,
    ) -> tuple[Trajectory, Memory]:
        """One step of length h to t1 (zero: accelerations at the given state); `largest` [N]: joint load
        so far."""
        constants = jax.lax.stop_gradient((operators, t1, h, largest))
        return solved_step(self, constants, conditions, trajectory, memory)

    def solve(self, constants, conditions, trajectory, memory):
        """Newton's method: unknowns, and what the step returns with them."""
        topology, largest = conditions.realised.topology, constants[3]
        drift = CLOSED * conditions.stabilisation.scale
        first = self.guess(constants, conditions, trajectory, memory)
        left, end = self.end_of_step(first, constants, conditions, trajectory, memory)
        matrix = self.matrix(constants, conditions, left)

        def unsettled(carry):
            count, _, _, (_, instant) = carry
            settled = (instant.residual <= self.tolerance * largest) & (instant.drift <= drift)
            return (count == 0) | ((count < self.corrections) & ~settled)

        def correct(carry):
            count, unknowns, residual, _ = carry
            change = correction(topology, matrix, residual)
            unknowns = jax.tree.map(jnp.add, unknowns, change)
            left, end = self.end_of_step(unknowns, constants, conditions, trajectory, memory)
            return count + 1, unknowns, residual_of(left), (end[1].rates, end[1].instant)

        # The first correction is always made: what the guess would return is never needed.
        nothing = jax.tree.map(jnp.zeros_like, (end[1].rates, end[1].instant))
        carry = (jnp.zeros((), jnp.int32), first, residual_of(left), nothing)
        _, unknowns, _, seen = jax.lax.while_loop(unsettled, correct, carry)
        return unknowns, self._ended(unknowns, constants, conditions, trajectory, memory, *seen)

    def matrix(self, constants, conditions: Conditions, left: Balance) -> NewtonMatrix:
        """Newton's matrix, on which the solution does not depend: it is not differentiated."""
        realised, (operators, _, h, _) = conditions.realised, constants
        if realised.topology.exact:
            operators = present_operators(realised, left.motion.relative, *self.factors(h))
        prescribed = isinstance(conditions.drive, PrescribedDrive)
        held = (realised.topology.driven,) if prescribed else ()
        matrix = newton_matrix(realised, operators, left.motion, left.closure, held)
        return jax.lax.stop_gradient(matrix)

    def guess(self, constants, conditions: Conditions, trajectory: Trajectory, memory) -> Correction:
        """Accelerations and multipliers before the first correction: those of the last step.

        Geometrically exact links keep their shape instead: their matrix is formed where the guess leads,
        which accelerations of stiff vibrations, carried on over a long step, would bend far.
        """
        _, t1, h, _ = constants
        topology = conditions.realised.topology
        drive = drive_input(conditions.drive, t1, conditions.phase)
        accelerations = memory.accelerations
        if topology.exact:
            moving = h > 0.0
            step = jnp.where(moving, h, 1.0)
            old, a0 = accelerations.elastic, memory.auxiliary.elastic
            a1 = -(trajectory.velocity.elastic / step + (0.5 - self.beta) * a0) / self.beta
            mixed = (1.0 - self.alpha_m) * a1 + self.alpha_m * a0 - self.alpha_f * old
            elastic = jnp.where(moving, mixed / (1.0 - self.alpha_f), old)
            accelerations = Coordinates(accelerations.angles, elastic)
        return Correction(_prescribed(topology, drive, accelerations), memory.multipliers)

    def end_of_step(
        self, unknowns: Correction, constants, conditions: Conditions, trajectory, memory
    ) -> tuple[Balance, tuple[Trajectory, Memory]]:
        """What is left over with given unknowns (`closing` as an acceleration), and what the step returns
        if that is nothing."""
        _, t1, h, _ = constants
        realised, scale = conditions.realised, conditions.stabilisation.scale
        drive = drive_input(conditions.drive, t1, conditions.phase)
        q_factor, _ = self.factors(h)
        moving = h > 0.0
        accelerations, multipliers = unknowns
        state, _ = self._reached(h, trajectory, memory, accelerations, realised.topology, drive)
        left = evaluate_balance(realised, state, accelerations, multipliers, drive, scale)
        closing = jnp.where(
            moving, left.closing / jnp.where(moving, q_factor, 1.0), left.closing_acceleration
        )
        left = left._replace(closing=closing)
        return left, self._ended_with(left, state, unknowns, constants, conditions, trajectory, memory)

    def end_by_wrenches(
        self, wrenches, unknowns: Correction, left: Balance, constants, conditions, trajectory, memory
    ) -> tuple[Trajectory, Memory]:
        """What the step returns with given unknowns and wrenches (6,) of the tree joints, in the place of
        the balance `left`."""
        _, t1, h, _ = constants
        realised = conditions.realised
        drive = drive_input(conditions.drive, t1, conditions.phase)
        state, _ = self._reached(
            h, trajectory, memory, unknowns.accelerations, realised.topology, drive
        )
        left = left._replace(
            multipliers=unknowns.multipliers,
            wrenches=[*wrenches, *loads.cut_wrenches(left.closure, unknowns.multipliers)],
            dissipated=dissipated_power(realised, state),
        )
        return self._ended_with(left, state, unknowns, constants, conditions, trajectory, memory)

    def _ended_with(self, left, state, unknowns, constants, conditions, trajectory, memory):
        """What the step returns with its balance."""
        realised, scale = conditions.realised, conditions.stabilisation.scale
        drive = drive_input(conditions.drive, constants[1], conditions.phase)
        left_over = _left_over(realised, left, drive, scale)
        topology, accelerations = realised.topology, unknowns.accelerations
        instant = balanced_instant(topology, left, accelerations, drive, scale, left_over)
        rates = _rates(realised, state, drive, instant)
        return self._ended(unknowns, constants, conditions, trajectory, memory, rates, instant)

    def _ended(self, unknowns: Correction, constants, conditions, trajectory, memory, rates, instant):
        """What the step returns with its unknowns, rates of the integrals and solved instant."""
        _, t1, h, _ = constants
        topology = conditions.realised.topology
        drive = drive_input(conditions.drive, t1, conditions.phase)
        accelerations, multipliers = unknowns
        state, auxiliary = self._reached(h, trajectory, memory, accelerations, topology, drive)
        integrals = jax.tree.map(
            lambda sum, old, new: sum + 0.5 * h * (old + new),
            trajectory.integrals, memory.rates, rates,
        )
        return (
            Trajectory(state.position, state.velocity, integrals),
            Memory(accelerations, auxiliary, multipliers, rates, instant),
        )

    def _reached(self, h, trajectory: Trajectory, memory: Memory, accelerations, topology, drive):
        """State at the end of the step with prescribed values imposed, and the method's a1."""
        moving = h > 0.0

        def auxiliary(new, old, a):
            mixed = (1.0 - self.alpha_f) * new + self.alpha_f * old - self.alpha_m * a
            return jnp.where(moving, mixed / (1.0 - self.alpha_m), new)

        a0 = memory.auxiliary
        a1 = jax.tree.map(auxiliary, accelerations, memory.accelerations, a0)
        position = jax.tree.map(
            lambda q, v, a, b: q + h * (v + h * ((0.5 - self.beta) * a + self.beta * b)),
            trajectory.position, trajectory.velocity, a0, a1,
        )
        velocity = jax.tree.map(
            lambda v, a, b: v + h * ((1.0 - self.gamma) * a + self.gamma * b),
            trajectory.velocity, a0, a1,
        )
        return impose(topology, State(position, velocity), drive), a1


def _left_over(realised, left: Balance, drive: DriveInput, scale: Array) -> Array:
    """The largest force [N] that is left over: on the rfes, about the hinges, to close the cut joints."""
    hinge = left.hinge
    if drive.turn is not None:
        # The moment that enforces the angle.
        hinge = jnp.where(np.arange(hinge.shape[0]) == realised.topology.driven, 0.0, hinge)
    return functools.reduce(
        jnp.maximum,
        (
            jnp.max(jnp.abs(left.force), initial=0.0),
            jnp.max(jnp.abs(left.moment), initial=0.0) / scale,
            jnp.max(jnp.abs(hinge)) / scale,
            jnp.max(jnp.abs(left.closing), initial=0.0) * jnp.sum(realised.mass),
        ),
    )


def _prescribed(topology: Topology, drive: DriveInput, accelerations: Coordinates) -> Coordinates:
    """The accelerations with that of a prescribed joint put in."""
    if drive.turn is None:
        return accelerations
    driven = np.arange(topology.n_links) == topology.driven
    driven = driven.reshape((-1,) + (1,) * (accelerations.angles.ndim - 1))
    angles = jnp.where(driven, drive.turn[2][None], accelerations.angles)
    return Coordinates(angles, accelerations.elastic)


def _rates(realised, state: State, drive: DriveInput, instant: Instant) -> Integrals:
    axial, normal, moment = equations.squares(instant.loads)
    return Integrals(
        axial_square=axial,
        normal_square=normal,
        moment_square=moment,
        work=equations.drive_power(realised.topology, state, drive, instant.loads),
        dissipation=instant.dissipated,
    )
