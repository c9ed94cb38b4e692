"""Monte Carlo studies: scatter of all metrics over the tolerances, their statistics, histograms and scatter matrix.

Place in the pipeline: `rfem_jax.description.tasks.monte_carlo` -> **monte_carlo** -> terminal, files and pictures.
Failed samples are counted, and not drawn; a study succeeds as long as any sample does. Pictures show errors in deg and
mm, metrics in their own units.
"""

from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Float

from rfem_jax.compilation.stages import on_stage
from rfem_jax.description.study_file.study import Study
from rfem_jax.description.tasks.monte_carlo import MonteCarloTask
from rfem_jax.description.tolerances.error_catalogue import as_specified
from rfem_jax.report.contents.annotations import Figure
from rfem_jax.report.contents.output import write_csv
from rfem_jax.report.drawings.style import (
    BAR_COLOURS,
    CASE_COLOURS,
    LINE_STYLES,
    add_titles,
    new_figure,
    panel_grid,
)
from rfem_jax.report.tasks import study_problem
from rfem_jax.report.tasks.path_figure import band_figure
from rfem_jax.report.tasks.sampled_report import SampledReport
from rfem_jax.report.tasks.sobol_bars import sobol_figure
from rfem_jax.report.tasks.task_files import metric_units
from rfem_jax.report.tasks.task_report import GRADIENT, as_stage
from rfem_jax.text_layout import size_text
from rfem_jax.tolerancing.problems.named_tolerances import Tolerances
from rfem_jax.tolerancing.problems.sharing import process_count, process_index
from rfem_jax.tolerancing.problems.simulated_problem import Problem
from rfem_jax.tolerancing.sampling.monte_carlo_result import MonteCarloResult
from rfem_jax.tolerancing.sampling.monte_carlo_study import first_samples, monte_carlo_samples
from rfem_jax.tolerancing.sampling.monte_carlo_study import monte_carlo as sample_problem
from rfem_jax.tolerancing.sampling.path_band import PARTS, PathBand
from rfem_jax.tolerancing.sampling.sampled_paths import path_bands
from rfem_jax.tolerancing.sampling.sampled_studies import SampleStudy

MOST_PANELS = 12
MOST_EACH = 4  # errors and metrics of a scatter matrix


