"""Entries at places: windows that are read or written where a number says, known or computed, and sorted entries.

Place in the pipeline: arithmetic, memory -> **places** -> emission, whose emitter has these rules.
"""

import functools
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from rfem_jax.kernels.arithmetic import Arithmetic, common_kind
from rfem_jax.kernels.builder import DTYPES, Builder, Entry, Unsupported, Value, is_known, kind_of
from rfem_jax.kernels.entries import Entries, each, numbers, of_shape
from rfem_jax.kernels.memory import copy, in_one_piece

Shape = tuple[int, ...]
# Gathers that are remembered, of so many entries: the same come again in every derivative.
MOST_WINDOWS, MOST_ENTRIES = 4000, 4000


@functools.lru_cache(maxsize=MOST_WINDOWS)
def _windows(indices: bytes, shape: Shape, dimensions: Any, sizes: Shape, of: Shape) -> np.ndarray:
    """Where the windows of a gather are in the entries of an array whose shape is `of`, in the order of its result.

    **Arguments:** `indices` of the windows, int64, in an array of this `shape`; `dimensions`, and `sizes` of windows,
    as the primitive has them.

    **Raises:** `Unsupported` for a window that is not within the array.
    """
    known = np.frombuffer(indices, np.int64).reshape(shape)
    places = known.shape[:-1]
    starts = np.zeros((*places, len(of)), int)
    starts[..., list(dimensions.start_index_map)] = known
    for axis, batch in zip(dimensions.operand_batching_dims, dimensions.start_indices_batching_dims):
        starts[..., axis] = np.arange(places[batch]).reshape([-1 if i == batch else 1 for i in range(len(places))])
    if (starts < 0).any() or (starts + sizes > of).any():
        raise Unsupported("gather of what is outside of an array")
    steps = np.array([math.prod(of[i + 1 :]) for i in range(len(of))], int)
    within = np.tensordot(np.indices(sizes), steps, (0, 0)) if sizes else np.zeros((), int)
    taken = np.asarray((starts @ steps).reshape((*places, *[1] * len(sizes))) + within)
    gone = (*dimensions.collapsed_slice_dims, *dimensions.operand_batching_dims)
    left = (size for axis, size in enumerate(sizes) if axis not in gone)
    taken = taken.reshape((*places, *left))
    return np.moveaxis(taken, range(len(places), taken.ndim), dimensions.offset_dims)


