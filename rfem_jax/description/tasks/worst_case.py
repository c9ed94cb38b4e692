"""What is asked of a worst-case search: the table [worst_case].

Place in the pipeline: task -> **worst_case** -> `rfem_jax.report.tasks.worst_case`.
"""

from dataclasses import dataclass, field

from rfem_jax.description.errors import require_choice, require_flag
from rfem_jax.description.tasks.settings import (
    MODES,
    MOST_AT_ONCE,
    MOST_SAMPLES,
    STARTS,
    metric_names,
    set_fields,
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
        corners: True to compute all corners of the box, False for none, None where there are few.
        evaluations: the most of each search.
        mode: of differentiation: "auto", "forward" or "reverse".
        batch: simulations at once.
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

    def __post_init__(self):
        require_choice(self.region, ("box", "ellipsoid"), "region")
        require_choice(self.sense, ("max", "min"), "sense")
        require_choice(self.mode, MODES, "mode")
        whole_number(self.seed, "seed", 0)
        whole_number(self.evaluations, "evaluations", 1, MOST_SAMPLES)
        whole_number(self.batch, "batch", 1, MOST_AT_ONCE)
        if self.corners is not None:
            require_flag(self.corners, "corners")
        set_fields(self, metrics=metric_names(self.metrics), starts=starts_of(self.starts))
