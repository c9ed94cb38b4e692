"""Study files with one mistake each, as typed in a hurry: deterministic by a seed.

`mutations` takes the text of a right study file; every mutation is (what was done, text).
"""

import json
import math
import random
import string
import tomllib
from collections.abc import Callable, Iterator
from typing import Any

Path = tuple[Any, ...]
LONG = 5000  # entries of a list, letters of a word

UNITS = ("m", "deg", "kg", "s", "N", "Pa", "N m", "rpm", "furlong", "kg/m^^3", "")
WRONG_TYPES = (True, 3, -2.5, "abc", "12", [], [1, 2], ["a"], {}, {"a": 1}, [[1]], [{}])
HUGE = (1e300, 10**400, -1e300, 1e40, 10**12, 1e-300)
WORDS = ("nobody", "Ab", "a.b", "x y", "", "ä", "A" * LONG, "con", "../up", "A\n", "nan")


def leaves(content: Any, path: Path = ()) -> Iterator[tuple[Path, Any]]:
    """All places of a document, tables and lists included, with what stands there."""
    entries = content.items() if isinstance(content, dict) else enumerate(content)
    for key, value in entries:
        yield (*path, key), value
        if isinstance(value, (dict, list)):
            yield from leaves(value, (*path, key))


def toml_of(content: dict[str, Any]) -> str:
    """A document as TOML: every table but the uppermost inline."""
    return "".join(f"{_word(key)} = {_value(value)}\n" for key, value in content.items())


def _word(key: str) -> str:
    return key if key and all(one in string.ascii_letters + string.digits + "_-" for one in key) else _value(key)


def _value(value: Any) -> str:
    if isinstance(value, dict):
        return "{" + ", ".join(f"{_word(key)} = {_value(one)}" for key, one in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(_value, value)) + "]"
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    return json.dumps(value, ensure_ascii=False)


