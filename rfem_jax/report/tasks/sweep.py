"""Sweeps: metrics over ranges of errors and numbers of the design: a table, responses over one, contours over two.

Place in the pipeline: `rfem_jax.description.tasks.sweep` -> **sweep** -> terminal, files and pictures. Pictures show
errors in deg and mm, metrics in their own units.
"""

from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from rfem_jax.description.parameters.deviations import deviation_unit
from rfem_jax.description.study_file.study import Study
from rfem_jax.description.tasks.sweep import SweepTask
from rfem_jax.description.tolerances.error_catalogue import as_specified
from rfem_jax.report.contents.annotations import Axes, Figure
from rfem_jax.report.contents.overview import format_error
from rfem_jax.report.drawings.style import CASE_COLOURS, MARKERS, add_titles, new_figure, panel_grid
from rfem_jax.report.tasks import study_problem
from rfem_jax.report.tasks.sampled_report import SampledReport
from rfem_jax.report.tasks.task_files import metric_units
from rfem_jax.report.tasks.task_report import as_stage
from rfem_jax.tolerancing.designs.response_surface import ResponseSurface
from rfem_jax.tolerancing.designs.sweep_study import SweepResult, sweep_samples
from rfem_jax.tolerancing.designs.sweep_study import sweep as run_sweep
from rfem_jax.tolerancing.sampling.sampled_studies import SampleStudy

MOST_EACH = 4  # errors and metrics of the responses
MOST_PANELS = 8
FINE = 61  # points of a curve, and of a side of a contour map


class SweepReport(SampledReport[SweepTask, SweepResult]):
    """Metrics on a design of experiments."""

    words = "sweep", "points"

    def samples(self) -> SampleStudy:
        task = self.task
        key = jax.random.key(task.seed)
        return sweep_samples(task.bounds, task.at, key, task.design, task.levels, task.batch, task.lanes)

    def run(self, folder: Path) -> SweepResult:
        """All points of the design; chunks are kept in `folder`/sweep, where a run continues.

        Raises: InputError for a folder of another study; ChunkWriteError for a full disk.
        """
        task = self.task
        progress = as_stage(f"Sweeping over {len(task.bounds)} quantities")
        bounds: Any = task.bounds
        with self.folder_in_words(folder):
            return run_sweep(
                study_problem.build_problem(self.study, task.metrics), bounds, design=task.design, levels=task.levels,
                n=task.n, key=jax.random.key(task.seed), at=task.at, batch=task.batch, lanes=task.lanes,
                progress=progress, **self.kept_as(folder),
            )  # fmt: skip

    def write(self, folder: Path, result: SweepResult) -> list[Path]:
        """Write sweep.json (ranges and the response surface, about the middle of the ranges, by m and rad) and
        sweep.csv (one row per point: status, errors, metrics and the surface's values, with their units in the names of
        the columns)."""
        content = {
            "points": len(result.status),
            "good": result.good,
            "errors": dict(zip(result.names, result.bounds, strict=True)),
            "surface": None if result.surface is None else _surface_content(result, result.surface),
            "surface_note": result.surface_note or None,
            "units": metric_units(result.metrics, result.metric_units),
        }
        return self.write_both(folder, content, result.rows())

    def simulations(self) -> list[str]:
        count = int(self.work())
        return [f"{count} simulations in chunks of {min(self.task.batch, count)}"]

    def work(self) -> float:
        task = self.task
        return task.levels ** len(task.bounds) if task.design == "grid" else task.n

    def setting_text(self, name: str, value: Any) -> str:
        """Bounds too in deg and mm."""
        if name != "bounds":
            return super().setting_text(name, value)
        unit = partial(deviation_unit, self.study.mechanism)
        texts = []
        for error, pair in value.items():
            low, high = (format_error("", end, unit(error)).removeprefix(" = ") for end in pair)
            texts.append(f"{error} {low} to {high}")
        return ", ".join(texts)

    def draw(self, result: SweepResult) -> dict[str, Figure]:
        figures = {"responses": responses_figure(self.study, result)}
        if len(result.names) > 1 and (result.surface is not None or _is_map(result)):
            figures["contours"] = contours_figure(self.study, result)
        return figures


def _surface_content(result: SweepResult, surface: ResponseSurface) -> dict[str, Any]:
    model = surface.model
    return {
        "middle": dict(zip(result.names, map(float, model.point), strict=True)),
        "samples": surface.samples,
        "metrics": {
            metric: {
                "value": float(model.value[j]),
                "gradient": dict(zip(result.names, map(float, model.gradient[j]), strict=True)),
                "hessian": np.asarray(model.hessian)[j],
                "residual": surface.residual[j],
                "cross_validated_error": surface.cross_validated[j],
                "explained": surface.explained[j],
            }
            for j, metric in enumerate(result.metrics)
        },
    }


