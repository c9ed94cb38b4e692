"""Generalised-alpha: an implicit method of order 2 whose steps follow the motion, not the stiffness.

Place in the pipeline: equations, newton, implicit_step -> **generalised_alpha** -> solvers, stepping.

Chung and Hulbert, J. Appl. Mech. 60 (1993) 371-375; for constrained systems at the level of positions
Arnold and Bruels, Multibody Syst. Dyn. 18 (2007) 185-202; theory (7.1) to (7.7):

    q1 = q0 + h v0 + h^2 ((1/2 - beta) a0 + beta a1),     v1 = v0 + h ((1 - gamma) a0 + gamma a1)
    (1 - alpha_m) a1 + alpha_m a0 = (1 - alpha_f) v1' + alpha_f v0'
    equations of motion at (q1, v1, v1', lambda1, t1),    Phi(q1) = 0

with coefficients from the spectral radius at infinite frequency.  The joint loads come from v1' and
lambda1, with which the equations of motion hold at the end of every step; integrals of squared loads
and of powers are sums by the trapezoidal rule.  A step of length zero finds the accelerations and
multipliers at a given state: the method starts, and starts again after a jump of the drive, by such a
step.  Newton's method solves a step with one iteration matrix, formed where the first guess leads, until the
residual is a small share of the largest joint load so far and the cut joints are closed, or as many
corrections have been made as allowed; the residual after the last one is part of the result.

How a step is differentiated is said in `implicit_step`.
"""

import math
from collections.abc import Callable
from typing import ClassVar, NamedTuple

import diffrax
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
from rfem_jax.mechanics.cut_joints import closure
from rfem_jax.mechanics.elasticity import dissipated_power
from rfem_jax.mechanics.inputs import DriveInput, impose
from rfem_jax.mechanics.kinematics import motion
from rfem_jax.mechanics.model import Coordinates, State, Topology
from rfem_jax.mechanics.newton import Correction, NewtonMatrix, correction, newton_matrix, residual_of
from rfem_jax.mechanics.realisation import Realisation
from rfem_jax.simulation import equations
from rfem_jax.simulation.equations import Conditions, Integrals, Trajectory, drive_input
from rfem_jax.simulation.implicit_step import form_matrix, solved_step
from rfem_jax.simulation.observation import balanced_instant, cut_drift
from rfem_jax.simulation.run import RESIDUAL_LIMIT

CLOSED = 1e-7  # drift of the cut joints, relative to the length, that Newton's method may leave
# The residual pushes the mechanism in every step, and after a jump loads are a fraction of the largest
# so far: RMS loads err by up to so many times the tolerance, and derivatives need be no better.  After one
# correction these err by 2e-3 at errors that matter (twenty times that where the errors are so small that loads
# hardly follow them), after every further one by a thirteenth, with steps of 2.5 ms; with 5 ms by 1e-2 and a
# ninth: table in benchmarks/README.md.
ACCURACY_OF_TOLERANCE = 30.0
FIRST_REFINEMENT, FURTHER_REFINEMENT = 5e-3, 1.0 / 13.0


class Memory(NamedTuple):
    """What goes from step to step besides the trajectory: accelerations v', the method's a, multipliers
    (5, C) [N], rates of the integrals; residual [N]: largest force that is left over in the equations of
    the last step, and in all steps so far."""

    accelerations: Coordinates
    auxiliary: Coordinates
    multipliers: Array
    rates: Integrals
    residual: Array
    largest_residual: Array


