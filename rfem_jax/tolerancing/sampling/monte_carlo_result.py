"""Result of a Monte Carlo study: samples, statistics, yields, indices; prints itself.

Place in the pipeline: output of the Monte Carlo study, input of tables, plots and files.

Symbols: N runs, d errors, m metrics, n random samples (the first n of the N runs; the others, if any, belong to the
design for Sobol' indices and enter no other statistic).
"""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, Int

from rfem_jax.labelled_data import Parts, Table
from rfem_jax.mechanics.elements.linear_validity import REMARKABLE_LINEAR_ERROR
from rfem_jax.tolerancing.labelled_results import LabelledMonteCarlo
from rfem_jax.tolerancing.layout import show_number
from rfem_jax.tolerancing.sampling.path_band import PathBand
from rfem_jax.tolerancing.sampling.statistics import ControlledMean, Estimate, SobolIndices


@dataclass(frozen=True)
class MetricStatistics:
    """Statistics of one metric over the good samples, in the metric's unit."""

    mean: Estimate
    std: Estimate
    quantiles: dict[float, Estimate]
    smallest: float
    largest: float


@dataclass(frozen=True)
class Yield:
    """Fraction within limits: of the good samples, and of all (a failed sample does not pass)."""

    of_good: Estimate
    of_all: Estimate


@dataclass(frozen=True, eq=False)
class MonteCarloResult(LabelledMonteCarlo):
    """Result of a Monte Carlo study.

    names, error_units (d) and metrics, metric_units, labels (m): of the errors that vary and of the metrics;
    errors [rad or m], values (NaN where the sample failed), status (0 good): of all N runs;
    samples: n, the first rows, which all statistics use; failures {cause: count} of them; linear_errors (N,): estimated
    errors of linear elements, None without any;
    statistics {metric: MetricStatistics};
    limits {metric: (low, high)}, yields {metric: Yield}, joint_yield (all limits at once; None without limits);
    sobol_indices {metric: SobolIndices} or None;
    controlled_means {metric: ControlledMean} or None, control_note: why one is missing;
    confidence of all intervals; sampling: kind of the random points;
    chunks_computed: by this process in this call; seconds: its time;
    path_bands {point: PathBand}: where the samples have points, if it was asked for.
    """

    names: tuple[str, ...]
    error_units: tuple[str, ...]
    metrics: tuple[str, ...]
    metric_units: tuple[str, ...]
    labels: tuple[str, ...]
    errors: Float[np.ndarray, "N d"]
    values: Float[np.ndarray, "N m"]
    status: Int[np.ndarray, " N"]
    samples: int
    failures: dict[str, int]
    statistics: dict[str, MetricStatistics]
    limits: dict[str, tuple[float, float]]
    yields: dict[str, Yield]
    joint_yield: Yield | None
    sobol_indices: dict[str, SobolIndices] | None
    controlled_means: dict[str, ControlledMean] | None
    control_note: str | None
    confidence: float
    sampling: str
    chunks_computed: int
    seconds: float
    linear_errors: Float[np.ndarray, " N"] | None = None
    path_bands: dict[str, PathBand] = field(default_factory=dict)

    @property
    def good(self) -> int:
        """Number of random samples that did not fail."""
        return int(np.sum(self.status[: self.samples] == 0))

    @property
    def inaccurate(self) -> int:
        """Number of good random samples in which linear elements err by more than 2 %."""
        return int(np.sum(self._linear_errors_of_good() > REMARKABLE_LINEAR_ERROR))

    @property
    def remark(self) -> str:
        """What such samples mean, "" where there are none."""
        if not self.inaccurate:
            return ""
        return (
            f"In {self.inaccurate} of {self.good} good samples linear elements are off by more than "
            f"{100 * REMARKABLE_LINEAR_ERROR:g} % in the deflections and moments of a link, by up to about "
            f'{100 * np.max(self._linear_errors_of_good()):.2g} %; take elements = "geometrically_exact".'
        )

    def _linear_errors_of_good(self) -> Float[np.ndarray, " n"]:
        if self.linear_errors is None:
            return np.zeros(0)
        return self.linear_errors[: self.samples][self.status[: self.samples] == 0]

    def parts(self) -> Parts:
        """Statistics with their intervals, yields, and what else was asked for."""
        failed = self.samples - self.good
        causes = ", ".join(f"{count} {cause}" for cause, count in self.failures.items())
        kind = "from independent nets" if self.sampling == "sobol" else "of independent samples"
        head = f"Monte Carlo: {self.samples} samples ({self.sampling}), {failed} failed"
        head += f" ({causes})" if causes else ""
        head += f"; intervals of {100 * self.confidence:g} % confidence, {kind}"
        parts: list[str | Table] = [head, self._statistics_table()]
        if self.joint_yield is not None:
            parts += ["", self._yield_table(self.joint_yield)]
        if self.sobol_indices is not None:
            parts += ["", self._index_table(self.sobol_indices)]
        if self.controlled_means:
            parts += ["", self._control_table(self.controlled_means)]
        for band in self.path_bands.values():
            parts += ["", *band.parts()]
        return [*parts, *(note for note in (self.control_note, self.remark) if note)]

    def _statistics_table(self) -> Table:
        fractions = list(next(iter(self.statistics.values())).quantiles)
        header = ["metric", "mean", "std", *(f"{100 * q:g} %" for q in fractions)]
        rows = [
            [f"{name} [{unit or 1}]", str(s.mean), str(s.std), *(str(s.quantiles[q]) for q in fractions)]
            for (name, s), unit in zip(self.statistics.items(), self.metric_units, strict=True)
        ]
        return Table(header, rows)

    def _yield_table(self, together: Yield) -> Table:
        rows = [
            [name, *map(show_number, self.limits[name]), str(y.of_good), str(y.of_all)]
            for name, y in self.yields.items()
        ]
        rows.append(["all limits", "", "", str(together.of_good), str(together.of_all)])
        return Table(["limit", "low", "high", "yield of good", "yield of all"], rows)

    def _index_table(self, found: dict[str, SobolIndices]) -> Table:
        rows = [
            [name, factor, str(indices.first_order[factor]), str(indices.total[factor])]
            for name, indices in found.items()
            for factor in indices.total
        ]
        return Table(["metric", "factor", "first-order index", "total index"], rows)

    def _control_table(self, found: dict[str, ControlledMean]) -> Table:
        rows = [
            [name, str(c.mean), show_number(c.variance_reduction), show_number(c.coefficient)]
            for name, c in found.items()
        ]
        return Table(["metric", "controlled mean", "variance ratio", "coefficient"], rows)
