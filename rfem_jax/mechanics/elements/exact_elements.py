"""Geometrically exact spring-damping elements: deflections of any size, and their wrenches.

Place in the pipeline: kinematics -> **exact elements** -> elasticity -> dynamics, statics.

Theory (1.12) to (1.15).  An sde joins the faces of its two rfes, l (left) and r (right; rfe 0
of the link is the left one of the first sde), at the lever arms a = s R e_x from their middles:

    theta = rotation vector of R_l^T R_r,  du = M^T (face_r - face_l),  M = R_l exp(theta / 2),

V = 1/2 (du, theta) C (du, theta); the Kelvin-Voigt damper acts on the rates of (du, theta).  M is
midway between the two faces, so the element is symmetric in left and right and n sdes approximate the
curve of a beam to second order.  All of it is invariant under a common rigid motion of both faces, so the
wrenches on them are action and reaction.

In axes of M, with v = sin(|theta|/2) n, c = cos(|theta|/2), h = tan(|theta|/4) n = v / (1 + c),
f = (|theta|/2) / sin(|theta|/2) = 1 + g v.v and the relative angular velocity w = w_r - w_l:

    theta = 2 f v,   theta' = f w - g v (v . w),   w_M = (w_l + w_r)/2 - h x w / 2.

All N sdes are one array axis; N stands after the components.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from rfem_jax.mechanics.algebra import vectors
from rfem_jax.mechanics.algebra.reordering import reorder
from rfem_jax.mechanics.algebra.vectors import apply, cross, dot, product, transpose, transposed_product
from rfem_jax.mechanics.kinematics.motion import RelativeMotion
from rfem_jax.mechanics.model.with_errors import ModelWithErrors

# (asin(r)/r - 1)/r^2 in powers of r^2, for r below SMALL: angles below 0.1 rad.
SERIES = (1 / 6, 3 / 40, 5 / 112, 35 / 1152, 63 / 2816, 231 / 13312, 143 / 10240)
SMALL = 0.05


class ExactDeflections(NamedTuple):
    """Deflections of all sdes, and the kinematics that their wrenches are formed with.

    stretch, rate (6, N): (du, theta) and their rates; half (3, N): v; quarter (3, N): h; f, g (N,);
    midway (3, 3, N): the transpose of M, from link axes; arms (3, 2, N): from the middles of the
    right and the left rfe to their faces, in link axes.
    """

    stretch: Float[Array, "6 rfes"]
    rate: Float[Array, "6 rfes"]
    half: Float[Array, "3 rfes"]
    quarter: Float[Array, "3 rfes"]
    f: Float[Array, " rfes"]
    g: Float[Array, " rfes"]
    midway: Float[Array, "3 3 rfes"]
    arms: Float[Array, "3 2 rfes"]


def deflections(actual: ModelWithErrors, u: Float[Array, "3 rfes"], relative: RelativeMotion) -> ExactDeflections:
    """Deflections of all sdes from the displacements u [m] of the rfes' middles and the relative motion."""
    # R - 1, displacements and velocities of the right and the left rfe of every sde; all zero for rfe 0.
    identity = jnp.asarray(vectors.IDENTITY[:, :, None])
    rotated = relative.rotation - identity
    n = actual.topology.n_rfes
    right = jnp.concatenate([rotated.reshape((9, n)), u, relative.angular, relative.linear])
    both = jnp.stack([right, from_left(actual, right)], axis=1)
    rotated = both[:9].reshape((3, 3, 2, n))
    rotation = rotated + identity[:, :, None]
    levers = jnp.stack([actual.lever_right, actual.lever_left], axis=-2)
    levers = levers if actual.topology.shaped else levers[None]
    arms = _to_faces(levers, rotation)
    spin = both[12:15]
    face = both[9:12] + _to_faces(levers, rotated)
    face_rate = both[15:] + cross(spin, arms)

    half, cosine = _half_rotation(rotation)
    quarter = half / (1.0 + cosine)[None]
    left = transpose(rotation[:, :, 1])
    midway = left - cross(half[:, None], left - cross(quarter[:, None], left))
    w = spin[:, 0] - spin[:, 1]
    gap, gap_rate = face[:, 0] - face[:, 1], face_rate[:, 0] - face_rate[:, 1]
    in_midway = product(midway, jnp.stack([gap, gap_rate, w, spin[:, 0] - 0.5 * w], axis=1))
    gap, gap_rate, w, mean = (in_midway[:, i] for i in range(4))
    f, g = _factors(dot(half, half))
    midway_spin = mean - 0.5 * cross(quarter, w)
    return ExactDeflections(
        stretch=unbent(actual, jnp.concatenate([gap, 2.0 * f[None] * half])),
        rate=jnp.concatenate([gap_rate - cross(midway_spin, gap), _tangent(half, f, g, w)]),
        half=half,
        quarter=quarter,
        f=f,
        g=g,
        midway=midway,
        arms=arms,
    )


