"""What an instant is given besides its state: what the drive does, Baumgarte's gains.

Place in the pipeline: model -> **inputs** -> dynamics, balance, statics, simulation.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from rfem_jax.mechanics.model import Coordinates, State, Topology


class DriveInput(NamedTuple):
    """What the drive does at one instant: a moment [N m] on the driven joint, or the joint's
    prescribed (angle, rate, acceleration); None for what it does not do."""

    moment: Array | None = None
    prescribed: tuple[Array, Array, Array] | None = None


class Stabilisation(NamedTuple):
    """Baumgarte's gains: Phi'' = -velocity_gain Phi' - position_gain Phi [1/s, 1/s^2], and the
    length [m] that scales the axis equations."""

    velocity_gain: Array
    position_gain: Array
    scale: Array


def impose(topology: Topology, state: State, drive: DriveInput) -> State:
    """The state with the driven joint's angle and rate replaced by the prescribed ones."""
    if drive.prescribed is None:
        return state
    is_driven = np.arange(topology.n_links) == topology.driven

    def replace(values: Coordinates, value) -> Coordinates:
        mask = is_driven.reshape((-1,) + (1,) * (values.angles.ndim - 1))
        return Coordinates(jnp.where(mask, value[None], values.angles), values.elastic)

    return State(
        replace(state.position, jnp.asarray(drive.prescribed[0])),
        replace(state.velocity, jnp.asarray(drive.prescribed[1])),
    )
