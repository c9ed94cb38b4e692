"""`rfem-jax run`: all cases of a study, and then every task that it declares.

Place in the pipeline: `load_study` (description) -> `check_step`, `run_cases` (simulation) -> summary, tables, files,
pictures -> the reports on tasks.
"""

import argparse
import time
from pathlib import Path

from rfem_jax.report.annotations import Run, Study, Summaries
from rfem_jax.report.commands.command import CASE_FAILED, DONE, Answer, Command, add_study_and_folder
from rfem_jax.report.commands.folders import cannot_write, open_folder, require_folder
from rfem_jax.report.commands.steps import (
    announce,
    files_document,
    read_study,
    require_task_folders,
    settle_method,
    write_page,
    write_task,
)
from rfem_jax.report.progress_line import note, show
from rfem_jax.task_kinds import task_kinds


def command() -> Command:
    """The subcommand."""
    return Command(
        name="run",
        purpose="simulate all cases of a study, then do every task that it declares",
        description="Simulate all cases of a study together, print the loads in all joints and "
        "write results.json, one CSV of time histories per case, pictures and report.html; then do every task "
        f"that the study declares ({', '.join(f'[{name}]' for name in task_kinds())}).",
        epilog="Pictures need the extra `plots`. Compiled programs are kept in the user's cache "
        "folder, so that the next run starts at once.",
        add_arguments=add_study_and_folder,
        act=act,
        kept=" and ".join(kind.kept for kind in task_kinds().values() if kind.kept),
    )


def act(arguments: argparse.Namespace) -> Answer:
    """Simulate, print, write, draw; then the tasks. Raises InputError."""
    started = time.perf_counter()
    study = read_study(arguments.study)

    from rfem_jax.report.files import write_files
    from rfem_jax.report.summary import summarise
    from rfem_jax.report.tables import results_text
    from rfem_jax.simulation import STATUS

    require_folder(arguments.out)
    require_task_folders(study, study.tasks.declared, arguments.out)
    study = settle_method(study)
    folder = open_folder(arguments.out)
    runs = _simulate(study)
    statuses = {name: STATUS[int(run.status)] for name, run in runs.items()}
    summaries = summarise(study, runs, statuses)
    show(results_text(study, summaries), end="\n\n")
    try:
        written = write_files(folder, study, runs, summaries)
        written += _write_pictures(folder, study, runs, summaries)
        written += _write_animation(folder, runs)
    except OSError as problem:
        raise cannot_write(folder, problem) from problem
    good = all(one["status"] == "ok" for one in summaries.values())
    if study.tasks.declared:
        show()
    for task in study.tasks.declared:
        done, files = write_task(study, task, folder)
        good, written = good and done, written + files
    written += write_page(folder)
    seconds = time.perf_counter() - started
    show(f"{len(written)} files written to {folder} ({seconds:.1f} s in all).")
    return Answer(DONE if good else CASE_FAILED, files_document(folder, written))


def _simulate(study: Study) -> dict[str, Run]:
    """All cases with their progress on standard error; returns {case: run}."""
    from rfem_jax.simulation import run_cases

    count = len(study.cases)
    stage = f"Simulating {count} case{'s' if count > 1 else ''}"
    announce(stage)
    _, runs = run_cases(study, progress=lambda done: announce(stage, done))
    return runs


def _write_pictures(folder: Path, study: Study, runs: dict[str, Run], summaries: Summaries) -> list[Path]:
    try:
        import matplotlib  # noqa: F401
    except ImportError:
        from rfem_jax.report.summary import PLOTS_HINT

        note(PLOTS_HINT)
        return []
    announce("Drawing pictures")
    from rfem_jax.report.figures import write_figures

    return write_figures(folder, study, runs, summaries)


def _write_animation(folder: Path, runs: dict[str, Run]) -> list[Path]:
    from rfem_jax.report.page.animation import write_animation

    announce("Tracing where the mechanism is")
    return write_animation(folder, runs)
