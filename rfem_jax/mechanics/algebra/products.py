"""Products of vectors and matrices as primitives of JAX.

Place in the pipeline: used by algebra.

Written by JAX's operations, a product of matrices is four of them and a cross product six, and Python traces each of
these by itself, differentiates, transposes and batches it, before XLA sees a program.  Here either is one operation to
all these transformations, and so is a sum of such products, which is what the derivative of one is.  XLA is given the
products and sums that these operations were.
"""

import functools
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

from rfem_jax.mechanics.algebra.reordering import reorder

Labels = tuple[int, ...]

_sum_of_products = Primitive("sum_of_products")
_cross_product = Primitive("cross_product")


def contract(first: Labels, second: Labels, result: Labels, a: Array | np.ndarray, b: Array | np.ndarray) -> Array:
    """Products of two arrays, summed over the axes whose labels the result does not have.

    **Arguments:** `first`, `second`, `result`: labels of the leading axes of both arrays and of the result; the later
    axes of both, equally many, are those of the result, too, and broadcast.

    **Raises:** `ValueError` for numbers of axes that do not fit.
    """
    axes, shapes = _broadcast(first, second, result, np.shape(a), np.shape(b))
    a, b = (x if np.shape(x) == shape else jnp.reshape(x, shape) for x, shape in zip((a, b), shapes))
    return _sum_of_products.bind(a, b, axes=axes[:2], result=axes[2])


def contract_constant(
    first: Labels, second: Labels, result: Labels, a: Array | np.ndarray, constant: np.ndarray
) -> Array:
    """`contract` with an array that has no later axes."""
    later = tuple(range(100, 100 + np.ndim(a) - len(first)))
    return _sum_of_products.bind(a, constant, axes=((*first, *later), second), result=(*result, *later))


def combine(weights: Sequence[Array | np.ndarray], matrices: Sequence[np.ndarray]) -> Array:
    """Sum of constant matrices (m, n) with weights (...), all of one shape, as one matrix (m, n, ...)."""
    later = tuple(range(2, 2 + weights[0].ndim))
    operands = [x for pair in zip(weights, matrices, strict=True) for x in pair]
    return _sum_of_products.bind(*operands, axes=(later, (0, 1)) * len(weights), result=(0, 1, *later))


@functools.cache
def _broadcast(first: Labels, second: Labels, result: Labels, a: tuple[int, ...], b: tuple[int, ...]):
    """Labels of all axes of both arrays and of the result, and shapes of both without the axes that are broadcast."""
    a_later, b_later = a[len(first) :], b[len(second) :]
    if len(a_later) != len(b_later):
        raise ValueError(
            f"Arrays of shapes {a} and {b} must have equally many axes after those of {first} and {second}."
        )
    later = [100 + i for i in range(len(a_later))]
    a_kept = [label for label, n, other in zip(later, a_later, b_later) if n != 1 or other == 1]
    b_kept = [label for label, n, other in zip(later, b_later, a_later) if n != 1 or other == 1]
    shapes = [
        (*shape[: len(own)], *(n for label, n in zip(later, shape[len(own) :]) if label in kept))
        for own, shape, kept in ((first, a, a_kept), (second, b, b_kept))
    ]
    return ((*first, *a_kept), (*second, *b_kept), (*result, *later)), shapes


def cross(a: Array | np.ndarray, b: Array | np.ndarray) -> Array:
    """Vector products along the first axis; the later axes broadcast."""
    return _cross_product.bind(a, b, axis=0)


def _sizes(operands: Sequence, axes: tuple[Labels, ...]) -> dict[int, int]:
    """Length of the axes of each label."""
    sizes: dict[int, int] = {}
    for operand, labels in zip(operands, axes, strict=True):
        for label, n in zip(labels, operand.shape, strict=True):
            if sizes.setdefault(label, n) != n:
                raise ValueError(
                    f"Axes that are multiplied must be of one length, but have {sizes[label]} and {n} entries."
                )
    return sizes


@functools.cache
def _order(axes: tuple[Labels, ...], result: Labels) -> Labels:
    """All labels, in an order in which as many operands as possible need not be transposed."""
    order: list[int] = []
    for labels in (result, *axes):
        for place, label in enumerate(labels):
            if label not in order:
                after = [order.index(other) for other in labels[place + 1 :] if other in order]
                order.insert(min(after, default=len(order)), label)
    return tuple(order)


def _sum_by_operations(*operands, axes: tuple[Labels, ...], result: Labels) -> Array:
    """The sum of the products of neighbouring operands by JAX's own operations."""
    order, sizes = _order(axes, result), _sizes(operands, axes)
    spread = []
    for operand, labels in zip(operands, axes):
        places = [order.index(label) for label in labels]
        operand = lax.transpose(operand, np.argsort(places)) if places != sorted(places) else operand
        spread.append(lax.broadcast_in_dim(operand, [sizes[label] for label in order], sorted(places)))
    total = functools.reduce(lax.add, map(lax.mul, spread[::2], spread[1::2]))
    summed = [place for place, label in enumerate(order) if label not in result]
    total = lax.reduce_sum(total, summed) if summed else total
    left = [label for label in order if label in result]
    return total if left == list(result) else lax.transpose(total, [left.index(label) for label in result])


