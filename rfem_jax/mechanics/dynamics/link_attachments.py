"""All that acts on a link at places: joints, force elements, point masses.

Place in the pipeline: link_bodies, loads -> **link_attachments** -> section_loads.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

from rfem_jax.mechanics.algebra import vectors
from rfem_jax.mechanics.dynamics.link_bodies import LinkBodies, inertial_wrench, length_of, middles_of
from rfem_jax.mechanics.dynamics.slender_forces import Moving
from rfem_jax.mechanics.laws.clearances import clearance_name
from rfem_jax.mechanics.model.masses_with_errors import off_diagonal
from rfem_jax.mechanics.model.model import Model
from rfem_jax.mechanics.model.topology import BASE
from rfem_jax.mechanics.model.with_errors import ModelWithErrors, point_places


class Attachment(NamedTuple):
    """A load on a rfe: number of the rfe in the link, place x [m] along its axis, wrench (6,) at the global origin."""

    rfe: int
    x: Float[Array, ""]
    wrench: Float[Array, "6"]


def attachments_of(
    model: Model, actual: ModelWithErrors, now: Moving, link: int, bodies: LinkBodies
) -> list[Attachment]:
    """All that acts on a link: joints, force elements, and the inertia and the weight of point masses."""
    topology, attachments, form = actual.topology, [], model.form

    def add(node: int, x: Array, wrench: Array, share: Array | None = None) -> None:
        rfe = _rfe_of(actual, link, node)
        if rfe is not None:
            if share is not None:
                x = share * length_of(actual, link) - middles_of(actual, link, [rfe])[0]
            attachments.append(Attachment(rfe, x, wrench))

    for j, wrench in enumerate(now.wrenches):
        add(topology.parents[j], actual.seat_position[0, j], -wrench, None if form is None else form.seats.share[j])
        add(topology.children[j], actual.bore_position[0, j], wrench, None if form is None else form.bores.share[j])
    if now.frame_loads is not None and actual.frame_forces is not None:
        for name, element in actual.frame_forces.elements.items():
            exerted = now.frame_loads.exerted[name]
            wrench = vectors.wrench_at_origin(exerted.moment, exerted.force, exerted.place)
            one, other = _element_shares(model, name)
            add(element.child.node, element.child.position[0], wrench, other)
            add(element.parent.node, element.parent.position[0], -wrench, one)
    masses = point_places(model, actual)
    for k, node in enumerate(topology.masses):
        rfe = _rfe_of(actual, link, node)
        if rfe is not None:
            load = _point_mass_load(model, actual, k, masses[:, k], bodies.at([rfe]))
            add(node, masses[0, k], -load, None if form is None else form.masses.share[k])
    return attachments


def _element_shares(model: Model, name: str) -> tuple[Array | None, Array | None]:
    """Shares of the links' lengths at both ends of a force element; None where no link has a form."""
    if model.form is None:
        return None, None
    if name not in model.form.elements:  # the contact of a joint with a clearance
        joint = next(j for j, joint in enumerate(model.topology.joints) if clearance_name(joint) == name)
        return model.form.seats.share[joint], model.form.bores.share[joint]
    shares = model.form.elements[name].share
    return (shares[0] if shares.shape[0] > 1 else None), shares[-1]


def _point_mass_load(model: Model, actual: ModelWithErrors, k: int, place: Array, body: LinkBodies) -> Array:
    """Rate of momentum minus weight of a point mass as a wrench (6,) at the global origin."""
    inertia = jnp.diag(model.point_inertia[:, k])
    if model.point_products is not None:
        inertia = inertia + off_diagonal(model.point_products[:, k])
    return inertial_wrench(actual, body, model.point_mass[k, None], place[:, None], inertia[:, :, None])[:, 0]


def _rfe_of(actual: ModelWithErrors, link: int, node: int) -> int | None:
    """Number of a node among the rfes of a link, None for a node of another link or of the base."""
    topology = actual.topology
    if node == BASE or topology.link_of(node) != link:
        return None
    return 0 if node < topology.n_links else node - topology.n_links - topology.ranges[link][0] + 1


def attachment_loads(
    attachments: Sequence[Attachment], sections: Sequence[tuple[int, Array, int | None]], n: int, near: Array
) -> Array:
    """Loads of the attachments between the reference position of an rfe and a section, as wrenches (6, sections)."""
    columns = []
    for rfe, x, beside in sections:
        from_right = n > 1 and rfe == n - 1
        total = jnp.zeros(6)
        for i, one in enumerate(attachments):
            if one.rfe != rfe:
                continue
            right_of_it = one.x <= x + near if beside is None or beside >= 0 else one.x < x - near
            if beside in (i, -1 - i):
                right_of_it = jnp.asarray(beside == i)
            wanted = jnp.logical_not(right_of_it) if from_right else right_of_it
            total = total + jnp.where(wanted, one.wrench if from_right else -one.wrench, 0.0)
        columns.append(total)
    return jnp.stack(columns, axis=1)
