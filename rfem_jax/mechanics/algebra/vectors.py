"""Vectors, rotations and spatial vectors: the algebra that the mechanics is written in.

Place in the pipeline: used by every other file of the mechanics.

Layout. Components come first: a vector is (3, ...), a rotation or a matrix (3, 3, ...), a spatial
vector (6, ...) with the angular part first; every later axis (bodies, columns of loads) broadcasts.
The contiguous axis is thus the one with many equal operations, and no function here needs a batched
product of small matrices, which XLA runs slowly on a CPU.

Spatial vectors (theory (2.11) to (2.13); Featherstone, Rigid Body Dynamics Algorithms, 2008, ch. 2)
are taken at the origin of the global frame, so that bodies share one reference point and no
transform is needed.
"""

import functools
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from rfem_jax.kernels import kernel
from rfem_jax.mechanics.algebra import products
from rfem_jax.mechanics.algebra.products import combine, contract, contract_constant
from rfem_jax.mechanics.algebra.reordering import reorder

Scalar = Float[Array, ""] | float

# Columns whose cosine is smaller are orthogonal; sweeps over all pairs, of which five or six are enough.
ROUNDING_OF_ROTATIONS, MOST_SWEEPS = 1e-15, 12
LARGEST_KERNEL = 16  # equations that a kernel solves as fast as LAPACK; it grows with the square of their number
IDENTITY = np.eye(3)
CROSSED = np.cross(IDENTITY[:, None], IDENTITY[None]).transpose(0, 2, 1)  # [k]: of the vector product by unit vector k


def cross(a: Float[Array, "3 *#n"], b: Float[Array, "3 *#n"]) -> Float[Array, "3 ..."]:
    """Vector product."""
    return products.cross(a, b)


def dot(a: Float[Array, "n *#k"], b: Float[Array, "n *#k"]) -> Float[Array, "..."]:
    """Sum over the first axis of the product."""
    return contract((0,), (0,), (), a, b)


def scaled(
    factor: Float[Array, "*#k"], vector: Float[Array, "n *#k"] | Float[np.ndarray, "n *#k"]
) -> Float[Array, "n ..."]:
    """Factor times vector."""
    return contract((), (0,), (0,), factor, vector)


def outer(a: Float[Array, " m"], b: Float[Array, " n"]) -> Float[Array, "m n"]:
    """Matrix of the products of all entries of two vectors."""
    return contract((0,), (1,), (0, 1), a, b)


def apply(matrix: Float[Array, "m n *#k"], vector: Float[Array, "n *#k"]) -> Float[Array, "m ..."]:
    """Matrix times vector."""
    return contract((0, 1), (1,), (0,), matrix, vector)


def apply_transposed(matrix: Float[Array, "n m *#k"], vector: Float[Array, "n *#k"]) -> Float[Array, "m ..."]:
    """Transpose of a matrix times vector."""
    return contract((0, 1), (0,), (1,), matrix, vector)


def product(
    a: Float[Array, "m n *#k"], b: Float[Array, "n p *#k"] | Float[np.ndarray, "n p *#k"]
) -> Float[Array, "m p ..."]:
    """Matrix times matrix."""
    return contract((0, 1), (1, 2), (0, 2), a, b)


def product_transposed(a: Float[Array, "m n *#k"], b: Float[Array, "p n *#k"]) -> Float[Array, "m p ..."]:
    """Matrix times the transpose of a matrix."""
    return contract((0, 1), (2, 1), (0, 2), a, b)


def transposed_product(a: Float[Array, "n m *#k"], b: Float[Array, "n p *#k"]) -> Float[Array, "m p ..."]:
    """Transpose of a matrix times matrix."""
    return contract((0, 1), (0, 2), (1, 2), a, b)


def constant_product(matrix: Float[Array, "m n"], b: Float[Array, " n *k"]) -> Float[Array, " m *k"]:
    """Matrix without later axes times vectors with any."""
    return jnp.tensordot(matrix, b, axes=1)


def by_component(values: Float[Array, "6 m *k"]) -> Float[Array, " size *k"]:
    """Flatten (6, m, ...) to (6 m, ...): all first components, all second ones, and so on."""
    return values.reshape((6 * values.shape[1],) + values.shape[2:])


