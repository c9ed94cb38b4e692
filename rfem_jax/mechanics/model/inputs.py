"""What an instant is given besides its state: the action of the drives, and Baumgarte's gains.

Place in the pipeline: model -> **inputs** -> joint_forces, dynamics, residual, loads, simulation.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from rfem_jax.mechanics.algebra.vectors import Scalar
from rfem_jax.mechanics.laws.frame_forces import Time
from rfem_jax.mechanics.model.model import Coordinates, State
from rfem_jax.mechanics.model.topology import Topology


class DriveInput(NamedTuple):
    """The drives at one instant, by joint coordinate.

    forces: given moments [N m] and forces [N]; motions: prescribed coordinates [rad, m] with their rates and
    accelerations.  A coordinate is in one of the two at most.  time: the instant, for forces that are functions of it
    (None: the start).
    """

    forces: dict[int, Float[Array, ""]] = {}  # noqa: RUF012 - never changed
    motions: dict[int, tuple[Float[Array, ""], Float[Array, ""], Float[Array, ""]]] = {}  # noqa: RUF012
    time: Time | None = None


class Stabilisation(NamedTuple):
    """Baumgarte's stabilisation (Comput. Methods Appl. Mech. Eng. 1 (1972) 1-16): Phi'' = -velocity_gain
    Phi' - position_gain Phi with gains [1/s, 1/s^2], and the length [m] that scales the axis equations."""

    velocity_gain: Scalar
    position_gain: Scalar
    scale: Scalar


def impose(topology: Topology, state: State, drive: DriveInput) -> State:
    """The state with prescribed coordinates and their rates put in."""

    def replace(values: Coordinates, index: int, value: Array) -> Coordinates:
        is_driven = np.arange(values.joints.shape[0]) == index
        return Coordinates(jnp.where(is_driven, value[None], values.joints), values.elastic)

    for k, (value, rate, _) in drive.motions.items():
        state = State(
            replace(state.position, topology.place_of(k), jnp.asarray(value)),
            replace(state.velocity, k, jnp.asarray(rate)),
        )
    return state
