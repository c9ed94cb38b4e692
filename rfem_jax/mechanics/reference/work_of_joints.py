"""Generalised forces of drives, and of springs, dampers, laws and couplings of joints, by their work.

Place in the pipeline: node_transforms, joint_forces -> **work_of_joints** -> formulation.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.flatten_util import ravel_pytree

from rfem_jax.mechanics.forces.joint_forces import applied_forces, law_forces
from rfem_jax.mechanics.laws.joint_springs import CompliantSpring
from rfem_jax.mechanics.model.inputs import DriveInput
from rfem_jax.mechanics.model.model import Coordinates, State
from rfem_jax.mechanics.model.with_errors import ModelWithErrors
from rfem_jax.mechanics.reference.node_transforms import axial, changed, transform, transforms


def joint_coordinate_forces(
    actual: ModelWithErrors, state: State, drive: DriveInput, unravel: Callable[[Array], Coordinates]
) -> Array:
    """Generalised forces of drives, springs, dampers and laws of joints, flat."""
    qd, _ = ravel_pytree(state.velocity)
    force = _spring_forces(actual, state, unravel)
    bare = eqx.tree_at(lambda a: a.springs, actual, None, is_leaf=lambda x: x is None)
    if actual.forces is not None and actual.forces.couplings:
        bare = eqx.tree_at(lambda a: a.forces.couplings, bare, {})
        force = force + _coupling_forces(actual, state, qd, unravel)
    laws = law_forces(bare, state)
    # Springs and dampers have been counted by their energy and their dissipation.
    outside = None if laws is None else laws._replace(inside={})
    for k, applied in applied_forces(actual.topology, state.position, drive, outside).items():
        force = force.at[k].add(applied)
    if actual.springs is not None:
        force = force + _spring_force(actual, state, qd, unravel)
    return force


def _spring_forces(actual: ModelWithErrors, state: State, unravel: Callable[[Array], Coordinates]) -> Array:
    """Generalised forces of the springs and dampers of joints, flat, by the energy that they store and the power that
    they dissipate: so both are compared with the forces."""
    still = jnp.zeros_like(ravel_pytree(state.velocity)[0])
    springs = [] if actual.forces is None else [law for law in actual.forces.laws.values() if law.inside]

    def potential(q):
        joints = changed(actual.topology, state.position, unravel(q)).joints
        return sum((law.energy(joints[law.place]) for law in springs), jnp.zeros(()))

    force = -jax.grad(potential)(still)
    for law in springs:
        rate = state.velocity.joints[law.coordinate]
        moves = rate != 0.0
        damping = law.dissipation(rate) / jnp.where(moves, rate, 1.0)
        force = force.at[law.coordinate].add(-jnp.where(moves, damping, 0.0))
    return force


def _coupling_forces(
    actual: ModelWithErrors, state: State, qd: Array, unravel: Callable[[Array], Coordinates]
) -> Array:
    """Generalised forces of couplings: the work of their loads along the coordinates' deflections."""
    assert actual.forces is not None, "couplings are among the forces"
    still, total = jnp.zeros_like(qd), jnp.zeros_like(qd)
    for coupling in (one for one in actual.forces.couplings.values() if one.stiffness is not None):

        def deflection(q, coupling=coupling):
            joints = changed(actual.topology, state.position, unravel(q)).joints
            return coupling.deflection(joints[np.array(coupling.places)])

        gradient = jax.grad(deflection)(still)
        total = total + gradient * coupling.load(deflection(still), gradient @ qd)[0]
    return actual.forces.share * total


