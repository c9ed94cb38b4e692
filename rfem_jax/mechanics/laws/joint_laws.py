"""Forces along the free motions of the tree joints as arrays: springs, dampers, tables and functions.

Place in the pipeline: description.forces -> **joint_laws** -> model, with_errors, joint_forces.

Each acts on one joint coordinate and depends on its position and rate alone (theory (3.14) to (3.16)).
"""

import abc
from collections.abc import Callable
from dataclasses import fields
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import ArrayLike, Float

from rfem_jax.description.mechanism.forces import JointForce, JointForceFunction, JointForceTable, JointSpring
from rfem_jax.mechanics.laws.couplings import CouplingLaw
from rfem_jax.mechanics.laws.friction_laws import Friction


class JointLaw(eqx.Module):
    """A force along one joint coordinate, positive as the coordinate.

    A law whose `energy` and `dissipation` account for all of its power is `inside` the joint and part of its load, as
    springs with dampers are; the power of any other is work done from outside (theory (3.17)), as of `FrameForce`. Its
    own fields are arrays, or a function, and have the names of those of its description in SI units.

    coordinate, place: indices of the coordinate among the rates and in the position of the tree joints.
    """

    coordinate: int = eqx.field(static=True)
    place: int = eqx.field(static=True)

    inside: ClassVar[bool] = False

    @abc.abstractmethod
    def force(self, position: Float[Array, ""], rate: Float[Array, ""]) -> Float[Array, ""]:
        """Force [N] or moment [N m] at a position [m, rad] and rate."""

    def energy(self, position: Float[Array, ""]) -> Float[Array, ""]:
        """Potential energy [J]."""
        return jnp.zeros_like(position)

    def dissipation(self, rate: Float[Array, ""]) -> Float[Array, ""]:
        """Power that a damper dissipates [W]."""
        return jnp.zeros_like(rate)

    def work(self, position: Float[Array, ""]) -> Float[Array, ""] | None:
        """Work [J] that a force from outside has done up to a position, from any fixed one, if it depends on the
        position alone; None for other forces."""
        del position

    def holds(self) -> bool:
        """Whether the force may depend on the position; numbers of the law must be concrete."""
        return True


class SpringLaw(JointLaw):
    """preload - stiffness (position - rest) - damping rate, in SI units."""

    stiffness: Float[Array, ""]
    damping: Float[Array, ""]
    rest: Float[Array, ""]
    preload: Float[Array, ""]

    inside: ClassVar[bool] = True

    def force(self, position, rate):
        return self.preload - self.stiffness * (position - self.rest) - self.damping * rate  # theory (3.14)

    def energy(self, position: Float[Array, ""]) -> Float[Array, ""]:
        """Potential energy [J], zero at rest."""
        stretch = position - self.rest
        return (0.5 * self.stiffness * stretch - self.preload) * stretch

    def dissipation(self, rate: Float[Array, ""]) -> Float[Array, ""]:
        return self.damping * rate**2

    def holds(self) -> bool:
        return float(self.stiffness) > 0.0


class TableLaw(JointLaw):
    """Linear between given positions, constant outside."""

    positions: Float[Array, " rows"]
    forces: Float[Array, " rows"]

    def force(self, position, rate):
        del rate
        return between_rows(self.positions, self.forces, position)

    def work(self, position: Float[Array, ""]) -> Float[Array, ""]:
        return work_from_first_row(self.positions, self.forces, position)


def between_rows(
    positions: Float[Array, " rows"], forces: Float[Array, " rows"], position: Float[Array, ""]
) -> Float[Array, ""]:
    """Force at a position from a table, linear between its rows and constant outside."""
    last = positions.shape[0] - 2
    at = jnp.clip(position, positions[0], positions[-1])
    # Comparisons and sums, no search: it is a loop, and gathers are slow in compiled loops.
    row = jnp.clip(jnp.sum(at >= positions) - 1, 0, last) == jnp.arange(last + 1)
    share = (at - positions[:-1]) / (positions[1:] - positions[:-1])
    values = forces[:-1] + share * (forces[1:] - forces[:-1])
    return jnp.sum(jnp.where(row, values, 0.0))


def work_from_first_row(
    positions: Float[Array, " rows"], forces: Float[Array, " rows"], position: Float[Array, ""]
) -> Float[Array, ""]:
    """Integral of the force of a table, as `between_rows`, from its first row to a position."""
    way = jnp.clip(position, positions[:-1], positions[1:]) - positions[:-1]
    slope = (forces[1:] - forces[:-1]) / (positions[1:] - positions[:-1])
    outside = forces[0] * jnp.minimum(position - positions[0], 0.0)
    outside = outside + forces[-1] * jnp.maximum(position - positions[-1], 0.0)
    return jnp.sum((forces[:-1] + 0.5 * slope * way) * way) + outside


class FunctionLaw(JointLaw):
    """A user's function of position and rate."""

    function: Callable[..., Float[Array, ""]]

    def force(self, position, rate):
        return self.function(position, rate)


class JointLaws(eqx.Module):
    """All forces along joint coordinates and between two of them, by their names; share: of their full size, for load
    steps."""

    laws: dict[str, JointLaw]
    share: Float[Array, ""]
    couplings: dict[str, CouplingLaw] = eqx.field(default_factory=dict)


# Of every description of a force along a joint coordinate its law.
LAWS: dict[type[JointForce], type[JointLaw]] = {
    JointSpring: SpringLaw,
    JointForceTable: TableLaw,
    JointForceFunction: FunctionLaw,
}


def joint_law(force: JointForce, coordinate: int, place: int) -> JointLaw:
    """The arrays of a described force on a joint coordinate."""
    law = LAWS[type(force)]
    own = {one.name: getattr(force, one.name) for one in fields(law) if one.name not in ("coordinate", "place")}
    arrays = {name: given if callable(given) else jnp.asarray(given, jnp.float64) for name, given in own.items()}
    return law(coordinate, place, **arrays)


def law_derivatives(
    law: JointLaw | Friction, position: ArrayLike, rate: ArrayLike
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Derivatives of a force with respect to position and rate."""
    at = jnp.asarray(position, jnp.float64), jnp.asarray(rate, jnp.float64)
    return jax.grad(law.force, (0, 1))(*at)
