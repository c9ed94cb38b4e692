"""The contacts of pins on a linear compliance: a small problem that is solved to its end.

Place in the pipeline: clearances -> **pins_on_compliance** -> contact.

Poses of the pins change by z = z0 + C l, where C is the compliance of the mechanism whose pins are held by springs, and
l are the wrenches by which contacts exceed these springs.  The equilibrium l = v(z) is where the energy

    E(l) = l^T C l / 2 + U(z) - z^T S z / 2 + w0^T z

of contacts U without that of the springs of stiffness S is least (theory (15.12)).
It is convex but for gravity and the turning of pins, so that Newton's method with a search along its direction finds it
from anywhere.
"""

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

from rfem_jax.kernels import kernel
from rfem_jax.mechanics.algebra.vectors import product, product_transposed, solve_equations
from rfem_jax.mechanics.laws.clearances import PinInBush
from rfem_jax.mechanics.laws.frame_forces import START, FrameForce, NodeFrame, Pose, Time
from rfem_jax.mechanics.model.orientations import exponential, rotation_of

STIFF = 1e3  # of the springs that hold pins, over a force and a length of the mechanism
ITERATIONS, TOLERANCE = 60, 1e-14
TRIALS, ENOUGH, SHORTEST = 40, 0.5, 1e-3  # along one direction: steps tried, what may be left of the slope


class Units(NamedTuple):
    """Length [m] and force [N] of the mechanism, by which poses and wrenches are scaled."""

    length: Float[Array, ""]
    force: Float[Array, ""]

    def of_poses(self, pins: int) -> Float[Array, " k"]:
        """[m, rad] of the six numbers of every pose."""
        return jnp.tile(jnp.concatenate([self.length * jnp.ones(3), jnp.ones(3)]), pins)

    def wrenches(self, scaled: Float[Array, " k"]) -> list[tuple[Float[Array, "3"], Float[Array, "3"]]]:
        """Force [N] and moment [N m] of every pin."""
        parts = scaled.reshape(-1, 6) * self.force
        return [(part[:3], part[3:] * self.length) for part in parts]

    def stiffnesses(self, scaled: Float[Array, " k"]) -> Float[Array, "pins 6"]:
        """[N/m, N m/rad] of the six numbers of every pin."""
        unit = jnp.concatenate([jnp.ones(3) / self.length**2, jnp.ones(3)]) * self.force * self.length
        return scaled.reshape(-1, 6) * unit[None]

    def scaled(self, wrench: tuple[Array, Array]) -> Float[Array, "6"]:
        """A force [N] and a moment [N m], scaled."""
        return jnp.concatenate([wrench[0], wrench[1] / self.length]) / self.force


class HeldPin(FrameForce):
    """A pin that stiff springs hold at a pose, with a wrench that it carries there.

    at: the pose; force [N], moment [N m]; stiffness (6,) [N/m, N m/rad] against displacements and rotations along the
    parent's axes.
    """

    parent: NodeFrame
    child: NodeFrame
    at: Pose
    force: Float[Array, "3"]
    moment: Float[Array, "3"]
    stiffness: Float[Array, "6"]

    def wrench(self, pose: Pose, time: Time) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
        moved = self.stiffness * change_of(pose, self.at)
        return self.force - moved[:3], self.moment - moved[3:]


def change_of(pose: Pose, before: Pose) -> Float[Array, "6"]:
    """Displacement [m] and small rotation vector [rad] from a pose to another."""
    turned = product_transposed(pose.rotation, before.rotation)
    vector = [turned[2, 1] - turned[1, 2], turned[0, 2] - turned[2, 0], turned[1, 0] - turned[0, 1]]
    return jnp.concatenate([pose.position - before.position, 0.5 * jnp.stack(vector)])


def holding(pins: list[PinInBush], units: Units) -> Float[Array, " k"]:
    """Stiffness of the springs that hold pins, scaled."""
    parts = [jnp.concatenate([jnp.ones(3), jnp.ones(3) * (0.5 * pin.length / units.length) ** 2]) for pin in pins]
    return STIFF * jnp.concatenate(parts)


