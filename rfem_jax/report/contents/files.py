"""The files of a run: `results.json` and one CSV of time histories per case.

Place in the pipeline: after `summary`; written by `output`.

CSV columns: `time_s`; `angle_rad`, `rate_rad_s` of the driven joint; energies `_J`; then for each
joint `A_force_x_N` ... `A_moment_z_Nm` in its frame H (y along a hinge, x along a guide); `drive_moment_Nm`; and last
the coordinates of the other joints of the tree, `D_angle_rad`, `G_displacement_m`, `U_angle_1_rad`. Where
several drives act, or one on a translation, they have columns of their own, `A_drive_angle_rad`,
`A_drive_rate_rad_s`, `A_drive_moment_Nm`, `G_drive_displacement_m`, `G_drive_speed_m_s`, `G_drive_force_N`, in the
place of `drive_moment_Nm`; `angle_rad` and `rate_rad_s` are then those of the first drive, if it turns a joint.  Last
of all the forces at points in global axes: `coil_length_m`, `coil_tension_N` of a spring, `push_force_x_N` ...,
`twist_moment_x_Nm` ... of others; of points whose paths are followed `P_x_m`, `P_velocity_x_m_s`,
`P_acceleration_x_m_s2` and `P_angle_x_rad` ...; and the energy that every friction has dissipated,
`bearing_dissipation_J`; of joints with clearance `D_penetration_start_m`, `..._end_m`, `..._axial_m` (below zero a
gap) and `D_contact_force_start_N` ...; of couplings `mesh_first_moment_Nm`, `mesh_second_force_N`, along their two
coordinates, and `mesh_deflection_m`; where the study asks for it, what the mechanism exerts on its base,
`shaking_force_x_N` ... `shaking_moment_z_Nm` in global axes; and with `--axes` the loads of all joints in other axes,
`A_force_global_x_N` ...
"""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float

from rfem_jax.compilation.keeping import state
from rfem_jax.description.basics.joint_kinds import KINDS
from rfem_jax.description.mechanism.couplings import Coupling
from rfem_jax.description.mechanism.point_forces import LoadOnLink
from rfem_jax.description.metrics.catalogue import notes_on, unit_of
from rfem_jax.description.metrics.shaking_metrics import RECORD
from rfem_jax.description.study_file.study import Study
from rfem_jax.mechanics.forces.bush_contacts import CONTACT_NAMES, ContactState
from rfem_jax.mechanics.model.discretisation import start_held
from rfem_jax.mechanics.statics.assembly import Load
from rfem_jax.report.contents.annotations import CouplingHistory, Run, StartHeld, Summaries
from rfem_jax.report.contents.driven_motions_report import drive_quantities
from rfem_jax.report.contents.output import csv_cell, write_json
from rfem_jax.report.contents.summary import joint_names, reaction_norm, study_note, total_energy
from rfem_jax.simulation.outcome.quantities import ENERGIES, column_name, units
from rfem_jax.whole_files import replacing


def start_of(runs: Mapping[str, Run]) -> StartHeld | None:
    """What the start of the runs of one study held; None where that is not known."""
    model = next(iter(runs.values())).model
    return None if model is None else start_held(model.topology)


def write_results(path: str | Path, study: Study, summaries: Summaries, start: StartHeld | None = None) -> Path:
    """Write `results.json`; `summaries` as `summarise` of `summary` returns them; `start`: of all cases."""
    driven = drive_quantities(study)
    content = {
        "title": study.title,
        "note": study_note(study) or None,
        "duration": study.duration,
        "driven_joint": study.drives[0].joint if study.drives else None,
        "method": study.method.as_table(),
        **({} if start is None else {"start": start._asdict()}),
        **({"design": study.design_values} if study.design_values else {}),
        **reaction_norm(study),
        "cases": summaries,
        "compilation": state(),
        "units": {"duration": "s", **units(), **{one.end.name: one.end.unit for one in driven}},
    }
    if study.metrics:
        content["units"]["metrics"] = {name: unit_of(name) or "1" for name in study.metrics}
        content["metric_notes"] = notes_on(study.metrics)
    if driven:
        content["drives"] = list(study.drive_labels)
    return write_json(path, content)


