"""Generalised-alpha: an implicit method of order 2 whose steps follow the motion, not the stiffness.

Place in the pipeline: equations, newton -> **generalised_alpha** -> integration.

Chung and Hulbert, J. Appl. Mech. 60 (1993) 371-375; for constrained systems at the level of positions
Arnold and Bruels, Multibody Syst. Dyn. 18 (2007) 185-202:

    q1 = q0 + h v0 + h^2 ((1/2 - beta) a0 + beta a1),     v1 = v0 + h ((1 - gamma) a0 + gamma a1)
    (1 - alpha_m) a1 + alpha_m a0 = (1 - alpha_f) v1' + alpha_f v0'
    equations of motion at (q1, v1, v1', lambda1, t1),    Phi(q1) = 0

with coefficients from the spectral radius at infinite frequency.  The joint loads come from v1' and
lambda1, with which the equations of motion hold at the end of every step; integrals of squared loads
and of powers are sums by the trapezoidal rule.  A step of length zero finds the accelerations and
multipliers at a given state: the method starts, and starts again after a jump of the drive, by such a
step.  Newton's method makes a fixed number of corrections with one matrix a step; what the last one
leaves over is part of the result.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from rfem_jax.description.methods import Method
from rfem_jax.mechanics.balance import balance
from rfem_jax.mechanics.dynamics import DriveInput, impose
from rfem_jax.mechanics.link_operators import LinkModes, LinkOperator, link_modes, link_operators
from rfem_jax.mechanics.model import Coordinates, Model, State, Topology
from rfem_jax.mechanics.newton import correction, newton_matrix
from rfem_jax.mechanics.realisation import assembly_errors, realise
from rfem_jax.simulation import equations
from rfem_jax.simulation.equations import Conditions, Integrals, Trajectory, drive_input
from rfem_jax.simulation.observation import Instant, balanced_instant


class Memory(NamedTuple):
    """What goes from step to step besides the trajectory: accelerations v', the method's a, multipliers
    (5, C) [N], rates of the integrals, and the solved instant."""

    accelerations: Coordinates
    auxiliary: Coordinates
    multipliers: Array
    rates: Integrals
    instant: Instant


class GeneralisedAlpha(eqx.Module):
    """The method with its coefficients; corrections: Newton's, in every step."""

    alpha_m: float = eqx.field(static=True)
    alpha_f: float = eqx.field(static=True)
    beta: float = eqx.field(static=True)
    gamma: float = eqx.field(static=True)
    corrections: int = eqx.field(static=True)

    def __init__(self, method: Method):
        radius = method.spectral_radius
        self.alpha_m = (2.0 * radius - 1.0) / (radius + 1.0)
        self.alpha_f = radius / (radius + 1.0)
        self.gamma = 0.5 + self.alpha_f - self.alpha_m
        self.beta = 0.25 * (self.gamma + 0.5) ** 2
        self.corrections = method.corrections

    def factors(self, h):
        """Change of coordinates [s^2] and of rates [s] by a change of the accelerations v1'."""
        share = (1.0 - self.alpha_f) / (1.0 - self.alpha_m)
        return self.beta * h**2 * share, self.gamma * h * share

    def operators(self, model: Model, lengths: Array) -> tuple[LinkOperator | None, ...]:
        """Operators of the links, first axis: step lengths (K,)."""
        modes = link_modes(realise(model, assembly_errors(model)))
        topology = model.topology
        return jax.vmap(lambda h: link_operators(topology, modes, *self.factors(h)))(lengths)

    def start(self, conditions: Conditions, trajectory: Trajectory) -> Memory:
        """Nothing remembered: the first step has length zero."""
        joints = trajectory.integrals.moment_square.shape[0]
        cuts = conditions.realised.topology.n_cuts
        nothing = jax.tree.map(jnp.zeros_like, trajectory.velocity)
        rates = jax.tree.map(jnp.zeros_like, trajectory.integrals)
        shapes = jax.eval_shape(
            lambda: self._instant(conditions, trajectory, nothing, jnp.zeros((5, cuts)), joints)
        )
        instant = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
        return Memory(nothing, nothing, jnp.zeros((5, cuts)), rates, instant)

    def _instant(self, conditions, trajectory, accelerations, multipliers, joints):
        scale = conditions.stabilisation.scale
        state = State(trajectory.position, trajectory.velocity)
        drive = drive_input(conditions.drive, jnp.zeros(()), conditions.phase)
        left = balance(conditions.realised, state, accelerations, multipliers, drive, scale)
        return balanced_instant(conditions.realised.topology, left, accelerations, drive, scale)

    def step(
        self,
        conditions: Conditions,
        operators: tuple[LinkOperator | None, ...],
        t1: Array,
        h: Array,
        trajectory: Trajectory,
        memory: Memory,
    ) -> tuple[Trajectory, Memory]:
        """One step of length h to t1 (zero: accelerations at the given state)."""
        realised, scale = conditions.realised, conditions.stabilisation.scale
        topology = realised.topology
        drive = drive_input(conditions.drive, t1, conditions.phase)
        q_factor, _ = self.factors(h)
        moving = h > 0.0

        def evaluate(accelerations, multipliers):
            state, auxiliary = self._reached(h, trajectory, memory, accelerations)
            state = impose(topology, state, drive)
            left = balance(realised, state, accelerations, multipliers, drive, scale)
            return state, auxiliary, left

        def matrix_of(left):
            return newton_matrix(
                realised, operators, left.motion, left.closure, drive.turn is not None
            )

        def correct(carry, index):
            accelerations, multipliers, matrix, *_ = carry
            state, auxiliary, left = evaluate(accelerations, multipliers)
            matrix = jax.lax.cond(index == 0, lambda: matrix_of(left), lambda: matrix)
            closing = -jnp.where(
                moving,
                left.closing / jnp.where(moving, q_factor, 1.0),
                left.closing_acceleration,
            )
            change = correction(realised, operators, matrix, left, closing)
            # The last round only evaluates.
            share = (index < self.corrections).astype(jnp.float64)
            instant = balanced_instant(topology, left, accelerations, drive, scale)
            change = jax.tree.map(lambda x: share * x, change)
            accelerations = jax.tree.map(jnp.add, accelerations, change.accelerations)
            multipliers = multipliers + change.multipliers
            return (accelerations, multipliers, matrix, state, auxiliary, instant), None

        first = _prescribed(topology, drive, memory.accelerations)
        shapes = jax.eval_shape(lambda: matrix_of(evaluate(first, memory.multipliers)[2]))
        matrix = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
        state = State(trajectory.position, trajectory.velocity)
        carry = (first, memory.multipliers, matrix, state, memory.auxiliary, memory.instant)
        rounds = jnp.arange(self.corrections + 1)
        (accelerations, multipliers, _, state, auxiliary, instant), _ = jax.lax.scan(
            correct, carry, rounds
        )
        rates = _rates(realised, state, drive, instant)
        integrals = jax.tree.map(
            lambda sum, old, new: sum + 0.5 * h * (old + new),
            trajectory.integrals, memory.rates, rates,
        )
        return (
            Trajectory(state.position, state.velocity, integrals),
            Memory(accelerations, auxiliary, multipliers, rates, instant),
        )

    def _reached(self, h, trajectory: Trajectory, memory: Memory, accelerations: Coordinates):
        """State at the end of the step, and the method's a1."""
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
        return State(position, velocity), a1


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
