"""Arrays of entries: object arrays of NumPy, whose entries are known numbers and values of the builder.

Place in the pipeline: builder -> **entries** -> memory, loops, emission.
"""

import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any
from weakref import WeakKeyDictionary

import jax
import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr, JaxprEqn, Var

from rfem_jax.kernels.builder import Entry, is_known

Entries = np.ndarray  # of dtype object


def entries_of(array) -> Entries:
    """Entries of an array of numbers that are known."""
    array = np.asarray(array)
    return of_shape(list(array.flat), array.shape)


def of_shape(entries: Iterable[Entry], shape: Sequence[int]) -> Entries:
    """An object array, filled one by one: NumPy would look into its entries."""
    return np.fromiter(entries, object, math.prod(shape)).reshape(shape)


def whole(entries) -> Entries:
    """An object array also of one entry, which is what NumPy returns in place of an array without axes."""
    if isinstance(entries, np.ndarray) and entries.dtype == object:
        return entries
    return of_shape([entries], ())


def numbers(entries: Entries, dtype) -> np.ndarray | None:
    """An array of known numbers, None if any entry is a value."""
    if not all(map(is_known, entries.flat)):
        return None
    return np.array([*entries.flat], dtype).reshape(entries.shape)


def each(function: Callable, parts: Sequence[Entries]) -> Entries:
    """A function of entries applied to each; arrays without axes are broadcast."""
    shape = parts[0].shape
    if any(x.shape != shape for x in parts):
        shape = np.broadcast_shapes(*(x.shape for x in parts))
        parts = [np.broadcast_to(x, shape) for x in parts]
    return of_shape(map(function, *(x.flat for x in parts)), shape)


def shape_of(variable: Any) -> jax.ShapeDtypeStruct:
    """Shape and type of a variable of a jaxpr."""
    return jax.ShapeDtypeStruct(variable.aval.shape, variable.aval.dtype)


_needed: WeakKeyDictionary[Jaxpr, list[JaxprEqn]] = WeakKeyDictionary()
_sizes: WeakKeyDictionary[Jaxpr, int] = WeakKeyDictionary()


def needed(jaxpr: Jaxpr) -> list[JaxprEqn]:
    """The equations of a jaxpr that its results depend on, or that do something besides."""
    known = _needed.get(jaxpr)
    if known is not None:
        return known
    wanted = {v for v in jaxpr.outvars if isinstance(v, Var)}
    found = []
    for equation in reversed(jaxpr.eqns):
        if equation.effects or wanted.intersection(equation.outvars):
            found.append(equation)
            wanted.update(v for v in equation.invars if isinstance(v, Var))
    return _needed.setdefault(jaxpr, found[::-1])


def is_program(x) -> bool:
    return isinstance(x, ClosedJaxpr)


def size_of(program: ClosedJaxpr) -> int:
    """Roughly, how many operations on entries a jaxpr has, with the body of every loop once."""
    if program.jaxpr in _sizes:
        return _sizes[program.jaxpr]
    total = 0

    def size(variable: Any) -> int:
        return math.prod(getattr(variable.aval, "shape", ()))

    for equation in needed(program.jaxpr):
        if equation.primitive.name == "kernel":
            total += size_of(equation.params["body"].program)
            continue
        parts = jax.tree.leaves(list(equation.params.values()), is_leaf=_holds_equations)
        inner = [x for x in parts if _holds_equations(x)]
        total += sum(size_of(x if is_program(x) else ClosedJaxpr(x, ())) for x in inner)
        if equation.primitive.name == "dot_general":
            (summed, _), _ = equation.params["dimension_numbers"]
            terms = math.prod(shape_of(equation.invars[0]).shape[i] for i in summed)
            total += 2 * terms * size(equation.outvars[0])
        else:
            total += sum(map(size, equation.outvars))
    return _sizes.setdefault(program.jaxpr, total)


def _holds_equations(x) -> bool:
    return isinstance(x, ClosedJaxpr | Jaxpr)
