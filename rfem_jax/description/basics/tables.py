"""Tables of a study file: the keys they may and must have.

Place in the pipeline: `study_reader` and `study` read every table of the TOML through here, so that
no key is ever ignored.
"""

import inspect
import re
import tomllib
from collections.abc import Callable, Collection, Iterable, Mapping
from pathlib import Path
from typing import Any, TypeVar

from rfem_jax.description.basics.errors import (
    ABSENT,
    ChecksItself,
    InputError,
    Problems,
    located,
    nearest,
    require_choice,
    suggestion,
)

Part = TypeVar("Part")

DEEPEST = 50  # tables and lists within each other; studies have less than ten


def read_toml(path: Path) -> dict[str, Any]:
    """Return the content of the TOML file `path`.

    Raises:
        InputError: the file is missing, unreadable, or no valid TOML (with line and column).
    """
    try:
        text = path.read_text(encoding="utf-8-sig")  # some editors begin with a mark
    except FileNotFoundError:
        raise InputError(
            f"Argument `path` must be a study file, but there is no file `{path}`; correct the path."
        ) from None
    except OSError as error:
        raise InputError(
            f"Argument `path` must be a readable file, but `{path}` is not ({error.strerror}); "
            "give the path of a study file in TOML."
        ) from None
    except UnicodeDecodeError as error:
        raise InputError(
            f"Study file `{path}` must be UTF-8 text, but byte {error.start} is not; save it again as UTF-8."
        ) from None
    if re.search(r"\b0[xob][0-9A-Fa-f_]{1000}", text):  # Python does not print what it reads so
        raise InputError(
            f"Study file `{path}` must have numbers that fit into double precision, but has one of more than a "
            "thousand digits; correct it."
        )
    nested = InputError(
        f"Study file `{path}` must nest brackets and dotted names a few levels deep, but nests more than "
        f"{DEEPEST}; close brackets earlier, or shorten the name."
    )
    try:
        content = tomllib.loads(text)
    except RecursionError:
        raise nested from None
    except ValueError as error:  # of TOML, or a number of thousands of digits
        raise InputError(
            f"Study file `{path}` must be valid TOML, but: {error}; correct this line (strings and "
            "numbers with units stand in quotes)."
        ) from None
    if not _is_shallow(content):
        raise nested
    return content


def _is_shallow(content: dict[str, Any]) -> bool:
    """Whether tables and lists are nested so few times that they can be compared and printed."""
    level: list[Any] = [content]
    for _ in range(DEEPEST):
        inner = [one.values() if isinstance(one, dict) else one for one in level]
        level = [entry for entries in inner for entry in entries if isinstance(entry, (dict, list))]
        if not level:
            return True
    return False


def keys_of(kind: Callable[..., Any], omit: Collection[str] = ()) -> tuple[list[str], list[str]]:
    """Names of the required and the optional arguments of a class, which are the keys of its table."""
    arguments = [one for name, one in inspect.signature(kind).parameters.items() if name not in omit]
    required = [one.name for one in arguments if one.default is one.empty]
    return required, [one.name for one in arguments if one.default is not one.empty]


def keys_of_all(kinds: Iterable[Callable[..., Any]], omit: Collection[str] = ()) -> list[str]:
    """Names of all arguments of several classes."""
    return sorted({key for kind in kinds for keys in keys_of(kind, omit) for key in keys})


def require_table(data: object, place: str) -> dict[str, Any]:
    """Return `data` if it is a table; `place` is its header, such as "[simulation]"."""
    if data is ABSENT:
        raise InputError()  # its name is misspelt, which is told
    if not isinstance(data, dict):
        raise InputError(f"{place} must be a table, but was {data!r}; write it as {place}.")
    return data


def checked_table(
    data: object, place: str, required: Collection[str], optional: Collection[str], problems: Problems
) -> dict[str, Any]:
    """Return what stands in a table under known keys, and ABSENT under those that are missing or misspelt.

    Args:
        data: what stands in the file.
        place: the table's header, for the message, such as "[simulation]".
        required, optional: the known keys.
        problems: where keys are noted that are unknown (with the nearest known one) or missing.
    Raises:
        InputError: not a table, or one without any known key, of which nothing else is told.
    """
    table, known = require_table(data, place), (*required, *optional)
    if not table and len(required) > 1:
        listed = ", ".join(f"`{key}`" for key in required)
        raise InputError(f"{place} must have the keys {listed}, but is empty; add them there.")
    unknown = [key for key in table if key not in known]
    wrong = [f"{place} must have known keys only, but has `{key}`; {suggestion(key, known)}" for key in unknown]
    meant = [nearest(key, known) for key in unknown]
    if required and len(unknown) == len(table) and not any(meant):
        raise InputError(*wrong)
    problems.found += wrong
    problems.found += [
        f"{place} must have the key `{key}`, but it is missing; add `{key}` there."
        for key in required
        if key not in table and key not in meant
    ]
    absent = [key for key in known if key not in table and (key in required or key in meant)]
    return {key: value for key, value in table.items() if key in known} | dict.fromkeys(absent, ABSENT)


