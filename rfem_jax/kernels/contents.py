"""The content of a jaxpr as a digest, so that what was made of it is found again without making it.

Place in the pipeline: emission -> **contents** -> bodies.

Two jaxprs with the same digest have the same operations on the same numbers: variables enter by the order in which
they appear, arrays by their bytes, settings of primitives by their values, and primitives that the emitter does not
know by what they are made of.  Settings of another kind, such as functions, have no digest, unless they say nothing
about the operations.
"""

import enum
import functools
import hashlib
from pathlib import Path
from typing import Any
from weakref import WeakKeyDictionary

import jax
import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr, JaxprEqn, Literal

from rfem_jax.kernels import foreign_function, machine_code
from rfem_jax.kernels.builder import Unsupported
from rfem_jax.kernels.emission import CALLS, SAME, Emitter, called_program, expansion_of
from rfem_jax.kernels.loops import counts_of_scan

# What decides about the operations, of primitives that have other settings besides.
SETTINGS = {
    "scan": ("jaxpr", "length", "reverse"),
    "while": ("cond_jaxpr", "body_jaxpr", "cond_nconsts", "body_nconsts"),
    "cond": ("branches",),
    "custom_linear_solve": ("const_lengths", "jaxprs"),
}


@functools.lru_cache(maxsize=4096)
def _type_text(dtype: Any, shape: tuple[int, ...]) -> str:
    return f"{dtype}{shape}"


class NoDigest(Exception):
    """Something that is not known by its content."""


def digest_of(program: ClosedJaxpr, short: bool = False) -> str | None:
    """SHA-256 (hexadecimal) of a jaxpr, and of what else its machine code depends on (`short`: see `programs.emit`);
    None if something in it is not known by its content."""
    try:
        content = _Contents().of(program)
    except (NoDigest, Unsupported):
        return None
    return hashlib.sha256(f"{_surroundings()} {short} {content}".encode()).hexdigest()[:40]


@functools.cache
def _surroundings() -> str:
    """The sources of this package, the processor, and the versions of the compiler and of the interface."""
    sources = hashlib.sha256()
    for file in sorted(Path(__file__).parent.glob("*.py")):
        sources.update(file.read_bytes())
    return f"{sources.hexdigest()} {machine_code.processor()} {foreign_function.interface_version()}"


# A derivative has the jaxprs of its kernel in it, and expansions come thousands of times: each is digested once.
_digests: WeakKeyDictionary[Jaxpr, str] = WeakKeyDictionary()


class _Contents:
    """Digests of jaxprs."""

    def __init__(self) -> None:
        self.expanding: set[str] = set()

    def of(self, program: ClosedJaxpr | Jaxpr) -> str:
        jaxpr = program.jaxpr if isinstance(program, ClosedJaxpr) else program
        if jaxpr not in _digests:
            _digests[jaxpr] = self._digest(jaxpr)
        consts = getattr(program, "consts", ())
        return f"{_digests[jaxpr]} {' '.join(map(self._text, consts))}" if consts else _digests[jaxpr]

    def _digest(self, jaxpr: Jaxpr) -> str:
        numbers: dict[Any, int] = {}

        def name(variable) -> str:
            if isinstance(variable, Literal):
                return self._text(variable.val)
            return str(numbers.setdefault(variable, len(numbers)))

        def typed(variable) -> str:
            return f"{name(variable)}:{_type_text(variable.aval.dtype, variable.aval.shape)}"

        text = [typed(v) for v in (*jaxpr.constvars, *jaxpr.invars)]
        for equation in jaxpr.eqns:
            text += [self._operation(equation), *map(name, equation.invars), "->"]
            text += map(typed, equation.outvars)
        text += ["result", *map(name, jaxpr.outvars)]
        return hashlib.sha256(" ".join(text).encode()).hexdigest()

    def _operation(self, equation: JaxprEqn) -> str:
        name, settings = equation.primitive.name, equation.params
        if name in SAME:
            return name
        if name in CALLS:
            return f"call {self.of(called_program(settings))}"
        if name == "kernel":
            return f"kernel {self.of(settings['body'].program)} {settings['batched']}"
        if not Emitter.knows(name):
            return f"call {self._expanded(equation)}"
        counts = counts_of_scan(settings) if name == "scan" else ""
        wanted = SETTINGS.get(name, sorted(settings))
        return f"{name} {counts} {' '.join(f'{key}={self._text(settings[key])}' for key in wanted)}"

    def _expanded(self, equation: JaxprEqn) -> str:
        name = equation.primitive.name
        if name in self.expanding:  # its implementation is itself
            raise NoDigest(name)
        self.expanding.add(name)
        found = self.of(expansion_of(equation))
        self.expanding.discard(name)
        return found

    def _text(self, value: Any) -> str:
        if value is None or isinstance(value, bool | int | float | str | np.dtype | np.generic | enum.Enum):
            return f"{type(value).__name__} {value!r}"
        if isinstance(value, ClosedJaxpr | Jaxpr):
            return self.of(value)
        if isinstance(value, tuple | list):
            return f"{type(value).__name__}({','.join(map(self._text, value))})"
        if isinstance(value, np.ndarray | jax.Array):
            array = np.asarray(value)
            return f"{array.dtype}{array.shape}{hashlib.sha256(array.tobytes()).hexdigest()}"
        if isinstance(value, type) and issubclass(value, np.generic):
            return value.__name__
        raise NoDigest(type(value).__name__)
