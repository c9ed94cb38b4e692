"""Energies and momenta of a mechanism, by which every run is checked.

Place in the pipeline: dynamics, loads -> **energy_and_momentum** -> simulation (checks of a run), statics (stability).

Each is computed apart from the equations that it checks (theory (11.8), (11.9)): the rate of the momenta follows by
differentiation along the motion, not from the reactions.
"""

from functools import reduce
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

from rfem_jax.mechanics.algebra.vectors import apply, apply_transposed, cross, dot, scaled
from rfem_jax.mechanics.elements import elasticity
from rfem_jax.mechanics.elements.deformed_bodies import deformed, kinetic_energy
from rfem_jax.mechanics.forces.element_loads import FrameLoads, frame_energy, frame_work
from rfem_jax.mechanics.forces.joint_forces import (
    law_energy,
    law_work,
)
from rfem_jax.mechanics.kinematics.cut_joints import cut_spring_energy
from rfem_jax.mechanics.kinematics.motion import Motion, all_frames, motion_of, spread
from rfem_jax.mechanics.laws.joint_laws import TableLaw
from rfem_jax.mechanics.laws.point_laws import TableBetween
from rfem_jax.mechanics.model.model import Coordinates, Model, State
from rfem_jax.mechanics.model.orientations import position_rate
from rfem_jax.mechanics.model.topology import Topology
from rfem_jax.mechanics.model.with_errors import ModelWithErrors


class Energies(NamedTuple):
    """Kinetic, elastic and gravity energy [J]; gravity's zero level is the datum."""

    kinetic: Float[Array, ""]
    elastic: Float[Array, ""]
    gravity: Float[Array, ""]


def velocities(
    actual: ModelWithErrors, motion: Motion
) -> tuple[Float[Array, "3 3 nodes"], Float[Array, "3 nodes"], Float[Array, "3 nodes"], Float[Array, "3 nodes"]]:
    """Rotation, centre of mass, its velocity and the angular velocity of all nodes in global axes."""
    rotation, point = all_frames(actual.topology, motion)
    velocity, spin = reference_velocities(actual.topology, motion, point)
    arm = apply(rotation, actual.centre)
    return rotation, point + arm, velocity + cross(spin, arm), spin


def reference_velocities(
    topology: Topology, motion: Motion, point: Float[Array, "3 nodes"]
) -> tuple[Float[Array, "3 nodes"], Float[Array, "3 nodes"]]:
    """Velocities of all nodes at their reference points, and their angular velocities, in global axes."""
    of_links = spread(topology, motion.links.rotation)
    spin, at_origin = motion.links.velocity[:3], motion.links.velocity[3:]
    link_spin = jnp.concatenate([spin, spread(topology, spin)], axis=1)
    link_velocity = jnp.concatenate([at_origin, spread(topology, at_origin)], axis=1)
    zeros = jnp.zeros_like(spin)
    angular = jnp.concatenate([zeros, apply(of_links, motion.relative.angular)], axis=1)
    linear = jnp.concatenate([zeros, apply(of_links, motion.relative.linear)], axis=1)
    return link_velocity + cross(link_spin, point) + linear, link_spin + angular


def momentum(actual: ModelWithErrors, state: State) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
    """Total linear momentum [N s] and angular momentum about the global origin [N m s]."""
    rotation, centre, velocity, spin = velocities(actual, motion_of(actual, state))
    linear = scaled(actual.mass, velocity)
    spin_momentum = apply(rotation, apply(actual.inertia, apply_transposed(rotation, spin)))
    total, about_origin = jnp.sum(linear, axis=1), jnp.sum(spin_momentum + cross(centre, linear), axis=1)
    if actual.superelements is not None:
        motion = motion_of(actual, state)
        spin, velocity = _origin_velocities(motion)
        for one in deformed(actual, motion.relative):
            l, axes = one.link, motion.links.rotation[:, :, one.link]
            linear, turned = (apply(axes, part) for part in one.momenta(spin[:, l], velocity[:, l]))
            total, about_origin = total + linear, about_origin + turned + cross(motion.links.point[:, l], linear)
    return total, about_origin


