"""The stiff part of a flexible link, condensed: what an implicit step needs of it.

Place in the pipeline: model -> **condensation** -> newton.

In the link's own axes, near its undeformed shape, the free rfes obey

    (M + s K) y + M X A = r + S w,      s = q_factor + damping * v_factor

for the second derivatives y of the elastic coordinates, the acceleration A of the link frame, residual
generalised forces r and wrenches w on the rfes that carry joints; M, K, X and S are constant.
M + s K, factored once along the chain of rfes, gives the link as it is felt at its frame and at its
carriers (static condensation of structural dynamics, of M + s K instead of K).

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
from rfem_jax.mechanics.block_tridiagonal import Factored, factor, solve
from rfem_jax.mechanics.kinematics import RelativeMotion
from rfem_jax.mechanics.model import Topology
from rfem_jax.mechanics.model_with_errors import ModelWithErrors


class LinkOperator(NamedTuple):
    """A link at one step length; wrenches and accelerations are (moment, force) and (angular, linear).

    factored: M + s K of its m free rfes, factored; inertia (6, 6) felt at the link frame; compliance
    (6 c, 6 c) of its c carriers and its inverse stiffness; pick (6 c, 6 m): the carriers' rows of
    (M + s K)^-1; reduced (6 m, 6): what unit accelerations of the frame take from the second
    derivatives of the coordinates; give (6 c, 6): its rows of the carriers.
    """

    factored: Factored
    inertia: Array
    frame_to_interface: Array
    compliance: Array
    stiffness: Array
    interface_rows: Array
    rigid_response: Array


def local_interfaces(topology: Topology, link: int) -> tuple[int, ...]:
    """Free rfes of a link that carry joints, counted within the link."""
    first, last = topology.ranges[link]
    return tuple(k - first for k in topology.interfaces if first <= k < last)


def link_operators(actual: ModelWithErrors, q_factor: Array, v_factor: Array) -> tuple[LinkOperator | None, ...]:
    """Operators of all links (None for rigid ones), undeformed, for steps in which coordinates move by
    q_factor [s^2] and rates by v_factor [s] times their accelerations."""
    actual = jax.lax.stop_gradient(actual)
    topology, n = actual.topology, actual.topology.n_links
    springs = elasticity.stiffness_blocks(actual)
    nothing = jnp.zeros_like(actual.rest)
    at = jnp.stack([actual.rest, nothing, nothing], axis=1)
    inertia = jnp.moveaxis(actual.inertia[:, :, n:], 2, 0)

    def operator(l, a, b):
        own = actual.mass[n + a : n + b], actual.centre[:, n + a : n + b].T, inertia[a:b]
        mass, coupling, rigid = _rigid_link(actual, l, own, at[a:b])
        s = q_factor + actual.damping[a] * v_factor
        factored = factor(mass + s * springs.own[a:b], s * springs.beside[a:b])
        return _condensed(factored, coupling, rigid, local_interfaces(topology, l))

    return tuple(operator(l, a, b) if b > a else None for l, (a, b) in enumerate(topology.ranges))


def _rigid_link(actual: ModelWithErrors, link: int, own, at):
    """Inertias (m, 6, 6) of the free rfes with (mass, centre, inertia) `own`, rfe first, coupling M X
    (m, 6, 6) for their places `at` (m, 3), and inertia (6, 6) of the whole link at its frame."""
    mass = jax.vmap(_inertia)(*own)
    # Motion of the rfes' middles when the link frame moves: linear += angular x position.
    spread = jax.vmap(lambda p: jnp.eye(6).at[3:, :3].set(-_cross_matrix(p)))(at)
    coupling = jnp.einsum("mij,mjk->mik", mass, spread)
    root = _inertia(actual.mass[link], actual.centre[:, link], actual.inertia[:, :, link])
    return mass, coupling, root + jnp.einsum("mji,mjk->ik", spread, coupling)


def _cross_matrix(p):
    return jnp.cross(jnp.eye(3), p[None]).T * -1.0


def _inertia(mass, centre, inertia):
    """Inertia (6, 6), angular part first, of one body about its reference point."""
    shift = _cross_matrix(centre)
    first = mass * shift
    return jnp.block([[inertia - first @ shift, first], [-first, mass * jnp.eye(3)]])


def present_operators(
    actual: ModelWithErrors, now: RelativeMotion, q_factor: Array, v_factor: Array
) -> tuple[LinkOperator | None, ...]:
    """Operators of links of geometrically exact elements in the present place."""
    actual, now = jax.lax.stop_gradient((actual, now))
    topology = actual.topology
    nothing = jnp.zeros_like(actual.rest)
    u = now.position - jnp.stack([actual.rest, nothing, nothing])
    springs = exact_elements.stiffness_blocks(actual, u, now)
    turned = product(now.rotation, actual.inertia[:, :, topology.n_links :])
    inertia = product_transposed(turned, now.rotation)
    centre = apply(now.rotation, actual.centre[:, topology.n_links :])
    inertia = jnp.moveaxis(inertia, 2, 0)
    # Of the coordinates: their rates turn a rfe about its present axes.
    turn = jnp.zeros((topology.n_rfes, 6, 6)).at[:, 3:, 3:].set(jnp.eye(3))
    turn = turn.at[:, :3, :3].set(jnp.moveaxis(now.rate_matrix, 2, 0))

    def operator(l, a, b):
        n = topology.n_links
        own = actual.mass[n + a : n + b], centre[:, a:b].T, inertia[a:b]
        mass, coupling, rigid = _rigid_link(actual, l, own, now.position[:, a:b].T)
        s, t = q_factor + actual.damping[a] * v_factor, turn[a:b]
        diagonal = jnp.einsum("mji,mjk,mkl->mil", t, mass + s * springs.own[a:b], t)
        left = jnp.roll(t, 1, axis=0)
        beside = s * jnp.einsum("mji,mjk,mkl->mil", t, springs.beside[a:b], left)
        coupling = jnp.einsum("mji,mjk->mik", t, coupling)
        return _condensed(factor(diagonal, beside), coupling, rigid, local_interfaces(topology, l))

    return tuple(operator(l, a, b) if b > a else None for l, (a, b) in enumerate(topology.ranges))


def _condensed(factored, coupling, rigid, interfaces) -> LinkOperator:
    m = coupling.shape[0]
    rows = np.array([k + m * c for k in interfaces for c in range(6)], dtype=int)
    unit = jnp.zeros((6, m, len(rows)))
    for i, k in enumerate(interfaces):
        unit = unit.at[:, k, 6 * i : 6 * i + 6].set(jnp.eye(6))
    interface_rows = solve(factored, unit).reshape(6 * m, len(rows)).T
    coupling = coupling.swapaxes(0, 1)
    rigid_response = solve(factored, coupling).reshape(6 * m, 6)
    compliance = interface_rows[:, rows]
    return LinkOperator(
        factored=factored,
        inertia=rigid - coupling.reshape(6 * m, 6).T @ rigid_response,
        frame_to_interface=rigid_response[rows],
        compliance=compliance,
        stiffness=algebra.invert_positive(compliance),
        interface_rows=interface_rows,
        rigid_response=rigid_response,
    )
