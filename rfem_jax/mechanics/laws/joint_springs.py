"""Springs and dampers of compliant joints as arrays, and what they exert.

Place in the pipeline: description.compliance -> **joint_springs** -> model, joint_forces, cut_joints.

A spring acts on one sprung direction of a joint or on the resultant of several.  In the tree they are coordinates of
the joint (theory (13.2) to (13.4)), at a cut joint the residuals of its closure equations (theory (13.6), (13.7)).

Symbols: r displacement [m] or tilt [rad]; p, s the two angles of a tilt in the tree; theta the angle between two axes.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

from rfem_jax.description.mechanism.compliance import SprungDirection
from rfem_jax.mechanics.algebra.vectors import Scalar

SERIES = 1e-3  # of the squared sine, below which theta / sin(theta) is a power series
ALMOST_ZERO = 1e-30  # of a squared displacement


class CompliantSpring(eqx.Module):
    """One spring with its damper.

    coordinates, places: indices of the rates and in the position of the tree joints (() at a cut joint); rows: of the
    closure equations (() in the tree); tilt: whether it acts on the angle between two axes by two coordinates, or by
    rows; stiffness [N/m, N m/rad], damping; positions, forces: a table instead of the stiffness.
    """

    coordinates: tuple[int, ...] = eqx.field(static=True)
    places: tuple[int, ...] = eqx.field(static=True)
    rows: tuple[int, ...] = eqx.field(static=True)
    tilt: bool = eqx.field(static=True)
    stiffness: Float[Array, ""]
    damping: Float[Array, ""]
    positions: Float[Array, " knots"] | None = None
    forces: Float[Array, " knots"] | None = None

    def along(self, position: Float[Array, " n"], rate: Float[Array, " n"]) -> Float[Array, " n"]:
        """Forces [N] or moments [N m] along the spring's coordinates, at these and their rates."""
        if not self.tilt:
            return -self._secant(position) * position - self.damping * rate
        (p, s), cosine = position, jnp.cos(position[0])
        direction = jnp.stack([jnp.sin(p) * jnp.cos(s), cosine * jnp.sin(s)])
        # The second axis is across the parent's by the cosine of the first angle.
        across = jnp.stack([jnp.ones_like(cosine), cosine**2])
        return -self._moment_over_sine(_square_of_sine(p, s)) * direction - self.damping * across * rate

    def in_rows(self, residual: Float[Array, " n"], rate: Float[Array, " n"], scale: Scalar) -> Float[Array, " n"]:
        """Multipliers [N] of the spring's closure equations at their residuals [m] and rates; `scale` [m] as in
        `closure`."""
        if not self.tilt:
            return -self._secant(residual) * residual - self.damping * rate
        bend, bend_rate = residual / scale, rate / scale
        square = jnp.sum(bend**2)
        across = bend_rate + bend * (jnp.sum(bend * bend_rate) / (1.0 - square))
        spring = self._moment_over_sine(square) / jnp.sqrt(1.0 - square) * bend
        return -(spring + self.damping * across) / scale

    def energy(self, position: Float[Array, " n"]) -> Float[Array, ""]:
        """Potential energy [J] at its coordinates."""
        if self.tilt:
            return self._energy_of_tilt(_square_of_sine(*position))
        return self._energy(jnp.sum(position**2), position)

    def energy_in_rows(self, residual: Float[Array, " n"], scale: Scalar) -> Float[Array, ""]:
        """Potential energy [J] at the residuals of its closure equations."""
        if self.tilt:
            return self._energy_of_tilt(jnp.sum((residual / scale) ** 2))
        return self._energy(jnp.sum(residual**2), residual)

    def _secant(self, position: Float[Array, " n"]) -> Float[Array, ""]:
        """Force over displacement."""
        if self.positions is None:
            return self.stiffness
        if position.shape[0] == 1:
            square, sign = position[0] ** 2, jnp.where(position[0] < 0.0, -1.0, 1.0)
        else:
            square, sign = jnp.sum(position**2), jnp.ones(())
        none = square < ALMOST_ZERO
        size = sign * jnp.sqrt(jnp.where(none, ALMOST_ZERO, square))
        return self._table(size)[0] / size

    def _moment_over_sine(self, square: Float[Array, ""]) -> Float[Array, ""]:
        """Moment over the sine of the tilt, by the square of the sine."""
        ratio = _angle_over_sine(square)
        if self.positions is None:
            return self.stiffness * ratio
        none = square < ALMOST_ZERO
        angle = ratio * jnp.sqrt(jnp.where(none, ALMOST_ZERO, square))
        return self._table(angle)[0] / angle * ratio

    def _energy_of_tilt(self, square: Float[Array, ""]) -> Float[Array, ""]:
        angle_square = _angle_over_sine(square) ** 2 * square
        return self._energy(angle_square, angle_square[None])

    def _energy(self, square: Float[Array, ""], position: Float[Array, " n"]) -> Float[Array, ""]:
        if self.positions is None:
            return 0.5 * self.stiffness * square
        sign = jnp.where(position[0] < 0.0, -1.0, 1.0) if position.shape[0] == 1 else jnp.ones(())
        none = square < ALMOST_ZERO
        return self._table(sign * jnp.sqrt(jnp.where(none, ALMOST_ZERO, square)))[1]

    def _table(self, position: Float[Array, ""]) -> tuple[Float[Array, ""], Float[Array, ""]]:
        """Force and its integral from zero, linear between rows and beyond them."""
        assert self.positions is not None and self.forces is not None
        x, f = self.positions, self.forces
        stiffness = (f[1:] - f[:-1]) / (x[1:] - x[:-1])
        before = jnp.concatenate([jnp.zeros((1,)), jnp.cumsum(0.5 * (f[1:] + f[:-1]) * (x[1:] - x[:-1]))])[:-1]

        def at(value):
            # Comparisons and sums, no search: it is a loop, and gathers are slow in compiled loops.
            last = x.shape[0] - 2
            row = jnp.clip(jnp.sum(value >= x) - 1, 0, last) == jnp.arange(last + 1)
            step = value - x[:-1]
            force = f[:-1] + stiffness * step
            energy = before + 0.5 * (f[:-1] + force) * step
            return jnp.sum(jnp.where(row, force, 0.0)), jnp.sum(jnp.where(row, energy, 0.0))

        force, energy = at(position)
        return force, energy - at(jnp.zeros_like(position))[1]


