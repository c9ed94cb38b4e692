"""The request of an optimisation of a design: variables, objective and limits, checked.

Place in the pipeline: arguments of `optimise` -> **request** -> criteria, search.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from rfem_jax.description.basics.errors import InputError
from rfem_jax.tolerancing.allocation.cost_models import CostModel, assign_costs
from rfem_jax.tolerancing.checks import ErrorValue, check_known, error_value, read_limits
from rfem_jax.tolerancing.optimisation.sizes import Zones, sizes_of
from rfem_jax.tolerancing.problems.evaluation import metric_index, split_errors
from rfem_jax.tolerancing.problems.named_tolerances import Tolerances
from rfem_jax.tolerancing.problems.problem import ToleranceProblem
from rfem_jax.tolerancing.problems.sample_values import Base
from rfem_jax.tolerancing.robust_design.criteria import NormalisedLimit
from rfem_jax.tolerancing.robust_design.variables import Variables, separate_widths

COST = "cost"  # term of the objective: the cost of the tolerances
CRITERIA = ("nominal", "worst_case", "rss", "yield")

Bounds = Mapping[str, Sequence[ErrorValue]]
Widths = Mapping[str, ErrorValue | Sequence[ErrorValue]]


@dataclass(frozen=True, eq=False)
class Request:
    """Checked arguments of `optimise`.

    base: errors with fixed values; weights {metric or "cost": weight} of the objective; metric_weights (m,): those of
    the problem's metrics; costs: cost models of the tolerances to be found, in their order.
    """

    problem: ToleranceProblem
    variables: Variables
    base: Base
    weights: dict[str, float]
    metric_weights: Float[np.ndarray, " m"]
    costs: tuple[CostModel, ...]
    limits: tuple[NormalisedLimit, ...]

    @property
    def units(self) -> dict[str, str]:
        """Units of all variables and of errors that scatter."""
        units = {name: self.problem.error_unit(name) for name in self.variables.names}
        return units | dict.fromkeys(self.variables.sizes.zones, "m")


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
) -> Request:
    """Check and normalise a request (arguments of `optimise`). Raises InputError."""
    variables = _variables(problem, designs, tolerances, robust, zones)
    weights = _weights(problem, objective)
    free = [variables.sizes.names[i] for i in variables.free]
    costs: tuple[CostModel, ...] = ()
    if free and cost is None:
        raise InputError(
            f"Argument `cost` must say what tolerances cost, because that of `{free[0]}` is to be found; give for "
            "example Reciprocal(1e-3)."
        )
    if free and cost is not None:
        costs = assign_costs(cost, free)
    if COST in weights and not free:
        raise InputError(
            'Argument `objective` must be a metric, but has "cost", and no tolerance is to be found; give (smallest, '
            "largest) for a tolerance."
        )
    fixed = {name: value for name, value in (at or {}).items() if name not in variables.names}
    if len(fixed) < len(at or {}):
        inside = next(name for name in (at or {}) if name in variables.names)
        raise InputError(f"Argument `at` must hold what does not vary, but `{inside}` does; leave it out.")
    base, _ = split_errors(problem, fixed, variables.names)
    metric_weights = np.array([weights.get(metric.name, 0.0) for metric in problem.metrics])
    return Request(problem, variables, base, weights, metric_weights, costs, _limits(problem, limits))


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
    check_known(designs, problem.error_names, "designs")
    bounds = np.array(
        [_pair(problem.error_unit(name), name, pair, "designs") for name, pair in designs.items()]
    ).reshape(-1, 2)
    widths = dict(tolerances or {}) if not isinstance(tolerances, Tolerances) else tolerances.half_widths()
    if isinstance(tolerances, Tolerances) and tolerances.zones:
        inside = [name for zone in tolerances.zones for name in zone.names]
        widths = {name: width for name, width in widths.items() if name not in inside}
        zones = {}
        for zone in tolerances.zones:
            label, diameter = "+".join(zone.names), 2.0 * float(jnp.max(zone.half_widths()))
            zones[label] = zone.scaled(jnp.full(len(zone.names), 1.0 / diameter))
            widths[label] = diameter
    sizes, read = sizes_of(problem, widths, zones, "tolerances"), {}
    for name in sizes.names:
        width, unit = widths[name], "m" if name in sizes.zones else problem.error_unit(name)
        if isinstance(width, (tuple, list)):
            read[name] = _pair(unit, name, width, "tolerances")
        else:
            read[name] = _number(unit, name, width, "tolerances")
            if not (np.isfinite(read[name]) and read[name] > 0.0):
                raise InputError(
                    f"Argument `tolerances` must have positive half-widths, but `{name}` has {read[name]:g}; leave "
                    "out an error that does not vary."
                )
    if robust != "nominal" and not read:
        raise InputError(
            f'Argument `tolerances` must say what scatters with robust="{robust}", but is empty; give {{error: '
            'half-width}, or robust="nominal".'
        )
    if not designs and not any(isinstance(width, tuple) for width in read.values()):
        raise InputError("Argument `designs` must hold what may change, but neither it nor a tolerance does.")
    return Variables(
        tuple(designs),
        bounds[:, 0],
        bounds[:, 1],
        np.array([nominal_value(problem, name) for name in designs]),
        sizes,
        *separate_widths(read),
    )


def _pair(unit, name, pair, where) -> tuple[float, float]:
    if not isinstance(pair, (tuple, list)) or len(pair) != 2:
        raise InputError(f"Argument `{where}` must give (lowest, highest), but `{name}` has {pair!r}.")
    low, high = (_number(unit, name, end, where) for end in pair)
    return low, high


def _number(unit, name, value, where) -> float:
    """A number in the unit of an error or a parameter, or a string with a unit."""
    return error_value(value, unit, f"`{name}` of `{where}`")


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


def _limits(problem, limits) -> tuple[NormalisedLimit, ...]:
    """Every finite end of a limit, upper before lower; distances are divided by the size of the bound."""
    found = []
    for name, (low, high) in read_limits(limits, tuple(metric.name for metric in problem.metrics)).items():
        position = metric_index(problem, name, "limits")
        for sign, bound in ((1.0, high), (-1.0, low)):
            if np.isfinite(bound):
                unit = problem.metrics[position].unit
                found.append(NormalisedLimit(name, unit, position, sign, bound, abs(bound) or 1.0))
    return tuple(found)