def transpose(matrix: Float[Array, "m n *k"]) -> Float[Array, "n m *k"]:
    """Exchange the first two axes."""
    return jnp.swapaxes(matrix, 0, 1)


def cross_matrix(a: Float[Array, " 3 *k"]) -> Float[Array, "3 3 *k"]:
    """The matrix of the vector product `a x`."""
    return contract_constant((0,), (1, 2, 0), (1, 2), a, CROSSED)


def rotation_x(angle: Float[Array, "*k"]) -> Float[Array, "3 3 *k"]:
    """Right-handed rotation about x by an angle [rad]."""
    return rotation_about(0, angle)


def rotation_y(angle: Float[Array, "*k"]) -> Float[Array, "3 3 *k"]:
    """Right-handed rotation about y by an angle [rad]."""
    return rotation_about(1, angle)


def rotation_z(angle: Float[Array, "*k"]) -> Float[Array, "3 3 *k"]:
    """Right-handed rotation about z by an angle [rad]."""
    return rotation_about(2, angle)


def rotation_about(axis: int, angle: Float[Array, "*k"]) -> Float[Array, "3 3 *k"]:
    """Right-handed rotation about axis 0, 1 or 2 (x, y, z) by an angle [rad]."""
    return combine((jnp.cos(angle), jnp.sin(angle), np.ones(angle.shape)), _ROTATIONS[axis])


