"""The method that "auto" stands for: the longest step that keeps the wanted accuracy.

Place in the pipeline: model, drive, duration, accuracy -> **method** -> cases, Problem.

RMS loads of trial assemblies are compared between a step and half of it.  The implicit method is of order 2, so
four thirds of the change estimate the error of the longer step (Richardson; theory (11.3), (11.4)).  The static starts
are found once; one program serves all steps.  Where no step is accurate enough (undamped vibrations, on whose phase
forces depend) Runge-Kutta 4 is taken, at nine tenths of its largest stable step.
"""

import functools
from collections.abc import Mapping
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from rfem_jax.compilation.program import Program
from rfem_jax.description.basics.errors import InputError
from rfem_jax.description.methods import DEFAULT_ACCURACY, Automatic, GeneralisedAlpha, Method, RungeKutta4
from rfem_jax.mechanics.dynamics.energy_and_momentum import has_tables_over_position
from rfem_jax.mechanics.forces.friction import require_implicit
from rfem_jax.mechanics.model.errors import AssemblyErrors, Deviations, Errors, assembly_errors
from rfem_jax.mechanics.model.model import Model
from rfem_jax.mechanics.model.status import OK
from rfem_jax.simulation.outcome.remarks import REMARKABLE_BALANCE
from rfem_jax.simulation.solvers.generalised_alpha import ACCURACY_OF_TOLERANCE
from rfem_jax.simulation.stages import balances, integration
from rfem_jax.simulation.stages.conclusion import joint_places, load_summary
from rfem_jax.simulation.stages.integration import Prepared
from rfem_jax.simulation.stages.stepping import Carry, Integration
from rfem_jax.simulation.system.driving import Drive, require_driven
from rfem_jax.simulation.system.sampled_laws import steps_that_see
from rfem_jax.simulation.system.time_grid import ROUNDING, TimeGrid
from rfem_jax.simulation.vibrations.stability import largest_stable_step, round_down

TRIAL_INTERVALS = 50
FIRST, LAST = 2, 256  # steps in an interval
# Changes are relative to the load of the joint, but at least to this share of the largest load of its kind.
SMALL_LOAD = 0.05
SMALL_MOMENT = 0.01  # likewise of the largest force times the longest link
# Where the slope of a force jumps, as at a stop, errors depend on where in a step it is met, and a step and its half
# may agree by chance: further numbers of steps are tried, these times as many.
UNEVEN = (1.125, 1.3125)
HALVINGS = 3  # of an explicit step that is checked
ENERGY = 5e-3  # error of the energy balance that is always good enough
TRIAL_TILT, TRIAL_SHIFT = 2e-3, 5e-4  # rad; shares of the longest link


def choose_method(
    model: Model,
    method: Method,
    drive: Drive = None,
    duration: float | None = None,
    errors: Errors | None = None,
    save_every: float | None = None,
) -> Method:
    """The method itself, or, for "auto", the one that it stands for on this mechanism.

    **Arguments:** `duration` [s] of the simulation; `errors`: trial assemblies along a first axis of every leaf, or
    {error name: their values (n,)}, of which parameters and numbers of drives are left out (None: the perfect one, and
    one with all joints tilted and shifted); `save_every` [s]: saved times are ends of steps, so no step is longer.

    Trial steps go by factors of two, so that a slightly different mechanism may get a step that is longer or shorter
    by a factor of up to about two and a half (docs/theory/11_accuracy.md); both keep the accuracy.

    **Raises:** `InputError` if "auto" is given without a duration, or with a drive of another than the driven joint.
    """
    if not isinstance(method, Automatic):
        return method
    if duration is None:
        raise InputError(
            'Argument `duration` must be given to choose a method for "auto", but is missing; add the '
            "duration of the simulation in seconds."
        )
    require_driven(model, drive)
    accuracy = DEFAULT_ACCURACY if method.accuracy is None else method.accuracy
    implicit = GeneralisedAlpha(step=duration, tolerance=accuracy / ACCURACY_OF_TOLERANCE)
    longest = duration if save_every is None else min(duration, save_every)
    step = _longest_step(model, implicit, drive, duration, accuracy, errors)
    if step is None and isinstance(errors, Mapping):  # of samples, any may fail with all steps
        step = _longest_step(model, implicit, drive, duration, accuracy, None)
    if step is not None:
        step = min(float(round_down(step)), longest)
        return replace(implicit, step=step, steps_per_row=_steps_per_row(model, implicit, drive, duration, step))
    require_implicit(
        model,
        "auto",
        implicit=False,
        fix="no step that is tried with the implicit method keeps the accuracy; give generalised_alpha with a `step`.",
    )
    if model.topology.clearances:
        raise InputError(
            'Argument `method` must be "generalised_alpha" with a `step` here, but is "auto", which finds none: loads '
            "change with all that are tried. Pins strike their bushes, and after a few impacts motion is chaotic; take "
            "a step for the mechanism without clearance: contacts are followed, and statistics of batches hold."
        )
    trial = RungeKutta4(step=1e-6, stabilisation=method.stabilisation)
    limit = 0.9 * largest_stable_step(model, trial, drive)
    # Rigid links have no limit, and a stop that is not touched at rest sets none; but no step is longer than those that
    # were not accurate enough with the implicit method.
    tried = min(limit, longest, duration / TRIAL_INTERVALS / LAST)
    if tried < limit or has_tables_over_position(model):
        tried = _explicit_step(model, replace(trial, step=tried), drive, duration, accuracy, errors)
    return replace(trial, step=float(round_down(tried)))


