"""Couplings between two joint coordinates as arrays: the function of a ratio or a table, and the mesh.

Place in the pipeline: description.couplings, contact_law -> **couplings** -> model, with_errors, joint_forces.

Symbols: q_a, q_b the two coordinates; f the function with its errors; g = q_b - f(q_a) - offset. Theory (16.1) to
(16.6).
"""

import abc
from dataclasses import replace
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rfem_jax.description.basics.numbers import array_of
from rfem_jax.description.mechanism.couplings import Coupling
from rfem_jax.mechanics.algebra.vectors import Scalar
from rfem_jax.mechanics.laws.contact_law import ContactLaw


class Transmission(eqx.Module):
    """The function f of a perfect coupling."""

    @abc.abstractmethod
    def at(self, position: Float[Array, ""]) -> tuple[Float[Array, ""], Float[Array, ""]]:
        """f and its derivative at q_a."""


class RatioTransmission(Transmission):
    """f = ratio q_a."""

    ratio: Float[Array, ""]

    def at(self, position):
        return self.ratio * position, self.ratio


class TableTransmission(Transmission):
    """A cubic spline with two continuous derivatives; curvatures: second derivatives in its rows; outside the rows it
    goes on straight, or repeats."""

    positions: Float[Array, " rows"]
    values: Float[Array, " rows"]
    curvatures: Float[Array, " rows"]
    periodic: bool = eqx.field(static=True)

    def at(self, position):
        x, y, bend = self.positions, self.values, self.curvatures
        if self.periodic:
            period = x[-1] - x[0]
            position = position - period * jnp.floor((position - x[0]) / period)
        # Not by `clip`, whose derivative is a half at the ends.
        inside = jnp.where(position < x[0], x[0], jnp.where(position > x[-1], x[-1], position))
        last = x.shape[0] - 2
        # Comparisons and sums, no search: it is a loop, and gathers are slow in compiled loops.
        row = jnp.clip(jnp.sum(inside >= x) - 1, 0, last) == jnp.arange(last + 1)
        h = x[1:] - x[:-1]
        right = (inside - x[:-1]) / h
        left = 1.0 - right
        value = left * y[:-1] + right * y[1:]
        value = value + h**2 / 6.0 * ((left**3 - left) * bend[:-1] + (right**3 - right) * bend[1:])
        slope = (y[1:] - y[:-1]) / h
        slope = slope + h / 6.0 * ((3.0 * right**2 - 1.0) * bend[1:] - (3.0 * left**2 - 1.0) * bend[:-1])
        value, slope = (jnp.sum(jnp.where(row, one, 0.0)) for one in (value, slope))
        return value + slope * (position - inside), slope


class Meshing(NamedTuple):
    """A mesh at one instant: deflection g [rad, m] of b's coordinate; loads (2,) [N m, N] along q_a and q_b;
    dissipated [W]."""

    deflection: Float[Array, ""]
    loads: Float[Array, "2"]
    dissipated: Float[Array, ""]


