"""What `allocate` and `optimise` return.

Place in the pipeline: allocation, optimisation -> **result** -> reports.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any, ClassVar

import numpy as np

from rfem_jax.labelled_data import Parts, Table
from rfem_jax.tolerancing.labelled_designs import LabelledAllocation, LabelledOptimum, LabelledSolution
from rfem_jax.tolerancing.layout import show_error, show_number


@dataclass(frozen=True, eq=False)
class LimitCheck:
    """One limit and its metric at the answer, all in the metric's unit.

    side "upper" or "lower"; nominal: at the perfect mechanism of the answer, at the centre of the tolerances;
    quadratic: by the quadratic model alone (NaN without one); predicted: by the criterion that found the answer (NaN
    for a yield that counts all limits together); verified: by the fresh run, with its confidence interval (a worst case
    has none: both ends are the value); shadow_price: change of the cost or objective if the limit is relaxed by one
    unit (negative or zero for an upper limit, zero where it is not active).
    """

    metric: str
    unit: str
    side: str
    limit: float
    nominal: float
    quadratic: float
    predicted: float
    verified: float
    verified_interval: tuple[float, float]
    shadow_price: float

    @property
    def predicted_margin(self) -> float:
        """Distance from the predicted value to the limit, positive where it holds."""
        return self._margin(self.predicted)

    @property
    def verified_margin(self) -> float:
        """Distance from the verified value to the limit, positive where it holds."""
        return self._margin(self.verified)

    @property
    def margin(self) -> float:
        """The verified margin."""
        return self.verified_margin

    def _margin(self, value: float) -> float:
        return self.limit - value if self.side == "upper" else value - self.limit


@dataclass(frozen=True, eq=False)
class Solution(LabelledSolution):
    """What the answers of `allocate` and `optimise` have in common.

    criterion: when limits hold; status: "ok" (found, and a fresh run agrees), "not_verified" (found, but a fresh run
    violates a limit beyond its confidence interval), "not_converged" or "infeasible"; message: one sentence, for an
    infeasible request the limit that is in the way and how near it comes; tolerances {error: half-width [rad, m or the
    unit of a parameter], zone: diameter [m]}, of an infeasible request those nearest to the limits; units of all of
    them; at_bounds {name: "smallest" | "largest"}; limits: LimitCheck of each; verified_yield with its interval:
    fraction within all limits (NaN but for samples); verified_by: what the fresh run was; history of rounds or
    solutions: (cost or objective, largest normalised limit); failed samples in all of them and in the fresh run.
    """

    criterion: str
    status: str
    message: str
    tolerances: dict[str, float]
    units: dict[str, str]
    at_bounds: dict[str, str]
    limits: tuple[LimitCheck, ...]
    verified_yield: float
    yield_interval: tuple[float, float]
    verified_by: str
    history: tuple[tuple[float, float], ...]
    failed: int

    limit_numbers: ClassVar[tuple[str, ...]]

    def _head(self) -> str:
        return f"status {self.status}"

    def entries(self) -> dict[str, Any]:
        """The answer as files have it."""
        names = ("metric", "unit", "side", *self.limit_numbers, "verified_interval")
        limits = [{name: getattr(check, name) for name in names} for check in self.limits]
        return {one.name: getattr(self, one.name) for one in fields(self)} | {"limits": limits}

    def parts(self) -> Parts:
        """The answer in words: what was found, the limits, the yield, and what it took."""
        columns = self.limit_numbers[: self.limit_numbers.index("verified") + 1]
        header = ["limit", "value", *columns[1:], "interval", "margin", "price"]
        rows = []
        for check in self.limits:
            ends = (show_number(end, scale=check.limit) for end in check.verified_interval)
            numbers = (show_number(getattr(check, name), scale=check.limit) for name in columns)
            last = (show_number(check.margin), show_number(check.shadow_price))
            rows.append([f"{check.metric} [{check.unit or 1}]", *numbers, " to ".join(ends), *last])
        low, high = self.yield_interval
        within = f"verified yield {self.verified_yield:.5f} ({low:.5f} to {high:.5f})"
        sure = [within] if np.isfinite(self.verified_yield) else []
        message = [self.message] if self.message else []
        tables = [one for one in (*self._found(), Table(header, rows)) if one.rows]
        return [self._head(), *message, *tables, *sure, *self._effort()]

    def _found(self) -> Sequence[Table]:
        """What was found, a table a kind."""
        rows = [[name, self._show(name, t), self._width_bound(name)] for name, t in self.tolerances.items()]
        return [Table(["error", "tolerance", "bound"], rows)]

    def _effort(self) -> Sequence[str]:
        """How the answer was verified, and what it took."""
        return [f"verified by {self.verified_by}; {self.failed} failed samples"]

    def _show(self, name: str, value: float) -> str:
        unit = self.units[name]
        return show_error(value, unit) if unit in ("rad", "m") else f"{show_number(value)} {unit}".strip()


@dataclass(frozen=True, eq=False)
class Allocation(LabelledAllocation, Solution):
    """The cheapest tolerances.

    Beside what every `Solution` has: cost; level: the fraction of samples that the statistical criteria refer to (NaN
    for worst case); predicted_yield: fraction within all limits by the corrected model (of "yield", else NaN);
    hessian_error: the estimated relative error of the quadratic model's Hessian by differences (NaN where it is exact).
    """

    cost: float
    level: float
    predicted_yield: float
    hessian_error: float

    limit_numbers: ClassVar[tuple[str, ...]] = (
        *("limit", "nominal", "quadratic", "predicted", "verified"),
        *("predicted_margin", "verified_margin", "shadow_price"),
    )

    def _head(self) -> str:
        return f"Allocation ({self.criterion}): {super()._head()}, cost {show_number(self.cost, 7)}"

    def _effort(self) -> Sequence[str]:
        accuracy = f"Hessian by differences of gradients, error {self.hessian_error:.0e}"
        return [*super()._effort(), *([accuracy] if np.isfinite(self.hessian_error) else [])]


@dataclass(frozen=True, eq=False)
class DesignOptimum(LabelledOptimum, Solution):
    """The best dimensions and tolerances.

    Beside what every `Solution` has: designs {name: value} and `initial` values; objective, its terms {metric or
    "cost": value}, their units and weights; kkt_residual, of the objective divided by its value at the start; number of
    simulations, and of starts tried. Tolerances are of all errors that scatter, found or given.
    """

    designs: dict[str, float]
    initial: dict[str, float]
    objective: float
    terms: dict[str, float]
    term_units: dict[str, str]
    weights: dict[str, float]
    kkt_residual: float
    simulations: int
    starts: int

    limit_numbers: ClassVar[tuple[str, ...]] = (
        *("limit", "nominal", "predicted", "verified"),
        *("margin", "shadow_price"),
    )

    def _head(self) -> str:
        terms = ", ".join(
            f"{name} {show_number(value)} {self.term_units[name]}".rstrip() for name, value in self.terms.items()
        )
        head = f"Optimum ({self.criterion.replace('_', ' ')}): {super()._head()}"
        return f"{head}, objective {show_number(self.objective, 7)} ({terms})"

    def _found(self) -> Sequence[Table]:
        rows = [
            [name, self._show(name, value), self._show(name, self.initial[name]), self.at_bounds.get(name, "")]
            for name, value in self.designs.items()
        ]
        return [Table(["dimension", "value", "before", "bound"], rows), *super()._found()]

    def _effort(self) -> Sequence[str]:
        effort = f"{self.simulations} simulations, {self.failed} failed; KKT residual {self.kkt_residual:.0e}"
        return [f"verified by {self.verified_by}; {effort}, best of {self.starts} starts"]
