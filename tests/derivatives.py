"""Derivatives in both modes, and differences, of a function of a few numbers, from two compiled programs.

The forward program gives the values beside the derivatives, so that differences need no program of their own.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np


class Jacobians(NamedTuple):
    """Values of a function, and their derivatives: axes of the values, then of the numbers."""

    values: np.ndarray
    forward: np.ndarray
    reverse: np.ndarray
    differences: np.ndarray


def jacobians(function: Callable, at: Any, steps: Any) -> Jacobians:
    """Derivatives of both modes, and central differences over `steps` to both sides, by one number after the other."""
    at = jnp.asarray(at, float)
    directions = np.eye(at.size).reshape(-1, *at.shape)
    distances = np.broadcast_to(steps, at.shape)

    @jax.jit
    def pushed(numbers, along):
        return jax.jvp(function, (numbers,), (along,))

    @jax.jit
    def pulled(numbers, weights):
        return jax.vjp(function, numbers)[1](weights)[0]

    def difference(along):
        ahead, behind = (pushed(at + sign * along * distances, along)[0] for sign in (1.0, -1.0))
        return (ahead - behind) / (2.0 * np.sum(along * distances))

    def by_numbers(columns):
        return np.stack([np.asarray(column) for column in columns], axis=-1).reshape(values.shape + at.shape)

    values, columns = zip(*(pushed(at, along) for along in directions), strict=True)
    values = np.asarray(values[0])
    rows = [pulled(at, weights) for weights in np.eye(values.size).reshape(-1, *values.shape)]
    reverse = np.stack([np.asarray(row) for row in rows]).reshape(values.shape + at.shape)
    return Jacobians(values, by_numbers(columns), reverse, by_numbers(map(difference, directions)))


def check_derivatives(
    function: Callable,
    at: Any,
    steps: Any,
    *,
    reverse: float,
    differences: float,
    floor: float = 0.0,
) -> Jacobians:
    """Assert that both modes agree within `reverse`, and with differences within `differences`: relative to the
    derivative, or to the share `floor` of the largest one if that is more."""
    found = jacobians(function, at, steps)
    assert np.isfinite(found.forward).all()
    scale = np.maximum(np.abs(found.forward), floor * np.abs(found.forward).max())
    for other, within in ((found.reverse, reverse), (found.differences, differences)):
        np.testing.assert_array_less(np.abs(other - found.forward), within * scale + np.finfo(float).tiny)
    return found
