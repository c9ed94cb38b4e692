"""Drives of translations: forces on the slides of joints, or prescribed displacements, as functions of time.

Place in the pipeline: as `rotations`, the same about axes.

Symbols: t [s]; force [N] along the axis of the motion; displacement since the start [m], speed [m/s], acceleration
[m/s^2]. Source: theory (3.5), (3.6), (3.15).
"""

from typing import ClassVar

import equinox as eqx

from rfem_jax.description.basics.units import Quantities, Quantity
from rfem_jax.description.drives.arguments import Scalar
from rfem_jax.description.drives.family import (
    GivenDrive,
    GivenFunction,
    GivenRamp,
    GivenTable,
    PrescribedRise,
    PrescribedSmoothRise,
    PrescribedSpline,
)


class ForceDrive(GivenDrive):
    """A given force [N] along a free translation of a joint."""

    rotation: ClassVar[bool | None] = False


class ForceRamp(GivenRamp, ForceDrive):
    """F = force * t / rise_time up to rise_time, then 0.

    Args:
        joint: the joint's name.
        force: [N], reached at rise_time.
        rise_time: [s], > 0.
        motion: which translation of the joint, as "T_x" (along x); None = the joint's only motion.
    """

    force: Scalar
    rise_time: float = eqx.field(static=True)

    def __init__(self, joint: str, force: Quantity, rise_time: Quantity, motion: str | None = None):
        self._begin(joint, force, rise_time, motion)


class ForceTable(GivenTable, ForceDrive):
    """A force given at times, linear in between, zero after the last time.

    Args:
        joint: the joint's name.
        times: [s], from 0, not decreasing; a time given twice is a jump.
        forces: [N], as many as times.
        motion: which translation of the joint, as "T_x" (along x); None = the joint's only motion.
    """

    def __init__(self, joint: str, times: Quantities, forces: Quantities, motion: str | None = None):
        self._begin(joint, times, forces, motion)


class ForceFunction(GivenFunction, ForceDrive):
    """A force given by a Python function written in JAX.

    Args:
        joint: the joint's name.
        function: (t [s], phase) -> force [N], a float64 scalar; smooth within a phase. It may
            close over what is differentiated; an `equinox.Module` that has it as arrays is compiled once for all
            values.
        breakpoints: times [s] > 0 at which the force jumps, increasing.
        motion: which translation of the joint, as "T_x" (along x); None = the joint's only motion.
    """


class PrescribedSpeed(PrescribedRise):
    """A speed that rises smoothly to a constant: speed * (3 x^2 - 2 x^3), x = t / rise_time <= 1.

    Args:
        joint: the joint's name.
        speed: [m/s], positive as the displacement.
        rise_time: [s], >= 0; 0 moves at the full speed from the start.
        motion: which translation of the joint, as "T_x" (along x); None = the joint's only motion.
    """

    rotation: ClassVar[bool | None] = False
    speed: Scalar
    rise_time: float = eqx.field(static=True)

    def __init__(self, joint: str, speed: Quantity, rise_time: Quantity = 0.0, motion: str | None = None):
        self._begin(joint, speed, rise_time, motion)


class PrescribedRunUp(PrescribedSmoothRise):
    """A speed that rises to a constant with a continuous acceleration:
    speed * (x - sin(2 pi x) / (2 pi)), x = t / rise_time <= 1.

    Args:
        joint: the joint's name.
        speed: [m/s], positive as the displacement, reached at rise_time.
        rise_time: [s], > 0.
        motion: which translation of the joint, as "T_x" (along x); None = the joint's only motion.
    """

    rotation: ClassVar[bool | None] = False
    speed: Scalar
    rise_time: float = eqx.field(static=True)

    def __init__(self, joint: str, speed: Quantity, rise_time: Quantity, motion: str | None = None):
        self._begin(joint, speed, rise_time, motion)


class PrescribedDisplacements(PrescribedSpline):
    """Displacements, given at times and joined by a cubic spline (C2, "not-a-knot" ends).

    Args:
        joint: the joint's name.
        times: [s], increasing from 0; at least two.
        displacements: since the start [m], as many as times, the first 0.
        motion: which translation of the joint, as "T_x" (along x); None = the joint's only motion.
    """

    rotation: ClassVar[bool | None] = False

    def __init__(self, joint: str, times: Quantities, displacements: Quantities, motion: str | None = None):
        self._begin(joint, times, displacements, motion)
