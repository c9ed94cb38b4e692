"""The steady cycle of a mechanism whose drive turns at a constant rate: a motion that repeats with every revolution.

Place in the pipeline: integration -> **cycle**.

A revolution maps the state at its start to that at its end; the cycle is a fixed point of this map, with angles counted
modulo a revolution. Material damping makes the map a contraction in all but its slowest modes, so that revolutions one
after another converge; Anderson's acceleration (theory (11.18); D. G. Anderson, J. ACM 12 (1965) 547-560) takes out
the slow ones.
"""

from collections.abc import Iterable
from dataclasses import replace
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.flatten_util import ravel_pytree
from jaxtyping import Float

from rfem_jax.compilation.program import Program
from rfem_jax.description.basics.errors import InputError
from rfem_jax.description.drives.driven_motions import each_drive
from rfem_jax.description.drives.rotations import PrescribedRate
from rfem_jax.mechanics.dynamics.point_paths import PointMotion
from rfem_jax.mechanics.laws.point_laws import changing
from rfem_jax.mechanics.model.errors import Errors
from rfem_jax.mechanics.model.model import Model, State
from rfem_jax.mechanics.model.topology import Topology
from rfem_jax.mechanics.statics.designs import Design, designed
from rfem_jax.simulation.outcome.records import PerfectPath, asks_perfect_path, require_records
from rfem_jax.simulation.outcome.run import Run
from rfem_jax.simulation.specification import Simulation, simulation_of_call
from rfem_jax.simulation.stages import integration
from rfem_jax.simulation.stages.conclusion import Conclusion, run_of_design
from rfem_jax.simulation.stages.stepping import Integration
from rfem_jax.simulation.system.driving import Drive, drive_of_design, require_driven

RANK = 1e-9  # of what a revolution leaves of changes of its start
MEMORY = 6  # revolutions that the next start is made of


class Cycle(eqx.Module):
    """A steady cycle.

    run: one revolution of it, whose metrics are without a start-up; start: its state; residual: largest change over the
    revolution of the links' deflections and of their rates, each relative to the largest of its kind; revolutions that
    were simulated; converged: whether the residual is within the tolerance; perfect: paths of the points in the cycle
    without errors, if a record asks for them.
    """

    run: Run
    start: State
    residual: float
    revolutions: int
    converged: bool
    perfect: dict[str, PerfectPath] = eqx.field(default_factory=dict)


def steady_cycle(
    simulation: Simulation | Model | None = None,
    errors: Errors | None = None,
    *,
    tolerance: float = 1e-6,
    most: int = 200,
    record: str | Iterable[str] = (),
    **former: Any,
) -> Cycle:
    """The steady cycle of a mechanism that is driven at a constant rate.

    **Arguments:** `simulation`: its drive a `PrescribedRate` about a hinge, without a rise; its duration is not used;
    `tolerance` of the residual; `most`: revolutions that are simulated at most; `record`: as of `simulate`. Not
    differentiable: `cycle_run` is. A model in place of the simulation, with `former` arguments, is the call of an
    earlier version, which warns.

    **Raises:** `InputError` for another drive, for forces that are functions of time, and for joints of the tree that
    turn about any axis.
    """
    simulation = simulation_of_call("steady_cycle", simulation, former)
    _require_sensible(simulation, tolerance, most)
    model, method, design = simulation.model, simulation.chosen, simulation.design
    drive, period = _with_period(model, require_constant_rate(model, simulation.drive), design)
    grid, steps = integration.grid_for(drive, period, method, simulation.save_every, model)
    made = designed(model, design, errors)
    model, errors = made.model, made.errors
    asked, revolution = require_records(model, record), Integration(model, drive, grid, method, steps)
    perfect = _perfect_paths(simulation, tolerance, most) if asks_perfect_path(asked) else {}
    state, conclusion = _revolution(revolution, errors, None, asked, perfect)
    # Beside the drive, which begins at its start: couplings count whole revolutions.
    start, pairs = _turned_back(model.topology, _nominal_start(model), state), []
    residual, done = np.inf, 1
    while done < most:
        state, conclusion = _revolution(revolution, errors, start, asked, perfect)
        done += 1
        before = _numbers(start)
        after = _numbers(_turned_back(model.topology, start, state))
        residual = _residual(model.topology, start, state)
        if not np.isfinite(residual) or residual <= tolerance:
            break
        pairs = [*pairs, (before, after)][-MEMORY:]
        start = _state(start, _mixed(pairs))
    return Cycle(run_of_design(made, conclusion), start, float(residual), done, bool(residual <= tolerance), perfect)


