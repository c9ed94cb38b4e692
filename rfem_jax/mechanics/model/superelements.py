"""Reduced bodies as superelements: a rigid body, and what its deformation adds to it.

Place in the pipeline: description.reduced_bodies -> **superelements** -> building, with_errors.

The link frame moves with the first interface. The coordinates of the others relative to it and the amplitudes of the
modes, together q, take the places of coordinates of free rfes: u and phi of an interface those of one, six amplitudes
those of another, a carrier, on which nothing stands. Amplitudes are scaled so that those in the places of displacements
are in m and those in the places of angles in rad; places that are left over have a mass and a spring of their own and
stay at rest. The rigid body is the body of rfe 0; the free rfes have no mass. Source: theory (19.1) to (19.6).
"""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rfem_jax.description.basics.numbers import Number
from rfem_jax.description.mechanism.reduced_bodies import ReducedBody

TENSOR_ROWS = 6  # of what stands for the edge of a section, where stresses are known at places of a body


class ReducedLink(NamedTuple):
    """The static part of a superelement. link: its index; shares: of the length from interface to interface, at which
    these are, but for the first one; modes: number of their amplitudes."""

    link: int
    shares: tuple[float, ...]
    modes: int

    @property
    def carriers(self) -> int:
        """Number of the free rfes that carry modes, six each."""
        return -(-self.modes // 6)

    @property
    def idle(self) -> int:
        """Number of coordinates that are left over."""
        return 6 * self.carriers - self.modes

    @property
    def middles(self) -> Float[np.ndarray, " nodes"]:
        """Shares of the length at which the nodes are: of rfe 0 any, of carriers the start."""
        return np.array([0.5, *self.shares, *[0.0] * self.carriers])


class Superelement(eqx.Module):
    """What the deformation of a reduced body adds to its rigid one, by its k coordinates q, those of displacements of
    all its free rfes first.

    mass, stiffness (k, k): M and K; damping [s]: eta; translation (3, k): C, integral of the displacements over the
    mass; rotation (3, k): H, that of their moments about the first interface; inertia (3, 3, k): G, change of the
    inertia about it; stresses (places, 6, k): xx, yy, zz, xy, yz, zx, None where they are not known.
    """

    mass: Float[Array, "k k"]
    stiffness: Float[Array, "k k"]
    damping: Float[Array, ""]
    translation: Float[Array, "3 k"]
    rotation: Float[Array, "3 k"]
    inertia: Float[Array, "3 3 k"]
    stresses: Float[Array, "places 6 k"] | None = None


class RigidPart(NamedTuple):
    """The body, undeformed: mass [kg], centre [m], and inertia (3, 3) [kg m^2] about the centre."""

    mass: float
    centre: Float[np.ndarray, "3"]
    inertia: Float[np.ndarray, "3 3"]


def reduced_link(index: int, body: ReducedBody) -> ReducedLink:
    """The static part of the superelement of a link."""
    places = np.asarray(body.interfaces)
    along = np.cumsum(np.linalg.norm(np.diff(places, axis=0), axis=1))
    return ReducedLink(index, tuple((along / along[-1]).tolist()), body.modes)


def rigid_part(body: ReducedBody) -> RigidPart:
    """The rigid body of a reduced one (theory (19.3))."""
    tensor = body.rigid_motions.T @ np.asarray(body.mass) @ body.rigid_motions
    mass, centre = body.total_mass, body.mass_centre
    steiner = mass * (centre @ centre * np.eye(3) - np.outer(centre, centre))
    inertia = tensor[3:, 3:] - steiner
    return RigidPart(mass, centre, 0.5 * (inertia + inertia.T))


def superelement_of(body: ReducedBody, damping: Number) -> Superelement:
    """The superelement of a body, whose damping may be traced."""
    onto, pads = _coordinates(body)
    mass, stiffness, rigid = np.asarray(body.mass), np.asarray(body.stiffness), body.rigid_motions
    momentum = rigid.T @ mass @ onto
    moments = np.einsum("abn,nk->abk", _moments(body), onto)
    symmetric = moments + moments.swapaxes(0, 1)
    trace = np.einsum("aak->k", moments)
    reduced = onto.T @ stiffness @ onto
    arrays = (
        onto.T @ mass @ onto + np.diag(np.where(pads, body.total_mass, 0.0)),
        reduced + np.diag(np.where(pads, body.total_mass * _slowest(body) if pads.any() else 0.0, 0.0)),
        np.asarray(damping) if isinstance(damping, float) else damping,
        momentum[:3],
        momentum[3:],
        2.0 * trace[None, None] * np.eye(3)[:, :, None] - symmetric,
    )
    stresses = None if body.stresses is None else jnp.asarray(body.stresses @ onto, jnp.float64)
    m, k, eta, c, h, g = (jnp.asarray(one, jnp.float64) for one in arrays)
    return Superelement(m, k, eta, c, h, g, stresses)


def _slowest(body: ReducedBody) -> float:
    """Square of the lowest frequency [rad^2/s^2] of its modes alone; of coordinates that are left over, too."""
    first = 6 * len(body.interfaces)
    return float(np.min(np.diag(body.stiffness)[first:] / np.diag(body.mass)[first:], initial=1e300))


def _coordinates(body: ReducedBody) -> tuple[Float[np.ndarray, "N k"], np.ndarray]:
    """Rows of the body by the coordinates q, and which of these are left over."""
    n, m, nodes = len(body.interfaces), body.modes, body.nodes - 1
    length, mass = np.linalg.norm(np.ptp(np.asarray(body.interfaces), axis=0)), np.diag(body.mass)
    onto = np.zeros((6 * n + m, 6, nodes))
    for i in range(1, n):
        onto[6 * i : 6 * i + 6, :, i - 1] = np.eye(6)
    pads = np.zeros((6, nodes), dtype=bool)
    for k in range(6 * (nodes - n + 1)):
        component, node = k % 6, n - 1 + k // 6
        if k >= m:
            pads[component, node] = True
            continue
        # Amplitudes as large as displacements of the whole body with their kinetic energy, in m, or over its length.
        unit = np.sqrt(body.total_mass / mass[6 * n + k])
        onto[6 * n + k, component, node] = unit if component < 3 else unit * length
    return onto.reshape(6 * n + m, 6 * nodes), pads.reshape(-1)


def _moments(body: ReducedBody) -> Float[np.ndarray, "3 3 N"]:
    """Integrals over the mass of x_a times displacement b by unit rows, of which the symmetric part counts: as given,
    else with linear fields as the body follows them when its interfaces do, with the least elastic energy (theory
    (19.5))."""
    if body.moments is not None:
        return np.asarray(body.moments)
    places, rows = np.asarray(body.interfaces), len(body.mass)
    stiffness, mass = np.asarray(body.stiffness), np.asarray(body.mass)
    at = np.arange(6 * len(places)).reshape(-1, 6)
    given, turning = at[:, :3].reshape(-1), at[:, 3:].reshape(-1)
    size = np.sqrt(np.diag(stiffness)[turning])
    bending = stiffness[np.ix_(turning, turning)] / size[:, None] / size[None]
    follow = -np.linalg.pinv(bending, rcond=1e-9) @ (stiffness[np.ix_(turning, given)] / size[:, None])
    follow = follow / size[:, None]
    moments = np.zeros((3, 3, rows))
    for a in range(3):
        for b in range(3):
            field = np.zeros(rows)
            field[given] = (places[:, a, None] * np.eye(3)[b]).reshape(-1)
            field[turning] = follow @ field[given]
            moments[a, b] = mass @ field
    return moments
