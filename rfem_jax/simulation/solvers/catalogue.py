"""From a method of the description to what integrates by it.

Place in the pipeline: explicit, generalised_alpha -> **catalogue** -> stepping.

    IntervalSolver     what `stepping` needs of a solver
    observed_solver    the one of a method
    register_method    adds a class of methods with its solver

diffrax's own explicit solvers are taken by their names.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, Protocol, runtime_checkable

import diffrax
from jaxtyping import Array, Float, PyTree

from rfem_jax.description.methods import Explicit, GeneralisedAlpha, Leapfrog, Method, RungeKutta4, add_method_class
from rfem_jax.mechanics.model.inputs import DriveInput
from rfem_jax.mechanics.model.model import State
from rfem_jax.mechanics.model.with_errors import ModelWithErrors
from rfem_jax.simulation.outcome.observation import Instant
from rfem_jax.simulation.solvers.explicit import LeapfrogSolver, PeakTracking, RungeKutta4Solver
from rfem_jax.simulation.solvers.generalised_alpha import GeneralisedAlphaSolver, MadeJump, StepState
from rfem_jax.simulation.system.equations import Conditions, Scalar, Trajectory


@runtime_checkable
class IntervalSolver(Protocol):
    """A diffrax solver of the state (trajectory, squared maxima of forces) that goes on from interval to interval.

    Its memory is what it carries besides the state, None for a method that carries nothing.
    """

    def operators(self, actual: ModelWithErrors, lengths: Float[Array, " lengths"]) -> PyTree:
        """`Conditions.operators` for steps of several lengths [s], which are the first axis of the arrays."""
        ...

    def start(self, conditions: Conditions, trajectory: Trajectory) -> PyTree:
        """Memory before the first interval."""
        ...

    def resume(
        self, terms: diffrax.AbstractTerm, t0: Scalar, t1: Scalar, y0: StepState, args: Conditions, memory: Any
    ) -> PyTree:
        """The solver's state at the start of an interval, from the memory at the end of the one before."""
        ...

    def step(
        self,
        terms: diffrax.AbstractTerm,
        t0: Scalar,
        t1: Scalar,
        y0: StepState,
        args: Conditions,
        solver_state: Any,
        made_jump: MadeJump,
    ) -> tuple[StepState, PyTree, dict[str, PyTree], PyTree, diffrax.RESULTS]:
        """One step, as `diffrax.AbstractSolver.step`."""
        ...

    def instant(
        self, t: Scalar, h: Float[Array, ""], trajectory: Trajectory, memory: Any, conditions: Conditions
    ) -> tuple[Float[Array, "4 joints"], State, DriveInput, Instant]:
        """At the end t of a step of length h [s]: squared axial and normal forces [N^2], state, drive, instant."""
        ...


_DIFFRAX = {
    "tsit5": diffrax.Tsit5,
    "dopri5": diffrax.Dopri5,
    "dopri8": diffrax.Dopri8,
    "bosh3": diffrax.Bosh3,
    "heun": diffrax.Heun,
    "midpoint": diffrax.Midpoint,
    "ralston": diffrax.Ralston,
}
_MAKERS: dict[type[Method], Callable[[Any], diffrax.AbstractSolver]] = {
    RungeKutta4: lambda method: RungeKutta4Solver(),
    Leapfrog: lambda method: LeapfrogSolver(),
    GeneralisedAlpha: GeneralisedAlphaSolver,
    Explicit: lambda method: _DIFFRAX[method.solver]() if isinstance(method.solver, str) else method.solver,
}


def register_method(kind: type[Method], make_solver: Callable[[Any], diffrax.AbstractSolver]) -> None:
    """Add a class of integration methods. From then on its name is known in study files.

        @dataclass(frozen=True, kw_only=True)
        class Kutta(FixedStep):
            names: ClassVar[tuple[str, ...]] = ("kutta3",)

        register_method(Kutta, lambda method: KuttaSolver())
        run = simulate(Simulation(model, method=Kutta(step=1e-5), ...), errors)

    Programs of such a method are compiled in every process, because its source is not part of their keys.

    **Arguments:** `kind`: a frozen dataclass derived from `Method` (or from a class of methods) whose one name in
    `names` is its own; its other fields are settings, made by `description.methods.setting`. `make_solver`: from a
    method of this class to its diffrax solver. An explicit one advances a `Trajectory`, and its dense information
    holds the increments h f of its stages, first stage first, as "k" (all Runge-Kutta methods of diffrax that derive
    from `diffrax.AbstractERK` do; these need no class: `Explicit(solver, step=...)`). An implicit one
    (`implicit = True` in the class) is an `IntervalSolver`. Steps of an explicit method are checked for stability only
    if it derives from `diffrax.AbstractERK`.

    **Raises:** `InputError` for a class that is not of this form, or a name that another method has.
    """
    add_method_class(kind)
    _MAKERS[kind] = make_solver


def observed_solver(method: Method) -> IntervalSolver:
    """The solver that integrates trajectory and maxima of forces by a method."""
    solver = make_solver(method)
    return solver if isinstance(solver, IntervalSolver) else PeakTracking(solver)


def make_solver(method: Method) -> diffrax.AbstractSolver:
    """The diffrax solver of a method."""
    solver = _MAKERS[type(method)](method)
    # With "bounded" loops over the stages all transforms apply, in forward and reverse mode.
    return dataclasses.replace(solver, scan_kind="bounded") if isinstance(solver, diffrax.AbstractERK) else solver
