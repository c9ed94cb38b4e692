"""Geometrically exact spring-damping elements: deflections of any size, and their wrenches.

Place in the pipeline: kinematics -> **exact elements** -> elasticity -> dynamics, statics.

Theory (1.12) to (1.15).  An sde joins the faces of its two rfes, l (left) and r (right; rfe 0
of the link is the left one of the first sde), at the lever arms a = s R e_x from their middles:

    theta = rotation vector of R_l^T R_r,  du = M^T (face_r - face_l),  M = R_l exp(theta / 2),

V = 1/2 (du, theta) C (du, theta); the Kelvin-Voigt damper acts on the rates of (du, theta).  M is
midway between the two faces, so left and right are alike and n sdes approximate the curve of a beam
to second order.  Nothing here changes under a common rigid motion of both faces: the wrenches on
them are action and reaction.

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

from rfem_jax.mechanics import algebra
from rfem_jax.mechanics.algebra import cross, dot, product, transpose
from rfem_jax.mechanics.kinematics import RelativeMotion
from rfem_jax.mechanics.realisation import Realisation
from rfem_jax.mechanics.reordering import reorder

# (asin(r)/r - 1)/r^2 in powers of r^2, for r below SMALL: angles below 0.1 rad.
SERIES = (1 / 6, 3 / 40, 5 / 112, 35 / 1152, 63 / 2816, 231 / 13312, 143 / 10240)
SMALL = 0.05


class ExactDeflections(NamedTuple):
    """Deflections of all sdes and what their wrenches need.

    stretch, rate (6, N): (du, theta) and their rates; half (3, N): v; quarter (3, N): h; f, g (N,);
    midway (3, 3, N): the transpose of M, from link axes; arms (3, 2, N): from the middles of the
    right and the left rfe to their faces, in link axes.
    """

    stretch: Array
    rate: Array
    half: Array
    quarter: Array
    f: Array
    g: Array
    midway: Array
    arms: Array


def deflections(realised: Realisation, u: Array, relative: RelativeMotion) -> ExactDeflections:
    """Deflections of all sdes from the displacements u (3, N) [m] of the rfes' middles and the
    relative motion."""
    # Displacement, turn and rates of both sides: rfe 0 does not move in its link frame.
    identity = _like(algebra.IDENTITY[:, :, None], relative.rotation)
    turned = relative.rotation - identity
    shape = u.shape[1:]
    own = jnp.concatenate([turned.reshape((9, *shape)), u, relative.angular, relative.linear])
    both = jnp.stack([own, from_left(realised, own)], axis=1)
    turned = both[:9].reshape((3, 3, 2, *shape))
    rotation = turned + identity[:, :, None]
    levers = jnp.stack([realised.lever_right, realised.lever_left])[None]
    arms = levers * rotation[:, 0]
    spin = both[12:15]
    face = both[9:12] + levers * turned[:, 0]
    face_rate = both[15:] + cross(spin, arms)

    half, cosine = _half_turn(rotation)
    quarter = half / (1.0 + cosine)[None]
    left = transpose(rotation[:, :, 1])
    midway = left - cross(half[:, None], left - cross(quarter[:, None], left))
    w = spin[:, 0] - spin[:, 1]
    gap, gap_rate = face[:, 0] - face[:, 1], face_rate[:, 0] - face_rate[:, 1]
    seen = product(midway, jnp.stack([gap, gap_rate, w, spin[:, 0] - 0.5 * w], axis=1))
    gap, gap_rate, w, mean = (seen[:, i] for i in range(4))
    f, g = _factors(dot(half, half))
    turning = mean - 0.5 * cross(quarter, w)
    return ExactDeflections(
        stretch=jnp.concatenate([gap, 2.0 * f[None] * half]),
        rate=jnp.concatenate([gap_rate - cross(turning, gap), _tangent(half, f, g, w)]),
        half=half,
        quarter=quarter,
        f=f,
        g=g,
        midway=midway,
        arms=arms,
    )


class SpringBlocks(NamedTuple):
    """Stiffness of the springs by virtual turns and displacements (angular first) of the rfes: own
    (N, 6, 6) of every rfe, beside (N, 6, 6) of a rfe (rows) and its left neighbour (columns), zero where
    that is the link frame."""

    own: Array
    beside: Array


def stiffness_blocks(realised: Realisation, u: Array, relative: RelativeMotion) -> SpringBlocks:
    """Of the springs in the present place, in link axes, without the part of loads that turn.

    One rfe in two is moved at a time, so that every sde feels one of its faces only.
    """
    n = realised.topology.n_rfes
    even = np.arange(n) % 2 == 0

    def rates(column, parity):
        unit = jnp.zeros((6, n)).at[column].set(jnp.where(even == parity, 1.0, 0.0))
        moved = relative._replace(angular=unit[:3], linear=unit[3:])
        return deflections(realised, u, moved).rate

    columns = jnp.arange(6)
    by_even, by_odd = (
        jax.vmap(lambda column: rates(column, parity))(columns) for parity in (True, False)
    )
    right = jnp.where(even, by_even, by_odd)
    left = jnp.where(even, by_odd, by_even)
    return spring_blocks(realised, right, left)


def spring_blocks(realised: Realisation, right: Array, left: Array) -> SpringBlocks:
    """From the deflections (6, 6, N) of every sde by unit motions (first axis) of its right and its
    left rfe."""
    inner = _is_inner(realised)[:, None, None]

    def block(one, other):
        return jnp.einsum("bak,ak,cak->kbc", one, realised.stiffness, other)

    by_left = jnp.roll(inner * block(left, left), -1, axis=0)
    return SpringBlocks(block(right, right) + by_left, inner * block(right, left))


def wrenches(realised: Realisation, now: ExactDeflections) -> tuple[Array, Array]:
    """Force [N] and moment [N m] (3, N) of springs and dampers on the free rfes, at their middles
    in link axes: the transposed tangent map of the deflections."""
    stress = realised.stiffness * (now.stretch + realised.damping[None] * now.rate)
    force, gap = stress[:3], now.stretch[:3]
    couple = _tangent(now.half, now.f, now.g, stress[3:])
    turn = 0.5 * cross(force, gap)  # of the midway frame, shared by both sides
    couple = couple + cross(now.quarter, turn)
    back = jnp.stack([force, -couple - turn, couple - turn], axis=1)
    back = product(transpose(now.midway), back)
    force = back[:, 0]
    moments = back[:, 1:] - cross(now.arms, jnp.stack([force, -force], axis=1))
    on_left = to_left(realised, jnp.concatenate([force, moments[:, 1]]))
    return on_left[:3] - force, on_left[3:] + moments[:, 0]


def from_left(realised: Realisation, values: Array) -> Array:
    """Values (k, N) of the left neighbours of the free rfes, zero for rfe 0."""
    return _expand(_is_inner(realised), values) * _rolled(values, 1)


def to_left(realised: Realisation, values: Array) -> Array:
    """Values (k, N) of the sdes moved to their left rfes; those of rfe 0 are dropped."""
    return _rolled(_expand(_is_inner(realised), values) * values, -1)


def _rolled(values, shift: int):
    return reorder(values, np.roll(np.arange(values.shape[1]), shift), axis=1)


def _is_inner(realised: Realisation) -> np.ndarray:
    """Which free rfes have another free rfe of their link on their left."""
    inner = np.ones(realised.topology.n_rfes)
    inner[[a for a, b in realised.topology.ranges if b > a]] = 0.0
    return inner


def _expand(inner, values):
    return jnp.asarray(inner).reshape((1, -1) + (1,) * (values.ndim - 2))


def _like(values, example):
    return jnp.asarray(values).reshape(values.shape + (1,) * (example.ndim - 3))


def _half_turn(rotation: Array) -> tuple[Array, Array]:
    """sin(angle/2) n (3, N) and cos(angle/2) (N,) of R_l^T R_r, angle below 180 deg; no square root
    of something that vanishes."""
    right, left = rotation[:, :, 0], rotation[:, :, 1]
    cosine = 0.5 * jnp.sqrt(1.0 + jnp.sum(right * left, axis=(0, 1)))
    axial = jnp.sum(cross(transpose(right), transpose(left)), axis=1)
    return axial / (4.0 * cosine)[None], cosine


def _factors(square: Array) -> tuple[Array, Array]:
    """f and g of the squared sine of half the angle, with safe derivatives at zero."""
    small = square < SMALL**2
    root = jnp.sqrt(jnp.where(small, 1.0 - SMALL, square))
    closed = (jnp.arcsin(root) / root - 1.0) / root**2
    series = SERIES[-1]
    for coefficient in SERIES[-2::-1]:
        series = series * square + coefficient
    g = jnp.where(small, series, closed)
    return 1.0 + g * square, g


def _tangent(half, f, g, vector):
    """d theta / d w, symmetric in the axes of M, times a vector."""
    return f[None] * vector - half * (g * dot(half, vector))[None]
