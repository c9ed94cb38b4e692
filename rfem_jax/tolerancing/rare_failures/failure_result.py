"""Result of a reliability study: probabilities that limits are broken; prints itself.

Place in the pipeline: output of the reliability study, input of tables, pictures and files.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from rfem_jax.labelled_data import DataFrame, column_name, frame
from rfem_jax.text_layout import align_columns, wrap_lines
from rfem_jax.tolerancing.layout import show_error, show_number
from rfem_jax.tolerancing.sampling.statistics import Estimate


@dataclass(frozen=True, eq=False)
class LimitFailure:
    """How probable it is that one end of a limit is broken.

    metric, unit, side ("upper" or "lower"), limit and nominal (at the medians of all errors) [unit];
    status: "ok"; "not_reached" where neither searches nor samples found errors with which the limit fails; "uncertain"
    where the probability cannot be trusted, for the `reason` in words;
    beta: reliability index, the distance of the nearest design point in standard normal coordinates, negative where the
    nominal mechanism fails (infinite for a limit that is not reached, NaN where no search found a point);
    design_point: "converged", "not_converged" (it lies on the limit, and a nearer one may be beside it) or "none";
    first_order: probability by FORM, N(-beta_j) of all design points together (their number: points);
    probability: by the method "importance_sampling"; of an uncertain limit by "subset_simulation", with an interval
    that spans both; failed simulations count as broken limits;
    effective_samples: how many failing samples of equal weight tell as much, largest_weight: part of the probability
    that one sample is, of the importance sampling; subset_simulation: the probability by that, an independent check;
    errors {name: rad or m}: the most probable ones that break the limit, the nearest design point;
    shares {factor: part of beta^2}: direction cosines squared, summed over the errors of a factor.
    """

    metric: str
    unit: str
    side: str
    limit: float
    nominal: float
    status: str
    reason: str
    beta: float
    design_point: str
    first_order: float
    points: Float[np.ndarray, "p k"]
    probability: Estimate
    method: str
    effective_samples: float
    largest_weight: float
    subset_simulation: Estimate
    errors: dict[str, float]
    shares: dict[str, float]

    def remarks(self) -> list[str]:
        """What a reader has to know beside the numbers, a phrase each."""
        found = []
        if self.status == "not_reached":
            found.append("no errors were found that break the limit")
        if self.status == "uncertain":
            found.append(f"uncertain, because {self.reason}: take the interval as a hint, or more samples")
        if self.status != "not_reached" and self.design_point == "none":
            found.append("no most probable errors were found, as no search converged")
        if self.design_point == "not_converged":
            found.append(
                "the search of the most probable errors did not converge; take more rounds for beta and shares"
            )
        return found


@dataclass(frozen=True, eq=False)
class ReliabilityResult:
    """Result of a reliability study.

    names, error_units (k) of the errors; limits, one `LimitFailure` for every finite end; any_limit: probability that
    at least one is broken; samples of the importance sampling, and how many of them failed as simulations;
    confidence of all intervals; searches per limit.
    """

    names: tuple[str, ...]
    error_units: tuple[str, ...]
    limits: tuple[LimitFailure, ...]
    any_limit: Estimate
    samples: int
    failed: int
    confidence: float
    searches: int
    simulations: int

    @property
    def status(self) -> str:
        """ "ok" if every limit has an answer (also that it is not reached), "uncertain" where one cannot be trusted."""
        if not all(np.isfinite(one.nominal) for one in self.limits):
            return "failed"
        return "uncertain" if any(one.status == "uncertain" for one in self.limits) else "ok"

    def rows(self) -> list[dict[str, Any]]:
        """A row per limit; `unit` is that of `limit` and `nominal`."""
        columns = {n: column_name(n, unit) for n, unit in zip(self.names, self.error_units, strict=True)}
        out = []
        for one in self.limits:
            row: dict[str, Any] = {"metric": one.metric, "side": one.side, "unit": one.unit or "1"}
            row |= {"limit": one.limit, "nominal": one.nominal, "status": one.status, "beta": one.beta}
            row |= {"first_order_probability": one.first_order, "probability": one.probability.value}
            row |= {"probability_low": one.probability.low, "probability_high": one.probability.high}
            row |= {"method": one.method, "effective_samples": one.effective_samples}
            row |= {"largest_weight": one.largest_weight, "subset_simulation": one.subset_simulation.value}
            row |= {"design_point": one.design_point, "reason": one.reason}
            out.append(row | {columns[name]: one.errors.get(name, float("nan")) for name in self.names})
        return out

    def to_pandas(self) -> DataFrame:
        """These rows as a `pandas.DataFrame`. Raises: ModuleNotFoundError without the extra `xarray`."""
        return frame(self.rows(), ["metric", "side"])

    def __str__(self) -> str:
        head = f"Reliability: {self.samples} samples where limits fail, {self.failed} of them failed simulations; "
        head += f"intervals of {100 * self.confidence:g} % confidence"
        table = [
            [
                f"{one.metric} {'<=' if one.side == 'upper' else '>='} {show_number(one.limit)} {one.unit}".rstrip(),
                show_number(one.beta, 4),
                show_number(one.first_order, 3),
                _short(one.probability) + (" uncertain" if one.status == "uncertain" else ""),
                show_number(one.subset_simulation.value, 2),
            ]
            for one in self.limits
        ]
        table.append(["any limit", "", "", _short(self.any_limit), ""])
        header = ["limit", "beta", "FORM", "probability that it is broken", "check"]
        lines = [wrap_lines(head), align_columns(header, table)]
        unit = dict(zip(self.names, self.error_units, strict=True))
        for one in self.limits:
            texts = one.remarks()
            if one.errors:
                worst = ", ".join(f"{name} {show_error(e, unit[name], 4)}" for name, e in one.errors.items())
                parts = ", ".join(f"{name} {100 * part:.3g} %" for name, part in one.shares.items())
                texts = [f"breaks most probably at {worst}; shares {parts}", *texts]
            lines += [wrap_lines(f"{one.metric} ({one.side}): {text}", indent=4) for text in texts]
        return "\n".join([*lines, wrap_lines(f"Yield of all limits: {1.0 - self.any_limit.value:.9g}")])


def _short(estimate: Estimate) -> str:
    return f"{estimate.value:.3g} [{estimate.low:.3g}, {estimate.high:.3g}]"
