"""InputError, the one exception for bad input, and the wording its sentences share.

Place in the pipeline: near_names -> **errors**, used by every package.

Every refusal is one sentence of the form "Argument `x` must ..., but ...", and the fix; where a reader can go on after
a mistake, it collects the sentences (`Problems`).
"""

import re
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from rfem_jax.description.basics.near_names import nearest as nearest

# Characters of a value, and of a remark in parentheses, a name or a path, beyond which a sentence quotes the beginning.
LONGEST_QUOTE, LONGEST_REMARK, QUOTED = 120, 300, 60
CLOSING = {"[": "]", "{": "}", "(": ")", "'": "'", '"': '"', "`": "`"}
MOST_ALIKE, MOST_NAMED = 2, 8  # sentences of one kind that are told each by itself; names told of the others
MOST_TOLD = 40  # sentences


class InputError(ValueError):
    """What the user wrote cannot be used; the message says where, why, and how to fix it.

    Args: problems, a sentence for each mistake; the message has a line for each, in which whole data are cut short.
    """

    def __init__(self, *problems: str):
        problems = tuple(map(with_short_quotes, problems))
        super().__init__(*problems)
        self.problems = problems

    def __str__(self) -> str:
        return "\n".join(self.problems)


class WrongSetting(InputError):
    """A setting of the process is wrong, not the input that was being read when it was found: no place is put before
    the sentence, and nothing is told beside it."""


class _Absent:
    def __repr__(self) -> str:
        return "(missing)"


# Value of an argument that cannot be read, which is told elsewhere: the others are checked all the same (`Checks`).
ABSENT: Any = _Absent()


class Problems:
    """Mistakes in several places, which are told together.

    problems = Problems()
    found = [problems.attempt(read, entry) for entry in entries]
    problems.refuse()
    """

    def __init__(self) -> None:
        self.found: list[str] = []
        self.failed = False

    @contextmanager
    def noted(self) -> Iterator[None]:
        """Note an InputError that the block raises, and go on after the block."""
        try:
            yield
        except WrongSetting:
            raise
        except InputError as error:
            self.failed = True
            self.found += error.problems

    def attempt(self, read: Callable[..., Any], *arguments: Any) -> Any:
        """Return read(*arguments), or note what is wrong and return ABSENT."""
        with self.noted():
            return read(*arguments)
        return ABSENT

    def refuse(self) -> None:
        """Raise InputError with all that was noted, if there is anything; without a sentence where all that is wrong is
        told elsewhere."""
        if self.failed or self.found:
            raise InputError(*dict.fromkeys(self.found)) from None


class Checks(Problems):
    """Checks of the fields of one object, whose mistakes are told together.

    Args: owner, the object. A field that is ABSENT counts as one with a mistake, of which nothing is told here.
    """

    def __init__(self, owner: Any):
        super().__init__()
        self.owner = owner
        self.wrong = {name for name, value in vars(owner).items() if value is ABSENT}
        self.failed = bool(self.wrong)

    def value(self, field: str, value: Any, convert: Callable[..., Any], *arguments: Any) -> Any:
        """Return convert(value, *arguments), or note what is wrong with the value and return ABSENT."""
        found = ABSENT if value is ABSENT else self.attempt(convert, value, *arguments)
        if found is ABSENT:
            self.wrong.add(field)
            self.failed = True
        return found

    def set(self, field: str, value: Any, convert: Callable[..., Any], *arguments: Any) -> None:
        """Set a field of the owner to convert(value, *arguments), unless something is wrong with the value."""
        found = self.value(field, value, convert, *arguments)
        if found is not ABSENT:
            object.__setattr__(self.owner, field, found)

    def convert(self, field: str, convert: Callable[..., Any], *arguments: Any) -> None:
        """As `set`, of the value that the field has."""
        self.set(field, getattr(self.owner, field), convert, *arguments)

    def passed(self, *fields: str) -> bool:
        """True if nothing is wrong with these fields."""
        return self.wrong.isdisjoint(fields)

    def relation(self, fields: Collection[str], check: Callable[..., Any], *arguments: Any) -> None:
        """Note what check(*arguments) says about fields together, unless one of them is wrong on its own."""
        if self.passed(*fields):
            with self.noted():
                check(*arguments)


class ChecksItself:
    """Base of the dataclasses that a user makes: they say in sentences what is wrong with their arguments, and convert
    what is right, so that a checker of types at run time leaves the arguments to them."""

    __no_type_check__ = True

    def __post_init__(self):
        checks = Checks(self)
        self._check_fields(checks)
        checks.refuse()

    def _check_fields(self, checks: Checks) -> None:
        """Check and convert every field. A subclass may have a `__post_init__` instead, and then tells what that
        raises, where a study file has no key that is misspelt or missing."""


def subject(where: str) -> str:
    """Return the start of a message: "Argument `where`".

    `where` is the argument's name, or a phrase that already holds its name in backticks
    (such as "`length` of link `crank`").
    """
    return f"Argument {where}" if "`" in where else f"Argument `{where}`"


def suggestion(name: object, known: Iterable[object]) -> str:
    """Return "did you mean `x`?", or the list of what is known where nothing is near."""
    known = [str(entry) for entry in known]
    match = nearest(name, known)
    if match is not None:
        return f"did you mean `{match}`?"
    if not known:
        return "there is nothing to choose from."
    shown = ", ".join(f"`{entry}`" for entry in known[:20])
    return f"known are {shown}{' and more' if len(known) > 20 else ''}."


