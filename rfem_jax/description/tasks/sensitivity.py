"""What is asked of a sensitivity study: the table [sensitivity].

Place in the pipeline: task -> **sensitivity** -> `rfem_jax.report.tasks.sensitivity`.

Symbols: the point `at` in rad and m (`error_catalogue`), or strings with a unit.
"""

from dataclasses import dataclass, field

from rfem_jax.description.errors import InputError, require_choice, require_flag
from rfem_jax.description.tasks.settings import MODES, MOST_AT_ONCE, metric_names, set_fields, whole_number
from rfem_jax.description.tasks.task import Task
from rfem_jax.description.tolerances import error_quantities


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
            adaptive method) and show the change.
    Raises: InputError for settings that are out of range or do not fit each other.
    """

    metrics: tuple[str, ...]
    order: int = 2
    at: dict[str, float] = field(default_factory=dict)
    mode: str = "auto"
    batch: int = 32
    half_step: bool = False

    def __post_init__(self):
        set_fields(self, metrics=metric_names(self.metrics), at=error_quantities(self.at, "at"))
        require_choice(self.mode, MODES, "mode")
        whole_number(self.batch, "batch", 1, MOST_AT_ONCE)
        require_flag(self.half_step, "half_step")
        if self.order not in (1, 2) or isinstance(self.order, bool):
            raise InputError(f"Argument `order` must be 1 or 2, but was {self.order!r}; 2 gives the Hessian too.")