class MonteCarloReport(SampledReport[MonteCarloTask, MonteCarloResult]):
    """Scatter of metrics over the tolerances."""

    words = "Monte Carlo study", "samples"

    def samples(self) -> SampleStudy:
        task = self.task
        tolerances, key = Tolerances.of(self.study), jax.random.key(task.seed)
        return monte_carlo_samples(tolerances, key, task.batch, task.lanes, task.sampling, task.sobol_indices)

    def trials(self) -> dict[str, Float[Array, " n"]]:
        """The first of the samples: the perfect mechanism, which none of them is, may need a far shorter step."""
        return first_samples(Tolerances.of(self.study), jax.random.key(self.task.seed), sampling=self.task.sampling)

    def run(self, folder: Path) -> MonteCarloResult:
        """The scatter of all metrics; chunks are kept in `folder`/monte_carlo, where a run continues.

        Raises: InputError for a folder of another study (in the words of the command line, where the
            folder is in DIR of `--out DIR`); ChunkWriteError for a full disk.
        """
        task = self.task
        progress = as_stage(
            f"Sampling {task.n} mechanisms on {jax.local_device_count()} devices"
            f" of {process_count()} process{'es' if process_count() > 1 else ''}"
        )
        with self.folder_in_words(folder):
            problem = study_problem.build_problem(self.study, task.metrics, trials=self.trials())
            result = sample_problem(
                problem, Tolerances.of(self.study), task.n, jax.random.key(task.seed), batch=task.batch,
                lanes=task.lanes,
                sampling=task.sampling, limits=task.limits, quantiles=task.quantiles, confidence=task.confidence,
                sobol_indices=task.sobol_indices, control_variate=task.control_variate or None, progress=progress,
                **self.kept_as(folder),
            )  # fmt: skip
        # A mechanism at rest has no path.
        if not task.bands or process_index() != 0 or not isinstance(problem, Problem):
            return result
        on_stage(f"Paths of {', '.join(task.bands)}")
        return replace(result, path_bands=path_bands(problem, result, task.bands))

    def write(self, folder: Path, result: MonteCarloResult) -> list[Path]:
        """Write monte_carlo.json and monte_carlo.csv (one row per sample: status, errors, metrics, with their units in
        the names of the columns), and monte_carlo_path_POINT.csv of every band."""
        together = result.joint_yield
        content = {
            "samples": result.samples,
            "good": result.good,
            "failures": result.failures,
            "remark": result.remark,
            "confidence": result.confidence,
            "sampling": result.sampling,
            "metrics": {metric: _statistics(result, metric) for metric in result.metrics},
            "joint_yield_of_good": None if together is None else asdict(together.of_good),
            "joint_yield_of_all": None if together is None else asdict(together.of_all),
            "control_note": result.control_note,
            "units": metric_units(result.metrics, result.metric_units),
        }
        if result.path_bands:
            content["path_bands"] = {point: _band_content(band) for point, band in result.path_bands.items()}
        bands = [
            write_csv(folder / f"monte_carlo_path_{point}.csv", band.rows())
            for point, band in result.path_bands.items()
        ]
        return self.write_both(folder, content, result.rows()) + bands

    def simulations(self) -> list[str]:
        specified, count, gradients = self.tolerances, *self._numbers()
        told = [f"{count} simulations in chunks of {min(self.task.batch, count)}"]
        if gradients:
            told.append(f"{gradients} with first derivatives, for the control variate")
        numbers = count * (len(specified.names) + len(self.task.metrics) + 1)
        return [*told, f"samples of about {size_text(8 * numbers)}"]

    def work(self) -> float:
        count, gradients = self._numbers()
        return count + GRADIENT * gradients

    def _numbers(self) -> tuple[int, int]:
        """Simulations, and simulations with first derivatives."""
        specified = self.tolerances
        factors = len(specified.independent) + len(specified.correlated) + len(specified.zones)
        count = self.task.n * (factors + 2) if self.task.sobol_indices else self.task.n
        return count, 1 + 4 * len(specified.names) if self.task.control_variate else 0

    def draw(self, result: MonteCarloResult) -> dict[str, Figure]:
        figures = {
            "histograms": histogram_figure(self.study, result),
            "scatter_matrix": scatter_matrix_figure(self.study, result),
        }
        if result.sobol_indices is not None:
            figures["sobol"] = sobol_figure(self.study, result)
        return figures | {f"path_{point}": band_figure(self.study, one) for point, one in result.path_bands.items()}


def _band_content(band: PathBand) -> dict[str, Any]:
    """Ends of the band and of the envelope [m] by parts, at its times [s]."""
    ends = {"low": band.low, "high": band.high, "smallest": band.smallest, "largest": band.largest}
    content: dict[str, Any] = {"samples": len(band.deviations), "level": band.level, "time": band.times}
    content["perfect"] = band.perfect
    return content | {part: {name: values[:, i] for name, values in ends.items()} for i, part in enumerate(PARTS)}


def _statistics(result: MonteCarloResult, metric: str) -> dict[str, Any]:
    found = result.statistics[metric]
    one = {
        "mean": asdict(found.mean),
        "std": asdict(found.std),
        "quantiles": {f"{q:g}": asdict(e) for q, e in found.quantiles.items()},
        "smallest": found.smallest,
        "largest": found.largest,
    }
    if metric in result.yields:
        one["limits"] = result.limits[metric]
        one["yield_of_good"] = asdict(result.yields[metric].of_good)
        one["yield_of_all"] = asdict(result.yields[metric].of_all)
    if result.sobol_indices is not None:
        indices = result.sobol_indices[metric]
        one["first_order_indices"] = {k: asdict(v) for k, v in indices.first_order.items()}
        one["total_indices"] = {k: asdict(v) for k, v in indices.total.items()}
    controlled = (result.controlled_means or {}).get(metric)
    if controlled is not None:
        one["controlled_mean"] = asdict(controlled.mean)
        one["variance_reduction"] = controlled.variance_reduction
    return one


