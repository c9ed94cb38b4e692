"""The equations of a mechanism at rest, and their unknowns and residuals as flat, scaled arrays.

Place in the pipeline: loads, elasticity, joint forces -> **static_equations** -> settling.

No moment about a free hinge but that of its springs and laws, zero generalised force of springs, gravity and joints on
every free rfe, closed loops.  Unknowns and residuals are scaled by a length and a force of the mechanism.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.flatten_util import ravel_pytree
from jaxtyping import Float

from rfem_jax.kernels import kernel
from rfem_jax.mechanics.algebra.vectors import apply_transposed, cross, dot
from rfem_jax.mechanics.dynamics import loads
from rfem_jax.mechanics.elements import elasticity
from rfem_jax.mechanics.forces.element_loads import frame_loads
from rfem_jax.mechanics.forces.joint_forces import (
    applied_forces,
    by_coordinate,
    law_forces,
    loads_about_parent_axes,
    with_ideal_couplings,
)
from rfem_jax.mechanics.kinematics.cut_joints import closure, spring_residual
from rfem_jax.mechanics.kinematics.motion import by_freedom, motion_of
from rfem_jax.mechanics.kinematics.self_stress import redundancy
from rfem_jax.mechanics.kinematics.slender_links import projected
from rfem_jax.mechanics.model.inputs import DriveInput
from rfem_jax.mechanics.model.model import Coordinates, Model, length_scale
from rfem_jax.mechanics.model.orientations import moved, rates_of
from rfem_jax.mechanics.model.topology import Topology
from rfem_jax.mechanics.model.with_errors import ModelWithErrors


class ScaledUnknowns(NamedTuple):
    """Unknowns and residuals as flat arrays, scaled by a length [m] and a force [N] of the mechanism.

    units (n,) [m, rad]: of the coordinates; generalised forces times these are works; unravel: flat -> coordinates, as
    many as rates; origin: quaternions of the position that rotation vectors among the unknowns start from.
    """

    topology: Topology
    length: Float[Array, ""]
    force: Float[Array, ""]
    units: Float[Array, " n"]
    unravel: Callable[[Array], Coordinates]
    origin: Coordinates

    def unknowns(self, values: Coordinates, multipliers: Array) -> Array:
        """Flat, of coordinates, as many as rates, and multipliers."""
        return jnp.concatenate([ravel_pytree(values)[0] / self.units, multipliers / self.force])

    def coordinates(self, unknowns: Array) -> Coordinates:
        """Position of the unknowns."""
        values = self.unravel(unknowns[: self.units.size] * self.units)
        return moved(self.topology, self.origin, values) if self.topology.balls else values

    def rates(self, unknowns: Array) -> Float[Array, "n n"]:
        """Rates of the coordinates, in units, by those of the unknowns: other than these where joints turn about any
        axis."""

        def rate(along):
            position, change = jax.jvp(self.coordinates, (unknowns[: along.size],), (along,))
            return ravel_pytree(rates_of(self.topology, position, change))[0] / self.units

        return jax.vmap(rate, out_axes=1)(jnp.eye(self.units.size))

    def multipliers(self, unknowns: Array) -> Array:
        return unknowns[self.units.size :] * self.force

    def residual(self, forces: Coordinates, closing: Array) -> Array:
        """Flat, of generalised forces and closing [m] (of springs [N])."""
        works = ravel_pytree(forces)[0] * self.units / (self.force * self.length)
        return jnp.concatenate([works, closing / self._unit_of_closing()])

    def with_open_multipliers(
        self, residual: Array, unknowns: Array, actual: ModelWithErrors, position: Coordinates
    ) -> Array:
        """The residual with multipliers that the motion leaves open in the places of equations that say nothing new."""
        motion = motion_of(actual, loads.static_state(self.topology, position))
        left_open = redundancy(self.topology, motion, closure(actual, motion, self.length))
        if left_open is None:
            return residual
        works, closing = residual[: self.units.size], residual[self.units.size :]
        multipliers = unknowns[self.units.size :]
        return jnp.concatenate([works, closing + left_open.open @ (multipliers - closing)])

    def unscaled(self, residual: Array) -> tuple[Coordinates, Array]:
        """Generalised forces and closing [m] (of springs [N]) of a flat residual."""
        works, closing = residual[: self.units.size], residual[self.units.size :]
        forces = self.unravel(works * (self.force * self.length) / self.units)
        return forces, closing * self._unit_of_closing()

    def _unit_of_closing(self) -> Array:
        sprung = self.topology.sprung_rows
        return jnp.where(np.array(sprung), self.force, self.length) if sprung else self.length


def scaled_unknowns(model: Model, actual: ModelWithErrors) -> ScaledUnknowns:
    length, topology = length_scale(model), model.topology
    displacements = jnp.ones((6, topology.n_rfes)).at[:3].set(length)
    units, _ = ravel_pytree(Coordinates(_joint_units(topology, length), displacements))
    start = start_values(model)
    origin = moved(topology, model.start_coordinates(), jax.tree.map(jnp.negative, start)) if topology.balls else start
    return ScaledUnknowns(topology, length, _force_scale(model, actual), units, ravel_pytree(start)[1], origin)


def start_values(model: Model) -> Coordinates:
    """Start as coordinates, as many as rates: quaternions are replaced by zero rotation vectors."""
    topology, start = model.topology, model.start_coordinates()
    if not topology.balls:
        return start
    parts = []
    for l, at in enumerate(topology.positions):
        parts.append(model.start_joints[at.start : at.start + topology.plain(l)])
        parts.append(jnp.zeros(3 * topology.kind(l).ball))
    return Coordinates(jnp.concatenate(parts), start.elastic)


def dependent_places(topology: Topology) -> list[int]:
    """Places among the unknowns of displacements that follow from rotations, in slender links; they stay zero."""
    places = topology.n_freedoms + np.arange(3)[:, None] * topology.n_rfes + np.flatnonzero(topology.slender_rfes)
    return places.reshape(-1).tolist()


def _joint_units(topology: Topology, length: Array) -> Float[Array, " freedoms"]:
    """1 rad, or a length [m], of every joint coordinate."""
    slides, ones = np.array(topology.slides, dtype=bool), jnp.ones(topology.n_freedoms)
    return jnp.where(slides, length, ones) if slides.any() else ones


def static_residual(
    actual: ModelWithErrors, position: Coordinates, multipliers: Array, scale: Array
) -> tuple[Float[Array, " freedoms"], Float[Array, "6 rfes"], Float[Array, " constraints"]]:
    """Loads along the joint coordinates [N m, N], generalised forces on the free rfes [N, N m] and closure residuals
    [m] (of springs [N]) of a mechanism at rest."""
    topology = actual.topology
    n = topology.n_links
    state = loads.static_state(topology, position)
    motion = motion_of(actual, state)
    cuts = closure(actual, motion, scale)
    at_rest = jnp.zeros((3, n + topology.n_rfes))
    inertial = loads.inertial_loads(actual, motion, at_rest, at_rest)
    force, moment = loads.loads_beyond_elements(inertial, frame_loads(actual, motion, None))
    wrenches = loads.chain_wrenches(actual, motion, cuts, multipliers, (force, moment))
    hinge = dot(motion.axis, by_freedom(topology, jnp.stack(wrenches[:n], axis=1)))
    laws = with_ideal_couplings(actual, law_forces(actual, state), motion, multipliers, scale)
    applied = applied_forces(topology, position, DriveInput(), laws)
    if applied:
        hinge = loads_about_parent_axes(topology, position, hinge - by_coordinate(topology, applied))
    force, moment = -force[:, n:], -moment[:, n:]
    for j, (left, right) in enumerate(zip(topology.parents, topology.children)):
        for node, sign in ((left, -1.0), (right, 1.0)):
            # A tree joint acts on rfe 0 of its child, which has no equation here.
            if node >= n:
                k = node - n
                rotation = motion.links.rotation[:, :, topology.link_of(node)]
                where = motion.interfaces.point[:, topology.interfaces.index(k)]
                on_force = sign * wrenches[j][3:]
                on_moment = sign * wrenches[j][:3] - cross(where, on_force)
                there = jnp.asarray(np.arange(topology.n_rfes) == k, float)[None]
                force = force + apply_transposed(rotation, on_force)[:, None] * there
                moment = moment + apply_transposed(rotation, on_moment)[:, None] * there
    external = jnp.concatenate([force, apply_transposed(motion.relative.rate_matrix, moment)])
    elastic, _ = elasticity.generalised_forces(actual, state, motion.relative)
    if actual.superelements is not None:
        elastic = elastic - loads.superelement_loads(actual, motion, at_rest, at_rest).generalised
    if topology.slender:
        external = jnp.concatenate(projected(actual, motion.relative, external[:3], external[3:]))
    closing = jnp.zeros((0,)) if cuts is None else spring_residual(topology, cuts, multipliers, cuts.residual)
    return hinge, external + elastic, closing


def _force_scale(model: Model, actual: ModelWithErrors) -> Array:
    """A force [N] of the mechanism: its bending stiffness over a length squared, or its weight and what
    acts on its joints."""
    stiffness, bodies = model.section.bending, [one.link for one in model.topology.reduced]
    flexible = [l for l, n in enumerate(model.topology.elements) if n > 1 and l not in bodies]
    bending = [stiffness[l] / model.length[l] ** 2 for l in flexible]
    for l, one in zip(bodies, model.superelements or (), strict=True):
        bending.append(jnp.min(jnp.diag(one.stiffness)[: len(one.stiffness) // 2]) * model.length[l])
    if bending:
        return jax.lax.stop_gradient(jnp.max(jnp.stack(bending)))
    force = jnp.sum(actual.mass) * jnp.linalg.norm(model.gravity) + jnp.sum(actual.mass)
    if model.topology.minimum_norm:
        force = force + _applied(model, actual)
    return jax.lax.stop_gradient(jnp.where(force > 0.0, force, 1.0))


def _applied(model: Model, actual: ModelWithErrors) -> Float[Array, ""]:
    """The largest force [N], or moment over the longest link, along a joint coordinate at the start."""
    length, none = length_scale(model), jnp.zeros(model.topology.n_constraints)
    given = jax.lax.stop_gradient((actual, model.start_coordinates(), none, length))
    along, *_ = kernel(static_residual, name="static equations")(*given)
    return jnp.max(jnp.abs(along) * _joint_units(model.topology, length) / length, initial=0.0)
