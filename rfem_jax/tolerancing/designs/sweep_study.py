"""Sweeps: all metrics on a grid or at Sobol' points over ranges of the errors.

Place in the pipeline: problem + ranges -> samples (`sampled_studies`, as Monte Carlo) -> response surface -> result.

Symbols: N points, k errors that vary, m metrics; errors (N, k) [rad or m], values (N, m) [units of the metrics].
Source: theory (10.27); Sobol' points: see `sampling.sequences`.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Float, Int

from rfem_jax.description.basics.errors import InputError, require_choice
from rfem_jax.description.basics.precision import require_float64
from rfem_jax.description.tasks.settings import MOST_SAMPLES, whole_number
from rfem_jax.labelled_data import Arrays, Labelled, Parts, Table, column_name, named_dimension
from rfem_jax.tolerancing.checks import ErrorValue, ErrorValues, check_variables, error_value
from rfem_jax.tolerancing.designs.response_surface import ResponseSurface, fit_response_surface
from rfem_jax.tolerancing.labelled_results import MetricResult
from rfem_jax.tolerancing.layout import show_error, show_number
from rfem_jax.tolerancing.problems.distributions import DISTRIBUTIONS
from rfem_jax.tolerancing.problems.evaluation import read_point
from rfem_jax.tolerancing.problems.named_tolerances import Tolerances
from rfem_jax.tolerancing.problems.problem import ToleranceProblem
from rfem_jax.tolerancing.progress import ProgressOption
from rfem_jax.tolerancing.sampling.sampled_studies import SampleStudy, sample_study
from rfem_jax.tolerancing.sampling.sequences import RandomKey, unit_points

DESIGNS = ("grid", "sobol")
Bounds = Mapping[str, tuple[ErrorValue, ErrorValue]]


@dataclass(frozen=True, eq=False)
class SweepResult(MetricResult):
    """Metrics over ranges of errors.

    names, error_units, bounds (k): of the errors that vary, "rad" or "m", (low, high); metrics, metric_units, labels
    (m); at {name: value}: errors held fixed, [rad or m];
    errors (N, k), values (N, m), NaN where a sample failed, status (N,), 0 good;
    design "grid" (with `levels` of each error, the last one fastest) or "sobol";
    surface: the response surface, None where the design does not determine one, for the reason `surface_note`.
    """

    names: tuple[str, ...]
    error_units: tuple[str, ...]
    bounds: tuple[tuple[float, float], ...]
    metrics: tuple[str, ...]
    metric_units: tuple[str, ...]
    labels: tuple[str, ...]
    at: dict[str, float]
    errors: Float[np.ndarray, "N k"]
    values: Float[np.ndarray, "N m"]
    status: Int[np.ndarray, " N"]
    design: str
    levels: int
    surface: ResponseSurface | None
    surface_note: str
    chunks_computed: int

    @property
    def good(self) -> int:
        """Number of points that did not fail."""
        return int(np.sum(self.status == 0))

    index = ("point",)

    def rows(self) -> list[dict[str, Any]]:
        """A row per point: status, errors and metrics, with their units in the names of the columns; with a response
        surface also its value at every point."""
        fitted = None if self.surface is None else self.surface(self.errors)
        out = []
        for i in range(len(self.status)):
            row: dict[str, Any] = {"point": i, "status": int(self.status[i])}
            for j, (name, unit) in enumerate(zip(self.names, self.error_units, strict=True)):
                row[column_name(name, unit)] = float(self.errors[i, j])
            for j, (name, unit) in enumerate(zip(self.metrics, self.metric_units, strict=True)):
                row[column_name(name, unit)] = float(self.values[i, j])
                if fitted is not None:
                    row[column_name(f"{name}_surface", unit)] = float(fitted[i, j])
            out.append(row)
        return out

    def arrays(self) -> Arrays:
        """All points over `point`, the ranges over `end`, and of a response surface its accuracy over `metric`."""
        surface, of_point, metric = self.surface, ("point", "metric"), ("metric",)
        of_errors, unit = ("point", "error"), "in metric_unit"
        variables = {
            "error_value": Labelled(of_errors, self.errors, "", "errors and numbers of the points, in error_unit"),
            "value": Labelled(of_point, self.values, "", f"metrics of the points, {unit}; NaN: it failed"),
            "status": Labelled(("point",), self.status, "", "0: good"),
            "bounds": Labelled(("error", "end"), self.bounds, "", "range, in error_unit"),
        }
        if surface is not None:
            effect = "change over the range by the response surface"
            variables |= {
                "surface": Labelled(of_point, surface(self.errors), "", f"response surface at the points, {unit}"),
                "effect": Labelled(("metric", "error"), surface.effects(), "", f"{effect}, {unit}"),
                "cross_validated_error": Labelled(metric, surface.cross_validated, "", f"of the surface, {unit}"),
                "explained": Labelled(metric, surface.explained, "1", "part of the variance that the surface explains"),
            }
        coordinates = {"point": Labelled(("point",), np.arange(len(self.status)), "1", "number of the point")}
        coordinates |= named_dimension("metric", self.metrics, self.metric_units) | {"end": ("low", "high")}
        coordinates |= named_dimension("error", self.names, self.error_units)
        attributes = {"title": "Sweep", "design": self.design, "good": self.good, "surface_note": self.surface_note}
        return variables, coordinates, attributes

    def parts(self) -> Parts:
        """The ranges, the extremes of all metrics, and how good a response surface is."""
        size = f"{self.levels} levels of each" if self.design == "grid" else "Sobol' points"
        head = f"Sweep over {len(self.names)} quantities: {len(self.status)} points ({size}), "
        head += f"{len(self.status) - self.good} failed"
        parts = [head, self._ranges(), "", self._extremes(), ""]
        if self.surface is None:
            return [*parts, f"No response surface: {self.surface_note}"]
        return [*parts, "Response surface (quadratic)", self._surface_table(self.surface)]

    def _ranges(self) -> Table:
        ends = zip(self.names, self.error_units, self.bounds, strict=True)
        return Table(
            ["quantity", "from", "to"], [[name, *(show_error(end, unit) for end in pair)] for name, unit, pair in ends]
        )

    def _extremes(self) -> Table:
        rows = []
        for j, (metric, unit) in enumerate(zip(self.metrics, self.metric_units, strict=True)):
            column = self.values[:, j]
            for word, find in (("smallest", np.nanargmin), ("largest", np.nanargmax)):
                if np.any(np.isfinite(column)):
                    i = int(find(column))
                    pairs = zip(self.errors[i], self.error_units, strict=True)
                    where = [show_error(e, of, 4) for e, of in pairs]
                    rows.append([f"{metric} [{unit or 1}]", word, show_number(column[i]), *where])
        return Table(["metric", "", "value", *self.names], rows)

    def _surface_table(self, surface: ResponseSurface) -> Table:
        effects = surface.effects()
        rows = [
            [
                f"{metric} [{unit or 1}]",
                show_number(surface.cross_validated[j], 3),
                f"{100 * surface.explained[j]:.4g} %",
                *(show_number(effect, 4, scale=np.max(effects[j])) for effect in effects[j]),
            ]
            for j, (metric, unit) in enumerate(zip(self.metrics, self.metric_units, strict=True))
        ]
        return Table(
            ["metric", "cross-validated error", "explained", *(f"effect of {name}" for name in self.names)], rows
        )


def sweep(
    problem: ToleranceProblem,
    bounds: Bounds,
    *,
    design: str = "grid",
    levels: int = 5,
    n: int = 128,
    key: RandomKey | None = None,
    at: ErrorValues | None = None,
    batch: int = 64,
    lanes: int | None = None,
    resume: str | Path | None = None,
    progress: ProgressOption = False,
    description: Mapping[str, str] | None = None,
) -> SweepResult:
    """Run `problem` at points all over ranges of its errors.

    Args:
        bounds: {error: (low, high)} in rad or m, or strings with a unit.
        design: "grid", all combinations of `levels` values of each error, or "sobol", `n` scrambled Sobol' points.
        key: JAX random key of the Sobol' points; None for jax.random.key(0).
        at: {error: value} of errors held fixed; all others are zero.
        batch, lanes, resume, progress, description: as of `monte_carlo`; an interrupted sweep continues in its folder.
    Raises: InputError for unknown names and bad numbers, and a folder of another study; ChunkWriteError.
    """
    require_float64()
    names, ends = read_bounds(problem, bounds)
    fixed = read_fixed(problem, at, names)
    for what, number, least in (("levels", levels, 2), ("n", n, 2)):
        whole_number(number, what, least)
    key = jax.random.key(0) if key is None else key
    study = sweep_samples(dict(zip(names, ends, strict=True)), fixed, key, design, levels, batch, lanes)
    points = design_of(design, len(names), levels, n, key)
    complete = np.concatenate([points, np.full((len(points), len(fixed)), 0.5)], axis=1)
    samples, computed = study.run(
        problem, complete, {"n": len(points)}, resume=resume, progress=progress, description=description
    )
    return _result(problem, names, ends, fixed, samples, design, levels, computed)


def _result(problem, names, ends, fixed, samples, design, levels, computed) -> SweepResult:
    metrics = tuple(metric.name for metric in problem.metrics)
    errors, values = samples["errors"][:, : len(names)], samples["values"]
    surface, note = None, ""
    try:
        surface = fit_response_surface(names, metrics, errors, values)
    except InputError as problem_of_fit:
        note = str(problem_of_fit)
    return SweepResult(
        names=names,
        error_units=tuple(problem.error_unit(name) for name in names),
        bounds=tuple(ends),
        metrics=metrics,
        metric_units=tuple(metric.unit for metric in problem.metrics),
        labels=tuple(metric.label for metric in problem.metrics),
        at=fixed,
        errors=errors,
        values=values,
        status=samples["status"],
        design=design,
        levels=levels,
        surface=surface,
        surface_note=note,
        chunks_computed=computed,
    )  # fmt: skip


def design_of(design: str, k: int, levels: int, n: int, key: RandomKey) -> Float[np.ndarray, "N k"]:
    """Points (N, k) of the unit cube, ends included on a grid. Raises: InputError for another design, or too many."""
    require_choice(design, DESIGNS, "design")
    if design == "sobol":
        return unit_points(key, n, k, "sobol")
    if levels**k > MOST_SAMPLES:
        raise InputError(
            f"Argument `levels` must give a grid of at most {MOST_SAMPLES} points, but {levels} levels of {k} errors "
            f'are more; take fewer, or the design "sobol".'
        )
    axes = [np.linspace(0.0, 1.0, levels)] * k
    return np.stack([axis.ravel() for axis in np.meshgrid(*axes, indexing="ij")], axis=1)


def sweep_samples(
    bounds: Mapping[str, tuple[float, float]],
    fixed: Mapping[str, float],
    key: RandomKey,
    design: str,
    levels: int,
    batch: int,
    lanes: int | None,
) -> SampleStudy:
    """The points of a sweep, and its folder: errors uniform between bounds [rad or m], and fixed ones as ranges without
    width; arguments and errors as of `sweep`."""
    uniform = DISTRIBUTIONS["uniform"]
    varying = {name: uniform(interval=pair) for name, pair in bounds.items()}
    tolerances = Tolerances(varying | {name: uniform(interval=(value, value)) for name, value in fixed.items()})
    grid = {"levels": levels} if design == "grid" else {}
    return sample_study("sweep", tolerances, key, batch=batch, lanes=lanes, design=design, **grid)


def read_fixed(problem: ToleranceProblem, at: ErrorValues | None, names: tuple[str, ...]) -> dict[str, float]:
    """Errors held fixed [rad, m], none of those that vary. Raises InputError."""
    fixed = read_point(problem, at)
    for name in names:
        if name in fixed:
            raise InputError(
                f"Argument `at` must hold errors that do not vary, but `{name}` varies; remove it from `at`."
            )
    return fixed


def read_bounds(
    problem: ToleranceProblem, bounds: Bounds, what: str = "bounds"
) -> tuple[tuple[str, ...], list[tuple[float, float]]]:
    """Names and (low, high) [rad, m] of ranges, of the argument `what`. Raises InputError."""
    if not isinstance(bounds, Mapping) or not bounds:
        raise InputError(
            f"Argument `{what}` must map errors to (low, high), but it is {bounds!r}; "
            'write {"D.delta_x": ("-0.5 deg", "0.5 deg")}.'
        )
    check_variables(bounds, problem, what)
    ends = []
    for name, pair in bounds.items():
        if not isinstance(pair, (tuple, list)) or len(pair) != 2:
            raise InputError(f"Argument `{what}` must have pairs (low, high), but `{name}` has {pair!r}; write both.")
        low, high = (error_value(end, problem.error_unit(name), f"`{name}` of `{what}`") for end in pair)
        if not (np.isfinite(low) and np.isfinite(high) and low < high):
            raise InputError(
                f"Argument `{what}` must rise from low to high, but `{name}` has {pair!r}; swap or correct its ends."
            )
        ends.append((low, high))
    return tuple(bounds), ends