def _rotation_parts(axis: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Matrices of the components across an axis, across it turned by 90 deg, and along it."""
    along = np.diag(IDENTITY[axis])
    return IDENTITY - along, np.cross(IDENTITY[axis], IDENTITY).T, along


_ROTATIONS = tuple(_rotation_parts(axis) for axis in range(3))


def _matrix(rows: list[list[Array]]) -> Array:
    return jnp.stack([jnp.stack(row) for row in rows])


def columns(values: Float[Array, "*n m"], indices: Sequence[int], axis: int = -1) -> Float[Array, "..."]:
    """Columns at static indices of an axis: one slice where there can be one."""
    axis %= values.ndim
    steps = set(np.diff(indices).tolist())
    if len(steps) <= 1 and min(steps, default=1) > 0:
        first, end = (indices[0], indices[-1] + 1) if len(indices) else (0, 0)
        return jax.lax.slice_in_dim(values, first, end, min(steps, default=1), axis)
    return jnp.stack([jax.lax.index_in_dim(values, i, axis, keepdims=False) for i in indices], axis=axis)


def spatial(angular: Float[Array, " 3 *k"], linear: Float[Array, " 3 *k"]) -> Float[Array, " 6 *k"]:
    """Spatial vector from its two halves (motion: at the origin; wrench: moment, force)."""
    return jnp.concatenate([angular, linear])


def wrench_at_origin(
    moment: Float[Array, " 3 *k"], force: Float[Array, " 3 *k"], point: Float[Array, " 3 *k"]
) -> Float[Array, " 6 *k"]:
    """Wrench at the global origin of a force at `point` and a moment."""
    return spatial(moment + cross(point, force), force)


def motion_at_origin(
    angular: Float[Array, " 3 *k"], linear: Float[Array, " 3 *k"], point: Float[Array, " 3 *k"]
) -> Float[Array, " 6 *k"]:
    """Spatial velocity at the origin of a body with an angular velocity and the linear velocity of its `point`."""
    return spatial(angular, linear + cross(point, angular))


def motion_cross(velocity: Float[Array, " 6 *k"], motion: Float[Array, " 6 *k"]) -> Float[Array, " 6 *k"]:
    """Spatial cross product of a velocity with a motion vector (Featherstone's crm)."""
    w, v = velocity[:3], velocity[3:]
    return spatial(cross(w, motion[:3]), cross(w, motion[3:]) + cross(v, motion[:3]))


def force_cross(velocity: Float[Array, " 6 *k"], wrench: Float[Array, " 6 *k"]) -> Float[Array, " 6 *k"]:
    """Spatial cross product of a velocity with a force vector (Featherstone's crf)."""
    w, v = velocity[:3], velocity[3:]
    return spatial(cross(w, wrench[:3]) + cross(v, wrench[3:]), cross(w, wrench[3:]))


def spatial_inertia(
    mass: Float[Array, "*k"], centre: Float[Array, " 3 *k"], inertia: Float[Array, "3 3 *k"]
) -> Float[Array, "6 6 *k"]:
    """Spatial inertia at the global origin of bodies with given centres of mass and central inertia tensors in
    global axes."""
    shift = cross_matrix(centre)
    first = mass[None, None] * shift
    identity = jnp.asarray(IDENTITY).reshape((3, 3) + (1,) * (centre.ndim - 1))
    upper = jnp.concatenate([inertia + product_transposed(first, shift), first], axis=1)
    lower = jnp.concatenate([-first, mass[None, None] * identity + 0.0 * first], axis=1)
    return jnp.concatenate([upper, lower])


def spatial_mobility(
    mass: Float[Array, "*k"], centre: Float[Array, " 3 *k"], inverse: Float[Array, "3 3 *k"]
) -> Float[Array, "6 6 *k"]:
    """Inverse of `spatial_inertia`, from the inverses of the central inertia tensors. It is accurate where the inertia
    is ill-conditioned and a numerical inverse is not."""
    shift = cross_matrix(centre)
    shifted = product(shift, inverse)
    identity = jnp.asarray(IDENTITY).reshape((3, 3) + (1,) * (centre.ndim - 1))
    upper = jnp.concatenate([inverse, transpose(shifted)], axis=1)
    corner = product_transposed(shifted, shift) + identity / mass[None, None]
    return jnp.concatenate([upper, jnp.concatenate([shifted, corner], axis=1)])


def invert_positive(matrix: Float[Array, "n n *k"]) -> Float[Array, "n n *k"]:
    """Inverse of symmetric positive definite matrices, n small and static.

    Block elimination (Schur complements) down to blocks of at most three rows, inverted by the
    adjugate: no pivoting, no loop at run time, and derivatives need no rule of their own.
    """
    n = matrix.shape[0]
    if n <= 3:
        return invert_block(matrix)
    k = 3 if n < 6 else n // 2
    a, b, d = matrix[:k, :k], matrix[:k, k:], matrix[k:, k:]
    a_inverse = invert_positive(a)
    ab = product(a_inverse, b)
    schur_inverse = invert_positive(d - transposed_product(b, ab))
    corner = -product(ab, schur_inverse)
    top = jnp.concatenate([a_inverse - product_transposed(corner, ab), corner], axis=1)
    bottom = jnp.concatenate([transpose(corner), schur_inverse], axis=1)
    return jnp.concatenate([top, bottom])


_by_kernel = kernel(jnp.linalg.solve, name="linear equations")
_one_by_one = jax.custom_batching.sequential_vmap(jnp.linalg.solve)


def solve_equations(matrix: Float[Array, "n n"], value: Float[Array, " n *k"]) -> Float[Array, " n *k"]:
    """Solution of linear equations, of one right-hand side or several.

    On a CPU by a kernel up to some size, and one sample after the other above it.  LAPACK's functions for batches wait
    for threads of the pool on which XLA runs them: where a program has several of them, all threads may wait for ever.
    """
    if len(matrix) <= LARGEST_KERNEL:
        return _by_kernel(matrix, value)

    def solved(matrix, value):
        return jax.lax.platform_dependent(matrix, value, cpu=_one_by_one, default=jnp.linalg.solve)

    return jax.lax.custom_linear_solve(
        lambda x: matrix @ x,
        value,
        lambda _, b: solved(matrix, b),
        transpose_solve=lambda _, b: solved(matrix.T, b),
    )


@functools.partial(jax.custom_jvp, nondiff_argnums=(1,))
def pseudo_inverse(matrix: Float[Array, "m n"], smallest: float) -> Float[Array, "n m"]:
    """Pseudo-inverse of a small matrix whose entries that say something are of size one; singular values below
    `smallest` times the largest, or times one, count as zero.

    By one-sided Jacobi rotations, operations that kernels have (M. R. Hestenes, J. SIAM 6 (1958) 51-90); its derivative
    is that of matrices of one rank (G. H. Golub, V. Pereyra, SIAM J. Numer. Anal. 10 (1973) 413-432).
    """
    m, n = matrix.shape
    if m < n:
        return pseudo_inverse(matrix.T, smallest).T
    if not matrix.size:
        return jnp.zeros((n, m))
    columns, vectors = _orthogonalised(matrix)
    squares = jnp.sum(columns**2, axis=1)
    kept = squares > smallest**2 * jnp.maximum(jnp.max(squares), 1.0)
    weights = jnp.where(kept, 1.0 / jnp.where(kept, squares, 1.0), 0.0)
    return vectors.T @ (weights[:, None] * columns)


@pseudo_inverse.defjvp
def _differentiate_pseudo_inverse(smallest, primals, tangents):
    (a,), (da,) = primals, tangents
    p = pseudo_inverse(a, smallest)
    beside = p @ p.T @ da.T @ (jnp.eye(a.shape[0]) - a @ p) + (jnp.eye(a.shape[1]) - p @ a) @ da.T @ p.T @ p
    return p, beside - p @ da @ p


def _orthogonalised(matrix: Float[Array, "m n"]) -> tuple[Float[Array, "n m"], Float[Array, "n n"]]:
    """Orthogonal combinations of a matrix's columns, as rows, and the rotation that makes them, likewise."""
    m, n = matrix.shape
    first, second = np.triu_indices(n, 1)
    pairs = jnp.asarray(first.astype(np.int32)), jnp.asarray(second.astype(np.int32))

    def rotate(carry, pair):
        rows, error = carry
        a, b = (jax.lax.dynamic_slice(rows, (k, jnp.int32(0)), (1, m + n))[0] for k in pair)
        both = jnp.sum(a[:m] * b[:m])
        square_a, square_b = jnp.sum(a[:m] ** 2), jnp.sum(b[:m] ** 2)
        size = jnp.sqrt(square_a * square_b)
        turned = jnp.abs(both) > ROUNDING_OF_ROTATIONS * size
        ratio = (square_b - square_a) / jnp.where(turned, 2.0 * both, 1.0)
        tangent = jnp.where(ratio < 0.0, -1.0, 1.0) / (jnp.abs(ratio) + jnp.sqrt(1.0 + ratio**2))
        tangent = jnp.where(turned, tangent, 0.0)
        cosine = 1.0 / jnp.sqrt(1.0 + tangent**2)
        new = cosine * a - cosine * tangent * b, cosine * tangent * a + cosine * b
        for k, row in zip(pair, new):
            rows = jax.lax.dynamic_update_slice(rows, row[None], (k, jnp.int32(0)))
        return (rows, jnp.maximum(error, jnp.where(turned, 1.0, 0.0))), None

    def sweep(carry):
        rows, _, count = carry
        (rows, error), _ = jax.lax.scan(rotate, (rows, jnp.zeros(())), pairs)
        return rows, error, count + 1

    start = jnp.concatenate([matrix.T, jnp.eye(n)], axis=1), jnp.ones(()), jnp.zeros((), jnp.int32)
    rows, _, _ = jax.lax.while_loop(lambda carry: (carry[1] > 0.0) & (carry[2] < MOST_SWEEPS), sweep, start)
    return rows[:, :m], rows[:, m:]


def invert_block(m: Float[Array, "n n *k"]) -> Float[Array, "n n *k"]:
    """Inverse of matrices with n <= 3: adjugate over determinant."""
    if m.shape[0] == 0:
        return m
    if m.shape[0] == 1:
        return 1.0 / m
    if m.shape[0] == 2:
        determinant = m[0, 0] * m[1, 1] - m[0, 1] * m[1, 0]
        return _matrix([[m[1, 1], -m[0, 1]], [-m[1, 0], m[0, 0]]]) / determinant[None, None]
    rows = transpose(m)
    columns = cross(reorder(rows, (1, 2, 0), axis=1), reorder(rows, (2, 0, 1), axis=1))
    return columns / dot(rows[:, 0], columns[:, 0])[None, None]
