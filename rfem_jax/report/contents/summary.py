"""The numbers of a study, picked out of its runs once for tables, files and bar charts.

Place in the pipeline: after `rfem_jax.simulation.run_cases`; what it returns is the `cases` part
of `results.json` with NaN still in it.
"""

import copy
import math
from collections.abc import Mapping
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Float

from rfem_jax.description.metrics.catalogue import metric_of
from rfem_jax.description.study_file.study import Study
from rfem_jax.mechanics.forces.bush_contacts import CLOSED, CONTACT_NAMES, ContactState, carrying
from rfem_jax.mechanics.model.status import STATUS
from rfem_jax.mechanics.statics.assembly import Load
from rfem_jax.report.contents.annotations import Run, Summaries
from rfem_jax.report.contents.driven_motions_report import drive_quantities, has_driven_joint
from rfem_jax.simulation.outcome.quantities import (
    CHECKS,
    CONTACT_CHANGES,
    CONTACTS,
    DRIVEN_JOINT,
    FRICTION_LOSS,
    JOINT_METRICS,
    POSITION_END,
    RMS_COMPONENTS,
)
from rfem_jax.simulation.outcome.remarks import remarks_on

OK = STATUS[0].name
HUGE = 1e30  # of any number of a run, SI units


def joint_names(study: Study) -> tuple[str, ...]:
    """Names of all joints, cut ones included, in the order of the description."""
    return tuple(joint.name for joint in study.mechanism.joints)


def study_note(study: Study) -> str:
    """What a reader must know about the study's data, or "" (a study may carry a `note`)."""
    return getattr(study, "note", None) or ""


def reaction_norm(study: Study) -> dict[str, float]:
    """The length [m] over which moments count in the norm of redundant reactions, {} where these are refused."""
    length = study.mechanism.norm_length
    return {} if length is None else {"reaction_length": length}


def total_energy(run: Run) -> Float[np.ndarray, " times"]:
    """Kinetic + elastic + gravity energy of one run, (T,) J."""
    energy = run.energy
    return np.asarray(energy.kinetic) + np.asarray(energy.elastic) + np.asarray(energy.gravity)


def summarise_run(study: Study, run: Run) -> dict[str, Any]:
    """Metrics, preload, end of the driven joint, losses by friction where there is any, balances and branch of one run
    (numbers, SI; NaN for an axial or normal force of a joint without an axis)."""
    joints: dict[str, dict[str, Any]] = {}
    for name in joint_names(study):
        row: dict[str, Any] = {"kind": study.mechanism.joint(name).kind}
        row["preload_force"] = [float(v) for v in np.asarray(run.preload[name].force)]
        row["preload_moment"] = [float(v) for v in np.asarray(run.preload[name].moment)]
        row |= {q.name: float(getattr(run.metrics, q.name)[name]) for q in JOINT_METRICS}
        row[RMS_COMPONENTS] = _rms_components(run, run.loads[name], name)
        joints[name] = row
    driven = _driven_joints(study, run)
    ends = {q.name: driven[0].get(q.name, math.nan) if driven else math.nan for q in DRIVEN_JOINT}
    balances = {q.name: float(getattr(run.checks, q.name)) for q in CHECKS}
    losses = {name: float(np.asarray(values)[-1]) for name, values in run.friction_losses.items()}
    friction = {FRICTION_LOSS.name: losses} if losses else {}
    summary = {"joints": joints, "driven_joint": ends, "driven_joints": driven, **friction, **balances}
    summary["branch"] = branches(run)
    if run.contacts:
        summary["contacts"] = {joint: _contacts(one, run.contact_losses[joint]) for joint, one in run.contacts.items()}
    if run.contact_changes is not None:
        summary[CONTACT_CHANGES.name] = int(run.contact_changes)
    if study.metrics:
        summary["metrics"] = {name: float(metric_of(run, name)) for name in study.metrics}
    for one in drive_quantities(study):
        of_drive = summary.setdefault("drives", {}).setdefault(one.label, {})
        of_drive[one.end.name] = float(one.values(run)[-1])
    return summary


def _contacts(history: ContactState, lost: Float[Array | np.ndarray, " times"]) -> dict[str, Any]:
    """Of a joint with clearance: the contacts that carry at the start, none of a pin that floats; the numbers
    `quantities.CONTACTS` of its saved times, penetrations and forces of the contact where they are largest; `lost` [J]:
    by the contacts since the start."""
    depth, force = np.asarray(history.penetration), np.asarray(history.normal_force)
    shares = dict(zip(CONTACT_NAMES, np.mean(depth > CLOSED, axis=0).tolist()))
    values = float(depth.max()), float(force.max()), shares, float(np.asarray(lost)[-1])
    numbers = dict(zip((quantity.name for quantity in CONTACTS), values, strict=True))
    return {"carrying_at_start": list(carrying(depth[0])), **numbers}


