"""Centre lines of the links in space, where their far ends are, and the frames of the joints.

Place in the pipeline: model with errors + coordinates -> **centre lines** -> simulation, report.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from rfem_jax.compilation.program import Program
from rfem_jax.kernels import kernel
from rfem_jax.mechanics.algebra import vectors
from rfem_jax.mechanics.dynamics import loads
from rfem_jax.mechanics.kinematics.motion import Motion, all_frames, motion_of, node_frames
from rfem_jax.mechanics.model.errors import AssemblyErrors
from rfem_jax.mechanics.model.model import Coordinates, Model
from rfem_jax.mechanics.model.with_errors import ModelWithErrors, apply_errors


@kernel
def link_lines(model: Model, actual: ModelWithErrors, position: Coordinates) -> dict[str, Float[Array, "_ 3"]]:
    """Points (P, 3) [m] in global axes along every link: its origin, the middles of its rfes, its
    end."""
    topology = actual.topology
    return dict(zip(topology.links, _lines(actual, motion_of(actual, loads.static_state(topology, position)))))


def _lines(actual: ModelWithErrors, motion: Motion) -> list[Float[Array, "_ 3"]]:
    topology, lines = actual.topology, []
    rotation, point = all_frames(topology, motion)
    for l, (a, b) in enumerate(topology.ranges):
        first, last = topology.n_links + a, topology.n_links + b
        if actual.form is not None:
            lines.append(_curved_line(actual, l, rotation, point))
            continue
        if a == b:
            end = point[:, l] + 2.0 * actual.beam_middle[l] * rotation[:, 0, l]
            lines.append(jnp.stack([point[:, l], end]))
            continue
        # From the middle of the last rfe, which is as long as rfe 0, to the link's end.
        tip = point[:, last - 1] + actual.beam_middle[l] * rotation[:, 0, last - 1]
        inner = point[:, first:last]
        lines.append(jnp.concatenate([point[:, l : l + 1], inner, tip[:, None]], axis=1).T)
    return lines


def _curved_line(
    actual: ModelWithErrors, link: int, rotation: Float[Array, "3 3 nodes"], point: Float[Array, "3 nodes"]
) -> Float[Array, "_ 3"]:
    """Points along a link with a form, carried by its rfes."""
    topology, form = actual.topology, actual.form
    assert form is not None
    shares, rfes = topology.drawn(link)
    first = topology.n_links + topology.ranges[link][0] - 1
    nodes = np.where(rfes == 0, link, first + rfes)
    rest = jnp.concatenate([jnp.zeros((3, topology.n_links)), actual.rest], axis=1)
    place = form.at(link, shares * form.whole(link)).position

    def carried(nodes):
        return point[:, nodes] + vectors.apply(rotation[:, :, nodes], place - rest[:, nodes])

    line, share = carried(nodes), topology.drawn_with(link)
    if share is not None:
        line = line + share[None] * (carried(first + rfes + 1) - line)
    return line.T


class Shape(NamedTuple):
    """Places for pictures of a mechanism in global axes: points [m] along its links, as of `link_lines`, link by link;
    frames in which the loads of its joints are given (H, at a cut joint L), and the centres on the child [m]."""

    points: Float[Array, "*t points 3"]
    rotation: Float[Array, "*t joints 3 3"]
    centre: Float[Array, "*t joints 3"]


@functools.partial(Program, nameless=True)
def trace_shapes(model: Model, errors: AssemblyErrors, positions: Coordinates) -> Shape:
    """Shapes of a mechanism with its errors at many positions, whose arrays have a first axis of times."""
    actual = apply_errors(model, errors)
    return jax.vmap(lambda position: _shape(actual, position))(positions)


@kernel
def _shape(actual: ModelWithErrors, position: Coordinates) -> Shape:
    topology = actual.topology
    motion = motion_of(actual, loads.static_state(topology, position))
    rotation, centre = motion.hinges
    if topology.n_cuts:
        n = topology.n_links
        parents = node_frames(topology, motion, topology.parents[n:])
        children = node_frames(topology, motion, topology.children[n:])
        left = vectors.product(parents.rotation, actual.seat_rotation[:, :, n:])
        right = children.point + vectors.apply(children.rotation, actual.bore_position[:, n:])
        rotation, centre = jnp.concatenate([rotation, left], axis=2), jnp.concatenate([centre, right], axis=1)
    return Shape(jnp.concatenate(_lines(actual, motion)), jnp.moveaxis(rotation, 2, 0), centre.T)


class Bodies(NamedTuple):
    """Where all rfes are, those at the origins of the links first, then link by link: rotations and origins [m] of
    their frames; ends: in these, where the link's axis begins and ends on each [m]."""

    rotation: Float[Array, "*t nodes 3 3"]
    point: Float[Array, "*t nodes 3"]
    ends: Float[Array, "2 nodes 3"]


