"""The design of a study: other values for numbers of its mechanism and drives, or bounds of them; the table [design].

Place in the pipeline: parameters, numbers_by_name -> **design_table** -> study.
"""

from collections.abc import Sequence
from typing import Any

from rfem_jax.description.basics.errors import InputError, Problems, suggestion
from rfem_jax.description.drives.driven_motions import AnyDrive
from rfem_jax.description.drives.numbers_by_name import drive_number_names, read_drive_number
from rfem_jax.description.mechanism.mechanism import Mechanism
from rfem_jax.description.parameters.parameters import parameters_of


def read_design(
    table: object, mechanism: Mechanism, drives: Sequence[AnyDrive], labels: Sequence[str]
) -> dict[str, float | tuple[float, float]]:
    """Values, and pairs of bounds, [SI units] of a table {parameter: value, or [lowest, highest]}.

    Args: drives of the study, labels of the motions that they act on.
    Raises: InputError for unknown names, and numbers of the wrong dimension, sign or order.
    """
    if not isinstance(table, dict):
        raise InputError(
            f"Argument `design` must be a table of parameters and values, but was {table!r}; write for example "
            '{ "bar.height" = "8 mm" }.'
        )
    found, problems = {}, Problems()
    for given, value in table.items():
        with problems.noted():
            name = _name(given, mechanism, drives, labels)
            if name in found:
                raise InputError(
                    f"Argument `design` must name each number once, but names `{name}` twice; leave one out."
                )
            if not isinstance(value, (list, tuple)):
                found[name] = _number(name, value, mechanism, drives, labels)
                continue
            ends = [_number(name, end, mechanism, drives, labels) for end in value]
            if len(ends) != 2 or not ends[0] < ends[1]:
                raise InputError(
                    f"Argument `{name}` of the design must be a value or [lowest, highest], but was {value!r}; correct "
                    "it."
                )
            found[name] = (ends[0], ends[1])
    problems.refuse()
    return found


def _name(name: str, mechanism: Mechanism, drives: Sequence[AnyDrive], labels: Sequence[str]) -> str:
    """The shorter one of the names of a number."""
    numbers = drive_number_names(drives, labels)
    if name in numbers:
        return min((one for one, number in numbers.items() if number == numbers[name]), key=len)
    known = parameters_of(mechanism)
    if name.startswith("drive.") and name not in known and numbers:
        raise InputError(
            f"Argument `design` must name numbers of the drives, but they have no `{name}`; {suggestion(name, numbers)}"
        )
    return known.find(name, "design").name


def _number(name: str, value: Any, mechanism: Mechanism, drives: Sequence[AnyDrive], labels: Sequence[str]) -> float:
    where = f"`{name}` of the design"
    if name in drive_number_names(drives, labels):
        return read_drive_number(name, value, where, labels)
    return parameters_of(mechanism).find(name, "design").read(value, where)