def history_columns(study: Study, run: Run) -> dict[str, Float[np.ndarray, " times"]]:
    """Time histories of one run, {column name with unit: (T,) array}, in the order of the CSV."""
    times = np.asarray(run.times)
    columns, driven = {column_name("time", "s"): times}, drive_quantities(study)
    columns |= _first_angle(study, run)
    for quantity in ENERGIES:
        is_total = quantity.name == "total"
        values = total_energy(run) if is_total else np.asarray(getattr(run.energy, quantity.name))
        columns[column_name(quantity.name, quantity.unit)] = values
    for name in joint_names(study):
        for load, unit in (("force", "N"), ("moment", "N m")):
            values = np.asarray(getattr(run.loads[name], load))
            for axis, letter in enumerate("xyz"):
                columns[column_name(f"{name}_{load}_{letter}", unit)] = values[:, axis]
    if not driven:
        columns[column_name("drive_moment", "N m")] = np.asarray(run.motion.drive_moment)
    columns |= {column_name(one.name, one.quantity.unit): one.values(run) for one in driven}
    losses = {column_name(f"{name}_dissipation", "J"): np.asarray(x) for name, x in run.friction_losses.items()}
    losses |= {column_name(f"{joint}_contact_loss", "J"): np.asarray(x) for joint, x in run.contact_losses.items()}
    return (
        columns | _coordinate_columns(study, run) | _point_columns(study, run) | path_columns(run) | losses
        | contact_columns(run.contacts) | coupling_columns(study, run.couplings) | shaking_columns(run)
    )  # fmt: skip


def _first_angle(study: Study, run: Run) -> dict[str, Float[np.ndarray, " times"]]:
    """Angle and rate of the first drive, unless it is one on a translation; of the run where nothing is driven."""
    angle, rate = run.motion.angle, run.motion.rate
    if drive_quantities(study):
        if not study.drive_motions[0].startswith("R"):
            return {}
        first = run.motion.drives[study.drive_labels[0]]
        angle, rate = first.position, first.rate
    return {column_name("angle", "rad"): np.asarray(angle), column_name("rate", "rad/s"): np.asarray(rate)}


def _point_columns(study: Study, run: Run) -> dict[str, Float[np.ndarray, " times"]]:
    """Length and tension of springs between points; components of the forces and moments at points and along links."""
    columns = {}
    for force in study.mechanism.point_forces:
        history = run.forces[force.name]
        if isinstance(force, LoadOnLink):
            values = np.asarray(getattr(history, force.dimension))
            for letter, one in zip("xyz", values.T, strict=True):
                columns[column_name(f"{force.name}_{force.dimension}_{letter}", force.unit)] = one
        else:
            columns[column_name(f"{force.name}_length", "m")] = np.asarray(history.length)
            columns[column_name(f"{force.name}_tension", "N")] = np.asarray(history.tension)
    return columns


def path_columns(run: Run) -> dict[str, Float[np.ndarray, " times"]]:
    """Place, velocity and acceleration of the points whose paths are followed, and angles of their links."""
    columns = {}
    for name, path in run.points.items():
        for what, unit, values in (
            ("", "m", path.position),
            ("velocity_", "m/s", path.velocity),
            ("acceleration_", "m/s^2", path.acceleration),
            ("angle_", "rad", path.angles),
        ):
            for axis, one in zip("xyz", np.asarray(values).T, strict=True):
                columns[column_name(f"{name}_{what}{axis}", unit)] = one
    return columns


def coupling_columns(study: Study, couplings: Mapping[str, CouplingHistory]) -> dict[str, Float[np.ndarray, " times"]]:
    """Loads along the two coordinates of every coupling, and the deflection of its mesh at the second one."""
    columns = {}
    for coupling in study.mechanism.couplings:
        history = couplings[coupling.name]
        columns |= coupling_load_columns(coupling, np.asarray(history.loads))
        unit = "rad" if coupling.turns[1] else "m"
        columns[column_name(f"{coupling.name}_deflection", unit)] = np.asarray(history.deflection)
    return columns


