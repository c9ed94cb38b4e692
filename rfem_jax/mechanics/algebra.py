"""Vectors, rotations and spatial vectors: the algebra that the mechanics is written in.

Layout. Components come first: a vector is (3, ...), a rotation or a matrix (3, 3, ...), a spatial
vector (6, ...) with the angular part first; every later axis (rigid finite elements, samples)
broadcasts.  The contiguous axis is thus the one with many equal operations, and no function here
needs a batched small matrix product, which XLA runs slowly on a CPU.

Spatial vectors (theory (2.11) to (2.13); Featherstone, Rigid Body Dynamics Algorithms, 2008, ch. 2)
are taken at the origin of the global frame, so that bodies share one reference point and no
transform is needed.
"""

import jax.numpy as jnp
import numpy as np
from jax import Array

from rfem_jax.mechanics.reordering import reorder

IDENTITY = np.eye(3)


def cross(a: Array, b: Array) -> Array:
    """Vector product of (3, ...) with (3, ...)."""
    return _cycled(a * _cycled(b) - _cycled(a) * b)


def _cycled(a: Array) -> Array:
    """Components (y, z, x)."""
    return reorder(a, (1, 2, 0))


def dot(a: Array, b: Array) -> Array:
    """Sum over the first axis of the product."""
    return jnp.sum(a * b, axis=0)


def apply(matrix: Array, vector: Array) -> Array:
    """Matrix (m, n, ...) times vector (n, ...)."""
    return jnp.sum(matrix * vector[None], axis=1)


def apply_transposed(matrix: Array, vector: Array) -> Array:
    """Transpose of a matrix (n, m, ...) times vector (n, ...)."""
    return jnp.sum(matrix * vector[:, None], axis=0)


def product(a: Array, b: Array) -> Array:
    """Matrix (m, n, ...) times matrix (n, k, ...)."""
    return jnp.sum(a[:, :, None] * b[None], axis=1)


def product_transposed(a: Array, b: Array) -> Array:
    """Matrix (m, n, ...) times the transpose of (k, n, ...)."""
    return jnp.sum(a[:, None] * b[None], axis=2)


def constant_product(matrix: Array, b: Array) -> Array:
    """Constant matrix (m, n) times (n, ...)."""
    return jnp.tensordot(matrix, b, axes=1)


def by_component(values: Array) -> Array:
    """(6, m, ...) as (6 m, ...): all first components, all second ones, and so on."""
    return values.reshape((6 * values.shape[1],) + values.shape[2:])


def transpose(matrix: Array) -> Array:
    """Exchange the first two axes."""
    return jnp.swapaxes(matrix, 0, 1)


def cross_matrix(a: Array) -> Array:
    """The matrix (3, 3, ...) of `a x`."""
    zero = jnp.zeros_like(a[0])
    return jnp.stack(
        [
            jnp.stack([zero, -a[2], a[1]]),
            jnp.stack([a[2], zero, -a[0]]),
            jnp.stack([-a[1], a[0], zero]),
        ]
    )


def rotation_x(angle: Array) -> Array:
    """Right-handed rotation about x, (3, 3, ...)."""
    c, s, one, zero = _rotation_entries(angle)
    return _matrix([[one, zero, zero], [zero, c, -s], [zero, s, c]])


def rotation_y(angle: Array) -> Array:
    """Right-handed rotation about y, (3, 3, ...)."""
    c, s, one, zero = _rotation_entries(angle)
    return _matrix([[c, zero, s], [zero, one, zero], [-s, zero, c]])


def rotation_z(angle: Array) -> Array:
    """Right-handed rotation about z, (3, 3, ...)."""
    c, s, one, zero = _rotation_entries(angle)
    return _matrix([[c, -s, zero], [s, c, zero], [zero, zero, one]])


def _rotation_entries(angle):
    one = jnp.ones_like(angle)
    return jnp.cos(angle), jnp.sin(angle), one, 0.0 * one


def _matrix(rows):
    return jnp.stack([jnp.stack(row) for row in rows])


