"""Numbers that may be traced: formulas of a description that serve a design as well.

Place in the pipeline: sections, materials, rigid_bodies, building write their formulas with these.

A description holds floats, and NumPy computes with them on the host. A design puts traced scalars in their places, and
the same formulas are then operations of JAX.
"""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

Number = float | Float[np.ndarray, ""] | Float[Array, ""]


def traced(values: Any) -> bool:
    """Whether any number of nested sequences is an array of JAX."""
    if isinstance(values, (list, tuple)):
        return any(traced(one) for one in values)
    return isinstance(values, jax.Array)


def array_of(values: Any) -> Float[np.ndarray, "*shape"] | Float[Array, "*shape"]:
    """Nested sequences of numbers of equal lengths as an array, of JAX where any number is one."""
    if not traced(values):
        return np.array(values, dtype=float)
    if isinstance(values, (list, tuple)):
        return jnp.stack([jnp.asarray(array_of(one)) for one in values])
    return jnp.asarray(values, jnp.float64)


def larger(one: Number, other: Number) -> Number:
    """The larger of two numbers."""
    return jnp.maximum(one, other) if traced((one, other)) else np.maximum(one, other)


def smaller(one: Number, other: Number) -> Number:
    """The smaller of two numbers."""
    return jnp.minimum(one, other) if traced((one, other)) else np.minimum(one, other)


def chosen(condition: bool | Bool[np.ndarray, ""] | Bool[Array, ""], one: Number, other: Number) -> Number:
    """The first number where a condition holds, else the second one."""
    return jnp.where(condition, one, other) if traced((condition, one, other)) else one if condition else other


def rotation_of_angles(angles: Sequence[Number]) -> Float[np.ndarray, "3 3"] | Float[Array, "3 3"]:
    """R = R_z R_y R_x of three angles about x, y, z [rad]."""
    module: Any = jnp if traced(angles) else np
    (cx, cy, cz), (sx, sy, sz) = (tuple(f(angle) for angle in angles) for f in (module.cos, module.sin))
    rx = array_of([[1.0, 0.0, 0.0], [0.0, cx, -sx], [0.0, sx, cx]])
    ry = array_of([[cy, 0.0, sy], [0.0, 1.0, 0.0], [-sy, 0.0, cy]])
    rz = array_of([[cz, -sz, 0.0], [sz, cz, 0.0], [0.0, 0.0, 1.0]])
    return rz @ ry @ rx
