"""Centre lines of the links in space, and where their far ends are.

Place in the pipeline: realisation + coordinates -> **centre lines** -> simulation, report.
"""

import jax.numpy as jnp
import numpy as np
from jax import Array

from rfem_jax.mechanics import loads
from rfem_jax.mechanics.kinematics import Motion, all_frames, motion
from rfem_jax.mechanics.model import Coordinates, Model
from rfem_jax.mechanics.model_with_errors import ModelWithErrors


def link_lines(model: Model, actual: ModelWithErrors, position: Coordinates) -> dict[str, Array]:
    """Points (P, 3) [m] in global axes along every link: its origin, the middles of its rfes, its
    end."""
    topology = actual.topology
    now = motion(actual, loads.static_state(position))
    rotation, point = all_frames(topology, now)
    lines = {}
    for l, (name, (a, b)) in enumerate(zip(topology.links, topology.ranges)):
        first, last = topology.n_links + a, topology.n_links + b
        if a == b:
            end = point[:, l] + 2.0 * actual.beam_middle[l] * rotation[:, 0, l]
            lines[name] = jnp.stack([point[:, l], end])
            continue
        # The last rfe is half as long as the others: its end is half a segment behind its middle.
        tip = point[:, last - 1] + actual.beam_middle[l] * rotation[:, 0, last - 1]
        inner = point[:, first:last]
        lines[name] = jnp.concatenate([point[:, l : l + 1], inner, tip[:, None]], axis=1).T
    return lines


def link_ends(actual: ModelWithErrors, now: Motion) -> tuple[Array, Array]:
    """Where the far ends of all links are (3, L) [m], and the rotations (3, 3, L) of the rfes that
    hold them, in global axes."""
    topology = actual.topology
    rotation, point = all_frames(topology, now)
    # A rigid link's origin is half a length before its middle, a flexible one's last middle half a
    # (half) rfe before its end.
    nodes = [l if a == b else topology.n_links + b - 1 for l, (a, b) in enumerate(topology.ranges)]
    behind = actual.beam_middle * np.array([2.0 if a == b else 1.0 for a, b in topology.ranges])
    rotation, point = rotation[:, :, np.array(nodes)], point[:, np.array(nodes)]
    return point + behind[None] * rotation[:, 0], rotation
