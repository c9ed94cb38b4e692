"""What is asked of the correction of a machine that was measured: the table [identification.correction].

Place in the pipeline: settings -> **correction** -> identification. Amounts are changes of errors and parameters that a
fitter can make, by turning a joint or putting a shim under it, in m and rad, or strings with a unit.
"""

from dataclasses import dataclass, field

from rfem_jax.description.basics.errors import Checks, ChecksItself, InputError
from rfem_jax.description.mechanism.mechanism import Mechanism
from rfem_jax.description.metrics.subjects import require_metric, subjects_of
from rfem_jax.description.parameters.deviations import require_deviation
from rfem_jax.description.tasks.settings import convert_all, fraction, limits_of, metric_names, whole_number
from rfem_jax.description.tasks.sweep import bounds_of
from rfem_jax.description.tolerances.tolerances import error_quantities


@dataclass(frozen=True)
class AskedCorrection(ChecksItself):
    """Which adjustment reduces a metric most, given what is known of the errors.

    Args:
        metric: what is to be less.
        adjustments: {error or parameter: (least, largest change)} that can be made, 0 among them.
        multiples_of: {adjustment: amount}: it comes in whole multiples, as shims of "0.05 mm" do.
        limits: {metric: largest value, or (low, high)} in its unit, whose probabilities to be broken are told.
        quantile: the metric is below the value that is told with this probability, between 0 and 1.
        points: samples of what is known of the errors that searches see.
        steps: the most of a search, each with derivatives at all of these samples.
    Raises: InputError for settings that are out of range.
    """

    metric: str
    adjustments: dict[str, tuple[float, float]]
    multiples_of: dict[str, float] = field(default_factory=dict)
    limits: dict[str, tuple[float, float]] = field(default_factory=dict)
    quantile: float = 0.95
    points: int = 16
    steps: int = 40

    def _check_fields(self, checks: Checks) -> None:
        checks.convert("metric", _metric)
        checks.convert("adjustments", bounds_of, "adjustments")
        checks.convert("multiples_of", error_quantities, "multiples_of")
        checks.convert("limits", limits_of)
        convert_all(checks, ("quantile",), fraction)
        convert_all(checks, ("points", "steps"), whole_number, 1)
        checks.relation(("adjustments", "multiples_of"), self._require_changes)

    def _require_changes(self) -> None:
        for name, (low, high) in self.adjustments.items():
            if low > 0.0 or high < 0.0:
                raise InputError(
                    f"Argument `adjustments` must be changes, 0 among them, but `{name}` goes from {low:g} to "
                    f"{high:g}; give the least and the largest change from what was measured."
                )
        for name, amount in self.multiples_of.items():
            if name not in self.adjustments or not (isinstance(amount, str) or amount > 0.0):
                raise InputError(
                    "Argument `multiples_of` must give positive amounts of adjustments, but has "
                    f"`{name}` = {amount!r}; name one of the `adjustments`."
                )
        if not self.adjustments:
            raise InputError(
                "Argument `adjustments` must name at least one error that can be changed, but names none; write for "
                'example { "D.d_y" = ["-1 mm", "1 mm"] }.'
            )

    def require_known(self, mechanism: Mechanism, name: str) -> None:
        """Raise InputError for errors and metrics that the mechanism has not; `name`: of the task."""
        for error in self.adjustments:
            require_deviation(mechanism, error, f"`{name}`")
        for metric in (self.metric, *self.limits):
            require_metric(metric, subjects_of(mechanism), "mechanism", f" of the task `{name}`")


def _metric(name: object) -> str:
    if not isinstance(name, str) or name.startswith("*"):
        raise InputError(f'Argument `metric` must be the name of a metric, but was {name!r}; write "D.rms_moment".')
    return metric_names(name)[0]
