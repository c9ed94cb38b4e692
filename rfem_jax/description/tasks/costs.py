"""Bounds and costs of tolerances that are to be found: the tables [NAME.bounds] and [NAME.cost] of a task.

Place in the pipeline: tolerances, units -> **costs** -> allocation, optimise. Both tables are by error, and a cost may
be given once for all of them.

Symbols: bounds and `at` in m and rad, or strings with a unit.
"""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from typing import Any

from rfem_jax.description.error_catalogue import error_dimension
from rfem_jax.description.errors import ABSENT, Checks, ChecksItself, InputError, Problems, located, require_choice
from rfem_jax.description.tables import build, checked_table, keys_of
from rfem_jax.description.tolerances import SpecifiedTolerances, error_quantities
from rfem_jax.description.units import DERIVED, positive_quantity, quantity

COST_MODELS = ("reciprocal", "reciprocal_squared", "exponential")


@dataclass(frozen=True)
class ErrorCost(ChecksItself):
    """What a tolerance t of one error costs.

    Args:
        model: "reciprocal" fixed + price at/t, "reciprocal_squared" fixed + price (at/t)^2, or
            "exponential" fixed + price exp(-t/at).
        price: in any currency, > 0.
        at: scale of the half-width t [rad or m]; None = the largest bound of the error (in a study file: its
            tolerance, where it has one).
        fixed: in the same currency.
    """

    model: str = "reciprocal"
    price: float = 1.0
    at: float = DERIVED
    fixed: float = 0.0

    def _check_fields(self, checks: Checks) -> None:
        checks.convert("model", require_choice, COST_MODELS, "`model` of a cost")
        checks.convert("price", positive_quantity, "none", "`price` of a cost")
        checks.convert("fixed", quantity, "none", "`fixed` of a cost")


def complete_costs(bounds: Mapping[str, tuple[float, float]], costs: Mapping[str, ErrorCost]) -> dict[str, ErrorCost]:
    """The costs of all errors with bounds, whose scale is the largest bound where none is given.

    Raises: InputError for an error with bounds and without a cost.
    """
    missing = [name for name in bounds if name not in costs]
    if missing:
        raise InputError(
            f"Argument `costs` must have a cost for every error with bounds, but `{missing[0]}` has none; add it."
        )
    given = {name: costs[name] for name in bounds}
    return dict(costs) | {name: replace(one, at=bounds[name][1]) for name, one in given.items() if one.at is None}


def read_with_costs(
    cls: type,
    keys: tuple[Collection[str], Collection[str]],
    table: object,
    place: str,
    tolerances: SpecifiedTolerances | None,
) -> Any:
    """The task of class `cls` from its `table` with `keys` (required, optional), whose table `cost` becomes its
    `costs`; the tolerances of the study serve as their scales. Raises: InputError."""
    problems = Problems()
    settings = problems.usable(lambda: dict(checked_table(table, place, *keys)))
    bounds, cost = settings.get("bounds", {}), settings.pop("cost", {})
    if not isinstance(bounds, dict) or not bounds:  # then any error may have a cost
        bounds = {name: None for name in cost if "." in name} if isinstance(cost, dict) else {}
    widths = {} if tolerances is None else tolerances.half_widths()
    costs: Any = ABSENT
    if cost is not ABSENT:
        with problems.noted():
            costs = _read_costs(f"{place.removesuffix(']')}.cost]", cost, bounds, widths)
    return build(cls, {"costs": costs, **settings}, place, problems)


def half_width_bounds(bounds: object) -> dict[str, tuple[float, float]]:
    if not isinstance(bounds, dict) or not bounds:
        raise InputError(
            f"Argument `bounds` must be a table of errors and their smallest and largest "
            f'half-width, but was {bounds!r}; write {{ "D.delta_x" = ["0.05 deg", "1 deg"] }}.'
        )
    complete, problems = {}, Problems()
    for name, pair in bounds.items():
        with problems.noted():
            ends = pair if isinstance(pair, (list, tuple)) and len(pair) == 2 else (0.0, 0.0)
            low, high = (error_quantities({name: end}, "bounds")[name] for end in ends)
            if not 0.0 < low < high:
                raise InputError(
                    f"Argument `bounds` must give [smallest, largest] half-widths above 0, but "
                    f'`{name}` has {pair!r}; write for example ["0.05 deg", "1 deg"].'
                )
            complete[name] = (low, high)
    problems.refuse()
    return complete


def _read_costs(place: str, table: object, bounds: dict[str, Any], widths: dict[str, float]) -> dict[str, ErrorCost]:
    """The cost of every error of `bounds`; keys that are no errors are the same for all.

    `at` that is not given is the error's tolerance in [tolerances], else its largest bound.
    """
    required, optional = keys_of(ErrorCost)
    common = tuple(key for key in (*required, *optional) if key != "at")
    problems = Problems()
    checked = problems.usable(lambda: checked_table(table, place, optional=(*common, *bounds)))
    shared = {key: value for key, value in checked.items() if key in common}
    costs = {}
    for name, pair in bounds.items():
        with problems.noted():
            own = checked.get(name, {})
            if own is not ABSENT:
                default = widths.get(name, pair[-1] if isinstance(pair, list) and pair else 1.0)
                costs[name] = _read_cost(place, name, own, shared, default)
    problems.refuse()
    return costs


def _read_cost(place: str, name: str, table: object, shared: dict[str, Any], default: Any) -> ErrorCost:
    """The cost of one error; `default` is its scale where its table has none."""
    problems = Problems()
    own = problems.usable(lambda: checked_table(table, f"{place} `{name}`", *keys_of(ErrorCost)))
    at = own.get("at", default)
    with problems.noted(), located(place):
        try:
            dimension = error_dimension(name)
            if "at" not in own:
                at = positive_quantity(at, dimension, f"`{name}`")
        except InputError:
            raise InputError() from None  # told of the bounds
        if at is not ABSENT:
            at = positive_quantity(at, dimension, f"`at` of the cost of `{name}`")
    return build(ErrorCost, {**shared, **own, "at": at}, place, problems)