def spatial(angular: Array, linear: Array) -> Array:
    """Spatial vector (6, ...) from its two halves (motion: at the origin; wrench: moment, force)."""
    return jnp.concatenate([angular, linear])


def wrench_at_origin(moment: Array, force: Array, point: Array) -> Array:
    """Wrench (6, ...) of a force at `point` and a moment, taken at the global origin."""
    return spatial(moment + cross(point, force), force)


def motion_at_origin(angular: Array, linear: Array, point: Array) -> Array:
    """Spatial velocity (6, ...) of a body that turns while its `point` moves, at the origin."""
    return spatial(angular, linear + cross(point, angular))


def motion_cross(velocity: Array, motion: Array) -> Array:
    """Spatial motion product `velocity x motion`."""
    w, v = velocity[:3], velocity[3:]
    return spatial(cross(w, motion[:3]), cross(w, motion[3:]) + cross(v, motion[:3]))


def force_cross(velocity: Array, wrench: Array) -> Array:
    """Spatial force product `velocity x* wrench`."""
    w, v = velocity[:3], velocity[3:]
    return spatial(cross(w, wrench[:3]) + cross(v, wrench[3:]), cross(w, wrench[3:]))


def spatial_inertia(mass: Array, centre: Array, inertia: Array) -> Array:
    """Spatial inertia (6, 6, ...) at the global origin of bodies with centres of mass (3, ...) and
    central inertia tensors (3, 3, ...) in global axes."""
    shift = cross_matrix(centre)
    first = mass[None, None] * shift
    identity = jnp.asarray(IDENTITY).reshape((3, 3) + (1,) * (centre.ndim - 1))
    upper = jnp.concatenate([inertia + product_transposed(first, shift), first], axis=1)
    lower = jnp.concatenate([-first, mass[None, None] * identity + 0.0 * first], axis=1)
    return jnp.concatenate([upper, lower])


def spatial_mobility(mass: Array, centre: Array, inverse: Array) -> Array:
    """Inverse of `spatial_inertia` (6, 6, ...), from the inverses (3, 3, ...) of the central inertia
    tensors; well conditioned where the matrix itself is not."""
    shift = cross_matrix(centre)
    turned = product(shift, inverse)
    identity = jnp.asarray(IDENTITY).reshape((3, 3) + (1,) * (centre.ndim - 1))
    upper = jnp.concatenate([inverse, transpose(turned)], axis=1)
    corner = product_transposed(turned, shift) + identity / mass[None, None]
    return jnp.concatenate([upper, jnp.concatenate([turned, corner], axis=1)])


def invert_positive(matrix: Array) -> Array:
    """Inverse of symmetric positive definite matrices (n, n, ...), n small and static.

    Block elimination down to blocks of at most three rows, whose inverse is the adjugate: no
    pivoting is needed, nothing is looped over at run time, and derivatives are plain.
    """
    n = matrix.shape[0]
    if n <= 3:
        return invert_block(matrix)
    k = 3 if n < 6 else n // 2
    a, b, d = matrix[:k, :k], matrix[:k, k:], matrix[k:, k:]
    a_inverse = invert_positive(a)
    ab = product(a_inverse, b)
    schur_inverse = invert_positive(d - product(transpose(b), ab))
    corner = -product(ab, schur_inverse)
    top = jnp.concatenate([a_inverse - product_transposed(corner, ab), corner], axis=1)
    bottom = jnp.concatenate([transpose(corner), schur_inverse], axis=1)
    return jnp.concatenate([top, bottom])


def invert_block(m: Array) -> Array:
    """Inverse of matrices (n, n, ...) with n <= 3 by the adjugate."""
    if m.shape[0] == 0:
        return m
    if m.shape[0] == 1:
        return 1.0 / m
    if m.shape[0] == 2:
        determinant = m[0, 0] * m[1, 1] - m[0, 1] * m[1, 0]
        return _matrix([[m[1, 1], -m[0, 1]], [-m[1, 0], m[0, 0]]]) / determinant[None, None]
    columns = [cross(m[1], m[2]), cross(m[2], m[0]), cross(m[0], m[1])]
    return jnp.stack(columns, axis=1) / dot(m[0], columns[0])[None, None]
