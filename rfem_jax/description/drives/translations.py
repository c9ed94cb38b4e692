"""Drives of translations: forces on the slides of joints, or prescribed displacements, as functions of time.

Place in the pipeline: as `drives`, which has those of rotations.

Symbols: t [s]; force [N] along the axis of the motion; displacement since the start [m], speed [m/s], acceleration
[m/s^2]. Source: theory (3.5), (3.6), (3.15).
"""

import abc
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from rfem_jax.description.basics.units import Quantities, Quantity, non_negative_quantity, positive_quantity
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
from rfem_jax.description.drives.laws import (
    Motion,
    ramp,
    rise,
    rise_steps,
    spin_up,
    spline,
    spline_at,
    table_at,
    table_jumps,
)
from rfem_jax.description.drives.rotations import GivenDrive, PrescribedDrive

if TYPE_CHECKING:
    Law = Callable[..., Scalar]
else:
    Law = Any  # what is no function is refused in a sentence


class ForceDrive(GivenDrive):
    """A given force along a free translation of a joint."""

    rotation: ClassVar[bool | None] = False

    @abc.abstractmethod
    def breakpoints(self) -> tuple[float, ...]:
        """Return the times [s] > 0 at which the force jumps, increasing."""

    @abc.abstractmethod
    def force_at(self, t: Time, phase: Phase) -> Scalar:
        """Return the force [N], positive as the displacement, at the time t, in the piece `phase` (int, from 0)."""


class ForceRamp(ForceDrive):
    """F = force * t / rise_time up to rise_time, then 0.

    Args:
        joint: the joint's name.
        force: [N], reached at rise_time.
        rise_time: [s], > 0.
        motion: which translation of the joint, as "T_x" (along x); None = the joint's only motion.
    """

    joint: str = eqx.field(static=True)
    force: Scalar
    rise_time: float = eqx.field(static=True)

    def __init__(self, joint: str, force: Quantity, rise_time: Quantity, motion: str | None = None):
        checks = drive_checks(self, joint, motion)
        checks.set("force", force, leaf, "force", "force")
        checks.set("rise_time", rise_time, positive_quantity, "time", "rise_time")
        checks.refuse()

    def breakpoints(self) -> tuple[float, ...]:
        return (self.rise_time,)

    def force_at(self, t: Time, phase: Phase) -> Scalar:
        return ramp(self.force, self.rise_time, t, phase)


class ForceTable(ForceDrive):
    """A force given at times, linear in between, zero after the last time.

    Args:
        joint: the joint's name.
        times: [s], from 0, not decreasing; a time given twice is a jump.
        forces: [N], as many as times.
        motion: which translation of the joint, as "T_x" (along x); None = the joint's only motion.
    """

    joint: str = eqx.field(static=True)
    values: Float[Array, " times"]
    times: tuple[float, ...] = eqx.field(static=True)

    def __init__(self, joint: str, times: Quantities, forces: Quantities, motion: str | None = None):
        checks = drive_checks(self, joint, motion)
        found = checks.value("times", times, table_times, False)
        checks.set("values", forces, column, "force", "forces", found)
        checks.refuse()
        self.times = found

    def breakpoints(self) -> tuple[float, ...]:
        return table_jumps(self.times)

    def step_ends(self, interval: float) -> tuple[float, ...]:
        return self.times

    def force_at(self, t: Time, phase: Phase) -> Scalar:
        return table_at(self.values, self.times, t, phase)


class ForceFunction(ForceDrive):
    """A force given by a Python function written in JAX.

    Args:
        joint: the joint's name.
        function: (t [s], phase) -> force [N], a float64 scalar; smooth within a phase. It may
            close over what is differentiated; an `equinox.Module` that has it as arrays is compiled once for all
            values.
        breakpoints: times [s] > 0 at which the force jumps, increasing.
        motion: which translation of the joint, as "T_x" (along x); None = the joint's only motion.
    """

    joint: str = eqx.field(static=True)
    function: Callable[..., Scalar]
    times: tuple[float, ...] = eqx.field(static=True)

    def __init__(self, joint: str, function: Law, breakpoints: Quantities = (), motion: str | None = None):
        checks = drive_checks(self, joint, motion)
        checks.set("times", breakpoints, checked_breakpoints)
        checks.set("function", function, function_of_time)
        checks.refuse()
        self.function = checked_function_of_time(self.function, with_phase=True)

    def breakpoints(self) -> tuple[float, ...]:
        return self.times

    def force_at(self, t: Time, phase: Phase) -> Scalar:
        return self.function(jnp.asarray(t, jnp.float64), as_phase(phase))


