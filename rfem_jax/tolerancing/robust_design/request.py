"""The request of an allocation or of an optimisation of a design: variables, objective and limits, checked.

Place in the pipeline: arguments of `allocate`, `optimise` -> **request** -> criteria, search.

An allocation is the request without designs: all tolerances are found, their cost is the objective. Distances from its
limits are divided by the headroom |limit - f(centre)|, those of an optimisation by the size of the limit.

Symbols: f metric; h (l,) normalised limits, at most 0 where they hold; k errors, v sizes of tolerances (`sizes`).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from rfem_jax.description.basics.errors import InputError
from rfem_jax.tolerancing.checks import ErrorValue, ErrorValues, check_variables, error_value, read_limits
from rfem_jax.tolerancing.layout import show_number
from rfem_jax.tolerancing.optimisation.sizes import Sizes, Zones, sizes_of
from rfem_jax.tolerancing.problems.evaluation import metric_index, read_point, split_errors
from rfem_jax.tolerancing.problems.linearisation import choose_mode
from rfem_jax.tolerancing.problems.named_tolerances import Tolerances
from rfem_jax.tolerancing.problems.problem import ToleranceProblem
from rfem_jax.tolerancing.problems.quadratic_model import QuadraticModel, expand_by_differences
from rfem_jax.tolerancing.problems.sample_values import Base
from rfem_jax.tolerancing.robust_design.cost_models import CostModel, assign_costs
from rfem_jax.tolerancing.robust_design.variables import Variables, separate_widths

COST = "cost"  # term of the objective: the cost of the tolerances

Bounds = Mapping[str, Sequence[ErrorValue]]
Widths = Mapping[str, ErrorValue | Sequence[ErrorValue]]


class Limit(NamedTuple):
    """One end of a limit: metric's name, unit and position, sign (1 upper, -1 lower), bound, and scale [unit] by which
    distances from it are divided."""

    metric: str
    unit: str
    position: int
    sign: float
    bound: float
    scale: float

    def normalise(self, value: Any) -> Any:
        """h of a value of the metric, a number or an array."""
        return self.sign * (value - self.bound) / self.scale

    def restore(self, h: float) -> float:
        """The metric's value of a normalised h."""
        return self.bound + self.sign * self.scale * h

    @property
    def words(self) -> str:
        """The limit for a sentence."""
        return f"at {'most' if self.sign > 0.0 else 'least'} {show_number(self.bound, 6)} {self.unit} on {self.metric}"

    def reached(self, h: float) -> str:
        """The metric's value of a normalised h, for a sentence."""
        return f"{show_number(self.restore(float(h)), 6)} {self.unit}"


@dataclass(frozen=True, eq=False)
class Request:
    """Checked arguments of `allocate` or `optimise`.

    base: errors with fixed values; weights {metric or "cost": weight} of the objective; metric_weights (m,): those of
    the problem's metrics; costs: cost models of the tolerances to be found, in their order; mode and batch of
    derivatives. Of an allocation: `at`, the centre of the tolerances and fixed errors; model, the quadratic one there.
    """

    problem: ToleranceProblem
    variables: Variables
    base: Base
    weights: dict[str, float]
    metric_weights: Float[np.ndarray, " m"]
    costs: tuple[CostModel, ...]
    limits: tuple[Limit, ...]
    mode: str
    batch: int
    at: dict[str, float]
    model: QuadraticModel | None = None

    @property
    def units(self) -> dict[str, str]:
        """Units of all variables and of errors that scatter."""
        units = {name: self.problem.error_unit(name) for name in self.variables.names}
        return units | dict.fromkeys(self.variables.sizes.zones, "m")

    def normalise(self, values: Float[np.ndarray, "n m"]) -> Float[np.ndarray, "n l"]:
        """Values of all metrics -> h."""
        found = [limit.normalise(values[:, limit.position]) for limit in self.limits]
        return np.stack(found, axis=1) if found else np.zeros((len(values), 0))

    def normalise_slopes(self, jacobians: Float[np.ndarray, "n m q"]) -> Float[np.ndarray, "n l q"]:
        """Derivatives of all metrics -> those of h."""
        found = [one.sign / one.scale * jacobians[:, one.position] for one in self.limits]
        return np.stack(found, axis=1) if found else np.zeros((len(jacobians), 0, jacobians.shape[2]))


