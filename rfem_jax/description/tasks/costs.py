"""Bounds and costs of tolerances that are to be found: the tables [NAME.bounds] and [NAME.cost] of a task.

Both may name zones of drawings beside errors ("D.coaxiality"); the tolerance t of a zone is its diameter.

Place in the pipeline: tolerances, units -> **costs** -> allocation, optimise. Both tables are by error, and a cost may
be given once for all of them.

Symbols: bounds and `at` in m and rad, or strings with a unit.
"""

from collections.abc import Collection
from dataclasses import dataclass, replace
from typing import Any, ClassVar

from rfem_jax.description.basics.errors import (
    ABSENT,
    Checks,
    ChecksItself,
    InputError,
    Problems,
    located,
    nearest,
    require_choice,
)
from rfem_jax.description.basics.tables import build, checked_table, keys_of
from rfem_jax.description.basics.units import DERIVED, positive_quantity, quantity
from rfem_jax.description.tasks.settings import MODES, convert_all, fraction, limits_of, set_fields, whole_number
from rfem_jax.description.tasks.task import Task
from rfem_jax.description.tolerances.error_catalogue import (
    JOINT_ERRORS,
    LINK_ERRORS,
    error_dimension,
    knows_dimension,
    parameters_being_read,
)
from rfem_jax.description.tolerances.tolerances import SpecifiedTolerances
from rfem_jax.description.tolerances.zones import CHARACTERISTICS, OF_DIRECTION, SpecifiedZone, is_zone

COST_MODELS = ("reciprocal", "reciprocal_squared", "exponential")


