"""Drives of rotations: moments about the axes of joints, or prescribed angles, as functions of time.

Place in the pipeline: family -> **rotations** -> specified in a study; `mechanics` and `simulation` evaluate them
inside compiled code (jit, vmap, forward and reverse differentiation). `translations` has the same along axes.

Symbols: t [s]; moment [N m] about the axis of the motion; change of the angle since the start [rad], rate [rad/s],
acceleration [rad/s^2]. Source: theory (3.5), (3.6), (3.15).
"""

import abc
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.core import Tracer

from rfem_jax.description.basics.errors import InputError
from rfem_jax.description.basics.units import Quantities, Quantity
from rfem_jax.description.drives.arguments import (
    Phase,
    Scalar,
    Time,
    as_phase,
    checked_function_of_time,
)
from rfem_jax.description.drives.family import (
    GivenDrive,
    GivenFunction,
    GivenRamp,
    GivenTable,
    Law,
    OfFunction,
    PrescribedDrive,
    PrescribedRise,
    PrescribedSmoothRise,
    PrescribedSpline,
)
from rfem_jax.description.drives.laws import Motion


class MomentDrive(GivenDrive):
    """A given moment about the axis of a free motion of a joint."""

    rotation: ClassVar[bool | None] = True

    @abc.abstractmethod
    def moment_at(self, t: Time, phase: Phase) -> Scalar:
        """Return the moment [N m], positive as the motion (about +y of a hinge), at the time t, in the piece `phase`
        (int, from 0)."""

    def force_at(self, t: Time, phase: Phase) -> Scalar:
        return self.moment_at(t, phase)


class _MomentOfFamily(MomentDrive):
    """A moment whose law is the family's `force_at`."""

    def moment_at(self, t: Time, phase: Phase) -> Scalar:
        return self.force_at(t, phase)


class MomentRamp(GivenRamp, _MomentOfFamily):
    """M = moment * t / rise_time up to rise_time, then 0; theory (3.5).

    Args:
        joint: the joint's name.
        moment: [N m], reached at rise_time.
        rise_time: [s], > 0.
        motion: which free motion of the joint, as "R_y" or "T_x" (a rotation about y, a translation along x); None =
            the joint's only one.
    """

    moment: Scalar
    rise_time: float = eqx.field(static=True)

    def __init__(self, joint: str, moment: Quantity, rise_time: Quantity, motion: str | None = None):
        self._begin(joint, moment, rise_time, motion)


class MomentTable(GivenTable, _MomentOfFamily):
    """A moment given at times, linear in between, zero after the last time.

    Args:
        joint: the joint's name.
        times: [s], from 0, not decreasing; a time given twice is a jump.
        moments: [N m], as many as times.
        motion: which free motion of the joint, as "R_y" or "T_x" (a rotation about y, a translation along x); None =
            the joint's only one.
    """

    def __init__(self, joint: str, times: Quantities, moments: Quantities, motion: str | None = None):
        self._begin(joint, times, moments, motion)


class MomentFunction(GivenFunction, _MomentOfFamily):
    """A moment given by a Python function written in JAX.

    Args:
        joint: the joint's name.
        function: (t [s], phase) -> moment [N m], a float64 scalar; smooth within a phase. It may
            close over what is differentiated; an `equinox.Module` that has it as arrays is compiled once for all
            values.
        breakpoints: times [s] > 0 at which the moment jumps, increasing.
        motion: which free motion of the joint, as "R_y" or "T_x" (a rotation about y, a translation along x); None =
            the joint's only one.
    """


class PrescribedRate(PrescribedRise):
    """A rate that rises smoothly to a constant: rate * (3 x^2 - 2 x^3), x = t / rise_time <= 1.

    Args:
        joint: the joint's name.
        rate: [rad/s] about +y.
        rise_time: [s], >= 0; 0 moves at the full rate from the start.
        motion: which free motion of the joint, as "R_y" or "T_x" (a rotation about y, a translation along x); None =
            the joint's only one.
    """

    rotation: ClassVar[bool | None] = True
    rate: Scalar
    rise_time: float = eqx.field(static=True)

    def __init__(self, joint: str, rate: Quantity, rise_time: Quantity = 0.0, motion: str | None = None):
        self._begin(joint, rate, rise_time, motion)


class PrescribedSpinUp(PrescribedSmoothRise):
    """A rate that rises to a constant with a continuous acceleration:
    rate * (x - sin(2 pi x) / (2 pi)), x = t / rise_time <= 1.

    The law of the spin-up beam of Simo and Vu-Quoc (J. Appl. Mech. 53 (1986) 855-863) and of Wu and
    Haug's slewing beam (Int. J. Numer. Methods Eng. 26 (1988) 2211-2226).

    Args:
        joint: the joint's name.
        rate: [rad/s] about +y, reached at rise_time.
        rise_time: [s], > 0.
        motion: which free motion of the joint, as "R_y" or "T_x" (a rotation about y, a translation along x); None =
            the joint's only one.
    """

    rotation: ClassVar[bool | None] = True
    rate: Scalar
    rise_time: float = eqx.field(static=True)

    def __init__(self, joint: str, rate: Quantity, rise_time: Quantity, motion: str | None = None):
        self._begin(joint, rate, rise_time, motion)


class PrescribedTable(PrescribedSpline):
    """Changes of the angle, given at times and joined by a cubic spline (C2, "not-a-knot" ends).

    Args:
        joint: the joint's name.
        times: [s], increasing from 0; at least two.
        angles: changes of the angle since the start [rad], as many as times, the first 0.
        motion: which free motion of the joint, as "R_y" or "T_x" (a rotation about y, a translation along x); None =
            the joint's only one.
    """

    rotation: ClassVar[bool | None] = True

    def __init__(self, joint: str, times: Quantities, angles: Quantities, motion: str | None = None):
        self._begin(joint, times, angles, motion)


class PrescribedFunction(OfFunction, PrescribedDrive):
    """Change of the angle, or displacement, as a Python function written in JAX; its derivatives are taken by JAX.

    Args:
        joint: the joint's name.
        function: t [s] -> change of the angle [rad] or displacement [m], a float64 scalar, 0 at t = 0 and twice
            differentiable; with breakpoints it is called as function(t, phase) instead.
        breakpoints: times [s] > 0 at which a derivative jumps, increasing.
        motion: which free motion of the joint, as "R_y" or "T_x" (a rotation about y, a translation along x); None =
            the joint's only one.
    """

    def __init__(self, joint: str, function: Law, breakpoints: Quantities = (), motion: str | None = None):
        self._begin(joint, function, breakpoints, motion)
        function_with_leaves = checked_function_of_time(self.function, with_phase=bool(self.times))
        start = self._angle(jnp.zeros((), jnp.float64), 0)
        if not isinstance(start, Tracer) and not abs(float(start)) <= 1e-12:
            raise InputError(
                f"Argument `function` must be 0 at t = 0, but was {float(start)}; return the change "
                "of the angle or displacement since the start."
            )
        self.function = function_with_leaves

    def _angle(self, t: Time, phase: Phase) -> Scalar:
        return self.function(t, phase) if self.times else self.function(t)

    def motion_at(self, t: Time, phase: Phase) -> Motion:
        t, phase = jnp.asarray(t, jnp.float64), as_phase(phase)
        one = jnp.ones_like(t)

        def angle_and_rate(time: Scalar) -> tuple[Scalar, Scalar]:
            return jax.jvp(lambda s: self._angle(s, phase), (time,), (one,))

        (angle, rate), (_, acceleration) = jax.jvp(angle_and_rate, (t,), (one,))
        return angle, rate, acceleration
