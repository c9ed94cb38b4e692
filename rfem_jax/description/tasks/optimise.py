"""What is asked of an optimisation of dimensions and tolerances: the table [optimise].

Place in the pipeline: task -> **optimise** -> `rfem_jax.report.tasks.optimise`. Dimensions are those of [design] with
bounds, tolerances those of [tolerances]; [optimise.bounds] and [optimise.cost] say which of these are to be found too.

Symbols: bounds in m, rad or the parameter's unit, or strings with a unit; limits in the metric's own unit.
"""

from dataclasses import dataclass, field
from typing import Any

from rfem_jax.description.basics.errors import Checks, InputError, require_choice
from rfem_jax.description.basics.units import non_negative_quantity
from rfem_jax.description.mechanism.mechanism import Mechanism
from rfem_jax.description.metrics.subjects import require_metric, subjects_of
from rfem_jax.description.tasks.costs import ErrorCost, FoundTolerancesTask
from rfem_jax.description.tasks.settings import MOST_AT_ONCE, MOST_SAMPLES, convert_all, metric_names, whole_number
from rfem_jax.description.tasks.task import Task
from rfem_jax.description.tolerances.zones import SpecifiedZone

COST = "cost"
ROBUST = ("nominal", "worst_case", "rss", "yield")


@dataclass(frozen=True)
class OptimiseTask(FoundTolerancesTask):
    """The best dimensions and tolerances that keep limits.

    Args:
        objective: what is to be least: a metric of the perfect mechanism, "cost" of the tolerances to be found, or
            { metric or "cost" = weight }.
        limits: {metric: largest value, or (low, high)} in the metric's unit.
        bounds: {error: (smallest, largest half-width), zone: diameters} of the tolerances to be found; those of
            [tolerances] beside them stay as they are.
        costs: {error: ErrorCost}, one for each of the bounds.
        robust: when limits hold: "nominal" (perfect mechanism), "worst_case", "rss" (mean + `coverage` deviations) or
            "yield" (a fraction `target` of all mechanisms).
        target: fraction of mechanisms that keep all limits, between 0 and 1; of "yield".
        coverage: standard deviations within the limits; of "rss".
        distribution: of the errors: "uniform", "triangular", "normal" or "truncated_normal"; of "rss" and "yield".
        samples: simulations that the statistics come from; of "rss" and "yield".
        verify_samples: independent simulations that verify the answer; of "rss" and "yield".
        starts: points that are compared at first.
        searches: of the best of these.
        steps: largest number of steps of a search.
        front: weights of the second of two terms of the objective, from 0 to 1, for a Pareto front.
        seed: of random starts and samples.
        mode: of differentiation: "auto", "forward" or "reverse".
        batch: simulations at once on each device.
        zones: shapes of the zones among the bounds; a position or coaxiality without one is a disc.
    Raises: InputError for settings that are out of range or do not fit each other.
    """

    objective: dict[str, float]
    limits: dict[str, tuple[float, float]] = field(default_factory=dict)
    bounds: dict[str, tuple[float, float]] = field(default_factory=dict)
    costs: dict[str, ErrorCost] = field(default_factory=dict)
    robust: str = "worst_case"
    target: float = 0.9973
    coverage: float = 3.0
    distribution: str = "normal"
    samples: int = 128
    verify_samples: int = 2048
    starts: int = 8
    searches: int = 1
    steps: int = 60
    front: tuple[float, ...] = ()
    seed: int = 0
    mode: str = "auto"
    batch: int = 64
    zones: tuple[SpecifiedZone, ...] = ()

    def _check_fields(self, checks: Checks) -> None:
        checks.convert("objective", _objective)
        checks.convert("robust", require_choice, ROBUST, "robust")
        self._check_search(checks, needed=False)
        convert_all(checks, ("samples", "verify_samples"), whole_number, 2, MOST_SAMPLES)
        convert_all(checks, ("starts", "searches", "steps", "batch"), whole_number, 1, MOST_AT_ONCE)
        checks.convert("front", _front)
        checks.relation(("objective", "bounds"), self._check_cost)
        checks.relation(("objective", "front"), self._check_front)

    def _check_cost(self) -> None:
        if COST in self.objective and not self.bounds:
            raise InputError(
                'Argument `objective` must be a metric, but has "cost", and no tolerance is to be found; add '
                "[optimise.bounds]."
            )

    def _check_front(self) -> None:
        if self.front and len(self.objective) != 2:
            raise InputError(
                f"Argument `front` must be left out unless the objective has two terms, but it has "
                f"{len(self.objective)}; write objective = {{ mass = 1, cost = 1 }}, for example."
            )

    def resolved(self, mechanism: Mechanism, name: str) -> "Task":
        """As `Task.resolved`; metrics of the objective must be there, too."""
        for metric in self.objective:
            if metric != COST:
                require_metric(metric, subjects_of(mechanism), "mechanism", f" of the task `{name}`")
        return super().resolved(mechanism, name)

    @property
    def metrics(self) -> tuple[str, ...]:
        """The metrics that have limits or are part of the objective."""
        return tuple(dict.fromkeys((*self.limits, *(name for name in self.objective if name != COST))))


def _objective(objective: object) -> dict[str, float]:
    terms = {objective: 1.0} if isinstance(objective, str) else objective
    if not isinstance(terms, dict) or not terms:
        raise InputError(
            f'Argument `objective` must be a metric, "cost" or a table of weights, but was {objective!r}; write '
            '"mass" or { mass = 1.0, cost = 0.1 }.'
        )
    metric_names([name for name in terms if name != COST] or ["end_energy"])
    weights = {
        name: non_negative_quantity(weight, "none", f"`{name}` of `objective`") for name, weight in terms.items()
    }
    if not any(weights.values()):
        raise InputError("Argument `objective` must have a weight above 0, but all weights are 0; give one.")
    return weights


def _front(weights: Any) -> tuple[float, ...]:
    found = (
        [non_negative_quantity(one, "none", "front") for one in weights] if isinstance(weights, (list, tuple)) else [2]
    )
    if any(one > 1.0 for one in found):
        raise InputError(
            f"Argument `front` must be a list of weights from 0 to 1, but was {weights!r}; write [0, 0.5, 1]."
        )
    return tuple(found)
