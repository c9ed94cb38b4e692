"""Internal forces and moments along the links, and the stresses at the edges of their sections.

Place in the pipeline: kinematics, elasticity, loads -> **section_loads** -> simulation.records, report.

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
from rfem_jax.mechanics.algebra.vectors import (
    apply,
    apply_transposed,
    constant_product,
    cross,
    product,
    product_transposed,
)
from rfem_jax.mechanics.dynamics.slender_forces import Moving, constraint_forces
from rfem_jax.mechanics.elements import elasticity
from rfem_jax.mechanics.elements.deformed_bodies import deformed
from rfem_jax.mechanics.forces.element_loads import FrameLoads
from rfem_jax.mechanics.forces.shaped_lines import shaped_line
from rfem_jax.mechanics.laws.clearances import clearance_name
from rfem_jax.mechanics.model.form import bodies_of, point_inertia, segments_of
from rfem_jax.mechanics.model.model import Model, State
from rfem_jax.mechanics.model.superelements import TENSOR_ROWS
from rfem_jax.mechanics.model.topology import BASE
from rfem_jax.mechanics.model.with_errors import ModelWithErrors, point_places

COUPLED_ROWS = 12  # of the edge of a coupled section: stresses and shear stresses by six loads
RIGID_PARTS = 8  # of a rigid link, at whose ends there are sections, too
SAME_PLACE = 1e-9  # of the link's length
NO_ATTACHMENT = 1_000_000  # a number that no attachment has


class SectionLoads(NamedTuple):
    """Internal loads at all sections of a link: place x (sections,) [m] along it, and (N, Q_y, Q_z) [N], (T, M_y, M_z)
    [N m] (6, sections) in the axes of the section."""

    place: Float[Array, " sections"]
    resultants: Float[Array, "6 sections"]


class _Bodies(NamedTuple):
    """Kinematics of bodies in global axes: rotation, reference point, angular velocity, accelerations."""

    rotation: Float[Array, "3 3 n"]
    point: Float[Array, "3 n"]
    spin: Float[Array, "3 n"]
    angular: Float[Array, "3 n"]
    linear: Float[Array, "3 n"]

    def at(self, indices: Sequence[int]) -> "_Bodies":
        """Some of the bodies, also repeatedly."""
        return _Bodies(*(jnp.stack([part[..., i] for i in indices], axis=-1) for part in self))


class _Attachment(NamedTuple):
    """A load on a rfe: number of the rfe in the link, place x [m] along its axis, wrench (6,) at the global origin."""

    rfe: int
    x: Float[Array, ""]
    wrench: Float[Array, "6"]


def loads_of_sections(model: Model, actual: ModelWithErrors, state: State, now: Moving, link: int) -> SectionLoads:
    """Internal forces and moments of a link at one instant, at its sdes and at both sides of all that acts on it."""
    with jax.named_scope("section_loads"):
        topology, n = actual.topology, actual.topology.elements[link]
        if link in [one.link for one in topology.reduced]:
            return _stresses_of_body(actual, now, link)
        first, _ = topology.ranges[link]
        bodies = _bodies_of(actual, now, link)
        attachments = _attachments(model, actual, now, link, bodies)
        length = _length(actual, link)
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
        bodies, length = _bodies_of(actual, now, link), _length(actual, link)
        attachments = _attachments(model, actual, now, link, bodies)
        x = fraction * length - _middles(actual, link, [rfe])[0]
        return SectionLoads(*_loads_at(model, actual, state, now, link, (bodies, attachments, [(rfe, x, None)])))


def _loads_at(
    model: Model, actual: ModelWithErrors, state: State, now: Moving, link: int,
    beside: tuple[_Bodies, list[_Attachment], list[tuple[int, Array, int | None]]],
) -> tuple[Array, Array]:  # fmt: skip
    """Places (sections,) [m] and resultants (6, sections) of sections, by the equilibrium of the pieces up to them."""
    bodies, attachments, sections = beside
    rfes, n = [rfe for rfe, _, _ in sections], actual.topology.elements[link]
    x = jnp.stack([_beam_place(actual, link, rfe, x) for rfe, x, _ in sections])
    wrench = _reference_loads(actual, state, now, link, bodies, rfes)
    start = _reference_positions(actual, link, rfes)
    wrench = wrench + _piece_loads(model, actual, link, bodies.at(rfes), rfes, (start, x))
    if now.frame_loads is not None and now.frame_loads.lines is not None:
        wrench = wrench - _line_loads(actual, now.frame_loads, link, bodies.at(rfes), rfes, (start, x))
    near = SAME_PLACE * _length(actual, link)
    wrench = wrench + _attachment_loads(attachments, sections, n, near)
    place = x + _middles(actual, link, rfes)
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


def _length(actual: ModelWithErrors, link: int) -> Array:
    """Length [m] of a link with its error."""
    return actual.beam_middle[link] / actual.topology.fractions(link)[1][0]


def _beam_place(actual: ModelWithErrors, link: int, rfe: int, x: Array) -> Array:
    """Place [m] on the axis of an rfe; a place beyond the end of the link is moved to that end."""
    n = actual.topology.elements[link]
    x = jnp.maximum(x, 0.0) if rfe == 0 else x
    if rfe < n - 1:
        return x
    return jnp.minimum(x, actual.beam_middle[link] if n > 1 else _length(actual, link))


def _bodies_of(actual: ModelWithErrors, now: Moving, link: int) -> _Bodies:
    """The rfes of a link."""
    topology = actual.topology
    a, b = topology.ranges[link]
    links, relative = now.motion.links, now.motion.relative
    axes, origin, spin = links.rotation[:, :, link, None], links.point[:, link, None], links.velocity[:3, link, None]
    free = slice(topology.n_links + a, topology.n_links + b)

    def of_nodes(values: Array) -> Array:
        return apply(axes, jnp.concatenate([values[:, link, None], values[:, free]], axis=1))

    return _Bodies(
        rotation=jnp.concatenate([axes, product(axes, relative.rotation[:, :, a:b])], axis=2),
        point=jnp.concatenate([origin, origin + apply(axes, relative.position[:, a:b])], axis=1),
        spin=jnp.concatenate([spin, spin + apply(axes, relative.angular[:, a:b])], axis=1),
        angular=of_nodes(now.angular),
        linear=of_nodes(now.linear),
    )


def _rfe_of(actual: ModelWithErrors, link: int, node: int) -> int | None:
    """Number of a node among the rfes of a link, None for a node of another link or of the base."""
    topology = actual.topology
    if node == BASE or topology.link_of(node) != link:
        return None
    return 0 if node < topology.n_links else node - topology.n_links - topology.ranges[link][0] + 1


def _attachments(model: Model, actual: ModelWithErrors, now: Moving, link: int, bodies: _Bodies) -> list[_Attachment]:
    """All that acts on a link: joints, force elements, and the inertia and the weight of point masses."""
    topology, attachments, form = actual.topology, [], model.form

    def add(node: int, x: Array, wrench: Array, share: Array | None = None) -> None:
        rfe = _rfe_of(actual, link, node)
        if rfe is not None:
            if share is not None:
                x = share * _length(actual, link) - _middles(actual, link, [rfe])[0]
            attachments.append(_Attachment(rfe, x, wrench))

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


def _point_mass_load(model: Model, actual: ModelWithErrors, k: int, place: Array, body: _Bodies) -> Array:
    """Rate of momentum minus weight of a point mass as a wrench (6,) at the global origin."""
    inertia = jnp.diag(model.point_inertia[:, k])
    if model.point_products is not None:
        xy, xz, yz = model.point_products[:, k]
        zero = jnp.zeros(())
        inertia = inertia + jnp.stack([jnp.stack(r) for r in ((zero, xy, xz), (xy, zero, yz), (xz, yz, zero))])
    return _inertial_wrench(actual, body, model.point_mass[k, None], place[:, None], inertia[:, :, None])[:, 0]


def _inertial_wrench(actual: ModelWithErrors, bodies: _Bodies, mass: Array, centre: Array, inertia: Array) -> Array:
    """Rate of momentum minus weight of bodies, as wrenches (6, n) at the global origin; `centre` (3, n) and central
    `inertia` (3, 3, n) in their axes."""
    rotation, point, spin, angular, linear = bodies
    arm = apply(rotation, centre)
    acceleration = linear + cross(angular, arm) + cross(spin, cross(spin, arm))
    force = mass[None] * (acceleration - actual.gravity[:, None])
    inertia = product_transposed(product(rotation, inertia), rotation)
    moment = apply(inertia, angular) + cross(spin, apply(inertia, spin))
    return vectors.wrench_at_origin(moment, force, point + arm)


def _sections_beside(attachments: Sequence[_Attachment], n: int, length: Array) -> list[tuple[int, Array, int | None]]:
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
    longer, sections = _length(actual, link) / model.length[link], []
    for rfe, span in zip(model.topology.stations[link], profile.spans[1:], strict=False):
        x = span.begin * longer - _middles(actual, link, [rfe])[0]
        sections += [(rfe, x, -1 - NO_ATTACHMENT), (rfe, x, NO_ATTACHMENT)]
    return sections


def section_edges(model: Model, actual: ModelWithErrors, link: int, place: Float[Array, " sections"]) -> Any:
    """Stresses at the edges of the sections of a link at places [m], as `Sections.edges`; of a link with stations for
    each of the sections, (4, points, sections)."""
    edges = model.section.edges[link] if model.section.edges else None
    profile = None if model.profiles is None else model.profiles[link]
    if edges is None or profile is None:
        return edges
    return profile.edges(place * (model.length[link] / _length(actual, link)))  # its stations move with its length


def _attachment_loads(
    attachments: Sequence[_Attachment], sections: Sequence[tuple[int, Array, int | None]], n: int, near: Array
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
            half = -0.5 * _length(actual, link) / (n - 1) if actual.form is not None else None
            at_sde = actual.lever_right[first + rfe - 1] if half is None else half
            places.append(actual.beam_middle[link] if last else at_sde)
    return jnp.stack(places)


def _reference_loads(
    actual: ModelWithErrors, state: State, now: Moving, link: int, bodies: _Bodies, rfes: Sequence[int]
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


def _piece_loads(
    model: Model,
    actual: ModelWithErrors,
    link: int,
    bodies: _Bodies,
    rfes: Sequence[int],
    piece: tuple[Array, Array],
) -> Array:
    """Rate of momentum minus weight of the pieces of beam between two places [m] on rfes, as wrenches (6, n) at the
    global origin; negative where the second place is smaller."""
    start, stop = piece
    if actual.form is not None:
        return _shaped_piece_loads(model, actual, link, bodies, rfes, piece)
    extent = stop - start
    mass = model.section.line_density[link] * extent
    middle, zero = 0.5 * (start + stop), jnp.zeros_like(start)
    profile = None if model.profiles is None else model.profiles[link]
    if profile is not None:
        longer, about = _length(actual, link) / model.length[link], _middles(actual, link, rfes)
        pieces = profile.pieces((start + about) / longer, (stop + about) / longer)
        spread = pieces.spread * longer**3
        inertia = pieces.rotary * longer + jnp.asarray(np.array([0.0, 1.0, 1.0]))[:, None] * spread[None]
        inertia = jnp.asarray(vectors.IDENTITY)[:, :, None] * inertia[:, None]
        middle = pieces.centre * longer - about
        return _inertial_wrench(actual, bodies, pieces.mass * longer, jnp.stack([middle, zero, zero]), inertia)
    principal = [model.section.rotary[i, link] * extent for i in range(3)]
    slender = mass * extent**2 / 12.0
    principal = jnp.stack([principal[0], principal[1] + slender, principal[2] + slender])
    inertia = jnp.asarray(vectors.IDENTITY)[:, :, None] * principal[:, None]
    return _inertial_wrench(actual, bodies, mass, jnp.stack([middle, zero, zero]), inertia)


def _shaped_piece_loads(
    model: Model,
    actual: ModelWithErrors,
    link: int,
    bodies: _Bodies,
    rfes: Sequence[int],
    piece: tuple[Array, Array],
) -> Array:
    """As `_piece_loads`, of a link with a form."""
    form, profile = actual.form, None if model.profiles is None else model.profiles[link]
    assert form is not None
    scale, about = form.errors.scale[link], _middles(actual, link, rfes)
    parts = segments_of(profile, form.lines.of(link), *((x + about) / scale for x in piece))
    mass, moment, inertia = bodies_of(parts, form.of_link(link, len(rfes)), _rests(actual, link, rfes), form.hinge)
    there = mass != 0.0
    centre = jnp.where(there[None], moment / jnp.where(there, mass, 1.0)[None], 0.0)
    return _inertial_wrench(actual, bodies, mass, centre, inertia - point_inertia(mass, centre))


def _rests(actual: ModelWithErrors, link: int, rfes: Sequence[int]) -> Float[Array, "3 sections"]:
    """Reference points of rfes of a link with a form, undeformed, in its frame."""
    first, _ = actual.topology.ranges[link]
    return jnp.stack([jnp.zeros(3) if rfe == 0 else actual.rest[:, first + rfe - 1] for rfe in rfes], axis=1)


def _line_loads(
    actual: ModelWithErrors,
    at_nodes: FrameLoads,
    link: int,
    bodies: _Bodies,
    rfes: Sequence[int],
    piece: tuple[Array, Array],
) -> Array:
    """Loads along the link on pieces of its rfes between two places [m] on these, as wrenches (6, sections) at the
    global origin."""
    assert actual.frame_forces is not None
    middle, total = _middles(actual, link, rfes), jnp.zeros((6, len(rfes)))
    start, stop = (x + middle for x in piece)
    for name, line in (actual.frame_forces.lines or {}).items():
        if line.link != link:
            continue
        assert at_nodes.lines is not None
        if actual.form is not None:
            rests = _rests(actual, link, rfes)
            force, moment, _ = shaped_line(
                actual.form, line, at_nodes.lines[name], (start, stop), rests, bodies.rotation
            )
            total = total + vectors.wrench_at_origin(moment, force, bodies.point)
            continue
        pieces = line.over(at_nodes.lines[name], start, stop, middle)
        force, lever = pieces.force, pieces.lever
        if line.turning:
            force, lever = apply(bodies.rotation, force), apply(bodies.rotation, lever)
        total = total + vectors.wrench_at_origin(cross(bodies.rotation[:, 0], lever), force, bodies.point)
    return total


def _middles(actual: ModelWithErrors, link: int, rfes: Sequence[int]) -> Array:
    """Places [m] of the reference points of rfes along the undeformed link."""
    first, _ = actual.topology.ranges[link]
    if actual.form is not None:
        middles = actual.topology.fractions(link)[1]
        return _length(actual, link) * np.array([0.0 if rfe == 0 else middles[rfe] for rfe in rfes])
    return jnp.stack([jnp.zeros(()) if rfe == 0 else actual.rest[first + rfe - 1] for rfe in rfes])


def _section_frames(
    actual: ModelWithErrors, link: int, bodies: _Bodies, rfes: Sequence[int], x: Array
) -> tuple[Float[Array, "3 n"], Float[Array, "3 3 n"]]:
    """Places and axes of sections in global axes."""
    if actual.form is None:
        return bodies.point + bodies.rotation[:, 0] * x[None], bodies.rotation
    found = actual.form.at(link, x + _middles(actual, link, rfes))
    arm = found.position - _rests(actual, link, rfes)
    return bodies.point + apply(bodies.rotation, arm), product(bodies.rotation, found.axes)


def _section_resultants(frames: tuple[Array, Array], wrench: Array) -> Array:
    """Wrenches (6, n) at the global origin as forces and moments (6, n) about the section's centre in its axes."""
    place, axes = frames
    force = wrench[3:]
    moment = wrench[:3] - cross(place, force)
    return jnp.concatenate([apply_transposed(axes, force), apply_transposed(axes, moment)])
