"""What a simulation ends with as arrays over all joints, and the `Run` with a name for each of them.

Place in the pipeline: records, carry -> **conclusion** -> Run.

The arrays are what is compiled; giving each joint its own is no computation, and is done outside of programs.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Float, Int

from rfem_jax.mechanics.dynamics import loads
from rfem_jax.mechanics.model.model import Coordinates, Model
from rfem_jax.mechanics.model.orientations import angles_of
from rfem_jax.mechanics.statics.assembly import Load, named
from rfem_jax.mechanics.statics.designs import Designed, status_of
from rfem_jax.simulation.outcome.observation import Record
from rfem_jax.simulation.outcome.run import (
    Checks,
    DriveHistory,
    LoadIntegrals,
    Loads,
    Metrics,
    Motion,
    PointPath,
    Run,
    of_model,
)
from rfem_jax.simulation.stages.stepping import Carry
from rfem_jax.simulation.system import equations
from rfem_jax.simulation.system.equations import Numbers, Scalar


class LoadSummary(NamedTuple):
    """Loads of all joints over the whole duration: mean squares of the resultant force [N^2] and moment [(N m)^2],
    their RMS values, and maxima of the axial, the normal and the resultant force [N] (the first two NaN without an
    axis) and of the resultant moment [N m]."""

    mean_squares: Float[Numbers, "2 joints"]
    rms: Float[Numbers, "2 joints"]
    highest: Float[Numbers, "4 joints"]


class Conclusion(NamedTuple):
    """Results of a simulation by index; `run_of` makes a `Run` with names of them.

    record: at the saved `times` [s]; ball_angles: rotation vectors (times, 3)
    [rad] of tree joints that turn about any axis, by link; the others as fields of `Run`.
    """

    times: Float[Numbers, " times"]
    record: Record
    preload: loads.JointLoads
    summary: LoadSummary
    checks: Checks
    status: Int[Numbers, ""]
    contact_changes: Float[Numbers, ""] | None
    ball_angles: dict[int, Float[Numbers, "times 3"]]
    centre_lines: Mapping[str, Float[Numbers, "points 3"]]
    nominal_lines: Mapping[str, Float[Numbers, "points 3"]]
    recorded: dict[str, Any]
    positions: Coordinates


def load_summary(model: Model, carry: Carry, duration: Scalar) -> LoadSummary:
    """Mean squares, RMS values and maxima over a duration [s]."""
    integrals = carry.trajectory.integrals
    force = (integrals.axial_square + integrals.normal_square) / duration
    mean = jnp.stack([force, integrals.moment_square / duration])
    highest = equations.safe_sqrt(carry.peaks)
    without_axis = [model.topology.kind(j).axis is None for j in range(len(model.topology.joints))]
    if any(without_axis):
        unknown = np.array([without_axis, without_axis, *([[False] * len(without_axis)] * 2)])
        highest = jnp.where(unknown, jnp.nan, highest)
    return LoadSummary(mean, equations.safe_sqrt(mean), highest)


def ball_angles(model: Model, joints: Float[Numbers, "times numbers"]) -> dict[int, Float[Numbers, "times 3"]]:
    """Rotation vectors [rad] of tree joints that turn about any axis, by link."""
    topology = model.topology
    balls = {l: at for l, at in enumerate(topology.positions) if topology.kind(l).ball}
    return {l: angles_of(jnp.asarray(joints[:, at.stop - 4 : at.stop])) for l, at in balls.items()}


def run_of(model: Model, conclusion: Conclusion) -> Run:
    """The run with its arrays by the names of joints, links and drives; of NumPy's arrays where these are NumPy's."""
    leaves = jax.tree.leaves(conclusion)
    if any(isinstance(x, Tracer) for x in leaves):
        return _compiled(model, conclusion)
    # NumPy's slices are views; each of JAX's would be a program of its own.
    run = _named_results(model, jax.tree.map(np.asarray, conclusion))
    if all(isinstance(x, np.ndarray) for x in leaves):
        return jax.tree.map(np.asarray, run)  # with names in the order in which JAX returns them
    return jax.device_put(run)


def _named_results(model: Model, conclusion: Conclusion) -> Run:
    times, record, topology = conclusion.times, conclusion.record, model.topology
    drives = _histories(model, record)
    nothing = DriveHistory(0.0 * times, 0.0 * times, record.drive_forces[0])
    first = next(iter(drives.values()), nothing)
    motion = Motion(
        angle=first.position,
        rate=first.rate,
        drive_moment=first.force,
        drives=drives,
        angles=joint_coordinates(model, record.joints, conclusion.ball_angles, rotation=True),
        displacements=joint_coordinates(model, record.joints, conclusion.ball_angles, rotation=False),
        ends={name: record.ends[..., l] for l, name in enumerate(model.link_names)},
        branch={topology.joints[j]: record.branch[..., i] for i, j in enumerate(topology.cuts)},
        centre_lines=dict(conclusion.centre_lines),
        nominal_lines=dict(conclusion.nominal_lines),
        positions=conclusion.positions,
    )
    places = zip(model.joint_names, joint_places(model))
    return Run(
        times=times,
        loads=Loads({name: Load(*(part[..., j] for part in record.loads)) for name, j in places}),
        preload=named(model, conclusion.preload),
        metrics=load_metrics(model, conclusion.summary),
        motion=motion,
        energy=record.energy,
        checks=conclusion.checks,
        status=conclusion.status,
        integrals=LoadIntegrals(*(_joint_values(model, record.square_integrals[..., kind, :]) for kind in range(2))),
        forces=record.forces,
        friction_losses=_friction_histories(model, record.friction_losses),
        contacts=record.contacts,
        contact_losses=_clearance_histories(model, record.contact_losses),
        contact_changes=conclusion.contact_changes,
        couplings=record.couplings,
        points={name: PointPath.of(one, model.topology.plane) for name, one in record.points.items()},
        recorded=conclusion.recorded,
    )


_compiled = eqx.filter_jit(_named_results)


def load_metrics(model: Model, summary: LoadSummary) -> Metrics:
    """Metrics of the loads by the names of the joints."""
    force, moment = (_joint_values(model, summary.mean_squares[..., kind, :]) for kind in range(2))
    rms_force, rms_moment = (_joint_values(model, summary.rms[..., kind, :]) for kind in range(2))
    return Metrics(
        force,
        moment,
        rms_force,
        rms_moment,
        *(_joint_values(model, summary.highest[..., kind, :]) for kind in range(4)),
    )


def joint_coordinates(
    model: Model,
    joints: Float[Numbers, "*batch numbers"],
    of_balls: dict[int, Float[Numbers, "*batch 3"]],
    rotation: bool,
) -> dict[str, Float[Numbers, "times ..."]]:
    """Angles or displacements by tree joint: (times,), or (times, k) of a kind that has several; `of_balls`: as of
    `ball_angles`."""
    by_joint, topology = {}, model.topology
    for l, own in enumerate(topology.own_positions):
        if rotation and l in of_balls:
            by_joint[topology.joints[l]] = of_balls[l]
            continue
        freedoms = topology.kind(l).nominal.freedoms
        wanted = [k for k, freedom in zip(own, freedoms) if freedom.rotation is rotation]
        if wanted:
            by_joint[topology.joints[l]] = joints[..., np.array(wanted)] if len(wanted) > 1 else joints[..., wanted[0]]
    return by_joint


def _histories(model: Model, record: Record) -> dict[str, DriveHistory]:
    """Position, rate and force of every driven coordinate, by its name."""
    topology, histories = model.topology, {}
    for label, k, force in zip(topology.drive_labels, topology.drives, record.drive_forces):
        histories[label] = DriveHistory(record.joints[..., topology.place_of(k)], record.joint_rates[..., k], force)
    return histories


def _friction_histories(
    model: Model, values: Float[Numbers, "times frictions"] | None
) -> dict[str, Float[Numbers, " times"]]:
    """Histories by the names of the frictions."""
    if values is None:
        return {}
    return {name: values[..., i] for i, name in enumerate(sorted(model.friction or {}))}


def _clearance_histories(
    model: Model, values: Float[Numbers, "times clearances"] | None
) -> dict[str, Float[Numbers, " times"]]:
    """Histories by the names of the joints with clearance."""
    if values is None:
        return {}
    return {model.topology.joints[j]: values[..., i] for i, j in enumerate(model.topology.clearances)}


def _joint_values(model: Model, values: Float[Numbers, "*axes joints"]) -> dict[str, Float[Numbers, "*axes"]]:
    return {name: values[..., j] for name, j in zip(model.joint_names, joint_places(model))}


def joint_places(model: Model) -> np.ndarray:
    """Places of the joints along the axes of joints, in the order of the description."""
    return np.array([model.topology.joints.index(name) for name in model.joint_names])


def run_of_design(made: Designed, conclusion: Conclusion) -> Run:
    """The run with the model and the errors that were simulated."""
    return with_status(of_model(run_of(made.model, conclusion), made.model, made.errors), made)


def with_status(run: Run, made: Designed) -> Run:
    """The run of a design that may not be possible, which its status then says."""
    if made.status is None:
        return run
    checks = dataclasses.replace(run.checks, design_gap=made.gap)
    return dataclasses.replace(run, status=status_of(jnp.asarray(run.status), made), checks=checks)
