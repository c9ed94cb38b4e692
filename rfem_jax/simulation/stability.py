"""Largest stable step of a fixed-step method, before hours are spent.

Place in the pipeline: model, method -> **stability** -> run (or a refusal).

The equations are linearised at rest at the start and at positions over a turn of the driven joint,
Baumgarte's terms included; all damped eigenvalues are tested against the method's own stability
function (Runge-Kutta), or the amplification matrix of the whole linear system (leapfrog).
"""

from typing import NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from rfem_jax.description.drives import PrescribedDrive
from rfem_jax.description.errors import InputError
from rfem_jax.description.methods import Method
from rfem_jax.mechanics.discretisation import CLOSING_TOLERANCE, close_at
from rfem_jax.mechanics.dynamics import accelerations
from rfem_jax.mechanics.inputs import DriveInput, Stabilisation, impose
from rfem_jax.mechanics.model import Coordinates, Model, State
from rfem_jax.mechanics.realisation import assembly_errors, realise
from rfem_jax.mechanics.statics import length_scale
from rfem_jax.simulation.solvers import make_solver
from rfem_jax.simulation.stepping import stabilisation_of

POSITIONS = 12
GROWTH_TOLERANCE = 1e-6


class Linearised(NamedTuple):
    """d q_ddot / d(q, q_dot) = base + velocity_gain * by_rate + position_gain * by_position, each
    (positions, n, 2 n), n coordinates."""

    base: np.ndarray
    by_rate: np.ndarray
    by_position: np.ndarray

    def at(self, pose: int, stabilisation: Stabilisation) -> np.ndarray:
        """The slope (n, 2 n) of one position with given gains."""
        return (
            self.base[pose]
            + float(stabilisation.velocity_gain) * self.by_rate[pose]
            + float(stabilisation.position_gain) * self.by_position[pose]
        )


def check_step(model: Model, method: Method, drive=None) -> float | None:
    """Largest stable step [s] of a fixed-step method (None for adaptive and implicit ones, and
    for "auto").

    **Raises:** `InputError` if the method's step is larger.
    """
    if method.implicit:
        return None
    if method.step is None:
        return None
    limit = largest_stable_step(model, method, drive)
    if method.step > limit:
        raise InputError(
            f"Argument `step` must be at most {round_down(limit)} s for the method {method.name!r} to be "
            f"stable on this mechanism, but is {method.step:g} s; reduce it, use fewer rfes, or take "
            "another method."
        )
    return limit


def round_down(value: float) -> str:
    """Three digits, rounded down."""
    exponent = int(np.floor(np.log10(value)))
    return f"{np.floor(value / 10.0**exponent * 100.0) / 100.0:g}e{exponent:+03d}"


def largest_stable_step(model: Model, method: Method, drive=None) -> float:
    """Largest step [s] at which no mode grows faster than it does in truth, at any position."""
    linear = linearise(model, drive)
    frequency = [np.abs(_eigenvalues(linear.base[pose])).max() for pose in range(len(linear.base))]
    limit = 20.0 / max(*frequency, 1e-300)
    for pose in np.argsort(frequency)[::-1]:
        if _stable(model, method, linear, pose, limit):
            continue
        low, high = 0.0, limit
        while high - low > 1e-3 * high:
            middle = 0.5 * (low + high) if low > 0.0 else 0.5 * high
            if middle < 1e-6 * limit:
                break
            stable = _stable(model, method, linear, pose, middle)
            low, high = (middle, high) if stable else (low, middle)
        limit = low
    return limit


def linearise(model: Model, drive=None) -> Linearised:
    """Slopes of the accelerations at rest, undeformed, over a turn of the driven joint."""
    poses = _poses(model)
    prescribed = isinstance(drive, PrescribedDrive)
    slopes = _slopes(model, jnp.asarray(poses), prescribed)
    return Linearised(*(np.asarray(part) for part in slopes))


def eigenvalues(model: Model, drive=None) -> np.ndarray:
    """Eigenvalues [rad/s] of the linearised model at its start, without stabilisation."""
    return _eigenvalues(linearise(model, drive).base[0])


