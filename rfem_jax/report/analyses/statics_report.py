"""The static loads of the cases of a study: computed, printed and written.

Place in the pipeline: study, model -> `simulation.rest.statics` -> **statics_report** -> files.
"""

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np

from rfem_jax.compilation.program import Program
from rfem_jax.description.metrics.catalogue import at_rest, notes_on, records_for
from rfem_jax.description.metrics.shaking_metrics import RECORD
from rfem_jax.description.study_file.statics import Statics
from rfem_jax.description.study_file.study import Study
from rfem_jax.mechanics.model.errors import Deviations
from rfem_jax.mechanics.model.model import Model
from rfem_jax.mechanics.model.status import STATUS
from rfem_jax.report.analyses.analysis import errors_of_cases
from rfem_jax.report.contents.files import contact_columns, coupling_columns
from rfem_jax.report.contents.output import write_csv, write_json
from rfem_jax.report.contents.summary import reaction_norm, study_note
from rfem_jax.report.contents.tables import title_text
from rfem_jax.simulation.outcome.records import require_records
from rfem_jax.simulation.rest.labelled_statics import LabelledStatics, status_name
from rfem_jax.simulation.rest.poses import ClosedPose, poses_at
from rfem_jax.simulation.rest.statics import StaticLoads, static_loads_at, usual_records


def compute_statics(study: Study, model: Model) -> LabelledStatics:
    """Static loads of all cases at the positions of the study's table [statics]. Raises InputError."""
    metrics = at_rest(study.metrics)
    asked = require_records(model, (*usual_records(model), *records_for(metrics)))
    poses = poses_at(model, *positions_and_motion(study.statics))
    found = _of_cases(model, errors_of_cases(study, model), poses, asked)
    results = tuple(jax.tree.map(lambda values, c=c: np.asarray(values)[c], found) for c in range(len(study.cases)))
    return LabelledStatics(tuple(case.name for case in study.cases), results, metrics)


def positions_and_motion(statics: Statics | None) -> tuple[Any, Any, Any]:
    """Positions, rates and accelerations that [statics] gives, as of `poses_at`; the last two are None at rest."""
    if statics is None:
        return None, None, None
    return (
        (statics.positions, statics.rates, statics.accelerations) if statics.moves else (statics.positions, None, None)
    )


@partial(Program, nameless=True)
def _of_cases(model: Model, errors: Deviations, poses: ClosedPose | None, asked: tuple[str, ...]) -> StaticLoads:
    return jax.vmap(lambda one: static_loads_at(model, one, poses, asked))(errors)


def statics_text(study: Study, found: LabelledStatics) -> str:
    """Tables of the loads of every case."""
    return f"{title_text(study)}\n\n{found}"


def write_statics(folder: Path, study: Study, found: LabelledStatics) -> list[Path]:
    """Write statics.json, statics.csv (all positions) and, where links are flexible, statics_sections.csv."""
    content = {
        "title": study.title,
        "note": study_note(study) or None,
        "analysis": "statics",
        **reaction_norm(study),
        "held": {label: found.units(label)[0] for label in found.labels},
        "cases": {case: _content(found, c) for c, case in enumerate(found.cases)},
        "metric_notes": notes_on(found.metrics),
        "units": {
            "force": "N", "moment": "N m", "stress": "Pa", "energy": "J", "deflection": "m", "place": "m",
            "momentum_balance_error": "1", "linear_error": "1", "growth_rate": "1/s",
            **{label: found.units(label)[1] for label in found.labels},
            **{name: unit or "1" for name, (_, unit) in found.values_of_metrics(0).items()},
        },
    }  # fmt: skip
    rows = found.rows()
    more = [contact_columns(one.contacts) | coupling_columns(study, one.couplings) for one in found.results]
    for row in rows:
        columns = more[found.cases.index(row["case"])]
        row |= {name: float(values[row["number"]]) for name, values in columns.items()}
    written = [write_json(folder / "statics.json", content), write_csv(folder / "statics.csv", rows)]
    if sections := found.section_rows():
        written.append(write_csv(folder / "statics_sections.csv", sections))
    return written


def _content(found: LabelledStatics, c: int) -> dict[str, Any]:
    """One case of statics.json: lists over the positions."""
    result = found.results[c]

    def lists(values: Mapping[str, Any]) -> dict[str, Any]:
        return {name: np.asarray(one).tolist() for name, one in values.items()}

    shaking = result.recorded.get(RECORD)
    ends = {name.rpartition(".")[0]: one for name, one in result.recorded.items() if name.endswith(".deflection")}
    return {
        "status": status_name(result.status),
        "statuses": [STATUS[int(code)].name for code in result.status],
        "remarks": found.remarks_on(c),
        "position": lists(result.position),
        **({"rate": lists(result.rate), "acceleration": lists(result.acceleration)} if found.moves else {}),
        "holding": lists(result.holding),
        "joints": {
            name: {"force": np.asarray(load.force).tolist(), "moment": np.asarray(load.moment).tolist()}
            for name, load in result.loads.items()
        },
        "stress": lists(result.stress),
        "deflection": lists(ends),
        "place": {name: np.asarray(path.position).tolist() for name, path in result.points.items()},
        **({} if shaking is None else {RECORD: {of: getattr(shaking, of).tolist() for of in ("force", "moment")}}),
        "energy": {part: np.asarray(getattr(result.energy, part)).tolist() for part in ("elastic", "gravity")},
        "metrics": {name: value for name, (value, _) in found.values_of_metrics(c).items()},
        "momentum_balance_error": float(result.checks.momentum_balance_error),
        "linear_error": float(result.checks.linear_error),
        **({} if result.stability is None else {"growth_rate": np.asarray(result.stability.growth).tolist()}),
    }
