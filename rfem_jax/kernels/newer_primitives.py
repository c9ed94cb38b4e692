"""Primitives that newer versions of JAX have for what older ones made of several.

Place in the pipeline: emission -> **newer_primitives**, which says there what they are made of.
"""

import functools
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

from rfem_jax.kernels.emission import expand_primitive


def one_minus_square(x: Array) -> Array:
    """1 - x^2, to all digits where x is close to one."""
    return (1 - x) * (1 + x)


def polynomial(x: Array, *coefficients: Array, unroll: int | None = None) -> Array:
    """Sum of coefficients times powers of x, the constant first, by Horner's rule."""
    del unroll
    backwards = coefficients[::-1]
    shape = np.broadcast_shapes(*(part.shape for part in (x, *coefficients)))
    return jnp.broadcast_to(functools.reduce(lambda total, one: total * x + one, backwards[1:], backwards[0]), shape)


def binary_logarithm(x: Array, **others: object) -> Array:
    """Logarithm to the base 2."""
    return jnp.log(x) * (1.0 / np.log(2.0))


def of_high_level(*operands: Array, **settings: Any) -> Any:
    """What a primitive of hijax is made of, as a search in a sorted array (of `jnp.interp`, `jnp.searchsorted`), in its
    own words: by the method that `jax.experimental.hijax.HiPrim` asks for."""
    (primitive,) = settings.values()
    return primitive.expand(*operands)


expand_primitive("call_hi_primitive", of_high_level)
expand_primitive("one_minus_square", one_minus_square)
expand_primitive("polynomial", polynomial)
expand_primitive("log2", binary_logarithm)
