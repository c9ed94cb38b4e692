"""What the deformation of reduced bodies adds to rigid ones: forces of their springs, inertial loads, momentum, energy.

Place in the pipeline: kinematics, superelements -> **deformed_bodies** -> elasticity, loads, residual, statics.

Terms of inertia that are linear in the deformation are kept (theory (19.4), (19.7) to (19.10)). Vectors are in the axes
of the links; angular and linear accelerations are those of the links' origins.
"""

from collections.abc import Iterator
from typing import NamedTuple

import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

from rfem_jax.mechanics.algebra.vectors import apply, apply_transposed, constant_product, cross, dot
from rfem_jax.mechanics.kinematics.motion import RelativeMotion
from rfem_jax.mechanics.model.model import Coordinates
from rfem_jax.mechanics.model.superelements import Superelement
from rfem_jax.mechanics.model.with_errors import ModelWithErrors


class Deformed(NamedTuple):
    """A superelement at an instant: link; element; coordinates q (k,) and their rates."""

    link: int
    element: Superelement
    q: Float[Array, " k"]
    rate: Float[Array, " k"]

    @property
    def offset(self) -> Float[Array, "3"]:
        """C q: by which the deformation moves the first moment [kg m]."""
        return constant_product(self.element.translation, self.q)

    def inertia(self, q: Float[Array, " k"]) -> Float[Array, "3 3"]:
        """G q: change of the inertia [kg m^2]."""
        return constant_product(self.element.inertia.reshape(9, -1), q).reshape(3, 3)

    def momenta(self, spin: Float[Array, "3"], velocity: Float[Array, "3"]) -> tuple[Array, Array]:
        """What the deformation adds to the momentum and to that about the link's origin (theory (19.7)), for the
        angular velocity and that of the origin."""
        element, offset = self.element, self.offset
        linear = cross(spin, offset) + constant_product(element.translation, self.rate)
        turned = cross(offset, velocity) + apply(self.inertia(self.q), spin)
        return linear, turned + constant_product(element.rotation, self.rate)


def deformed(actual: ModelWithErrors, relative: RelativeMotion) -> Iterator[Deformed]:
    """The superelements of a mechanism."""
    if actual.superelements is None:
        return
    assert relative.coordinates is not None, "mechanisms with superelements have them"
    for one, element in zip(actual.topology.reduced, actual.superelements, strict=True):
        a, b = actual.topology.ranges[one.link]
        q, rate = (part[:, a:b].reshape(-1) for part in relative.coordinates)
        yield Deformed(one.link, element, q, rate)


def _on_rfes(actual: ModelWithErrors, found: dict[int, Array]) -> Float[Array, "6 rfes"]:
    """Generalised forces (k,) by link, in the places of the coordinates; zero of other links."""
    parts = [jnp.zeros((6, 0))]
    for l, (a, b) in enumerate(actual.topology.ranges):
        parts.append(found[l].reshape(6, b - a) if l in found else jnp.zeros((6, b - a)))
    return jnp.concatenate(parts, axis=1)


def spring_forces(actual: ModelWithErrors, relative: RelativeMotion) -> tuple[Float[Array, "6 rfes"], Array]:
    """Generalised forces of springs and dampers (theory (19.6)), and the power [W] that the dampers dissipate."""
    found, dissipated = {}, jnp.zeros(())
    for one in deformed(actual, relative):
        element = one.element
        found[one.link] = -constant_product(element.stiffness, one.q + element.damping * one.rate)
        dissipated = dissipated + element.damping * dot(one.rate, constant_product(element.stiffness, one.rate))
    return _on_rfes(actual, found), dissipated


def spring_energy(actual: ModelWithErrors, position: Coordinates) -> Float[Array, ""]:
    """Energy of the springs [J]."""
    energy = jnp.zeros(())
    for one, element in zip(actual.topology.reduced, actual.superelements or (), strict=True):
        a, b = actual.topology.ranges[one.link]
        q = position.elastic[:, a:b].reshape(-1)
        energy = energy + 0.5 * dot(q, constant_product(element.stiffness, q))
    return energy


class DeformationLoads(NamedTuple):
    """Rate of momentum less weight that the deformation adds: force [N] and moment [N m] at the origins of the links;
    generalised (6, N) [N, N m] on the coordinates."""

    force: Float[Array, "3 links"]
    moment: Float[Array, "3 links"]
    generalised: Float[Array, "6 rfes"]


def deformation_loads(
    actual: ModelWithErrors,
    relative: RelativeMotion,
    spin: Float[Array, "3 links"],
    angular: Float[Array, "3 links"],
    linear: Float[Array, "3 links"],
    accelerations: Float[Array, "6 rfes"] | None,
) -> DeformationLoads:
    """Inertial loads of the deformation (theory (19.8) to (19.10)), for accelerations of the origins less that of
    gravity, and second derivatives of the coordinates (None: zero)."""
    n, found = actual.topology.n_links, {}
    forces, moments = [jnp.zeros(3)] * n, [jnp.zeros(3)] * n
    for one in deformed(actual, relative):
        l, element = one.link, one.element
        w, turn, move, offset = spin[:, l], angular[:, l], linear[:, l], one.offset
        moving = constant_product(element.translation, one.rate)
        turning = constant_product(element.rotation, one.rate)
        inertia = one.inertia(one.q)
        force = cross(turn, offset) + cross(w, cross(w, offset) + 2.0 * moving)
        moment = cross(offset, move) + apply(inertia, turn) + apply(one.inertia(one.rate), w)
        moment = moment + cross(w, apply(inertia, w) + turning)
        by_spin = constant_product(element.inertia.reshape(9, -1).T, (w[:, None] * w[None]).reshape(-1))
        along = apply_transposed(element.translation, move) + apply_transposed(element.rotation, turn) - 0.5 * by_spin
        if accelerations is not None:
            a, b = actual.topology.ranges[l]
            second = accelerations[:, a:b].reshape(-1)
            force = force + constant_product(element.translation, second)
            moment = moment + constant_product(element.rotation, second)
            along = along + constant_product(element.mass, second)
        forces[l], moments[l], found[l] = force, moment, along
    return DeformationLoads(jnp.stack(forces, axis=1), jnp.stack(moments, axis=1), _on_rfes(actual, found))


def kinetic_energy(
    actual: ModelWithErrors, relative: RelativeMotion, spin: Float[Array, "3 links"], velocity: Float[Array, "3 links"]
) -> Float[Array, ""]:
    """What the deformation adds to the kinetic energy [J] (theory (19.4)), for velocities of the links' origins."""
    energy = jnp.zeros(())
    for one in deformed(actual, relative):
        w, v, element = spin[:, one.link], velocity[:, one.link], one.element
        moving = constant_product(element.translation, one.rate)
        energy = energy + dot(v, cross(w, one.offset) + moving)
        energy = energy + dot(w, 0.5 * apply(one.inertia(one.q), w) + constant_product(element.rotation, one.rate))
        energy = energy + 0.5 * dot(one.rate, constant_product(element.mass, one.rate))
    return energy
