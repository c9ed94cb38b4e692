"""Largest stable step of a fixed-step method, estimated before a simulation.

Place in the pipeline: model, method -> **stability** -> simulation, or a refusal.

The modes of vibration about rest, at the start and at positions over a revolution of each driven one, and the decay
of closure errors by Baumgarte's terms, are tested with the stability function of the method (Runge-Kutta) or with
the amplification matrix of each mode (leapfrog): theory (11.6), (11.7).
"""

from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Complex

from rfem_jax.description.basics.errors import InputError
from rfem_jax.description.methods import Leapfrog, Method, RungeKutta4
from rfem_jax.mechanics.forces.friction import require_implicit
from rfem_jax.mechanics.model.discretisation import CLOSING_TOLERANCE, close_at
from rfem_jax.mechanics.model.model import Model
from rfem_jax.simulation.system.driving import Drive, prescribed_coordinates, require_driven
from rfem_jax.simulation.system.stabilisation import stabilisation_of
from rfem_jax.simulation.vibrations.vibration import Modes, Vibration

LONGEST_STEP = 1e9  # s, of a mechanism without any stiffness
POSITIONS = 12  # over a revolution of the driven joint
GROWTH_TOLERANCE = 1e-6  # of the amplification in one step, relative


def check_step(model: Model, method: Method, drive: Drive = None) -> float | None:
    """Largest stable step [s] of a fixed-step method. None for adaptive and implicit methods, for "auto", and for a
    method from outside of this package that is not a Runge-Kutta method of diffrax, whose stability is unknown.

    **Raises:** `InputError` if the method's step is larger, and for a drive of a joint that is not the driven one.
    """
    require_implicit(model, method.name, method.implicit or method.name == "auto")
    if method.implicit or method.step is None or not _stability_known(method):
        return None
    limit = largest_stable_step(model, method, drive)
    if limit == 0.0:
        raise InputError(
            f"Argument `method` must be stable at some step, but {method.name!r} is not on this mechanism; "
            "reduce `stabilisation`, add damping to the material, or take another method."
        )
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


def largest_stable_step(model: Model, method: Method, drive: Drive = None) -> float:
    """Largest step [s] at which no mode grows faster than its exact solution, at any position; 0 if every step is too
    long.

    **Raises:** `InputError` for a drive of a joint that is not the driven one.
    """
    require_driven(model, drive)
    vibration = Vibration(model, prescribed_coordinates(model.topology, drive))
    vibrations = [vibration.modes(joints) for joints in _poses(model)]
    values = [modes.eigenvalues() for modes in vibrations]
    frequency = [np.abs(of_one).max() for of_one in values]
    limit = min(20.0 / max(*frequency, 1e-300), LONGEST_STEP)
    for pose in np.argsort(frequency)[::-1]:

        def stable(step, modes=vibrations[pose], values=values[pose]):
            return _stable(model, method, modes, values, step)

        if stable(limit):
            continue
        low, high = 0.0, limit
        while high - low > 1e-3 * high:
            middle = 0.5 * (low + high) if low > 0.0 else 0.5 * high
            if middle < 1e-6 * limit:
                break
            low, high = (middle, high) if stable(middle) else (low, middle)
        limit = low
        if limit == 0.0:
            break
    return limit


def eigenvalues(model: Model, drive: Drive = None) -> Complex[np.ndarray, " eigenvalues"]:
    """Eigenvalues [rad/s] of the linearised model at its start, without stabilisation.

    **Raises:** `InputError` for a drive of another joint than the driven one.
    """
    require_driven(model, drive)
    vibration = Vibration(model, prescribed_coordinates(model.topology, drive))
    return vibration.modes(np.asarray(model.start_joints)).eigenvalues()


def _poses(model: Model) -> np.ndarray:
    """Positions of the joints (poses, numbers) of closed nominal geometries, start first: over a revolution of every
    driven angle that assembly holds, the others at their start."""
    start, topology = np.asarray(model.start_joints), model.topology
    poses = [start]
    for k in topology.held:
        joints, driven = start, topology.place_of(k)
        if topology.slides[k]:
            continue
        for rotation in np.arange(1, POSITIONS) * 2.0 * np.pi / POSITIONS:
            guess = np.array(joints)
            guess[driven] = start[driven] + rotation
            joints, residual, alignment, _ = close_at(model, guess)
            # A crank that cannot make a full revolution: the positions up to its limit count.
            if np.abs(residual).max(initial=0.0) > CLOSING_TOLERANCE or (alignment < 0.0).any():
                break
            poses.append(joints)
    return np.stack(poses)


