"""Functions of JAX with results of NumPy."""

import functools
from collections.abc import Callable

import jax
import numpy as np


def evaluated(function: Callable) -> Callable:
    """The function under `jax.jit`, with arrays of NumPy as its results."""
    compiled = jax.jit(function)

    @functools.wraps(function)
    def of_numpy(*arguments):
        return jax.tree.map(np.array, compiled(*arguments))

    return of_numpy
