"""The method that "auto" stands for: the longest step that keeps the wanted accuracy.

Place in the pipeline: model, drive, duration, accuracy -> **method** -> cases, Problem.

RMS loads of trial assemblies are compared between a step and half of it.  The implicit method is of order
2, so four thirds of the change estimate the error of the longer step (theory (11.3), (11.4)).  One compiled
program serves all steps.  Where no step is good enough (undamped vibrations, whose phase decides forces)
Runge-Kutta 4 at nine tenths of its largest stable step is taken.
"""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from rfem_jax.compilation.program import Program
from rfem_jax.description.errors import InputError
from rfem_jax.description.methods import Method
from rfem_jax.mechanics.model import Model
from rfem_jax.mechanics.realisation import AssemblyErrors, assembly_errors
from rfem_jax.mechanics.status import OK
from rfem_jax.simulation import integration
from rfem_jax.simulation.generalised_alpha import ACCURACY_OF_TOLERANCE
from rfem_jax.simulation.stability import largest_stable_step, round_down

DEFAULT_ACCURACY = 1e-3
TRIAL_INTERVALS = 50
FIRST, LAST = 2, 256  # steps an interval
# A joint that carries less than this share of the largest load is judged by that share.
SMALL_LOAD = 0.05
SMALL_MOMENT = 0.01  # the same of forces times lengths
TRIAL_TILT, TRIAL_SHIFT = 2e-3, 5e-4  # rad; of the longest link


def choose_method(
    model: Model,
    method: Method,
    drive=None,
    duration: float | None = None,
    errors: AssemblyErrors | None = None,
    save_every: float | None = None,
) -> Method:
    """The method itself, or, for "auto", the one that it stands for on this mechanism.

    **Arguments:** `duration` [s] of the simulation; `errors`: trial assemblies, one along a first axis of
    every leaf (None: the perfect one, and one with all joints tilted and shifted); `save_every` [s]: saved times are
    ends of steps, so no step is longer.

    **Raises:** `InputError` if "auto" is given without a duration.
    """
    if method.name != "auto":
        return method
    if duration is None:
        raise InputError(
            'Argument `duration` must be given to choose a method for "auto", but is missing; add the '
            "duration of the simulation in seconds."
        )
    accuracy = DEFAULT_ACCURACY if method.accuracy is None else method.accuracy
    implicit = Method("generalised_alpha", step=duration, tolerance=accuracy / ACCURACY_OF_TOLERANCE)
    longest = duration if save_every is None else min(duration, save_every)
    step = _longest_step(model, implicit, drive, duration, accuracy, errors)
    if step is not None:
        return replace(implicit, step=min(float(round_down(step)), longest))
    trial = Method("rk4", step=1e-6, stabilisation=method.stabilisation)
    limit = 0.9 * largest_stable_step(model, trial, drive)
    # Rigid links have no limit, but what was not accurate enough for the implicit method is none for this one.
    limit = min(limit, duration / TRIAL_INTERVALS / LAST)
    return replace(trial, step=min(float(round_down(limit)), longest))


def _longest_step(model, method: Method, drive, duration, accuracy, errors) -> float | None:
    errors = _trial_errors(model) if errors is None else errors
    length = float(np.max(np.asarray(model.length)))
    interval = duration / TRIAL_INTERVALS
    method = replace(method, step=interval)
    grid, _ = integration.grid_for(drive, duration, method, interval)

    def loads(steps):
        # Traced: one program for all steps.
        count = jnp.asarray(steps, jnp.float64)
        loads, residual, assembled = map(np.asarray, rms_loads(model, errors, drive, grid, method, count))
        # Errors that rigid links cannot give way to say nothing of a step.
        used = assembled if assembled.any() else np.ones_like(assembled)
        return loads[used], residual[used].max()

    steps, (before, _) = FIRST, loads(FIRST)
    while steps < LAST:
        steps *= 2
        now, residual = loads(steps)
        error = 4.0 / 3.0 * estimate_change(before, now, length)
        if error <= accuracy and residual <= accuracy:
            longer = min(np.sqrt(accuracy / max(error, 1e-300)), 2.0)
            return 0.9 * longer * interval / (steps / 2)
        before = now
    return None


def estimate_change(one: np.ndarray, other: np.ndarray, length: float) -> float:
    """Largest change of RMS forces and moments (cases, 2, joints) relative to the load, or, in a joint that carries
    little, to a twentieth of the largest of its kind; moments at least to a hundredth of the largest force times
    `length` [m], since a planar mechanism has none; infinite where one is not finite."""
    largest = np.abs(other).max(axis=(0, 2), keepdims=True)
    scale = np.maximum(np.abs(other), SMALL_LOAD * largest)
    scale[:, 1] = np.maximum(scale[:, 1], SMALL_MOMENT * length * largest[:, 0])
    change = np.abs(one - other) / np.where(scale > 0.0, scale, 1.0)
    return float(change.max()) if np.isfinite(change).all() else np.inf


def _trial_errors(model: Model) -> AssemblyErrors:
    perfect = assembly_errors(model)
    length = float(np.max(np.asarray(model.length)))
    size = np.array([TRIAL_TILT, TRIAL_TILT, *[TRIAL_SHIFT * length] * 3])
    signs = 1.0 - 2.0 * (np.indices(perfect.seat.shape).sum(axis=0) % 2)
    flawed = eqx.tree_at(lambda e: e.seat, perfect, jnp.asarray(size[:, None] * signs))
    return jax.tree.map(lambda a, b: jnp.stack([a, b]), perfect, flawed)


@Program
def rms_loads(model, errors, drive, grid, method, steps):
    """RMS loads (cases, 2, joints), the largest share of a load that was left over and whether it was assembled, by
    case; `errors`: `AssemblyErrors` or {name: values (cases,)}."""

    def one(errors):
        if not isinstance(errors, AssemblyErrors):
            errors = assembly_errors(model, errors)
        prepared = integration.prepare(model, errors, drive, None)
        carry = integration.start_carry(model, prepared, drive, method)
        carry = integration.advance_unobserved(
            model, prepared.realised, drive, carry, grid, method, steps
        )
        metrics = integration.metrics_of(model, carry, grid.starts[-1] + grid.lengths[-1])
        force = jnp.stack(list(metrics.rms_force.values()))
        moment = jnp.stack(list(metrics.rms_moment.values()))
        largest = integration.largest_force(carry)
        residual = carry.residual / jnp.where(largest > 0.0, largest, 1.0)
        return jnp.stack([force, moment]), residual, prepared.status == OK

    return jax.vmap(one)(errors)
