"""The class that computes and shows a task, for every kind of task; and what the commands for tasks do.

Place in the pipeline: the reports, `rfem_jax.task_kinds` -> **catalogue** -> `report.commands`, with a study as loaded.
"""

import time
from pathlib import Path
from typing import Any

from rfem_jax.description.basics.errors import InputError
from rfem_jax.description.study_file.study import Study
from rfem_jax.report.tasks.task_report import TaskReport
from rfem_jax.report.terminal.messages import remark
from rfem_jax.task_kinds import task_kinds


def report_class(name: str) -> Any:
    """The class of a kind of task, imported when it is used: some take seconds."""
    match name:
        case "sensitivity":
            from rfem_jax.report.tasks.sensitivity import SensitivityReport as Report
        case "monte_carlo":
            from rfem_jax.report.tasks.monte_carlo import MonteCarloReport as Report
        case "worst_case":
            from rfem_jax.report.tasks.worst_case import WorstCaseReport as Report
        case "allocation":
            from rfem_jax.report.tasks.allocation import AllocationReport as Report
        case "sweep":
            from rfem_jax.report.tasks.sweep import SweepReport as Report
        case "reliability":
            from rfem_jax.report.tasks.reliability import ReliabilityReport as Report
        case "optimise":
            from rfem_jax.report.tasks.optimise import OptimiseReport as Report
        case "identification":
            from rfem_jax.report.tasks.identification import IdentificationReport as Report
        case _:
            return task_kinds()[name].report_class()
    return Report


def report_on(study: Study, name: str) -> TaskReport:
    """The report on the task `name` of a study that declares it."""
    return report_class(name)(study, name, study.tasks.asked[name])


def require_task(study: Study, name: str) -> None:
    """Raise InputError if the study does not declare the task `name`."""
    if name not in study.tasks.declared:
        declared = ", ".join(f"[{one}]" for one in study.tasks.declared) or "none"
        raise InputError(
            f"Argument `STUDY.toml` must have a table [{name}] for this command, but its tasks are "
            f"{declared}; add the table."
        )


def do_task(study: Study, name: str, folder: str | Path, pictures: bool = True) -> tuple[bool, list[Path]]:
    """Compute, print, write and, with `pictures`, draw one declared task.

    Returns: whether the result is good, and the files written (none but by process 0 of several).
    Raises: InputError; OSError for files that cannot be written.
    """
    require_task(study, name)
    started = time.perf_counter()
    good, written = report_on(study, name).do(Path(folder), pictures)
    remark(f"{name.replace('_', ' ').capitalize()} done after {time.perf_counter() - started:.1f} s.")
    return good, written