def _to_faces(levers: Array, rotation: Array) -> Array:
    """Arms (3, 2, N) from the middles of the right and the left rfe to their faces, at x or at vectors from them."""
    return apply(rotation, levers) if levers.shape[0] == 3 else levers * rotation[:, 0]


def stress_of(actual: ModelWithErrors, strain: Float[Array, "6 rfes"]) -> Float[Array, "6 rfes"]:
    """Stress [N, N m] of the sdes by their stiffness, of deflections with their rates."""
    return apply(actual.stiffness, strain) if actual.topology.shaped else actual.stiffness * strain


def unbent(actual: ModelWithErrors, stretch: Float[Array, "6 rfes"]) -> Float[Array, "6 rfes"]:
    """Deflections of the sdes less those that they have without load."""
    if actual.bent is None:
        return stretch
    return jnp.concatenate([stretch[:4], stretch[4:] - actual.bent])


class SpringBlocks(NamedTuple):
    """Block-tridiagonal stiffness of the springs for virtual rotations and displacements (angular first) of
    the rfes: diagonal (N, 6, 6), and lower (N, 6, 6) of a rfe (rows) and its left neighbour (columns), zero
    where that is the link frame."""

    diagonal: Float[Array, "rfes 6 6"]
    lower: Float[Array, "rfes 6 6"]


def stiffness_blocks(actual: ModelWithErrors, u: Float[Array, "3 rfes"], relative: RelativeMotion) -> SpringBlocks:
    """Material part of the tangent stiffness at the present deflection, in link axes, without the geometric
    part of loads that rotate with the rfes.

    Every second rfe is moved at a time, so that only one face of every sde moves.
    """
    n = actual.topology.n_rfes
    even = np.arange(n) % 2 == 0

    def rates(column, parity):
        unit = jnp.zeros((6, n)).at[column].set(jnp.where(even == parity, 1.0, 0.0))
        moved = relative._replace(angular=unit[:3], linear=unit[3:])
        return deflections(actual, u, moved).rate

    columns = jnp.arange(6)
    by_even, by_odd = (jax.vmap(lambda column: rates(column, parity))(columns) for parity in (True, False))
    right = jnp.where(even, by_even, by_odd)
    left = jnp.where(even, by_odd, by_even)
    return spring_blocks(actual, right, left)


def spring_blocks(
    actual: ModelWithErrors, right: Float[Array, "6 6 rfes"], left: Float[Array, "6 6 rfes"]
) -> SpringBlocks:
    """Blocks from the deflections of every sde (second axis) due to unit motions (first axis) of its right
    and of its left rfe."""
    inner = jnp.asarray(_is_inner(actual)[:, None, None])

    def block(one, other):
        if actual.topology.shaped:
            return jnp.einsum("bak,adk,cdk->kbc", one, actual.stiffness, other)
        return jnp.einsum("bak,ak,cak->kbc", one, actual.stiffness, other)

    by_left = jnp.roll(inner * block(left, left), -1, axis=0)
    return SpringBlocks(block(right, right) + by_left, inner * block(right, left))


def wrenches(
    actual: ModelWithErrors, deflected: ExactDeflections
) -> tuple[Float[Array, "3 rfes"], Float[Array, "3 rfes"]]:
    """Force [N] and moment [N m] of springs and dampers on the free rfes, at their middles in link axes:
    the stresses under the transposed Jacobian of the deflections."""
    force, moments = on_both_rfes(actual, deflected)
    on_left = to_left(actual, jnp.concatenate([force, moments[:, 1]]))
    return on_left[:3] - force, on_left[3:] + moments[:, 0]