def check_request(
    problem: ToleranceProblem,
    designs: Bounds,
    tolerances: Tolerances | Widths | None,
    objective: str | Mapping[str, float],
    limits: Mapping[str, Any] | None,
    cost: CostModel | Mapping[str, CostModel] | None,
    at: Mapping[str, ErrorValue] | None,
    robust: str,
    zones: Zones | None = None,
    mode: str = "auto",
    batch: int = 64,
) -> Request:
    """Check and normalise a request (arguments of `optimise`). Raises InputError."""
    variables = _variables(problem, designs, tolerances, robust, zones)
    weights = _weights(problem, objective)
    costs = _costs(variables, cost)
    if COST in weights and not costs:
        raise InputError(
            'Argument `objective` must be a metric, but has "cost", and no tolerance is to be found; give (smallest, '
            "largest) for a tolerance."
        )
    inside = next((name for name in at or {} if name in variables.names), None)
    if inside is not None:
        raise InputError(f"Argument `at` must hold what does not vary, but `{inside}` does; leave it out.")
    base, _ = split_errors(problem, at, variables.names)
    mode = choose_mode(mode, len(variables.names), len(problem.metrics), problem)
    metric_weights = np.array([weights.get(metric.name, 0.0) for metric in problem.metrics])
    read = _limits(problem, limits)
    return Request(problem, variables, base, weights, metric_weights, costs, read, mode, batch, read_point(problem, at))


def check_allocation(
    problem: ToleranceProblem,
    limits: Mapping[str, Any],
    cost: CostModel | Mapping[str, CostModel],
    bounds: Bounds,
    at: ErrorValues | None = None,
    mode: str = "auto",
    batch: int = 64,
    model: QuadraticModel | None = None,
    zones: Zones | None = None,
    together: bool = True,
) -> Request:
    """Check and normalise a request (arguments of `allocate`), with the quadratic model at the centre.

    Args: together: True if the derivatives of all metrics are needed at every point (statistical criteria), False for
        those of one (worst case); it decides the mode of the derivatives.
    Raises: InputError.
    """
    if not isinstance(bounds, Mapping) or not bounds:
        raise InputError(
            f"Argument `bounds` must map names of errors to (smallest, largest) half-width, but it is {bounds!r}."
        )
    sizes, widths = _read_sizes(problem, bounds, zones, "bounds")
    base, centre = split_errors(problem, at, sizes.errors)
    none = np.zeros(0)
    variables = Variables((), none, none, none, sizes, *separate_widths(widths), np.asarray(centre))
    costs = _costs(variables, cost)
    mode = choose_mode(mode, len(sizes.errors), len(problem.metrics) if together else 1, problem)
    if model is None:
        typical = dict(zip(sizes.errors, map(float, sizes.reaches(variables.half_widths)), strict=True))
        model = expand_by_differences(problem, at, typical, mode=mode, batch=batch)
    elif model.names != sizes.errors or model.hessian is None:
        raise InputError(
            "Argument `model` must be of order 2 in the errors of `bounds`, in their order, but it "
            f"has {model.names} of order {1 if model.hessian is None else 2}; leave it out."
        )
    read = _limits(problem, limits, np.asarray(model.value))
    no_metric = np.zeros(len(problem.metrics))
    return Request(
        problem, variables, base, {COST: 1.0}, no_metric, costs, read, mode, batch, read_point(problem, at), model
    )


def nominal_value(problem: ToleranceProblem, name: str) -> float:
    """What a deviation of zero means: the value of a parameter in the description, 0 for errors."""
    known = getattr(problem, "nominal_value", None)
    return 0.0 if known is None else float(known(name))


