"""Forces at points of links and between them as force elements.

Place in the pipeline: description.point_forces, frame_forces -> **point_laws** -> building, simulation.

A spring pulls its child towards its parent with a tension that depends on the distance and its rate (theory (3.19) to
(3.21)); a given force or moment acts between the base and a link (theory (3.22)).
"""

import abc
from collections.abc import Callable, Iterable
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from rfem_jax.description.mechanism.point_forces import (
    AtPoint,
    BetweenPoints,
    LoadOnLink,
    PointMoment,
    PointSpring,
    PointSpringFunction,
    PointSpringTable,
)
from rfem_jax.mechanics.algebra.vectors import Scalar, apply, dot
from rfem_jax.mechanics.laws.frame_forces import FrameForce, NodeFrame, Pose, Time
from rfem_jax.mechanics.laws.joint_laws import between_rows, work_from_first_row


class PointLaw(FrameForce):
    """A tension between two points, the origins of the frames, as a function of their distance and its rate."""

    components: ClassVar[int] = 3

    @abc.abstractmethod
    def tension(self, length: Float[Array, ""], rate: Float[Array, ""]) -> Float[Array, ""]:
        """Tension [N], positive where it pulls, at a length [m] and its rate [m/s]."""

    def wrench(self, pose: Pose, time: Time) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
        del time
        length, rate, direction = _length(pose)
        return -self.tension(length, rate)[None] * direction, jnp.zeros_like(direction)

    def tangent(self, pose: Pose, time: Time, q_factor: Scalar, v_factor: Scalar) -> Float[Array, "3 3"]:
        """Of tensions that grow with the length and its rate, and of a pull across the line; what pushes is left out,
        so that the matrix stays positive."""
        del time
        length, rate, direction = _length(pose)
        by_length, by_rate = jax.grad(self.tension, (0, 1))(length, rate)
        along = q_factor * jnp.maximum(by_length, 0.0) + v_factor * jnp.maximum(by_rate, 0.0)
        across = q_factor * jnp.maximum(self.tension(length, rate), 0.0) / length
        outer = direction[:, None] * direction[None]
        return (along - across) * outer + across * jnp.eye(3)


def _length(pose: Pose) -> tuple[Array, Array, Array]:
    """Distance of the two points [m], its rate [m/s], and the direction (3,) from the parent's point to the child's.
    Where the points meet there is no direction, and the force is zero."""
    square = dot(pose.position, pose.position)
    apart = square > 0.0
    length = jnp.sqrt(jnp.where(apart, square, 1.0))
    direction = jnp.where(apart, pose.position / length[None], 0.0)
    return jnp.where(apart, length, 0.0), dot(direction, pose.linear), direction


class SpringBetween(PointLaw):
    """preload + stiffness (length - free_length) + damping rate, in SI units."""

    parent: NodeFrame
    child: NodeFrame
    stiffness: Float[Array, ""]
    damping: Float[Array, ""]
    free_length: Float[Array, ""]
    preload: Float[Array, ""]

    inside: ClassVar[bool] = True

    def tension(self, length: Float[Array, ""], rate: Float[Array, ""]) -> Float[Array, ""]:
        return self.preload + self.stiffness * (length - self.free_length) + self.damping * rate

    def energy(self, pose: Pose) -> Float[Array, ""]:
        """Potential energy [J], zero at the free length."""
        stretch = _length(pose)[0] - self.free_length
        return (0.5 * self.stiffness * stretch + self.preload) * stretch

    def dissipation(self, pose: Pose) -> Float[Array, ""]:
        return self.damping * _length(pose)[1] ** 2


class TableBetween(PointLaw):
    """Linear between given lengths, constant outside."""

    parent: NodeFrame
    child: NodeFrame
    lengths: Float[Array, " rows"]
    forces: Float[Array, " rows"]

    def tension(self, length: Float[Array, ""], rate: Float[Array, ""]) -> Float[Array, ""]:
        del rate
        return between_rows(self.lengths, self.forces, length)

    def work(self, pose: Pose) -> Float[Array, ""]:
        return -work_from_first_row(self.lengths, self.forces, _length(pose)[0])


class FunctionBetween(PointLaw):
    """A user's function of length and rate."""

    parent: NodeFrame
    child: NodeFrame
    function: Callable[..., Float[Array, ""]]

    def tension(self, length: Float[Array, ""], rate: Float[Array, ""]) -> Float[Array, ""]:
        return self.function(length, rate)


class TimeVector(eqx.Module):
    """A vector as a function of time."""

    times: eqx.AbstractVar[tuple[float, ...]]

    @abc.abstractmethod
    def at(self, time: Time) -> Float[Array, "3"]:
        """The vector at an instant."""

    def breakpoints(self) -> tuple[float, ...]:
        """Times [s] > 0 at which it jumps."""
        return self.times

    def rows(self) -> tuple[float, ...]:
        """Times [s] at which its slope jumps."""
        return ()