class Places:
    """Rules of primitives of JAX, by their names."""

    builder: Builder
    arithmetic: Arithmetic

    def _gather(self, equation, operand, indices):
        known = numbers(indices, np.int64)
        if known is None:
            return [self._gathered_rows(equation, operand, indices)]
        numbers_, sizes = equation.params["dimension_numbers"], equation.params["slice_sizes"]
        few = known.size * math.prod(sizes) <= MOST_ENTRIES
        windows = _windows if few else _windows.__wrapped__
        return [operand.ravel()[windows(known.tobytes(), known.shape, numbers_, sizes, operand.shape)]]

    def _gathered_rows(self, equation, operand, indices):
        """Windows at places that are values, of an index by lane."""
        numbers_, sizes = equation.params["dimension_numbers"], equation.params["slice_sizes"]
        places = indices.shape[:-1]
        gone = (*numbers_.collapsed_slice_dims, *numbers_.operand_batching_dims)
        kept = [size for axis, size in enumerate(sizes) if axis not in gone]
        taken = np.empty((*places, *kept), object)
        for place in np.ndindex(*places):
            starts = [np.int64(0)] * operand.ndim
            for axis, of in zip(numbers_.operand_batching_dims, numbers_.start_indices_batching_dims):
                starts[axis] = np.int64(place[of])
            for axis, index in zip(numbers_.start_index_map, indices[place]):
                starts[axis] = index
            taken[(*place, ...)] = self._window(operand, starts, sizes).reshape(kept)
        return np.moveaxis(taken, range(len(places), taken.ndim), numbers_.offset_dims)

    def _dynamic_slice(self, equation, operand, *starts):
        return [self._window(operand, [x[()] for x in starts], equation.params["slice_sizes"])]

    def _clamped(self, start: Entry, largest: int) -> Entry:
        arithmetic = self.arithmetic
        start = arithmetic.convert(start, np.dtype(np.int64))
        return arithmetic.smaller(arithmetic.larger(start, np.int64(0)), np.int64(largest))

    def _window(self, operand: Entries, starts: Sequence[Entry], sizes: Sequence[int]) -> Entries:
        """Entries from places on that may be values, which are moved so far that the window is within the array."""
        starts = [self._clamped(a, n - size) for a, n, size in zip(starts, operand.shape, sizes)]
        if not operand.size:
            return np.empty(sizes, object)
        fixed = tuple(slice(int(a), int(a) + n) if is_known(a) else slice(None) for a, n in zip(starts, sizes))
        operand = operand[fixed]
        moving = [(axis, a) for axis, a in enumerate(starts) if not is_known(a)]
        if not moving:
            return operand
        if 0 in sizes:
            return np.empty(sizes, object)
        row = self._row_of(operand.shape, moving)
        places = np.arange(operand.size).reshape(operand.shape)[tuple(slice(0, n) for n in sizes)]
        kind = common_kind(operand.flat)
        known = numbers(operand, DTYPES[kind])
        if known is not None:
            table = self.builder.table(kind, known.ravel())
            found = [self.builder.gather_of_table(kind, table, int(place), row) for place in places.flat]
            return of_shape(found, sizes)
        first = in_one_piece(self.builder, operand, kind)
        found = [self.builder.gather(kind, first + int(place), row) for place in places.flat]
        return of_shape(found, sizes)

    def _row_of(self, shape: Sequence[int], moving: Sequence[tuple[int, Entry]]) -> Value:
        """How many entries after the first one a window begins."""
        total: Entry = np.int64(0)
        for axis, start in moving:
            stride = np.int64(math.prod(shape[axis + 1 :]))
            total = self.arithmetic.add(total, self.arithmetic.multiply(start, stride))
        assert isinstance(total, Value)
        return total

    def _dynamic_update_slice(self, equation, operand, update, *starts):
        return [self._updated(operand, update, [a[()] for a in starts])]

    def _updated(self, operand: Entries, update: Entries, starts: Sequence[Entry]) -> Entries:
        """An array with a window at places that may be values, which is moved so far that it is within the array."""
        if not update.size:
            return operand
        starts = [self._clamped(a, n - m) for a, n, m in zip(starts, operand.shape, update.shape)]
        moving = [(axis, a) for axis, a in enumerate(starts) if not is_known(a)]
        within = tuple(slice(int(a), int(a) + n) if is_known(a) else slice(0, n) for a, n in zip(starts, update.shape))
        if not moving:
            operand = operand.copy()
            operand[within] = update
            return operand
        kind = common_kind(operand.flat)
        first = self.builder.reserve(operand.size)
        copy(self.builder, operand, kind, first)
        row = self._row_of(operand.shape, moving)
        places = np.arange(operand.size).reshape(operand.shape)[within]
        for place, entry in zip(places.flat, update.flat):
            self.builder.scatter(entry, kind, first + int(place), row)
        return of_shape([self.builder.load(kind, first + i) for i in range(operand.size)], operand.shape)

    def _scatter(self, equation, operand, indices, updates):
        return [self._scattered(equation, operand, indices, updates, lambda old, new: new)]

    def _scatter_add(self, equation, operand, indices, updates):
        return [self._scattered(equation, operand, indices, updates, self.arithmetic.add)]

    def _scattered(self, equation, operand, indices, updates, combined: Callable) -> Entries:
        """Updates at places that are known."""
        known = numbers(indices, np.int64)
        settings = equation.params["dimension_numbers"]
        if known is None or settings.operand_batching_dims:
            return self._scattered_by_lane(operand, indices, updates, settings, combined)
        operand = operand.copy()
        windows = settings.update_window_dims
        batch_axes = [i for i in range(updates.ndim) if i not in windows]
        window_axes = [i for i in range(operand.ndim) if i not in settings.inserted_window_dims]
        for place in np.ndindex(*updates.shape):
            index = known[tuple(place[i] for i in batch_axes)]
            at = np.zeros(operand.ndim, int)
            at[window_axes] = [place[i] for i in windows]
            at[list(settings.scatter_dims_to_operand_dims)] += index
            if (at < 0).any() or (at >= operand.shape).any():
                raise Unsupported("scatter to what is outside of an array")
            operand[tuple(at)] = combined(operand[tuple(at)], updates[place])
        return operand

    def _scattered_by_lane(self, operand, indices, updates, settings, combined: Callable) -> Entries:
        """Windows at places that are values, one after the other; nothing where one is outside of the array."""
        arithmetic = self.arithmetic
        single = (*settings.inserted_window_dims, *settings.operand_batching_dims)
        left = (updates.shape[i] for i in settings.update_window_dims)
        sizes = [1 if axis in single else next(left) for axis in range(operand.ndim)]
        batch_axes = [i for i in range(updates.ndim) if i not in settings.update_window_dims]
        for place in np.ndindex(*indices.shape[:-1]):
            starts, inside = [np.int64(0)] * operand.ndim, np.bool_(True)
            for axis, of in zip(settings.operand_batching_dims, settings.scatter_indices_batching_dims):
                starts[axis] = np.int64(place[of])
            for axis, index in zip(settings.scatter_dims_to_operand_dims, indices[place]):
                index = arithmetic.convert(index, np.dtype(np.int64))
                within = arithmetic.compare("le", index, np.int64(operand.shape[axis] - sizes[axis]))
                inside = arithmetic.function("and", inside, within)
                inside = arithmetic.function("and", inside, arithmetic.compare("ge", index, np.int64(0)))
                starts[axis] = index
            update = np.moveaxis(updates, batch_axes, range(len(batch_axes)))[(*place, ...)]
            old = self._window(operand, starts, sizes)
            new = each(lambda a, b: arithmetic.select(inside, combined(a, b), a), [old, update.reshape(sizes)])
            operand = self._updated(operand, new, starts)
        return operand

    def _sort(self, equation, *parts):
        """Of one axis, by one key: every entry goes to the place that as many others are before."""
        if parts[0].ndim != 1 or equation.params["num_keys"] != 1:
            raise Unsupported("sort of several axes or by several keys")
        arithmetic, keys = self.arithmetic, parts[0]
        zero, one = np.int64(0), np.int64(1)
        ranks = []
        for i, key in enumerate(keys):
            before = (arithmetic.function("le_to" if j < i else "lt_to", other, key) for j, other in enumerate(keys))
            counts = [arithmetic.select(b, one, zero) for j, b in enumerate(before) if j != i]
            ranks.append(functools.reduce(arithmetic.add, counts, zero))
        found = []
        for part, variable in zip(parts, equation.outvars):
            kind, first = kind_of(variable.aval.dtype), self.builder.reserve(part.size)
            for entry, rank in zip(part, ranks):
                if is_known(rank):
                    self.builder.store(entry, kind, first + int(rank))
                else:
                    self.builder.scatter(entry, kind, first, rank)
            found.append(of_shape([self.builder.load(kind, first + i) for i in range(part.size)], part.shape))
        return found
