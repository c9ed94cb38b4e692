"""What the reports on analyses have in common: the cases of a study, and their files.

Place in the pipeline: study -> **analysis** -> modes_report, turn_report.
"""

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from rfem_jax.description.parameters.parameters import parameters_of
from rfem_jax.description.study_file.study import Study
from rfem_jax.mechanics.model.errors import Deviations
from rfem_jax.mechanics.model.model import Model
from rfem_jax.report.contents.output import write_json
from rfem_jax.report.contents.summary import reaction_norm, study_note
from rfem_jax.simulation import cases


def errors_of_cases(study: Study, model: Model) -> Deviations:
    """What deviates in all cases of a study, along a first axis."""
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *cases.errors_of_cases(study, model))


def error_names(study: Study) -> tuple[str, ...]:
    """Errors that derivatives of what is at rest are wanted by: those of the tolerances, and those that cases have;
    without numbers of the drives, which move nothing there."""
    tolerances, parameters = study.tasks.tolerances, parameters_of(study.mechanism)
    names = [] if tolerances is None else list(tolerances.names)
    names += [name for case in study.cases for name in case.errors]
    return tuple(name for name in dict.fromkeys(names) if name in parameters or not name.startswith("drive."))


def write_analysis(path: Path, study: Study, name: str, result: dict[str, Any]) -> Path:
    """Write the JSON file of an analysis (SI units, radians)."""
    content = {"title": study.title, "note": study_note(study) or None, "analysis": name}
    return write_json(path, {**content, **reaction_norm(study), **result})
