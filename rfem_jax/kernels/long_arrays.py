"""Operations on long arrays as loops over their entries: short code, where it is seldom run.

Place in the pipeline: arithmetic, memory -> **long_arrays** -> emission.

The code of other operations grows with the number of entries.  In a loop an operation is written once, its operands are
read from the workspace and its results are written there, which takes longer to run than registers do.
"""

import math
from collections.abc import Callable, Sequence

import numpy as np

from rfem_jax.kernels.arithmetic import Arithmetic, common_kind
from rfem_jax.kernels.builder import Builder, Entry, Rows, Stored, is_known
from rfem_jax.kernels.entries import Entries, of_shape
from rfem_jax.kernels.memory import copy, location_of, steps_of, stored

LONG = 256  # entries
MANY = 8  # one of so many entries

# Counters of loops, one for each axis, None for an axis of one entry -> the entry there.
At = Callable[[Sequence[str | None]], Entry]


def is_long(parts: Sequence[Entries], shape: Sequence[int]) -> bool:
    """Whether a result of a shape pays as a loop: not where many entries of an operand are known, each another number,
    which spares operations."""
    return math.prod(shape) >= LONG and all(_is_one(x) or MANY * sum(map(is_known, x.flat)) < x.size for x in parts)


def _is_one(entries: Entries) -> bool:
    """Whether all entries are the same value or number."""
    first = entries.flat[0] if entries.size else None
    if is_known(first):
        known = [np.asarray(x).tobytes() for x in entries.flat if is_known(x)]
        return len(known) == entries.size and len(set(known)) == 1
    return all(x is first for x in entries.flat)


def each_in_a_loop(builder: Builder, function: Callable, parts: Sequence[Entries], shape: Sequence[int]) -> Entries:
    """A function of entries applied to each; arrays are broadcast."""
    operands = [_operand(builder, x, shape) for x in parts]
    first, found = builder.reserve(math.prod(shape)), []

    def turn(at: Sequence[str | None]) -> None:
        found[:] = [function(*(operand(at) for operand in operands))]
        builder.store(found[0], common_kind(found), first, _rows(at, _evenly(shape)))

    _nested(builder, shape, turn)
    if is_known(found[0]):
        return of_shape(found * math.prod(shape), shape)
    return stored(builder, found[0].kind, first, shape).entries


def reduced_in_a_loop(builder: Builder, function: Callable, nothing: Entry, values: Entries, axes: int) -> Entries:
    """The entries of the first axes combined, from what changes nothing on."""
    kept, gone = values.shape[axes:], values.shape[:axes]
    operand, kind, first = _operand(builder, values, values.shape), common_kind(values.flat), 0
    first = builder.reserve(math.prod(kept))

    def turn(at: Sequence[str | None]) -> None:
        own = _rows(at, _evenly(kept))
        builder.store(nothing, kind, first, own)

        def combine(of: Sequence[str | None]) -> None:
            builder.store(function(builder.load(kind, first, own), operand([*of, *at])), kind, first, own)

        _nested(builder, gone, combine)

    _nested(builder, kept, turn)
    return stored(builder, kind, first, kept).entries


def products_in_a_loop(arithmetic: Arithmetic, a: Entries, b: Entries) -> Entries:
    """Products of matrices (batch, rows, terms) and (batch, columns, terms), summed over terms."""
    (batch, rows, terms), columns, builder = a.shape, b.shape[1], arithmetic.builder
    left, right = _operand(builder, a, a.shape), _operand(builder, b, b.shape)
    shape, kind = (batch, rows, columns), common_kind([*a.flat, *b.flat])
    first = builder.reserve(math.prod(shape))

    def turn(at: Sequence[str | None]) -> None:
        own = _rows(at, _evenly(shape))

        def product(k: str | None) -> Entry:
            return arithmetic.multiply(left([at[0], at[1], k]), right([at[0], at[2], k]))

        def add(of: Sequence[str | None]) -> None:
            total = arithmetic.add(builder.load(kind, first, own), product(of[0]))
            builder.store(total, kind, first, own)

        builder.store(np.float64(0.0) if kind == "d" else np.int64(0), kind, first, own)
        _nested(builder, (terms,), add)

    _nested(builder, shape, turn)
    return stored(builder, kind, first, shape).entries


def _operand(builder: Builder, part: Entries, shape: Sequence[int]) -> At:
    """Where the entries of an array, broadcast to a shape, are: a copy unless they lie evenly in the workspace."""
    if _is_one(part):
        return lambda at: part.flat[0]
    axes = [None] * (len(shape) - part.ndim) + [i if n > 1 else None for i, n in enumerate(part.shape)]
    found = location_of(part)
    steps = None if found is None else steps_of(found.slots)
    if found is None or steps is None:
        kind, slot, before = common_kind(part.flat), builder.reserve(part.size), ()
        copy(builder, part, kind, slot)
        steps = _evenly(part.shape)
    else:
        kind, slot, before = found.kind, int(found.slots.flat[0]), found.rows
    along = [0 if axis is None else steps[axis] for axis in axes]
    return lambda at: Stored(builder, kind, slot, (*before, *_rows(at, along)))


def _evenly(shape: Sequence[int]) -> list[int]:
    """How far it is from one entry to the next along each axis, of an array in one piece."""
    return [math.prod(shape[i + 1 :]) for i in range(len(shape))]


def _rows(at: Sequence[str | None], steps: Sequence[int]) -> Rows:
    return tuple((counter, step) for counter, step in zip(at, steps, strict=True) if counter is not None and step)


def _nested(builder: Builder, shape: Sequence[int], turn: Callable[[Sequence[str | None]], None]) -> None:
    """A loop over the entries of an array."""

    def over(axis: int, at: list[str | None]) -> None:
        if axis == len(shape):
            turn(at)
        elif shape[axis] == 1:
            over(axis + 1, [*at, None])
        else:
            builder.counted(shape[axis], lambda counter: over(axis + 1, [*at, counter]))

    over(0, [])
