"""What is asked of an allocation: limits, bounds and costs of the tolerances to be found; the table [allocation].

Place in the pipeline: task -> **allocation** -> `rfem_jax.report.tasks.allocation`. The tables [allocation.bounds]
and [allocation.cost] are by error, and a cost may be given once for all of them.

Symbols: bounds and `at` in m and rad (`error_catalogue`), or strings with a unit; limits in the
metric's own unit.
"""

from dataclasses import MISSING, Field, dataclass, field, fields
from typing import Any

from rfem_jax.description.basics.errors import Checks, InputError, require_choice
from rfem_jax.description.basics.units import positive_quantity
from rfem_jax.description.tasks.costs import ErrorCost, FoundTolerancesTask
from rfem_jax.description.tasks.settings import STARTS, convert_all, starts_of, whole_number
from rfem_jax.description.tolerances.zones import SpecifiedZone

# Settings that count for some criteria only.
_CRITERIA_OF = {
    "target": ("yield",),
    "coverage": ("rss",),
    "statistic": ("rss",),
    "distribution": ("rss", "yield"),
    "samples": ("rss", "yield"),
    "verify_samples": ("rss", "yield"),
    "starts": ("worst_case",),
}


@dataclass(frozen=True)
class AllocationTask(FoundTolerancesTask):
    """The cheapest tolerances that keep limits.

    Args:
        limits: {metric: largest value, or (low, high)} in the metric's unit.
        bounds: {error: (smallest, largest half-width)} in rad and m, {zone: (smallest, largest diameter)} in m.
        costs: {error: ErrorCost}, one for each of the bounds.
        criterion: "worst_case", "rss" or "yield".
        target: fraction of mechanisms that keep all limits, between 0 and 1; of the criterion "yield" alone.
        coverage: standard deviations within the limits; of "rss" alone.
        statistic: "quantile" or "mean"; of "rss" alone.
        distribution: of the errors: "uniform", "triangular", "normal" or "truncated_normal".
        samples: simulations that the statistics come from; None for the default. Not of "worst_case".
        verify_samples: independent simulations that verify the answer. Not of "worst_case".
        starts: numbers of searches by the kind of their starting points, {"corners", "random", "sobol"};
            of "worst_case" alone.
        rounds: largest number of corrections until the answer converges.
        accuracy: relative, of the limits.
        scales: further allocations, with every limit's distance to the nominal value multiplied by these.
        seed: of random starts and samples.
        mode: of differentiation: "auto", "forward" or "reverse".
        batch: simulations at once on each device.
        zones: shapes of the zones among the bounds; a position or coaxiality without one is a disc.
    Raises: InputError for settings that are out of range or do not fit each other.
    """

    limits: dict[str, tuple[float, float]]
    bounds: dict[str, tuple[float, float]]
    costs: dict[str, ErrorCost]
    criterion: str = "worst_case"
    target: float = 0.9973
    coverage: float = 3.0
    statistic: str = "quantile"
    distribution: str = "normal"
    samples: int | None = None
    verify_samples: int = 4096
    starts: dict[str, int] = field(default_factory=lambda: dict(STARTS))
    rounds: int = 12
    accuracy: float = 1e-4
    scales: tuple[float, ...] = ()
    seed: int = 0
    mode: str = "auto"
    batch: int = 64
    zones: tuple[SpecifiedZone, ...] = ()

    def _check_fields(self, checks: Checks) -> None:
        checks.convert("criterion", require_choice, ("worst_case", "rss", "yield"), "criterion")
        self._check_search(checks, needed=True)
        checks.convert("statistic", require_choice, ("quantile", "mean"), "statistic")
        convert_all(checks, ("verify_samples", "rounds", "batch", "samples"), whole_number, 1)
        checks.convert("scales", _scales)
        checks.convert("accuracy", positive_quantity, "none", "accuracy")
        checks.convert("starts", starts_of)
        given = {one.name for one in fields(self) if getattr(self, one.name) != _default(one)}
        for name in sorted(given & {*_CRITERIA_OF}):
            checks.relation(("criterion", name), self._require_criterion, name)

    def _require_criterion(self, name: str) -> None:
        """See that a setting counts for the criterion."""
        criteria = _CRITERIA_OF[name]
        if self.criterion not in criteria:
            others = " or ".join(f'"{one}"' for one in criteria)
            raise InputError(
                f'Argument `{name}` must be left out with the criterion "{self.criterion}", '
                f"but is given; remove it, or take the criterion {others}."
            )

    @property
    def metrics(self) -> tuple[str, ...]:
        """The metrics that have limits."""
        return tuple(self.limits)


def _scales(scales: object) -> tuple[float, ...]:
    if not isinstance(scales, (list, tuple)):
        raise InputError(f"Argument `scales` must be a list of factors, but was {scales!r}; write [0.5, 2.0].")
    return tuple(positive_quantity(one, "none", "scales") for one in scales)


def _default(one: Field[Any]) -> Any:
    return one.default if one.default_factory is MISSING else one.default_factory()