def _driven_joints(study: Study, run: Run) -> list[dict[str, Any]]:
    """Joint and motion of every drive with `angle_end` and `rate_end`, or `position_end` and `speed_end`."""
    found = []
    for one, label, motion in zip(study.drives, study.drive_labels, study.drive_motions, strict=True):
        if has_driven_joint(study):
            position, rate = run.motion.angle_end, run.motion.rate_end
        else:
            position, rate = (np.asarray(getattr(run.motion.drives[label], part))[-1] for part in ("position", "rate"))
        names = ("angle_end", "rate_end") if motion.startswith("R") else (POSITION_END.name, "speed_end")
        ends = zip(names, (position, rate), strict=True)
        found.append({"joint": one.joint, "motion": motion, **{name: float(value) for name, value in ends}})
    return found


def _add_axes(joints: dict[str, dict[str, Any]], run: Run, axes: str) -> None:
    """Put the components of loads in further axes into the rows of the joints."""
    loads, preload = run.loads_in(axes), run.preload_in(axes)
    for name, row in joints.items():
        at_start = {f"preload_{part}": np.asarray(getattr(preload[name], part)).tolist() for part in Load._fields}
        row["in_axes"] = {"axes": axes, RMS_COMPONENTS: _rms_components(run, loads[name], name), **at_start}


def _rms_components(run: Run, loads: Any, name: str) -> dict[str, list[float]]:
    """RMS of the x, y and z of force and moment of a joint's loads; their squares add up to that of the RMS load.

    The mean square is that of the whole run, its shares are those of the saved times.
    """
    found = {}
    for load in ("force", "moment"):
        with np.errstate(invalid="ignore"):  # of a failed run
            squares = np.trapezoid(np.asarray(getattr(loads, load)) ** 2, np.asarray(run.times), axis=0)
            total = float(np.sum(squares))
            shares = squares / total if total != 0.0 else np.zeros(3)
        found[load] = [float(v) for v in float(getattr(run.metrics, f"rms_{load}")[name]) * np.sqrt(shares)]
    return found


def branches(run: Run) -> dict[str, dict[str, int]]:
    """{cut joint: {"start", "end": assembly mode +1 or -1 (0: none is told), "changes": changes of it}}.

    Runs whose branches differ are not to be averaged, nor differentiated across.
    """
    found = {}
    for name, modes in run.motion.branch.items():
        modes = np.asarray(modes)
        modes = modes[np.isfinite(modes)]
        if len(modes):
            found[name] = {
                "start": int(modes[0]),
                "end": int(modes[-1]),
                "changes": int(np.count_nonzero(np.diff(modes))),
            }
    return found


def summarise(
    study: Study, runs: Mapping[str, Run], statuses: Mapping[str, tuple[str, str]], axes: str = "joint"
) -> Summaries:
    """Summary of every case.

    Arguments:
        study: the study as loaded (`.cases`, `.mechanism`, `.drive`).
        runs: {case name: run of NumPy arrays}.
        statuses: {case name: (short name, full message)}; the short name of success is "ok".
        axes: further ones for components of loads (`Run.loads_in`).

    Returns {case name: {"status", "message", "remarks" (a list), "errors", "joints", "driven_joint", balances}}, with
    "drives" where several drives act or one on a translation, in the order of the study; numbers are floats in SI
    units, NaN where a run has no value.
    """
    summaries = {}
    for case in study.cases:
        status, message = statuses[case.name]
        summaries[case.name] = {
            "status": status,
            "message": message,
            "remarks": list(remarks_on(runs[case.name])),
            "errors": {name: float(value) for name, value in case.errors.items()},
            **summarise_run(study, runs[case.name]),
        }
        if axes != "joint":
            _add_axes(summaries[case.name]["joints"], runs[case.name], axes)
    return summaries


def readable(run: Run) -> Run:
    """The run, which if it has failed has NaN in the place of numbers that no mechanism has: infinite ones and those of
    1e200 that a run leaves when it diverges overflow in every sum and picture, and NaN is shown as missing."""
    if int(run.status) == 0:
        return run

    def shown(value):
        values = np.asarray(value)
        return np.where(np.abs(values) < HUGE, values, np.nan) if np.issubdtype(values.dtype, np.floating) else value

    found = copy.copy(run)
    for name, value in vars(run).items():
        if name not in ("model", "errors"):  # what was simulated
            object.__setattr__(found, name, jax.tree.map(shown, value))
    return found


def marked(case: str, status: str) -> str:
    """Name of a case where its numbers are shown: with an asterisk where they are not those of a complete run."""
    return case if status == OK else f"{case}*"


def in_legend(case: str, status: str) -> str:
    """Name of a case in a picture, which has no line for what the asterisk means."""
    return case if status == OK else f"{marked(case, status)} ({status.replace('_', ' ')})"


def marked_cases(summaries: Summaries) -> dict[str, str]:
    """{case: its name where its numbers are shown}."""
    return {case: marked(case, one["status"]) for case, one in summaries.items()}


def status_of(run: Run) -> str:
    """Short name of what happened to a run."""
    return STATUS[int(run.status)].name


def reference_case(study: Study) -> str:
    """Name of the case the others are compared with: the first one without errors, or the first."""
    for case in study.cases:
        if not any(case.errors.values()):
            return case.name
    return study.cases[0].name
