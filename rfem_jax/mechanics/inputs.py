"""What an instant is given besides its state: the action of the drive, and Baumgarte's gains.

Place in the pipeline: model -> **inputs** -> joint_forces, dynamics, residual, loads, simulation.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from rfem_jax.mechanics.algebra import Scalar
from rfem_jax.mechanics.frame_forces import Time
from rfem_jax.mechanics.model import Coordinates, State, Topology


class DriveInput(NamedTuple):
    """The drive at one instant: a moment [N m] on the driven joint, or the joint's prescribed angle [rad],
    rate [rad/s] and acceleration [rad/s^2]; at most one of the two is given.  time: the instant, for forces that are
    functions of it (None: the start)."""

    moment: Float[Array, ""] | None = None
    prescribed: tuple[Float[Array, ""], Float[Array, ""], Float[Array, ""]] | None = None
    time: Time | None = None


class Stabilisation(NamedTuple):
    """Baumgarte's stabilisation (Comput. Methods Appl. Mech. Eng. 1 (1972) 1-16): Phi'' = -velocity_gain
    Phi' - position_gain Phi with gains [1/s, 1/s^2], and the length [m] that scales the axis equations."""

    velocity_gain: Scalar
    position_gain: Scalar
    scale: Scalar


def impose(topology: Topology, state: State, drive: DriveInput) -> State:
    """The state with the driven joint's angle and rate replaced by the prescribed ones."""
    if drive.prescribed is None:
        return state

    def replace(values: Coordinates, index: int | None, value: Array) -> Coordinates:
        is_driven = np.arange(values.joints.shape[0]) == index
        return Coordinates(jnp.where(is_driven, value[None], values.joints), values.elastic)

    return State(
        replace(state.position, topology.driven_position, jnp.asarray(drive.prescribed[0])),
        replace(state.velocity, topology.driven_coordinate, jnp.asarray(drive.prescribed[1])),
    )
