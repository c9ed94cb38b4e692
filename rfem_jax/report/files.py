"""The files of a run: `results.json` and one CSV of time histories per case.

Place in the pipeline: after `summary`. Every file appears whole or not at all: it is written
beside its final place and then renamed. JSON has no NaN; a value that does not exist is null.

CSV columns: `time_s`; `angle_rad`, `rate_rad_s` of the driven joint; energies `_J`; then for each
joint `A_force_x_N` ... `A_moment_z_Nm` in its hinge frame (y along the hinge); and last
`drive_moment_Nm`.
"""

import json
import math
import os
import platform
from contextlib import contextmanager
from dataclasses import asdict
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from rfem_jax.report.quantities import ENERGIES, units
from rfem_jax.report.summary import joint_names, study_note, total_energy

_PACKAGES = ("rfem_jax", "jax", "jaxlib", "diffrax", "equinox", "optimistix", "lineax", "numpy")


@contextmanager
def replacing(path: Path):
    """Give a temporary path beside `path`; rename it to `path` when the block ends well."""
    path = Path(path)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        yield temporary
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def without_nan(value: Any) -> Any:
    """Copy of nested dicts, lists and numbers in which NaN and infinity are None."""
    if isinstance(value, dict):
        return {key: without_nan(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [without_nan(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def versions() -> dict[str, str | None]:
    """Versions of Python and of the packages that made the numbers (None: not installed)."""
    found: dict[str, str | None] = {"python": platform.python_version()}
    for package in _PACKAGES:
        try:
            found[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            found[package] = None
    return found


def write_results(path, study, summaries) -> Path:
    """Write `results.json`; `summaries` as `rfem_jax.report.summary.summarise` returns them."""
    content = {
        "title": study.title,
        "note": study_note(study) or None,
        "duration": study.duration,
        "driven_joint": None if study.drive is None else study.drive.joint,
        "method": asdict(study.method),
        "cases": summaries,
        "units": {"duration": "s", **units()},
        "versions": versions(),
    }
    text = json.dumps(without_nan(content), indent=2, allow_nan=False)
    with replacing(path) as temporary:
        temporary.write_text(text + "\n", encoding="utf-8")
    return Path(path)


def history_columns(study, run) -> dict[str, np.ndarray]:
    """Time histories of one run, {column name with unit: (T,) array}, in the order of the CSV."""
    times = np.asarray(run.times)
    columns = {
        "time_s": times,
        "angle_rad": np.asarray(run.angle),
        "rate_rad_s": np.asarray(run.rate),
    }
    for quantity in ENERGIES:
        is_total = quantity.name == "total"
        values = total_energy(run) if is_total else np.asarray(getattr(run.energy, quantity.name))
        columns[f"{quantity.name}_{quantity.unit}"] = values
    for name in joint_names(study):
        for load, unit in (("force", "N"), ("moment", "Nm")):
            values = np.asarray(getattr(run.loads[name], load))
            for axis, letter in enumerate("xyz"):
                columns[f"{name}_{load}_{letter}_{unit}"] = values[:, axis]
    columns["drive_moment_Nm"] = np.asarray(run.drive_moment)
    return columns


def write_history(path, study, run) -> Path:
    """Write the time histories of one run as CSV (12 digits, one row per saved time)."""
    columns = history_columns(study, run)
    table = np.stack(list(columns.values()), axis=1)
    with replacing(path) as temporary:
        np.savetxt(
            temporary, table, fmt="%.12g", delimiter=",", header=",".join(columns), comments=""
        )
    return Path(path)


def write_files(folder, study, runs, summaries) -> list[Path]:
    """Write `results.json` and `<case>.csv` of every case into `folder`; returns their paths."""
    folder = Path(folder)
    written = [write_results(folder / "results.json", study, summaries)]
    for case in study.cases:
        written.append(write_history(folder / f"{case.name}.csv", study, runs[case.name]))
    return written
