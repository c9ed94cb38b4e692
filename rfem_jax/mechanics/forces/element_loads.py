"""What the force elements of a mechanism exert at one instant.

Place in the pipeline: kinematics, frame_forces -> **element_loads** -> dynamics, residual, loads, statics, newton.

Source: theory (3.18), (3.23) to (3.26), (7.22).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from rfem_jax.mechanics.algebra import vectors
from rfem_jax.mechanics.algebra.vectors import Scalar, apply, apply_transposed, cross, dot, product, scaled
from rfem_jax.mechanics.forces.shaped_lines import shaped_line
from rfem_jax.mechanics.kinematics.motion import Motion, node_frames
from rfem_jax.mechanics.laws.frame_forces import START, FrameForce, Pose, Time, pose_between
from rfem_jax.mechanics.laws.line_loads import LineLoad
from rfem_jax.mechanics.model.topology import BASE, Topology, rfe_fractions
from rfem_jax.mechanics.model.with_errors import ModelWithErrors


class Exerted(NamedTuple):
    """Load of an element on its child: force [N] and moment [N m] (3,) at the child's point, in global axes; place and
    parent_place (3,) [m]: both points."""

    force: Float[Array, "3"]
    moment: Float[Array, "3"]
    place: Float[Array, "3"]
    parent_place: Float[Array, "3"]


class FrameLoads(NamedTuple):
    """Loads of all elements at one instant.

    exerted: by their names; force [N], moment [N m] (3, nodes): on all nodes at their reference points, in the axes of
    their links; wrench (6,): on all nodes together at the global origin; dissipated, power [W]: of the dampers, and of
    the elements that act from outside and whose work is not known by their poses; lost [W]: of the dampers, by the
    names of their elements; lines: loads along links at their begins and ends [N/m] (3, 2), by their names; what these
    exert in all, about the middle of the loaded piece, is among `exerted`.
    """

    exerted: dict[str, Exerted]
    force: Float[Array, "3 nodes"]
    moment: Float[Array, "3 nodes"]
    wrench: Float[Array, "6"]
    dissipated: Float[Array, ""]
    power: Float[Array, ""]
    lost: dict[str, Float[Array, ""]]
    lines: dict[str, Float[Array, "3 2"]] | None = None


class ElementTangents(NamedTuple):
    """The elements that have tangents, with k rows together.

    units: wrenches (6, k) at the global origin, by node, of unit forces and moments between the frames; stiffness
    (k, k): minus the derivatives of these by the relative accelerations, block diagonal; joints: with couplings, loads
    along the joint coordinates of units of all.
    """

    units: dict[int, Float[Array, "6 k"]]
    stiffness: Float[Array, "k k"]
    joints: Float[Array, "freedoms k"] | None = None


def frame_loads(actual: ModelWithErrors, motion: Motion, time: Time | None) -> FrameLoads | None:
    """Wrenches and powers of all force elements at one instant (None: the start); None for a mechanism without any."""
    if actual.frame_forces is None:
        return None
    with jax.named_scope("frame_forces"):
        topology, share = actual.topology, actual.frame_forces.share
        nodes = topology.n_links + topology.n_rfes
        total = [jnp.zeros((3, nodes)), jnp.zeros((3, nodes))]
        exerted, lost, wrench = {}, {}, jnp.zeros(6)
        dissipated = power = jnp.zeros(())
        for name, element in actual.frame_forces.elements.items():
            parent, child, pose = _placed(topology, motion, element)
            force, moment = (share * part for part in element.wrench(pose, START if time is None else time))
            if element.inside:
                lost[name] = share * element.dissipation(pose)
                dissipated = dissipated + lost[name]
            elif element.work(pose) is None:
                power = power + dot(force, pose.linear) + dot(moment, pose.angular)
            force, moment = apply(parent.rotation, force), apply(parent.rotation, moment)
            exerted[name] = Exerted(force, moment, child.place, parent.place)
            for end, sign in ((element.child, 1.0), (element.parent, -1.0)):
                if end.node == BASE:
                    continue
                on_node = _node_load(topology, motion, end.node, sign * force, sign * moment, child.place)
                here = jnp.asarray(np.arange(nodes) == end.node, float)[None]
                total = [sum + part[:, None] * here for sum, part in zip(total, on_node)]
                wrench = wrench + sign * vectors.wrench_at_origin(moment, force, child.place)
        found = FrameLoads(exerted, total[0], total[1], wrench, dissipated, power, lost)
        return found if actual.frame_forces.lines is None else _with_lines(actual, motion, found, time)


def _with_lines(actual: ModelWithErrors, motion: Motion, found: FrameLoads, time: Time | None) -> FrameLoads:
    """The loads with those along links (theory (3.24) to (3.26))."""
    assert actual.frame_forces is not None
    topology, share, loads = actual.topology, actual.frame_forces.share, {}
    for name, line in (actual.frame_forces.lines or {}).items():
        loads[name] = share * line.at(START if time is None else time)
        link, n = line.link, topology.n_links
        a, b = topology.ranges[link]
        on_rfes = _line_on_rfes(actual, motion, line, loads[name])
        of_all = on_rfes.exerted

        def of_nodes(values: Array, link=link, n=n, a=a, b=b) -> Array:
            """Values (3, rfes) of the link's rfes among all nodes."""
            widths = link, n - link - 1 + a, topology.n_rfes - b
            before, between, after = (jnp.zeros((3, width)) for width in widths)
            return jnp.concatenate([before, values[:, :1], between, values[:, 1:], after], axis=1)

        found = found._replace(
            exerted=found.exerted | {name: of_all},
            force=found.force + of_nodes(on_rfes.force),
            moment=found.moment + of_nodes(on_rfes.moment),
            wrench=found.wrench + vectors.wrench_at_origin(of_all.moment, of_all.force, of_all.place),
            power=found.power + on_rfes.power,
        )
    return found._replace(lines=loads)


