"""What is asked of a worst-case search: the table [worst_case].

Place in the pipeline: task -> **worst_case** -> `rfem_jax.report.tasks.worst_case`.
"""

from dataclasses import dataclass, field

from rfem_jax.description.basics.errors import Checks, require_choice, require_flag
from rfem_jax.description.tasks.settings import (
    MODES,
    MOST_AT_ONCE,
    MOST_SAMPLES,
    STARTS,
    convert_all,
    metric_names,
    starts_of,
    whole_number,
)
from rfem_jax.description.tasks.task import Task


@dataclass(frozen=True)
class WorstCaseTask(Task):
    """Largest (or smallest) value of metrics over the tolerances.

    Args:
        metrics: names of metrics; "*" stands for all joints.
        region: "box" or "ellipsoid" of the tolerances.
        sense: "max" or "min".
        seed: of the random starts.
        starts: numbers of searches by the kind of their starting points, {"corners", "random", "sobol"}.
        corners: True to compute all corners of the box, False for none; None = only where there are few.
        evaluations: largest number of evaluations of each search.
        mode: of differentiation: "auto", "forward" or "reverse".
        batch: simulations at once on each device.
    Raises: InputError for settings that are out of range or do not fit each other.
    """

    metrics: tuple[str, ...]
    region: str = "box"
    sense: str = "max"
    seed: int = 0
    starts: dict[str, int] = field(default_factory=lambda: dict(STARTS))
    corners: bool | None = None
    evaluations: int = 100
    mode: str = "auto"
    batch: int = 64

    def _check_fields(self, checks: Checks) -> None:
        checks.convert("region", require_choice, ("box", "ellipsoid"), "region")
        checks.convert("sense", require_choice, ("max", "min"), "sense")
        checks.convert("mode", require_choice, MODES, "mode")
        convert_all(checks, ("seed",), whole_number, 0)
        convert_all(checks, ("evaluations",), whole_number, 1, MOST_SAMPLES)
        convert_all(checks, ("batch",), whole_number, 1, MOST_AT_ONCE)
        convert_all(checks, ("corners",), require_flag)
        checks.convert("metrics", metric_names)
        checks.convert("starts", starts_of)
