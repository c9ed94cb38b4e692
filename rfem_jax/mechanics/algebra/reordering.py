"""Rows of an array exchanged, repeated and summed: each one primitive of JAX.

Place in the pipeline: used by algebra and the elements where rows are exchanged within a formula, by kinematics where
values by link are those of its rfes, or sums over them.

Concatenated slices would do the same, but XLA fuses them into the formulas around them: every entry is then
selected by branches, and where such formulas are nested, every branch has its own copy of the inner one.  A
gather has no branches.  Its transpose in JAX is a scatter, which XLA compiles to a loop over the rows; here it is
the gather of the inverse permutation.  Repeated rows and sums of neighbouring rows are the transposes of each other;
by slices either would be several operations for each group, all of which Python traces and differentiates.
"""

import functools
from collections.abc import Sequence

import jax
import numpy as np
from jax import Array, lax
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

MOST_RUNS = 4  # of neighbouring rows, which are taken as slices

_reorder, _repeat, _sum_groups = Primitive("reorder"), Primitive("repeat_rows"), Primitive("sum_row_groups")


def reorder(values: Array | np.ndarray, order: Sequence[int] | np.ndarray, axis: int = 0) -> Array:
    """Rows `order[0]`, `order[1]`, ... of an axis.

    **Raises:** `ValueError` if `order` is not a permutation of the axis's places.
    """
    order = tuple(int(place) for place in order)
    if sorted(order) != list(range(values.shape[axis])):
        raise ValueError(f"{order} is not a permutation of {values.shape[axis]} rows")
    return _reorder.bind(values, order=order, axis=axis)


def rows(values: Array | np.ndarray, places: Sequence[int] | np.ndarray, axis: int = 0) -> Array:
    """Rows at static places of an axis, each at most once."""
    places = np.asarray(places, int)
    runs = np.split(places, np.flatnonzero(np.diff(places) != 1) + 1)
    if len(runs) > MOST_RUNS or not places.size:
        return _gather(values, order=tuple(places.tolist()), axis=axis)
    # Slices, and what joins them, compile in a tenth of the time of a gather.
    parts = [lax.slice_in_dim(values, int(run[0]), int(run[-1]) + 1, axis=axis) for run in runs]
    return parts[0] if len(parts) == 1 else lax.concatenate(parts, axis)


def _gather(values: Array | np.ndarray, *, order: tuple[int, ...], axis: int) -> Array:
    sizes = list(values.shape)
    sizes[axis] = 1
    numbers = lax.GatherDimensionNumbers(
        offset_dims=tuple(i for i in range(values.ndim) if i != axis),
        collapsed_slice_dims=(axis,),
        start_index_map=(axis,),
    )
    places = np.asarray(order, np.int32)[:, None]
    return lax.gather(values, places, numbers, sizes, unique_indices=True, mode="promise_in_bounds")


def repeat(values: Array | np.ndarray, counts: Sequence[int], axis: int = -1) -> Array:
    """Row i of an axis `counts[i]` times, one after the other."""
    return _grouped(_repeat, values, counts, axis, len(counts))


def sum_groups(values: Array | np.ndarray, counts: Sequence[int], axis: int = -1) -> Array:
    """Sums of the first `counts[0]` rows of an axis, of the next `counts[1]`, and so on."""
    return _grouped(_sum_groups, values, counts, axis, sum(counts))


def _grouped(primitive: Primitive, values, counts: Sequence[int], axis: int, rows: int) -> Array:
    if values.shape[axis] != rows:
        raise ValueError(f"The counts {tuple(counts)} must be of {rows} rows, but the axis has {values.shape[axis]}.")
    return primitive.bind(values, counts=tuple(int(n) for n in counts), axis=axis % values.ndim)


def _repeated(values: Array, *, counts: tuple[int, ...], axis: int) -> Array:
    rows = [lax.slice_in_dim(values, row, row + 1, axis=axis) for row in range(len(counts))]
    shapes = [(*values.shape[:axis], n, *values.shape[axis + 1 :]) for n in counts]
    every = range(values.ndim)
    return lax.concatenate([lax.broadcast_in_dim(row, shape, every) for row, shape in zip(rows, shapes)], axis)


def _sums(values: Array, *, counts: tuple[int, ...], axis: int) -> Array:
    ends = np.cumsum(counts)
    parts = [lax.slice_in_dim(values, end - n, end, axis=axis) for end, n in zip(ends.tolist(), counts)]
    return lax.concatenate([lax.expand_dims(lax.reduce_sum(part, [axis]), [axis]) for part in parts], axis)


def _with_rows(values, axis: int, rows: int) -> ShapedArray:
    return ShapedArray((*values.shape[:axis], rows, *values.shape[axis + 1 :]), values.dtype)


def _repeated_type(values, *, counts, axis) -> ShapedArray:
    return _with_rows(values, axis, sum(counts))


def _sums_type(values, *, counts, axis) -> ShapedArray:
    return _with_rows(values, axis, len(counts))


def _add_rules(primitive: Primitive, by_operations, type_of, transpose) -> None:
    """Rules of a linear primitive along an axis; `transpose`: of a cotangent, with the settings of the primitive."""

    def batch(arguments, axes, *, axis, **settings):
        (values,), (place,) = arguments, axes
        return primitive.bind(values, axis=axis + (place <= axis), **settings), place

    # Operation by operation outside of `jit` it would be compiled as many times.
    compiled = functools.cache(lambda **settings: jax.jit(functools.partial(by_operations, **settings)))
    primitive.def_impl(lambda values, **settings: compiled(**settings)(values))
    primitive.def_abstract_eval(type_of)
    ad.deflinear2(primitive, lambda cotangent, _, **settings: [transpose(cotangent, **settings)])
    batching.primitive_batchers[primitive] = batch
    mlir.register_lowering(primitive, mlir.lower_fun(by_operations, multiple_results=False))


def _back(cotangent, *, order, axis):
    return _reorder.bind(cotangent, order=tuple(int(place) for place in np.argsort(np.array(order, int))), axis=axis)


_add_rules(_reorder, _gather, lambda values, *, order, axis: values, _back)
_add_rules(_repeat, _repeated, _repeated_type, _sum_groups.bind)
_add_rules(_sum_groups, _sums, _sums_type, _repeat.bind)
