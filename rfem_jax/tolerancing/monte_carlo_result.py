"""What a Monte Carlo study found: samples, statistics, yields, indices; prints itself.

Place in the pipeline: output of the Monte Carlo study, input of tables, plots and files.

Symbols: N runs, d errors, m metrics, n random samples (the first ones of the N; the others, if any,
belong to the design for Sobol' indices and enter no other statistic).
"""

from dataclasses import dataclass

import numpy as np

from rfem_jax.tolerancing.layout import align_columns, show_number, wrap_lines
from rfem_jax.tolerancing.statistics import ControlledMean, Estimate, SobolIndices

NOT_FINITE = -1  # status of a sample that called itself good but has a value that is not finite


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
class MonteCarloResult:
    """Result of a Monte Carlo study.

    names, error_units (d); metrics, metric_units, labels (m); errors (N, d) [rad or m], values (N,
    m) NaN where the sample failed, status (N,) 0 good; samples n, the first rows, that all
    statistics use; failures {cause: count} of them; statistics {metric: MetricStatistics}; limits
    {metric: (low, high)}, yields {metric: Yield}, joint_yield (all limits at once; None without
    limits); sobol_indices {metric: SobolIndices} or None; controlled_means {metric: ControlledMean}
    or None, control_note why one is missing; chunks_computed by this process in this call; seconds
    it took.
    """

    names: tuple[str, ...]
    error_units: tuple[str, ...]
    metrics: tuple[str, ...]
    metric_units: tuple[str, ...]
    labels: tuple[str, ...]
    errors: np.ndarray
    values: np.ndarray
    status: np.ndarray
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

    @property
    def good(self):
        """Number of random samples that did not fail."""
        return int(np.sum(self.status[: self.samples] == 0))

    def __str__(self):
        failed = self.samples - self.good
        causes = ", ".join(f"{count} {cause}" for cause, count in self.failures.items())
        kind = "from independent nets" if self.sampling == "sobol" else "of independent samples"
        head = f"Monte Carlo: {self.samples} samples ({self.sampling}), {failed} failed"
        head += f" ({causes})" if causes else ""
        head += f"; intervals of {100 * self.confidence:g} % confidence, {kind}"
        lines = [wrap_lines(head), self._statistics_table()]
        if self.joint_yield is not None:
            lines += ["", self._yield_table()]
        if self.sobol_indices is not None:
            lines += ["", self._index_table()]
        if self.controlled_means:
            lines += ["", self._control_table()]
        return "\n".join(lines + ([wrap_lines(self.control_note)] if self.control_note else []))

    def _statistics_table(self):
        fractions = list(next(iter(self.statistics.values())).quantiles)
        header = ["metric", "mean", "std", *(f"{100 * q:g} %" for q in fractions)]
        rows = [
            [f"{name} [{unit or 1}]", str(s.mean), str(s.std),
             *(str(s.quantiles[q]) for q in fractions)]
            for (name, s), unit in zip(self.statistics.items(), self.metric_units, strict=True)
        ]  # fmt: skip
        return align_columns(header, rows)

    def _yield_table(self):
        rows = [
            [name, *map(show_number, self.limits[name]), str(y.of_good), str(y.of_all)]
            for name, y in self.yields.items()
        ]
        together = self.joint_yield
        rows.append(["all limits", "", "", str(together.of_good), str(together.of_all)])
        return align_columns(["limit", "low", "high", "yield of good", "yield of all"], rows)

    def _index_table(self):
        rows = [
            [name, factor, str(indices.first_order[factor]), str(indices.total[factor])]
            for name, indices in self.sobol_indices.items()
            for factor in indices.total
        ]
        return align_columns(["metric", "factor", "first-order index", "total index"], rows)

    def _control_table(self):
        rows = [
            [name, str(c.mean), show_number(c.variance_reduction), show_number(c.coefficient)]
            for name, c in self.controlled_means.items()
        ]
        return align_columns(["metric", "controlled mean", "variance ratio", "coefficient"], rows)
