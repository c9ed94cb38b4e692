"""Force elements: a wrench between two frames as a function of their relative motion.

Place in the pipeline: algebra -> **frame_forces** -> model, point_laws, element_loads.

A `FrameForce` joins a frame on its parent's node (a link, a free rfe, the base) and one on its child's.  It exerts a
wrench on the child at the child's point, and the opposite at the same point on the parent, so that the pair has no
couple of its own and the power (theory (3.18))

    P = force . velocity of the child's point seen from the parent + moment . relative angular velocity.

Free rfes that elements act on are `Topology.holders`, which makes them interfaces of their links.
"""

import abc
from typing import ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float, Int

from rfem_jax.mechanics.algebra import vectors
from rfem_jax.mechanics.algebra.vectors import Scalar, cross


class Time(NamedTuple):
    """An instant for functions of time: t [s], and the last jump of any function that was passed [s], -1 before the
    first."""

    t: Scalar
    passed: Scalar

    def phase(self, breakpoints: tuple[float, ...]) -> Int[Array, ""]:
        """Number of the breakpoints [s] of one function that were passed; t itself is never compared with them."""
        return jnp.sum(jnp.asarray(self.passed) >= jnp.asarray(breakpoints, jnp.float64))


START = Time(0.0, -1.0)


class NodeFrame(eqx.Module):
    """A frame on a node: rotation (3, 3) and position (3,) [m] in the node's own frame."""

    node: int = eqx.field(static=True)
    rotation: Float[Array, "3 3"]
    position: Float[Array, "3"]


class Pose(NamedTuple):
    """Motion of the child's frame relative to the parent's, in the parent's axes: position [m] of its origin, rotation;
    linear [m/s], rate of the position; angular velocity [rad/s]."""

    position: Float[Array, "3"]
    rotation: Float[Array, "3 3"]
    linear: Float[Array, "3"]
    angular: Float[Array, "3"]


class FrameForce(eqx.Module):
    """A wrench between two frames.

    An element whose `energy` and `dissipation` account for all of its power is `inside` the mechanism, as springs with
    dampers are; the power of any other is work done from outside.  `components`: 6, 3 if it never exerts a moment (its
    tangent then has three rows), 0 if it has no tangent.
    """

    parent: eqx.AbstractVar[NodeFrame]
    child: eqx.AbstractVar[NodeFrame]

    inside: ClassVar[bool] = False
    components: ClassVar[int] = 6

    @abc.abstractmethod
    def wrench(self, pose: Pose, time: Time) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
        """Force [N] and moment [N m] on the child at its point, in the parent's axes."""

    def energy(self, pose: Pose) -> Float[Array, ""]:
        """Potential energy [J]."""
        return jnp.zeros_like(pose.position[0])

    def dissipation(self, pose: Pose) -> Float[Array, ""]:
        """Power that a damper dissipates [W]."""
        return jnp.zeros_like(pose.position[0])

    def work(self, pose: Pose) -> Float[Array, ""] | None:
        """Work [J] that a force from outside has done up to a pose, from any fixed one, if the force depends on the
        position alone: it needs no integration, and tells whether steps have seen the force (theory (11.8)). None for
        other forces."""
        del pose
        return None

    def tangent(self, pose: Pose, time: Time, q_factor: Scalar, v_factor: Scalar) -> Float[Array, "k k"]:
        """Minus the derivatives of force and moment with respect to the accelerations of the child's point and frame
        relative to the parent, for the given derivatives of position [s^2] and rate [s]; of `components` rows.

        Newton's method converges best with the exact derivatives; any that are near serve.
        """
        q_factor, v_factor = jnp.asarray(q_factor, float), jnp.asarray(v_factor, float)
        units = jnp.eye(6)

        def along(unit):
            linear, angular = unit[:3], unit[3:]
            turned = vectors.product(vectors.cross_matrix(angular), pose.rotation)
            moved = Pose(q_factor * linear, q_factor * turned, v_factor * linear, v_factor * angular)
            return jnp.concatenate(jax.jvp(lambda pose: self.wrench(pose, time), (pose,), (moved,))[1])

        k = self.components
        return -jax.vmap(along, out_axes=1)(units[:k])[:k]


def pose_between(
    parent: tuple[Float[Array, "3 3"], Float[Array, "3"], Float[Array, "6"]],
    child: tuple[Float[Array, "3 3"], Float[Array, "3"], Float[Array, "6"]],
) -> Pose:
    """The pose of two frames, each its rotation, its point and the spatial velocity of its body at the origin, in
    global axes."""
    (rotation, origin, velocity), (of_child, place, child_velocity) = parent, child
    difference = child_velocity - velocity
    # Both bodies' velocities at the child's point: their difference is what is seen from the parent.
    linear = difference[3:] + cross(difference[:3], place)
    return Pose(
        position=vectors.apply_transposed(rotation, place - origin),
        rotation=vectors.transposed_product(rotation, of_child),
        linear=vectors.apply_transposed(rotation, linear),
        angular=vectors.apply_transposed(rotation, difference[:3]),
    )