def _longest_step(model, method: Method, drive, duration, accuracy, errors) -> float | None:
    errors = _assemblies(model, errors)
    length = float(np.max(np.asarray(model.length)))
    method, grid = _trial_grid(model, method, drive, duration)
    interval = duration / TRIAL_INTERVALS
    first = _first_steps(model, drive, grid, interval)
    whole = Integration(model, drive, grid, method, jnp.asarray(1.0, jnp.float64))
    prepared, carry = integration.prepare_batch(whole, errors)

    def loads(steps):
        found = loads_of_trials(_trial(whole, steps, interval), prepared, carry)
        loads, residual, energy, assembled = map(np.asarray, found)
        # Trial errors that rigid links cannot be assembled with say nothing about the step.
        used = assembled if assembled.any() else np.ones_like(assembled)
        return loads[used], residual[used].max(), energy[used].max()

    share_of_energy = accuracy / min(max(accuracy, ENERGY), REMARKABLE_BALANCE)
    steps, (before, _, energy), error = first, loads(first), None
    while steps < LAST:
        steps *= 2
        now, residual, finer_energy = loads(steps)
        error, longer_step = 4.0 / 3.0 * estimate_change(before, now, length), error
        error = max(error, share_of_energy * (energy if np.isfinite(energy) else np.inf))
        if error <= accuracy and residual <= accuracy:
            if not has_tables_over_position(model):
                return 0.9 * _longer(error, longer_step, accuracy) * interval / (steps / 2)
            if all(estimate_change(loads(share * steps / 2)[0], now, length) <= accuracy for share in UNEVEN):
                return interval / (steps / 2)
        before, energy = now, finer_energy
    return None


