"""Runs as labelled data: an xarray Dataset, a table of the joints, HTML for notebooks.

Place in the pipeline: `Run.to_xarray`, `Run.to_pandas` and `Run._repr_html_`, and those of the runs of a study
(`cases.Runs`), call these.

Dimensions: `case` (of a batch), `time`, `joint`, `component` (x, y, z of the joint's frame H, of global axes for link
ends and forces at points); `pin` (of joints with clearance), its `contact` (start, end, axial), `pin_end` and
`direction` (x, z of the bush); `rotation` and `translation` for driven coordinates, `angle` and `displacement` for the
coordinates of the tree joints, `link`, `point`, `cut_joint`, `friction`, `force_at_points`, `followed_point`;
`coupling`, and of its two coordinates `coupled` (first, second). What a mechanism does not have is left out.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from rfem_jax import rich_text
from rfem_jax.description.basics.errors import InputError, require_choice
from rfem_jax.description.metrics.shaking_metrics import RECORD
from rfem_jax.labelled_data import COMPONENTS, DataFrame, Dataset, Labelled, column_name, dataset, frame
from rfem_jax.mechanics.dynamics.load_axes import AXES
from rfem_jax.mechanics.forces.bush_contacts import CONTACT_NAMES
from rfem_jax.mechanics.model.status import STATUS
from rfem_jax.simulation.outcome.quantities import (
    AT_REST,
    CHECKS,
    ENERGIES,
    HINGE_MOMENT_ERROR,
    JOINT_METRICS,
    MEAN_SQUARES,
    Quantity,
)

Run = Any  # `rfem_jax.simulation.outcome.run.Run`, which imports this module

METRICS = (*MEAN_SQUARES, *JOINT_METRICS)  # of every joint


def _labelled(quantity: Quantity, dims: tuple[str, ...], values: Any) -> Labelled:
    return Labelled(dims, values, quantity.unit or "1", quantity.label, {"description": quantity.description})


def run_dataset(run: Run, cases: Sequence[str] | None = None, axes: str = "joint") -> Dataset:
    """Everything that a run has, with named dimensions, units and long names.

    Args: run, one or a batch with one leading axis; cases, the names along it (None: their numbers); axes of the loads,
        as of `Run.loads_in`.
    Raises: InputError for a batch with several axes, and as `Run.loads_in`.
    """
    batch = np.ndim(run.status)
    if batch > 1:
        raise InputError(
            f"A batch of runs must have one axis to be labelled, but has the shape {np.shape(run.status)}; flatten it."
        )
    before = ("case",) * batch
    joints = tuple(run.loads)
    times = np.asarray(run.times)
    coordinates: dict[str, Any] = {
        # All runs of a batch have the same saved times.
        "time": Labelled(("time",), times[0] if batch else times, "s", "time"),
        "joint": joints,
        "component": COMPONENTS,
    }
    if batch:
        count = len(np.asarray(run.status))
        names = [str(number) for number in range(count)] if cases is None else cases
        coordinates["case"] = names
    variables: dict[str, Labelled] = {}
    _add_loads(variables, run, joints, before, axes)
    _add_motion(variables, coordinates, run, before)
    _add_energies(variables, coordinates, run, before)
    to = variables, coordinates, before
    _add_vectors(*to, run.forces, "force_at_points", "point", FORCE_FIELDS, "global axes")
    of = "in the axes of what it is relative to"
    _add_vectors(*to, run.points, "followed_point", "path", PATH_FIELDS, of)
    _add_contacts(variables, coordinates, run, before)
    _add_shaking(variables, run, before)
    _add_couplings(variables, coordinates, run, before)
    _add_lines(variables, coordinates, run, before)
    for one in (*CHECKS, HINGE_MOMENT_ERROR):
        variables[one.name] = _labelled(one, before, getattr(run.checks, one.name))
    codes = {"flag_values": np.arange(len(STATUS)), "flag_meanings": " ".join(one.name for one in STATUS)}
    variables["status"] = Labelled(before, run.status, "1", "what happened to the run", codes)
    return dataset(variables, coordinates, {"title": "rfem_jax: simulated loads and motion"})


def _stack(values: Sequence[Any], axis: int) -> np.ndarray:
    return np.stack([np.asarray(one) for one in values], axis=axis)


def _add_loads(variables, run, joints, before, axes) -> None:
    """Loads over time, preloads, integrals and metrics by joint."""
    require_choice(axes, tuple(AXES), "axes")
    loads, preload, at, words = run.loads_in(axes), run.preload_in(axes), len(before), AXES[axes]
    for what, unit in (("force", "N"), ("moment", "N m")):
        over_time = _stack([getattr(loads[name], what) for name in joints], at + 1)
        variables[what] = Labelled((*before, "time", "joint", "component"), over_time, unit, f"joint {what}, {words}")
        start = _stack([getattr(preload[name], what) for name in joints], at)
        variables[f"preload_{what}"] = Labelled(
            (*before, "joint", "component"), start, unit, f"joint {what} at the start, {words}"
        )
        squared = {"force": "N^2 s", "moment": "(N m)^2 s"}[what]
        sums = getattr(run.integrals, f"{what}_square")
        variables[f"{what}_square_integral"] = Labelled(
            (*before, "time", "joint"), _stack([sums[name] for name in joints], at + 1), squared,
            f"integral of the squared resultant {what} since the start",
        )  # fmt: skip
    for one in METRICS:
        by_joint = getattr(run.metrics, one.name)
        variables[one.name] = _labelled(one, (*before, "joint"), _stack([by_joint[name] for name in joints], at))


def _add_motion(variables, coordinates, run, before) -> None:
    """Driven coordinates and those of the tree joints, rotations and translations apart as their units differ."""
    turning = [name for name in run.motion.drives if _turns(run, name)]
    kinds = (
        ("rotation", turning, ("drive_angle", "rad"), ("drive_rate", "rad/s"), ("drive_moment", "N m")),
        (
            "translation", [name for name in run.motion.drives if name not in turning],
            ("drive_displacement", "m"), ("drive_speed", "m/s"), ("drive_force", "N"),
        ),
    )  # fmt: skip
    at = len(before) + 1
    for dimension, labels, *columns in kinds:
        if not labels:
            continue
        coordinates[dimension] = labels
        for (name, unit), field in zip(columns, ("position", "rate", "force"), strict=True):
            values = _stack([getattr(run.motion.drives[label], field) for label in labels], at)
            meaning = f"{name.replace('drive_', '')} of the driven coordinate"
            variables[name] = Labelled((*before, "time", dimension), values, unit, meaning)
    for dimension, unit, by_joint in (
        ("angle", "rad", run.motion.angles),
        ("displacement", "m", run.motion.displacements),
    ):
        columns = dict(_coordinates(by_joint, at))
        if columns:
            coordinates[dimension] = list(columns)
            values = _stack(list(columns.values()), at)
            meaning = f"{dimension} of a joint of the tree"
            variables[f"joint_{dimension}"] = Labelled((*before, "time", dimension), values, unit, meaning)


def _turns(run, label: str) -> bool:
    """Whether a driven coordinate, "A" or "C.T_y", is an angle."""
    joint, _, motion = label.partition(".")
    return motion.startswith("R") if motion else joint in run.motion.angles


def _coordinates(by_joint: Mapping[str, Any], axes: int):
    """(label, values over time): "B", or "S_1", "S_2" where a joint has several."""
    for name, values in by_joint.items():
        values = np.asarray(values)
        if values.ndim == axes:
            yield name, values
        else:
            yield from ((f"{name}_{number}", values[..., number - 1]) for number in range(1, values.shape[-1] + 1))


def _add_energies(variables, coordinates, run, before) -> None:
    for one in ENERGIES:
        name = one.name if one.name == "work" else f"{one.name}_energy"
        variables[name] = _labelled(one, (*before, "time"), getattr(run.energy, one.name))
    if run.friction_losses:
        coordinates["friction"] = list(run.friction_losses)
        values = _stack(list(run.friction_losses.values()), len(before) + 1)
        meaning = "energy that a friction has dissipated since the start"
        variables["friction_loss"] = Labelled((*before, "time", "friction"), values, "J", meaning)
    if run.motion.branch:
        coordinates["cut_joint"] = list(run.motion.branch)
        values = _stack(list(run.motion.branch.values()), len(before) + 1)
        variables["branch"] = Labelled((*before, "time", "cut_joint"), values, "1", "assembly mode, +1 or -1")


FORCE_FIELDS = (
    ("force", "N", "force at a point"),
    ("moment", "N m", "moment on the second point"),
    ("place", "m", "position of the second point"),
    ("first_place", "m", "position of the first point"),
)
PATH_FIELDS = (
    ("position", "m", "place of a point"),
    ("velocity", "m/s", "velocity of a point"),
    ("acceleration", "m/s^2", "acceleration of a point"),
    ("angles", "rad", "angles of the link at a point, of R_y R_z R_x"),
)


def _add_vectors(variables, coordinates, before, histories, coordinate, prefix, fields, axes) -> None:
    """Vectors over time of things by their names."""
    if not histories:
        return
    coordinates[coordinate] = list(histories)
    for field, unit, meaning in fields:
        values = _stack([getattr(one, field) for one in histories.values()], len(before) + 1)
        dims = (*before, "time", coordinate, "component")
        variables[f"{prefix}_{field}"] = Labelled(dims, values, unit, f"{meaning}, {axes}")


def _add_contacts(variables, coordinates, run, before) -> None:
    """Contacts of the pins of joints with clearance, and what they have lost."""
    if not run.contacts:
        return
    coordinates |= {"pin": list(run.contacts), "contact": CONTACT_NAMES, "pin_end": CONTACT_NAMES[:2]}
    coordinates["direction"] = ("x", "z")
    over, at = (*before, "time", "pin"), len(before) + 1
    fields = (
        ("penetration", ("contact",), "contact_penetration", "m", "penetration of a contact, below zero a gap"),
        ("normal_force", ("contact",), "contact_force", "N", "normal force of a contact"),
        ("eccentricity", ("pin_end", "direction"), "pin_eccentricity", "m", "end of a pin in its bush"),
        ("along", (), "pin_along", "m", "middle of a pin along its bush"),
    )
    for field, dims, name, unit, meaning in fields:
        values = _stack([getattr(one, field) for one in run.contacts.values()], at)
        variables[name] = Labelled((*over, *dims), values, unit, meaning)
    lost = _stack([run.contact_losses[pin] for pin in run.contacts], at)
    variables["contact_loss"] = Labelled(over, lost, "J", "energy that the contacts of a pin have dissipated")
    if run.contact_changes is not None:
        meaning = "how often contacts have closed or opened"
        variables["contact_changes"] = Labelled(before, run.contact_changes, "1", meaning)


def _add_shaking(variables, run, before) -> None:
    """Force of the mechanism on its base and its moment, where they are recorded."""
    if RECORD not in run.recorded:
        return
    recorded, dims = run.recorded[RECORD], (*before, "time", "component")
    for load, unit in (("force", "N"), ("moment", "N m")):
        about = "" if load == "force" else ", about `shaking_point`"
        meaning = f"{load} of the mechanism on its base{about}, global axes"
        variables[f"{RECORD}_{load}"] = Labelled(dims, getattr(recorded, load), unit, meaning)


def _add_couplings(variables, coordinates, run, before) -> None:
    """Loads of couplings along their two coordinates, of which each may be a moment or a force."""
    if not run.couplings:
        return
    coordinates |= {"coupling": list(run.couplings), "coupled": ("first", "second")}
    over, at, histories = (*before, "time", "coupling"), len(before) + 1, list(run.couplings.values())
    loads = _stack([one.loads for one in histories], at)
    meaning = "load along a coupled coordinate, on the child of its joint"
    variables["coupling_load"] = Labelled((*over, "coupled"), loads, "N m or N", meaning)
    deflections = _stack([one.deflection for one in histories], at)
    meaning = "deflection of a mesh at its second coordinate"
    variables["coupling_deflection"] = Labelled(over, deflections, "rad or m", meaning)


def _add_lines(variables, coordinates, run, before) -> None:
    """Positions of the far ends of the links over time; centre lines as assembled, filled up with NaN."""
    if not run.motion.ends:
        return
    links = list(run.motion.ends)
    coordinates["link"] = links
    at = len(before)
    ends = _stack(list(run.motion.ends.values()), at + 1)
    dims = (*before, "time", "link", "component")
    variables["link_end"] = Labelled(dims, ends, "m", "position of the far end of a link, global axes")
    for name, lines in (("centre_line", run.motion.centre_lines), ("nominal_line", run.motion.nominal_lines)):
        points = [np.asarray(lines[link]) for link in links]
        most = max(one.shape[at] for one in points)
        filled = [
            np.pad(one, [(0, 0)] * at + [(0, most - one.shape[at]), (0, 0)], constant_values=np.nan) for one in points
        ]
        meaning = "points along a link as assembled" if name == "centre_line" else "points along a link, no errors"
        dims = (*before, "link", "point", "component")
        variables[name] = Labelled(dims, _stack(filled, at), "m", f"{meaning}, global axes")


def joint_rows(run: Run, case: str | None = None) -> list[dict[str, Any]]:
    """Metrics and preload of one run, a row per joint; names end in their units."""
    rows = []
    for joint in run.loads:
        row: dict[str, Any] = {} if case is None else {"case": case}
        row["joint"] = joint
        row |= {column_name(one.name, one.unit): float(getattr(run.metrics, one.name)[joint]) for one in METRICS}
        for what, unit in (("force", "N"), ("moment", "N m")):
            values = np.asarray(getattr(run.preload[joint], what))
            row |= {column_name(f"preload_{what}_{x}", unit): float(v) for x, v in zip(COMPONENTS, values, strict=True)}
        rows.append(row)
    return rows


def require_one(run: Run) -> None:
    """Raise InputError for a batch."""
    if np.ndim(run.status) != 0:
        raise InputError(
            f"A table of joints must be of one run, but this is a batch of {np.shape(run.status)} runs; take one of "
            "them, or use to_xarray()."
        )


def run_frame(run: Run) -> DataFrame:
    """`joint_rows` as a DataFrame, by joint. Raises: InputError for a batch."""
    require_one(run)
    return frame(joint_rows(run), ["joint"])


HEADER = ["joint", *(one.title for one in (*AT_REST, *JOINT_METRICS))]


def _shown(run: Run, joint: str) -> list[str | float]:
    at_rest = (float(np.linalg.norm(np.asarray(load))) for load in run.preload[joint])
    return [joint, *at_rest, *(float(getattr(run.metrics, one.name)[joint]) for one in JOINT_METRICS)]


def run_html(run: Run) -> str:
    """Status, loads and balances of one run, or the size of a batch."""
    if np.ndim(run.status) != 0:
        return rich_text.document("Run", rich_text.paragraph(run.summary()))
    status = STATUS[int(run.status)]
    title = f"Run of {float(run.times[-1]):g} s, status {status.name}"
    checks = [
        [f"{one.label}: {one.description}", float(getattr(run.checks, one.name)), one.unit or "1"]
        for one in (*CHECKS, HINGE_MOMENT_ERROR)
    ]
    parts = [
        rich_text.table(HEADER, [_shown(run, joint) for joint in run.loads]),
        rich_text.table(["check", "value", "unit"], checks, (0, 2)),
    ]
    if status.name != "ok":
        parts.insert(0, rich_text.paragraph(status.message))
    return rich_text.document(title, *parts)


def runs_html(runs: Mapping[str, Run]) -> str:
    """Loads of all cases, a row per case and joint, and their status."""
    rows = [
        [case, *_shown(run, joint), STATUS[int(run.status)].name] for case, run in runs.items() for joint in run.loads
    ]
    header = ["case", *HEADER, "status"]
    return rich_text.document(f"Runs of {len(runs)} cases", rich_text.table(header, rows, (0, 1, len(header) - 1)))
