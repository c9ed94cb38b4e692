"""The simulator as a problem: named errors in, metrics and a status out.

Place in the pipeline: model, drive, metrics, method -> **Problem** -> all tolerance studies.
The only place where tolerance studies meet the mechanics.
"""

import functools
import warnings
from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rfem_jax.compilation.program import Program
from rfem_jax.description.basics.errors import InputError
from rfem_jax.description.basics.precision import require_float64
from rfem_jax.description.drives.driven_motions import Drive
from rfem_jax.description.drives.numbers_by_name import drive_number_unit
from rfem_jax.description.methods import GeneralisedAlpha, Method
from rfem_jax.description.metrics.catalogue import only_at_start
from rfem_jax.mechanics.model.errors import Deviations, Errors, deviations, deviations_of
from rfem_jax.mechanics.model.model import Model
from rfem_jax.mechanics.model.status import PAST_LIMIT, STATUS
from rfem_jax.mechanics.statics.designs import Design, Designed, designed
from rfem_jax.simulation.locking import FAILED_IN_MOTION, DriveLimit, drive_limit
from rfem_jax.simulation.outcome.records import require_records
from rfem_jax.simulation.outcome.run import RESIDUAL_LIMIT
from rfem_jax.simulation.simulating import perfect_model, simulated
from rfem_jax.simulation.specification import Simulation, simulation_of_call
from rfem_jax.simulation.stages.conclusion import run_of_design
from rfem_jax.simulation.stages.integration import grid_for
from rfem_jax.simulation.stages.stepping import Integration, contact_tolerance_of
from rfem_jax.simulation.system.driving import design_with, drive_numbers, drive_of_design, require_driven
from rfem_jax.simulation.system.time_grid import TimeGrid, longest_interval, of_any_step
from rfem_jax.tolerancing.checks import check_distinct, error_value
from rfem_jax.tolerancing.problems.mechanism_problem import (
    LINEAR_ERROR,
    MechanismProblem,
    following_metrics,
    known_metric,
    records_of,
)
from rfem_jax.tolerancing.problems.metrics import metric
from rfem_jax.tolerancing.problems.problem import Metric, Status, Values


