"""How files are written: whole or not at all, without NaN, with the versions that made them.

Place in the pipeline: `whole_files` -> **output** -> every module of this package that writes, and the studies'
scripts.  JSON has no NaN; a value that does not exist is null, in CSV an empty cell.
Texts in CSV files that begin as a formula (=, +, -, @) have an apostrophe before them.

Columns of CSV files are named with their units (`column_name`): `time_s`, `D.d_y_m`. Where the unit changes
from row to row, it stands in a column of its own: `gradient_unit` is that of `gradient`, `unit` that of all others. A
column of which neither is said has no unit: a count, a name, a ratio, a cost in the currency of the study.
"""

import csv
import io
import json
import math
import platform
from collections.abc import Mapping, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from rfem_jax.whole_files import write_text

_PACKAGES = ("rfem_jax", "jax", "jaxlib", "diffrax", "equinox", "optimistix", "lineax", "numpy")


def without_nan(value: Any) -> Any:
    """Copy of nested dicts, lists and numbers in which NaN and infinity are None."""
    if isinstance(value, dict):
        return {key: without_nan(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [without_nan(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def plain(value: Any) -> Any:
    """NumPy arrays and scalars of nested dicts and lists as Python's own."""
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if isinstance(value, np.ndarray):
        return value.tolist()
    return value.item() if isinstance(value, np.generic) else value


def versions() -> dict[str, str | None]:
    """Versions of Python and of the packages that made the numbers (None: not installed)."""
    found: dict[str, str | None] = {"python": platform.python_version()}
    for package in _PACKAGES:
        try:
            found[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            found[package] = None
    return found


def write_json(path: str | Path, content: dict[str, Any]) -> Path:
    """Write `content` with the versions beside it."""
    text = json.dumps(without_nan({**content, "versions": versions()}), indent=2, allow_nan=False)
    return write_text(path, text + "\n")


def write_csv(path: str | Path, rows: Sequence[Mapping[str, Any]]) -> Path:
    """Write rows (dicts with the same keys) as CSV; NaN is an empty cell."""
    text = io.StringIO()
    names = list(rows[0])
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([csv_cell(name) for name in names])
    for row in rows:
        writer.writerow([csv_cell(row[name]) for name in names])
    return write_text(path, text.getvalue())


def csv_cell(value: Any) -> Any:
    """What stands in a cell of a CSV file for a value."""
    if isinstance(value, (float, np.floating)):
        return "" if np.isnan(value) else f"{value:.12g}"
    # A spreadsheet takes such a text for a formula: with an apostrophe before it it is a text.
    return f"'{value}" if isinstance(value, str) and value.startswith(("=", "+", "-", "@")) else value
