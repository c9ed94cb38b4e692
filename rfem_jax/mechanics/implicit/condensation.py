"""Flexible links in an implicit step, condensed to their link frame and their interfaces.

Place in the pipeline: model with errors, block_tridiagonal -> **condensation** -> newton, statics.

In the link's axes, linearised about its undeformed shape, the equations of the free rfes are
(theory (7.8))

    (M + s K) y + M X A = r + S w,      s = q_factor + damping * v_factor

for the second derivatives y of the elastic coordinates, the acceleration A of the link frame, residual
generalised forces r and wrenches w on the link's interfaces, which are the free rfes that carry joints;
M, K, X (rigid-body modes) and S (selection of the interfaces) are constant.  Eliminating all other
coordinates is static condensation (Guyan, AIAA J. 3 (1965) 380; with the link frame as a boundary as in
Craig and Bampton, AIAA J. 6 (1968) 1313-1319) of the dynamic stiffness M + s K, so that nothing is lost
(theory (7.9), (7.10)).

The operators approximate the tangent for Newton's method, whose solution does not depend on them, and are
therefore not differentiated.  They are those of each sample's links: with those of the perfect mechanism,
length errors of 0.3 % made the residual of a refined derivative grow from step to step.  Where no length
varies, a batch shares them.  Geometrically exact elements rotate with the rfes, which changes the stiffness
in the link's axes as soon as a link is bent by more than its thickness: their operators are formed at the
present deflection.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from rfem_jax.mechanics.algebra import vectors
from rfem_jax.mechanics.algebra.block_tridiagonal import Factored, factor
from rfem_jax.mechanics.algebra.constrained_chain import ConstrainedChain, factor_constrained, positive_inverse, solve
from rfem_jax.mechanics.algebra.vectors import apply, product, product_transposed
from rfem_jax.mechanics.elements import elasticity, exact_elements
from rfem_jax.mechanics.kinematics.motion import RelativeMotion
from rfem_jax.mechanics.kinematics.slender_links import unit_rates
from rfem_jax.mechanics.model.superelements import Superelement
from rfem_jax.mechanics.model.topology import Topology
from rfem_jax.mechanics.model.with_errors import ModelWithErrors


class LinkOperator(NamedTuple):
    """A link with m free rfes and c interfaces at one step length; wrenches are (moment, force),
    accelerations (angular, linear).

    factored: M + s K; inertia (6, 6): of the link condensed to its frame, interfaces free;
    interface_rows (6 c, 6 m): rows S^T (M + s K)^-1 of the interfaces; compliance (6 c, 6 c): S^T
    (M + s K)^-1 S, and its inverse, stiffness; rigid_response (6 m, 6): (M + s K)^-1 M X, minus the second
    derivatives of the coordinates due to unit accelerations of the frame; frame_to_interface (6 c, 6): its
    rows of the interfaces.

    Of slender links (theory (7.23)) all this is on the motions that they have, for which compliance may be singular:
    interface_motions (6 c, 3 m), those of the interfaces, take the place of the stiffness.
    """

    factored: Factored | ConstrainedChain
    inertia: Float[Array, "6 6"]
    frame_to_interface: Float[Array, "interfaces 6"]
    compliance: Float[Array, "interfaces interfaces"]
    stiffness: Float[Array, "interfaces interfaces"] | None
    interface_rows: Float[Array, "interfaces elastic"]
    rigid_response: Float[Array, "elastic 6"]
    interface_motions: Float[Array, "interfaces free"] | None = None


def local_interfaces(topology: Topology, link: int) -> tuple[int, ...]:
    """Interfaces of a link as indices of its own free rfes."""
    first, last = topology.ranges[link]
    return tuple(k - first for k in topology.interfaces if first <= k < last)


def link_operators(
    actual: ModelWithErrors, q_factor: Float[Array, ""], v_factor: Float[Array, ""]
) -> tuple[LinkOperator | None, ...]:
    """Operators of all links (None for rigid ones), undeformed, for steps in which a change of the
    accelerations changes coordinates by q_factor [s^2] and rates by v_factor [s] times as much."""
    return _link_operators(jax.lax.stop_gradient(actual), q_factor, v_factor)


@jax.jit  # traced once for all its places
def _link_operators(actual, q_factor, v_factor):
    topology, n = actual.topology, actual.topology.n_links
    springs = elasticity.stiffness_blocks(actual)
    middle = _rest(actual)
    bodies = _rigid_bodies(actual, actual.centre[:, n:], actual.inertia[:, :, n:], middle)

    superelements = _superelements(actual)

    def operator(l, a, b):
        mass, coupling, rigid = bodies.of_link(topology, l)
        if l in superelements:
            element = superelements[l], q_factor + superelements[l].damping * v_factor
            return _condense_superelement(*element, mass, coupling, rigid, interfaces=local_interfaces(topology, l))
        s = q_factor + actual.damping[a] * v_factor
        stiffness = mass + s * springs.diagonal[a:b], s * springs.lower[a:b]
        motions = unit_rates(actual, None, l) if l in topology.slender else None
        return _condense(*stiffness, coupling, rigid, motions, interfaces=local_interfaces(topology, l))

    return tuple(operator(l, a, b) if b > a else None for l, (a, b) in enumerate(topology.ranges))


def _rest(actual: ModelWithErrors) -> Float[Array, "3 rfes"]:
    """Reference points of the free rfes of undeformed links."""
    if actual.topology.shaped:
        return actual.rest
    zeros = jnp.zeros_like(actual.rest)
    return jnp.stack([actual.rest, zeros, zeros])


class _RigidBodies(NamedTuple):
    """Inertia of the bodies of all links, in the links' axes.

    mass (rfes, 6, 6): M of the free rfes; coupling (rfes, 6, 6): M X; moved (rfes, 6, 6): X^T M X; roots (6, 6, links):
    of the rfes 0 at their frames.
    """

    mass: Float[Array, "rfes 6 6"]
    coupling: Float[Array, "rfes 6 6"]
    moved: Float[Array, "rfes 6 6"]
    roots: Float[Array, "6 6 links"]

    def of_link(self, topology: Topology, link: int) -> tuple[Array, Array, Array]:
        """M (m, 6, 6) and M X (m, 6, 6) of the free rfes of a link; inertia (6, 6) of the whole link, rigid, at its
        frame."""
        a, b = topology.ranges[link]
        rigid = self.roots[:, :, link] + jnp.sum(self.moved[a:b], axis=0)
        return self.mass[a:b], self.coupling[a:b], rigid


def _rigid_bodies(actual: ModelWithErrors, centre: Array, inertia: Array, middle: Array) -> _RigidBodies:
    """Bodies of links whose free rfes have centres (3, rfes), central inertias (3, 3, rfes) and middles (3, rfes)."""
    n = actual.topology.n_links
    mass = jnp.moveaxis(vectors.spatial_inertia(actual.mass[n:], centre, inertia), 2, 0)
    # Motion of the rfes' middles when the link frame moves: linear += angular x position.
    shift = jnp.moveaxis(vectors.cross_matrix(middle), 2, 0)
    rigid_modes = jnp.broadcast_to(jnp.eye(6), mass.shape).at[:, 3:, :3].set(-shift)
    coupling = mass @ rigid_modes
    moved = rigid_modes.swapaxes(1, 2) @ coupling
    return _RigidBodies(mass, coupling, moved, root_inertia(actual, slice(n)))


def root_inertia(actual: ModelWithErrors, link: int | slice) -> Float[Array, "6 6 *links"]:
    """Spatial inertia of a link's rfe 0, or that of several links, at its frame, in its axes."""
    return vectors.spatial_inertia(actual.mass[link], actual.centre[:, link], actual.inertia[:, :, link])


