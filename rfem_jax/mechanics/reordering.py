"""Permutation of the rows of an array as one primitive of JAX.

Place in the pipeline: used by algebra and the elements where rows are exchanged within a formula.

Concatenated slices would do the same, but XLA fuses them into the formulas around them: every entry is then
selected by branches, and where such formulas are nested, every branch has its own copy of the inner one.  A
gather has no branches.  Its transpose in JAX is a scatter, which XLA compiles to a loop over the rows; here it is
the gather of the inverse permutation.
"""

from collections.abc import Sequence

import jax
import numpy as np
from jax import Array, lax
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

_reorder = Primitive("reorder")


def reorder(values: Array | np.ndarray, order: Sequence[int] | np.ndarray, axis: int = 0) -> Array:
    """Rows `order[0]`, `order[1]`, ... of an axis; `order` is a permutation of its places.

    **Raises:** `ValueError` if it is none.
    """
    order = tuple(int(place) for place in order)
    if sorted(order) != list(range(values.shape[axis])):
        raise ValueError(f"{order} is no permutation of {values.shape[axis]} rows")
    return _reorder.bind(values, order=order, axis=axis)


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


def _implementation(values: Array | np.ndarray, *, order: tuple[int, ...], axis: int) -> Array:
    return jax.jit(_gather, static_argnames=("order", "axis"))(values, order=order, axis=axis)


def _transpose(cotangent, values, *, order, axis):
    inverse = tuple(int(place) for place in np.argsort(np.array(order, int)))
    return [_reorder.bind(cotangent, order=inverse, axis=axis)]


def _batch(arguments, axes, *, order, axis):
    (values,), (batch,) = arguments, axes
    return _reorder.bind(values, order=order, axis=axis + (batch <= axis)), batch


_reorder.def_impl(_implementation)
_reorder.def_abstract_eval(lambda values, *, order, axis: values)
ad.deflinear2(_reorder, _transpose)
batching.primitive_batchers[_reorder] = _batch
mlir.register_lowering(_reorder, mlir.lower_fun(_gather, multiple_results=False))