class Problem(MechanismProblem):
    """A mechanism under a drive as a pure function of its assembly errors.

    `problem(errors)` takes {error name: number in rad or m, or a string with a unit}, or what `assembly_errors` and
    `deviations` return, and returns ({metric name: scalar}, status); it works under jit, vmap, jacfwd, grad, jacrev and
    their compositions.

    Memory: forward mode stores nothing along the way. Reverse mode with an explicit method of fixed steps keeps the
    integrated state at every saved time and at every stage of one interval between them, with an implicit method the
    state and the solution (accelerations, multipliers) of every step; everything else is computed again
    (`benchmarks/gradients.py` measures both).

    Args:
        simulation: what is simulated; `save_every` is also the interval of the balances and checkpoints, and of the
            times that p-norms see; deviations of parameters are from the values of its `design`.
        metrics: `Metric`s with functions, or names ("A.rms_force", "end_energy"; see `register_metric`).
        further, former: arguments of an earlier version, Problem(model, drive, duration, metrics, method, ...), which
            warns.
    Raises: InputError for unknown and repeated metrics, metrics without a function and of joints that do not exist, and
        for a simulation that starts from a `State`.
    """

    model: Model
    drive: Drive
    duration: float = eqx.field(static=True)
    metrics: tuple[Metric, ...] = eqx.field(static=True)
    method: Method = eqx.field(static=True)
    save_every: float | None = eqx.field(static=True)
    design: Design | None = None
    steps: Float[Array, ""] | None = eqx.field(init=False)  # in an interval, where it is traced

    def __init__(
        self,
        simulation: Simulation | Model | None = None,
        metrics: str | Metric | Iterable[str | Metric] | None = None,
        *further: Any,
        **former: Any,
    ):
        if simulation is None and "model" in former:
            simulation, former = former["model"], {name: one for name, one in former.items() if name != "model"}
        if isinstance(simulation, Model):
            simulation, metrics = _of_former_arguments(simulation, metrics, further, former)
        elif further or former:
            raise InputError(
                "Arguments of a problem must be a simulation and metrics, but more were given; give drive, duration, "
                "method and the like to `Simulation`."
            )
        simulation, metrics = simulation_of_call("Problem", simulation, {}), () if metrics is None else metrics
        if simulation.start is not None:
            raise InputError(
                "Argument `start` of a problem's simulation must be a word, but is a State, which no errors change; "
                'leave it out, or give "as_given" or "equilibrium".'
            )
        metrics = (metrics,) if isinstance(metrics, (str, Metric)) else tuple(metrics)
        model = following_metrics(simulation.model, metrics)
        self.model, self.drive, self.design, self.steps = model, simulation.drive, simulation.design, None
        self.metrics = tuple(known_metric(model, m) for m in metrics)
        check_distinct((m.name for m in self.metrics), "metrics")
        _check_angle(model, self.metrics)
        self.duration, self.save_every = simulation.require_duration(), simulation.save_every
        self.method = simulation.chosen

    # Short: JAX asks for it whenever it transforms a problem, and all of a model takes longer than a simulation.
    def __repr__(self) -> str:
        links, names = ", ".join(self.model.topology.links), ", ".join(one.name for one in self.metrics)
        step = "" if self.method.step is None else f" with steps of {self.method.step:g} s"
        return f"<Problem of {links}: {names} over {self.duration:g} s by {self.method.name}{step}>"

    @property
    def reversible(self) -> bool:
        """Whether reverse mode is possible: not with steps that are chosen on the way."""
        return not self.method.adaptive and contact_tolerance_of(self.model, self.method) is None

    @property
    def drive_numbers(self) -> dict[str, Array | float]:
        """Numbers of the drives [their units] that no parameter has the name of."""
        known = () if self.model.source is None else self.model.source.blueprint.names
        numbers = drive_numbers(self.model, self.drive, self.design)
        return {name: number for name, number in numbers.items() if name not in known}

    def describe_status(self, code: int) -> str:
        """Short name of a status code; "ok" for 0. Samples that have diverged are past the limit of their mechanism
        where the perfect one locks under the drive."""
        code = int(code)
        if code in FAILED_IN_MOTION and self._limit is not None:
            code = PAST_LIMIT
        return STATUS[code].name

    @property
    def _limit(self) -> DriveLimit | None:
        """Where the loops stop closing under the drive."""
        return drive_limit(self.model, drive_of_design(self.model, self.drive, self.design), self.duration)

    @property
    def undamped(self) -> bool:
        """True if no flexible link has damping: derivatives of mean-square forces then depend on
        the phase of undamped vibrations (docs/theory/9_symmetry.md)."""
        flexible = np.array(self.model.topology.elements) > 1
        damping = [*np.asarray(self.model.section.damping)[flexible]]
        damping += [float(one.damping) for one in self.model.superelements or ()]
        return bool(flexible.any() and not any(damping))

    @property
    def strikes(self) -> bool:
        """Whether pins may strike their bushes: derivatives through impacts lose their meaning after a few, as single
        runs do, and count only as far as a finer step reproduces them. Not in metrics of the start at rest."""
        return bool(self.model.topology.clearances) and not only_at_start(one.name for one in self.metrics)

    def refined(self) -> "Problem":
        """The same problem with half the step and parts of it that follow contacts, or a tenth of the tolerances of an
        adaptive method; times between which balances are made stay."""
        finer = finer_method(self.method, contacts=bool(self.model.topology.clearances))
        every = self.save_every if self.method.adaptive else self._interval
        return self._changed(method=finer, save_every=every)

    def with_checks(self) -> tuple["Problem", tuple[str, ...]]:
        """The problem with its checks beside the metrics, and their names: the estimated error of linear elements,
        where links have such."""
        topology = self.model.topology
        if topology.exact or not topology.n_rfes:
            return self, ()
        named = {one.name: one for one in (*self.metrics, metric(LINEAR_ERROR))}
        if len(named) == len(self.metrics):
            return self, (LINEAR_ERROR,)
        return self._changed(metrics=list(named.values())), (LINEAR_ERROR,)

    def with_metrics(self, metrics: Iterable[str | Metric]) -> "Problem":
        """The same simulations with other metrics. Raises InputError as `Problem`."""
        return self._changed(metrics=tuple(metrics))

    def _changed(self, **settings: Any) -> "Problem":
        metrics = settings.pop("metrics", self.metrics)
        kept = {name: getattr(self, name) for name in ("drive", "duration", "method", "save_every", "design")}
        return Problem(Simulation(self.model, **(kept | settings)), metrics)

    def of_any_step(self) -> "Problem":
        """The same problem in the form that shares its programs with those of other steps; not for reverse mode."""
        grid, count = grid_for(self.drive, self.duration, self.method, self.save_every, self.model)
        method, _, steps = of_any_step(self.method, grid, count)
        if isinstance(steps, int) or self.steps is not None:
            return self
        same = self._changed(method=method, save_every=self._interval)
        return eqx.tree_at(lambda one: one.steps, same, steps, is_leaf=lambda x: x is None)

    @property
    def derivative_limit(self) -> float | None:
        """The largest relative residual of the differentiated equations with which a derivative counts as converged
        (see `derivative_residual`); None for explicit methods, which solve no equations."""
        return RESIDUAL_LIMIT if self.method.implicit else None

    def __call__(self, errors: Errors) -> tuple[Values, Status]:
        """Values {metric name: scalar} and status (scalar int32) of one sample."""
        problem, deviating = self._split(errors)
        if problem.design is not None or deviating.parameters:
            return _values_and_status(problem, deviating)
        errors = deviating.errors
        model = replace(problem.model, source=None)
        integration = Integration.of_any_step(model, problem.drive, *problem._grid(), problem.method, errors)
        return _values_of_numbers(problem.metrics, integration, errors)

    def with_residual(
        self, errors: Errors
    ) -> tuple[Values, Status, Float[Array, "times n"], Float[Array, "joints times 3"]]:
        """Values, status, residual of the equations of motion [N] and joint forces [N] at the saved times.

        The derivatives of the residual and of the forces show how accurate derivatives are. With explicit methods
        n = 0.
        """
        problem, errors = self._split(errors)
        drive = drive_of_design(problem.model, problem.drive, problem.design)
        made = designed(problem.model, problem.design, errors)
        integration = Integration.of_any_step(made.model, drive, *problem._grid(), problem.method, made)
        asked = require_records(made.model, problem.records)
        perfect = perfect_model(problem.model, problem.design, errors, asked)
        run = run_of_design(made, simulated(integration, made.errors, None, None, asked, perfect))
        forces = jnp.stack([load.force for load in run.loads.values()])
        values = {m.name: jnp.asarray(m(run)) for m in self.metrics}
        return values, jnp.asarray(run.status), jnp.asarray(run.checks.equation_residual), forces

    @property
    def _interval(self) -> float:
        return longest_interval(self.duration, self.method.step, self.save_every)

    def _grid(self) -> tuple[TimeGrid, int | Float[Array, ""]]:
        """The time grid, and the number of steps in an interval."""
        require_float64()
        require_driven(self.model, self.drive)
        grid, steps = grid_for(self.drive, self.duration, self.method, self.save_every, self.model)
        return (grid, steps) if self.steps is None else (grid.of_any_step(), self.steps)

    def _split(self, errors: Errors) -> tuple["Problem", Deviations]:
        """The problem with the numbers of drives that deviate, and what else deviates."""
        if not isinstance(errors, Mapping):
            return self, deviations_of(self.model, errors)
        known = self.drive_numbers if any(name.startswith("drive.") for name in errors) else {}
        numbers = {}
        for name in (name for name in errors if name in known):
            change = errors[name]
            change = error_value(change, drive_number_unit(name), name) if isinstance(change, str) else change
            numbers[name] = jnp.asarray(known[name] + change, jnp.float64)
        others = {name: value for name, value in errors.items() if name not in numbers}
        problem = self
        if numbers:
            driven = design_with(self.model, self.drive, self.design, numbers)
            problem = eqx.tree_at(lambda one: one.design, self, driven, is_leaf=lambda x: x is None)
        return problem, deviations(self.model, others)