def _cross_by_operations(*operands, axis: int) -> Array:
    """The sum of the cross products of neighbouring operands by JAX's own operations."""

    def cycle(x):
        return reorder(x, (1, 2, 0), axis)

    pairs = list(zip(operands[::2], operands[1::2]))
    forth = functools.reduce(jnp.add, [a * cycle(b) for a, b in pairs])
    back = functools.reduce(jnp.add, [cycle(a) * b for a, b in pairs])
    return cycle(forth - back)


def _sum_type(*operands, axes: tuple[Labels, ...], result: Labels) -> ShapedArray:
    sizes = _sizes(operands, axes)
    return ShapedArray(tuple(sizes[label] for label in result), _dtype(operands))


def _cross_type(*operands, axis: int) -> ShapedArray:
    return ShapedArray(np.broadcast_shapes(*(operand.shape for operand in operands)), _dtype(operands))


def _dtype(operands) -> np.dtype:
    (dtype,) = {operand.dtype for operand in operands}
    return dtype


def _derivative(primitive: Primitive):
    """Rule of forward mode: the tangent of a sum of products is a sum of products, too."""

    def rule(primals, tangents, **settings):
        value = primitive.bind(*primals, **settings)
        axes = settings.get("axes", (None,) * len(primals))
        terms = []
        for first in range(0, len(primals), 2):
            for moving in (first, first + 1):
                if type(tangents[moving]) is not ad.Zero:
                    pair = [tangents[i] if i == moving else primals[i] for i in (first, first + 1)]
                    terms += zip(pair, axes[first : first + 2], strict=True)
        given, of_terms = zip(*terms)
        return value, primitive.bind(*given, **settings | ({"axes": of_terms} if "axes" in settings else {}))

    return rule


def _transposed(back):
    """The rule of reverse mode; `back`: cotangent of the operand at a place from that of the result."""

    def rule(cotangent, *operands, **settings):
        cotangents: list = [None] * len(operands)
        for place, operand in enumerate(operands):
            if ad.is_undefined_primal(operand):
                nothing = type(cotangent) is ad.Zero
                cotangents[place] = ad.Zero(operand.aval) if nothing else back(cotangent, operands, place, **settings)
        return cotangents

    return rule


def _sum_back(cotangent, operands, place: int, *, axes, result):
    other = place ^ 1
    return _sum_of_products.bind(cotangent, operands[other], axes=(result, axes[other]), result=axes[place])


def _cross_back(cotangent, operands, place: int, *, axis):
    pair = (operands[place ^ 1], cotangent) if place % 2 == 0 else (cotangent, operands[place ^ 1])
    found, shape = _cross_product.bind(*pair, axis=axis), operands[place].aval.shape
    spread = tuple(i for i, (n, m) in enumerate(zip(shape, found.shape)) if n != m)
    return jnp.sum(found, axis=spread, keepdims=True) if spread else found


def _sum_batched(operands, batches, *, axes, result):
    label = 1 + max(label for labels in axes for label in labels)
    widened = [
        labels if batch is None else (*labels[:batch], label, *labels[batch:])
        for labels, batch in zip(axes, batches, strict=True)
    ]
    last = all(b is None or b == len(labels) for labels, b in zip(axes, batches))
    place = len(result) if last else 0
    result = (*result[:place], label, *result[place:])
    return _sum_of_products.bind(*operands, axes=tuple(widened), result=result), place


def _cross_batched(operands, batches, *, axis):
    place = next(batch for batch in batches if batch is not None)
    moved = [
        x if batch == place else jnp.expand_dims(x, place) if batch is None else jnp.moveaxis(x, batch, place)
        for x, batch in zip(operands, batches)
    ]
    return _cross_product.bind(*moved, axis=axis + (place <= axis)), place


def _define(primitive: Primitive, by_operations, type_of, back, batched) -> None:
    names = ("axis",) if primitive is _cross_product else ("axes", "result")
    primitive.def_impl(jax.jit(by_operations, static_argnames=names))
    primitive.def_abstract_eval(type_of)
    ad.primitive_jvps[primitive] = _derivative(primitive)
    ad.primitive_transposes[primitive] = _transposed(back)
    batching.primitive_batchers[primitive] = batched
    mlir.register_lowering(primitive, mlir.lower_fun(by_operations, multiple_results=False))


_define(_sum_of_products, _sum_by_operations, _sum_type, _sum_back, _sum_batched)
_define(_cross_product, _cross_by_operations, _cross_type, _cross_back, _cross_batched)
