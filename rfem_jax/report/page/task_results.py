"""Results of tasks for the page: the JSON of each task, and the samples of a Monte Carlo study.

Place in the pipeline: files of `report.tasks` -> **task_results** -> folder.
"""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rfem_jax.description.basics.errors import InputError
from rfem_jax.report.contents.output import without_nan
from rfem_jax.report.page.histories import read_table
from rfem_jax.report.page.packing import pack_floats, some_rows
from rfem_jax.task_kinds import task_kinds

MOST_SAMPLES = 5000
MOST_NUMBERS = 80_000  # of the samples, four bytes each
MOST_TEXT = 400_000  # characters of one task's JSON
MOST_LIST = 4096  # entries of a list of it
LARGEST = 50_000_000  # bytes of a file that is read
# Files of `report.analyses` and of the command `cycle`.
ANALYSES = {"statics": "Statics", "turn": "Turn", "modes": "Modes", "cycle": "Cycle"}


def read_json(path: Path) -> dict[str, Any] | None:
    """A JSON object without NaN; None where there is no such file, or it holds something else.

    Raises: InputError for a file that is damaged or too large.
    """
    try:
        if path.stat().st_size > LARGEST:
            raise damaged(path, f"is larger than {LARGEST // 10**6} MB")
        found = json.loads(path.read_text(encoding="utf-8"))
        return without_nan(found) if isinstance(found, dict) else None
    except (FileNotFoundError, NotADirectoryError):
        return None
    except InputError:
        raise
    except OSError as problem:
        raise damaged(path, f"cannot be read ({problem.strerror or problem})") from None
    except (ValueError, RecursionError):
        raise damaged(path, "is damaged") from None


def damaged(path: Path, finding: str) -> InputError:
    """What is said of a file in a folder of results that cannot be used."""
    return InputError(
        f"Argument `DIR` must be a folder with whole files as `rfem-jax` writes them, but `{path}` {finding}; compute "
        "it again, or delete it."
    )


def read_tasks(folder: Path) -> list[dict[str, Any]]:
    """{name, title, result} of every task and analysis that has a JSON file in the folder; of a Monte Carlo study also
    samples, of a sweep its points."""
    found = []
    titles = {kind.name: str(kind.title) for kind in task_kinds().values()}
    for name, title in (ANALYSES | titles).items():
        result = read_json(folder / f"{name}.json")
        if result is None:
            continue
        one = {"name": name, "title": title, "result": _shortened(result)}
        if len(json.dumps(one)) > MOST_TEXT:
            one["result"] = {key: value for key, value in result.items() if not isinstance(value, (dict, list))}
            one["left_out"] = f"{name}.json is too large to be shown here"
        if name == "monte_carlo":
            one["samples"] = _samples(folder / "monte_carlo.csv", result)
        if name == "sweep":
            one["points"] = _points(folder / "sweep.csv", result)
        found.append(one)
    return found


def _shortened(value: Any) -> Any:
    """Every k-th entry of lists that are too long to be shown, such as the corners of a box of many errors."""
    if isinstance(value, dict):
        return {key: _shortened(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_shortened(value[i]) for i in some_rows(len(value), MOST_LIST)]
    return value


def _samples(path: Path, result: dict[str, Any]) -> dict[str, Any] | None:
    """Names and units of errors and metrics, and their values in the samples, a row each."""
    table = read_table(path)
    if table is None or not {"sample", "status"} <= set(table):
        return None
    metrics = result.get("metrics") if isinstance(result.get("metrics"), dict) else {}
    columns = [name for name in table if name not in ("sample", "status")]
    errors = columns[: max(len(columns) - len(metrics or {}), 0)]
    most = min(MOST_SAMPLES, MOST_NUMBERS // max(len(columns), 1))
    rows = some_rows(len(table["status"]), most)
    values = np.stack([table[name][rows] for name in columns]) if columns else np.zeros((0, len(rows)))
    return {
        "errors": [_error(name) for name in errors],
        "metrics": _metrics(columns[len(errors) :], list(metrics or {}), result.get("units")),
        "number": pack_floats(table["sample"][rows]),
        "status": pack_floats(table["status"][rows]),
        "values": pack_floats(values),
        "all": len(table["status"]),
    }


def _points(path: Path, result: dict[str, Any]) -> dict[str, Any] | None:
    """Names and units of the quantities and metrics of a sweep, and their values at its points, a row each."""
    table, quantities = read_table(path), result.get("errors")
    if table is None or not {"point", "status"} <= set(table) or not isinstance(quantities, dict):
        return None
    columns = [name for name in table if name not in ("point", "status")]
    varied, pairs = columns[: len(quantities)], columns[len(quantities) :]
    units = result.get("units")
    names = [name for name in units if name not in ("duration", "error")] if isinstance(units, dict) else []
    # Where there is a surface its values stand beside those of the points.
    metrics = pairs if result.get("surface") is None else pairs[::2]
    if len(names) != len(metrics):
        return None
    rows = some_rows(len(table["status"]), min(MOST_SAMPLES, MOST_NUMBERS // max(len(columns), 1)))
    shown = [*varied, *metrics]
    return {
        "quantities": [_error(name) for name in varied],
        "metrics": _metrics(metrics, names, units),
        "status": pack_floats(table["status"][rows]),
        "values": pack_floats(np.stack([table[name][rows] for name in shown]) if shown else np.zeros((0, len(rows)))),
    }


def _error(column: str) -> dict[str, Any]:
    for suffix, unit in (("_rad", "rad"), ("_m", "m")):
        if column.endswith(suffix):
            return {"name": column.removesuffix(suffix), "unit": unit}
    return {"name": column, "unit": ""}


def _metrics(columns: Sequence[str], names: Sequence[str], units: Any) -> list[dict[str, Any]]:
    """The metrics by the names of `monte_carlo.json`, whose order is that of the columns."""
    known = units if isinstance(units, dict) else {}
    matched = [name if column.startswith(name) else column for name, column in zip(names, columns, strict=True)]
    return [{"name": name, "unit": "" if known.get(name) == "1" else str(known.get(name, ""))} for name in matched]
