"""Where points of links are, how they move, and how their links are turned there, at one instant.

Place in the pipeline: kinematics, accelerations of the nodes -> **point paths** -> simulation.

Source: theory (8.17) to (8.19).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

from rfem_jax.mechanics.algebra.vectors import apply, apply_transposed, cross, transposed_product
from rfem_jax.mechanics.dynamics.energy_and_momentum import reference_velocities
from rfem_jax.mechanics.kinematics.motion import Motion, all_frames
from rfem_jax.mechanics.model.topology import BASE
from rfem_jax.mechanics.model.with_errors import ModelWithErrors


class PointMotion(NamedTuple):
    """Motion of a point: position (3,) [m], velocity [m/s], acceleration [m/s^2]; rotation (3, 3) and angular velocity
    [rad/s] of its link there; all seen from the link that it is relative to and in that link's axes, or in global
    ones."""

    position: Float[Array, "*times 3"]
    velocity: Float[Array, "*times 3"]
    acceleration: Float[Array, "*times 3"]
    rotation: Float[Array, "*times 3 3"]
    angular_velocity: Float[Array, "*times 3"]


class _Body(NamedTuple):
    """A place on a body: rotation, place, its velocity and acceleration, angular velocity and acceleration, global."""

    rotation: Float[Array, "3 3"]
    place: Float[Array, "3"]
    velocity: Float[Array, "3"]
    acceleration: Float[Array, "3"]
    spin: Float[Array, "3"]
    spin_rate: Float[Array, "3"]


def point_motions(
    actual: ModelWithErrors, motion: Motion, angular: Float[Array, "3 nodes"], linear: Float[Array, "3 nodes"]
) -> dict[str, PointMotion]:
    """Motions of all points by their names; `angular`, `linear`: accelerations of the nodes in link axes."""
    if actual.points is None:
        return {}
    with jax.named_scope("point_paths"):
        topology = actual.topology
        rotation, point = all_frames(topology, motion)
        velocity, spin = reference_velocities(topology, motion, point)

        def on_node(node: int, place: Array) -> _Body:
            of_link = motion.links.rotation[:, :, topology.link_of(node)]
            w, a = spin[:, node], apply(of_link, linear[:, node])
            dw, arm = apply(of_link, angular[:, node]), apply(rotation[:, :, node], place)
            moved = velocity[:, node] + cross(w, arm), a + cross(dw, arm) + cross(w, cross(w, arm))
            return _Body(rotation[:, :, node], point[:, node] + arm, *moved, w, dw)

        paths = {}
        for name, one in actual.points.items():
            here = on_node(one.node, one.position)
            paths[name] = (
                _in_global_axes(here) if one.observer == BASE else _seen_from(on_node(one.observer, jnp.zeros(3)), here)
            )
        return paths


def _in_global_axes(body: _Body) -> PointMotion:
    return PointMotion(body.place, body.velocity, body.acceleration, body.rotation, body.spin)


def _seen_from(observer: _Body, body: _Body) -> PointMotion:
    """A body's motion in the frame of a link: without the velocity and acceleration that the frame gives it there
    (theory (8.18))."""
    w, arm = observer.spin, body.place - observer.place
    velocity = body.velocity - observer.velocity - cross(w, arm)
    carried = observer.acceleration + cross(observer.spin_rate, arm) + cross(w, cross(w, arm))
    acceleration = body.acceleration - carried - 2.0 * cross(w, velocity)
    of_vectors = (arm, velocity, acceleration)
    position, velocity, acceleration = (apply_transposed(observer.rotation, one) for one in of_vectors)
    return PointMotion(
        position=position,
        velocity=velocity,
        acceleration=acceleration,
        rotation=transposed_product(observer.rotation, body.rotation),
        angular_velocity=apply_transposed(observer.rotation, body.spin - w),
    )
