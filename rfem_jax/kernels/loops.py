"""Loops and branches of a jaxpr, over all lanes at once.

Place in the pipeline: memory, arithmetic -> **loops** -> emission, which hands itself over for the bodies.

What goes around in a loop is kept in the workspace.  A `while` goes on as long as any lane does, and a lane that has
come to its end keeps what it had; a branch is entered if any lane takes it, and every lane keeps the results of its
own.
"""

import functools
import math
from collections.abc import Callable, Sequence
from typing import Protocol, runtime_checkable

import numpy as np
from jax.extend.core import ClosedJaxpr

from rfem_jax.kernels.arithmetic import Arithmetic
from rfem_jax.kernels.builder import DTYPES, TURNS, Builder, Entry, Unsupported, Value, is_known, kind_of
from rfem_jax.kernels.entries import Entries, each, of_shape, size_of, whole
from rfem_jax.kernels.long_arrays import LONG, each_in_a_loop, is_long
from rfem_jax.kernels.memory import Array, Location, columns_of, copy, entries_in, row_at, row_of, stored

LONGEST_UNROLLED = 64
LARGEST_UNROLLED = 3000  # operations of all turns
LARGEST_WITHOUT_BRANCH = 100  # operations that are carried out whether or not they are needed


@runtime_checkable  # where types are checked at run time
class Emitter(Protocol):
    """What carries out jaxprs: `emission.Emitter`."""

    builder: Builder
    arithmetic: Arithmetic
    short: bool

    def run(self, program: ClosedJaxpr, given: Sequence[Array]) -> list[Array]: ...


def counts_of_scan(settings) -> tuple[int, int]:
    """How many operands of a scan are constants and how many are carried; JAX 0.12 keeps them as trees."""
    if "num_carry" in settings:
        return settings["num_consts"], settings["num_carry"]
    constants, carry, _ = settings["ft_in"].unpack()
    return len(constants), len(carry)


class Slots:
    """Arrays in the workspace, of given shapes and types, each `rows` times one after the other."""

    def __init__(self, emitter: Emitter, variables: Sequence, rows: int = 1, drop: int = 0) -> None:
        self.builder, self.rows, self.short = emitter.builder, rows, emitter.short
        self.shapes = [v.aval.shape[drop:] for v in variables]
        self.kinds = [kind_of(v.aval.dtype) for v in variables]
        self.sizes = [math.prod(shape) for shape in self.shapes]
        self.firsts = [self.builder.reserve(size * rows) for size in self.sizes]

    def store(self, arrays: Sequence[Array], row: str | None = None) -> None:
        """Into the first row, or into one that is computed."""
        for array, kind, first, size in zip(arrays, self.kinds, self.firsts, self.sizes, strict=True):
            copy(self.builder, array, kind, first, () if row is None else ((row, size),))

    def load(self) -> list[Array]:
        """The first row, which may be written again."""
        return [self._loaded(*of) for of in zip(self.kinds, self.firsts, self.sizes, self.shapes)]

    def _loaded(self, kind: str, first: int, size: int, shape: Sequence[int]) -> Array:
        if not self.short or size < LONG:
            return of_shape([self.builder.load(kind, first + i) for i in range(size)], shape)
        other = self.builder.reserve(size)
        copy(self.builder, stored(self.builder, kind, first, shape), kind, other)
        return stored(self.builder, kind, other, shape)

    def finished(self) -> list[Array]:
        """All rows, which are written no more; without the axis of rows if there is one."""
        shapes = self.shapes if self.rows == 1 else [(self.rows, *shape) for shape in self.shapes]
        return [stored(self.builder, *of) for of in zip(self.kinds, self.firsts, shapes)]


def _typed(arrays: Sequence[Array], variables: Sequence) -> list[Array]:
    """Numbers among entries with the types of their variables."""
    found = []
    for array, variable in zip(arrays, variables, strict=True):
        if isinstance(array, Location):
            found.append(array)
            continue
        as_type = DTYPES[kind_of(variable.aval.dtype)].type
        found.append(of_shape([as_type(x) if is_known(x) else x for x in array.flat], array.shape))
    return found


def scan(emitter: Emitter, equation, parts: Sequence[Array]) -> list[Array]:
    settings = equation.params
    constants, carried = counts_of_scan(settings)
    fixed, carry, rows = parts[:constants], parts[constants : constants + carried], parts[constants + carried :]
    variables = equation.invars[constants + carried :], equation.outvars[:carried], equation.outvars[carried:]

    def body(carry, own):
        return emitter.run(settings["jaxpr"], [*fixed, *carry, *own])

    size = size_of(settings["jaxpr"])
    return _turns(emitter, body, size, settings["length"], settings["reverse"], list(carry), rows, variables)


def over_rows(emitter: Emitter, program: ClosedJaxpr, equation, parts: Sequence[Array], batched: Sequence[bool]):
    """Results of a jaxpr for every row of the operands that have an axis of them in front."""
    rows = [x for x, b in zip(parts, batched) if b]
    variables = [v for v, b in zip(equation.invars, batched) if b], [], equation.outvars

    def body(_, own):
        left = iter(own)
        return emitter.run(program, [next(left) if b else x for x, b in zip(parts, batched)])

    return _turns(emitter, body, size_of(program), rows[0].shape[0], False, [], rows, variables)


