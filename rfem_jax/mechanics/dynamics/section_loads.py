"""Internal forces and moments along the links, and the stresses at the edges of their sections.

Place in the pipeline: kinematics, elasticity, loads -> **section_loads** -> simulation.outcome.records, report.

At the sde in the middle of a segment the elements give them. Between sdes every rfe is a rigid body in equilibrium
with its inertia, its weight and what joints, point masses and forces exert on it, so that at both sides of each of
these the section's loads follow from the nearest end of the link, where nothing is beyond, or else from the sde on the
rfe's left (theory (8.10)). They are what the part with the larger x exerts on the other one.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from rfem_jax.mechanics.algebra import vectors
from rfem_jax.mechanics.algebra.vectors import apply, apply_transposed, constant_product, cross, product
from rfem_jax.mechanics.dynamics.link_attachments import Attachment, attachment_loads, attachments_of
from rfem_jax.mechanics.dynamics.link_bodies import LinkBodies, bodies_of_link, length_of, middles_of, rests_of
from rfem_jax.mechanics.dynamics.link_pieces import loads_along, piece_loads
from rfem_jax.mechanics.dynamics.slender_forces import Moving, constraint_forces
from rfem_jax.mechanics.elements import elasticity
from rfem_jax.mechanics.elements.deformed_bodies import deformed
from rfem_jax.mechanics.model.model import Model, State
from rfem_jax.mechanics.model.superelements import TENSOR_ROWS
from rfem_jax.mechanics.model.with_errors import ModelWithErrors

COUPLED_ROWS = 12  # of the edge of a coupled section: stresses and shear stresses by six loads
RIGID_PARTS = 8  # of a rigid link, at whose ends there are sections, too
SAME_PLACE = 1e-9  # of the link's length
NO_ATTACHMENT = 1_000_000  # a number that no attachment has


class SectionLoads(NamedTuple):
    """Internal loads at all sections of a link: place x (sections,) [m] along it, and (N, Q_y, Q_z) [N], (T, M_y, M_z)
    [N m] (6, sections) in the axes of the section."""

    place: Float[Array, " sections"]
    resultants: Float[Array, "6 sections"]


def loads_of_sections(model: Model, actual: ModelWithErrors, state: State, now: Moving, link: int) -> SectionLoads:
    """Internal forces and moments of a link at one instant, at its sdes and at both sides of all that acts on it."""
    with jax.named_scope("section_loads"):
        topology, n = actual.topology, actual.topology.elements[link]
        if link in [one.link for one in topology.reduced]:
            return _stresses_of_body(actual, now, link)
        first, _ = topology.ranges[link]
        bodies = bodies_of_link(actual, now, link)
        attachments = attachments_of(model, actual, now, link, bodies)
        length = length_of(actual, link)
        sections = _sections_beside(attachments, n, length)
        sections += _at_stations(model, actual, link)
        parts = []
        if n > 1:
            at_sdes = elasticity.section_loads(actual, state, now.motion.relative, constraint_forces(actual, now))
            at_sdes = at_sdes[:, first : first + n - 1]
            if actual.form is not None:
                axes = actual.form.axes[:, :, first : first + n - 1]
                at_sdes = jnp.concatenate([apply_transposed(axes, at_sdes[:3]), apply_transposed(axes, at_sdes[3:])])
            parts.append(((np.arange(n - 1) + 0.5) / (n - 1) * length, at_sdes))
        if sections:
            parts.append(_loads_at(model, actual, state, now, link, (bodies, attachments, sections)))
        if not parts:
            return SectionLoads(jnp.zeros((0,)), jnp.zeros((6, 0)))
        return SectionLoads(*(jnp.concatenate(part, axis=-1) for part in zip(*parts, strict=True)))


def _stresses_of_body(actual: ModelWithErrors, now: Moving, link: int) -> SectionLoads:
    """Of a superelement components of stress [Pa] (6, places) in the place of resultants; nothing where they are not
    known (theory (19.11))."""
    for one in deformed(actual, now.motion.relative):
        if one.link == link and one.element.stresses is not None:
            places = one.element.stresses.shape[0]
            components = constant_product(one.element.stresses.reshape(6 * places, -1), one.q)
            return SectionLoads(jnp.zeros(places), components.reshape(places, 6).T)
    return SectionLoads(jnp.zeros((0,)), jnp.zeros((6, 0)))


def loads_of_section(
    model: Model, actual: ModelWithErrors, state: State, now: Moving, link: int, fraction: float
) -> SectionLoads:
    """Internal forces and moments of a link at one instant in the one section at a fraction of its length; those beyond
    all that acts on the link there."""
    with jax.named_scope("section_loads"):
        lengths, _ = actual.topology.fractions(link)
        rfe = int(np.searchsorted(np.cumsum(lengths)[:-1], fraction, side="right"))
        bodies, length = bodies_of_link(actual, now, link), length_of(actual, link)
        attachments = attachments_of(model, actual, now, link, bodies)
        x = fraction * length - middles_of(actual, link, [rfe])[0]
        return SectionLoads(*_loads_at(model, actual, state, now, link, (bodies, attachments, [(rfe, x, None)])))


def _loads_at(
    model: Model, actual: ModelWithErrors, state: State, now: Moving, link: int,
    beside: tuple[LinkBodies, list[Attachment], list[tuple[int, Array, int | None]]],
) -> tuple[Array, Array]:  # fmt: skip
    """Places (sections,) [m] and resultants (6, sections) of sections, by the equilibrium of the pieces up to them."""
    bodies, attachments, sections = beside
    rfes, n = [rfe for rfe, _, _ in sections], actual.topology.elements[link]
    x = jnp.stack([_beam_place(actual, link, rfe, x) for rfe, x, _ in sections])
    wrench = _reference_loads(actual, state, now, link, bodies, rfes)
    start = _reference_positions(actual, link, rfes)
    wrench = wrench + piece_loads(model, actual, link, bodies.at(rfes), rfes, (start, x))
    if now.frame_loads is not None and now.frame_loads.lines is not None:
        wrench = wrench - loads_along(actual, now.frame_loads, link, bodies.at(rfes), rfes, (start, x))
    near = SAME_PLACE * length_of(actual, link)
    wrench = wrench + attachment_loads(attachments, sections, n, near)
    place = x + middles_of(actual, link, rfes)
    if model.profiles is not None and model.profiles[link] is not None:
        # To its side of a step there, whose section it has.
        place = place + near * np.array([0.0 if one is None else 1.0 if one >= 0 else -1.0 for _, _, one in sections])
    return place, _section_resultants(_section_frames(actual, link, bodies.at(rfes), rfes, x), wrench)


def stress_squares(
    edge: Float[Array, "loads points"] | Float[Array, "loads points sections"],
    resultants: Float[Array, "*times 6 sections"],
) -> Float[Array, "*times points sections"]:
    """Squares of the von Mises stress [Pa^2] at the edge of the sections of a link (theory (8.11)), whose points have 4
    numbers, or the 12 of a coupled section; of a superelement from the components of stress."""
    if edge.shape[0] == COUPLED_ROWS:
        edge = edge if edge.ndim == 3 else edge[:, :, None]
        direct, shear = (jnp.sum(rows * resultants[..., :, None, :], axis=-3) for rows in (edge[:6], edge[6:]))
        return direct**2 + 3.0 * shear**2
    if edge.shape[0] == TENSOR_ROWS:
        xx, yy, zz, xy, yz, zx = (resultants[..., i, :] for i in range(6))
        direct = 0.5 * ((xx - yy) ** 2 + (yy - zz) ** 2 + (zz - xx) ** 2)
        return (direct + 3.0 * (xy**2 + yz**2 + zx**2))[..., None, :]
    axial, about_y, about_z, by_torque = (edge[i] if edge.ndim == 3 else edge[i, :, None] for i in range(4))
    force, torque, moment_y, moment_z = (resultants[..., i, None, :] for i in (0, 3, 4, 5))

    def product_of(column: Array, load: Array) -> Array:
        return column.reshape((1,) * (load.ndim - 2) + column.shape) * load

    direct = product_of(axial, force) + product_of(about_y, moment_y) + product_of(about_z, moment_z)
    return direct**2 + 3.0 * product_of(by_torque, torque) ** 2


def _beam_place(actual: ModelWithErrors, link: int, rfe: int, x: Array) -> Array:
    """Place [m] on the axis of an rfe; a place beyond the end of the link is moved to that end."""
    n = actual.topology.elements[link]
    x = jnp.maximum(x, 0.0) if rfe == 0 else x
    if rfe < n - 1:
        return x
    return jnp.minimum(x, actual.beam_middle[link] if n > 1 else length_of(actual, link))


def _sections_beside(attachments: Sequence[Attachment], n: int, length: Array) -> list[tuple[int, Array, int | None]]:
    """Sections on both sides of all attachments, and inside a rigid link.

    **Returns:** for every section its rfe, its place x [m] there, and its attachment: number i of the attachment just
    to the left, -1 - i for one just to the right, None where there is no attachment beside it.
    """
    sections: list[tuple[int, Array, int | None]] = []
    for i, one in enumerate(attachments):
        sections += [(one.rfe, one.x, -1 - i), (one.rfe, one.x, i)]
    if n == 1:
        sections += [(0, length * (k / RIGID_PARTS), None) for k in range(1, RIGID_PARTS)]
    return sections


def _at_stations(model: Model, actual: ModelWithErrors, link: int) -> list[tuple[int, Array, int | None]]:
    """Sections on both sides of the stations inside a link, as of `_sections_beside`; so are those of attachments that
    are at a station."""
    profile = None if model.profiles is None else model.profiles[link]
    if profile is None:
        return []
    longer, sections = length_of(actual, link) / model.length[link], []
    for rfe, span in zip(model.topology.stations[link], profile.spans[1:], strict=False):
        x = span.begin * longer - middles_of(actual, link, [rfe])[0]
        sections += [(rfe, x, -1 - NO_ATTACHMENT), (rfe, x, NO_ATTACHMENT)]
    return sections


def section_edges(model: Model, actual: ModelWithErrors, link: int, place: Float[Array, " sections"]) -> Any:
    """Stresses at the edges of the sections of a link at places [m], as `Sections.edges`; of a link with stations for
    each of the sections, (4, points, sections)."""
    edges = model.section.edges[link] if model.section.edges else None
    profile = None if model.profiles is None else model.profiles[link]
    if edges is None or profile is None:
        return edges
    return profile.edges(place * (model.length[link] / length_of(actual, link)))  # its stations move with its length


def _reference_positions(actual: ModelWithErrors, link: int, rfes: Sequence[int]) -> Array:
    """Places on the axes of rfes [m] at which the internal loads are known before any sum: the ends of the link, where
    there are none, and the sdes, which have the elastic force (`_reference_loads`)."""
    n, (first, _) = actual.topology.elements[link], actual.topology.ranges[link]
    places = []
    for rfe in rfes:
        if rfe == 0:
            places.append(jnp.zeros(()))
        else:
            last = rfe == n - 1
            half = -0.5 * length_of(actual, link) / (n - 1) if actual.form is not None else None
            at_sde = actual.lever_right[first + rfe - 1] if half is None else half
            places.append(actual.beam_middle[link] if last else at_sde)
    return jnp.stack(places)


def _reference_loads(
    actual: ModelWithErrors, state: State, now: Moving, link: int, bodies: LinkBodies, rfes: Sequence[int]
) -> Array:
    """Internal loads at `_reference_positions` as wrenches (6, sections) at the global origin."""
    topology, n = actual.topology, actual.topology.elements[link]
    inner = [0 < rfe < n - 1 for rfe in rfes]
    if not any(inner):
        return jnp.zeros((6, len(rfes)))
    first, _ = topology.ranges[link]
    axes = now.motion.links.rotation[:, :, link, None]
    force, moment = elasticity.wrenches_of_left(actual, state, now.motion.relative, constraint_forces(actual, now))
    zero, columns = jnp.zeros(6), []
    elastic = vectors.wrench_at_origin(
        apply(axes, moment[:, first : first + n - 1]), apply(axes, force[:, first : first + n - 1]), bodies.point[:, 1:]
    )
    for rfe, is_inner in zip(rfes, inner, strict=True):
        columns.append(-elastic[:, rfe - 1] if is_inner else zero)
    return jnp.stack(columns, axis=1)


def _section_frames(
    actual: ModelWithErrors, link: int, bodies: LinkBodies, rfes: Sequence[int], x: Array
) -> tuple[Float[Array, "3 n"], Float[Array, "3 3 n"]]:
    """Places and axes of sections in global axes."""
    if actual.form is None:
        return bodies.point + bodies.rotation[:, 0] * x[None], bodies.rotation
    found = actual.form.at(link, x + middles_of(actual, link, rfes))
    arm = found.position - rests_of(actual, link, rfes)
    return bodies.point + apply(bodies.rotation, arm), product(bodies.rotation, found.axes)


def _section_resultants(frames: tuple[Array, Array], wrench: Array) -> Array:
    """Wrenches (6, n) at the global origin as forces and moments (6, n) about the section's centre in its axes."""
    place, axes = frames
    force = wrench[3:]
    moment = wrench[:3] - cross(place, force)
    return jnp.concatenate([apply_transposed(axes, force), apply_transposed(axes, moment)])