def _perfect_paths(simulation: Simulation, tolerance: float, most: int) -> dict[str, PerfectPath]:
    """Paths of the points in the cycle of the mechanism without errors."""
    run = steady_cycle(simulation, tolerance=tolerance, most=most).run
    return {
        name: PerfectPath(PointMotion(*(getattr(path, part) for part in PointMotion._fields)), run.motion.angle,
                          run.motion.rate)
        for name, path in run.points.items()
    }  # fmt: skip


def cycle_run(
    cycle: Cycle,
    simulation: Simulation | Model | None = None,
    errors: Errors | None = None,
    *,
    record: str | Iterable[str] = (),
    **former: Any,
) -> Run:
    """One revolution of a steady cycle as a function of the errors and the design, about those it was found for.

    **Arguments:** `cycle`, from `steady_cycle` with the same numbers; the others as of `steady_cycle`; errors and
    design may be traced, but not the rate of the drive.

    **Returns:** `Run`, equal to `cycle.run` within its residual. Works under jit, vmap, forward and reverse mode: start
    of the cycle and all loads change as the periodic motion does (theory (11.19)); first derivatives only.
    """
    simulation = simulation_of_call("cycle_run", simulation, former)
    model, method, design = simulation.model, simulation.chosen, simulation.design
    drive, period = _with_period(model, require_constant_rate(model, simulation.drive), design)
    grid, steps = integration.grid_for(drive, period, method, simulation.save_every, model)
    made = designed(model, design, errors)
    asked = require_records(model, record)
    if asks_perfect_path(asked) and not cycle.perfect:
        raise InputError(
            "Argument `record` of `cycle_run` asks for paths of the perfect mechanism, which the cycle does not have; "
            "give `steady_cycle` the same `record`."
        )
    revolution = Integration(made.model, drive, grid, method, steps)
    conclusion = _periodic(revolution, made.errors, cycle.start, asked, cycle.perfect)
    return run_of_design(made, conclusion)


@partial(Program, nameless=True)
def _periodic(revolution: Integration, errors, start: State, asked, perfect) -> Conclusion:
    numbers, unravel = ravel_pytree(jax.lax.stop_gradient(start))

    def end_of(numbers, model, errors):
        state = _revolution(replace(revolution, model=model), errors, unravel(numbers), asked, perfect)[0]
        return ravel_pytree(state)[0]

    model = revolution.model
    fixed = jax.lax.stop_gradient((model, errors))
    _, push = jax.linearize(lambda x: end_of(x, *fixed), numbers)
    kept = jnp.eye(numbers.shape[0]) - jax.vmap(push, out_axes=1)(jnp.eye(numbers.shape[0]))
    end = end_of(numbers, model, errors)
    # Where a revolution changes nothing, as of the driven angle, the start stays: the solution of least norm.
    change = jnp.linalg.pinv(kept, rtol=RANK) @ (end - jax.lax.stop_gradient(end))
    return _revolution(revolution, errors, unravel(numbers + change), asked, perfect)[1]


def _with_period(model: Model, drive: PrescribedRate, design: Design | None) -> tuple[PrescribedRate, float]:
    """The drive with the rate that a design sets, and the period of a revolution [s]."""
    if design is not None and design.drives:
        if any(isinstance(rate, Tracer) for rate in design.drives.values()):
            raise InputError(
                "Argument `design` of a cycle must set a rate of the drive that is known, but it is traced, and the "
                "period follows from it; find a cycle for each rate."
            )
        (designed_drive,) = each_drive(drive_of_design(model, drive, design))
        assert isinstance(designed_drive, PrescribedRate), "its kind stays"
        drive = designed_drive
    return drive, abs(2.0 * np.pi / float(drive.rate))