def good_samples(
    result: MonteCarloResult,
) -> tuple[Float[np.ndarray, "samples errors"], Float[np.ndarray, "samples metrics"]]:
    """Errors (n, d) [rad, m] and values (n, m) of the random samples that did not fail."""
    good = result.status[: result.samples] == 0
    return result.errors[: result.samples][good], result.values[: result.samples][good]


def histogram_figure(study: Study, result: MonteCarloResult) -> Figure:
    """Histogram of every metric with its mean, its quantiles and its limits."""
    shown = min(len(result.metrics), MOST_PANELS)
    figure = new_figure(8.4, 2.1 * -(-shown // 2) + 1.6)
    panels, add_shared_legend = panel_grid(figure, shown)
    _, values = good_samples(result)
    styles = {}
    for index, axes in enumerate(panels):
        metric = result.metrics[index]
        samples = values[:, index]
        if len(samples):
            bins = int(np.clip(2.0 * np.cbrt(len(samples)), 5, 60))
            axes.hist(samples, bins, color=BAR_COLOURS[2], edgecolor="black", linewidth=0.5)
        found = result.statistics[metric]
        marks = [("mean", found.mean.value, CASE_COLOURS[0], "-")]
        marks += [
            (f"{100 * q:g} %", estimate.value, CASE_COLOURS[2], LINE_STYLES[1 + i % 6])
            for i, (q, estimate) in enumerate(found.quantiles.items())
        ]
        ends = result.limits.get(metric, ())
        marks += [("limit", end, CASE_COLOURS[1], "-") for end in ends if np.isfinite(end)]
        for word, place, colour, style in marks:
            if np.isfinite(place):
                wide = 2.2 if word == "limit" else 1.3
                line = axes.axvline(place, color=colour, linestyle=style, linewidth=wide)
                styles.setdefault(word, line)
        title = result.labels[index]
        if metric in result.yields:
            title += f": {100 * result.yields[metric].of_all.value:.3g} % within"
        axes.set_title(title, loc="left")
        axes.locator_params(axis="x", nbins=5)  # room for the digits of a metric that scatters little
        axes.set_xlabel(result.metric_units[index] or "1")
        axes.set_ylabel("samples")
    add_shared_legend(list(styles.values()), list(styles))
    failed = result.samples - result.good
    heading = f"Scatter over the tolerances: {result.samples} samples, {failed} failed"
    add_titles(figure, heading, study)
    return figure


def scatter_matrix_figure(study: Study, result: MonteCarloResult) -> Figure:
    """Every pair of errors and metrics (four of each, the errors that matter most): points below, rank correlations
    above, histograms on the diagonal."""
    names, samples = _columns(result)
    left_out = len(result.names) + len(result.metrics) - len(names)
    heading = "Errors and metrics of all samples; above the diagonal rank correlations"
    if left_out:
        heading += f" ({left_out} more are in the CSV)"
    return scatter_matrix(study, names, samples, heading)


def scatter_matrix(study: Study, names: list[str], samples: Float[np.ndarray, "n p"], heading: str) -> Figure:
    """Every pair of p numbers: points below, rank correlations above, histograms on the diagonal."""
    from matplotlib.transforms import blended_transform_factory

    size = len(names)
    figure = new_figure(1.35 * size + 1.0, 1.35 * size + 1.4)
    grid = figure.add_gridspec(size, size)
    panels = [[figure.add_subplot(grid[row, column]) for column in range(row + 1)] for row in range(size)]
    ranks = np.argsort(np.argsort(samples, axis=0), axis=0).astype(float)
    point = float(np.clip(80.0 / np.sqrt(max(len(samples), 1)), 1.0, 2.5))
    for row in range(size):
        for column in range(row + 1, size):
            # Beside the diagonal's panel of the row, and above that of the column: axes of its own would take as
            # long as a panel.
            place = blended_transform_factory(panels[column][column].transAxes, panels[row][row].transAxes)
            _write_correlation(figure, place, ranks[:, row], ranks[:, column])
        for column, axes in enumerate(panels[row]):
            axes.grid(visible=False)
            if column == row:
                axes.hist(samples[:, row], 12, color=BAR_COLOURS[2], edgecolor="black", lw=0.4)
                axes.set_yticks([])
            else:
                axes.plot(
                    samples[:, column], samples[:, row], ".", ms=point, mew=0.0,
                    color=CASE_COLOURS[2],
                )  # fmt: skip
            axes.tick_params(labelsize=7, labelbottom=row == size - 1)
            axes.tick_params(labelleft=column == 0 and row > 0)
            if row == size - 1:
                axes.set_xlabel(names[column], fontsize=8)
            if column == 0:
                axes.set_ylabel(names[row], fontsize=8)
            axes.locator_params(nbins=3)
    add_titles(figure, heading, study)
    return figure


def _columns(result: MonteCarloResult) -> tuple[list[str], Float[np.ndarray, "samples columns"]]:
    """Labels and samples (n, p) of the errors and metrics that are drawn."""
    errors, values = good_samples(result)
    names, columns = [], []
    metrics = sorted(range(len(result.metrics)), key=lambda i: _order(result, i))[:MOST_EACH]
    for i in _most_felt(errors, values[:, metrics]):
        specified, factor = as_specified(result.error_units[i])
        names.append(f"{result.names[i]}\n{specified}")
        columns.append(factor * errors[:, i])
    for i in metrics:
        names.append(f"{result.metrics[i]}\n{result.metric_units[i] or '1'}")
        columns.append(values[:, i])
    return names, np.stack(columns, axis=1)


def _most_felt(errors: Float[np.ndarray, "samples errors"], values: Float[np.ndarray, "samples metrics"]) -> list[int]:
    """Which errors are drawn, in their order: those that a metric is correlated with most, or with whose squares, as
    loads are even in many errors."""
    if errors.shape[1] <= MOST_EACH or len(errors) < 3:
        return list(range(min(errors.shape[1], MOST_EACH)))
    centred = errors - errors.mean(axis=0)

    def standard(columns: Float[np.ndarray, "samples columns"]) -> Float[np.ndarray, "samples columns"]:
        spread = columns.std(axis=0)
        return (columns - columns.mean(axis=0)) / np.where(spread > 0.0, spread, 1.0)

    influence = [np.abs(standard(of).T @ standard(values)).max(axis=1) for of in (centred, centred**2)]
    return sorted(np.argsort(-np.max(influence, axis=0), kind="stable")[:MOST_EACH].tolist())


def _order(result: MonteCarloResult, i: int) -> tuple[bool, int, int]:
    """Metrics with limits come first, then one of each kind before the second of a kind."""
    kinds = [name.rpartition(".")[2] for name in result.metrics]
    return result.metrics[i] not in result.limits, kinds[:i].count(kinds[i]), i


def _write_correlation(
    figure: Figure, place: Any, first: Float[np.ndarray, " samples"], second: Float[np.ndarray, " samples"]
) -> None:
    """Write a rank correlation in the middle of a place."""
    spread = len(first) > 1 and np.std(first) > 0 and np.std(second) > 0
    correlation = np.corrcoef(first, second)[0, 1] if spread else np.nan
    # Adding zero takes the sign off what rounds to zero.
    text = f"{round(correlation, 2) + 0.0:+.2f}" if np.isfinite(correlation) else "-"
    shade = "black" if abs(correlation) > 0.3 else "#808080"
    figure.text(0.5, 0.5, text, ha="center", va="center", color=shade, transform=place)
