"""What is asked of a reliability study: the table [reliability].

Place in the pipeline: task -> **reliability** -> `rfem_jax.report.tasks.reliability`.

A table of its own, not a setting of [monte_carlo]: it answers another question (one probability for each limit, no
scatter), takes other simulations (searches with gradients, then samples far outside of the usual ones), and can
find that a limit is out of reach.

Symbols: limits in the metric's own unit.
"""

from dataclasses import dataclass

from rfem_jax.description.basics.errors import Checks, InputError, require_choice
from rfem_jax.description.tasks.settings import (
    MODES,
    MOST_AT_ONCE,
    MOST_SAMPLES,
    convert_all,
    fraction,
    limits_of,
    whole_number,
)
from rfem_jax.description.tasks.task import Task


@dataclass(frozen=True)
class ReliabilityTask(Task):
    """Probabilities that limits are broken, however small they are.

    Args:
        limits: {metric: largest value, or (low, high)} in the metric's unit.
        n: samples where limits fail, at least 50; intervals narrow by their square root. Twice and four times as many
            more are drawn where what they say cannot be trusted.
        level_samples: simulations of each level of the subset simulation, about a level for every factor 10 of a
            limit's probability, at least 50.
        starts: searches of the most probable failure in a turn, for each limit.
        rounds: the most simulations with derivatives of each search.
        seed: of the searches and samples.
        confidence: of the intervals, between 0 and 1.
        mode: of differentiation: "auto", "forward" or "reverse".
        batch: simulations at once on each device.
    Raises: InputError for settings that are out of range or do not fit each other.
    """

    limits: dict[str, tuple[float, float]]
    n: int = 2000
    level_samples: int = 500
    starts: int = 16
    rounds: int = 60
    seed: int = 0
    confidence: float = 0.95
    mode: str = "auto"
    batch: int = 64

    def _check_fields(self, checks: Checks) -> None:
        checks.convert("limits", limits_of, True)
        checks.convert("mode", require_choice, MODES, "mode")
        convert_all(checks, ("n", "level_samples"), whole_number, 50, MOST_SAMPLES)
        convert_all(checks, ("starts", "rounds"), whole_number, 1, MOST_SAMPLES)
        convert_all(checks, ("batch",), whole_number, 1, MOST_AT_ONCE)
        convert_all(checks, ("seed",), whole_number, 0)
        convert_all(checks, ("confidence",), fraction)
        checks.relation(("limits",), self._require_end)

    def _require_end(self) -> None:
        if all(abs(end) == float("inf") for pair in self.limits.values() for end in pair):
            raise InputError("Argument `limits` must have a finite end, but all ends are open; give a number.")

    @property
    def metrics(self) -> tuple[str, ...]:
        """Names of the metrics that have limits."""
        return tuple(self.limits)