def operators_at(
    actual: ModelWithErrors,
    operators: tuple[LinkOperator | None, ...],
    relative: RelativeMotion,
    q_factor: Float[Array, ""],
    v_factor: Float[Array, ""],
) -> tuple[LinkOperator | None, ...]:
    """Condensed links at the present deflection: `operators`, those of `link_operators`, where elements are linear."""
    return present_operators(actual, relative, q_factor, v_factor) if actual.topology.exact else operators


def present_operators(
    actual: ModelWithErrors, relative: RelativeMotion, q_factor: Float[Array, ""], v_factor: Float[Array, ""]
) -> tuple[LinkOperator | None, ...]:
    """`link_operators` of geometrically exact elements at the present deflection."""
    actual, relative = jax.lax.stop_gradient((actual, relative))
    topology, n = actual.topology, actual.topology.n_links
    u = relative.position - _rest(actual)
    springs = exact_elements.stiffness_blocks(actual, u, relative)
    rotated = product(relative.rotation, actual.inertia[:, :, n:])
    inertia = product_transposed(rotated, relative.rotation)
    centre = apply(relative.rotation, actual.centre[:, n:])
    # From rates of the coordinates, whose angles are about the rfe's present axes, to twists in link axes.
    rates = jnp.zeros((topology.n_rfes, 6, 6)).at[:, 3:, 3:].set(jnp.eye(3))
    rates = rates.at[:, :3, :3].set(jnp.moveaxis(relative.rate_matrix, 2, 0))
    bodies = _rigid_bodies(actual, centre, inertia, relative.position)

    superelements = _superelements(actual)
    undeformed = _rigid_bodies(actual, actual.centre[:, n:], actual.inertia[:, :, n:], _rest(actual))

    def operator(l, a, b):
        if l in superelements:
            element = superelements[l], q_factor + superelements[l].damping * v_factor
            parts = undeformed.of_link(topology, l)
            return _condense_superelement(*element, *parts, interfaces=local_interfaces(topology, l))
        mass, coupling, rigid = bodies.of_link(topology, l)
        s, t = q_factor + actual.damping[a] * v_factor, rates[a:b]
        diagonal = jnp.einsum("mji,mjk,mkl->mil", t, mass + s * springs.diagonal[a:b], t)
        left = jnp.roll(t, 1, axis=0)
        lower = s * jnp.einsum("mji,mjk,mkl->mil", t, springs.lower[a:b], left)
        coupling = jnp.einsum("mji,mjk->mik", t, coupling)
        motions = unit_rates(actual, relative, l) if l in topology.slender else None
        return _condense(diagonal, lower, coupling, rigid, motions, interfaces=local_interfaces(topology, l))

    return tuple(operator(l, a, b) if b > a else None for l, (a, b) in enumerate(topology.ranges))


