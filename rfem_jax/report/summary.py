"""The numbers of a study, picked out of its runs once for tables, files and bar charts.

Place in the pipeline: after `rfem_jax.simulation.run_cases`; what it returns is the `cases` part
of `results.json` with NaN still in it.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

from rfem_jax.description.metric_catalogue import metric_of
from rfem_jax.description.study import Study
from rfem_jax.report.annotations import Run, Summaries
from rfem_jax.report.driven_motions_report import drive_quantities, has_driven_joint
from rfem_jax.report.quantities import BALANCES, DRIVEN_JOINT, FRICTION_LOSS, JOINT_METRICS

PLOTS_HINT = 'No pictures were drawn: matplotlib is not installed (pip install "rfem_jax[plots]").'


def joint_names(study: Study) -> tuple[str, ...]:
    """Names of all joints, cut ones included, in the order of the description."""
    return tuple(joint.name for joint in study.mechanism.joints)


def study_note(study: Study) -> str:
    """What a reader must know about the study's data, or "" (a study may carry a `note`)."""
    return getattr(study, "note", None) or ""


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
        row |= {q.name: float(getattr(run.metrics, q.name)[name]) for q in JOINT_METRICS}
        row["preload_force"] = [float(v) for v in np.asarray(run.preload[name].force)]
        row["preload_moment"] = [float(v) for v in np.asarray(run.preload[name].moment)]
        joints[name] = row
    driven = has_driven_joint(study)
    ends = {q.name: float(getattr(run.driven_joint, q.name)) if driven else float("nan") for q in DRIVEN_JOINT}
    balances = {q.name: float(getattr(run, q.name)) for q in BALANCES}
    losses = {name: float(np.asarray(values)[-1]) for name, values in run.friction_losses.items()}
    friction = {FRICTION_LOSS.name: losses} if losses else {}
    summary = {"joints": joints, "driven_joint": ends, **friction, **balances, "branch": branches(run)}
    if study.metrics:
        summary["metrics"] = {name: float(metric_of(run, name)) for name in study.metrics}
    for one in drive_quantities(study):
        of_drive = summary.setdefault("drives", {}).setdefault(one.label, {})
        of_drive[one.end.name] = float(one.values(run)[-1])
    return summary


def branches(run: Run) -> dict[str, dict[str, int]]:
    """{cut joint: {"start", "end": assembly mode +1 or -1 (0: none is told), "changes": changes of it}}.

    Runs whose branches differ are not to be averaged, nor differentiated across.
    """
    found = {}
    for name, modes in run.branch.items():
        modes = np.asarray(modes)
        modes = modes[np.isfinite(modes)]
        if len(modes):
            found[name] = {
                "start": int(modes[0]),
                "end": int(modes[-1]),
                "changes": int(np.count_nonzero(np.diff(modes))),
            }
    return found


def summarise(study: Study, runs: Mapping[str, Run], statuses: Mapping[str, tuple[str, str]]) -> Summaries:
    """Summary of every case.

    Arguments:
        study: the study as loaded (`.cases`, `.mechanism`, `.drive`).
        runs: {case name: run of NumPy arrays}.
        statuses: {case name: (short name, full message)}; the short name of success is "ok".

    Returns {case name: {"status", "message", "errors", "joints", "driven_joint", balances}}, with "drives" where
    several drives act or one on a translation, in the order of the study; numbers are floats in SI units, NaN where a
    run has no value.
    """
    summaries = {}
    for case in study.cases:
        status, message = statuses[case.name]
        summaries[case.name] = {
            "status": status,
            "message": message,
            "errors": {name: float(value) for name, value in case.errors.items()},
            **summarise_run(study, runs[case.name]),
        }
    return summaries


def reference_case(study: Study) -> str:
    """Name of the case the others are compared with: the first one without errors, or the first."""
    for case in study.cases:
        if not any(case.errors.values()):
            return case.name
    return study.cases[0].name
