"""Integration methods as diffrax solvers.

Place in the pipeline: generalised_alpha, methods -> **solvers** -> stepping.

`RungeKutta4` is the paper's method; `Leapfrog` needs one right-hand side a step; `PeakTracking` wraps
any explicit solver and keeps running maxima of the joint forces, updated after accepted steps and outside the
error control.  Diffrax's own explicit solvers come by their names.

What `stepping` integrates with, `PeakTracking` and `GeneralisedAlpha`, is a diffrax solver of the state
(trajectory, squared maxima of forces) with four methods more: `operators(realised, lengths)`: what the
`Conditions` hold for steps of these lengths; `start(conditions, trajectory)` and `resume(terms, t0, t1, y0, args,
memory)`: its memory before the first interval and at the start of each; `instant(t, h, trajectory, memory,
conditions)`: at the end t of a step of length h squared axial and normal forces (2, joints), State, drive and the
solved instant.
"""

from collections.abc import Callable
from typing import ClassVar

import diffrax
import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import PyTree

from rfem_jax.description.methods import Method
from rfem_jax.mechanics.model import Coordinates
from rfem_jax.simulation import equations
from rfem_jax.simulation.equations import Conditions
from rfem_jax.simulation.generalised_alpha import GeneralisedAlpha
from rfem_jax.simulation.observation import solved_instant


class StageInterpolation(diffrax.LocalLinearInterpolation):
    """Linear interpolation that carries the stages' increments k = h f, first stage first."""

    k: PyTree


class RungeKutta4(diffrax.AbstractSolver):
    """Classical Runge-Kutta method of order 4 with a fixed step.

    The four stages are one loop around one copy of the right-hand side: the program is a quarter
    as long, and runs faster than four copies in a row, which XLA does not keep in cache.
    """

    term_structure: ClassVar = diffrax.AbstractTerm
    interpolation_cls: ClassVar[Callable] = StageInterpolation

    def order(self, terms):
        return 4

    def init(self, terms, t0, t1, y0, args):
        return None

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
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
        return total, None, dict(y0=y0, y1=total, k=k), None, diffrax.RESULTS.successful

    def func(self, terms, t0, y0, args):
        return terms.vf(t0, y0, args)


class Leapfrog(diffrax.AbstractSolver):
    """Drift-kick-drift with one right-hand side a step, order 2 (theory (3.13)).

    Acts on a state with `position`, `velocity` and further integrals:

        q_half = q0 + h/2 v0,  v* = v0 + h/2 a_before,  a = a(q_half, v*),
        v1 = v0 + h a,         q1 = q_half + h/2 v1.

    Damping, gyroscopic and stabilising terms read v*, the velocity at mid-step predicted with the
    last step's acceleration; a lagging velocity would make the method first order.
    """

    term_structure: ClassVar = diffrax.AbstractTerm
    interpolation_cls: ClassVar[Callable] = StageInterpolation

    def order(self, terms):
        return 2

    def init(self, terms, t0, t1, y0, args):
        return terms.vf(t0, y0, args).velocity

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        del made_jump
        h = t1 - t0
        half = _advance(y0.position, y0.velocity, 0.5 * h)
        predicted = _advance(y0.velocity, solver_state, 0.5 * h)
        middle = type(y0)(half, predicted, y0.integrals)
        rate = terms.vf(t0 + 0.5 * h, middle, args)
        velocity = _advance(y0.velocity, rate.velocity, h)
        integrals = jax.tree.map(lambda a, b: a + h * b, y0.integrals, rate.integrals)
        y1 = type(y0)(_advance(half, velocity, 0.5 * h), velocity, integrals)
        k = jax.tree.map(lambda a: (h * a)[None], rate)
        return y1, None, dict(y0=y0, y1=y1, k=k), rate.velocity, diffrax.RESULTS.successful

    def func(self, terms, t0, y0, args):
        return terms.vf(t0, y0, args)


def _advance(value: Coordinates, rate: Coordinates, h) -> Coordinates:
    return jax.tree.map(lambda a, b: a + h * b, value, rate)


class PeakTracking(diffrax.AbstractWrappedSolver):
    """Runs `solver` on the first part of the state (motion, peaks) and keeps in the second the
    largest value of `watch(rate)` at the starts of accepted steps.

    The rate at a step's start is the solver's first stage, so the maxima cost no evaluation.
    """

    solver: diffrax.AbstractSolver
    watch: Callable[[PyTree], Array] = equations.peaks

    # diffrax's adjoints look at these two of a solver.
    scan_kind = "bounded"

    @property
    def term_structure(self):
        return self.solver.term_structure

    @property
    def interpolation_cls(self):
        return diffrax.LocalLinearInterpolation

    def order(self, terms):
        return self.solver.order(terms)

    def init(self, terms, t0, t1, y0, args):
        return self.solver.init(_motion_term(terms), t0, t1, y0[0], args)

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        motion, peaks = y0
        inner = _motion_term(terms)
        motion1, error, dense, solver_state, result = self.solver.step(
            inner, t0, t1, motion, args, solver_state, made_jump
        )
        h = t1 - t0
        safe = jnp.where(h > 0.0, h, 1.0)
        seen = self.watch(jax.tree.map(lambda k: k[0] / safe, dense["k"]))
        peaks1 = jnp.where(h > 0.0, jnp.maximum(peaks, seen), peaks)
        if error is not None:
            error = (error, jnp.zeros_like(peaks))
        y1 = (motion1, peaks1)
        return y1, error, dict(y0=y0, y1=y1), solver_state, result

    def func(self, terms, t0, y0, args):
        return terms.vf(t0, y0, args)

    def operators(self, realised, lengths):
        """None are needed."""
        del realised, lengths

    def start(self, conditions, trajectory):
        """Nothing is remembered from interval to interval."""
        del conditions, trajectory

    def resume(self, terms, t0, t1, y0, args, memory):
        """Memory of the wrapped solver at the start of an interval: the drive may have jumped there."""
        del memory
        return self.init(terms, t0, t1, y0, args)

    def instant(self, t, h, trajectory, memory, conditions: Conditions):
        """Squared forces, State, drive, solved instant."""
        del h, memory
        state, drive, result, _ = equations.at_instant(t, trajectory, conditions)
        scale = conditions.stabilisation.scale
        instant = solved_instant(conditions.realised, result, drive, scale)
        axial, normal, _ = equations.squares(instant.loads)
        return jnp.stack([axial, normal]), state, drive, instant


def _motion_term(terms):
    """The term's vector field restricted to the motion."""
    zero = None

    def field(t, motion, args):
        return terms.vf(t, (motion, zero), args)[0]

    return diffrax.ODETerm(field)


_DIFFRAX = {
    "tsit5": diffrax.Tsit5,
    "dopri5": diffrax.Dopri5,
    "dopri8": diffrax.Dopri8,
    "bosh3": diffrax.Bosh3,
    "heun": diffrax.Heun,
    "midpoint": diffrax.Midpoint,
    "ralston": diffrax.Ralston,
}


def observed_solver(method: Method) -> PeakTracking | GeneralisedAlpha:
    """The solver that integrates trajectory and maxima of forces by a method."""
    return GeneralisedAlpha(method) if method.implicit else PeakTracking(make_solver(method))


def make_solver(method: Method) -> diffrax.AbstractSolver:
    """The diffrax solver of an explicit method."""
    if method.name == "rk4":
        return RungeKutta4()
    if method.name == "leapfrog":
        return Leapfrog()
    # "bounded" loops over the stages take every transform, forward and reverse.
    return _DIFFRAX[method.name](scan_kind="bounded")
