"""The stiff part of a flexible link, condensed: what an implicit step needs of it.

Place in the pipeline: model -> **condensation** -> newton.

In the link's own axes, near its undeformed shape, the free rfes obey

    (M + s K) y + M X A = r + S w,      s = q_factor + damping * v_factor

for the second derivatives y of the elastic coordinates, the acceleration A of the link frame, residual
generalised forces r and wrenches w on the rfes that carry joints; M, K, X and S are constant and the same for all samples
of a batch.  The eigenvectors V of (K, M), computed once, give (M + s K)^-1 = V (1 + s L)^-1 V^T for
every step, and with it the link as it is felt at its frame and at its carriers (static condensation of
structural dynamics, of M + s K instead of K).

The matrices are those of the nominal model: they serve Newton's method, whose solution does not depend
on them, and are therefore not differentiated.  Geometrically exact elements turn with the rfes, which
changes the stiffness felt in the link's axes as soon as a link is bent by more than its thickness: for
them the matrices are formed in the present place, sample by sample.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from rfem_jax.mechanics import elasticity, exact_elements
from rfem_jax.mechanics.algebra import apply, product, product_transposed
from rfem_jax.mechanics.kinematics import RelativeMotion
from rfem_jax.mechanics.model import Coordinates, Topology
from rfem_jax.mechanics.realisation import Realisation


class LinkModes(NamedTuple):
    """Undeformed flexible link of m free rfes, rows component by component: modes (6 m, 6 m) with
    V^T M V = 1; stiffness (6 m,) = L [1/s^2]; damping [s]; coupling (6 m, 6) = M X; rigid (6, 6): inertia
    of the whole link about its frame.
    """

    modes: Array
    stiffness: Array
    damping: Array
    coupling: Array
    rigid: Array


class LinkOperator(NamedTuple):
    """A link at one step length; wrenches and accelerations are (moment, force) and (angular, linear).

    inverse (6 m, 6 m) = (M + s K)^-1; inertia (6, 6) felt at the link frame; compliance (6 c, 6 c) of its
    c carriers and its inverse stiffness; pick (6 c, 6 m): the carriers' rows of `inverse`; reduced
    (6 m, 6): what unit accelerations of the frame take from the second derivatives of the coordinates;
    give (6 c, 6): its rows of the carriers.
    """

    inverse: Array
    inertia: Array
    give: Array
    compliance: Array
    stiffness: Array
    pick: Array
    reduced: Array


def local_carriers(topology: Topology, link: int) -> tuple[int, ...]:
    """Free rfes of a link that carry joints, counted within the link."""
    first, last = topology.ranges[link]
    return tuple(k - first for k in topology.carriers if first <= k < last)


def link_modes(realised: Realisation) -> tuple[LinkModes | None, ...]:
    """Modes of all links (None for rigid ones), from the nominal constants."""
    realised = jax.lax.stop_gradient(realised)
    topology = realised.topology
    stiffness = _stiffness(realised)
    return tuple(
        _modes(realised, stiffness, l, a, b) if b > a else None
        for l, (a, b) in enumerate(topology.ranges)
    )


def _stiffness(realised: Realisation) -> Array:
    """Stiffness matrix (6, N, 6, N) of all links at the undeformed state, in the coordinates (phi, u)."""

    def energy(elastic):
        position = Coordinates(jnp.zeros(realised.topology.n_links), elastic)
        return elasticity.elastic_energy(realised, position)

    matrix = jax.hessian(energy)(jnp.zeros((6, realised.topology.n_rfes)))
    order = np.array([3, 4, 5, 0, 1, 2])
    return matrix[order][:, :, order]


def _modes(realised, stiffness, link: int, a: int, b: int) -> LinkModes:
    m, n = b - a, realised.topology.n_links
    k = stiffness[:, a:b, :, a:b].transpose(1, 0, 3, 2).reshape(6 * m, 6 * m)
    own = (realised.mass[n + a : n + b], realised.centre[:, n + a : n + b].T,
           jnp.moveaxis(realised.inertia[:, :, n + a : n + b], 2, 0))
    at = jnp.stack([realised.rest[a:b], jnp.zeros(m), jnp.zeros(m)], axis=1)
    mass, coupling, rigid = _rigid_link(realised, link, own, at)
    root = jnp.linalg.cholesky(mass)
    lower = jax.scipy.linalg.block_diag(*(root[i] for i in range(m)))
    half = jax.scipy.linalg.solve_triangular(lower, k, lower=True)
    scaled = jax.scipy.linalg.solve_triangular(lower, half.T, lower=True)
    values, vectors = jnp.linalg.eigh(0.5 * (scaled + scaled.T))
    modes = jax.scipy.linalg.solve_triangular(lower.T, vectors, lower=False)
    return LinkModes(
        modes=_by_component(modes.reshape(m, 6, 6 * m)),
        stiffness=jnp.maximum(values, 0.0),
        damping=realised.damping[a],
        coupling=_by_component(coupling),
        rigid=rigid,
    )


def _rigid_link(realised: Realisation, link: int, own, at):
    """Inertias (m, 6, 6) of the free rfes with (mass, centre, inertia) `own`, rfe first, coupling M X
    (m, 6, 6) for their places `at` (m, 3), and inertia (6, 6) of the whole link at its frame."""
    mass = jax.vmap(_inertia)(*own)
    # Motion of the rfes' middles when the link frame moves: linear += angular x position.
    spread = jax.vmap(lambda p: jnp.eye(6).at[3:, :3].set(-_cross_matrix(p)))(at)
    coupling = jnp.einsum("mij,mjk->mik", mass, spread)
    root = _inertia(realised.mass[link], realised.centre[:, link], realised.inertia[:, :, link])
    return mass, coupling, root + jnp.einsum("mji,mjk->ik", spread, coupling)


def _by_component(rows: Array) -> Array:
    """(m, 6, k), rfe by rfe, as (6 m, k), component by component."""
    m, _, k = rows.shape
    return rows.swapaxes(0, 1).reshape(6 * m, k)


def _cross_matrix(p):
    return jnp.cross(jnp.eye(3), p[None]).T * -1.0


def _inertia(mass, centre, inertia):
    """Inertia (6, 6), angular part first, of one body about its reference point."""
    shift = _cross_matrix(centre)
    first = mass * shift
    return jnp.block([[inertia - first @ shift, first], [-first, mass * jnp.eye(3)]])


def link_operators(
    topology: Topology, modes: tuple[LinkModes | None, ...], q_factor: Array, v_factor: Array
) -> tuple[LinkOperator | None, ...]:
    """Operators of all links for steps in which coordinates move by q_factor [s^2] and rates by v_factor
    [s] times their accelerations."""
    return tuple(
        None if one is None else _operator(one, local_carriers(topology, l), q_factor, v_factor)
        for l, one in enumerate(modes)
    )


def present_operators(
    realised: Realisation, now: RelativeMotion, q_factor: Array, v_factor: Array
) -> tuple[LinkOperator | None, ...]:
    """Operators of links of geometrically exact elements in the present place."""
    realised, now = jax.lax.stop_gradient((realised, now))
    topology = realised.topology
    nothing = jnp.zeros_like(realised.rest)
    u = now.position - jnp.stack([realised.rest, nothing, nothing])
    stiffness = exact_elements.stiffness_matrix(realised, u, now)
    turned = product(now.rotation, realised.inertia[:, :, topology.n_links :])
    inertia = product_transposed(turned, now.rotation)
    centre = apply(now.rotation, realised.centre[:, topology.n_links :])
    operators: list[LinkOperator | None] = []
    for l, (a, b) in enumerate(topology.ranges):
        if a == b:
            operators.append(None)
            continue
        m = b - a
        own = (realised.mass[topology.n_links + a : topology.n_links + b], centre[:, a:b].T,
               jnp.moveaxis(inertia[:, :, a:b], 2, 0))
        mass, coupling, rigid = _rigid_link(realised, l, own, now.position[:, a:b].T)
        # Of the coordinates: their rates turn a rfe about its present axes.
        turn = jnp.zeros((m, 6, 6)).at[:, 3:, 3:].set(jnp.eye(3))
        turn = turn.at[:, :3, :3].set(jnp.moveaxis(now.rate_matrix[:, :, a:b], 2, 0))
        mass = jnp.einsum("mji,mjk,mkl->mil", turn, mass, turn)
        coupling = jnp.einsum("mji,mjk->mik", turn, coupling)
        springs = jnp.einsum("mai,ambn,nbj->imjn", turn, stiffness[:, a:b, :, a:b], turn)
        diagonal = jnp.zeros((6, m, 6, m)).at[:, np.arange(m), :, np.arange(m)].set(mass)
        s = q_factor + realised.damping[a] * v_factor
        inverse = jnp.linalg.inv((diagonal + s * springs).reshape(6 * m, 6 * m))
        operators.append(
            _condensed(inverse, _by_component(coupling), rigid, local_carriers(topology, l))
        )
    return tuple(operators)


def _operator(one: LinkModes, carriers, q_factor, v_factor) -> LinkOperator:
    s = q_factor + one.damping * v_factor
    inverse = (one.modes / (1.0 + s * one.stiffness)[None]) @ one.modes.T
    return _condensed(inverse, one.coupling, one.rigid, carriers)


def _condensed(inverse, coupling, rigid, carriers) -> LinkOperator:
    m = inverse.shape[0] // 6
    rows = np.array([k + m * c for k in carriers for c in range(6)], dtype=int)
    pick = inverse[rows]
    reduced = inverse @ coupling
    compliance = pick[:, rows]
    return LinkOperator(
        inverse=inverse,
        inertia=rigid - coupling.T @ reduced,
        give=reduced[rows],
        compliance=compliance,
        stiffness=jnp.linalg.inv(compliance),
        pick=pick,
        reduced=reduced,
    )
