"""The family of drives: each law once, for moments about an axis and forces along it, for angles and displacements.

Place in the pipeline: arguments, laws -> **family** -> rotations, translations, which give the laws their arguments.

A drive may jump at its breakpoints, which are static (they divide the run into integrations). Pieces are chosen by
`phase`, the number of breakpoints passed, never by comparing t with a jump. Values are float64 JAX arrays: new values
do not compile anew.

Symbols: t [s]; force, a moment [N m] about the axis of the motion or a force [N] along it; change of the coordinate
since the start [rad, m], rate [rad/s, m/s], acceleration [rad/s^2, m/s^2].  Source: theory (3.5), (3.6), (3.15).
"""

import abc
import copy
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from rfem_jax.description.basics.units import Quantities, Quantity, non_negative_quantity, positive_quantity
from rfem_jax.description.drives import laws
from rfem_jax.description.drives.arguments import (
    Phase,
    Scalar,
    Time,
    as_phase,
    checked_breakpoints,
    checked_function_of_time,
    column,
    drive_checks,
    function_of_time,
    leaf,
    table_changes,
    table_times,
)
from rfem_jax.description.drives.laws import Motion

if TYPE_CHECKING:
    Law = Callable[..., Scalar]
else:
    Law = Any  # what is no function is refused in a sentence


class Words(NamedTuple):
    """What the quantities of a motion are called: arguments that are also dimensions, and the column of its changes
    with its dimension."""

    force: str
    rate: str
    changes: str
    change: str


ROTATION = Words("moment", "rate", "angles", "angle")
TRANSLATION = Words("force", "speed", "displacements", "length")


class AnyMotion(eqx.Module):
    """A drive of one free motion of a joint of the tree; `motion` None: its only one."""

    joint: eqx.AbstractVar[str]
    motion: str | None = eqx.field(static=True, default=None, kw_only=True)
    rotation: ClassVar[bool | None] = None  # whether the motion is a rotation, or a translation; None: either
    scaled_field: ClassVar[str | None] = None  # the field that the number "factor" scales

    def renamed(self, names: Any) -> Any:
        """On a joint of another name, `names.of(name)`."""
        other = copy.copy(self)
        object.__setattr__(other, "joint", names.of(self.joint))
        return other

    @abc.abstractmethod
    def breakpoints(self) -> tuple[float, ...]:
        """Return the times [s] > 0 at which the force, or a derivative of the motion, jumps, increasing."""

    def step_ends(self, interval: float) -> tuple[float, ...]:
        """Return the times [s] beside the breakpoints at which steps must end, so that they see how the drive changes:
        rows of a table, and places within a rise that is short beside intervals of a length [s]."""
        del interval
        return ()

    @property
    def number_name(self) -> str | None:
        """Name of the number that a design may set: a field, or "factor", which scales one; None: there is none."""
        return None if self.scaled_field is None else "factor"

    @property
    def _words(self) -> Words:
        return ROTATION if self.rotation else TRANSLATION


class GivenDrive(AnyMotion):
    """A given force or moment along one free motion of a joint of the tree; `motion` None: its only one."""

    @abc.abstractmethod
    def force_at(self, t: Time, phase: Phase) -> Scalar:
        """Return the moment [N m] or force [N], positive as the motion, at t in the piece `phase` (int, from 0)."""


class PrescribedDrive(AnyMotion):
    """A given angle or displacement of a joint; the moment or force that enforces it is a result."""

    @abc.abstractmethod
    def motion_at(self, t: Time, phase: Phase) -> Motion:
        """Return (change of the angle or displacement since the start, rate, acceleration) at t in the piece
        `phase`."""


class GivenRamp(GivenDrive):
    """A force, in the field of its word, that rises linearly and is then 0."""

    joint: str = eqx.field(static=True)
    rise_time: eqx.AbstractVar[float]

    def _begin(self, joint: str, force: Quantity, rise_time: Quantity, motion: str | None) -> None:
        checks, word = drive_checks(self, joint, motion), self._words.force
        checks.set(word, force, leaf, word, word)
        checks.set("rise_time", rise_time, positive_quantity, "time", "rise_time")
        checks.refuse()

    def breakpoints(self) -> tuple[float, ...]:
        return (self.rise_time,)

    @property
    def number_name(self) -> str:
        return self._words.force

    def force_at(self, t: Time, phase: Phase) -> Scalar:
        return laws.ramp(getattr(self, self._words.force), self.rise_time, t, phase)


