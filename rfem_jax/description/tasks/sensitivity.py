"""What is asked of a sensitivity study: the table [sensitivity].

Place in the pipeline: task -> **sensitivity** -> `rfem_jax.report.tasks.sensitivity`.

Symbols: the point `at` in rad and m (`error_catalogue`), or strings with a unit.
"""

from dataclasses import dataclass, field

from rfem_jax.description.basics.errors import Checks, InputError, require_choice, require_flag
from rfem_jax.description.tasks.settings import MODES, MOST_AT_ONCE, convert_all, metric_names, whole_number
from rfem_jax.description.tasks.task import Task
from rfem_jax.description.tolerances.tolerances import error_quantities


@dataclass(frozen=True)
class SensitivityTask(Task):
    """Derivatives of metrics by the errors that have tolerances.

    Args:
        metrics: names of metrics, such as "D.mean_square_moment"; "*" stands for all joints.
        order: 1, or 2 for the Hessian too.
        at: the point, {error: value} in rad and m; errors not named are 0.
        mode: of differentiation: "auto", "forward" or "reverse".
        batch: directions at once.
        half_step: True to repeat everything with half the step (a tenth of the tolerances of an
            adaptive method) and show the change, as is always done with joints with clearance.
    Raises: InputError for settings that are out of range or do not fit each other.
    """

    metrics: tuple[str, ...]
    order: int = 2
    at: dict[str, float] = field(default_factory=dict)
    mode: str = "auto"
    batch: int = 32
    half_step: bool = False

    def _check_fields(self, checks: Checks) -> None:
        checks.convert("metrics", metric_names)
        checks.convert("at", error_quantities, "at")
        checks.convert("mode", require_choice, MODES, "mode")
        convert_all(checks, ("batch",), whole_number, 1, MOST_AT_ONCE)
        convert_all(checks, ("half_step",), require_flag)
        checks.convert("order", _order)


def _order(order: object) -> int:
    if isinstance(order, bool) or order not in (1, 2):
        raise InputError(f"Argument `order` must be 1 or 2, but was {order!r}; 2 gives the Hessian too.")
    return order
