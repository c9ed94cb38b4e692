"""Calls whose arguments do not fit: what is wrong with their names is said in a sentence, as of values.

Place in the pipeline: errors -> **calls** -> classes and functions that users call with many arguments by name.
"""

import functools
import inspect
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ParamSpec, TypeVar

from rfem_jax.description.basics.errors import InputError, Problems, suggestion

P = ParamSpec("P")
R = TypeVar("R")


def require_arguments(name: str, function: Callable, given: Sequence[Any], named: Mapping[str, Any]) -> None:
    """Raise InputError, with all mistakes at once, for arguments without names where they need one, with names that
    the function does not have, and for missing ones; `self` is among those given."""
    parameters = inspect.signature(function).parameters
    own = [one for one in parameters.values() if one.kind not in (one.VAR_POSITIONAL, one.VAR_KEYWORD)]
    known = [one.name for one in own if one.name != "self"]
    places = [one.name for one in own if one.kind is one.POSITIONAL_OR_KEYWORD]
    problems = Problems()
    with problems.noted():
        if len(given) > len(places):
            raise InputError(
                f"Arguments of {name} must be given by their names, but {_short(given[len(places)])} was given without "
                f"one; give it as one of {', '.join(f'{one}=' for one in known)}."
            )
    for one in named:
        with problems.noted():
            if one not in known:
                raise InputError(
                    f"Argument `{one}` must be left out, but was given to {name}, which does not know it; "
                    f"{suggestion(one, known)}"
                )
    there = {*places[: len(given)], *named}
    all_known = len(given) <= len(places) and set(named) <= set(known)  # else one of them may be what is missing
    for one in own:
        with problems.noted():
            if all_known and one.default is one.empty and one.name not in there:
                raise InputError(
                    f"Argument `{one.name}` of {name} must be given, but is missing; add {one.name}=... to the call."
                )
    problems.refuse()


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) < 60 else f"a {type(value).__name__}"


def with_known_arguments(name: str) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """A function that says by `require_arguments` what is wrong with the names of its arguments."""

    def decorated(function: Callable[P, R]) -> Callable[P, R]:
        signature = inspect.signature(function)

        @functools.wraps(function)
        def called(*given: P.args, **named: P.kwargs) -> R:
            try:
                signature.bind(*given, **named)
            except TypeError:
                require_arguments(name, function, given, named)
                raise
            return function(*given, **named)

        return called

    return decorated