def _variables(problem, designs, tolerances, robust, zones) -> Variables:
    if not isinstance(designs, Mapping):
        raise InputError(
            f'Argument `designs` must map names to (lowest, highest), but it is {designs!r}; write {{"bar.height": '
            "(0.006, 0.012)}."
        )
    check_variables(designs, problem, "designs")
    bounds = [_pair(problem.error_unit(name), name, pair, "designs") for name, pair in designs.items()]
    for name, (low, high) in zip(designs, bounds, strict=True):
        if not (np.isfinite(low) and np.isfinite(high) and low < high):
            raise InputError(
                f"Argument `designs` must give (lowest, highest) of finite numbers in this order, but `{name}` has "
                f"({low:g}, {high:g}); exchange them, or leave out what must not change."
            )
    widths = dict(tolerances or {}) if not isinstance(tolerances, Tolerances) else tolerances.half_widths()
    if isinstance(tolerances, Tolerances) and tolerances.zones:
        inside = [name for zone in tolerances.zones for name in zone.names]
        widths = {name: width for name, width in widths.items() if name not in inside}
        zones = {}
        for zone in tolerances.zones:
            label, diameter = "+".join(zone.names), 2.0 * float(jnp.max(zone.half_widths()))
            zones[label] = zone.scaled(jnp.full(len(zone.names), 1.0 / diameter))
            widths[label] = diameter
    sizes, read = _read_sizes(problem, widths, zones, "tolerances")
    if robust != "nominal" and not read:
        raise InputError(
            f'Argument `tolerances` must say what scatters with robust="{robust}", but is empty; give {{error: '
            'half-width}, or robust="nominal".'
        )
    if not designs and not any(isinstance(width, tuple) for width in read.values()):
        raise InputError("Argument `designs` must hold what may change, but neither it nor a tolerance does.")
    lower, upper = np.array(bounds).reshape(-1, 2).T
    nominal = np.array([nominal_value(problem, name) for name in designs])
    return Variables(tuple(designs), lower, upper, nominal, sizes, *separate_widths(read))


def _read_sizes(problem, widths, zones, where) -> tuple[Sizes, dict[str, float | tuple[float, float]]]:
    """The tolerances by their sizes, and the value of each or, of those to be found (all of `bounds`), both ends."""
    sizes, read = sizes_of(problem, widths, zones, where), {}
    for name in sizes.names:
        width, unit = widths[name], "m" if name in sizes.zones else problem.error_unit(name)
        if where == "bounds" or isinstance(width, (tuple, list)):
            low, high = read[name] = _pair(unit, name, width, where)
            if not 0.0 < low < high < np.inf:
                raise InputError(f"Argument `{where}` must give 0 < smallest < largest, but `{name}` has {width}.")
        else:
            read[name] = error_value(width, unit, f"`{name}` of `{where}`")
            if not (np.isfinite(read[name]) and read[name] > 0.0):
                raise InputError(
                    f"Argument `tolerances` must have positive half-widths, but `{name}` has {read[name]:g}; leave "
                    "out an error that does not vary."
                )
    return sizes, read


def _pair(unit, name, pair, where) -> tuple[float, float]:
    if not isinstance(pair, (tuple, list, np.ndarray)) or len(pair) != 2:
        raise InputError(f"Argument `{where}` must give (lowest, highest), but `{name}` has {pair!r}.")
    low, high = (error_value(end, unit, f"`{name}` of `{where}`") for end in pair)
    return low, high


def _costs(variables, cost) -> tuple[CostModel, ...]:
    """Cost models of the tolerances to be found."""
    free = [variables.sizes.names[i] for i in variables.free]
    if free and cost is None:
        raise InputError(
            f"Argument `cost` must say what tolerances cost, because that of `{free[0]}` is to be found; give for "
            "example Reciprocal(1e-3)."
        )
    return assign_costs(cost, free) if free else ()


def _weights(problem, objective) -> dict[str, float]:
    weights = {objective: 1.0} if isinstance(objective, str) else dict(objective)
    if not weights:
        raise InputError('Argument `objective` must name a metric or "cost", but is empty.')
    for name, weight in weights.items():
        if name != COST:
            metric_index(problem, name, "objective")
        if not (np.isfinite(weight) and weight >= 0.0):
            raise InputError(
                f"Argument `objective` must have weights that are not negative, but `{name}` has {weight!r}."
            )
    if not any(weights.values()):
        raise InputError("Argument `objective` must have a positive weight, but all are 0.")
    return {name: float(weight) for name, weight in weights.items()}


def _limits(problem, limits, centre=None) -> tuple[Limit, ...]:
    """Every finite end of a limit, upper before lower; `centre` (m,), values of all metrics there, of an allocation,
    which must have limits."""
    found, names = [], tuple(metric.name for metric in problem.metrics)
    for name, (low, high) in read_limits(limits, names, needed=centre is not None).items():
        position = metric_index(problem, name, "limits")
        for sign, bound in ((1.0, high), (-1.0, low)):
            if np.isfinite(bound):
                headroom = 0.0 if centre is None else abs(bound - float(centre[position]))
                unit = problem.metrics[position].unit
                found.append(Limit(name, unit, position, sign, bound, headroom or abs(bound) or 1.0))
    if centre is not None and not found:
        raise InputError("Argument `limits` must hold finite limits, but has none; add one.")
    return tuple(found)
