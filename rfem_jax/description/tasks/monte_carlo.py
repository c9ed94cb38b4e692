"""What is asked of a Monte Carlo study: the table [monte_carlo].

Place in the pipeline: task -> **monte_carlo** -> `rfem_jax.report.tasks.monte_carlo`.

Symbols: limits in the metric's own unit; quantiles and confidence [1].
"""

from dataclasses import dataclass, field

from rfem_jax.description.errors import InputError, require_choice, require_flag
from rfem_jax.description.tasks.settings import (
    MOST_AT_ONCE,
    MOST_SAMPLES,
    fraction,
    limits_of,
    metric_names,
    set_fields,
    whole_number,
)
from rfem_jax.description.tasks.task import Task


@dataclass(frozen=True)
class MonteCarloTask(Task):
    """Scatter of metrics over the tolerances.

    Args:
        n: number of samples, at least 2; best a power of 2.
        metrics: names of metrics; "*" stands for all joints; those of `limits` are added.
        limits: {metric: largest value, or (low, high)} in the metric's unit; their yield is estimated.
        batch: samples in a chunk, the unit that is stored, and lost when a run is interrupted.
        lanes: samples that each device computes at once; None for its default.
        seed: of the random samples.
        sampling: "sobol" or "pseudo_random".
        quantiles: fractions between 0 and 1.
        confidence: of the intervals, between 0 and 1.
        sobol_indices: True to estimate Sobol' indices, with d + 2 times as many simulations for d
            independent errors.
        control_variate: True to estimate means with the help of the quadratic model.
    Raises: InputError for settings that are out of range or do not fit each other.
    """

    n: int
    metrics: tuple[str, ...] = ()
    limits: dict[str, tuple[float, float]] = field(default_factory=dict)
    batch: int = 64
    lanes: int | None = None
    seed: int = 0
    sampling: str = "sobol"
    quantiles: tuple[float, ...] = (0.01, 0.05, 0.5, 0.95, 0.99)
    confidence: float = 0.95
    sobol_indices: bool = False
    control_variate: bool = False

    def __post_init__(self):
        whole_number(self.n, "n", 2, MOST_SAMPLES)
        whole_number(self.batch, "batch", 1, MOST_AT_ONCE)
        whole_number(self.seed, "seed", 0)
        if self.lanes is not None:
            whole_number(self.lanes, "lanes", 1, MOST_AT_ONCE)
        require_choice(self.sampling, ("sobol", "pseudo_random"), "sampling")
        require_flag(self.sobol_indices, "sobol_indices")
        require_flag(self.control_variate, "control_variate")
        if not isinstance(self.quantiles, (list, tuple)):
            raise InputError(
                f"Argument `quantiles` must be a list of fractions, but was {self.quantiles!r}; "
                "write [0.05, 0.5, 0.95]."
            )
        limits = limits_of(self.limits)
        named = metric_names(self.metrics) if self.metrics or not limits else ()
        set_fields(
            self,
            limits=limits,
            metrics=tuple(dict.fromkeys((*named, *limits))),
            quantiles=tuple(fraction(one, "quantiles") for one in self.quantiles),
            confidence=fraction(self.confidence, "confidence"),
        )