def _origin_velocities(motion: Motion) -> tuple[Float[Array, "3 links"], Float[Array, "3 links"]]:
    """Angular velocities of the links, and velocities of their origins, in their axes."""
    links = motion.links
    linear = links.velocity[3:] + cross(links.velocity[:3], links.point)
    return apply_transposed(links.rotation, links.velocity[:3]), apply_transposed(links.rotation, linear)


def _moved_mass(actual: ModelWithErrors, motion: Motion) -> Float[Array, "3"]:
    """First moment [kg m] by which deformations of superelements move the mass, in global axes."""
    moved = jnp.zeros(3)
    for one in deformed(actual, motion.relative):
        moved = moved + apply(motion.links.rotation[:, :, one.link], one.offset)
    return moved


def energies(actual: ModelWithErrors, state: State) -> Energies:
    """Kinetic, elastic and gravity energy at one instant."""
    motion = motion_of(actual, state)
    rotation, centre, velocity, spin = velocities(actual, motion)
    body_spin = apply_transposed(rotation, spin)
    translation = actual.mass * dot(velocity, velocity)
    rotational = dot(body_spin, apply(actual.inertia, body_spin))
    from_datum = centre - actual.datum[:, None]
    found = Energies(
        kinetic=0.5 * jnp.sum(translation + rotational),
        elastic=_elastic_energy(actual, state.position, motion),
        gravity=-jnp.sum(actual.mass * dot(actual.gravity[:, None], from_datum)),
    )
    if actual.superelements is None:
        return found
    return found._replace(
        kinetic=found.kinetic + kinetic_energy(actual, motion.relative, *_origin_velocities(motion)),
        gravity=found.gravity - dot(actual.gravity, _moved_mass(actual, motion)),
    )


def has_tables_over_position(model: Model) -> bool:
    """Whether forces are tables over position, whose slopes jump."""
    laws = [] if model.forces is None else list(model.forces.values())
    elements = [] if model.frame_forces is None else list(model.frame_forces.values())
    return any(isinstance(one, (TableLaw, TableBetween)) for one in (*laws, *elements))


def table_work(actual: ModelWithErrors, state: State) -> Float[Array, ""] | None:
    """Work [J] of tables over position, which is a function of the position, from any fixed one; None without any."""
    works = law_work(actual, state.position)
    if actual.frame_forces is not None:
        works = works + frame_work(actual, motion_of(actual, state))
    return reduce(jnp.add, works) if works else None


def _elastic_energy(actual: ModelWithErrors, position: Coordinates, motion: Motion) -> Float[Array, ""]:
    """Energy [J] of the springs of links and joints, and between points."""
    energy = elasticity.elastic_energy(actual, position)
    if actual.forces is not None or actual.springs is not None:
        energy = energy + law_energy(actual, position)
    if actual.topology.sprung_rows:
        energy = energy + cut_spring_energy(actual, motion)
    return energy if actual.frame_forces is None else energy + frame_energy(actual, motion)


def momentum_residual(
    actual: ModelWithErrors,
    state: State,
    accelerations: Coordinates,
    base: Float[Array, "6"],
    at_nodes: FrameLoads | None = None,
) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
    """Base reactions + weight + wrenches of force elements - d/dt of the total momentum: force [N] and moment [N m].

    The rate of momentum comes from differentiating the momenta along (q_dot, q_ddot), independently
    of the equations that give the reactions `base`.
    """

    def momentum_at(position, velocity):
        return momentum(actual, State(position, velocity))

    tangents = (position_rate(actual.topology, state.position, state.velocity), accelerations)
    _, (linear_rate, angular_rate) = jax.jvp(momentum_at, (state.position, state.velocity), tangents)
    motion = motion_of(actual, state)
    _, centre, _, _ = velocities(actual, motion)
    weight = actual.mass[None] * actual.gravity[:, None]
    about_origin = jnp.sum(cross(centre, weight), axis=1)
    if actual.superelements is not None:
        about_origin = about_origin + cross(_moved_mass(actual, motion), actual.gravity)
    if at_nodes is not None:
        base = base + at_nodes.wrench
    return base[3:] + jnp.sum(weight, axis=1) - linear_rate, base[:3] + about_origin - angular_rate
