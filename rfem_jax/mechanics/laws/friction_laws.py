"""Friction along one free motion of a joint as arrays: its force at a rate and under a normal load.

Place in the pipeline: description.forces -> **friction_laws** -> model, with_errors, friction.

The smooth sign is tanh, or that of P. Brown, J. McPhee, J. Comput. Nonlinear Dyn. 11 (2016) 054502 (theory (12.1) to
(12.4)).
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import ArrayLike, Float

from rfem_jax.description.basics.joint_kinds import KINDS
from rfem_jax.description.basics.units import Quantity
from rfem_jax.description.mechanism.forces import JointFriction
from rfem_jax.description.mechanism.joints import Joint
from rfem_jax.mechanics.algebra.vectors import cross, dot

SMALL_RATE = 1e-4  # over the sliding rate, below which tanh(x) / x is 1 - x^2 / 3
LARGEST_RATE = 1e6  # over the sliding rate, at which a friction is sought
SMALLEST_SLOPE = 1e-6  # of friction against the rate, over that at rest, likewise
IMPROVEMENTS = 8


class NormalLoad(eqx.Module):
    """Parameters by which friction depends on the load across the axis.

    arm, static_arm: coefficients of friction times the pin's radius [m], along an axis the coefficients alone; length
    [m] of the bearing, None where moments do not press; scale [N]: below it the load is rounded off.
    """

    arm: Float[Array, ""]
    static_arm: Float[Array, ""]
    length: Float[Array, ""] | None
    scale: Float[Array, ""]

    def size(self, force: Float[Array, "3"], moment: Float[Array, "3"], axis: Float[Array, "3"]) -> Float[Array, ""]:
        """Normal load [N] of a joint's force [N] and moment [N m] about its point on the child."""
        across = force - axis * dot(axis, force)[None]
        if self.length is None:
            return self._smooth(across)
        by_moment = cross(moment, axis) / self.length[None]
        return self._smooth(0.5 * across + by_moment) + self._smooth(0.5 * across - by_moment)

    def _smooth(self, vector: Float[Array, "3"]) -> Float[Array, ""]:
        """Length of a vector, smooth at zero."""
        square = dot(vector, vector)
        return square / jnp.sqrt(square + self.scale**2)