def _spring_force(actual: ModelWithErrors, state: State, qd: Array, unravel: Callable[[Array], Coordinates]) -> Array:
    """Generalised forces of the springs of compliant joints: what they are stretched by, and its rate, give the work
    that their forces do."""
    still, topology = jnp.zeros_like(qd), actual.topology
    springs = [(*name.split("."), spring) for name, spring in (actual.springs or {}).items()]
    kinds = {joint: topology.kind(topology.joints.index(joint)).nominal for joint, *_ in springs}

    def over(q):
        return _joint_transforms(actual, state.position, unravel(q))

    def stretches(q):
        found = over(q)
        return [
            _displacement(found[joint], kinds[joint].directions[name], kinds[joint].axis, kinds[joint].angles == 2)
            for joint, name, _ in springs
        ]

    def rates(qd):
        now, change = jax.jvp(over, (still,), (qd,))
        plain = jax.jvp(stretches, (still,), (qd,))[1]
        for n, (joint, name, _) in enumerate(springs):
            if name == "tilt" and kinds[joint].angles < 2:
                # The angular velocity across the parent's axis.
                spin = change[joint][:3, :3] @ now[joint][:3, :3].T
                plain[n] = jnp.where(np.arange(3) == kinds[joint].axis, 0.0, axial(spin))
        return plain

    pulls = [_pull(spring, at) for (*_, spring), at in zip(springs, stretches(still))]
    drags = [spring.damping * rate for (*_, spring), rate in zip(springs, rates(qd))]
    force = jnp.zeros_like(qd)
    for exerted, jacobian in zip((pulls, drags), (jax.jacfwd(stretches)(still), jax.jacfwd(rates)(qd))):
        force = force - sum(rows.T @ one for rows, one in zip(jacobian, exerted))
    return force


def _joint_transforms(actual: ModelWithErrors, position: Coordinates, change: Coordinates) -> dict[str, Array]:
    """Transforms from the frame on the parent to that on the child, by the names of joints."""
    frames, topology, by_joint = [*transforms(actual, position, change), jnp.eye(4)], actual.topology, {}
    for j, name in enumerate(topology.joints):
        left = transform(actual.seat_rotation[:, :, j], actual.seat_position[:, j])
        right = transform(actual.bore_rotation[:, :, j], actual.bore_position[:, j])
        left, right = frames[topology.parents[j]] @ left, frames[topology.children[j]] @ right
        by_joint[name] = jnp.linalg.inv(left) @ right
    return by_joint


def _displacement(relative: Array, motions: tuple[str, ...], axis: int | None, universal: bool) -> Array:
    """Displacement of a compliant joint's spring, from the transform over the joint: displacements along the parent's
    axes; the vector of the tilt between two axes, as long as its angle; or one angle."""
    if motions[0][0] == "T":
        return jnp.stack([relative["xyz".index(motion[-1]), 3] for motion in motions])
    rotation = relative[:3, :3]
    if universal:
        return jnp.arcsin(rotation[1, 2])[None]
    if len(motions) == 2 and axis is not None:
        first, second = ((axis + n) % 3 for n in (1, 2))
        vector = jnp.stack([-rotation[second, axis], rotation[first, axis]])
        square = vector @ vector
        none = square < 1e-20
        sine = jnp.sqrt(jnp.where(none, 1.0, square))
        return vector * jnp.where(none, 1.0 + square / 6.0, jnp.arctan2(sine, rotation[axis, axis]) / sine)
    # One rotation: the angle of the next but one axis, or of the successive ones about x, y, z.
    about = "xyz".index(motions[0][-1])
    b, c = (about + 1) % 3, (about + 2) % 3
    if about == 0:
        return jnp.arctan2(-rotation[b, c], rotation[c, c])[None]
    sine, cosine = (rotation[0, 2], rotation[0, 0]) if about == 1 else (-rotation[0, 1], rotation[0, 0])
    return jnp.arcsin(sine)[None] if about == 1 else jnp.arctan2(sine, cosine)[None]


def _pull(spring: CompliantSpring, stretch: Array) -> Array:
    """Force that displaces a spring by a vector, or in one direction by a number of either sign."""
    size = stretch[0] if stretch.size == 1 else jnp.linalg.norm(stretch)
    x, f = spring.positions, spring.forces
    if x is None or f is None:
        return spring.stiffness * stretch
    row = jnp.clip(jnp.sum(x <= size) - 1, 0, x.size - 2)
    exerted = f[row] + (f[row + 1] - f[row]) / (x[row + 1] - x[row]) * (size - x[row])
    return exerted / size * stretch
