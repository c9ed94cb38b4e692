"""The content of the page from the files of a folder alone.

Place in the pipeline: results.json, CSV files, animation.npz, files of tasks -> **folder** -> document.

Whatever these files hold, the content is a dict of known keys; what has another form than that of `files` is
left out, or shown as the text that it is.
"""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from rfem_jax.description.basics.errors import InputError
from rfem_jax.description.tolerances.error_catalogue import error_unit
from rfem_jax.report.page.animation import pack_animation, read_animation
from rfem_jax.report.page.histories import pack_histories, read_table
from rfem_jax.report.page.task_results import read_json, read_tasks
from rfem_jax.simulation.outcome.quantities import CHECKS, DRIVEN_JOINT, JOINT_METRICS, PRELOADS, Quantity

RESULTS = "results.json"


def folder_content(folder: str | Path) -> dict[str, Any]:
    """What the page of a folder shows.

    Raises: InputError for a folder that has neither results.json nor the JSON of a task, and for files of results that
        are damaged.
    """
    folder = Path(folder)
    results, tasks = read_json(folder / RESULTS), read_tasks(folder)
    if results is None and not tasks:
        raise InputError(
            f"Argument `DIR` must be a folder with results of `rfem-jax`, but {folder} has neither {RESULTS} nor the "
            "results of a task; name the folder that was given to --out."
        )
    head = results if results is not None else tasks[0]["result"]
    content = {**page_head(head), "cases": case_rows(results or {}), "tasks": tasks, "histories": None}
    if results is None:
        return {**content, "animation": None}
    joints = [joint["name"] for joint in next(iter(content["cases"]), {"joints": []})["joints"]]
    tables = {case["name"]: read_table(folder / f"{case['name']}.csv") for case in content["cases"] if _plain(case)}
    content["histories"] = pack_histories(tables, joints)
    content["animation"] = _animation(folder, [case["name"] for case in content["cases"]])
    return content


def _animation(folder: Path, cases: list[str]) -> dict[str, Any] | None:
    """The animation, unless it is of other cases than the results are."""
    found = read_animation(folder)
    return pack_animation(*found) if found is not None and found[0]["cases"] == cases else None


def _plain(case: dict[str, Any]) -> bool:
    """Whether the case's name is that of a file in the folder, not a path out of it."""
    name = case["name"]
    return name not in ("", ".", "..") and not set(name) & set("/\\:\0")


def page_head(results: dict[str, Any]) -> dict[str, Any]:
    """What is said of a study as a whole, and the names and units of all numbers."""
    plain = ("title", "note", "duration", "driven_joint")
    return {
        **{key: results.get(key) for key in plain},
        "method": _pairs(results.get("method")),
        "versions": _pairs(results.get("versions")),
        "compilation": _pairs(results.get("compilation")),
        "metrics": [_described(one) for one in (*PRELOADS, *JOINT_METRICS)],
        "balances": [_described(one) for one in CHECKS],
        "ends": [_described(one) for one in DRIVEN_JOINT],
        "metric_units": _pairs(_table(results.get("units")).get("metrics")),
        "metric_notes": _pairs(results.get("metric_notes")),
    }


def _described(quantity: Quantity) -> dict[str, str]:
    return {"name": quantity.name, "unit": quantity.unit, "label": quantity.label, "text": quantity.description}


def _pairs(value: Any) -> list[list[Any]]:
    """[name, value] of a dict, in its order, which that of a JavaScript object is not."""
    return [[str(key), item] for key, item in value.items()] if isinstance(value, dict) else []


def case_rows(results: dict[str, Any]) -> list[dict[str, Any]]:
    """{name, status, message, errors, joints, numbers, metrics, driven, branch} of every case."""
    cases = results.get("cases")
    rows = []
    for name, case in cases.items() if isinstance(cases, dict) else ():
        if not isinstance(case, dict):
            continue
        joints = case.get("joints")
        rows.append(
            {
                "name": name,
                "status": case.get("status"),
                "message": " ".join(str(one) for one in (case.get("message"), *_listed(case.get("remarks"))) if one),
                "errors": [[error, value, _unit(error)] for error, value in _pairs(case.get("errors"))],
                "joints": [
                    {"name": joint, **row}
                    for joint, row in _items(joints)
                    if isinstance(row, dict) and "name" not in row
                ],
                "numbers": {one.name: case.get(one.name) for one in CHECKS},
                "metrics": _pairs(case.get("metrics")),
                "driven": _pairs(case.get("driven_joint")),
                "drives": [[label, _pairs(ends)] for label, ends in _items(case.get("drives"))],
                "branch": [[joint, _pairs(modes)] for joint, modes in _items(case.get("branch"))],
            }
        )
    return rows


def _listed(value: Any) -> list[Any]:
    return value if isinstance(value, list) else []


def _table(value: Any) -> dict[str, Any]:
    return value if isinstance(value, dict) else {}


def _items(value: Any) -> Iterable[tuple[str, Any]]:
    return value.items() if isinstance(value, dict) else ()


def _unit(error: str) -> str:
    try:
        return error_unit(error)
    except InputError:
        return ""