class GeneralisedAlpha(diffrax.AbstractSolver):
    """The method as a diffrax solver of the equations of motion.

    It reads the mechanism itself, not the vector field of its terms, so it solves these equations alone:

        diffrax.diffeqsolve(terms, GeneralisedAlpha(method), t0, t1, h, y0, args=conditions, ...)

    with y0 = (`Trajectory`, squared maxima (2, joints) so far of axial and normal forces), args = `Conditions`
    of one phase of the drive, terms = `diffrax.ODETerm(stepping.vector_field)`.  Between two jumps of
    the drive one call integrates; steps may vary, and if the `operators` of the conditions are those of the one
    step length, they are not formed in every step.  A step in which Newton's method fails has the result
    `nonlinear_max_steps_reached`.

    Attributes: corrections: Newton's, at most in every step; tolerance: share of the largest joint load that
    the residual may have.
    """

    term_structure: ClassVar = diffrax.AbstractTerm
    interpolation_cls: ClassVar[Callable] = diffrax.LocalLinearInterpolation
    # diffrax's adjoints look at it: a step takes every transform.
    scan_kind: ClassVar[str] = "bounded"

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

    def order(self, terms):
        return 2

    def func(self, terms, t0, y0, args):
        return terms.vf(t0, y0, args)

    def init(self, terms, t0, t1, y0, args: Conditions) -> Memory:
        """Accelerations and multipliers at the start, by a step of length zero."""
        del t1
        nothing = self.start(args, y0[0])
        return self.step(terms, t0, t0, y0, args, nothing, False)[3]

    def start(self, conditions: Conditions, trajectory: Trajectory) -> Memory:
        """Nothing remembered: the first step must have length zero."""
        multipliers = jnp.zeros((5, conditions.realised.topology.n_cuts))
        nothing = jax.tree.map(jnp.zeros_like, trajectory.velocity)
        rates = jax.tree.map(jnp.zeros_like, trajectory.integrals)
        return Memory(nothing, nothing, multipliers, rates, jnp.zeros(()), jnp.zeros(()))

    def resume(self, terms, t0, t1, y0, args, memory: Memory) -> Memory:
        """Memory at the start of an interval: that of the one before."""
        del terms, t0, t1, y0, args
        return memory

    def step(self, terms, t0, t1, y0, args: Conditions, solver_state: Memory, made_jump):
        """One step (of length zero: accelerations at the given state).  After a jump of the drive there must
        be one of length zero, so `made_jump` says nothing new."""
        del terms, made_jump
        h, (trajectory, peaks) = t1 - t0, y0
        operators = args.operators
        if operators is None:
            operators = jax.tree.map(lambda x: x[0], self.operators(args.realised, h[None]))
        given = eqx.tree_at(lambda c: c.operators, args, None), trajectory, solver_state
        seen = jnp.maximum(peaks, squared_forces(solver_state.rates))
        constants = t1, h, jnp.sqrt(jnp.max(seen))
        operators, constants, fixed = jax.lax.stop_gradient((operators, constants, given))
        matrix = form_matrix(self, operators, constants, *fixed)
        trajectory, memory = solved_step(self, (matrix, *constants), *given)
        y1 = trajectory, jnp.maximum(peaks, squared_forces(memory.rates))
        allowed = RESIDUAL_LIMIT * jnp.sqrt(jnp.max(jax.lax.stop_gradient(y1[1])))
        result = diffrax.RESULTS.where(
            memory.residual <= allowed,
            diffrax.RESULTS.successful,
            diffrax.RESULTS.nonlinear_max_steps_reached,
        )
        return y1, None, dict(y0=y0, y1=y1), memory, result

    def factors(self, h):
        """Change of coordinates [s^2] and of rates [s] by a change of the accelerations v1'."""
        share = (1.0 - self.alpha_f) / (1.0 - self.alpha_m)
        return self.beta * h**2 * share, self.gamma * h * share

    def operators(self, realised: Realisation, lengths: Array) -> tuple[LinkOperator | None, ...]:
        """Operators of the links, first axis: step lengths (K,)."""
        return jax.vmap(lambda h: link_operators(realised, *self.factors(h)))(lengths)

    def instant(self, t, h, trajectory, memory: Memory, conditions: Conditions):
        """At the end t of a step of length h: squared forces, state, drive, and the solved instant."""
        scale = conditions.stabilisation.scale
        state = State(trajectory.position, trajectory.velocity)
        drive = drive_input(conditions.drive, t, conditions.phase)
        accelerations, multipliers = memory.accelerations, memory.multipliers
        left = evaluate_balance(conditions.realised, state, accelerations, multipliers, drive, scale)
        forces = residual_forces(conditions.realised, self._closing(left, h), drive, scale)
        topology = conditions.realised.topology
        instant = balanced_instant(topology, left, accelerations, drive, scale, forces)
        return squared_forces(memory.rates), state, drive, instant

    def solve(self, constants, conditions, trajectory, memory) -> tuple[Trajectory, Memory]:
        """Newton's method."""
        matrix, _, _, largest = constants
        topology, given = conditions.realised.topology, (conditions, trajectory, memory)
        drift = CLOSED * conditions.stabilisation.scale
        first = self.guess(constants, *given)
        left = self.end_of_step(first, constants, *given)[0]

        def unsettled(carry):
            count, settled, _, _, _ = carry
            return (count == 0) | ((count < self.corrections) & ~settled)

        def correct(carry):
            count, _, unknowns, residual, _ = carry
            change = correction(topology, matrix, residual)
            unknowns = jax.tree.map(jnp.add, unknowns, change)
            left, end = self.end_of_step(unknowns, constants, *given)
            closed = cut_drift(left.closure, conditions.stabilisation.scale)[0] <= drift
            settled = (end[1].residual <= self.tolerance * largest) & closed
            return count + 1, settled, unknowns, residual_of(left), end

        # The first correction is always made: what the guess would return is never needed.
        start = jnp.zeros((), jnp.int32), jnp.zeros((), bool)
        carry = (*start, first, residual_of(left), (trajectory, memory))
        return jax.lax.while_loop(unsettled, correct, carry)[4]

    def matrix(self, operators, constants, conditions: Conditions, trajectory, memory) -> NewtonMatrix:
        """Newton's matrix, formed where the guess leads; the solution does not depend on it."""
        (t1, h, _), realised = constants, conditions.realised
        scale = conditions.stabilisation.scale
        drive = drive_input(conditions.drive, t1, conditions.phase)
        accelerations, _ = self.guess((None, *constants), conditions, trajectory, memory)
        state, _ = self._reached(h, trajectory, memory, accelerations, realised.topology, drive)
        now = motion(realised, state)
        if realised.topology.exact:
            operators = present_operators(realised, now.relative, *self.factors(h))
        prescribed = isinstance(conditions.drive, PrescribedDrive)
        held = (realised.topology.driven,) if prescribed else ()
        return newton_matrix(realised, operators, now, closure(realised, now, scale), held)

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
        """Residual with given unknowns (`closing` as an acceleration), and what the step returns if that is
        nothing."""
        _, t1, h, _ = constants
        realised, scale = conditions.realised, conditions.stabilisation.scale
        drive = drive_input(conditions.drive, t1, conditions.phase)
        accelerations, multipliers = unknowns
        state, auxiliary = self._reached(h, trajectory, memory, accelerations, realised.topology, drive)
        left = evaluate_balance(realised, state, accelerations, multipliers, drive, scale)
        left = self._closing(left, h)
        reached = state, auxiliary, unknowns
        return left, self._ended(left, reached, drive, h, conditions, trajectory, memory)

    def end_by_wrenches(
        self, wrenches, unknowns: Correction, left: Balance, constants, conditions, trajectory, memory
    ) -> tuple[Trajectory, Memory]:
        """What the step returns with given unknowns and wrenches (6,) of the tree joints, in the place of
        the balance `left`."""
        _, t1, h, _ = constants
        realised = conditions.realised
        drive = drive_input(conditions.drive, t1, conditions.phase)
        state, auxiliary = self._reached(
            h, trajectory, memory, unknowns.accelerations, realised.topology, drive
        )
        left = left._replace(
            multipliers=unknowns.multipliers,
            wrenches=[*wrenches, *loads.cut_wrenches(left.closure, unknowns.multipliers)],
            dissipated=dissipated_power(realised, state),
        )
        reached = state, auxiliary, unknowns
        return self._ended(left, reached, drive, h, conditions, trajectory, memory)

    def _closing(self, left: Balance, h) -> Balance:
        """The balance with its closure as an acceleration [m/s^2]: the one that closes it within the step."""
        moving, (q_factor, _) = h > 0.0, self.factors(h)
        by_step = left.closing / jnp.where(moving, q_factor, 1.0)
        return left._replace(closing=jnp.where(moving, by_step, left.closing_acceleration))

    def _ended(self, left: Balance, reached, drive, h, conditions, trajectory, memory):
        """What the step returns with its balance, and state, auxiliary accelerations and unknowns."""
        realised, scale = conditions.realised, conditions.stabilisation.scale
        state, auxiliary, (accelerations, multipliers) = reached
        residual = jnp.max(jnp.abs(residual_forces(realised, left, drive, scale)), initial=0.0)
        residual = jax.lax.stop_gradient(residual)
        joint = loads.loads_of_wrenches(realised.topology, left, left.wrenches, drive)
        axial, normal, moment = equations.squares(joint)
        work = equations.drive_power(realised.topology, state, drive, joint)
        rates = Integrals(axial, normal, moment, work, left.dissipated)
        integrals = jax.tree.map(
            lambda sum, old, new: sum + 0.5 * h * (old + new),
            trajectory.integrals, memory.rates, rates,
        )
        most = jnp.maximum(memory.largest_residual, residual)
        return (
            Trajectory(state.position, state.velocity, integrals),
            Memory(accelerations, auxiliary, multipliers, rates, residual, most),
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


def squared_forces(rates: Integrals) -> Array:
    """Squared axial and normal forces (2, joints)."""
    return jnp.stack([rates.axial_square, rates.normal_square])


def residual_forces(realised, left: Balance, drive: DriveInput, scale: Array) -> Array:
    """Residual as forces [N] (n,): on the rfes, about the hinges, and to close the cut joints."""
    hinge = left.hinge
    if drive.turn is not None:
        # The moment that enforces the angle.
        hinge = jnp.where(np.arange(hinge.shape[0]) == realised.topology.driven, 0.0, hinge)
    parts = left.force, left.moment / scale, hinge / scale, left.closing * jnp.sum(realised.mass)
    return jnp.concatenate([part.reshape(-1) for part in parts])


def _prescribed(topology: Topology, drive: DriveInput, accelerations: Coordinates) -> Coordinates:
    """The accelerations with that of a prescribed joint put in."""
    if drive.turn is None:
        return accelerations
    driven = np.arange(topology.n_links) == topology.driven
    driven = driven.reshape((-1,) + (1,) * (accelerations.angles.ndim - 1))
    angles = jnp.where(driven, drive.turn[2][None], accelerations.angles)
    return Coordinates(angles, accelerations.elastic)