def on_both_rfes(
    actual: ModelWithErrors, deflected: ExactDeflections
) -> tuple[Float[Array, "3 rfes"], Float[Array, "3 2 rfes"]]:
    """Force [N] of every sde on its left rfe (minus that on its right one), and its moments [N m] on the right and the
    left rfe at their middles, in link axes."""
    force, couple, shared = _midway_loads(actual, deflected)
    in_link = jnp.stack([force, -couple - shared, couple - shared], axis=1)
    in_link = transposed_product(deflected.midway, in_link)
    force = in_link[:, 0]
    return force, in_link[:, 1:] - cross(deflected.arms, jnp.stack([force, -force], axis=1))


def section_loads(actual: ModelWithErrors, deflected: ExactDeflections) -> Float[Array, "6 rfes"]:
    """Force [N] and moment [N m] that the right side of every sde exerts on its left one, about the middle of both
    faces and in the axes of M."""
    force, couple, _ = _midway_loads(actual, deflected)
    return jnp.concatenate([force, couple])


def _midway_loads(actual: ModelWithErrors, deflected: ExactDeflections) -> tuple[Array, Array, Array]:
    """Force and moment of every sde in the axes of M, and the moment of the force about either face."""
    stress = stress_of(actual, deflected.stretch + actual.damping[None] * deflected.rate)
    force, gap = stress[:3], deflected.stretch[:3]
    couple = _tangent(deflected.half, deflected.f, deflected.g, stress[3:])
    shared = 0.5 * cross(force, gap)  # by the rotation of the midway frame, which is half that of either side
    return force, couple + cross(deflected.quarter, shared), shared


def from_left(actual: ModelWithErrors, values: Float[Array, "k rfes"]) -> Float[Array, "k rfes"]:
    """Values of the left neighbours of the free rfes, zero where that is rfe 0."""
    return jnp.asarray(_is_inner(actual)).reshape((1, -1)) * _roll(values, 1)


def to_left(actual: ModelWithErrors, values: Float[Array, "k rfes"]) -> Float[Array, "k rfes"]:
    """Values of the sdes moved to their left rfes; those of rfe 0 are dropped."""
    return _roll(jnp.asarray(_is_inner(actual)).reshape((1, -1)) * values, -1)


def _roll(values: Array, shift: int) -> Array:
    return reorder(values, np.roll(np.arange(values.shape[1]), shift), axis=1)


def _is_inner(actual: ModelWithErrors) -> np.ndarray:
    """1 for the free rfes that have another free rfe of their link on their left, 0 for the others."""
    inner = np.ones(actual.topology.n_rfes)
    inner[[a for a, b in actual.topology.ranges if b > a]] = 0.0
    return inner


def _half_rotation(rotation: Array) -> tuple[Array, Array]:
    """sin(angle/2) n (3, N) and cos(angle/2) (N,) of R_l^T R_r, for angles below 180 deg; differentiable at
    zero, since the only square root is the cosine's."""
    right, left = rotation[:, :, 0], rotation[:, :, 1]
    cosine = 0.5 * jnp.sqrt(1.0 + jnp.sum(right * left, axis=(0, 1)))
    axial = jnp.sum(cross(transpose(right), transpose(left)), axis=1)
    return axial / (4.0 * cosine)[None], cosine


def _factors(square: Array) -> tuple[Array, Array]:
    """f and g of the squared sine of half the angle, with finite derivatives at zero."""
    small = square < SMALL**2
    root = jnp.sqrt(jnp.where(small, 1.0 - SMALL, square))
    closed = (jnp.arcsin(root) / root - 1.0) / root**2
    series = SERIES[-1]
    for coefficient in SERIES[-2::-1]:
        series = series * square + coefficient
    g = jnp.where(small, series, closed)
    return 1.0 + g * square, g


def _tangent(half: Array, f: Array, g: Array, vector: Array) -> Array:
    """The map from w to d theta / dt, symmetric in the axes of M, of a vector."""
    return f[None] * vector - half * (g * dot(half, vector))[None]
