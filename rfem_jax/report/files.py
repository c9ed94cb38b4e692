"""The files of a run: `results.json` and one CSV of time histories per case.

Place in the pipeline: after `summary`; written by `output`.

CSV columns: `time_s`; `angle_rad`, `rate_rad_s` of the driven joint; energies `_J`; then for each
joint `A_force_x_N` ... `A_moment_z_Nm` in its frame H (y along a hinge); `drive_moment_Nm`; the coordinates of the
joints of the tree that are not revolute, `G_displacement_m`, `U_angle_1_rad`; and last the energy that every friction
has dissipated, `bearing_dissipation_J`.
"""

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path

import numpy as np
from jaxtyping import Float

from rfem_jax.compilation.keeping import state
from rfem_jax.description.study import Study
from rfem_jax.report.annotations import Run, Summaries
from rfem_jax.report.output import replacing, write_json
from rfem_jax.report.quantities import ENERGIES, column_name, units
from rfem_jax.report.summary import joint_names, study_note, total_energy


def write_results(path: str | Path, study: Study, summaries: Summaries) -> Path:
    """Write `results.json`; `summaries` as `rfem_jax.report.summary.summarise` returns them."""
    content = {
        "title": study.title,
        "note": study_note(study) or None,
        "duration": study.duration,
        "driven_joint": None if study.drive is None else study.drive.joint,
        "method": asdict(study.method),
        "cases": summaries,
        "compilation": state(),
        "units": {"duration": "s", **units()},
    }
    return write_json(path, content)


def history_columns(study: Study, run: Run) -> dict[str, Float[np.ndarray, " times"]]:
    """Time histories of one run, {column name with unit: (T,) array}, in the order of the CSV."""
    times = np.asarray(run.times)
    columns = {
        column_name("time", "s"): times,
        column_name("angle", "rad"): np.asarray(run.angle),
        column_name("rate", "rad/s"): np.asarray(run.rate),
    }
    for quantity in ENERGIES:
        is_total = quantity.name == "total"
        values = total_energy(run) if is_total else np.asarray(getattr(run.energy, quantity.name))
        columns[column_name(quantity.name, quantity.unit)] = values
    for name in joint_names(study):
        for load, unit in (("force", "N"), ("moment", "N m")):
            values = np.asarray(getattr(run.loads[name], load))
            for axis, letter in enumerate("xyz"):
                columns[column_name(f"{name}_{load}_{letter}", unit)] = values[:, axis]
    columns[column_name("drive_moment", "N m")] = np.asarray(run.drive_moment)
    losses = {column_name(f"{name}_dissipation", "J"): np.asarray(x) for name, x in run.friction_losses.items()}
    return columns | _coordinate_columns(study, run) | losses


def _coordinate_columns(study: Study, run: Run) -> dict[str, Float[np.ndarray, " times"]]:
    """Coordinates of the tree joints that are not revolute, numbered where a joint has several of one dimension."""
    columns = {}
    for joint in study.mechanism.joints:
        if joint.cut or joint.kind == "revolute":
            continue
        for what, unit, values in (("angle", "rad", run.angles), ("displacement", "m", run.displacements)):
            several = np.asarray(values[joint.name]) if joint.name in values else np.zeros((0, 0))
            if several.ndim == 1:
                columns[column_name(f"{joint.name}_{what}", unit)] = several
            else:
                columns |= {
                    column_name(f"{joint.name}_{what}_{n}", unit): one for n, one in enumerate(several.T, start=1)
                }
    return columns


def write_history(path: str | Path, study: Study, run: Run) -> Path:
    """Write the time histories of one run as CSV (12 digits, one row per saved time)."""
    columns = history_columns(study, run)
    table = np.stack(list(columns.values()), axis=1)
    with replacing(path) as temporary:
        np.savetxt(temporary, table, fmt="%.12g", delimiter=",", header=",".join(columns), comments="")
    return Path(path)


def write_files(folder: str | Path, study: Study, runs: Mapping[str, Run], summaries: Summaries) -> list[Path]:
    """Write `results.json` and `<case>.csv` of every case into `folder`; returns their paths."""
    folder = Path(folder)
    written = [write_results(folder / "results.json", study, summaries)]
    for case in study.cases:
        written.append(write_history(folder / f"{case.name}.csv", study, runs[case.name]))
    return written
