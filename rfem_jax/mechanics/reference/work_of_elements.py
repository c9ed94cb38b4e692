"""Generalised forces and wrenches of force elements and of loads along links, by virtual work.

Place in the pipeline: node_transforms -> **work_of_elements** -> formulation, reference.loads.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from rfem_jax.mechanics.laws.frame_forces import START, NodeFrame, Pose
from rfem_jax.mechanics.model.inputs import DriveInput
from rfem_jax.mechanics.model.topology import rfe_fractions
from rfem_jax.mechanics.model.with_errors import ModelWithErrors
from rfem_jax.mechanics.reference.node_transforms import axial, transform


def element_forces(
    actual: ModelWithErrors, drive: DriveInput, frames: Array, derivatives: Array, rates: Array
) -> Array:
    """Generalised forces of force elements, flat, by the principle of virtual work: the relative transform of their two
    frames and its derivatives by the coordinates, from those (nodes, 4, 4, n) of the transforms of all nodes."""
    total, forces = jnp.zeros_like(rates), actual.frame_forces
    if forces is None:
        return total
    for element in forces.elements.values():

        def relative(frames, element=element):
            frames = jnp.concatenate([frames, jnp.eye(4)[None]])
            parent, child = (_framed(frames, end) for end in (element.parent, element.child))
            return jnp.linalg.inv(parent) @ child

        now, along = jax.linearize(relative, frames)
        by_coordinates = jax.vmap(along, in_axes=3, out_axes=2)(derivatives)
        turns = axial(jnp.einsum("abi,cb->aci", by_coordinates[:3, :3], now[:3, :3]))
        shifts = by_coordinates[:3, 3]
        pose = Pose(now[:3, 3], now[:3, :3], shifts @ rates, turns @ rates)
        wrench = element.wrench(pose, START if drive.time is None else drive.time)
        force, moment = (forces.share * part for part in wrench)
        total = total + force @ shifts + moment @ turns
    for node, place, force in _line_forces(actual, drive, frames):
        total = total + force @ (derivatives[node, :3, :3].transpose(2, 0, 1) @ place + derivatives[node, :3, 3].T).T
    return total


def _line_forces(actual: ModelWithErrors, drive: DriveInput, frames: Array) -> list[tuple[int, Array, Array]]:
    """Loads along links as forces at points: node, place in its frame [m], force [N] in global axes; at the two points
    of Gauss of each loaded piece of an rfe, which integrate the work of linear loads exactly."""
    topology, forces, found = actual.topology, actual.frame_forces, []
    if forces is None:
        return found
    for line in (forces.lines or {}).values():
        first, last = (forces.share * line.at(START if drive.time is None else drive.time)).T
        first_rfe = topology.n_links + topology.ranges[line.link][0]
        # Ends of the rfes: the start, the spring-damping elements, the end.
        shares, middles = rfe_fractions(topology.elements[line.link])
        length = actual.beam_middle[line.link] / middles[0]
        edge = jnp.zeros(())
        for i, share in enumerate(shares):
            node = line.link if i == 0 else first_rfe + i - 1
            low, high = (jnp.clip(x, line.begin, line.end) for x in (edge, edge + share * length))
            edge = edge + share * length
            for at, weight in _line_points(actual):
                x = low + at * (high - low)
                along = (x - line.begin) / (line.end - line.begin)
                force = weight * (high - low) * ((1.0 - along) * first + along * last)
                place = jnp.stack([x - (0.0 if i == 0 else middles[i] * length), *jnp.zeros(2)])
                if actual.form is not None:
                    rest = jnp.zeros(3) if i == 0 else actual.rest[:, topology.ranges[line.link][0] + i - 1]
                    place = actual.form.at(line.link, x[None]).position[:, 0] - rest
                found.append((node, place, frames[node, :3, :3] @ force if line.turning else force))
    return found


def _line_points(actual: ModelWithErrors) -> list[tuple[float, float]]:
    """Gauss's points and weights of a piece from 0 to 1: two, or of links with forms, whose lever arms are no
    polynomials, many."""
    nodes, weights = np.polynomial.legendre.leggauss(2 if actual.form is None else 12)
    return list(zip(0.5 + 0.5 * nodes, 0.5 * weights))


def element_wrenches(
    actual: ModelWithErrors, drive: DriveInput, frames: Float[Array, "nodes 4 4"], rates: Float[Array, "nodes 4 4"]
) -> list[tuple[int, Float[Array, "6"]]]:
    """Nodes, and the wrenches at the global origin that force elements exert on them, from the transforms of all nodes
    and their rates."""
    wrenches, forces = [], actual.frame_forces
    if forces is None:
        return wrenches
    for element in forces.elements.values():

        def placed(frames, element=element):
            frames = jnp.concatenate([frames, jnp.eye(4)[None]])
            parent, child = (_framed(frames, end) for end in (element.parent, element.child))
            return jnp.linalg.inv(parent) @ child, parent, child

        (now, parent, child), (change, *_) = jax.jvp(placed, (frames,), (rates,))
        pose = Pose(now[:3, 3], now[:3, :3], change[:3, 3], axial(change[:3, :3] @ now[:3, :3].T))
        wrench = element.wrench(pose, START if drive.time is None else drive.time)
        force, moment = (forces.share * parent[:3, :3] @ part for part in wrench)
        at_origin = jnp.concatenate([moment + jnp.cross(child[:3, 3], force), force])
        wrenches += [(element.child.node, at_origin), (element.parent.node, -at_origin)]
    for node, place, force in _line_forces(actual, drive, frames):
        point = frames[node, :3, :3] @ place + frames[node, :3, 3]
        wrenches.append((node, jnp.concatenate([jnp.cross(point, force), force])))
    return wrenches


def _framed(frames: Array, end: NodeFrame) -> Array:
    """Transform of a frame on a node, of which the last of `frames` is the base."""
    return frames[end.node] @ transform(end.rotation, end.position)
