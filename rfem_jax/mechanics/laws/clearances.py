"""Joints with clearance: a pin in its bush as a force element between the joint's frames on parent and child.

Place in the pipeline: description.clearance, contact_law, frame_forces -> **clearances** -> building, loads,
statics, implicit methods.

The pin touches the bush at its two ends (contacts 0 and 1, at -length/2 and +length/2 of its axis) and axially in its
middle (contact 2).  All is measured in the axes of the bush: eccentricities e of the ends across its axis y, the place
of the middle along it.  Theory (15.1) to (15.9).
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rfem_jax.description.mechanism.clearance import Clearance
from rfem_jax.mechanics.algebra.vectors import apply, apply_transposed, cross, dot
from rfem_jax.mechanics.laws.contact_law import ContactLaw, Push, chi_of_restitution, distance, sliding_share
from rfem_jax.mechanics.laws.frame_forces import FrameForce, NodeFrame, Pose, Time

ENDS = np.array([-0.5, 0.5])
ACROSS = np.array([1.0, 0.0, 1.0])
ALONG = np.array([0.0, 1.0, 0.0])
CONTACTS = 3


class ContactMemory(NamedTuple):
    """Memory of contacts: approach [m/s], the speed at which each began; depth [m] and rate [m/s] at the last
    instant."""

    approach: Float[Array, "3"]
    depth: Float[Array, "3"]
    rate: Float[Array, "3"]


class PinMotion(NamedTuple):
    """Motion of a pin in the axes of its bush: centre (3,) [m] of its middle, axis (3,), their rates, and the angular
    velocity (3,) [rad/s]."""

    centre: Float[Array, "3"]
    axis: Float[Array, "3"]
    centre_rate: Float[Array, "3"]
    axis_rate: Float[Array, "3"]
    spin: Float[Array, "3"]


class Contacts(NamedTuple):
    """The three contacts at one instant: eccentricity (3, 2) [m] of the ends in the axes of the bush, without a
    component along y; direction (3, 3) from the bush's axis to the pin, a column a contact; depth [m], below zero where
    open; rate [m/s] of the depth."""

    eccentricity: Float[Array, "3 2"]
    direction: Float[Array, "3 3"]
    depth: Float[Array, "3"]
    rate: Float[Array, "3"]


class PinInBush(FrameForce):
    """Contacts, and a weak spring that centres the pin.

    radial, axial, length [m]: clearances and the pin's length; ends, stop: laws of the contacts; centring [N/m];
    damping [s/m] chi of Hunt and Crossley, or restitution of Lankarani and Nikravesh with slowest [m/s] and the speeds
    `approach` (3,) [m/s]; friction, its coefficient, with radius [m] of the pin and sliding [m/s]; each is None where
    it is not given.  on_parent: whether the pin is the parent's.
    """

    parent: NodeFrame
    child: NodeFrame
    radial: Float[Array, ""]
    axial: Float[Array, ""]
    length: Float[Array, ""]
    ends: ContactLaw
    stop: ContactLaw
    centring: Float[Array, ""]
    damping: Float[Array, ""] | None = None
    restitution: Float[Array, ""] | None = None
    slowest: Float[Array, ""] | None = None
    approach: Float[Array, "3"] | None = None
    friction: Float[Array, ""] | None = None
    radius: Float[Array, ""] | None = None
    sliding: Float[Array, ""] | None = None
    on_parent: bool = eqx.field(static=True, default=False)

    inside = True

    def pin_motion(self, pose: Pose) -> PinMotion:
        """The pin in the bush's axes."""
        spin, axis = pose.angular, jnp.asarray(ALONG)
        if not self.on_parent:
            axis = pose.rotation[:, 1]
            return PinMotion(pose.position, axis, pose.linear, cross(spin, axis), spin)
        turned = pose.rotation
        # The parent's point and axis as the child sees them.
        centre_rate = cross(spin, pose.position) - pose.linear
        return PinMotion(
            centre=-apply_transposed(turned, pose.position),
            axis=apply_transposed(turned, axis),
            centre_rate=apply_transposed(turned, centre_rate),
            axis_rate=-apply_transposed(turned, cross(spin, axis)),
            spin=-apply_transposed(turned, spin),
        )

    def contacts(self, pose: Pose) -> Contacts:
        """Eccentricities, penetrations and their rates."""
        pin = self.pin_motion(pose)
        arms = self.length * ENDS[None]
        places = (pin.centre[:, None] + pin.axis[:, None] * arms) * ACROSS[:, None]
        rates = (pin.centre_rate[:, None] + pin.axis_rate[:, None] * arms) * ACROSS[:, None]
        sizes = distance(places, 0)
        along, size = pin.centre * ALONG, distance(pin.centre[1])
        direction = jnp.concatenate([places / sizes[None], (along / size)[:, None]], axis=1)
        rates = jnp.concatenate([rates, (pin.centre_rate * ALONG)[:, None]], axis=1)
        clearances = jnp.stack([self.radial, self.radial, self.axial])
        depth = jnp.concatenate([sizes, size[None]]) - clearances
        return Contacts(places, direction, depth, jnp.sum(direction * rates, axis=0))

    def pushes(self, contacts: Contacts) -> Push:
        """Normal forces [N] (3,) of the contacts, and their elastic parts."""
        chi = self._chi()
        parts = [
            law.push(contacts.depth[at], contacts.rate[at], None if chi is None else chi[at])
            for law, at in ((self.ends, slice(0, 2)), (self.stop, slice(2, 3)))
        ]
        return Push(*(jnp.concatenate(part) for part in zip(*parts)))

    def _chi(self) -> Float[Array, "3"] | None:
        if self.restitution is not None:
            assert self.approach is not None and self.slowest is not None
            return chi_of_restitution(self.restitution, self.approach, self.slowest)
        return None if self.damping is None else self.damping * jnp.ones(CONTACTS)

    def wrench(self, pose: Pose, time: Time) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
        del time
        pin, contacts = self.pin_motion(pose), self.contacts(pose)
        normal = self.pushes(contacts).normal
        forces = -normal[None] * contacts.direction
        # The weak spring acts at the ends, so that it centres tilts, too, and along the axis.
        forces = forces - self.centring * jnp.concatenate(
            [0.5 * contacts.eccentricity, (pin.centre * ALONG)[:, None]], axis=1
        )
        arms = pin.axis[:, None] * (self.length * np.append(ENDS, 0.0))[None]
        force, moment = jnp.sum(forces, axis=1), jnp.sum(cross(arms, forces), axis=1)
        if self.friction is not None:
            on_surface, arms, about_axis = self._friction(pin, contacts, normal)
            force = force + jnp.sum(on_surface, axis=1)
            moment = moment + jnp.sum(cross(arms, on_surface), axis=1) + about_axis
        return self._child_load(pose, force, moment)

    def _child_load(
        self, pose: Pose, force: Float[Array, "3"], moment: Float[Array, "3"]
    ) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
        """Force and moment on the child at its point, in the parent's axes, of those on the pin at its middle in the
        bush's axes."""
        if not self.on_parent:
            return force, moment
        force, moment = -apply(pose.rotation, force), -apply(pose.rotation, moment)
        return force, moment - cross(pose.position, force)

    def _sliding(self, pin: PinMotion, contacts: Contacts) -> tuple[Float[Array, "3 2"], Float[Array, "3 2"]]:
        """Velocities [m/s] of the pin's surface along the bush at the contacts of both ends, and the arms [m] from the
        pin's middle to these places."""
        assert self.radius is not None
        direction = contacts.direction[:, :2]
        arms = pin.axis[:, None] * (self.length * ENDS)[None] + self.radius * direction
        velocity = pin.centre_rate[:, None] + cross(pin.spin[:, None], arms)
        return velocity - direction * dot(direction, velocity)[None], arms

    def _friction(
        self, pin: PinMotion, contacts: Contacts, normal: Float[Array, "3"]
    ) -> tuple[Float[Array, "3 2"], Float[Array, "3 2"], Float[Array, "3"]]:
        """Friction on the pin: forces at the ends, their arms, and the moment of the stop about the bush's axis."""
        assert self.friction is not None and self.sliding is not None and self.radius is not None
        velocity, arms = self._sliding(pin, contacts)
        forces = -self.friction * normal[None, :2] * sliding_share(velocity, self.sliding)
        turning = sliding_share(self.radius * pin.spin[1:2], self.sliding)
        return forces, arms, -self.friction * normal[2] * self.radius * turning * ALONG

    def energy(self, pose: Pose) -> Float[Array, ""]:
        contacts, along = self.contacts(pose), self.pin_motion(pose).centre[1]
        stored = jnp.sum(self.ends.energy(contacts.depth[:2])) + self.stop.energy(contacts.depth[2])
        return stored + 0.5 * self.centring * (0.5 * jnp.sum(contacts.eccentricity**2) + along**2)

    def dissipation(self, pose: Pose) -> Float[Array, ""]:
        pin, contacts = self.pin_motion(pose), self.contacts(pose)
        push = self.pushes(contacts)
        lost = jnp.sum((push.normal - push.elastic) * contacts.rate)
        if self.friction is not None:
            forces, _, about_axis = self._friction(pin, contacts, push.normal)
            lost = lost - jnp.sum(forces * self._sliding(pin, contacts)[0]) - dot(about_axis, pin.spin)
        return lost

    def remembered(self, pose: Pose, memory: ContactMemory) -> ContactMemory:
        """The memory at an instant, from that of the instant before.

        A contact that has closed between the two began at the speed that a constant acceleration gives where it closed
        (theory (15.6)); one that is open would begin at its present speed.
        """
        _, _, depth, rate = self.contacts(pose)
        open_now, was_open = depth <= 0.0, memory.depth <= 0.0
        passed = depth - memory.depth
        share = -memory.depth / jnp.where(passed > 0.0, passed, 1.0)
        square = memory.rate**2 + share * (rate**2 - memory.rate**2)
        began = jnp.sqrt(jnp.maximum(square, 1e-300))
        closing = was_open & ~open_now & (passed > 0.0)
        approach = jnp.where(open_now, rate, jnp.where(closing, began, memory.approach))
        return ContactMemory(approach, depth, rate)