class GivenTable(GivenDrive):
    """A force at times, linear in between and 0 after the last."""

    joint: str = eqx.field(static=True)
    values: Float[Array, " times"]
    times: tuple[float, ...] = eqx.field(static=True)
    scaled_field: ClassVar[str | None] = "values"

    def _begin(self, joint: str, times: Quantities, forces: Quantities, motion: str | None) -> None:
        checks, word = drive_checks(self, joint, motion), self._words.force
        found = checks.value("times", times, table_times, False)
        checks.set("values", forces, column, word, f"{word}s", found)
        checks.refuse()
        self.times = found

    def breakpoints(self) -> tuple[float, ...]:
        return laws.table_jumps(self.times)

    def step_ends(self, interval: float) -> tuple[float, ...]:
        return self.times

    def force_at(self, t: Time, phase: Phase) -> Scalar:
        return laws.table_at(self.values, self.times, t, phase)


class OfFunction(AnyMotion):
    """A drive by a function of the user's, with the `times` [s] at which it jumps."""

    joint: str = eqx.field(static=True)
    function: Callable[..., Scalar]
    times: tuple[float, ...] = eqx.field(static=True)

    def _begin(self, joint: str, function: Law, breakpoints: Quantities, motion: str | None) -> None:
        checks = drive_checks(self, joint, motion)
        checks.set("times", breakpoints, checked_breakpoints)
        checks.set("function", function, function_of_time)
        checks.refuse()

    def breakpoints(self) -> tuple[float, ...]:
        return self.times


class GivenFunction(OfFunction, GivenDrive):
    """A force as a function of time and phase."""

    def __init__(self, joint: str, function: Law, breakpoints: Quantities = (), motion: str | None = None):
        self._begin(joint, function, breakpoints, motion)
        self.function = checked_function_of_time(self.function, with_phase=True)

    def force_at(self, t: Time, phase: Phase) -> Scalar:
        return self.function(jnp.asarray(t, jnp.float64), as_phase(phase))


class PrescribedRise(PrescribedDrive):
    """A rate, in the field of its word, that rises smoothly to a constant."""

    joint: str = eqx.field(static=True)
    rise_time: eqx.AbstractVar[float]
    may_jump: ClassVar[bool] = True  # whether it may rise in no time

    def _begin(self, joint: str, rate: Quantity, rise_time: Quantity, motion: str | None) -> None:
        checks, word = drive_checks(self, joint, motion), self._words.rate
        checks.set(word, rate, leaf, word, word)
        read = non_negative_quantity if self.may_jump else positive_quantity
        checks.set("rise_time", rise_time, read, "time", "rise_time")
        checks.refuse()

    def breakpoints(self) -> tuple[float, ...]:
        return (self.rise_time,) if self.rise_time > 0.0 else ()

    def step_ends(self, interval: float) -> tuple[float, ...]:
        return laws.rise_steps(self.rise_time, interval)

    @property
    def number_name(self) -> str:
        return self._words.rate

    def motion_at(self, t: Time, phase: Phase) -> Motion:
        return laws.rise(getattr(self, self._words.rate), self.rise_time, t, phase)


class PrescribedSmoothRise(PrescribedRise):
    """A rate, in the field of its word, that rises to a constant with a continuous acceleration."""

    may_jump: ClassVar[bool] = False

    def motion_at(self, t: Time, phase: Phase) -> Motion:
        return laws.spin_up(getattr(self, self._words.rate), self.rise_time, t, phase)


class PrescribedSpline(PrescribedDrive):
    """Changes of the coordinate at times, joined by a cubic spline."""

    joint: str = eqx.field(static=True)
    knots: Float[Array, " times"]
    coefficients: Float[Array, "4 times-1"]
    times: tuple[float, ...] = eqx.field(static=True)
    scaled_field: ClassVar[str | None] = "coefficients"

    def _begin(self, joint: str, times: Quantities, changes: Quantities, motion: str | None) -> None:
        checks, words = drive_checks(self, joint, motion), self._words
        knots = checks.value("times", times, table_times, True)
        found = checks.value(words.changes, changes, table_changes, words.change, words.changes, knots)
        checks.refuse()
        self.times = knots
        self.knots, self.coefficients = laws.spline(knots, found)

    def breakpoints(self) -> tuple[float, ...]:
        return ()

    def step_ends(self, interval: float) -> tuple[float, ...]:
        return self.times

    def motion_at(self, t: Time, phase: Phase) -> Motion:
        return laws.spline_at(self.knots, self.coefficients, t)
