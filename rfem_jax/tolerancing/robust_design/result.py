"""What an optimisation of a design returns.

Place in the pipeline: optimisation -> **result** -> reports.
"""

from dataclasses import dataclass

import numpy as np

from rfem_jax.text_layout import align_columns, wrap_lines
from rfem_jax.tolerancing.labelled_designs import LabelledDesignOptimum
from rfem_jax.tolerancing.layout import show_error, show_number

STATUSES = {
    "ok": "found, and a fresh run agrees",
    "not_verified": "found, but a fresh run violates a limit",
    "not_converged": "the search ended before the conditions of optimality held",
    "infeasible": "no design within the bounds keeps all limits",
}


@dataclass(frozen=True)
class LimitAtOptimum:
    """One limit at the answer, in the metric's unit.

    side "upper" or "lower"; nominal: at the perfect mechanism of the answer; predicted: by the criterion that was
    optimised (of a yield: NaN, since it is of all limits together); verified: by the fresh run, with its confidence
    interval; margin: from the verified value to the limit, positive where it holds; shadow_price: change of the
    objective if the limit is relaxed by one unit (zero or negative for an upper limit).
    """

    metric: str
    unit: str
    side: str
    limit: float
    nominal: float
    predicted: float
    verified: float
    verified_interval: tuple[float, float]
    margin: float
    shadow_price: float


@dataclass(frozen=True, eq=False)
class DesignOptimum(LabelledDesignOptimum):
    """The best dimensions and tolerances.

    criterion: when limits hold; status of `STATUSES`, message: one sentence (of an infeasible request: which limit is
    in the way, and how near it comes); designs {name: value}, tolerances {error: half-width} of all errors that
    scatter, found or given; units of both and `initial` values of the designs; objective, its terms {metric or "cost":
    value}, their units and weights; limits; at_bounds {design or error: "smallest" | "largest"}; kkt_residual, of the
    objective divided by its value at the start; verified_yield with its interval (NaN but for samples), verified_by;
    simulations and failed ones; starts tried, and history: (objective, largest normalised constraint) of every
    solution.
    """

    criterion: str
    status: str
    message: str
    designs: dict[str, float]
    tolerances: dict[str, float]
    units: dict[str, str]
    initial: dict[str, float]
    objective: float
    terms: dict[str, float]
    term_units: dict[str, str]
    weights: dict[str, float]
    limits: tuple[LimitAtOptimum, ...]
    at_bounds: dict[str, str]
    kkt_residual: float
    verified_yield: float
    yield_interval: tuple[float, float]
    verified_by: str
    simulations: int
    failed: int
    starts: int
    history: tuple[tuple[float, float], ...]

    def __str__(self) -> str:
        terms = ", ".join(
            f"{name} {show_number(value)} {self.term_units[name]}".rstrip() for name, value in self.terms.items()
        )
        head = f"Optimum ({self.criterion.replace('_', ' ')}): status {self.status}, "
        parts = [f"{head}objective {show_number(self.objective, 7)} ({terms})", wrap_lines(self.message)]
        rows = [
            [name, self._show(name, value), self._show(name, self.initial[name]), self.at_bounds.get(name, "")]
            for name, value in self.designs.items()
        ]
        if rows:
            parts.append(align_columns(["dimension", "value", "before", "bound"], rows))
        rows = [
            [name, self._show(name, width), self.at_bounds.get(name, self.at_bounds.get(f"tolerance of {name}", ""))]
            for name, width in self.tolerances.items()
        ]
        if rows:
            parts.append(align_columns(["error", "tolerance", "bound"], rows))
        header = ["limit", "value", "nominal", "predicted", "verified", "interval", "margin", "price"]
        if self.limits:
            parts.append(align_columns(header, [self._limit_row(check) for check in self.limits]))
        if np.isfinite(self.verified_yield):
            low, high = self.yield_interval
            parts.append(f"verified yield {self.verified_yield:.5f} ({low:.5f} to {high:.5f})")
        effort = f"{self.simulations} simulations, {self.failed} failed; KKT residual {self.kkt_residual:.0e}"
        parts.append(wrap_lines(f"verified by {self.verified_by}; {effort}, best of {self.starts} starts"))
        return "\n".join(part for part in parts if part)

    def _show(self, name: str, value: float) -> str:
        unit = self.units[name]
        return show_error(value, unit) if unit in ("rad", "m") else f"{show_number(value)} {unit}".strip()

    @staticmethod
    def _limit_row(check: LimitAtOptimum) -> list[str]:
        ends = (show_number(end, scale=check.limit) for end in check.verified_interval)
        numbers = (check.limit, check.nominal, check.predicted, check.verified)
        return [
            f"{check.metric} [{check.unit or 1}]",
            *(show_number(number, scale=check.limit) for number in numbers),
            " to ".join(ends),
            show_number(check.margin),
            show_number(check.shadow_price),
        ]
