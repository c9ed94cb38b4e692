"""Rows of an array in another order, as one operation of JAX.

Place in the pipeline: algebra, elasticity use it where rows are exchanged within a formula.

Slices joined together would do the same, but XLA merges them into the formulas around: an entry is then found by
branches, and where such formulas stand in each other, every branch has its own copy of what is inside.  A gather
has no branches.  Its transpose in JAX is a scatter, which XLA writes as a loop over the rows; that of an order is
the order back.
"""

import jax
import numpy as np
from jax import Array, lax
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

_reorder = Primitive("reorder")


def reorder(values: Array, order, axis: int = 0) -> Array:
    """Rows `order[0]`, `order[1]`, ... of an axis; `order` has each of its places once."""
    order = tuple(int(place) for place in order)
    if sorted(order) != list(range(values.shape[axis])):
        raise ValueError(f"{order} is no order of {values.shape[axis]} rows")
    return _reorder.bind(values, order=order, axis=axis)


def _gathered(values, *, order, axis):
    sizes = list(values.shape)
    sizes[axis] = 1
    numbers = lax.GatherDimensionNumbers(
        offset_dims=tuple(i for i in range(values.ndim) if i != axis),
        collapsed_slice_dims=(axis,),
        start_index_map=(axis,),
    )
    places = np.asarray(order, np.int32)[:, None]
    return lax.gather(values, places, numbers, sizes, unique_indices=True, mode="promise_in_bounds")


def _reordered(values, *, order, axis):
    return jax.jit(_gathered, static_argnames=("order", "axis"))(values, order=order, axis=axis)


def _reordered_back(cotangent, values, *, order, axis):
    back = tuple(int(place) for place in np.argsort(np.array(order, int)))
    return [_reorder.bind(cotangent, order=back, axis=axis)]


def _batched(arguments, axes, *, order, axis):
    (values,), (batch,) = arguments, axes
    return _reorder.bind(values, order=order, axis=axis + (batch <= axis)), batch


_reorder.def_impl(_reordered)
_reorder.def_abstract_eval(lambda values, *, order, axis: values)
ad.deflinear2(_reorder, _reordered_back)
batching.primitive_batchers[_reorder] = _batched
mlir.register_lowering(_reorder, mlir.lower_fun(_gathered, multiple_results=False))
