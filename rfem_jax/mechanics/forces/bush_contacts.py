"""Where pins stand in their bushes, what their contacts carry, and what contacts remember from step to step.

Place in the pipeline: clearances, element_loads -> **bush_contacts** -> statics, simulation.
"""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rfem_jax.description.basics.errors import InputError
from rfem_jax.mechanics.forces.element_loads import FrameLoads, element_pose
from rfem_jax.mechanics.kinematics.motion import Motion
from rfem_jax.mechanics.laws.clearances import (
    CONTACTS,
    ContactMemory,
    PinInBush,
    clearance_name,
)
from rfem_jax.mechanics.laws.contact_law import ROUNDING, distance
from rfem_jax.mechanics.model.model import Model
from rfem_jax.mechanics.model.topology import Topology
from rfem_jax.mechanics.model.with_errors import ModelWithErrors

CONTACT_NAMES = ("start", "end", "axial")  # of the pin: at -length/2 and +length/2 of its axis, and in its middle

CLOSED = 10.0 * ROUNDING  # m


class ContactState(NamedTuple):
    """The contacts of one joint with clearance.

    eccentricity (2 ends, 2) [m]: of the pin's ends at -length/2 and +length/2, along x and z of the bush; along [m]: of
    its middle, along y; penetration (3,) [m] and normal force (3,) [N] of both ends and of the axial stop, penetrations
    below zero being gaps; centring (3,) [N]: forces of the weak spring that centres the pin, at both ends and along
    the axis.
    """

    eccentricity: Float[Array, "*times 2 2"]
    along: Float[Array, "*times"]
    penetration: Float[Array, "*times 3"]
    normal_force: Float[Array, "*times 3"]
    centring: Float[Array, "*times 3"]

    @property
    def carrying(self) -> tuple[str, ...]:
        """Names of the contacts that carry at one instant: "start", "end", "axial"; () of a floating pin."""
        return carrying(self.penetration)


def carrying(penetration: Float[Array | np.ndarray, "3"]) -> tuple[str, ...]:
    """Names of the contacts that carry at penetrations [m]; () of a floating pin."""
    pairs = zip(CONTACT_NAMES, np.asarray(penetration).tolist(), strict=True)
    return tuple(name for name, depth in pairs if depth > CLOSED)


def pins_of(actual: ModelWithErrors) -> dict[str, PinInBush]:
    """The contacts of the joints with clearance, by the joints."""
    topology, pins = actual.topology, {}
    for j in topology.clearances:
        assert actual.frame_forces is not None, "contacts are force elements"
        element = actual.frame_forces.elements[clearance_name(topology.joints[j])]
        assert isinstance(element, PinInBush)
        pins[topology.joints[j]] = element
    return pins


def contact_states(actual: ModelWithErrors, motion: Motion) -> dict[str, ContactState]:
    """The contacts of all joints with clearance at one instant."""
    states = {}
    for name, pin in pins_of(actual).items():
        pose = element_pose(actual.topology, motion, pin)
        contacts, along = pin.contacts(pose), pin.pin_motion(pose).centre[1]
        sizes = distance(contacts.eccentricity, 0)
        states[name] = ContactState(
            eccentricity=contacts.eccentricity[::2].T,
            along=along,
            penetration=contacts.depth,
            normal_force=pin.pushes(contacts).normal,
            centring=pin.centring * jnp.append(0.5 * sizes, jnp.abs(along)),
        )
    return states


def contact_losses(topology: Topology, at_nodes: FrameLoads | None) -> Float[Array, " clearances"] | None:
    """Power [W] that the contacts of every joint with clearance dissipate, in the order of `Topology.clearances`; None
    without any."""
    if not topology.clearances or at_nodes is None:
        return None
    return jnp.stack([at_nodes.lost[clearance_name(topology.joints[j])] for j in topology.clearances])


def remembers(actual: ModelWithErrors) -> bool:
    """Whether any contact remembers how it began."""
    return any(pin.restitution is not None for pin in pins_of(actual).values())


def require_memory(model: Model, method: str, implicit: bool) -> None:
    """Raise InputError for a method that keeps no memory of the model's contacts."""
    names = [clearance_name(model.topology.joints[j]) for j in model.topology.clearances]
    elements = model.frame_forces or {}
    remembering = [one for one in names if (pin := elements[one]) and getattr(pin, "restitution", None) is not None]
    if remembering and not implicit:
        raise InputError(
            f'Argument `method` must be "generalised_alpha" with `restitution` in a clearance (`{remembering[0]}`), '
            f"which needs the speed at which a contact began, but is {method!r}; take that method, or give `damping`."
        )


def contact_memory(
    actual: ModelWithErrors, motion: Motion, before: dict[str, ContactMemory] | None = None
) -> dict[str, ContactMemory]:
    """Memory of the contacts with restitution at one instant, by joint. `before`: memory of the previous step; None at
    the start, where closed contacts count as having no approach speed."""
    memory = {}
    for name, pin in pins_of(actual).items():
        if pin.restitution is None:
            continue
        nothing = ContactMemory(jnp.zeros(CONTACTS), jnp.zeros(CONTACTS), jnp.zeros(CONTACTS))
        old = nothing if before is None else before[name]
        memory[name] = pin.remembered(element_pose(actual.topology, motion, pin), old)
    return memory


def with_memory(actual: ModelWithErrors, memory: dict[str, ContactMemory]) -> ModelWithErrors:
    """The mechanism whose contacts began as the memory says."""
    names = list(memory)
    return eqx.tree_at(
        lambda a: [pins_of(a)[name].approach for name in names], actual, [memory[name].approach for name in names]
    )