def clearance_name(joint: str) -> str:
    """Name of the force element of a joint."""
    return f"{joint}.clearance"


def pin_in_bush(clearance: Clearance, parent: NodeFrame, child: NodeFrame) -> PinInBush:
    """The arrays of a described clearance."""

    def number(value) -> Array | None:
        return None if value is None else jnp.asarray(value, jnp.float64)

    def needed(value) -> Array:
        return jnp.asarray(value, jnp.float64)

    exponent: Any = clearance.exponent
    stiffness, of_stop = clearance.of_stop
    remembers = clearance.restitution is not None
    return PinInBush(
        parent=parent,
        child=child,
        radial=needed(clearance.radial),
        axial=needed(clearance.axial),
        length=needed(clearance.length),
        ends=ContactLaw(needed(clearance.stiffness), float(exponent)),
        stop=ContactLaw(needed(stiffness), float(of_stop)),
        centring=needed(clearance.centring),
        damping=number(clearance.damping),
        restitution=number(clearance.restitution),
        slowest=number(clearance.slowest_approach) if remembers else None,
        approach=jnp.zeros(CONTACTS) if remembers else None,
        friction=number(clearance.friction),
        radius=None if clearance.friction is None else 0.5 * needed(clearance.diameter),
        sliding=number(clearance.sliding_speed),
        on_parent=clearance.pin == "parent",
    )