def require_name(name: object, where: str, reserved: Collection[str] = ()) -> str:
    """Return `name` if it is a word of letters, digits, "_" and "-"; else raise InputError.

    Names become parts of error names ("D.delta_x") and of columns, hence no dots or spaces.
    """
    if not isinstance(name, str):
        raise InputError(f"{subject(where)} must be a string, but was {name!r}; put it in quotes.")
    plain = name.replace("_", "").replace("-", "")
    if not (plain.isascii() and plain.isalnum()):
        raise InputError(
            f'{subject(where)} must consist of letters, digits, "_" and "-", but was {name!r}; '
            'choose a plain word such as "crank".'
        )
    if name in reserved:
        raise InputError(f"{subject(where)} must not be a reserved word, but was `{name}`; choose another name.")
    return name


def require_choice(value: object, choices: Collection[str], where: str) -> str:
    """Return `value` if it is one of the strings `choices`; else raise InputError."""
    if not (isinstance(value, str) and value in choices):
        listed = ", ".join(f'"{choice}"' for choice in choices)
        fix = suggestion(value, choices) if nearest(value, choices) is not None else "write one of these."
        raise InputError(f"{subject(where)} must be one of {listed}, but was {value!r}; {fix}")
    return value


def require_instance(value: Any, where: str, kind: type | tuple[type, ...], fix: str) -> Any:
    """Return `value` if it is of a class, or one of several; else raise InputError, with what to do, `fix`."""
    if not isinstance(value, kind):
        *others, last = [one.__name__ for one in (kind if isinstance(kind, tuple) else (kind,))]
        wanted = f"{', '.join(others)} or {last}" if others else last
        raise InputError(f"{subject(where)} must be a {wanted}, but was {value!r}; {fix}")
    return value


def require_entries(value: Any, where: str, kind: type | tuple[type, ...], called: str, fix: str) -> tuple[Any, ...]:
    """Return a list of things of a class, or one of several, as a tuple; else raise InputError: `called`, what it must
    be a list of; `fix`, what to do."""
    if not isinstance(value, (list, tuple)) or any(not isinstance(one, kind) for one in value):
        raise InputError(f"{subject(where)} must be a list of {called}, but was {value!r}; {fix}")
    return tuple(value)


def require_flag(value: object, where: str) -> bool:
    """Return `value` if it is True or False; else raise InputError."""
    if not isinstance(value, bool):
        raise InputError(f"{subject(where)} must be true or false, but was {value!r}; write it without quotes.")
    return value


@contextmanager
def located(place: str) -> Iterator[None]:
    """Prefix the message of an InputError raised inside with `place` (a table of a study file), unless it has it."""
    try:
        yield
    except WrongSetting:
        raise
    except InputError as error:
        placed = (one if one.startswith(f"{place}: ") else f"{place}: {one}" for one in error.problems)
        raise InputError(*placed) from None


def with_short_quotes(sentence: str) -> str:
    """A sentence in which values that are quoted at length are cut: lists, tables, texts, names."""
    if len(sentence) <= LONGEST_QUOTE:
        return sentence
    parts, at = [], 0
    while at < len(sentence):
        word = _WORD.match(sentence, at)
        end = at + len(word[0]) if word else _end_of_quote(sentence, at)
        quote = sentence[at:end]
        most = LONGEST_QUOTE if quote[0] in "[{'\"" else LONGEST_REMARK
        parts.append(quote if len(quote) <= most else f"{quote[:QUOTED]}... ({len(quote)} characters)")
        at = end
    return "".join(parts)


_WORD = re.compile(r"[^\s\[{('\"`]+|\s+")


def _end_of_quote(sentence: str, start: int) -> int:
    """The place after the quotation that begins at `start`; the next place where nothing ends it."""
    mark, closing, depth = sentence[start], CLOSING[sentence[start]], 0
    if mark == closing:  # an apostrophe within a word begins nothing
        found = -1 if sentence[start - 1 : start].isalnum() else sentence.find(closing, start + 1)
        return found + 1 or start + 1
    for place in range(start, len(sentence)):
        depth += {mark: 1, closing: -1}.get(sentence[place], 0)
        if depth == 0:
            return place + 1
    return start + 1


def condensed(problems: Sequence[str]) -> tuple[str, ...]:
    """Sentences of which those that differ only in the names they quote, and many that differ in numbers, too, are told
    once, with the names of the others: one mistake may be found in many places, and many have been made at once. Of too
    many the last are counted."""
    told = _alike(problems, lambda one: _NAMES.sub("``", one), MOST_ALIKE)
    told = _alike(told, lambda one: _NUMBERS.sub("0", _NAMES.sub("``", one)), MOST_NAMED)
    if len(told) > MOST_TOLD:
        told = [*told[:MOST_TOLD], f"There are {len(told) - MOST_TOLD} more mistakes; correct these first."]
    return tuple(told)


_NAMES, _NUMBERS = re.compile(r"`[^`]*`|'[^']*'|number \d+"), re.compile(r"-?\d[\w.+-]*")


def _alike(problems: Sequence[str], kind: Callable[[str], str], most: int) -> list[str]:
    """Sentences of which more than `most` of one kind are one."""
    alike: dict[str, list[str]] = {}
    for problem in problems:
        alike.setdefault(kind(problem), []).append(problem)
    return [one for group in alike.values() for one in (group if len(group) <= most else [_together(group)])]


def _together(group: Sequence[str]) -> str:
    """The first of sentences that differ in names, and what the others name."""
    told = {*_NAMES.findall(group[0])}
    others = list(dict.fromkeys(name for one in group[1:] for name in _NAMES.findall(one) if name not in told))
    named = ", ".join(others[:MOST_NAMED])
    more = f"{named} and more" if len(others) > MOST_NAMED else named
    return f"{group[0].removesuffix('.')} ({f'so for {more}; ' if others else ''}{len(group)} in all)."
