"""From the tables of a study file to its tasks: [tolerances], [sensitivity], [monte_carlo],
[worst_case], [allocation].

Place in the pipeline: called by `study.load_study`. Keys are the names of the arguments of the
classes in `tasks`, `allocation_task` and `tolerances`; in [allocation] the tables [allocation.bounds] and
[allocation.cost] are by error, and a cost may be stated once for all of them.
"""

from dataclasses import MISSING, fields

from rfem_jax.description.allocation_task import AllocationTask, ErrorCost
from rfem_jax.description.error_catalogue import error_dimension
from rfem_jax.description.errors import located
from rfem_jax.description.tables import checked_list, checked_table
from rfem_jax.description.tasks import MonteCarloTask, SensitivityTask, Tasks, WorstCaseTask
from rfem_jax.description.tolerances import (
    CorrelatedTolerances,
    SpecifiedTolerance,
    SpecifiedTolerances,
)
from rfem_jax.description.units import positive_quantity

TABLES = ("tolerances", "sensitivity", "monte_carlo", "worst_case", "allocation")
_PLAIN = {
    "sensitivity": SensitivityTask,
    "monte_carlo": MonteCarloTask,
    "worst_case": WorstCaseTask,
}


def read_tasks(content: dict) -> Tasks:
    """Return the Tasks of a study file's content; tables that are missing give no task.

    Raises: InputError, with the table's name, for unknown keys and bad values.
    """
    found = {}
    if "tolerances" in content:
        found["tolerances"] = _read_tolerances(content["tolerances"])
    for name, kind in _PLAIN.items():
        if name in content:
            place = f"[{name}]"
            table = checked_table(content[name], place, *_keys(kind))
            with located(place):
                found[name] = kind(**table)
    if "allocation" in content:
        specified = found.get("tolerances")
        widths = {} if specified is None else specified.half_widths()
        found["allocation"] = _read_allocation(content["allocation"], widths)
    return Tasks(**found)


def _keys(kind, omit=()):
    """Names of the required and of the optional arguments of a dataclass."""
    named = [one for one in fields(kind) if one.name not in omit]
    needed = [one.name for one in named if one.default is MISSING and one.default_factory is MISSING]
    return needed, [one.name for one in named if one.name not in needed]


def _read_tolerances(table) -> SpecifiedTolerances:
    place = "[tolerances]"
    checked_table(table, place, optional=table if isinstance(table, dict) else ())
    alone = []
    for error, entry in table.items():
        if error == "correlated":
            continue
        if not isinstance(entry, dict):
            entry = {"half_width": entry}
        with located(place):
            error_dimension(error)
        settings = checked_table(entry, f"{place} `{error}`", *_keys(SpecifiedTolerance, ("error",)))
        with located(place):
            alone.append(SpecifiedTolerance(error, **settings))
    header, groups = "[[tolerances.correlated]]", []
    for entry in checked_list(table.get("correlated", []), header):
        settings = checked_table(entry, header, *_keys(CorrelatedTolerances))
        with located(header):
            groups.append(CorrelatedTolerances(**settings))
    with located(place):
        return SpecifiedTolerances(tuple(alone), tuple(groups))


def _read_allocation(table, widths) -> AllocationTask:
    place = "[allocation]"
    required, optional = _keys(AllocationTask, omit=("costs",))
    table = checked_table(table, place, required, ("cost", *optional))
    settings = {name: value for name, value in table.items() if name != "cost"}
    bounds = settings["bounds"] if isinstance(settings["bounds"], dict) else {}
    costs = _read_costs(table.get("cost", {}), bounds, widths)
    with located(place):
        return AllocationTask(costs=costs, **settings)


def _read_costs(table, bounds, widths) -> dict[str, ErrorCost]:
    """The cost of every error of `bounds`; keys that are no errors are the same for all.

    `at` that is not stated is the error's tolerance in [tolerances], else its largest bound.
    """
    place = "[allocation.cost]"
    required, optional = _keys(ErrorCost)
    common = tuple(key for key in (*required, *optional) if key != "at")
    checked_table(table, place, optional=(*common, *bounds))
    shared = {key: value for key, value in table.items() if key in common}
    costs = {}
    for name in bounds:
        own = checked_table(table.get(name, {}), f"{place} `{name}`", required, optional)
        with located(place):
            dimension = error_dimension(name)
            pair = bounds[name] if isinstance(bounds[name], list) and bounds[name] else [1.0]
            at = own.get("at", widths.get(name, pair[-1]))
            at = positive_quantity(at, dimension, f"`at` of the cost of `{name}`")
            costs[name] = ErrorCost(**{**shared, **own, "at": at})
    return costs