class _OnRfes(NamedTuple):
    """A load along a link on its rfes: force [N] and moment [N m] at their reference points, in link axes; power [W];
    all of it about the middle of its loaded piece, as it is deformed."""

    force: Float[Array, "3 rfes"]
    moment: Float[Array, "3 rfes"]
    power: Float[Array, ""]
    exerted: Exerted


def _line_on_rfes(actual: ModelWithErrors, motion: Motion, line: LineLoad, load: Float[Array, "3 2"]) -> _OnRfes:
    """A load along a link as forces and moments on its rfes that do the same work."""
    topology, link, relative = actual.topology, line.link, motion.relative
    a, b = topology.ranges[link]
    shares, middles = rfe_fractions(topology.elements[link])
    edges = np.concatenate([[0.0], np.cumsum(shares)])
    length = actual.beam_middle[link] / middles[0]
    at_start = np.array([0.0, *middles[1:]])  # the reference point of rfe 0 is the start of the link
    pieces = None
    if actual.form is None:
        pieces = line.over(load, length * edges[:-1], length * edges[1:], length * at_start)
    axes, origin = motion.links.rotation[:, :, link], motion.links.point[:, link]
    rotation = jnp.concatenate([jnp.asarray(vectors.IDENTITY)[:, :, None], relative.rotation[:, :, a:b]], axis=2)
    zero = jnp.zeros((3, 1))
    point, linear, angular = (
        jnp.concatenate([zero, part[:, a:b]], axis=1) for part in (relative.position, relative.linear, relative.angular)
    )
    extent = arms = zero
    if pieces is not None:
        if line.turning:
            force, lever = apply(rotation, pieces.force), apply(rotation, pieces.lever)
        else:
            force, lever = (apply_transposed(axes[..., None], part) for part in (pieces.force, pieces.lever))
        moment = cross(rotation[:, 0], lever)
    else:
        assert actual.form is not None
        rests = jnp.concatenate([zero, actual.rest[:, a:b]], axis=1)
        given = load if line.turning else apply_transposed(axes[..., None], load)
        whole = length * edges[:-1], length * edges[1:]
        force, moment, (extent, arms) = shaped_line(actual.form, line, given, whole, rests, rotation)
    of_link = motion.links.velocity[:, link]
    spin = apply_transposed(axes, of_link[:3])[:, None]
    at_origin = apply_transposed(axes, of_link[3:] + cross(of_link[:3], origin))[:, None]
    power = dot(force, at_origin + cross(spin, point) + linear) + dot(moment, spin + angular)
    if pieces is not None:
        loaded = point + scaled(pieces.middle - length * at_start, rotation[:, 0])
        middle = jnp.sum(scaled(pieces.extent, loaded), axis=1) / (line.end - line.begin)[None]
    else:
        middle = jnp.sum(scaled(extent, point) + arms, axis=1) / (line.end - line.begin)[None]
    about = jnp.sum(moment + cross(point - middle[:, None], force), axis=1)
    all_force, about, middle = (apply(axes, part) for part in (jnp.sum(force, axis=1), about, middle))
    return _OnRfes(force, moment, jnp.sum(power), Exerted(all_force, about, origin + middle, jnp.zeros(3)))