def _first_steps(model: Model, drive: Drive, grid: TimeGrid, interval: float) -> int:
    """Number of steps in an interval [s] of the first trial: such that no peak of a function of time lies between two.

    **Raises:** `InputError` for a function whose peak would lie between steps of all trials.
    """
    seen = steps_that_see(model, drive, grid, LAST // 2)
    if seen is None:
        raise InputError(
            f"Argument `drive` must be a function that changes slowly enough for steps of {interval / LAST:.3g} s, the "
            'shortest that "auto" tries, but it (or a force that is a function of time) has a narrower peak; give the '
            "times around it as `breakpoints`, give a table, or take a method with a `step`."
        )
    return max(seen, FIRST)


def _trial_grid(model: Model, method: Method, drive: Drive, duration: float) -> tuple[Method, TimeGrid]:
    """Method and intervals of the trials."""
    interval = duration / TRIAL_INTERVALS
    method = replace(method, step=interval)
    return method, integration.grid_for(drive, duration, method, interval, model)[0]


def _trial(whole: Integration, steps: int, interval: float) -> Integration:
    """The integration by a number of steps, which are half as long as with half the number everywhere."""
    grid = whole.grid.with_steps_per_row(steps // FIRST)
    share = 1.0 if grid.parts is None else float(grid.distinct.max()) / interval
    return replace(whole, grid=grid, steps=jnp.asarray(share * steps, jnp.float64))  # traced: one program for all steps


def _steps_per_row(model: Model, method: Method, drive: Drive, duration: float, step: float) -> int | None:
    """Number of steps between two rows of a table that goes with a step [s], as in the trials; None where no interval
    of these is cut."""
    if _trial_grid(model, method, drive, duration)[1].parts is None:
        return None
    return int(np.ceil(duration / TRIAL_INTERVALS / FIRST / step * (1.0 - ROUNDING)))


def _explicit_step(model, method: Method, drive, duration, accuracy, errors) -> float:
    """The step of an explicit method, or the longest half, quarter, ... of it with which loads and energies are as
    accurate as asked for, in so far as `HALVINGS` reach that: after several impacts no step may do."""
    assert method.step is not None, "it was given"
    errors, interval = _assemblies(model, errors), duration / TRIAL_INTERVALS
    length, steps = float(np.max(np.asarray(model.length))), int(np.ceil(interval / method.step * (1.0 - ROUNDING)))
    grid, _ = integration.grid_for(drive, duration, method, interval, model)
    share = 1.0 if grid.parts is None else float(grid.distinct.max()) / interval
    whole = Integration(model, drive, grid.of_any_step(), method, jnp.asarray(1.0, jnp.float64))
    prepared, carry = integration.prepare_batch(whole, errors)

    def loads(steps):
        trial = replace(whole, steps=jnp.asarray(share * steps, jnp.float64))
        found = loads_of_trials(trial, prepared, carry)
        loads, _, energy, assembled = map(np.asarray, found)
        used = assembled if assembled.any() else np.ones_like(assembled)
        return loads[used], energy[used].max()

    for _ in range(HALVINGS):
        fine, _ = loads(2 * steps)
        tried = [loads(steps), *(loads(np.ceil(share * steps)) for share in UNEVEN)]
        errors_of_loads = [estimate_change(found, fine, length) for found, _ in tried]
        if max(errors_of_loads) <= accuracy and max(energy for _, energy in tried) <= max(accuracy, ENERGY):
            break
        steps *= 2
    return interval / steps


def _longer(error: float, error_of_twice: float | None, accuracy: float) -> float:
    """Factor by which a step may be longer than one whose `error` is below the accuracy; at most two. Between the two
    steps the error grows by the order that was observed, if that is above the method's: vibrations become resolved."""
    error = max(error, 1e-300)
    order = 2.0 if error_of_twice is None else max(2.0, float(np.log2(max(error_of_twice, error) / error)))
    return min((accuracy / error) ** (1.0 / order), 2.0)


def _assemblies(model: Model, errors: Errors | None) -> AssemblyErrors:
    if isinstance(errors, Deviations):
        return errors.errors
    if isinstance(errors, AssemblyErrors):
        return errors
    given = (errors or {}).items()
    known = {name: jnp.asarray(value, jnp.float64) for name, value in given if name in model.topology.error_names}
    return _errors_of(model, known) if known else trial_errors(model)


@functools.partial(Program, nameless=True)
def _errors_of(model: Model, known: dict[str, Float[Array, " cases"]]) -> AssemblyErrors:
    """A batch of errors by their names."""
    return jax.vmap(lambda one: assembly_errors(model, one))(known)


def estimate_change(
    one: Float[np.ndarray, "cases 2 joints"], other: Float[np.ndarray, "cases 2 joints"], length: float
) -> float:
    """Largest relative change of RMS forces [N] and moments [N m].

    Each is relative to the load of its joint, but at least to a twentieth of the largest load of its kind, and moments
    at least to a hundredth of the largest force times `length` [m], since a planar mechanism has none.  Infinite where
    a load is not finite.
    """
    largest = np.abs(other).max(axis=(0, 2), keepdims=True)
    scale = np.maximum(np.abs(other), SMALL_LOAD * largest)
    scale[:, 1] = np.maximum(scale[:, 1], SMALL_MOMENT * length * largest[:, 0])
    change = np.abs(one - other) / np.where(scale > 0.0, scale, 1.0)
    return float(change.max()) if np.isfinite(change).all() else np.inf


def trial_errors(model: Model) -> AssemblyErrors:
    """Two assemblies that a step is chosen with: without errors, and with tilts and shifts of all seats, those that a
    joint's free motions do not make good."""
    perfect, topology = assembly_errors(model), model.topology
    shift = TRIAL_SHIFT * float(np.max(np.asarray(model.length)))
    names = topology.error_components
    size = np.array([shift if name.startswith("d_") else TRIAL_TILT for name in names])
    signs = 1.0 - 2.0 * (np.indices(perfect.seat.shape).sum(axis=0) % 2)
    has = np.array(
        [[name in topology.kind(j).errors(child=False) for j in range(perfect.seat.shape[1])] for name in names]
    )
    flawed = eqx.tree_at(lambda e: e.seat, perfect, jnp.asarray(np.where(has, size[:, None] * signs, 0.0), jnp.float64))
    return jax.tree.map(lambda a, b: jnp.asarray(np.stack([a, b]), a.dtype), perfect, flawed)


@functools.partial(Program, nameless=True)
def loads_of_trials(
    trial: Integration, prepared: Prepared, carry: Carry
) -> tuple[Float[Array, "cases 2 joints"], Float[Array, " cases"], Float[Array, " cases"], Bool[Array, " cases"]]:
    """RMS forces [N] and moments [N m] of several assemblies, from what `prepare_batch` gives.

    **Returns:** the loads; the largest residual over the largest joint force; the error of the energy balance; whether
    the mechanism was assembled.
    """
    return jax.vmap(jax.jit(lambda prepared, carry: _loads_of(trial, prepared, carry)))(prepared, carry)


def _loads_of(trial: Integration, prepared: Prepared, carry: Carry):
    model, grid = trial.model, trial.grid
    carry, energy = integration.advance_unobserved(trial, prepared.actual, carry)
    rms = load_summary(model, carry, grid.starts[-1] + grid.lengths[-1]).rms[:, joint_places(model)]
    largest = balances.force_or_moment(model, balances.largest_force(carry), jnp.max(rms[1]))
    residual = carry.residual / jnp.where(largest > 0.0, largest, 1.0)
    balance = balances.balance_error(model, energy, largest)
    return rms, residual, balance, prepared.status == OK
