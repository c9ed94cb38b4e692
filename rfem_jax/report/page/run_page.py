"""The page of one run, for notebooks.

Place in the pipeline: `rfem_jax.simulation.outcome.run` -> **run_page** -> document.
"""

from pathlib import Path
from typing import Any

import numpy as np

from rfem_jax.description.basics.errors import InputError
from rfem_jax.description.tolerances.error_catalogue import BOWS
from rfem_jax.mechanics.model.status import STATUS
from rfem_jax.report.contents.files import path_columns, shaking_columns
from rfem_jax.report.contents.output import versions, without_nan
from rfem_jax.report.contents.summary import readable
from rfem_jax.report.page.animation import pack_animation, record_animation
from rfem_jax.report.page.document import write_document
from rfem_jax.report.page.folder import case_rows, page_head
from rfem_jax.report.page.histories import Columns, pack_histories
from rfem_jax.simulation.outcome.quantities import CHECKS, DRIVEN_JOINT, ENERGIES, JOINT_METRICS, PRELOADS, column_name
from rfem_jax.simulation.outcome.remarks import remarks_on
from rfem_jax.simulation.outcome.run import Run

CASE = "run"
FILE = "report.html"


def report_run(run: Run, path: str | Path) -> Path:
    """Write one run, not a batch, as a page `report.html` for any browser.

    **Arguments:** `path`: the file, or a folder.

    **Returns:** the file.  **Raises:** `InputError` for a batch; OSError.
    """
    if not isinstance(run, Run):
        raise InputError(f"Argument `run` must be a Run, but is {type(run).__name__}; give what `simulate` returns.")
    if np.ndim(run.status) != 0:
        raise InputError(
            f"Argument `run` must be one run, but is a batch of {np.shape(run.status)}; take one of it, for example "
            "jax.tree.map(lambda x: x[0], runs)."
        )
    path = Path(path)
    return write_document(path / FILE if path.is_dir() else path, run_content(run))


def run_content(run: Run) -> dict[str, Any]:
    """What the page of a run shows."""
    run = readable(run)
    status = STATUS[int(run.status)]
    case = {"status": status.name, "message": status.message, "errors": _errors(run), "joints": _joints(run)}
    case["remarks"] = list(remarks_on(run))
    case["driven_joint"] = {one.name: float(getattr(run.motion, one.name)) for one in DRIVEN_JOINT}
    case |= {one.name: float(getattr(run.checks, one.name)) for one in CHECKS}
    driven = run.model.driven_joint if run.model is not None else None
    head = {
        "title": "Loads in the joints of one run", "duration": float(run.times[-1]), "driven_joint": driven,
        "versions": versions(), "cases": {CASE: case},
    }  # fmt: skip
    head = without_nan(head)
    animation = record_animation({CASE: run})
    return {
        **page_head(head),
        "cases": case_rows(head),
        "tasks": [],
        "histories": pack_histories({CASE: _columns(run)}, list(run.loads)),
        "animation": None if animation is None else pack_animation(*animation),
    }


def _joints(run: Run) -> dict[str, dict[str, Any]]:
    kinds = {}
    if run.model is not None:
        topology = run.model.topology
        kinds = dict(zip(topology.joints, topology.kinds, strict=True))
    joints = {}
    for name in run.loads:
        row: dict[str, Any] = {"kind": kinds.get(name)}
        for one in PRELOADS:
            load = getattr(run.preload[name], one.name.removeprefix("preload_"))
            row[one.name] = [float(x) for x in load]
        row |= {one.name: float(getattr(run.metrics, one.name)[name]) for one in JOINT_METRICS}
        joints[name] = row
    return joints


def _errors(run: Run) -> dict[str, float]:
    """The errors that are not zero by their names, as `assembly_errors` takes them."""
    if run.model is None or run.errors is None:
        return {}
    topology, errors, found = run.model.topology, run.errors, {}
    sides = (("", errors.seat), (".child", errors.bore))
    for j, joint in enumerate(topology.joints):
        for side, values in sides:
            for component, value in zip(topology.error_components, np.asarray(values)[:, j], strict=True):
                found[f"{joint}{side}.{component}"] = float(value)
        for axis, value in zip("xz", np.asarray(errors.pin)[:, j], strict=True):
            found[f"{joint}.pin_tilt_{axis}"] = float(value)
    for l, link in enumerate(topology.links):
        found[f"{link}.length"] = float(errors.length[l])
        found[f"{link}.twist"] = float(errors.twist[l])
        for name, value in zip(BOWS, () if errors.bow is None else np.asarray(errors.bow)[:, l]):
            found[f"{link}.{name}"] = float(value)
    return {name: value for name, value in found.items() if value != 0.0}


def _columns(run: Run) -> Columns:
    """Time histories under the names that they have in the CSV files of a study."""
    columns = {column_name("time", "s"): np.asarray(run.times)}
    for one in ENERGIES:
        columns[column_name(one.name, one.unit)] = np.asarray(getattr(run.energy, one.name))
    for name, load in run.loads.items():
        for part, unit in (("force", "N"), ("moment", "N m")):
            for letter, values in zip("xyz", np.asarray(getattr(load, part)).T, strict=True):
                columns[column_name(f"{name}_{part}_{letter}", unit)] = values
    for what, unit, values in (("angle", "rad", run.motion.angles), ("displacement", "m", run.motion.displacements)):
        for joint, several in values.items():
            several = np.asarray(several)
            if several.ndim == 1:
                columns[column_name(f"{joint}_{what}", unit)] = several
            else:
                named = enumerate(several.T, start=1)
                columns |= {column_name(f"{joint}_{what}_{n}", unit): one for n, one in named}
    columns |= path_columns(run) | shaking_columns(run)
    if run.model is not None and run.model.topology.drives:
        columns[column_name("rate", "m/s" if _slides(run) else "rad/s")] = np.asarray(run.motion.rate)
    return columns


def _slides(run: Run) -> bool:
    assert run.model is not None
    topology = run.model.topology
    return topology.slides[topology.drives[0]]
