"""Arrays in the workspace: where they lie, their rows, and copies of them.

Place in the pipeline: builder, entries -> **memory** -> loops, places, programs.

Arrays whose axes were exchanged, or that are a part of another one, still lie evenly: so far from one entry to the next
along each axis.  Their rows are read where they are, and what has to be copied is copied in loops.
"""

import functools
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from rfem_jax.kernels.builder import DTYPES, Builder, Entry, Rows, Stored, is_known
from rfem_jax.kernels.entries import Entries, of_shape, whole

LARGEST_UNROLLED_COPY = 64  # entries


class Location:
    """An array in the workspace: the slots of its entries, all so many rows after these.

    The results of all turns of a loop are many entries, of which another loop reads rows: they are made where an
    operation takes them one by one.
    """

    def __init__(self, builder: Builder, kind: str, slots: np.ndarray, rows: Rows = ()) -> None:
        self.builder, self.kind, self.slots, self.rows = builder, kind, slots, rows
        self.shape, self.size = slots.shape, slots.size

    def moved(self, slots: np.ndarray) -> "Location":
        """What is in other slots."""
        return Location(self.builder, self.kind, slots, self.rows)

    @functools.cached_property
    def entries(self) -> Entries:
        """The entries one by one; what is in a slot is one of them, also where it stands several times."""
        slots = self.slots.ravel().tolist()
        made = {slot: Stored(self.builder, self.kind, slot, self.rows) for slot in slots}
        return of_shape((made[slot] for slot in slots), self.shape)


Array = Entries | Location


def entries_in(array: Array) -> Entries:
    """An array's entries one by one."""
    return array.entries if isinstance(array, Location) else array


def row_at(rows: Array, i: int) -> Array:
    """A row whose number is known."""
    return rows.moved(np.asarray(rows.slots[i])) if isinstance(rows, Location) else whole(rows[i])


def stored(builder: Builder, kind: str, slot: int, shape: Sequence[int]) -> Location:
    """An array that is in the workspace from a slot on."""
    return Location(builder, kind, np.asarray(slot + np.arange(math.prod(shape)).reshape(shape)))


def location_of(array: Array) -> Location | None:
    """Where an array is in the workspace; None of one that is elsewhere, or scattered over several rows."""
    if isinstance(array, Location):
        return array if array.size else None
    found = [*array.flat]
    if not found or not all(isinstance(x, Stored) for x in found) or len({(x.kind, x.rows) for x in found}) > 1:
        return None
    slots = np.array([x.slot for x in found]).reshape(array.shape)
    return Location(found[0].builder, found[0].kind, slots, found[0].rows)


def in_one_piece(builder: Builder, entries: Array, kind: str) -> int:
    """First slot of an array of a kind, or of a copy of it if it is not in the workspace in one piece."""
    found = location_of(entries)
    if found is not None and found.kind == kind and not found.rows:
        first = int(found.slots.flat[0])
        if (found.slots.ravel() == first + np.arange(found.slots.size)).all():
            return first
    first = builder.reserve(entries.size)
    copy(builder, entries, kind, first)
    return first


def copy(builder: Builder, array: Array, kind: str, first: int, rows: Rows = ()) -> None:
    """Put an array into the workspace, from a slot on, or so many rows after it."""
    long = array.size > LARGEST_UNROLLED_COPY
    if long and not isinstance(array, Location) and all(map(is_known, array.flat)):
        table = builder.table(kind, np.array([*array.flat], DTYPES[kind]))
        builder.counted(array.size, lambda i: builder.store_number(kind, table, i, first, (*rows, (i, 1))))
        return
    found = location_of(array) if long else None
    steps = None if found is None or found.kind != kind else _steps(found.slots)
    if found is None or steps is None:
        for i, entry in enumerate(entries_in(array).flat):
            builder.store(entry, kind, first + i, rows)
        return
    source = int(found.slots.flat[0])

    def copy_from(axis: int, there: Rows, here: Rows) -> None:
        if axis == len(steps):
            builder.store(builder.load(kind, source, there), kind, first, here)
            return
        length, step = steps[axis]
        own = math.prod(n for n, _ in steps[axis + 1 :])
        builder.counted(length, lambda i: copy_from(axis + 1, (*there, (i, step)), (*here, (i, own))))

    copy_from(0, found.rows, rows)


def steps_of(slots: np.ndarray) -> list[int] | None:
    """How many slots it is from one entry to the next along every axis; None unless that is the same everywhere."""
    first = int(slots.flat[0])
    places, steps = np.full(slots.shape, first), []
    for axis, length in enumerate(slots.shape):
        at = tuple(int(k == axis) for k in range(slots.ndim))
        steps.append(int(slots[at]) - first if length > 1 else 0)
        places += steps[-1] * np.arange(length).reshape([length if k == axis else 1 for k in range(slots.ndim)])
    return steps if (places == slots).all() else None


def _steps(slots: np.ndarray) -> list[tuple[int, int]] | None:
    """Length of every axis with more than one entry, and `steps_of` it. Axes that follow each other without a gap are
    one."""
    steps, found = steps_of(slots), []
    if steps is None:
        return None
    for length, step in zip(slots.shape, steps):
        if length == 1:
            continue
        if found and found[-1][1] == step * length:
            found[-1] = found[-1][0] * length, step
        else:
            found.append((length, step))
    return found


class Column(NamedTuple):
    """An entry of every row: where it is in the first one, and how many slots it is to the next row."""

    slot: int
    step: int
    rows: Rows


def columns_of(builder: Builder, rows: Array, kind: str) -> list[Column | Entry]:
    """The entries of rows (rows, ...): columns in the workspace, where need be copies, and entries that all rows
    share."""
    if isinstance(rows, Location):
        slots = rows.slots.reshape(len(rows.slots), -1)
        return [_column(builder, rows.moved(column), kind) for column in slots.T]
    return [_column(builder, column, kind) for column in rows.reshape(len(rows), -1).T]


def _column(builder: Builder, column: Array, kind: str) -> Column | Entry:
    if not isinstance(column, Location):
        first = column[0]
        if is_known(first):
            same = all(is_known(x) for x in column) and len({np.asarray(x).tobytes() for x in column}) == 1
        else:
            same = all(x is first for x in column)
        if same:
            return first
    found = location_of(column)
    if found is not None and found.kind == kind:
        steps = np.diff(found.slots)
        if (steps == steps[0]).all():
            return Column(int(found.slots[0]), int(steps[0]), found.rows) if steps[0] else found.entries[0]
    slot = builder.reserve(column.size)
    copy(builder, column, kind, slot)
    return Column(slot, 1, ())


def row_of(builder: Builder, kind: str, columns: Sequence[Column | Entry], shape: Sequence[int], at: str) -> Entries:
    """The row whose number is a scalar."""
    return of_shape(
        [Stored(builder, kind, x.slot, (*x.rows, (at, x.step))) if isinstance(x, Column) else x for x in columns], shape
    )