def build(kind: Callable[..., Part], settings: dict[str, Any], place: str, problems: Problems) -> Part:
    """Return kind(**settings), checked even where it cannot be made.

    Args:
        kind: a class that tells all its mistakes.
        settings: its arguments, ABSENT those that cannot be read.
        place: the table's header.
        problems: what is known to be wrong with the table.
    Raises:
        InputError: with `problems` and everything that is wrong with the arguments.
    """
    own = getattr(kind, "__post_init__", ChecksItself.__post_init__) is not ChecksItself.__post_init__
    made = None
    if not (own and any(value is ABSENT for value in settings.values())):  # checks of its own do not know ABSENT
        with problems.noted(), located(place):
            made = kind(**settings)
    problems.refuse()
    if made is None:
        raise InputError()  # nothing to add: what is wrong is told elsewhere
    return made


def read_table(kind: Callable[..., Part], table: object, place: str, **given: Any) -> Part:
    """Return the object of a class that a table describes, whose keys are the arguments beside those `given`.

    Raises: InputError with everything that is wrong with the table.
    """
    problems = Problems()
    settings = checked_table(table, place, *keys_of(kind, omit=given), problems)
    return build(kind, {**settings, **given}, place, problems)


def checked_list(data: object, place: str) -> list[dict[str, Any]]:
    """Return `data` if it is a list of tables; `place` is its header, such as "[[cases]]"."""
    if data is ABSENT:
        raise InputError()  # as above
    if not isinstance(data, list) or any(not isinstance(entry, dict) for entry in data):
        raise InputError(
            f"{place} must be a list of tables, but was {data!r}; start each with {place} in double brackets."
        )
    return data


def named_place(header: str, entry: dict[str, Any], number: int) -> str:
    """Return the header of one table of a list with its name, or its number without one."""
    name = entry.get("name")
    return f"{header} `{name}`" if isinstance(name, str) else f"{header} number {number}"


def build_of_kind(
    content: dict[str, Any],
    key: str,
    kinds: Mapping[str, Callable[..., Part]],
    keys: Callable[[str], tuple[list[str], list[str]]],
    place: str,
    problems: Problems,
    **given: Any,
) -> Part:
    """Return the object of a table whose class is chosen by one of its keys.

    Args:
        content: what stands under keys of all kinds, ABSENT what is misspelt or missing.
        key: content[key] is the name of a kind, without which the other keys cannot be judged.
        kinds: {name: class}.
        keys: gives the required and the optional keys of a kind.
        place: the table's header.
        problems: what is known to be wrong with the table.
        given: further arguments of the class.
    Raises: InputError with `problems` and everything else that is wrong.
    """
    kind = ABSENT
    if content[key] is not ABSENT:
        with problems.noted(), located(place):
            kind = require_choice(content[key], tuple(kinds), key)
    if kind is ABSENT:
        problems.refuse()
    settings = keys_of_kind(content, f'{place} of {key} "{kind}"', *keys(kind), problems)
    settings = {name: value for name, value in settings.items() if name != key}
    return build(kinds[kind], {**settings, **given}, place, problems)


def keys_of_kind(
    content: dict[str, Any], place: str, required: Collection[str], optional: Collection[str], problems: Problems
) -> dict[str, Any]:
    """Return the keys that the kind of a table has, of one with the keys of all kinds; note those that it has not."""
    known = (*required, *optional)
    written = {name: value for name, value in content.items() if value is not ABSENT or name in known}
    return checked_table(written, place, required, optional, problems)


def read_list(entries: object, header: str, read: Callable[..., Part], *known: Any) -> list[Part]:
    """Return what read(table, place, *known) makes of the tables [[header]]; raise InputError with all mistakes."""
    problems = Problems()
    tables = enumerate(checked_list(entries, header), start=1)
    found = [problems.attempt(read, table, named_place(header, table, number), *known) for number, table in tables]
    problems.refuse()
    return found