@functools.partial(Program, nameless=True)
def _values_and_status(problem: Problem, errors: Deviations) -> tuple[Values, Status]:
    """A program of its own: that of `simulate` differentiates the histories, too."""
    return problem.with_residual(errors)[:2]


@functools.partial(Program, nameless=True)
def _values_of_numbers(metrics, whole: Integration, errors):
    """As `_values_and_status`, of a mechanism whose numbers are those of the model."""
    asked = require_records(whole.model, records_of(metrics))
    run = run_of_design(Designed(whole.model, errors), simulated(whole, errors, None, None, asked))
    return {m.name: jnp.asarray(m(run)) for m in metrics}, run.status


def _of_former_arguments(
    model: Model, drive: Any, further: tuple, former: dict[str, Any]
) -> tuple[Simulation, str | Metric | Iterable[str | Metric]]:
    """Simulation and metrics of a call as in an earlier version, which warns."""
    names = ("drive", "duration", "metrics", "method", "save_every", "design", "trials")
    # Where all came by their names, what stands in the place of the drive are the metrics.
    by_place: dict[str, Any] = {"metrics": drive} if "drive" in former else dict(zip(names, (drive, *further)))
    given = {**by_place, **former}
    metrics = given.pop("metrics", ())
    warnings.warn(
        "`Problem` takes a simulation: write Problem(Simulation(model, drive=..., duration=..., method=...), metrics), "
        "which a later version needs.",
        DeprecationWarning,
        stacklevel=5,  # beyond Equinox
    )
    return Simulation(model, **given), metrics


def _check_angle(model: Model, metrics: Iterable[Metric]) -> None:
    driven = model.topology.driven_coordinate
    slides = driven is not None and model.topology.slides[driven]
    if slides and any(one.name == "angle_error" for one in metrics):
        raise InputError(
            "Argument `metrics` must fit the drive, but `angle_error` is of an angle and the first drive moves "
            f"`{model.topology.drive_labels[0]}` along an axis; leave it out, or give a Metric of the displacement."
        )


def finer_method(method: Method, contacts: bool = True) -> Method:
    """The same method with half the step and parts of it that follow contacts (where there are any), or a tenth of its
    tolerances."""
    if method.step is None:
        return replace(method, **{name: 0.1 * getattr(method, name) for name in ("rtol", "atol")})
    finer = replace(method, step=0.5 * method.step)
    if isinstance(finer, GeneralisedAlpha) and contacts:
        finer = replace(finer, contact_tolerance=0.25 * finer.contact_tolerance)
    return finer
