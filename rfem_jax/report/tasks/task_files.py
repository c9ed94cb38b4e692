"""What the JSON files of all tasks have in common, and numbers with their confidence intervals.

Place in the pipeline: used by the reports on tasks. SI units (rad, m) and the metrics' own units; JSON has no NaN, an
open limit or a missing number is null. Nothing in a file depends on how long a run took or how often it was
interrupted.
"""

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from rfem_jax.description.metrics.catalogue import notes_on
from rfem_jax.description.study_file.study import Study
from rfem_jax.report.contents.output import plain, write_json
from rfem_jax.report.contents.summary import study_note


def metric_units(metrics: Sequence[str], units: Sequence[str]) -> dict[str, str]:
    """{metric: unit}, "1" where it has no dimension."""
    return {name: unit or "1" for name, unit in zip(metrics, units, strict=True)}


def write_task_json(path: Path, study: Study, name: str, result: dict[str, Any]) -> Path:
    """Write one task's JSON: what was asked for (`task`, `tolerances`) and `result` (a dict)."""
    specified = study.tasks.tolerances
    content = {
        "title": study.title,
        "note": study_note(study) or None,
        "duration": study.duration,
        "method": study.method.as_table(),
        **({} if study.statics is None else {"statics": asdict(study.statics)}),
        "task": {"name": name, **asdict(study.tasks.asked[name])},
        "tolerances": None if specified is None else asdict(specified),
        **result,
        "zone_names": {} if specified is None else {"+".join(one.errors): one.name for one in specified.zones},
        "metric_notes": notes_on(getattr(study.tasks.asked[name], "metrics", ())),
        "units": {"duration": "s", "error": "rad or m", **result.get("units", {})},
    }
    return write_json(path, plain(content))
