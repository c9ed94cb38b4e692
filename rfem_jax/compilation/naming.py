"""Names of things among the arguments of a program, which are no part of it: two calls that differ in names alone
share what was traced, compiled and kept.

Place in the pipeline: `program` puts numbered words in the place of names before a call, and names back into its
results.

    arguments     things whose class has `own_names` say what their names are
    of(text)      a text that begins with a name, as "A", "A.radial", "link@0.5.deflection", "link.A.length", renamed
    renamed       a tree with other names: in keys of dictionaries, in texts of tuples, and where a method `renamed` of
                  a class says; what is the user's stays

Where a name is like a word that other texts begin with, and where something cannot be renamed, as a function of the
user's that reads results by their names, programs know the names as they are.
"""

import copy
import dataclasses
import functools
import re
from collections.abc import Mapping
from typing import Any

import equinox as eqx

PACKAGE = "rfem_jax"
KINDS = ("link", "joint", "section", "material", "force", "point")  # full names begin with one
RESERVED = frozenset((*KINDS, "drive", "mechanism", "gravity", "base", "masses"))
_NAME = re.compile(r"[^.@]+")


class NotRenamable(Exception):
    """Something depends on names in a way that is not known."""


class Names:
    """Names and the words in their places.  Words are unlike any name: names have letters, digits, "_" and "-"."""

    def __init__(self, words: Mapping[str, str]):
        self.words = dict(words)

    @functools.cached_property
    def back(self) -> "Names":
        """From the words to the names."""
        return Names({word: name for name, word in self.words.items()})

    @functools.cached_property
    def key(self) -> tuple[tuple[str, str], ...]:
        """Its content."""
        return tuple(self.words.items())

    def arguments(self, args: tuple, kwargs: dict) -> tuple[tuple, dict]:
        """Arguments with the other names; a single text is no name, but a choice."""
        positional = (one if isinstance(one, str) else self.renamed(one) for one in args)
        return tuple(positional), {word: self.renamed(one) for word, one in kwargs.items()}

    def of(self, text: str) -> str:
        """A text that begins with a name, or with the kind of a thing, with the other one."""
        kind, _, rest = text.partition(".")
        if rest and (kind in KINDS or (kind == "drive" and "." in rest)):
            return f"{kind}.{self._first(rest)}"
        return self._first(text)

    def _first(self, text: str) -> str:
        return _NAME.sub(lambda found: self.words.get(found[0], found[0]), text, count=1)

    def renamed(self, tree: Any) -> Any:
        """A tree with the other names."""
        if isinstance(tree, str):
            return self.of(tree)
        if isinstance(tree, dict):
            return _sorted(type(tree), {self._key(key): self.renamed(value) for key, value in tree.items()})
        return self.inside(tree)

    def _key(self, key: Any) -> Any:
        return self.of(key) if isinstance(key, str) else key

    def inside(self, tree: Any) -> Any:
        """As `renamed`, where texts and dictionaries are no names, as in static fields."""
        if _renames(tree):
            return tree.renamed(self)
        if isinstance(tree, (tuple, list)):
            found = [self.renamed(one) for one in tree]
            return type(tree)(*found) if hasattr(tree, "_fields") else type(tree)(found)
        if isinstance(tree, eqx.Module) and _of_package(tree):
            return self.of_fields(tree)
        return tree

    def of_fields(self, thing: Any) -> Any:
        """A dataclass whose fields are renamed; static ones only as far as they have the method."""
        changed = {}
        for field in dataclasses.fields(thing):
            value = getattr(thing, field.name)
            static = field.metadata.get("static", False)
            new = self._static(value) if static else self.renamed(value)
            if new is not value:
                changed[field.name] = new
        return with_fields(thing, **changed)

    def _static(self, value: Any) -> Any:
        if type(value) is tuple:
            found = tuple(self._static(one) for one in value)
            return value if all(a is b for a, b in zip(found, value)) else found
        return value.renamed(self) if _renames(value) else value


def _of_package(thing: Any) -> bool:
    return type(thing).__module__.partition(".")[0] == PACKAGE


def _renames(thing: Any) -> bool:
    """Whether its class says how it is renamed."""
    return hasattr(type(thing), "renamed")


def with_fields(thing: Any, **values: Any) -> Any:
    """A copy with other values in some fields; nothing is checked."""
    other = copy.copy(thing)
    for name, value in values.items():
        object.__setattr__(other, name, value)
    return other


def _sorted(kind: type, pairs: dict) -> dict:
    """A dictionary in the order of its keys, as JAX returns them."""
    return kind(sorted(pairs.items()) if all(isinstance(key, str) for key in pairs) else pairs)


def names_in(arguments: tuple) -> Names | None:
    """The names of the things among arguments, and a word for each by its number; None if there are none, or one may
    be taken for another word."""
    found = [name for one in arguments if hasattr(type(one), "own_names") for name in one.own_names]
    names = tuple(dict.fromkeys(found))
    return None if not names or not RESERVED.isdisjoint(names) else _numbered(names)


@functools.lru_cache(maxsize=256)
def _numbered(names: tuple[str, ...]) -> Names:
    return Names({name: f"#{n:04d}" for n, name in enumerate(names)})


def in_words(error: Exception) -> bool:
    """Whether a message speaks of words in the places of names."""
    return "#0" in str(error)