class CouplingLaw(eqx.Module):
    """A mesh between two joint coordinates.

    coordinates, places: indices of q_a and q_b among the rates and in the position of the tree joints; stiffness: None
    of an ideal coupling, which is a constraint and no mesh (`kinematics.ideal_couplings`); offset: None before the
    start positions are known, of which it is then made; gap: half the backlash; chi: of flanks that only push, None
    without any; waves: None where q_a does not turn.
    """

    coordinates: tuple[int, int] = eqx.field(static=True)
    places: tuple[int, int] = eqx.field(static=True)
    transmission: Transmission
    stiffness: Float[Array, ""] | None
    damping: Float[Array, ""]
    pitch_error: Float[Array, ""]
    eccentricity: Float[Array, ""]
    eccentricity_phase: Float[Array, ""]
    offset: Float[Array, ""] | None
    gap: Float[Array, ""] | None
    chi: Float[Array, ""] | None
    waves: Float[Array, ""] | None
    exponent: float = eqx.field(static=True)
    one_sided: bool = eqx.field(static=True)

    def starting_at(self, joints: Float[Array, " numbers"]) -> "CouplingLaw":
        """The law with its offset, which is that of the start unless it is given."""
        if self.offset is not None:
            return self
        first, second = self.places
        return replace(self, offset=joints[second] - self.transmission.at(joints[first])[0])

    def transmitted(self, position: Float[Array, ""]) -> tuple[Float[Array, ""], Float[Array, ""]]:
        """f with its errors and its derivative at q_a (theory (16.2))."""
        value, slope = self.transmission.at(position + self.pitch_error)
        if self.waves is None:
            return value, slope
        wave = self.waves * position + self.eccentricity_phase
        return value + self.eccentricity * jnp.sin(wave), slope + self.eccentricity * self.waves * jnp.cos(wave)

    def deflection(self, positions: Float[Array, "2"]) -> Float[Array, ""]:
        """g [rad, m] of the coordinates."""
        assert self.offset is not None, "`starting_at` has not been called"
        return positions[1] - self.transmitted(positions[0])[0] - self.offset

    def meshing(self, positions: Float[Array, "2"], rates: Float[Array, "2"]) -> Meshing:
        """What the mesh exerts at positions and rates of q_a and q_b (theory (16.3))."""
        slope = self.transmitted(positions[0])[1]
        deflection, rate = self.deflection(positions), rates[1] - slope * rates[0]
        load, elastic = self.load(deflection, rate)
        return Meshing(deflection, jnp.stack([-slope * load, load]), (elastic - load) * rate)

    def load(self, deflection: Float[Array, ""], rate: Float[Array, ""]) -> tuple[Float[Array, ""], Float[Array, ""]]:
        """Load [N m, N] along q_b, and its elastic part."""
        assert self.stiffness is not None, "an ideal coupling has no mesh"
        if self.gap is None:
            elastic = -self.stiffness * deflection
            return elastic - self.damping * rate, elastic
        contact = ContactLaw(self.stiffness, self.exponent)
        drive = contact.push(-deflection - self.gap, -rate, self.chi)
        if self.one_sided:
            return drive.normal, drive.elastic
        coast = contact.push(deflection - self.gap, rate, self.chi)
        return drive.normal - coast.normal, drive.elastic - coast.elastic

    def energy(self, positions: Float[Array, "2"]) -> Float[Array, ""]:
        """Potential energy [J], zero without load."""
        assert self.stiffness is not None, "an ideal coupling has no mesh"
        deflection = self.deflection(positions)
        if self.gap is None:
            return 0.5 * self.stiffness * deflection**2
        contact = ContactLaw(self.stiffness, self.exponent)
        drive = contact.energy(-deflection - self.gap)
        return drive if self.one_sided else drive + contact.energy(deflection - self.gap)

    def tangent(
        self, positions: Float[Array, "2"], rates: Float[Array, "2"], q_factor: Scalar, v_factor: Scalar
    ) -> tuple[Float[Array, "2"], Float[Array, ""]]:
        """The direction (-f', 1) of the loads, and minus the derivative of the load along q_b with respect to the
        relative acceleration along it, for the derivatives of position [s^2] and rate [s] by it; at least zero."""
        slope = self.transmitted(positions[0])[1]
        at = self.deflection(positions), rates[1] - slope * rates[0]
        along = (jnp.asarray(q_factor, float), jnp.asarray(v_factor, float))
        change = jax.jvp(lambda g, rate: self.load(g, rate)[0], at, along)[1]
        return jnp.stack([-slope, jnp.ones_like(slope)]), jnp.maximum(-change, 0.0)


def coupling_law(coupling: Coupling, coordinates: tuple[int, int], places: tuple[int, int]) -> CouplingLaw:
    """The arrays of a described coupling of two joint coordinates."""

    def array(value):
        return jnp.asarray(value, jnp.float64)

    gap = 0.0 if coupling.one_sided else None
    if coupling.backlash is not None:
        gap = 0.5 * array(coupling.backlash)
    return CouplingLaw(
        coordinates=coordinates,
        places=places,
        transmission=_transmission(coupling),
        stiffness=None if coupling.stiffness is None else array(coupling.stiffness),
        damping=array(coupling.damping),
        pitch_error=array(coupling.pitch_error),
        eccentricity=array(coupling.eccentricity),
        eccentricity_phase=array(coupling.eccentricity_phase),
        offset=None if coupling.offset is None else array(coupling.offset),
        gap=None if gap is None else array(gap),
        chi=array(coupling.contact_damping) if coupling.flanks else None,
        waves=array(coupling.waves) if coupling.turns[0] else None,
        exponent=float(coupling.exponent),  # pyright: ignore[reportArgumentType]
        one_sided=coupling.one_sided,
    )


def _transmission(coupling: Coupling) -> Transmission:
    if coupling.positions is None:
        return RatioTransmission(jnp.asarray(coupling.ratio, jnp.float64))
    positions, values = np.asarray(coupling.positions, float), jnp.asarray(array_of(coupling.values), jnp.float64)
    curvatures = jnp.asarray(_curvature_matrix(positions, coupling.periodic)) @ values
    return TableTransmission(jnp.asarray(positions), values, curvatures, coupling.periodic)


def _curvature_matrix(x: Float[np.ndarray, " rows"], periodic: bool) -> Float[np.ndarray, "rows rows"]:
    """Matrix that gives the second derivatives of a cubic spline in its rows from the values in these: slopes are
    continuous, and the ends are without curvature, or alike."""
    n, h = len(x), np.diff(x)
    left, right = np.eye(n), np.zeros((n, n))
    for k in range(1, n - 1):
        left[k, k - 1 : k + 2] = h[k - 1] / 6.0, (h[k - 1] + h[k]) / 3.0, h[k] / 6.0
        right[k, k - 1 : k + 2] = 1.0 / h[k - 1], -1.0 / h[k - 1] - 1.0 / h[k], 1.0 / h[k]
    if periodic:
        left[0] = right[0] = 0.0
        left[0, [0, 1, -2, -1]] = h[0] / 3.0, h[0] / 6.0, h[-1] / 6.0, h[-1] / 3.0
        right[0, [0, 1, -2, -1]] = -1.0 / h[0], 1.0 / h[0], 1.0 / h[-1], -1.0 / h[-1]
        left[-1, 0] = -1.0  # and 1 on the diagonal: the same curvature at both ends
    return np.linalg.solve(left, right)
