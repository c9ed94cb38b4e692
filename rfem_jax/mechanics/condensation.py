"""The stiff part of a flexible link, condensed: what an implicit step needs of it.

Place in the pipeline: model -> **condensation** -> newton.

In the link's own axes, near its undeformed shape, the free rfes obey (theory (7.8))

    (M + s K) y + M X A = r + S w,      s = q_factor + damping * v_factor

for the second derivatives y of the elastic coordinates, the acceleration A of the link frame, residual
generalised forces r and wrenches w on the rfes that carry joints; M, K, X and S are constant.
M + s K, factored once along the chain of rfes, gives the link as it is felt at its frame and at its
carriers (theory (7.9), (7.10): static condensation of structural dynamics, of M + s K instead of K).

The matrices serve Newton's method, whose solution does not depend on them, and are therefore not
differentiated.  They are those of a sample's own links: with those of the perfect mechanism, length
errors of 0.3 % let what a correction of a derivative leaves over grow from step to step.  Where no length
varies, a batch shares them.  Geometrically exact elements turn with the rfes, which changes the
stiffness felt in the link's axes as soon as a link is bent by more than its thickness: for them the
matrices are formed in the present place.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from rfem_jax.mechanics import algebra, elasticity, exact_elements
from rfem_jax.mechanics.algebra import apply, product, product_transposed
from rfem_jax.mechanics.chains import Chain, factor, solve
from rfem_jax.mechanics.kinematics import RelativeMotion
from rfem_jax.mechanics.model import Topology
from rfem_jax.mechanics.realisation import Realisation


class LinkOperator(NamedTuple):
    """A link at one step length; wrenches and accelerations are (moment, force) and (angular, linear).

    chain: M + s K of its m free rfes, factored; inertia (6, 6) felt at the link frame; compliance
    (6 c, 6 c) of its c carriers and its inverse stiffness; pick (6 c, 6 m): the carriers' rows of
    (M + s K)^-1; reduced (6 m, 6): what unit accelerations of the frame take from the second
    derivatives of the coordinates; give (6 c, 6): its rows of the carriers.
    """

    chain: Chain
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


def link_operators(
    realised: Realisation, q_factor: Array, v_factor: Array
) -> tuple[LinkOperator | None, ...]:
    """Operators of all links (None for rigid ones), undeformed, for steps in which coordinates move by
    q_factor [s^2] and rates by v_factor [s] times their accelerations."""
    realised = jax.lax.stop_gradient(realised)
    topology, n = realised.topology, realised.topology.n_links
    springs = elasticity.stiffness_blocks(realised)
    nothing = jnp.zeros_like(realised.rest)
    at = jnp.stack([realised.rest, nothing, nothing], axis=1)
    inertia = jnp.moveaxis(realised.inertia[:, :, n:], 2, 0)

    def operator(l, a, b):
        own = realised.mass[n + a : n + b], realised.centre[:, n + a : n + b].T, inertia[a:b]
        mass, coupling, rigid = _rigid_link(realised, l, own, at[a:b])
        s = q_factor + realised.damping[a] * v_factor
        chain = factor(mass + s * springs.own[a:b], s * springs.beside[a:b])
        return _condensed(chain, coupling, rigid, local_carriers(topology, l))

    return tuple(operator(l, a, b) if b > a else None for l, (a, b) in enumerate(topology.ranges))


def _rigid_link(realised: Realisation, link: int, own, at):
    """Inertias (m, 6, 6) of the free rfes with (mass, centre, inertia) `own`, rfe first, coupling M X
    (m, 6, 6) for their places `at` (m, 3), and inertia (6, 6) of the whole link at its frame."""
    mass = jax.vmap(_inertia)(*own)
    # Motion of the rfes' middles when the link frame moves: linear += angular x position.
    spread = jax.vmap(lambda p: jnp.eye(6).at[3:, :3].set(-_cross_matrix(p)))(at)
    coupling = jnp.einsum("mij,mjk->mik", mass, spread)
    root = _inertia(realised.mass[link], realised.centre[:, link], realised.inertia[:, :, link])
    return mass, coupling, root + jnp.einsum("mji,mjk->ik", spread, coupling)


def _cross_matrix(p):
    return jnp.cross(jnp.eye(3), p[None]).T * -1.0


def _inertia(mass, centre, inertia):
    """Inertia (6, 6), angular part first, of one body about its reference point."""
    shift = _cross_matrix(centre)
    first = mass * shift
    return jnp.block([[inertia - first @ shift, first], [-first, mass * jnp.eye(3)]])


def present_operators(
    realised: Realisation, now: RelativeMotion, q_factor: Array, v_factor: Array
) -> tuple[LinkOperator | None, ...]:
    """Operators of links of geometrically exact elements in the present place."""
    realised, now = jax.lax.stop_gradient((realised, now))
    topology = realised.topology
    nothing = jnp.zeros_like(realised.rest)
    u = now.position - jnp.stack([realised.rest, nothing, nothing])
    springs = exact_elements.stiffness_blocks(realised, u, now)
    turned = product(now.rotation, realised.inertia[:, :, topology.n_links :])
    inertia = product_transposed(turned, now.rotation)
    centre = apply(now.rotation, realised.centre[:, topology.n_links :])
    inertia = jnp.moveaxis(inertia, 2, 0)
    # Of the coordinates: their rates turn a rfe about its present axes.
    turn = jnp.zeros((topology.n_rfes, 6, 6)).at[:, 3:, 3:].set(jnp.eye(3))
    turn = turn.at[:, :3, :3].set(jnp.moveaxis(now.rate_matrix, 2, 0))

    def operator(l, a, b):
        n = topology.n_links
        own = realised.mass[n + a : n + b], centre[:, a:b].T, inertia[a:b]
        mass, coupling, rigid = _rigid_link(realised, l, own, now.position[:, a:b].T)
        s, t = q_factor + realised.damping[a] * v_factor, turn[a:b]
        diagonal = jnp.einsum("mji,mjk,mkl->mil", t, mass + s * springs.own[a:b], t)
        left = jnp.roll(t, 1, axis=0)
        beside = s * jnp.einsum("mji,mjk,mkl->mil", t, springs.beside[a:b], left)
        coupling = jnp.einsum("mji,mjk->mik", t, coupling)
        return _condensed(factor(diagonal, beside), coupling, rigid, local_carriers(topology, l))

    return tuple(operator(l, a, b) if b > a else None for l, (a, b) in enumerate(topology.ranges))


def _condensed(chain, coupling, rigid, carriers) -> LinkOperator:
    m = coupling.shape[0]
    rows = np.array([k + m * c for k in carriers for c in range(6)], dtype=int)
    unit = jnp.zeros((6, m, len(rows)))
    for i, k in enumerate(carriers):
        unit = unit.at[:, k, 6 * i : 6 * i + 6].set(jnp.eye(6))
    pick = solve(chain, unit).reshape(6 * m, len(rows)).T
    coupling = coupling.swapaxes(0, 1)
    reduced = solve(chain, coupling).reshape(6 * m, 6)
    compliance = pick[:, rows]
    return LinkOperator(
        chain=chain,
        inertia=rigid - coupling.reshape(6 * m, 6).T @ reduced,
        give=reduced[rows],
        compliance=compliance,
        stiffness=algebra.invert_positive(compliance),
        pick=pick,
        reduced=reduced,
    )
