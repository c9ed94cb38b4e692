"""What is asked of a Monte Carlo study: the table [monte_carlo].

Place in the pipeline: task -> **monte_carlo** -> `rfem_jax.report.tasks.monte_carlo`.

Symbols: limits in the metric's own unit; quantiles and confidence [1].
"""

from dataclasses import dataclass, field, replace

from rfem_jax.description.basics.errors import Checks, InputError, require_choice, require_flag, suggestion
from rfem_jax.description.mechanism.mechanism import Mechanism
from rfem_jax.description.metrics.subjects import points_of
from rfem_jax.description.tasks.settings import (
    MOST_AT_ONCE,
    MOST_SAMPLES,
    convert_all,
    fraction,
    fractions,
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
        bands: names of points of whose paths the band is computed, from at most 256 of the samples; None for those
            that the metrics are of.
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
    bands: tuple[str, ...] | None = None

    def _check_fields(self, checks: Checks) -> None:
        convert_all(checks, ("n",), whole_number, 2, MOST_SAMPLES)
        convert_all(checks, ("batch", "lanes"), whole_number, 1, MOST_AT_ONCE)
        convert_all(checks, ("seed",), whole_number, 0)
        checks.convert("sampling", require_choice, ("sobol", "pseudo_random"), "sampling")
        convert_all(checks, ("sobol_indices", "control_variate"), require_flag)
        convert_all(checks, ("quantiles",), fractions)
        convert_all(checks, ("confidence",), fraction)
        checks.convert("limits", limits_of)
        convert_all(checks, ("bands",), _names)
        if self.metrics or not (self.limits or checks.failed):
            checks.convert("metrics", metric_names)
        if checks.passed("limits", "metrics"):
            set_fields(self, metrics=tuple(dict.fromkeys((*self.metrics, *self.limits))))

    def resolved(self, mechanism: Mechanism, name: str) -> "MonteCarloTask":
        """As `Task.resolved`; bands must be of points of the mechanism."""
        task = super().resolved(mechanism, name)
        assert isinstance(task, MonteCarloTask)
        owners, own = points_of(task.metrics), [point.name for point in mechanism.points]
        known = [*own, *(point for point in owners if point not in own)]
        if task.bands is None:
            return replace(task, bands=tuple(point for point in known if point in owners))
        for point in task.bands:
            if point not in known:
                raise InputError(
                    f"Argument `bands` of the task `{name}` must name points of the mechanism, but it has no point "
                    f"`{point}`; {suggestion(point, known) if known else 'add a table [[mechanism.points]].'}"
                )
        return task


def _names(value: object, where: str) -> tuple[str, ...] | None:
    """Names of points, checked but for the mechanism. Raises InputError."""
    names = (value,) if isinstance(value, str) else value
    if names is not None and not (isinstance(names, (list, tuple)) and all(isinstance(one, str) for one in names)):
        raise InputError(f'Argument `{where}` must be a list of names of points, but was {value!r}; write ["P"].')
    return None if names is None else tuple(dict.fromkeys(names))
