"""Tables of a study file: the keys they may and must have.

Place in the pipeline: `study_reader` and `study` read every table of the TOML through here, so that
no key is ever ignored.
"""

import re
import tomllib
from collections.abc import Callable, Collection, Mapping
from dataclasses import MISSING, fields
from pathlib import Path
from typing import Any, TypeVar

from rfem_jax.description.basics.errors import (
    ABSENT,
    ChecksItself,
    InputError,
    Problems,
    WrongKeys,
    WrongSetting,
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


def keys_of(kind: type, omit: Collection[str] = ()) -> tuple[list[str], list[str]]:
    """Names of the required and the optional arguments of a dataclass, which are the keys of its table."""
    named = [one for one in fields(kind) if one.init and one.name not in omit]
    required = [one.name for one in named if one.default is MISSING and one.default_factory is MISSING]
    return required, [one.name for one in named if one.name not in required]


def checked_table(
    data: object, place: str, required: Collection[str] = (), optional: Collection[str] = ()
) -> dict[str, Any]:
    """Return `data` if it is a table with all `required` and no other than `optional` keys.

    Args:
        data: what stands in the file.
        place: the table's header, for the message, such as "[simulation]".
    Raises:
        InputError: not a table, or one without any known key, of which nothing else is told.
        WrongKeys: an unknown key (with the nearest known one), a missing key.
    """
    if data is ABSENT:
        raise InputError()  # its name is misspelt, which is told
    if not isinstance(data, dict):
        raise InputError(f"{place} must be a table, but was {data!r}; write it as {place}.")
    known = (*required, *optional)
    if not data and len(required) > 1:
        listed = ", ".join(f"`{key}`" for key in required)
        raise InputError(f"{place} must have the keys {listed}, but is empty; add them there.")
    unknown = [key for key in data if key not in known]
    problems = [f"{place} must have known keys only, but has `{key}`; {suggestion(key, known)}" for key in unknown]
    meant = [nearest(key, known) for key in unknown]
    if required and len(unknown) == len(data) and not any(meant):
        raise InputError(*problems)
    problems += [
        f"{place} must have the key `{key}`, but it is missing; add `{key}` there."
        for key in required
        if key not in data and key not in meant
    ]
    if problems:
        absent = [key for key in known if key not in data and (key in required or key in meant)]
        usable = {key: value for key, value in data.items() if key in known}
        raise WrongKeys(problems, usable | dict.fromkeys(absent, ABSENT))
    return data


def build(kind: Callable[..., Part], settings: dict[str, Any], place: str, problems: Problems) -> Part:
    """Return kind(**settings), checked even where it cannot be made.

    Args:
        kind: a class that tells all its mistakes, or one with a `__post_init__` of its own (see `build_by_trial`).
        settings: its arguments, ABSENT those that cannot be read.
        place: the table's header.
        problems: what is known to be wrong with the table.
    Raises:
        InputError: with `problems` and everything that is wrong with the arguments.
    """
    made = None
    if getattr(kind, "__post_init__", ChecksItself.__post_init__) is not ChecksItself.__post_init__:
        made = build_by_trial(kind, settings, place, problems)
    else:
        with problems.noted(), located(place):
            made = kind(**settings)
    problems.refuse()
    if made is None:
        raise InputError()  # nothing to add: what is wrong is told elsewhere
    return made


def build_by_trial(kind: Callable[..., Part], settings: dict[str, Any], place: str, problems: Problems) -> Part | None:
    """As `build`, of a class that tells its first mistake only: it is asked again without the argument that it names.

    Returns: None where something is wrong, which `problems` then hold.
    """
    left = {name: value for name, value in settings.items() if value is not ABSENT}
    whole = len(left) == len(settings)
    while True:
        try:
            made = kind(**left)
            return made if whole else None
        except TypeError:
            if whole:
                raise
            return None  # a required argument is absent, or was left out
        except WrongSetting:
            raise
        except InputError as error:
            named = {match[1] for problem in error.problems if (match := re.match(r"Argument `(\w+)`", problem))}
            # Where an argument is left out, what is said of one that is not there may be a consequence of that.
            if whole or not named.isdisjoint(left):
                problems.found += [f"{place}: {problem}" for problem in error.problems]
            if named.isdisjoint(left):
                return None
        left = {name: value for name, value in left.items() if name not in named}
        whole = False


def checked_list(data: object, place: str) -> list[dict[str, Any]]:
    """Return `data` if it is a list of tables; `place` is its header, such as "[[cases]]"."""
    if not isinstance(data, list) or any(not isinstance(entry, dict) for entry in data):
        raise InputError(
            f"{place} must be a list of tables, but was {data!r}; start each with {place} in double brackets."
        )
    return data


def named_place(header: str, entry: dict[str, Any], number: int) -> str:
    """Return the header of one table of a list with its name, or its number without one."""
    name = entry.get("name")
    return f"{header} `{name}`" if isinstance(name, str) else f"{header} number {number}"


def kind_of(content: dict[str, Any], known: Mapping[str, object], key: str, place: str, problems: Problems) -> str:
    """Return the kind of a table, content[key], without which its other keys cannot be judged.

    Args: problems, what is known to be wrong with the table.
    Raises: InputError with `problems` where the kind is absent or unknown.
    """
    kind = ABSENT
    if content[key] is not ABSENT:
        with problems.noted(), located(place):
            kind = require_choice(content[key], tuple(known), key)
    if kind is ABSENT:
        problems.refuse()
    return kind


def keys_of_kind(
    content: dict[str, Any], place: str, required: Collection[str], optional: Collection[str], problems: Problems
) -> dict[str, Any]:
    """Return the keys that the kind of a table has, of one with the keys of all kinds; note those that it has not."""
    known = (*required, *optional)
    written = {name: value for name, value in content.items() if value is not ABSENT or name in known}
    return problems.usable(lambda: checked_table(written, place, required, optional))


def read_list(entries: object, header: str, read: Callable[..., Part], *known: Any) -> list[Part]:
    """Return what read(table, place, *known) makes of the tables [[header]]; raise InputError with all mistakes."""
    found, problems = [], Problems()
    for number, entry in enumerate(checked_list(entries, header), start=1):
        with problems.noted():
            found.append(read(entry, named_place(header, entry, number), *known))
    problems.refuse()
    return found