def pin_wrenches(pins: list[PinInBush], poses: list[Pose], units: Units) -> Float[Array, " k"]:
    """Scaled wrenches that pins at rest exert, without friction."""
    without = [dataclasses.replace(pin, friction=None) for pin in pins]
    return jnp.concatenate([units.scaled(pin.wrench(at, START)) for pin, at in zip(without, poses, strict=True)])


def _moved(poses: list[Pose], change: Float[Array, " k"], units: Units) -> list[Pose]:
    """Poses changed by scaled displacements and rotation vectors."""
    found = []
    for pose, part in zip(poses, change.reshape(-1, 6), strict=True):
        turn = rotation_of(exponential(part[3:]))
        found.append(
            pose._replace(position=pose.position + part[:3] * units.length, rotation=product(turn, pose.rotation))
        )
    return found


@kernel
def pins_at_rest(
    pins: list[PinInBush], poses: list[Pose], free: Float[Array, " k"], compliance: Float[Array, "k k"], units: Units
) -> Float[Array, " k"]:
    """Changes of the wrenches on the pins beyond those of the springs that hold them, for which pins are at rest; all
    of it scaled.

    **Arguments:** poses: at which wrenches are changed from; free: change of the poses while only the springs act;
    compliance: further change by wrenches.
    """
    before, stiffness = pin_wrenches(pins, poses, units), holding(pins, units)

    def excess(wrenches):
        """Difference between wrenches and those of the pins at the poses that they lead to."""
        change = free + compliance @ wrenches
        return wrenches - pin_wrenches(pins, _moved(poses, change, units), units) + before - stiffness * change

    def going_on(carry):
        _, size, count = carry
        return (size > TOLERANCE) & (count < ITERATIONS)

    def improve(carry):
        wrenches, _, count = carry
        value, by_unit = jax.linearize(excess, wrenches)
        direction = -solve_equations(jax.vmap(by_unit, out_axes=1)(jnp.eye(value.size)), value)
        # Gravity may push pins from the middle: where Newton's step leads uphill, its opposite is taken.
        direction = jnp.where(value @ (compliance @ direction) > 0.0, -direction, direction)
        moved = compliance @ direction
        share = _line_search_share(lambda t: excess(wrenches + t * direction) @ moved, value @ moved)
        return wrenches + share * direction, jnp.max(jnp.abs(share * moved)), count + 1

    start = jnp.zeros_like(free)
    return jax.lax.while_loop(going_on, improve, (start, jnp.ones(()), jnp.zeros((), jnp.int32)))[0]


def _line_search_share(slope: Callable[[Array], Array], first: Float[Array, ""]) -> Float[Array, ""]:
    """Share of a step at which the energy's slope along it, `first` at its start, has nearly vanished; all of it where
    the energy still falls there.

    The step may be a million times too long, as that of a pin that nothing holds yet: the Illinois variant of the
    secant method, and every third time the geometric middle.
    """

    def going_on(carry):
        *_, at, count = carry
        enough = jnp.abs(at) <= ENOUGH * jnp.abs(first)
        return ~(enough | ((count == 1) & (at <= 0.0))) & (count < TRIALS)

    def try_one(carry):
        (left, low), (right, high), _, _, count = carry
        secant = left - low * (right - left) / (high - low)
        middle = jnp.sqrt(jnp.maximum(left, SHORTEST * right) * right)
        share = jnp.where(count == 0, 1.0, jnp.where(count % 3 == 0, middle, secant))
        at = slope(share)
        falls = at < 0.0
        # The end that stays counts half.
        left, low = jnp.where(falls, share, left), jnp.where(falls, at, 0.5 * low)
        right, high = jnp.where(falls, right, share), jnp.where(falls, 0.5 * high, at)
        return (left, low), (right, high), share, at, count + 1

    one = jnp.ones(())
    start = (0.0 * one, first), (one, one), one, jnp.inf * one, jnp.zeros((), jnp.int32)
    return jax.lax.while_loop(going_on, try_one, start)[2]
