"""Tasks of a study: tolerances of the errors, and the tolerance studies that are asked for.

Place in the pipeline: `task_reader` makes them of a study file's tables, `study` checks them
against its mechanism, `report` turns them into calls of `tolerancing`.

Symbols: half-widths, intervals and points of errors in m and rad (`error_catalogue`), or strings
with a unit; limits in the metric's own unit; deviations [1] standard deviations in a half-width.
Metrics are named as `task_settings` says.
"""

from dataclasses import dataclass, field, fields, replace

from rfem_jax.description.allocation_task import AllocationTask
from rfem_jax.description.errors import InputError, require_choice, require_flag, suggestion
from rfem_jax.description.metric_catalogue import RUN_METRICS
from rfem_jax.description.task_settings import (
    MODES,
    MOST_AT_ONCE,
    MOST_SAMPLES,
    STARTS,
    fraction,
    limits_of,
    metric_names,
    set_fields,
    starts_of,
    whole_number,
)
from rfem_jax.description.tolerances import SpecifiedTolerances, error_quantities


@dataclass(frozen=True)
class SensitivityTask:
    """Derivatives of metrics by the errors that have tolerances.

    Args: metrics, names; order 1 or 2; at {error: value} of the point, else nominal; mode "auto",
        "forward" or "reverse"; batch, directions at once; half_step, True to repeat everything with
        half the step (a tenth of the tolerances of an adaptive method) and show the change.
    Raises: InputError for everything that cannot be meant.
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


@dataclass(frozen=True)
class MonteCarloTask:
    """Scatter of metrics over the tolerances.

    Args: n samples, in chunks of batch; seed; metrics, names (those of limits are added); limits
        {metric: largest, or (low, high)}; sampling "sobol" or "pseudo_random"; quantiles and
        confidence in (0, 1); sobol_indices, control_variate; lanes, samples each device computes at
        once, None for its default.
    Raises: InputError for everything that cannot be meant.
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


@dataclass(frozen=True)
class WorstCaseTask:
    """Largest (or smallest) value of metrics over the tolerances.

    Args: metrics, names; region "box" or "ellipsoid"; sense "max" or "min"; seed; starts
        {"corners", "random", "sobol": number of searches}; corners True, False or None (all of
        them where there are few); evaluations, the most of each search; mode; batch, simulations
        at once.
    Raises: InputError for everything that cannot be meant.
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


@dataclass(frozen=True)
class Tasks:
    """The tolerances of a study and its tasks, None where it has none."""

    tolerances: SpecifiedTolerances | None = None
    sensitivity: SensitivityTask | None = None
    monte_carlo: MonteCarloTask | None = None
    worst_case: WorstCaseTask | None = None
    allocation: AllocationTask | None = None

    @property
    def declared(self) -> tuple[str, ...]:
        """Names of the tasks that there are, in the order in which they are done."""
        names = (one.name for one in fields(self) if one.name != "tolerances")
        return tuple(name for name in names if getattr(self, name) is not None)

    def resolved(self, mechanism) -> "Tasks":
        """The same tasks with "*" replaced by the mechanism's joints; everything must fit it.

        Raises: InputError for errors and joints that the mechanism has not, and for a task that
            needs tolerances where there are none.
        """
        if self.tolerances is not None:
            mechanism.require_sizes(self.tolerances.reaches(), "`tolerances`")
        found = {}
        for name in self.declared:
            task = getattr(self, name)
            if self.tolerances is None and name != "allocation":
                raise InputError(
                    f"Task `{name}` must have tolerances of the errors, but the study states none; "
                    'add a table [tolerances], for example with "D.delta_x" = "0.5 deg".'
                )
            for error in (*getattr(task, "at", ()), *getattr(task, "bounds", ())):
                mechanism.require_error(error, f"`{name}`")
            joints = tuple(joint.name for joint in mechanism.joints)
            changes = {}
            if hasattr(task, "limits"):
                changes["limits"] = {
                    metric: limit
                    for pattern, limit in task.limits.items()
                    for metric in _resolve(pattern, joints, name)
                }
            if name != "allocation":
                metrics = (m for pattern in task.metrics for m in _resolve(pattern, joints, name))
                changes["metrics"] = tuple(dict.fromkeys(metrics))
            found[name] = replace(task, **changes)
        return replace(self, **found)


def _resolve(pattern, joints, task):
    """Names of the metrics that one name with "*" stands for; the joint must be there."""
    joint, _, kind = pattern.rpartition(".")
    if joint == "*":
        return [f"{name}.{kind}" for name in joints]
    if pattern not in RUN_METRICS and joint not in joints:
        raise InputError(
            f"Argument `metrics` of the task `{task}` must be of joints of the mechanism, but "
            f"`{joint}` in `{pattern}` is none; {suggestion(joint, joints)}"
        )
    return [pattern]
