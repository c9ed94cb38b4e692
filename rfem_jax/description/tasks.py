"""Tasks of a study: tolerances of the errors, and the tolerance studies that are asked for.

Place in the pipeline: `task_reader` makes them of a study file's tables, `study` checks them
against its mechanism, `report` turns them into calls of `tolerancing`.

Symbols: half-widths, intervals and points of errors in m and rad (`error_catalogue`), or strings
with a unit; limits in the metric's own unit; deviations [1] standard deviations in a half-width.
Metrics are named "JOINT.KIND" (KINDS below), "*.KIND" for all joints, or by RUN_METRICS.
"""

from dataclasses import MISSING, dataclass, field, fields, replace

from rfem_jax.description.errors import InputError, require_choice, require_flag, suggestion
from rfem_jax.description.tolerances import StatedTolerances, error_quantities
from rfem_jax.description.units import positive_quantity, quantity

KINDS = (
    *("mean_square_force", "mean_square_moment", "rms_force", "rms_moment", "peak_force"),
    *("peak_moment", "preload_force_square", "preload_moment_square"),
)
RUN_METRICS = ("angle_error", "end_energy")
MODES = ("auto", "forward", "reverse")
STARTS = {"corners": 4, "random": 4, "sobol": 8}
COST_MODELS = ("reciprocal", "reciprocal_squared", "exponential")


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
        _set(self, metrics=metric_names(self.metrics), at=error_quantities(self.at, "at"))
        require_choice(self.mode, MODES, "mode")
        whole_number(self.batch, "batch", 1)
        require_flag(self.half_step, "half_step")
        if self.order not in (1, 2) or isinstance(self.order, bool):
            raise InputError(
                f"Argument `order` must be 1 or 2, but was {self.order!r}; 2 gives the Hessian too."
            )


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
        whole_number(self.n, "n", 1)
        whole_number(self.batch, "batch", 1)
        whole_number(self.seed, "seed", 0)
        if self.lanes is not None:
            whole_number(self.lanes, "lanes", 1)
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
        _set(
            self,
            limits=limits,
            metrics=tuple(dict.fromkeys((*named, *limits))),
            quantiles=tuple(_fraction(one, "quantiles") for one in self.quantiles),
            confidence=_fraction(self.confidence, "confidence"),
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
        whole_number(self.evaluations, "evaluations", 1)
        whole_number(self.batch, "batch", 1)
        if self.corners is not None:
            require_flag(self.corners, "corners")
        _set(self, metrics=metric_names(self.metrics), starts=starts_of(self.starts))


@dataclass(frozen=True)
class ErrorCost:
    """What a tolerance t of one error costs.

    Args: model "reciprocal" fixed + price at/t, "reciprocal_squared" fixed + price (at/t)^2, or
        "exponential" fixed + price exp(-t/at); price and fixed in any currency; at [rad or m].
    """

    model: str = "reciprocal"
    price: float = 1.0
    at: float | None = None
    fixed: float = 0.0

    def __post_init__(self):
        require_choice(self.model, COST_MODELS, "`model` of a cost")
        _set(
            self,
            price=positive_quantity(self.price, "none", "`price` of a cost"),
            fixed=quantity(self.fixed, "none", "`fixed` of a cost"),
        )


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
class AllocationTask:
    """The cheapest tolerances that keep limits.

    Args: limits {metric: largest, or (low, high)}; bounds {error: (smallest, largest half-width)};
        costs {error: ErrorCost} with `at` in SI, one for each of the bounds; criterion
        "worst_case", "rss" or "yield"; target, coverage, statistic, samples, verify_samples,
        starts, rounds, accuracy as `rfem_jax.allocate` says (accuracy is its `tolerance`);
        distribution of the errors; scales, further allocations with every limit's distance to the
        nominal value multiplied by these; mode; seed; batch, simulations at once.
    Raises: InputError for everything that cannot be meant.
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

    def __post_init__(self):
        require_choice(self.criterion, ("worst_case", "rss", "yield"), "criterion")
        require_choice(self.statistic, ("quantile", "mean"), "statistic")
        known = ("uniform", "triangular", "normal", "truncated_normal")
        require_choice(self.distribution, known, "distribution")
        require_choice(self.mode, MODES, "mode")
        self._require_own_settings()
        for name, least in (("verify_samples", 1), ("rounds", 1), ("seed", 0), ("batch", 1)):
            whole_number(getattr(self, name), name, least)
        if self.samples is not None:
            whole_number(self.samples, "samples", 1)
        if not isinstance(self.scales, (list, tuple)):
            raise InputError(
                f"Argument `scales` must be a list of factors, but was {self.scales!r}; "
                "write [0.5, 2.0]."
            )
        _set(
            self,
            limits=limits_of(self.limits, needed=True),
            bounds=_bounds(self.bounds),
            target=_fraction(self.target, "target"),
            coverage=positive_quantity(self.coverage, "none", "coverage"),
            accuracy=positive_quantity(self.accuracy, "none", "accuracy"),
            starts=starts_of(self.starts),
            scales=tuple(positive_quantity(one, "none", "scales") for one in self.scales),
        )
        missing = [name for name in self.bounds if name not in self.costs]
        if missing:
            raise InputError(
                f"Argument `costs` must have a cost for every error with bounds, but "
                f"`{missing[0]}` has none; add it."
            )

    def _require_own_settings(self):
        for one in fields(self):
            criteria = _CRITERIA_OF.get(one.name, (self.criterion,))
            if self.criterion in criteria:
                continue
            default = one.default_factory() if one.default is MISSING else one.default
            if getattr(self, one.name) != default:
                others = " or ".join(f'"{name}"' for name in criteria)
                raise InputError(
                    f'Argument `{one.name}` must be left out with the criterion "{self.criterion}", '
                    f"but is given; remove it, or take the criterion {others}."
                )

    @property
    def metrics(self) -> tuple[str, ...]:
        """The metrics that have limits."""
        return tuple(self.limits)


@dataclass(frozen=True)
class Tasks:
    """The tolerances of a study and its tasks, None where it has none."""

    tolerances: StatedTolerances | None = None
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
            for name in self.tolerances.names:
                mechanism.require_error(name, "`tolerances`")
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


def metric_names(names) -> tuple[str, ...]:
    """Names of metrics, checked but for their joints. Raises InputError with the nearest name."""
    if isinstance(names, str):
        names = (names,)
    if not isinstance(names, (list, tuple)) or not names:
        raise InputError(
            f"Argument `metrics` must be a list of names, but was {names!r}; "
            'write for example ["D.mean_square_moment"].'
        )
    for name in names:
        joint, dot, kind = name.rpartition(".") if isinstance(name, str) else ("", "", "")
        if name in RUN_METRICS or (joint and dot and kind in KINDS):
            continue
        known = [f"{joint or '*'}.{kind}" for kind in KINDS] + list(RUN_METRICS)
        raise InputError(
            f"Argument `metrics` must hold names of metrics, but {name!r} is none; "
            f"{suggestion(name, known)}"
        )
    return tuple(dict.fromkeys(names))


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


def limits_of(limits, needed=False) -> dict[str, tuple[float, float]]:
    """{metric: (low, high)}, open ends infinite, from {metric: high, or (low, high)}."""
    if not isinstance(limits, dict) or (needed and not limits):
        raise InputError(
            f"Argument `limits` must be a table of metrics and their limits, but was {limits!r}; "
            'write for example { "D.mean_square_moment" = 20.0 }.'
        )
    if limits:
        metric_names(tuple(limits))
    complete = {}
    for name, limit in limits.items():
        pair = tuple(limit) if isinstance(limit, (list, tuple)) else (float("-inf"), limit)
        plain = all(isinstance(end, (int, float)) and not isinstance(end, bool) for end in pair)
        if len(pair) != 2 or not plain or not pair[0] < pair[1]:
            raise InputError(
                f"Argument `limits` must give a largest value or [low, high], but `{name}` has "
                f"{limit!r}; write a number in the metric's unit (inf and -inf are open ends)."
            )
        complete[name] = (float(pair[0]), float(pair[1]))
    return complete


def starts_of(starts) -> dict[str, int]:
    """Numbers of starts by kind; kinds that are missing are 0. Raises InputError."""
    if not isinstance(starts, dict):
        raise InputError(
            f"Argument `starts` must be a table of numbers, but was {starts!r}; "
            "write { corners = 4, random = 4, sobol = 8 }."
        )
    for name, count in starts.items():
        require_choice(name, tuple(STARTS), "starts")
        whole_number(count, f"starts.{name}", 0)
    if not any(starts.values()):
        raise InputError(
            "Argument `starts` must ask for at least one search, but asks for none; "
            "write { corners = 4 }."
        )
    return {name: starts.get(name, 0) for name in STARTS}


def whole_number(value, where: str, least: int) -> int:
    """`value` if it is a whole number of at least `least`. Raises InputError."""
    if isinstance(value, bool) or not isinstance(value, int) or value < least:
        raise InputError(
            f"Argument `{where}` must be a whole number of at least {least}, but was {value!r}; "
            "correct it."
        )
    return value


def _fraction(value, where):
    number = quantity(value, "none", where)
    if not 0.0 < number < 1.0:
        raise InputError(
            f"Argument `{where}` must lie between 0 and 1, but was {value!r}; 0.95 is usual."
        )
    return number


def _bounds(bounds):
    if not isinstance(bounds, dict) or not bounds:
        raise InputError(
            f"Argument `bounds` must be a table of errors and their smallest and largest "
            f'half-width, but was {bounds!r}; write {{ "D.delta_x" = ["0.05 deg", "1 deg"] }}.'
        )
    complete = {}
    for name, pair in bounds.items():
        ends = pair if isinstance(pair, (list, tuple)) and len(pair) == 2 else (0.0, 0.0)
        low, high = (error_quantities({name: end}, "bounds")[name] for end in ends)
        if not 0.0 < low < high:
            raise InputError(
                f"Argument `bounds` must give [smallest, largest] half-widths above 0, but "
                f'`{name}` has {pair!r}; write for example ["0.05 deg", "1 deg"].'
            )
        complete[name] = (low, high)
    return complete


def _set(task, **values):
    for name, value in values.items():
        object.__setattr__(task, name, value)