def _require_sensible(simulation: Simulation, tolerance: float, most: int) -> None:
    """Raise InputError for a simulation with a start (a cycle finds its own), and for a tolerance or a number of
    revolutions with which no search ends."""
    if simulation.start is not None:
        raise InputError(
            "Argument `start` of a cycle's simulation must be left out, but is a State; a cycle finds its own start."
        )
    if not tolerance > 0.0:
        raise InputError(f"Argument `tolerance` must be greater than 0, but is {tolerance}; the default is 1e-6.")
    if not isinstance(most, int) or most < 2:
        raise InputError(f"Argument `most` must be a whole number of at least 2, but is {most}; the default is 200.")


def require_constant_rate(model: Model, drive: Drive) -> PrescribedRate:
    """The drive. Raises InputError for a drive or a model without a cycle that can be found here."""
    if not isinstance(drive, PrescribedRate) or drive.rise_time > 0.0:
        raise InputError(
            f"Argument `drive` of a cycle must be a PrescribedRate without a rise time, but is {drive!r}; give the "
            "constant rate alone."
        )
    require_driven(model, drive)
    if changing(model.vectors_of_time):
        raise InputError(
            "Argument `model` of a cycle must have forces that do not depend on time, but one does; leave it out, or "
            "simulate several revolutions."
        )
    if model.topology.balls:
        raise InputError(
            "Argument `model` of a cycle must have joints with angles and displacements in the tree, but one turns "
            "about any axis; cut that joint."
        )
    return drive


@partial(Program, nameless=True)
def _revolution(revolution: Integration, errors, start: State | None, asked, perfect) -> tuple[State, Conclusion]:
    prepared = integration.prepare(revolution.model, errors, revolution.drive, start)
    carry, ends = integration.advance(revolution, prepared.actual, integration.start_carry(revolution, prepared))
    conclusion = integration.conclude(revolution, prepared, carry, ends, asked, perfect)
    return State(carry.trajectory.position, carry.trajectory.velocity), conclusion


def _nominal_start(model: Model) -> State:
    position = model.start_coordinates()
    return State(position, jax.tree.map(jnp.zeros_like, position))


def _turned_back(topology: Topology, start: State, end: State) -> State:
    """The end of a revolution with angles less whole revolutions."""
    angles = ~np.array(topology.slides, dtype=bool)
    change = np.asarray(end.position.joints) - np.asarray(start.position.joints)
    whole = np.where(angles, 2.0 * np.pi * np.round(change / (2.0 * np.pi)), 0.0)
    return eqx.tree_at(lambda s: s.position.joints, end, end.position.joints - whole)


def _residual(topology: Topology, start: State, end: State) -> float:
    """Largest change of displacements, angles and their rates over a revolution, each over the largest of its kind; of
    joints where no link is flexible, whole revolutions counted in what is the largest alone."""

    def parts(state: State):
        both = state.position, state.velocity
        if topology.n_rfes == 0:
            return [np.asarray(one.joints) for one in both]
        return [np.asarray(rows) for one in both for rows in (one.elastic[:3], one.elastic[3:])]

    three = zip(parts(start), parts(_turned_back(topology, start, end)), parts(end), strict=True)
    return max(float(np.abs(b - a).max() / max(np.abs(whole).max(), 1e-300)) for a, b, whole in three)


def _numbers(state: State) -> Float[np.ndarray, " n"]:
    return np.concatenate([np.ravel(part) for part in jax.tree.leaves(state)])


def _state(like: State, numbers: Float[np.ndarray, " n"]) -> State:
    leaves, tree = jax.tree.flatten(like)
    parts = np.split(numbers, np.cumsum([leaf.size for leaf in leaves])[:-1])
    made = [jnp.asarray(part.reshape(leaf.shape)) for part, leaf in zip(parts, leaves, strict=True)]
    return jax.tree.unflatten(tree, made)


def _mixed(pairs: list[tuple[np.ndarray, np.ndarray]]) -> Float[np.ndarray, " n"]:
    """The next start by Anderson's acceleration of starts and ends of the last revolutions."""
    starts, ends = (np.array(part) for part in zip(*pairs, strict=True))
    if len(pairs) == 1:
        return ends[-1]
    # Entries relative to their size: rates are larger than deflections by the frequency.
    size = np.maximum(np.abs(ends).max(axis=0), 1e-12 * np.abs(ends).max())
    residuals = (ends - starts) / size
    weights = np.linalg.lstsq(np.diff(residuals, axis=0).T, residuals[-1], rcond=1e-10)[0]
    return ends[-1] - weights @ np.diff(ends, axis=0)