class PrescribedSpeed(PrescribedDrive):
    """A speed that rises smoothly to a constant: speed * (3 x^2 - 2 x^3), x = t / rise_time <= 1.

    Args:
        joint: the joint's name.
        speed: [m/s], positive as the displacement.
        rise_time: [s], >= 0; 0 moves at the full speed from the start.
        motion: which translation of the joint, as "T_x" (along x); None = the joint's only motion.
    """

    rotation: ClassVar[bool | None] = False
    joint: str = eqx.field(static=True)
    speed: Scalar
    rise_time: float = eqx.field(static=True)

    def __init__(self, joint: str, speed: Quantity, rise_time: Quantity = 0.0, motion: str | None = None):
        checks = drive_checks(self, joint, motion)
        checks.set("speed", speed, leaf, "speed", "speed")
        checks.set("rise_time", rise_time, non_negative_quantity, "time", "rise_time")
        checks.refuse()

    def breakpoints(self) -> tuple[float, ...]:
        return (self.rise_time,) if self.rise_time > 0.0 else ()

    def step_ends(self, interval: float) -> tuple[float, ...]:
        return rise_steps(self.rise_time, interval)

    def motion_at(self, t: Time, phase: Phase) -> Motion:
        return rise(self.speed, self.rise_time, t, phase)


class PrescribedRunUp(PrescribedDrive):
    """A speed that rises to a constant with a continuous acceleration:
    speed * (x - sin(2 pi x) / (2 pi)), x = t / rise_time <= 1.

    Args:
        joint: the joint's name.
        speed: [m/s], positive as the displacement, reached at rise_time.
        rise_time: [s], > 0.
        motion: which translation of the joint, as "T_x" (along x); None = the joint's only motion.
    """

    rotation: ClassVar[bool | None] = False
    joint: str = eqx.field(static=True)
    speed: Scalar
    rise_time: float = eqx.field(static=True)

    def __init__(self, joint: str, speed: Quantity, rise_time: Quantity, motion: str | None = None):
        checks = drive_checks(self, joint, motion)
        checks.set("speed", speed, leaf, "speed", "speed")
        checks.set("rise_time", rise_time, positive_quantity, "time", "rise_time")
        checks.refuse()

    def breakpoints(self) -> tuple[float, ...]:
        return (self.rise_time,)

    def step_ends(self, interval: float) -> tuple[float, ...]:
        return rise_steps(self.rise_time, interval)

    def motion_at(self, t: Time, phase: Phase) -> Motion:
        return spin_up(self.speed, self.rise_time, t, phase)


class PrescribedDisplacements(PrescribedDrive):
    """Displacements, given at times and joined by a cubic spline (C2, "not-a-knot" ends).

    Args:
        joint: the joint's name.
        times: [s], increasing from 0; at least two.
        displacements: since the start [m], as many as times, the first 0.
        motion: which translation of the joint, as "T_x" (along x); None = the joint's only motion.
    """

    rotation: ClassVar[bool | None] = False
    joint: str = eqx.field(static=True)
    knots: Float[Array, " times"]
    coefficients: Float[Array, "4 times-1"]
    times: tuple[float, ...] = eqx.field(static=True)

    def __init__(self, joint: str, times: Quantities, displacements: Quantities, motion: str | None = None):
        checks = drive_checks(self, joint, motion)
        knots = checks.value("times", times, table_times, True)
        changes = checks.value("displacements", displacements, table_changes, "length", "displacements", knots)
        checks.refuse()
        self.times = knots
        self.knots, self.coefficients = spline(knots, changes)

    def breakpoints(self) -> tuple[float, ...]:
        return ()

    def step_ends(self, interval: float) -> tuple[float, ...]:
        return self.times

    def motion_at(self, t: Time, phase: Phase) -> Motion:
        return spline_at(self.knots, self.coefficients, t)