def frame_energy(actual: ModelWithErrors, motion: Motion) -> Float[Array, ""]:
    """Potential energy [J] of all force elements of a mechanism that has any."""
    energy = jnp.zeros(())
    if actual.frame_forces is None:
        return energy
    for element in actual.frame_forces.elements.values():
        if element.inside:
            energy = energy + element.energy(_placed(actual.topology, motion, element)[2])
    return actual.frame_forces.share * energy


def frame_work(actual: ModelWithErrors, motion: Motion) -> list[Float[Array, ""]]:
    """Works [J] of the force elements that act from outside and depend on their poses alone."""
    if actual.frame_forces is None:
        return []
    elements = [element for element in actual.frame_forces.elements.values() if not element.inside]
    works = [element.work(_placed(actual.topology, motion, element)[2]) for element in elements]
    return [actual.frame_forces.share * work for work in works if work is not None]


def element_tangents(
    actual: ModelWithErrors, motion: Motion, time: Time | None, q_factor: Scalar, v_factor: Scalar
) -> ElementTangents | None:
    """Tangents of the elements that have any, as `FrameForce.tangent`; None without such."""
    elements = [] if actual.frame_forces is None else actual.frame_forces.elements.values()
    elements = [element for element in elements if element.components]
    if actual.frame_forces is None or not elements:
        return None
    topology, k = actual.topology, sum(element.components for element in elements)
    units: dict[int, Array] = {}
    rows, first = [], 0
    for element in elements:
        parent, child, pose = _placed(topology, motion, element)
        block = element.tangent(pose, START if time is None else time, q_factor, v_factor)
        left, right = jnp.zeros((6, first)), jnp.zeros((6, k - first - element.components))
        forces = jnp.concatenate([cross(child.place[:, None], parent.rotation), parent.rotation])
        couples = jnp.concatenate([parent.rotation, jnp.zeros((3, 3))])
        own = forces if element.components == 3 else jnp.concatenate([forces, couples], axis=1)
        for end, sign in ((element.child, 1.0), (element.parent, -1.0)):
            if end.node != BASE:
                columns = jnp.concatenate([left, sign * own, right], axis=1)
                units[end.node] = units[end.node] + columns if end.node in units else columns
        n = element.components
        rows.append(jnp.concatenate([jnp.zeros((n, first)), block, jnp.zeros((n, k - first - n))], axis=1))
        first += n
    return ElementTangents(units, actual.frame_forces.share * jnp.concatenate(rows))


def with_couplings(
    elements: ElementTangents | None,
    couplings: tuple[Float[Array, "freedoms couplings"], Float[Array, " couplings"]] | None,
) -> ElementTangents | None:
    """The tangents of the elements beside those of couplings, from `coupling_tangents`."""
    if couplings is None:
        return elements
    directions, tangents = couplings
    if elements is None:
        return ElementTangents({}, jnp.diag(tangents), directions)
    k, more = elements.stiffness.shape[0], tangents.shape[0]
    units = {node: jnp.pad(one, ((0, 0), (0, more))) for node, one in elements.units.items()}
    stiffness = jnp.pad(elements.stiffness, (0, more)) + jnp.diag(jnp.pad(tangents, (k, 0)))
    return ElementTangents(units, stiffness, jnp.pad(directions, ((0, 0), (k, 0))))


def element_pose(topology: Topology, motion: Motion, element: FrameForce) -> Pose:
    """The pose of an element's child frame relative to that of its parent."""
    return _placed(topology, motion, element)[2]


class _End(NamedTuple):
    """A frame of an element in global axes."""

    rotation: Float[Array, "3 3"]
    place: Float[Array, "3"]


def _placed(topology: Topology, motion: Motion, element: FrameForce) -> tuple[_End, _End, Pose]:
    """The frames of an element's parent and child, and their pose."""
    ends, velocities = [], []
    for end in (element.parent, element.child):
        rotation, point, velocity = (part[..., 0] for part in node_frames(topology, motion, [end.node]))
        ends.append(_End(product(rotation, end.rotation), point + apply(rotation, end.position)))
        velocities.append(velocity)
    parent, child = ((*end, velocity) for end, velocity in zip(ends, velocities))
    return ends[0], ends[1], pose_between(parent, child)


def _node_load(
    topology: Topology, motion: Motion, node: int, force: Array, moment: Array, place: Array
) -> tuple[Array, Array]:
    """Force and moment at a node's reference point in the axes of its link, equivalent to those at a place in global
    axes."""
    n = topology.n_links
    link = motion.links.rotation[:, :, topology.link_of(node)]
    interfaces = motion.interfaces.point
    point = motion.links.point[:, node] if node < n else interfaces[:, topology.interfaces.index(node - n)]
    return apply_transposed(link, force), apply_transposed(link, moment + cross(place - point, force))