class Friction(eqx.Module):
    """Friction along one free motion of a joint.

    joint: its index; component: of the joint's load that friction is, 0 to 2 of the force, 3 to 5 of the moment;
    coordinate, place: indices of the coordinate among the rates and in the position, None at a cut joint; law: of the
    smooth sign; constant, static_constant [N, N m], viscous [N s/m, N m s/rad], sliding_rate [m/s, rad/s]; load: None
    where friction does not depend on it.
    """

    joint: int = eqx.field(static=True)
    component: int = eqx.field(static=True)
    axis: int = eqx.field(static=True)
    coordinate: int | None = eqx.field(static=True)
    place: int | None = eqx.field(static=True)
    law: str = eqx.field(static=True)
    constant: Float[Array, ""]
    static_constant: Float[Array, ""]
    viscous: Float[Array, ""]
    sliding_rate: Float[Array, ""]
    load: NormalLoad | None

    def _limits(self, normal: Float[Array, ""] | None) -> tuple[Float[Array, ""], Float[Array, ""]]:
        """Friction [N, N m] while sliding, and what it may be larger before."""
        sliding, more = self.constant, self.static_constant - self.constant
        if self.load is not None and normal is not None:
            sliding = sliding + self.load.arm * normal
            more = more + (self.load.static_arm - self.load.arm) * normal
        return sliding, more

    def force(
        self,
        position: ArrayLike,
        rate: Float[Array, ""],
        normal: Float[Array, ""] | None = None,
        sliding: Float[Array, ""] | None = None,
    ) -> Float[Array, ""]:
        """Force [N] or moment [N m] on the child at a rate and under a normal load [N] (None: zero); `sliding`: another
        rate, at which all but the viscous part is taken (theory (12.10))."""
        del position
        return -self._dry((rate if sliding is None else sliding) / self.sliding_rate, normal) - self.viscous * rate

    def _dry(self, x: Float[Array, ""], normal: Float[Array, ""] | None) -> Float[Array, ""]:
        """Friction [N, N m] without its viscous part against a rate over the sliding rate."""
        sliding, more = self._limits(normal)
        if self.law == "tanh":
            return sliding * jnp.tanh(x)
        return sliding * jnp.tanh(4.0 * x) + more * x / (0.25 * x**2 + 0.75) ** 2

    def tangent(self, rate: Float[Array, ""], normal: Float[Array, ""] | None) -> Float[Array, ""]:
        """Minus the derivative of the force with respect to the rate."""
        return -jax.grad(lambda rate: self.force(0.0, rate, normal))(rate)

    def secant(self, rate: Float[Array, ""], normal: Float[Array, ""] | None) -> Float[Array, ""]:
        """Minus the force over the rate: at least the tangent, so that iterations with it cannot overshoot."""
        sliding, more = self._limits(normal)
        x = rate / self.sliding_rate
        if self.law == "tanh":
            return sliding * _tanh_ratio(x) / self.sliding_rate + self.viscous
        ratio = 4.0 * sliding * _tanh_ratio(4.0 * x) + more / (0.25 * x**2 + 0.75) ** 2
        return ratio / self.sliding_rate + self.viscous

    def chord(
        self,
        rate: Float[Array, ""],
        normal: Float[Array, ""] | None,
        force: Float[Array, ""],
        gain: Float[Array, ""],
    ) -> Float[Array, ""]:
        """Minus the slope of the force from a rate to where it meets the line `force` + `gain` (nu - rate), of a force
        [N, N m] and a slope that is not negative (theory (12.9)); at least zero."""
        x, rising = rate / self.sliding_rate, gain * self.sliding_rate
        there = self._meeting(rising * x - force, rising + self.viscous * self.sliding_rate, normal)
        apart = x - there
        near = jnp.abs(apart) < SMALL_RATE
        rise = self._dry(x, normal) - self._dry(there, normal)
        slope = jnp.where(near, 0.0, rise / jnp.where(near, 1.0, apart)) / self.sliding_rate + self.viscous
        return jnp.maximum(jnp.where(near, self.tangent(rate, normal), slope), 0.0)

    def _meeting(
        self, wanted: Float[Array, ""], rising: Float[Array, ""], normal: Float[Array, ""] | None
    ) -> Float[Array, ""]:
        """Rate over the sliding rate at which friction and `rising` times it are as wanted [N, N m], by Newton's method
        from below, from where it never goes beyond the root."""
        size, derivative = jnp.abs(wanted), jax.grad(self._dry)
        sliding, _ = self._limits(normal)
        steepest = derivative(jnp.zeros_like(size), normal) + rising

        def over(value, slope):
            return value / jnp.where(slope > 0.0, slope, 1.0)

        def improve(_, x):
            slope = jnp.maximum(derivative(x, normal), 0.0) + rising
            missing = size - self._dry(x, normal) - rising * x
            return jnp.clip(x + over(missing, jnp.maximum(slope, SMALLEST_SLOPE * steepest)), 0.0, LARGEST_RATE)

        first = jnp.maximum(over(size, steepest), jnp.where(rising > 0.0, over(size - sliding, rising), 0.0))
        return jnp.sign(wanted) * jax.lax.fori_loop(0, IMPROVEMENTS, improve, jnp.minimum(first, LARGEST_RATE))


def _tanh_ratio(x: Float[Array, ""]) -> Float[Array, ""]:
    """tanh(x) / x."""
    small = jnp.abs(x) < SMALL_RATE
    safe = jnp.where(small, 1.0, x)
    return jnp.where(small, 1.0 - x**2 / 3.0, jnp.tanh(safe) / safe)


def friction_law(
    friction: JointFriction, joint: Joint, index: int, coordinate: int | None, place: int | None
) -> Friction:
    """The arrays of described friction at the joint with an index, on a joint coordinate of the tree or none."""
    kind = KINDS[joint.kind]
    freedom = kind.freedoms[friction.coordinate(joint)]
    if kind.axis is None:
        raise TypeError(f"A {joint.kind} joint has no axis.")

    def number(value: Quantity | None, default: Quantity = 0.0) -> Array:
        return jnp.asarray(default if value is None else value, jnp.float64)

    load = None
    if friction.coefficient is not None:
        radius = number(friction.radius, 1.0)
        length = None if friction.length is None else number(friction.length)
        largest = number(friction.static_coefficient, friction.coefficient)
        load = NormalLoad(radius * number(friction.coefficient), radius * largest, length, number(friction.load_scale))
    return Friction(
        joint=index,
        component=freedom.axis + (3 if freedom.rotation else 0),
        axis=kind.axis,
        coordinate=coordinate,
        place=place,
        law=friction.law,
        constant=number(friction.constant),
        static_constant=number(friction.static_constant, 0.0 if friction.constant is None else friction.constant),
        viscous=number(friction.viscous),
        sliding_rate=number(friction.sliding_rate, 1.0),
        load=load,
    )
