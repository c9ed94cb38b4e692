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
    status "ok", or "not_reached" where no search found a point at which the limit fails;
    beta: reliability index, the distance of the nearest design point in standard normal coordinates, negative where the
    nominal mechanism fails (infinite without a design point); first_order: probability by FORM, N(-beta_j) of all
    design points together (their number: points);
    probability: by importance sampling; failed simulations count as broken limits;
    errors {name: rad or m}: the most probable ones that break the limit, the nearest design point;
    shares {factor: part of beta^2}: direction cosines squared, summed over the errors of a factor.
    """

    metric: str
    unit: str
    side: str
    limit: float
    nominal: float
    status: str
    beta: float
    first_order: float
    points: Float[np.ndarray, "p k"]
    probability: Estimate
    errors: dict[str, float]
    shares: dict[str, float]


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

    @property
    def status(self) -> str:
        """ "ok" if every limit has an answer (also that it is not reached)."""
        return "ok" if all(np.isfinite(one.nominal) for one in self.limits) else "failed"

    def rows(self) -> list[dict[str, Any]]:
        """A row per limit; `unit` is that of `limit` and `nominal`."""
        columns = {n: column_name(n, unit) for n, unit in zip(self.names, self.error_units, strict=True)}
        out = []
        for one in self.limits:
            row: dict[str, Any] = {"metric": one.metric, "side": one.side, "unit": one.unit or "1"}
            row |= {"limit": one.limit, "nominal": one.nominal, "status": one.status, "beta": one.beta}
            row |= {"first_order_probability": one.first_order, "probability": one.probability.value}
            row |= {"probability_low": one.probability.low, "probability_high": one.probability.high}
            out.append(row | {columns[name]: one.errors.get(name, float("nan")) for name in self.names})
        return out

    def to_pandas(self) -> DataFrame:
        """These rows as a `pandas.DataFrame`. Raises: ModuleNotFoundError without the extra `xarray`."""
        return frame(self.rows(), ["metric", "side"])

    def __str__(self) -> str:
        head = f"Reliability: {self.samples} samples about the design points, {self.failed} failed simulations; "
        head += f"intervals of {100 * self.confidence:g} % confidence"
        table = [
            [
                f"{one.metric} {'<=' if one.side == 'upper' else '>='} {show_number(one.limit)} {one.unit}".rstrip(),
                show_number(one.beta, 4),
                show_number(one.first_order, 3),
                _short(one.probability),
            ]
            for one in self.limits
        ]
        table.append(["any limit", "", "", _short(self.any_limit)])
        header = ["limit", "beta", "FORM", "probability that it is broken"]
        lines = [wrap_lines(head), align_columns(header, table)]
        unit = dict(zip(self.names, self.error_units, strict=True))
        for one in self.limits:
            if one.status != "ok":
                text = f"{one.metric} ({one.side}): no errors were found that break the limit"
            else:
                worst = ", ".join(f"{name} {show_error(e, unit[name], 4)}" for name, e in one.errors.items())
                parts = ", ".join(f"{name} {100 * part:.3g} %" for name, part in one.shares.items())
                text = f"{one.metric} ({one.side}) breaks most probably at {worst}; shares {parts}"
            lines.append(wrap_lines(text, indent=4))
        return "\n".join([*lines, wrap_lines(f"Yield of all limits: {1.0 - self.any_limit.value:.9g}")])


def _short(estimate: Estimate) -> str:
    return f"{estimate.value:.3g} [{estimate.low:.3g}, {estimate.high:.3g}]"