def coupling_load_columns(
    coupling: Coupling, loads: Float[np.ndarray, "rows 2"]
) -> dict[str, Float[np.ndarray, " rows"]]:
    """Loads of a coupling along its two coordinates, each a moment or a force."""
    columns = {}
    for side, turns, values in zip(("first", "second"), coupling.turns, loads.T, strict=True):
        what, unit = ("moment", "N m") if turns else ("force", "N")
        columns[column_name(f"{coupling.name}_{side}_{what}", unit)] = values
    return columns


def contact_columns(states: Mapping[str, ContactState]) -> dict[str, Float[np.ndarray, " times"]]:
    """Penetrations, below zero gaps, and normal forces of all contacts, by the joints with clearance."""
    columns = {}
    for joint, contacts in states.items():
        for what, unit, values in (
            ("penetration", "m", contacts.penetration),
            ("contact_force", "N", contacts.normal_force),
        ):
            for name, one in zip(CONTACT_NAMES, np.asarray(values).T, strict=True):
                columns[column_name(f"{joint}_{what}_{name}", unit)] = one
    return columns


def shaking_columns(run: Run) -> dict[str, Float[np.ndarray, " times"]]:
    """Force of the mechanism on its base and its moment, where the run has them, in global axes."""
    columns = {}
    if RECORD in run.recorded:
        for load, unit in (("force", "N"), ("moment", "N m")):
            for letter, values in zip("xyz", np.asarray(getattr(run.recorded[RECORD], load)).T, strict=True):
                columns[column_name(f"{RECORD}_{load}_{letter}", unit)] = values
    return columns


def _coordinate_columns(study: Study, run: Run) -> dict[str, Float[np.ndarray, " times"]]:
    """Coordinates of the tree joints, numbered where a joint has several of one dimension, but that of a hinge which
    the first drive turns."""
    columns = {}
    first = study.drives[0].joint if study.drives else None
    for joint in study.mechanism.joints:
        if joint.cut or (joint.name == first and KINDS[joint.kind].motions == ("R_y",)):
            continue
        for what, unit, values in (
            ("angle", "rad", run.motion.angles),
            ("displacement", "m", run.motion.displacements),
        ):
            several = np.asarray(values[joint.name]) if joint.name in values else np.zeros((0, 0))
            if several.ndim == 1:
                columns[column_name(f"{joint.name}_{what}", unit)] = several
            else:
                columns |= {
                    column_name(f"{joint.name}_{what}_{n}", unit): one for n, one in enumerate(several.T, start=1)
                }
    return columns


def axes_columns(study: Study, loads: Mapping[str, Load], axes: str) -> dict[str, Float[np.ndarray, " times"]]:
    """Loads of all joints in axes that the names of the columns say."""
    columns = {}
    for name in joint_names(study):
        for load, unit in (("force", "N"), ("moment", "N m")):
            for letter, values in zip("xyz", np.asarray(getattr(loads[name], load)).T, strict=True):
                columns[column_name(f"{name}_{load}_{axes}_{letter}", unit)] = values
    return columns


def write_history(path: str | Path, study: Study, run: Run, axes: str = "joint") -> Path:
    """Write the time histories of one run as CSV (12 digits, one row per saved time); `axes`: as of `write_files`."""
    columns = history_columns(study, run)
    if axes != "joint":
        columns |= axes_columns(study, run.loads_in(axes), axes)
    table = np.stack(list(columns.values()), axis=1)
    header = ",".join(map(csv_cell, columns))
    with replacing(path) as temporary, open(temporary, "w", encoding="utf-8", newline="\n") as file:
        np.savetxt(file, table, fmt="%.12g", delimiter=",", header=header, comments="")
    return Path(path)


def write_files(
    folder: str | Path,
    study: Study,
    runs: Mapping[str, Run],
    summaries: Summaries,
    start: StartHeld | None = None,
    axes: str = "joint",
) -> list[Path]:
    """Write `results.json`, with what the `start` held, and `<case>.csv` of every case into `folder`, with the loads in
    further `axes` (`Run.loads_in`) besides; returns their paths."""
    folder = Path(folder)
    written = [write_results(folder / "results.json", study, summaries, start)]
    for case in study.cases:
        written.append(write_history(folder / f"{case.name}.csv", study, runs[case.name], axes))
    return written