@functools.partial(jax.jit, static_argnames="interfaces")  # traced once for links of one shape
def _condense(
    diagonal: Array,
    lower: Array,
    coupling: Array,
    rigid: Array,
    motions: Array | None,
    *,
    interfaces: tuple[int, ...],
) -> LinkOperator:
    """The operator from the blocks (m, 6, 6) of M + s K on and below the diagonal, M X (m, 6, 6), the rigid link's
    inertia (6, 6), and the motions (6 m, 3 m) of a slender link."""
    factored = factor(diagonal, lower) if motions is None else factor_constrained(diagonal, lower, motions)
    return _condensed(factored, coupling, rigid, motions, interfaces)


def _superelements(actual: ModelWithErrors) -> dict[int, Superelement]:
    """The superelements by link."""
    return dict(zip((one.link for one in actual.topology.reduced), actual.superelements or (), strict=True))


@functools.partial(jax.jit, static_argnames="interfaces")  # as `_condense`
def _condense_superelement(
    element: Superelement, s: Array, mass: Array, coupling: Array, rigid: Array, *, interfaces: tuple[int, ...]
) -> LinkOperator:
    """The operator of a superelement, whose matrices are full; `mass` and `coupling` of what stands on its interfaces,
    `rigid` with these."""
    m = mass.shape[0]
    angles_first = np.roll(np.arange(6 * m), 3 * m)
    system = (element.mass + s * element.stiffness)[angles_first][:, angles_first]
    beside = mass.transpose(1, 0, 2)[:, :, :, None] * np.eye(m)[None, :, None]
    inverse = positive_inverse(system + beside.reshape(6 * m, 6 * m))
    by_frame = jnp.concatenate([element.rotation, element.translation])[:, angles_first].T
    by_frame = by_frame.reshape(6, m, 6).swapaxes(0, 1)
    return _condensed(Factored(inverse[None], None, None), coupling + by_frame, rigid, None, interfaces)


def _condensed(
    factored: Factored | ConstrainedChain,
    coupling: Array,
    rigid: Array,
    motions: Array | None,
    interfaces: tuple[int, ...],
) -> LinkOperator:
    """The operator of a factored link."""
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
        stiffness=vectors.invert_positive(compliance) if motions is None else None,
        interface_rows=interface_rows,
        rigid_response=rigid_response,
        interface_motions=None if motions is None else motions[rows],
    )