@functools.partial(Program, nameless=True)
def trace_bodies(model: Model, errors: AssemblyErrors, positions: Coordinates) -> Bodies:
    """The rfes of a mechanism with its errors at many positions, whose arrays have a first axis of times."""
    actual = apply_errors(model, errors)
    rotation, point = jax.vmap(lambda position: _body_frames(actual, position))(positions)
    ends = jnp.stack([jnp.concatenate(both, axis=1).T for both in zip(*_ends_of_rfes(actual))])
    return Bodies(jnp.moveaxis(rotation, 3, 1), jnp.moveaxis(point, 2, 1), ends)


def _ends_of_rfes(actual: ModelWithErrors) -> list[tuple[Float[Array, "3 _"], Float[Array, "3 _"]]]:
    """Where the axis begins and ends on the rfes at the links' origins, and on the free rfes of every link: at the next
    sdes, or at the ends of the link."""
    topology, form = actual.topology, actual.form
    left, right = (_vectors(one) for one in (actual.lever_left, actual.lever_right))
    of_roots, of_free = [], []
    for l, (a, b) in enumerate(topology.ranges):
        if form is None:  # as many halves of rfe 0 from a root's origin, or from the middle of the last rfe
            first = _vectors(actual.beam_middle[l : l + 1])
            far = first if b > a else 2.0 * first
        else:
            first = jnp.zeros((3, 1))
            tip = form.at(l, jnp.reshape(form.whole(l), 1)).position
            far = tip - actual.rest[:, b - 1 : b] if b > a else tip
        of_roots.append(first + left[:, a : a + 1] if b > a else far)
        of_free += [(right[:, a:b], jnp.concatenate([left[:, a + 1 : b], far], axis=1))] if b > a else []
    return [(jnp.zeros((3, topology.n_links)), jnp.concatenate(of_roots, axis=1)), *of_free]


def _vectors(arms: Array) -> Float[Array, "3 _"]:
    """Lever arms of links without a form, which lie along x, as vectors."""
    return arms if arms.ndim == 2 else jnp.stack([arms, jnp.zeros_like(arms), jnp.zeros_like(arms)])


@kernel
def _body_frames(
    actual: ModelWithErrors, position: Coordinates
) -> tuple[Float[Array, "3 3 nodes"], Float[Array, "3 nodes"]]:
    topology = actual.topology
    return all_frames(topology, motion_of(actual, loads.static_state(topology, position)))


def link_ends(actual: ModelWithErrors, motion: Motion) -> tuple[Float[Array, "3 links"], Float[Array, "3 3 links"]]:
    """Where the far ends of all links are [m], and the rotations of the rfes that hold them, in global axes."""
    topology = actual.topology
    rotation, point = all_frames(topology, motion)
    # From a rigid link's origin the end is a whole length away, from a flexible link's last middle half an rfe.
    nodes = [topology.end_of(l) for l in range(topology.n_links)]
    if actual.form is not None:
        ends = [actual.form.at(l, jnp.reshape(actual.form.whole(l), 1)).position for l in range(topology.n_links)]
        rest = jnp.concatenate([jnp.zeros((3, topology.n_links)), actual.rest], axis=1)
        rotation, point = rotation[:, :, np.array(nodes)], point[:, np.array(nodes)]
        return point + vectors.apply(rotation, jnp.concatenate(ends, axis=1) - rest[:, np.array(nodes)]), rotation
    distance = actual.beam_middle * np.array([2.0 if a == b else 1.0 for a, b in topology.ranges])
    rotation, point = rotation[:, :, np.array(nodes)], point[:, np.array(nodes)]
    return point + distance[None] * rotation[:, 0], rotation
