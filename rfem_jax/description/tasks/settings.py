"""Settings that several tasks share, and their checks: metrics, limits, starts, numbers.

Place in the pipeline: units, errors -> **settings** -> the tasks.

Metrics are named as `metric_catalogue` says, or "*.KIND" for all joints or links; limits are in the metric's own unit.
"""

from collections.abc import Callable, Collection
from dataclasses import fields
from typing import Any

import numpy as np

from rfem_jax.description.basics.errors import Checks, InputError, Problems, require_choice
from rfem_jax.description.basics.units import DIMENSIONS, Quantity, quantity, short
from rfem_jax.description.metrics.catalogue import kind_and_owner, never_negative, suggested_metric, unit_of

MOST = 10**9  # of whole numbers without a bound of their own
MOST_SAMPLES, MOST_AT_ONCE = 10**8, 10**5
MOST_LIMIT = 1e100
MODES = ("auto", "forward", "reverse")
STARTS = {"corners": 4, "random": 4, "sobol": 8}


def metric_names(names: object) -> tuple[str, ...]:
    """Names of metrics, checked but for their joints. Raises InputError with the nearest name."""
    if isinstance(names, str):
        names = (names,)
    if not isinstance(names, (list, tuple)) or not names:
        raise InputError(
            f"Argument `metrics` must be a list of names, but was {names!r}; "
            'write for example ["D.mean_square_moment"].'
        )
    problems = []
    for name in names:
        kind, owner = kind_and_owner(name) if isinstance(name, str) else (None, "")
        if kind is not None:
            continue
        fix = suggested_metric(str(name), owner or "*")
        problems.append(f"Argument `metrics` must hold names of metrics, but {name!r} is not a metric; {fix}")
    if problems:
        raise InputError(*problems)
    return tuple(dict.fromkeys(names))


def limits_of(limits: object, needed: bool = False) -> dict[str, tuple[float, float]]:
    """{metric: (low, high)}, open ends infinite, from {metric: high, or (low, high)}."""
    if not isinstance(limits, dict) or (needed and not limits):
        raise InputError(
            f"Argument `limits` must be a table of metrics and their limits, but was {limits!r}; "
            'write for example { "D.mean_square_moment" = 20.0 }.'
        )
    problems, complete = Problems(), {}
    if limits:
        with problems.noted():
            metric_names(tuple(limits))
    for name, limit in limits.items():
        if not isinstance(name, str) or kind_and_owner(name)[0] is None:
            continue  # nor is the unit of its limits known
        with problems.noted():
            complete[name] = limit_ends(name, limit)
    problems.refuse()
    return complete


def limit_ends(name: Any, limit: Any) -> tuple[float, float]:
    """(low, high) of a limit on a metric, open ends infinite: of a largest value, or of a pair, in which None is an
    open end, too; numbers in the metric's unit, or strings with a unit. Raises InputError."""
    pair = tuple(limit) if isinstance(limit, (list, tuple)) else (float("-inf"), limit)
    if isinstance(limit, (list, tuple)) and len(pair) == 2:
        pair = tuple(end if given is None else given for given, end in zip(pair, (float("-inf"), float("inf"))))
    pair = tuple(_in_metrics_unit(name, end) if isinstance(end, str) else end for end in pair)
    plain = all(isinstance(end, (int, float, np.integer, np.floating)) and not isinstance(end, bool) for end in pair)
    plain = plain and all(abs(end) < MOST_LIMIT or end in (float("inf"), float("-inf")) for end in pair)
    if len(pair) != 2 or not plain or not pair[0] < pair[1]:
        raise InputError(
            f"Argument `limits` must give a largest value or [low, high], but `{name}` has "
            f"{short(repr(limit))}; write a number in the metric's unit (inf and -inf are open ends), or a string with "
            'a unit for an angle, a length, a force or the like, as "30 deg".'
        )
    if isinstance(name, str) and never_negative(name) and pair[1] <= 0.0:
        raise InputError(
            f"Argument `limits` must allow a load, which is never negative, but `{name}` has "
            f"{limit!r}; write its largest value as a positive number."
        )
    return float(pair[0]), float(pair[1])


def _in_metrics_unit(name: Any, limit: str) -> Any:
    """A string with a unit as a number in the metric's unit, if that is a dimension of its own; else the string."""
    unit = unit_of(name) if isinstance(name, str) else None
    dimension = _DIMENSIONS.get(unit) if unit else None
    return limit if dimension is None else quantity(limit, dimension, f"`limits` of `{name}`")


_DIMENSIONS = {DIMENSIONS[name][1]: name for name in ("angle", "length", "force", "moment", "mass", "pressure", "time")}


def starts_of(starts: object) -> dict[str, int]:
    """Numbers of starts by kind; kinds that are missing are 0. Raises InputError."""
    if not isinstance(starts, dict):
        raise InputError(
            f"Argument `starts` must be a table of numbers, but was {starts!r}; "
            "write { corners = 4, random = 4, sobol = 8 }."
        )
    problems = Problems()
    for name, count in starts.items():
        with problems.noted():
            require_choice(name, tuple(STARTS), "starts")
            whole_number(count, f"starts.{name}", 0)
    problems.refuse()
    if not any(starts.values()):
        raise InputError(
            "Argument `starts` must ask for at least one search, but asks for none; write { corners = 4 }."
        )
    return {name: starts.get(name, 0) for name in STARTS}


def whole_number(value: object, where: str, least: int, most: int = MOST) -> int:
    """`value` if it is a whole number from `least` to `most`. Raises InputError."""
    if isinstance(value, bool) or not isinstance(value, int) or value < least:
        raise InputError(
            f"Argument `{where}` must be a whole number of at least {least}, but was {value!r}; correct it."
        )
    if value > most:
        raise InputError(
            f"Argument `{where}` must be at most {most}, but was {short(value)}; this would not end, or not fit "
            "into memory: reduce it."
        )
    return value


def fraction(value: Quantity, where: str) -> float:
    """A number between 0 and 1. Raises InputError."""
    number = quantity(value, "none", where)
    if not 0.0 < number < 1.0:
        raise InputError(f"Argument `{where}` must lie between 0 and 1, but was {value!r}; 0.95 is usual.")
    return number


def fractions(values: object, where: str) -> tuple[float, ...]:
    """Numbers between 0 and 1. Raises InputError."""
    if not isinstance(values, (list, tuple)):
        raise InputError(
            f"Argument `{where}` must be a list of fractions, but was {values!r}; write [0.05, 0.5, 0.95]."
        )
    return tuple(fraction(one, where) for one in values)


def convert_all(checks: Checks, names: Collection[str], convert: Callable[..., object], *arguments: object) -> None:
    """Convert fields of a dataclass by convert(value, name, *arguments); None stays where it is the default."""
    may_be_none = {one.name for one in fields(checks.owner) if one.default is None}
    for name in names:
        if getattr(checks.owner, name) is not None or name not in may_be_none:
            checks.convert(name, convert, name, *arguments)


def set_fields(task: object, **values: object) -> None:
    """Set fields of a frozen task."""
    for name, value in values.items():
        object.__setattr__(task, name, value)
