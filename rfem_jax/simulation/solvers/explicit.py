"""Explicit methods as diffrax solvers.

Place in the pipeline: equations, observation -> **explicit** -> catalogue.

    RungeKutta4Solver    the classical method with a fixed step, that of the paper
    LeapfrogSolver       one right-hand side a step
    PeakTracking   wraps any explicit solver and keeps maxima of the joint forces, outside of the error control
"""

from collections.abc import Callable
from typing import ClassVar

import diffrax
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from rfem_jax.kernels import kernel
from rfem_jax.mechanics.model.inputs import DriveInput
from rfem_jax.mechanics.model.model import Coordinates, State
from rfem_jax.mechanics.model.orientations import moved
from rfem_jax.mechanics.model.with_errors import ModelWithErrors
from rfem_jax.simulation.outcome.observation import Instant, solved_instant
from rfem_jax.simulation.solvers.generalised_alpha import MadeJump
from rfem_jax.simulation.system import equations
from rfem_jax.simulation.system.equations import Conditions, Scalar, Trajectory

# Reverse mode recomputes a stage from its state: to store hundreds of intermediates costs more.
MOTION = diffrax.ODETerm(jax.checkpoint(kernel(equations.right_hand_side, name="right-hand side")))


class StageInterpolation(diffrax.LocalLinearInterpolation):
    """Linear interpolation that carries the increments k = h f of the stages, first stage first."""

    k: PyTree


class RungeKutta4Solver(diffrax.AbstractSolver):
    """Classical Runge-Kutta method of order 4 with a fixed step.

    The four stages are one loop around one right-hand side: the program is a quarter as long as with four
    right-hand sides in a row, and runs faster, since it stays in the processor's cache.
    """

    term_structure: ClassVar = diffrax.AbstractTerm
    interpolation_cls: ClassVar[Callable] = StageInterpolation

    def order(self, terms: PyTree) -> int:
        return 4

    def init(self, terms: diffrax.AbstractTerm, t0: Scalar, t1: Scalar, y0: PyTree, args: PyTree) -> None:
        return None

    def step(
        self,
        terms: diffrax.AbstractTerm,
        t0: Scalar,
        t1: Scalar,
        y0: PyTree,
        args: PyTree,
        solver_state: None,
        made_jump: MadeJump,
    ) -> tuple[PyTree, None, dict[str, PyTree], None, diffrax.RESULTS]:
        del solver_state, made_jump
        control = terms.contr(t0, t1)
        nodes = jnp.array([0.0, 0.5, 0.5, 1.0])
        weights = jnp.array([1.0, 2.0, 2.0, 1.0]) / 6.0

        def stage(carry, entry):
            increment, total = carry
            node, weight = entry
            y = jax.tree.map(lambda a, b: a + node * b, y0, increment)
            increment = terms.vf_prod(t0 + node * (t1 - t0), y, args, control)
            total = jax.tree.map(lambda a, b: a + weight * b, total, increment)
            return (increment, total), increment

        zeros = jax.tree.map(jnp.zeros_like, y0)
        (_, total), k = jax.lax.scan(stage, (zeros, y0), (nodes, weights))
        return total, None, {"y0": y0, "y1": total, "k": k}, None, diffrax.RESULTS.successful

    def func(self, terms: diffrax.AbstractTerm, t0: Scalar, y0: PyTree, args: PyTree) -> PyTree:
        return terms.vf(t0, y0, args)


class LeapfrogSolver(diffrax.AbstractSolver):
    """Drift-kick-drift with one right-hand side a step, order 2 (theory (3.13)).

    For a state with `position`, `velocity` and `integrals`:

        q_half = q0 + h/2 v0,  v* = v0 + h/2 a_before,  a = a(q_half, v*),
        v1 = v0 + h a,         q1 = q_half + h/2 v1.

    Damping, gyroscopic and stabilising terms take v*, the velocity at mid-step predicted with the acceleration of the
    last step; with v0 instead the method would be of order 1.
    """

    term_structure: ClassVar = diffrax.AbstractTerm
    interpolation_cls: ClassVar[Callable] = StageInterpolation

    def order(self, terms: PyTree) -> int:
        return 2

    def init(self, terms: diffrax.AbstractTerm, t0: Scalar, t1: Scalar, y0: PyTree, args: PyTree) -> Coordinates:
        return terms.vf(t0, y0, args).velocity

    def step(
        self,
        terms: diffrax.AbstractTerm,
        t0: Scalar,
        t1: Scalar,
        y0: PyTree,
        args: PyTree,
        solver_state: Coordinates,
        made_jump: MadeJump,
    ) -> tuple[PyTree, None, dict[str, PyTree], Coordinates, diffrax.RESULTS]:
        del made_jump
        h = t1 - t0
        half = _drifted(y0.position, y0.velocity, 0.5 * h, args)
        predicted = _advance(y0.velocity, solver_state, 0.5 * h)
        middle = type(y0)(half, predicted, y0.integrals)
        rate = terms.vf(t0 + 0.5 * h, middle, args)
        velocity = _advance(y0.velocity, rate.velocity, h)
        integrals = jax.tree.map(lambda a, b: a + h * b, y0.integrals, rate.integrals)
        y1 = type(y0)(_drifted(half, velocity, 0.5 * h, args), velocity, integrals)
        k = jax.tree.map(lambda a: (h * a)[None], rate)
        return y1, None, {"y0": y0, "y1": y1, "k": k}, rate.velocity, diffrax.RESULTS.successful

    def func(self, terms: diffrax.AbstractTerm, t0: Scalar, y0: PyTree, args: PyTree) -> PyTree:
        return terms.vf(t0, y0, args)