def _poses(model: Model) -> np.ndarray:
    """Angles (positions, links) of closed nominal geometries, start first."""
    start = np.asarray(model.start_angles)
    driven = model.topology.driven
    if driven is None:
        return start[None]
    poses, angles = [start], start
    for turn in np.arange(1, POSITIONS) * 2.0 * np.pi / POSITIONS:
        guess = np.array(angles)
        guess[driven] = start[driven] + turn
        angles, residual, alignment, _ = close_at(model, guess)
        # A crank that cannot turn all the way round: the positions up to its limit count.
        if np.abs(residual).max(initial=0.0) > CLOSING_TOLERANCE or (alignment < 0.0).any():
            break
        poses.append(angles)
    return np.stack(poses)


@eqx.filter_jit
def _slopes(model: Model, poses, prescribed: bool):
    realised = realise(model, assembly_errors(model))
    topology = model.topology
    elastic = jnp.zeros((6, topology.n_rfes))

    def slope(angles, gains):
        position = Coordinates(angles, elastic)
        rest = State(position, jax.tree.map(jnp.zeros_like, position))
        flat, unravel = ravel_pytree(rest)
        drive = DriveInput()
        if prescribed:
            zero = jnp.zeros(())
            drive = DriveInput(turn=(angles[topology.driven], zero, zero))

        def rate(flat):
            state = impose(topology, unravel(flat), drive)
            stabilisation = Stabilisation(gains[0], gains[1], length_scale(model))
            result = accelerations(realised, state, drive, stabilisation)
            return ravel_pytree(result.coordinates)[0]

        return jax.jacfwd(rate)(flat)

    gains = jnp.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    slopes = jax.lax.map(
        lambda angles: jax.lax.map(lambda gain: slope(angles, gain), gains), poses
    )
    return slopes[:, 0], slopes[:, 1] - slopes[:, 0], slopes[:, 2] - slopes[:, 0]


def _system(slope: np.ndarray) -> np.ndarray:
    n = slope.shape[0]
    return np.block([[np.zeros((n, n)), np.eye(n)], [slope]])


def _eigenvalues(slope: np.ndarray) -> np.ndarray:
    return np.linalg.eigvals(_system(slope))


def _stable(model: Model, method: Method, linear: Linearised, pose: int, step: float) -> bool:
    trial = Method(method.name, step=step, stabilisation=method.stabilisation)
    slope = linear.at(pose, stabilisation_of(model, trial))
    values = _eigenvalues(slope)
    if method.name == "leapfrog":
        growth = np.abs(np.linalg.eigvals(_leapfrog_amplification(slope, step))).max()
        true = np.exp(step * max(values.real.max(), 0.0))
        return bool(growth <= true * (1.0 + GROWTH_TOLERANCE))
    growth = np.abs(_stability_function(method, step * values))
    true = np.maximum(1.0, np.exp(step * values.real))
    return bool((growth <= true * (1.0 + GROWTH_TOLERANCE)).all())


def _stability_function(method: Method, z: np.ndarray) -> np.ndarray:
    """R(z) of an explicit Runge-Kutta method."""
    if method.name == "rk4":
        return 1.0 + z * (1.0 + z / 2.0 * (1.0 + z / 3.0 * (1.0 + z / 4.0)))
    tableau = make_solver(method).tableau
    if isinstance(tableau, diffrax.MultiButcherTableau):
        tableau = tableau.tableaus[0]
    weights = np.asarray(tableau.b_sol)
    stages = []
    for row in [np.zeros(0), *tableau.a_lower]:
        stages.append(1.0 + z * sum(a * k for a, k in zip(np.asarray(row), stages)))
    return 1.0 + z * sum(b * k for b, k in zip(weights, stages))


def _leapfrog_amplification(slope: np.ndarray, h: float) -> np.ndarray:
    """Matrix of one step of `Leapfrog` on (q, v, a_before) of the linear system."""
    n = slope.shape[0]
    one, none = np.eye(n), np.zeros((n, n))
    by_position, by_rate = slope[:, :n], slope[:, n:]
    half = np.hstack([one, 0.5 * h * one, none])
    predicted = np.hstack([none, one, 0.5 * h * one])
    acceleration = by_position @ half + by_rate @ predicted
    velocity = np.hstack([none, one, none]) + h * acceleration
    return np.vstack([half + 0.5 * h * velocity, velocity, acceleration])