def _square_of_sine(p: Float[Array, ""], s: Float[Array, ""]) -> Float[Array, ""]:
    """Square of the sine of the angle between two axes that are turned by p, then s, about two axes across."""
    return jnp.sin(s) ** 2 + (jnp.cos(s) * jnp.sin(p)) ** 2


def _angle_over_sine(square: Float[Array, ""]) -> Float[Array, ""]:
    """theta / sin(theta) of an angle below 90 deg by the square of its sine."""
    small = square < SERIES
    x = jnp.where(small, square, 0.0)
    series = 1.0 + x * (1 / 6 + x * (3 / 40 + x * (5 / 112 + x * (35 / 1152 + x * (63 / 2816)))))
    sine = jnp.sqrt(jnp.where(small, 0.5, square))
    return jnp.where(small, series, jnp.arcsin(jnp.minimum(sine, 1.0)) / sine)


def compliant_spring(
    spring: SprungDirection, coordinates: tuple[int, ...], places: tuple[int, ...], rows: tuple[int, ...]
) -> CompliantSpring:
    """The arrays of a described spring on coordinates of a tree joint, or on closure equations of a cut one."""

    def array(values):
        return None if values is None else jnp.asarray(values, jnp.float64)

    return CompliantSpring(
        coordinates=coordinates,
        places=places,
        rows=rows,
        tilt=spring.rotation and (bool(rows) or len(coordinates) == 2),
        stiffness=jnp.asarray(spring.stiffness, jnp.float64),
        damping=jnp.asarray(spring.damping, jnp.float64),
        positions=array(spring.positions),
        forces=array(spring.forces),
    )


def diagonal_tangent(function, position: Array, rate: Array, q_factor: Scalar, v_factor: Scalar) -> Array:
    """Minus the derivatives of each force with respect to its own coordinate's acceleration, at least zero, for the
    derivatives of position [s^2] and rate [s] by it."""
    found = []
    for unit in jnp.eye(position.shape[0]):
        along = (q_factor * unit, v_factor * unit)
        found.append(jnp.maximum(-jnp.sum(unit * jax.jvp(function, (position, rate), along)[1]), 0.0))
    return jnp.stack(found)
