"""Motions of one rigid body about a fixed point, not computed by this package's mechanics.

Place in the pipeline: the references of `spinning_bodies`.

A body without moments, principal inertia I_1 < I_2 < I_3, by elliptic functions; its orientation follows from the
constancy of the angular momentum and one quadrature. A symmetric heavy top: steady precession in closed form, any
nutation from its two momentum integrals and one equation for the nutation angle, solved by SciPy to 1e-12. Source:
Landau, Lifshitz, Mechanics, sections 35 and 37.

Rotations are those of the body's axes; the axis of symmetry of the top is its x, gravity acts along -z.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.integrate import quad, solve_ivp
from scipy.special import ellipj

from rfem_jax.validation.rigid_links import Axes, turn_x, turn_y, turn_z

Rotations = Float[np.ndarray, "times 3 3"]


@dataclass(frozen=True)
class FreeBody:
    """A body without moments; at t = 0 its angular velocity is (spin[0], 0, spin[1]) [rad/s] in its principal axes.

    inertia: I_1 < I_2 < I_3 [kg m^2], with |L|^2 > 2 E I_2 (L the angular momentum, E the energy).
    """

    inertia: tuple[float, float, float]
    spin: tuple[float, float]

    @property
    def momentum(self) -> float:
        """|L| [kg m^2/s]."""
        return float(np.hypot(self.inertia[0] * self.spin[0], self.inertia[2] * self.spin[1]))

    def angular_velocity(self, t: float) -> Float[np.ndarray, "3"]:
        """In the body's axes [rad/s]."""
        a, b, c = self.inertia
        twice_energy = a * self.spin[0] ** 2 + c * self.spin[1] ** 2
        first, second = twice_energy * c - self.momentum**2, self.momentum**2 - twice_energy * a
        rate = np.sqrt((c - b) * second / (a * b * c))
        sn, cn, dn, _ = ellipj(rate * t, (b - a) * first / ((c - b) * second))
        return np.array([self.spin[0] * cn, np.sqrt(first / (b * (c - b))) * sn, self.spin[1] * dn])

    def _axes(self, t: float, azimuth: float) -> Axes:
        """Body axes in axes whose z is along L."""
        x, y, z = np.array(self.inertia) * self.angular_velocity(t) / self.momentum
        return turn_z(azimuth) @ turn_x(np.arccos(np.clip(z, -1.0, 1.0))) @ turn_z(np.arctan2(x, y))

    def _azimuth_rate(self, t: float) -> float:
        w, inertia = self.angular_velocity(t)[:2], np.array(self.inertia[:2])
        return self.momentum * float(inertia @ w**2) / float(inertia**2 @ w**2)

    def rotations(self, start: Axes, times: Float[np.ndarray, " times"]) -> Rotations:
        """Rotations at times [s], from that at t = 0."""
        spans = zip((0.0, *times[:-1]), times)
        parts = [quad(self._azimuth_rate, a, b, epsabs=1e-13, epsrel=1e-13)[0] for a, b in spans]
        to_space = start @ self._axes(0.0, 0.0).T
        return np.stack([to_space @ self._axes(t, angle) for t, angle in zip(times, np.cumsum(parts))])


@dataclass(frozen=True)
class HeavyTop:
    """A symmetric top with a fixed point: inertia about its axis and, at the fixed point, across it [kg m^2]; moment
    of its weight m g l [N m]."""

    axial: float
    across: float
    weight_moment: float

    def steady_spin(self, tilt: float, precession: float) -> float:
        """Angular velocity about its axis [rad/s] with which it precesses steadily at a tilt [rad] from the upward
        vertical with a rate [rad/s]: I_1 W^2 cos(tilt) - I_3 w_3 W + m g l = 0."""
        return (self.weight_moment + self.across * precession**2 * np.cos(tilt)) / (self.axial * precession)

    @staticmethod
    def axes(azimuth: float, tilt: float, spin: float) -> Axes:
        """Axes of the top: x tilted from the upward vertical towards the azimuth, turned about x by the spin angle."""
        return turn_z(azimuth) @ turn_y(tilt - np.pi / 2.0) @ turn_x(spin)

    def steady(self, tilt: float, precession: float, times: Float[np.ndarray, " times"]) -> Rotations:
        """Rotations of the steady precession."""
        own = self.steady_spin(tilt, precession) - precession * np.cos(tilt)
        return np.stack([self.axes(precession * t, tilt, own * t) for t in times])

    def nutation(self, tilt: float, spin: float, times: Float[np.ndarray, " times"]) -> tuple[Rotations, np.ndarray]:
        """Rotations and tilts [rad] after a start at a tilt with an angular velocity about the axis alone [rad/s]."""
        about_axis = self.axial * spin
        vertical = about_axis * np.cos(tilt)

        def rates(_, y):
            angle, rate = y[:2]
            s, c = np.sin(angle), np.cos(angle)
            azimuth = (vertical - about_axis * c) / (self.across * s**2)
            falling = (self.across * azimuth**2 * c - about_axis * azimuth + self.weight_moment) * s / self.across
            return [rate, falling, azimuth, spin - azimuth * c]

        solved = solve_ivp(rates, (0.0, times[-1]), [tilt, 0.0, 0.0, 0.0], method="DOP853", t_eval=times, rtol=1e-12,
                           atol=1e-13)  # fmt: skip
        tilts, _, azimuths, spins = solved.y
        return np.stack([self.axes(a, b, c) for a, b, c in zip(azimuths, tilts, spins)]), tilts