def _stable(model: Model, method: Method, modes: Modes, values: np.ndarray, step: float) -> bool:
    trial = replace(method, step=step)
    if model.topology.n_constraints:
        rate = np.sqrt(float(stabilisation_of(model, trial).position_gain))
        modes, values = _with_gaps(modes, rate), np.append(values, -rate)
    if method.name == "leapfrog":
        growth = np.abs(np.linalg.eigvals(_leapfrog_amplification(modes, step))).max()
        true = np.exp(step * max(np.real(values).max(), 0.0))
        return bool(growth <= true * (1.0 + GROWTH_TOLERANCE))
    growth = np.abs(_stability_function(method, step * values))
    true = np.maximum(1.0, np.exp(step * np.real(values)))
    return bool((growth <= true * (1.0 + GROWTH_TOLERANCE)).all())


def _with_gaps(modes: Modes, rate: float) -> Modes:
    """The modes and the decay of closure errors, Phi'' = -2 rate Phi' - rate^2 Phi, as one more mode: it is decoupled
    from the others, in which Phi = 0."""
    squares = np.append(modes.squares, rate**2)
    if modes.damping.ndim == 1:
        return Modes(squares, np.append(modes.damping, 2.0 * rate))
    damping = np.pad(modes.damping, (0, 1))
    damping[-1, -1] = 2.0 * rate
    return Modes(squares, damping)


def _stability_known(method: Method) -> bool:
    return type(method) in (RungeKutta4, Leapfrog) or _tableau(method) is not None


def _tableau(method: Method) -> Any:
    """Coefficients of a Runge-Kutta method of diffrax; None for any other method."""
    # Imported here, since most checks do not need it and it takes long.
    import diffrax

    from rfem_jax.simulation.solvers.catalogue import make_solver

    solver = make_solver(method)
    return solver.tableau if isinstance(solver, diffrax.AbstractERK) else None


def _stability_function(method: Method, z: np.ndarray) -> np.ndarray:
    """R(z) of an explicit Runge-Kutta method."""
    if method.name == "rk4":
        return 1.0 + z * (1.0 + z / 2.0 * (1.0 + z / 3.0 * (1.0 + z / 4.0)))
    import diffrax

    tableau = _tableau(method)
    if tableau is None:
        raise InputError(
            f"Argument `method` must be a Runge-Kutta method for its largest stable step, but {method.name!r} is not "
            "one; try steps."
        )
    if isinstance(tableau, diffrax.MultiButcherTableau):
        tableau = tableau.tableaus[0]
    weights = np.asarray(tableau.b_sol)
    stages = []
    for row in [np.zeros(0), *tableau.a_lower]:
        stages.append(1.0 + z * sum(a * k for a, k in zip(np.asarray(row), stages)))
    return 1.0 + z * sum(b * k for b, k in zip(weights, stages))


def _leapfrog_amplification(modes: Modes, h: float) -> np.ndarray:
    """Matrices of one step of `LeapfrogSolver` for (q, v, a_before): one a mode, or one of all coupled modes."""
    if modes.damping.ndim == 1:
        by_position, by_rate = -modes.squares[:, None, None], -modes.damping[:, None, None]
    else:
        by_position, by_rate = -np.diag(modes.squares), -modes.damping
    n = by_position.shape[-1]
    identity, zeros = np.eye(n), np.zeros((n, n))
    half = np.hstack([identity, 0.5 * h * identity, zeros])
    predicted = np.hstack([zeros, identity, 0.5 * h * identity])
    acceleration = by_position @ half + by_rate @ predicted
    velocity = np.hstack([zeros, identity, zeros]) + h * acceleration
    return np.concatenate([half + 0.5 * h * velocity, velocity, acceleration], axis=-2)
