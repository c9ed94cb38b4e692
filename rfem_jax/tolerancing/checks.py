"""Checks of arguments that all tolerance studies share: names, limits, numbers with units.

Place in the pipeline: the first thing that a study does; refuses bad input before anything is compiled or run.
"""

from collections.abc import Collection, Iterable, Mapping
from typing import Any, SupportsFloat

from rfem_jax.description.basics.errors import InputError, suggestion
from rfem_jax.description.basics.units import DIMENSIONS as ALL_DIMENSIONS
from rfem_jax.description.basics.units import quantity
from rfem_jax.description.tasks.settings import limit_ends

# Dimensions by SI units: angles and lengths of errors first, then those of parameters.
DIMENSIONS = {"rad": "angle", "m": "length"}
DIMENSIONS |= {unit: name for name, (_, unit, _) in reversed(ALL_DIMENSIONS.items()) if unit not in DIMENSIONS}

ErrorValue = SupportsFloat | str  # a number in rad or m, or a string with a unit
ErrorValues = Mapping[str, ErrorValue]  # by the names of the errors


def check_known(names: Iterable[str], known: Collection[str], what: str) -> None:
    """Raise InputError for the first of `names` that is not in `known`, with the nearest known one.

    Args: what, name of the argument that holds them.
    """
    for name in names:
        if name not in known:
            raise InputError(
                f"Argument `{what}` must name what the problem has, but `{name}` is not known; "
                f"{suggestion(name, known)}"
            )


def check_variables(names: Collection[str], problem: Any, what: str) -> None:
    """Raise InputError for the first of `names` that the problem does not know, or that it cannot vary.

    Args: problem, a ToleranceProblem; what, name of the argument that holds them.
    """
    check_known(names, problem.error_names, what)
    require_closable = getattr(problem, "require_closable", None)
    if require_closable is not None:
        require_closable(names, what)


def check_distinct(names: str | Iterable[str], what: str) -> tuple[str, ...]:
    """`names` as a tuple, at least one and none twice. Raises InputError."""
    names = (names,) if isinstance(names, str) else tuple(names)
    if not names:
        raise InputError(f"Argument `{what}` must hold at least one name, but it is empty.")
    repeated = next((name for i, name in enumerate(names) if name in names[:i]), None)
    if repeated is not None:
        raise InputError(f"Argument `{what}` must not repeat a name, but `{repeated}` occurs twice; rename one.")
    return names


def read_limits(limits: Any, metrics: Collection[str], needed: bool = False) -> dict[str, tuple[float, float]]:
    """Limits on metrics as {metric: (low, high)} in the metrics' units; an open end is infinite.

    Args: limits {metric: largest value, or (low, high) with None or an infinite number for an open end}, or None, as
        `limit_ends` reads each; metrics, the names that there are; needed: True if there must be limits.
    Raises: InputError for anything else, for unknown metrics, and where low is not below high.
    """
    if (needed or limits is not None) and (not isinstance(limits, Mapping) or (needed and not limits)):
        raise InputError(
            f"Argument `limits` must map metrics to limits, but it is {limits!r}; "
            'write {"metric": largest} or {"metric": (low, high)}.'
        )
    limits = dict(limits or {})
    check_known(limits, metrics, "limits")
    return {name: limit_ends(name, limit) for name, limit in limits.items()}


def error_value(value: ErrorValue, unit: str, where: str) -> float:
    """A deviation or a half-width in its SI `unit`, from a number in it or a string with a unit ("0.25 deg").

    Raises: InputError for a string that is no such quantity; `where` names it.
    """
    return quantity(value, DIMENSIONS[unit], where) if isinstance(value, str) else float(value)


def parse_error(text: str, where: str) -> tuple[float, str]:
    """Number in SI units, and this unit, of a string such as "0.25 deg" or "0.1 mm".

    Raises: InputError for a string that is no quantity; `where` names it.
    """
    for unit, dimension in DIMENSIONS.items():
        try:
            return quantity(text, dimension, where), unit
        except InputError:
            continue
    raise InputError(
        f"Argument `{where}` must be an angle, a length or another quantity with a unit, but it is {text!r}; "
        'write for example "0.25 deg" or "0.1 mm".'
    )