class _Mistake:
    """One mistake in a document: the place is chosen at random among those where it can be made."""

    def __init__(self, text: str, chance: random.Random):
        self.content, self.text, self.chance = tomllib.loads(text), text, chance

    def place(self, suits: Callable[[Path, Any], bool]) -> tuple[Any, Any, Path]:
        """The table or list that is changed, the key in it, and the whole path. Raises LookupError."""
        found = [path for path, value in leaves(self.content) if suits(path, value)]
        path = found[self.chance.randrange(len(found))] if found else _nothing()
        owner: Any = self.content
        for key in path[:-1]:
            owner = owner[key]
        return owner, path[-1], path

    def done(self, what: str, path: Path) -> tuple[str, str]:
        return f"{what} {'.'.join(map(str, path))}", toml_of(self.content)

    def delete_key(self):
        owner, key, path = self.place(lambda path, _: True)
        del owner[key]
        return self.done("deleted", path)

    def misspell_key(self):
        owner, key, path = self.place(lambda path, _: isinstance(path[-1], str) and len(path[-1]) > 1)
        i = self.chance.randrange(len(key) - 1)
        slips = (
            key[:i] + key[i + 1 :],
            key[:i] + key[i + 1] + key[i] + key[i + 2 :],
            key[:i] + key[i] + key[i:],
            key + "s",
        )
        slip = self.chance.choice([one for one in slips if one not in owner] or [key + "xx"])
        items = [(slip if one == key else one, value) for one, value in owner.items()]
        owner.clear()
        owner.update(items)
        return self.done(f"misspelt as {slip}", path)

    def wrong_type(self):
        owner, key, path = self.place(lambda *_: True)
        kind = type(owner[key])
        owner[key] = self.chance.choice([one for one in WRONG_TYPES if type(one) is not kind])
        return self.done(f"type {owner[key]!r} for", path)

    def wrong_unit(self):
        owner, key, path = self.place(lambda _, value: isinstance(value, str) and value[:1].isdigit())
        owner[key] = f"{owner[key].split()[0]} {self.chance.choice(UNITS)}"
        return self.done(f"unit {owner[key]!r} for", path)

    def negative(self):
        owner, key, path = self.place(lambda _, value: _measure(value) and not str(value).startswith("-"))
        owner[key] = f"-{owner[key]}" if isinstance(owner[key], str) else -owner[key]
        return self.done("negative", path)

    def zero(self):
        owner, key, path = self.place(lambda _, value: _measure(value))
        owner[key] = 0
        return self.done("zero", path)

    def huge(self):
        owner, key, path = self.place(lambda _, value: _measure(value))
        owner[key] = self.chance.choice(HUGE)
        return self.done("huge", path)

    def not_finite(self):
        owner, key, path = self.place(lambda _, value: _measure(value))
        owner[key] = self.chance.choice((math.nan, math.inf, -math.inf, "nan", "inf m"))
        return self.done(f"{owner[key]} for", path)

    def unknown_name(self):
        owner, key, path = self.place(lambda _, value: isinstance(value, str) and not value[:1].isdigit())
        owner[key] = self.chance.choice(WORDS)
        return self.done(f"name {owner[key][:20]!r} for", path)

    def near_name(self):
        owner, key, path = self.place(
            lambda _, value: isinstance(value, str) and len(value) > 2 and not value[:1].isdigit()
        )
        i = self.chance.randrange(len(owner[key]))
        owner[key] = owner[key][:i] + owner[key][i + 1 :]
        return self.done(f"slip {owner[key][:20]!r} for", path)

    def duplicate(self):
        owner, key, path = self.place(lambda path, _: isinstance(path[-1], int))
        owner.insert(key, owner[key])
        return self.done("twice", path)

    def wrong_length(self):
        owner, key, path = self.place(lambda _, value: isinstance(value, list) and bool(value))
        one = owner[key]
        owner[key] = self.chance.choice((one[:-1], one[1:], [*one, 1.0], one * 7))
        return self.done("length of", path)

    def empty(self):
        owner, key, path = self.place(lambda _, value: isinstance(value, (dict, list, str)))
        owner[key] = type(owner[key])()
        return self.done("empty", path)

    def whole_data(self):
        owner, key, path = self.place(lambda *_: True)
        owner[key] = self.chance.choice(([0.123456789] * LONG, "word " * LONG, {f"k{i}": i for i in range(LONG // 10)}))
        return self.done(f"{LONG} entries for", path)

    def new_key(self):
        owner, _, path = self.place(lambda path, _: isinstance(path[-1], str))
        owner[self.chance.choice(("colour", "lenght", "name2", "a b", "drive.rate", ""))] = 1
        return self.done("new key beside", path)

    def line(self):
        lines = self.text.splitlines(keepends=True)
        i = self.chance.choice([i for i, one in enumerate(lines) if one.strip() and not one.startswith("#")])
        what = self.chance.choice(("deleted", "twice", "half", "unquoted", "comma"))
        one = lines[i]
        lines[i] = {
            "deleted": "", "twice": one * 2, "half": one[: len(one) // 2] + "\n", "unquoted": one.replace('"', ""),
            "comma": one.replace(".", ",", 1),
        }[what]  # fmt: skip
        return f"line {i + 1} {what}: {one.strip()[:60]}", "".join(lines)


KINDS = tuple(name for name in vars(_Mistake) if not name.startswith("_") and name not in ("place", "done"))


def _measure(value: Any) -> bool:
    number = isinstance(value, (int, float)) and not isinstance(value, bool)
    return number or (isinstance(value, str) and value[:1].isdigit() and " " in value)


def _nothing() -> Any:
    raise LookupError


def mutations(text: str, count: int, seed: int) -> Iterator[tuple[str, str]]:
    """`count` mutations of a study file, of all kinds in turn."""
    number = 0
    while count:
        chance = random.Random(f"{seed} {number}")
        try:
            what, mutated = getattr(_Mistake(text, chance), KINDS[number % len(KINDS)])()
        except LookupError:
            number += 1
            continue
        number, count = number + 1, count - 1
        yield f"{KINDS[(number - 1) % len(KINDS)]}: {what}", mutated