@dataclass(frozen=True)
class ErrorCost(ChecksItself):
    """What a tolerance t of one error, or of a zone, costs.

    Args:
        model: "reciprocal" fixed + price at/t, "reciprocal_squared" fixed + price (at/t)^2, or
            "exponential" fixed + price exp(-t/at).
        price: in any currency, > 0.
        at: scale of t [rad or m]; None = its largest bound (in a study file: its value in [tolerances], where it
            has one).
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


class FoundTolerancesTask(Task):
    """A task that finds tolerances between bounds, at their cost, so that limits hold: what these have in common."""

    needs_tolerances: ClassVar[bool] = False

    limits: dict[str, tuple[float, float]]
    bounds: dict[str, tuple[float, float]]
    costs: dict[str, ErrorCost]
    zones: tuple[SpecifiedZone, ...]

    def _check_search(self, checks: Checks, needed: bool) -> None:
        """Check the settings that such tasks share; `needed`, whether there must be limits and bounds."""
        known = ("uniform", "triangular", "normal", "truncated_normal")
        checks.convert("distribution", require_choice, known, "distribution")
        checks.convert("mode", require_choice, MODES, "mode")
        convert_all(checks, ("seed",), whole_number, 0)
        convert_all(checks, ("target",), fraction)
        checks.convert("coverage", positive_quantity, "none", "coverage")
        checks.convert("limits", limits_of, needed)
        if needed or self.bounds:
            checks.convert("bounds", half_width_bounds)
        checks.relation(("bounds", "costs"), self._complete_costs)
        checks.relation(("bounds", "zones"), self._complete_zones)

    def _complete_costs(self) -> None:
        """Give all errors with bounds a cost, whose scale is the largest bound where none is given."""
        missing = [name for name in self.bounds if name not in self.costs]
        if missing:
            raise InputError(
                "Argument `costs` must have a cost for every error with bounds, but that of "
                f"`{missing[0]}` is missing; add it."
            )
        unscaled = {name: self.costs[name] for name in self.bounds if self.costs[name].at is None}
        scaled = {name: replace(one, at=self.bounds[name][1]) for name, one in unscaled.items()}
        set_fields(self, costs=self.costs | scaled)

    def _complete_zones(self) -> None:
        """Take the zones among the bounds, with the shapes that [tolerances] gives them; others are discs (position,
        coaxiality). Raises: InputError for zones that need a length."""
        known, problems = {zone.name: zone for zone in self.zones}, Problems()
        found = []
        for name, (_, largest) in self.bounds.items():
            if not is_zone(name):
                continue
            with problems.noted():
                if name not in known and str(name).rpartition(".")[2] in OF_DIRECTION:
                    raise InputError(
                        f"Argument `bounds` must name zones whose length is known, but `{name}` is not in "
                        f'[tolerances]; add "{name}" = {{ diameter = "0.1 mm", length = "20 mm" }} there.'
                    )
                found.append(known.get(name) or SpecifiedZone(name, largest))
        problems.refuse()
        set_fields(self, zones=tuple(found))

    @classmethod
    def tables(cls, header: str) -> list[tuple[str, type, Collection[str], Collection[str]]]:
        """As `Task.tables`, with that of the costs."""
        required, optional = keys_of(cls, omit=("costs", "zones"))
        return [
            (header, cls, required, ("cost", *optional)),
            (f"{header.removesuffix(']')}.cost]", ErrorCost, *keys_of(ErrorCost)),
        ]

    @classmethod
    def read(cls, table: object, place: str, tolerances: SpecifiedTolerances | None) -> Any:
        """As `Task.read`; the table `cost` becomes its `costs`, whose scales are the tolerances of the study."""
        (_, _, required, optional), (of_costs, *_) = cls.tables(place)
        problems = Problems()
        settings = checked_table(table, place, required, optional, problems)
        bounds, cost = settings.get("bounds", {}), settings.pop("cost", {})
        if not isinstance(bounds, dict) or not bounds:  # then any error may have a cost
            bounds = {name: None for name in cost if "." in name} if isinstance(cost, dict) else {}
        widths = {} if tolerances is None else tolerances.sizes()
        if tolerances is not None and isinstance(bounds, dict):
            settings["zones"] = tuple(zone for zone in tolerances.zones if zone.name in bounds)
        costs = problems.attempt(_read_costs, of_costs, cost, bounds, widths)
        return build(cls, {"costs": costs, **settings}, place, problems)


def size_dimension(name: object) -> str:
    """Dimension of the tolerance of an error or a parameter, or of the diameter of a zone. Raises: InputError."""
    if is_zone(name):
        return "length"
    try:
        return error_dimension(name)
    except InputError as error:
        if not error.problems:  # of a mechanism that could not be read
            raise
        owner, _, component = str(name).partition(".")
        close = nearest(component, (*JOINT_ERRORS, *LINK_ERRORS, *CHARACTERISTICS)) if component else None
        near = f"{owner}.{close}" if close else nearest(name, parameters_being_read())
        told = f"did you mean `{near}`?" if near else 'write for example "D.delta_x", "D.coaxiality" or "bar.height".'
        raise InputError(
            f"Argument `bounds` must name errors, zones of drawings or parameters, but `{name}` is none of these; "
            f"{told}"
        ) from None


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
            if all(isinstance(end, float) for end in ends) and not (is_zone(name) or knows_dimension(name)):
                low, high = ends  # of a parameter, read before
            else:
                dimension = size_dimension(name)
                low, high = (quantity(end, dimension, f"`{name}` of `bounds`") for end in ends)
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
    checked = checked_table(table, place, (), (*common, *bounds), problems)
    shared = {key: value for key, value in checked.items() if key in common}
    costs = {}
    for name, pair in bounds.items():
        if not _has_dimension(name):
            continue  # refused in `bounds`
        with problems.noted():
            own = checked.get(name, {})
            if own is not ABSENT:
                default = widths.get(name, pair[-1] if isinstance(pair, list) and pair else 1.0)
                costs[name] = _read_cost(place, name, own, shared, default)
    problems.refuse()
    return costs


def _has_dimension(name: object) -> bool:
    try:
        return bool(size_dimension(name))
    except InputError:
        return False


def _read_cost(place: str, name: str, table: object, shared: dict[str, Any], default: Any) -> ErrorCost:
    """The cost of one error; `default` is its scale where its table has none."""
    problems = Problems()
    own = checked_table(table, f"{place} `{name}`", *keys_of(ErrorCost), problems)
    at = own.get("at", default)
    with problems.noted(), located(place):
        try:
            dimension = size_dimension(name)
            if "at" not in own:
                at = positive_quantity(at, dimension, f"`{name}`")
        except InputError:
            raise InputError() from None  # told of the bounds
        if at is not ABSENT:
            at = positive_quantity(at, dimension, f"`at` of the cost of `{name}`")
    return build(ErrorCost, {**shared, **own, "at": at}, place, problems)