def _turns(
    emitter: Emitter,
    body: Callable,
    size: int,
    length: int,
    reverse: bool,
    carry: list,
    rows: Sequence,
    variables: tuple,
) -> list[Array]:
    """What is carried, and the stacked results of the turns, of a loop over rows.

    **Arguments:** `body`: (carried, own rows) -> carried and results; `size`: its operations; `variables`: of rows, of
    what is carried, and of stacked results.
    """
    row_variables, carry_variables, made_variables = variables
    carried = len(carry)
    if length <= 1 or (length <= LONGEST_UNROLLED and length * size <= LARGEST_UNROLLED):
        made = []
        for i in range(length)[::-1] if reverse else range(length):
            results = body(carry, [row_at(x, i) for x in rows])
            carry = results[:carried]
            made.append(results[carried:])
        made = made[::-1] if reverse else made
        if not made:
            return carry + [np.empty(v.aval.shape, object) for v in made_variables]
        return carry + [np.stack([*map(entries_in, column)]) for column in zip(*made)]
    around = Slots(emitter, carry_variables)
    written = Slots(emitter, made_variables, length, drop=1)
    around.store(_typed(carry, carry_variables))
    builder, rows = emitter.builder, _typed(rows, row_variables)
    kinds = [kind_of(v.aval.dtype) for v in row_variables]
    columns = [columns_of(builder, x, kind) for x, kind in zip(rows, kinds)]

    def turn(counter: str) -> None:
        at = builder.scalar(f"sub i64 {length - 1}, {counter}") if reverse else counter
        own = [row_of(builder, kind, of, x.shape[1:], at) for kind, of, x in zip(kinds, columns, rows)]
        results = body(around.load(), own)
        around.store(_typed(results[:carried], carry_variables))
        written.store(_typed(results[carried:], made_variables), at)

    builder.counted(length, turn)
    return around.finished() + written.finished()


def repeat_while(emitter: Emitter, equation, parts: Sequence[Array]) -> list[Array]:
    settings, variables, builder = equation.params, equation.outvars, emitter.builder
    first, second = settings["cond_nconsts"], settings["cond_nconsts"] + settings["body_nconsts"]
    of_condition, of_body, start = parts[:first], parts[first:second], parts[second:]
    around = Slots(emitter, variables)
    around.store(_typed(start, variables))
    loop, inner, done = (builder.fresh(name) for name in ("while", "turn", "end"))
    builder.line(f"br label %{loop}")
    builder.begin(loop)

    def turn() -> None:
        carry = around.load()
        conditions = entries_in(emitter.run(settings["cond_jaxpr"], [*of_condition, *carry])[0])  # of a batch, several
        goes_on: Entry = functools.reduce(emitter.arithmetic.either, conditions.flat)
        if is_known(goes_on):
            if goes_on:
                raise Unsupported("while without an end")
            builder.line(f"br i1 false, label %{inner}, label %{done}")
            builder.begin(inner)
        else:
            builder.line(f"br i1 {builder.any(goes_on)}, label %{inner}, label %{done}")
            builder.begin(inner)
            results = _typed(emitter.run(settings["body_jaxpr"], [*of_body, *carry]), variables)
            around.store([_kept(emitter, conditions, new, old) for new, old in zip(results, carry)])
        builder.line(f"br label %{loop}")

    builder.inside(turn, TURNS)
    builder.begin(done)
    return around.finished()


def _kept(emitter: Emitter, masks: Entries, new: Array, old: Array) -> Entries:
    """What is new where a mask holds, which is one for all, or one for each entry of the first axes."""
    new, old = entries_in(new), entries_in(old)
    masks, select = masks.reshape(masks.shape + (1,) * (new.ndim - masks.ndim)), emitter.arithmetic.select
    if emitter.short and is_long((masks, new, old), new.shape):
        return each_in_a_loop(emitter.builder, select, (masks, new, old), new.shape)
    return each(select, (np.broadcast_to(masks, new.shape), new, old))


def branch(emitter: Emitter, equation, which: Array, parts: Sequence[Array]) -> list[Array]:
    branches, variables, builder = equation.params["branches"], equation.outvars, emitter.builder
    arithmetic = emitter.arithmetic
    index: Entry = entries_in(which)[()]
    if is_known(index):
        return emitter.run(branches[min(max(int(index), 0), len(branches) - 1)], parts)
    if index.kind != "b":
        index = arithmetic.smaller(arithmetic.larger(index, DTYPES[index.kind].type(0)),
                                   DTYPES[index.kind].type(len(branches) - 1))  # fmt: skip
    if sum(map(size_of, branches)) <= LARGEST_WITHOUT_BRANCH:
        results = [_typed(emitter.run(x, parts), variables) for x in branches]
        return [
            each(lambda *cases: arithmetic.choose(index, list(cases)), [*map(entries_in, column)])
            for column, v in zip(zip(*results), variables)
        ]
    found = Slots(emitter, variables)
    for i, program in enumerate(branches):
        mask: Entry
        if index.kind == "b":
            mask = index if i == 1 else arithmetic.invert(index)
        else:
            mask = arithmetic.compare("eq", index, DTYPES[index.kind].type(i))
        assert isinstance(mask, Value)
        taken, done = builder.fresh("branch"), builder.fresh("joined")
        builder.line(f"br i1 {builder.any(mask)}, label %{taken}, label %{done}")
        builder.begin(taken)

        def carry_out(program=program, mask=mask, first=i == 0) -> None:
            results = _typed(emitter.run(program, parts), variables)
            if not first:
                results = [_kept(emitter, whole(mask), new, old) for new, old in zip(results, found.load())]
            found.store(results)

        builder.inside(carry_out)
        builder.line(f"br label %{done}")
        builder.begin(done)
    return found.finished()