def _most_felt(result: SweepResult, metrics: list[int]) -> list[int]:
    """Errors that change these metrics most, in their order: by the response surface, else the first ones."""
    k = len(result.names)
    if result.surface is None:
        return list(range(min(k, MOST_EACH)))
    effects = result.surface.effects()[metrics]
    shares = effects / np.maximum(effects.max(axis=1, keepdims=True), 1e-300)
    return sorted(np.argsort(-shares.max(axis=0), kind="stable")[:MOST_EACH].tolist())


def responses_figure(study: Study, result: SweepResult) -> Figure:
    """Every metric over every error (four of each): all points, and the response surface with the other errors in the
    middle of their ranges."""
    metrics = list(range(min(len(result.metrics), MOST_EACH)))
    errors = _most_felt(result, metrics)
    figure = new_figure(2.4 * len(errors) + 1.6, 2.0 * len(metrics) + 1.6)
    panels = figure.subplots(len(metrics), len(errors), squeeze=False)
    for row, j in enumerate(metrics):
        for column, i in enumerate(errors):
            axes = panels[row, column]
            specified, factor = as_specified(result.error_units[i])
            axes.plot(
                factor * result.errors[:, i], result.values[:, j], MARKERS[0], ms=3.0, color=CASE_COLOURS[2],
                markerfacecolor="none", label="points",
            )  # fmt: skip
            if result.surface is not None:
                line = _along(result, {i: np.linspace(*result.bounds[i], FINE)})
                axes.plot(
                    factor * line[:, i], result.surface(line)[:, j], "-", color=CASE_COLOURS[1], linewidth=1.4,
                    label="response surface",
                )  # fmt: skip
            axes.locator_params(nbins=4)
            if row == len(metrics) - 1:
                axes.set_xlabel(f"{result.names[i]}, {specified}")
            if column == 0:
                axes.set_ylabel(f"{result.metrics[j]},\n{result.metric_units[j] or '1'}")
    panels[0, 0].legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=2, frameon=False)
    left_out = len(result.names) + len(result.metrics) - len(errors) - len(metrics)
    heading = (
        f"Responses over one quantity each: {len(result.status)} points, {len(result.status) - result.good} failed"
    )
    heading += f" ({left_out} more quantities and metrics are in the CSV)" if left_out else ""
    add_titles(figure, heading, study)
    return figure


def _along(result: SweepResult, moved: dict[int, np.ndarray]) -> Float[np.ndarray, "n k"]:
    """Points (n, k) in the middle of the ranges, with some errors at given values (n,)."""
    count = len(next(iter(moved.values())))
    points = np.tile(np.mean(result.bounds, axis=1), (count, 1))
    for i, values in moved.items():
        points[:, i] = values
    return points


def _is_map(result: SweepResult) -> bool:
    """Whether the points themselves are a map of two errors."""
    return result.design == "grid" and len(result.names) == 2


def contours_figure(study: Study, result: SweepResult) -> Figure:
    """Every metric over the two errors that change it most: of the grid's own values where it has two errors, else of
    the response surface with the other errors in the middle of their ranges."""
    shown = min(len(result.metrics), MOST_PANELS)
    figure = new_figure(9.0, 3.2 * -(-shown // 2) + 1.2)
    panels, _ = panel_grid(figure, shown)
    for j, axes in enumerate(panels):
        _draw_contours(figure, axes, result, j)
    own = "values at the points" if _is_map(result) else "response surface, the others in the middle"
    add_titles(figure, f"Contours over the two quantities that matter most ({own})", study)
    return figure


def _draw_contours(figure: Figure, axes: Axes, result: SweepResult, j: int) -> None:
    first, second = 0, 1
    if result.surface is not None:
        first, second = sorted(np.argsort(-result.surface.effects()[j], kind="stable")[:2].tolist())
    units = [as_specified(result.error_units[i]) for i in (first, second)]
    if _is_map(result):
        shape = (result.levels, result.levels)
        x, y = (result.errors[:, i].reshape(shape) for i in (first, second))
        heights = result.values[:, j].reshape(shape)
    else:
        x, y = np.meshgrid(*(np.linspace(*result.bounds[i], FINE) for i in (first, second)), indexing="ij")
        assert result.surface is not None, "drawn only with one"
        heights = result.surface(_along(result, {first: x.ravel(), second: y.ravel()}))[:, j].reshape(x.shape)
    heights = np.ma.masked_invalid(heights)
    if heights.count() and heights.max() > heights.min():
        image = axes.contourf(units[0][1] * x, units[1][1] * y, heights, levels=12, cmap="YlOrRd")
        figure.colorbar(image, ax=axes, label=result.metric_units[j] or "1")
    axes.plot(units[0][1] * result.errors[:, first], units[1][1] * result.errors[:, second], ".", ms=2.0, color="black")
    axes.set_title(result.labels[j], loc="left")
    axes.set_xlabel(f"{result.names[first]}, {units[0][0]}")
    axes.set_ylabel(f"{result.names[second]}, {units[1][0]}")
    axes.grid(visible=False)
