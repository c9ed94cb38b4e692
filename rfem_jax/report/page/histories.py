"""Curves of the page: the columns of the CSV files of a study, with names and units.

Place in the pipeline: files of `report.contents` -> **histories** -> folder.
"""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from rfem_jax.description.metrics.shaking_metrics import RECORD
from rfem_jax.mechanics.dynamics.load_axes import AXES
from rfem_jax.report.page.packing import pack_floats, some_rows
from rfem_jax.simulation.outcome.quantities import ENERGIES

MOST_ROWS = 2001  # of a case
MOST_NUMBERS = 220_000  # of all cases, four bytes each
LARGEST = 200_000_000  # bytes of a file that is read
UNITS = {
    "_rad_s": "rad/s",
    "_m_s2": "m/s^2",
    "_m_s": "m/s",
    "_Nm": "N m",
    "_rad": "rad",
    "_N": "N",
    "_J": "J",
    "_m": "m",
    "_s": "s",
}

Columns = dict[str, Float[np.ndarray, " times"]]


def read_table(path: Path) -> Columns | None:
    """The columns of a CSV file of numbers by their names; None where it is no such file."""
    try:
        if path.stat().st_size > LARGEST:
            return None
        with open(path, encoding="utf-8") as file:
            names = [name.removeprefix("'") for name in file.readline().rstrip("\n").split(",")]
            values = np.loadtxt(file, delimiter=",", ndmin=2, converters=_number)
    except (OSError, ValueError, UnicodeDecodeError):
        return None
    if values.shape[1] != len(names) or len(values) == 0:
        return None
    return dict(zip(names, values.T, strict=True))


def _number(text: str) -> float:
    return float(text) if text.strip() else np.nan


def quantities_of(names: Sequence[str], joints: Sequence[str]) -> list[dict[str, Any]]:
    """What can be plotted: {label, group, unit, columns: [name], parts: [letter]}; loads have three columns."""
    found, used = [], {"time_s"}
    for joint in joints:
        for load, unit, suffix in (("Force", "N", "N"), ("Moment", "N m", "Nm")):
            columns = [f"{joint}_{load.lower()}_{axis}_{suffix}" for axis in "xyz"]
            if set(columns) <= set(names):
                used |= set(columns)
                one = {"label": f"{load} in {joint}", "group": f"Joint {joint}", "unit": unit, "joint": joint}
                found.append({**one, "load": load.lower(), "columns": columns, "parts": list("xyz")})
    vectors = [(f"{RECORD}_{{load}}", "Shaking {load}", "Base")]
    for axes, words in AXES.items():
        vectors += [(f"{joint}_{{load}}_{axes}", f"{{Load}} in {joint}, {words}", f"Joint {joint}") for joint in joints]
    for before, label, group in vectors:
        for load, unit, suffix in (("force", "N", "N"), ("moment", "N m", "Nm")):
            columns = [f"{before.format(load=load)}_{axis}_{suffix}" for axis in "xyz"]
            if used.isdisjoint(columns) and set(columns) <= set(names):
                used |= set(columns)
                shown = label.format(load=load, Load=load.capitalize())
                found.append({"label": shown, "group": group, "unit": unit, "columns": columns, "parts": list("xyz")})
    labels = {one.name: one.label for one in ENERGIES}
    for name in names:
        if name in used:
            continue
        suffix = next((end for end in UNITS if name.endswith(end)), "")
        word = name.removesuffix(suffix) if suffix else name
        moves = suffix[:4] in ("_rad", "_m", "_m_s")
        group = "Energy" if suffix == "_J" else "Motion" if moves else "Drives and forces"
        label = labels.get(word) or re.sub(r"_", " ", word)
        label = label[:1].upper() + label[1:]
        found.append({"label": label, "group": group, "unit": UNITS.get(suffix, ""), "columns": [name], "parts": []})
    return found


def pack_histories(tables: Mapping[str, Columns | None], joints: Sequence[str]) -> dict[str, Any] | None:
    """Curves of all cases: quantities (with numbers of columns), and of every case its times and columns.

    Columns that not all cases have are left out.
    """
    known = {case: table for case, table in tables.items() if table is not None and "time_s" in table}
    if not known:
        return None
    first = next(iter(known.values()))
    names = [name for name in first if all(name in table for table in known.values())]
    quantities = quantities_of(names, joints)
    wanted = list(dict.fromkeys(name for one in quantities for name in one["columns"]))
    numbers = {name: i for i, name in enumerate(wanted)}
    for one in quantities:
        one["columns"] = [numbers[name] for name in one["columns"]]
    most = max(2, min(MOST_ROWS, MOST_NUMBERS // (max(len(wanted), 1) * len(known))))
    cases, saved = [], 0
    for case, table in known.items():
        rows = some_rows(len(table["time_s"]), most)
        saved = max(saved, len(table["time_s"]))
        values = np.stack([table[name][rows] for name in wanted]) if wanted else np.zeros((0, len(rows)))
        cases.append({"case": case, "times": pack_floats(table["time_s"][rows]), "values": pack_floats(values)})
    return {"quantities": quantities, "cases": cases, "saved_times": saved, "most_times": most}