class ConstantVector(TimeVector):
    """A vector that is the same at all times."""

    values: Float[Array, "3"]
    times: tuple[float, ...] = eqx.field(static=True, default=())

    def at(self, time: Time) -> Float[Array, "3"]:
        del time
        return self.values


class TableVector(TimeVector):
    """Linear between given times, zero after the last; a time given twice is a jump."""

    values: Float[Array, "3 rows"]
    times: tuple[float, ...] = eqx.field(static=True)

    def _jump_rows(self) -> list[int]:
        return [i for i in range(1, len(self.times)) if self.times[i] == self.times[i - 1]]

    def breakpoints(self) -> tuple[float, ...]:
        return (*(self.times[row] for row in self._jump_rows()), self.times[-1])

    def rows(self) -> tuple[float, ...]:
        return self.times

    def at(self, time: Time) -> Float[Array, "3"]:
        phase, jumps = time.phase(self.breakpoints()), np.array(self._jump_rows(), int)
        # The piece of every row that has a length, and its place within it: comparisons and sums, no search.
        starts = np.setdiff1d(np.arange(len(self.times) - 1), jumps - 1)
        begin, end = (np.array(self.times)[starts + i] for i in (0, 1))
        piece = np.searchsorted(jumps, starts, side="right")
        first = np.diff(piece, prepend=-1) > 0
        here = (piece == phase) & ((time.t >= begin) | first)
        last = jnp.append(~here[1:], True) & here
        share = (time.t - begin) / (end - begin)
        left, right = (self.values[:, starts + i] for i in (0, 1))
        return jnp.sum(jnp.where(last[None], left + share[None] * (right - left), 0.0), axis=1)


class FunctionVector(TimeVector):
    """A user's function of time and phase."""

    function: Callable[..., Float[Array, "3"]]
    times: tuple[float, ...] = eqx.field(static=True)

    def at(self, time: Time) -> Float[Array, "3"]:
        phase = time.phase(self.times).astype(jnp.int32)
        return self.function(jnp.asarray(time.t, jnp.float64), phase)


class GivenLoad(FrameForce):
    """A given force, or moment, on the child from the base, in global axes or those of the child.

    turning: whether it turns with the child; moment: whether it is one.
    """

    parent: NodeFrame
    child: NodeFrame
    value: TimeVector
    turning: bool = eqx.field(static=True)
    moment: bool = eqx.field(static=True)

    components: ClassVar[int] = 0

    def wrench(self, pose: Pose, time: Time) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
        value = self.value.at(time)
        if self.turning:
            value = apply(pose.rotation, value)
        return (jnp.zeros_like(value), value) if self.moment else (value, jnp.zeros_like(value))


def changing(vectors: Iterable[TimeVector]) -> bool:
    """Whether any of these is not constant."""
    return any(not isinstance(vector, ConstantVector) for vector in vectors)


def breakpoints_of(vectors: Iterable[TimeVector]) -> tuple[float, ...]:
    """Times [s] > 0 at which any of these jumps, increasing."""
    return tuple(sorted({time for vector in vectors for time in vector.breakpoints()}))


def rows_of(vectors: Iterable[TimeVector]) -> tuple[float, ...]:
    """Times [s] of the rows of all tables over time."""
    return tuple(time for vector in vectors for time in vector.rows())


def spring_between(force: BetweenPoints, parent: NodeFrame, child: NodeFrame) -> PointLaw:
    """The element of a described force between two points."""
    if isinstance(force, PointSpring):
        numbers = {name: getattr(force, name) for name in ("stiffness", "damping", "free_length", "preload")}
        return SpringBetween(parent, child, **{name: jnp.asarray(x, jnp.float64) for name, x in numbers.items()})
    if isinstance(force, PointSpringTable):
        return TableBetween(parent, child, *(jnp.asarray(x, jnp.float64) for x in (force.lengths, force.forces)))
    if isinstance(force, PointSpringFunction):
        return FunctionBetween(parent, child, force.function)
    raise TypeError(f"{type(force).__name__} is not a force that the mechanics knows; add its law here.")


def load_at(force: AtPoint, base: NodeFrame, child: NodeFrame) -> GivenLoad:
    """The element of a described force or moment at a point."""
    value = time_vector(force, force.value)
    return GivenLoad(base, child, value, force.axes == "link", isinstance(force, PointMoment))


def time_vector(force: LoadOnLink, given: Any) -> TimeVector:
    """What is given of a load, a vector, a table or a function, as a function of time."""
    if force.changes and force.times is None:
        return FunctionVector(function=given, times=tuple(force.breakpoints))
    if force.times is not None:
        return TableVector(values=jnp.asarray(given, jnp.float64).T, times=tuple(force.times))
    return ConstantVector(values=jnp.asarray(given, jnp.float64))