def _drifted(position: Coordinates, velocity: Coordinates, h, args: PyTree) -> Coordinates:
    """Position after a time h at a constant velocity; quaternions turn with it (`args`: `Conditions`)."""
    change = jax.tree.map(lambda v: h * v, velocity)
    if position.joints.shape == velocity.joints.shape:
        return jax.tree.map(jnp.add, position, change)
    return moved(args.actual.topology, position, change)


def _advance(value: Coordinates, rate: Coordinates, h) -> Coordinates:
    return jax.tree.map(lambda a, b: a + h * b, value, rate)


class PeakTracking(diffrax.AbstractWrappedSolver):
    """Integrates the first part of a state (motion, peaks) with `solver`, and keeps in the second the largest value of
    `watch(rate)` at the starts of accepted steps.

    It solves the equations of motion, whatever its terms are, which are those of the whole state. The rate at the start
    of a step is the first stage of the solver, so the maxima cost no evaluation.
    """

    solver: diffrax.AbstractSolver  # pyright: ignore[reportIncompatibleVariableOverride] # an `AbstractVar`
    watch: Callable[[PyTree], Array] = equations.peaks

    # diffrax's adjoints look at it, as at the scan kind of its own solvers.
    scan_kind: ClassVar[str] = "bounded"

    @property
    def term_structure(self) -> PyTree:  # pyright: ignore[reportIncompatibleVariableOverride] # as diffrax's wrappers
        return self.solver.term_structure

    @property
    def interpolation_cls(self) -> Callable:  # pyright: ignore[reportIncompatibleMethodOverride] # likewise
        return diffrax.LocalLinearInterpolation

    def order(self, terms: PyTree) -> int | None:
        return self.solver.order(terms)

    def init(self, terms: diffrax.AbstractTerm, t0: Scalar, t1: Scalar, y0: PyTree, args: PyTree) -> PyTree:
        return self.solver.init(MOTION, t0, t1, y0[0], args)

    def step(
        self,
        terms: diffrax.AbstractTerm,
        t0: Scalar,
        t1: Scalar,
        y0: PyTree,
        args: PyTree,
        solver_state: PyTree,
        made_jump: MadeJump,
    ) -> tuple[PyTree, PyTree, dict[str, PyTree], PyTree, diffrax.RESULTS]:
        motion, peaks = y0
        motion1, error, dense, solver_state, result = self.solver.step(
            MOTION, t0, t1, motion, args, solver_state, made_jump
        )
        h = t1 - t0
        safe = jnp.where(h > 0.0, h, 1.0)
        seen = self.watch(jax.tree.map(lambda k: k[0] / safe, dense["k"]))
        peaks1 = jnp.where(h > 0.0, jnp.maximum(peaks, seen), peaks)
        if error is not None:
            error = (error, jnp.zeros_like(peaks))
        y1 = (motion1, peaks1)
        return y1, error, {"y0": y0, "y1": y1}, solver_state, result

    def func(self, terms: diffrax.AbstractTerm, t0: Scalar, y0: PyTree, args: PyTree) -> PyTree:
        return terms.vf(t0, y0, args)

    def operators(self, actual: ModelWithErrors, lengths: Float[Array, " lengths"]) -> None:
        """Explicit methods need none."""
        del actual, lengths

    def start(self, conditions: Conditions, trajectory: Trajectory) -> None:
        """Nothing is remembered from interval to interval."""
        del conditions, trajectory

    def resume(
        self, terms: diffrax.AbstractTerm, t0: Scalar, t1: Scalar, y0: PyTree, args: PyTree, memory: None
    ) -> PyTree:
        """State of the wrapped solver at the start of an interval: the drive may jump there."""
        del memory
        return self.init(terms, t0, t1, y0, args)

    def instant(
        self, t: Scalar, h: Float[Array, ""], trajectory: Trajectory, memory: PyTree, conditions: Conditions
    ) -> tuple[Float[Array, "4 joints"], State, DriveInput, Instant]:
        """At the time t [s]: squared loads, state, drive, and the solved instant."""
        del h, memory
        state, drive, result, _ = equations.at_instant(t, trajectory, conditions)
        scale = conditions.stabilisation.scale
        instant = solved_instant(conditions.actual, result, drive, scale)
        axial, normal, moment = equations.squares(conditions.actual.topology, instant.loads)
        return jnp.stack([axial, normal, axial + normal, moment]), state, drive, instant
