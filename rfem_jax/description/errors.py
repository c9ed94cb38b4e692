"""InputError, the one exception for bad input, and the wording its sentences share.

Place in the pipeline: used by every package; imports nothing of the library.

Every refusal is one sentence of the form "Argument `x` must ..., but ...", and the fix; where a reader can go on after
a mistake, it collects the sentences (`Problems`).
"""

from collections.abc import Collection, Iterable, Iterator
from contextlib import contextmanager
from difflib import get_close_matches

# By difflib, "legnth" is like "length" by 0.83, "rk5" like "rk4" by 0.67, but so is "other" like "note".
LIKENESS, LIKENESS_OF_SAME_LETTER = 0.7, 0.65


class InputError(ValueError):
    """What the user wrote cannot be used; the message says where, why, and how to fix it.

    Args: problems, a sentence for each mistake; the message has a line for each.
    """

    def __init__(self, *problems: str):
        super().__init__(*problems)
        self.problems = problems

    def __str__(self) -> str:
        return "\n".join(self.problems)


class Problems:
    """Mistakes in several places, which are told together.

    problems = Problems()
    for entry in entries:
        with problems.noted():
            read(entry)
    problems.refuse()
    """

    def __init__(self) -> None:
        self.found: list[str] = []

    @contextmanager
    def noted(self) -> Iterator[None]:
        """Note an InputError that the block raises, and go on after the block."""
        try:
            yield
        except InputError as error:
            self.found += error.problems

    def refuse(self) -> None:
        """Raise InputError with all that was noted, if there is anything."""
        if self.found:
            raise InputError(*dict.fromkeys(self.found)) from None


class ChecksItself:
    """Base of the dataclasses that a user makes: `__post_init__` says in a sentence what is wrong with an argument, and
    converts what is right, so that a checker of types at run time leaves the arguments to it."""

    __no_type_check__ = True


def subject(where: str) -> str:
    """Return the start of a message: "Argument `where`".

    `where` is the argument's name, or a phrase that already holds its name in backticks
    (such as "`length` of link `crank`").
    """
    return f"Argument {where}" if "`" in where else f"Argument `{where}`"


def nearest(name: object, known: Iterable[object]) -> str | None:
    """Return the entry of `known` (strings) that `name` may be a slip of the pen for, or None."""
    by_lower_case = {str(entry).lower(): str(entry) for entry in known}
    name = str(name).lower()
    same_letter = [entry for entry in by_lower_case if entry[:1] == name[:1]]
    found = get_close_matches(name, list(by_lower_case), n=1, cutoff=LIKENESS)
    found = found or get_close_matches(name, same_letter, n=1, cutoff=LIKENESS_OF_SAME_LETTER)
    return by_lower_case[found[0]] if found else None


def suggestion(name: object, known: Iterable[object]) -> str:
    """Return "did you mean `x`?", or the list of what is known where nothing is near."""
    known = [str(entry) for entry in known]
    match = nearest(name, known)
    if match is not None:
        return f"did you mean `{match}`?"
    if not known:
        return "there is none to choose from."
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
        raise InputError(f"{subject(where)} must be one of {listed}, but was {value!r}; {suggestion(value, choices)}")
    return value


def require_flag(value: object, where: str) -> bool:
    """Return `value` if it is True or False; else raise InputError."""
    if not isinstance(value, bool):
        raise InputError(f"{subject(where)} must be true or false, but was {value!r}; write it without quotes.")
    return value


@contextmanager
def located(place: str) -> Iterator[None]:
    """Prefix the message of an InputError raised inside with `place` (a table of a study file)."""
    try:
        yield
    except InputError as error:
        raise InputError(*(f"{place}: {problem}" for problem in error.problems)) from None
