"""Centre lines of the links in space, and where their far ends are.

Place in the pipeline: model with errors + coordinates -> **centre lines** -> simulation, report.
"""

import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from rfem_jax.mechanics import loads
from rfem_jax.mechanics.kinematics import Motion, all_frames, motion_of
from rfem_jax.mechanics.model import Coordinates, Model
from rfem_jax.mechanics.model_with_errors import ModelWithErrors


def link_lines(model: Model, actual: ModelWithErrors, position: Coordinates) -> dict[str, Float[Array, "_ 3"]]:
    """Points (P, 3) [m] in global axes along every link: its origin, the middles of its rfes, its
    end."""
    topology = actual.topology
    rotation, point = all_frames(topology, motion_of(actual, loads.static_state(topology, position)))
    lines = {}
    for l, (name, (a, b)) in enumerate(zip(topology.links, topology.ranges)):
        first, last = topology.n_links + a, topology.n_links + b
        if a == b:
            end = point[:, l] + 2.0 * actual.beam_middle[l] * rotation[:, 0, l]
            lines[name] = jnp.stack([point[:, l], end])
            continue
        # From the middle of the last rfe, which is as long as rfe 0, to the link's end.
        tip = point[:, last - 1] + actual.beam_middle[l] * rotation[:, 0, last - 1]
        inner = point[:, first:last]
        lines[name] = jnp.concatenate([point[:, l : l + 1], inner, tip[:, None]], axis=1).T
    return lines


def link_ends(actual: ModelWithErrors, motion: Motion) -> tuple[Float[Array, "3 links"], Float[Array, "3 3 links"]]:
    """Where the far ends of all links are [m], and the rotations of the rfes that hold them, in global axes."""
    topology = actual.topology
    rotation, point = all_frames(topology, motion)
    # From a rigid link's origin the end is a whole length away, from a flexible link's last middle half an rfe.
    nodes = [l if a == b else topology.n_links + b - 1 for l, (a, b) in enumerate(topology.ranges)]
    distance = actual.beam_middle * np.array([2.0 if a == b else 1.0 for a, b in topology.ranges])
    rotation, point = rotation[:, :, np.array(nodes)], point[:, np.array(nodes)]
    return point + distance[None] * rotation[:, 0], rotation
