"""`rfem-jax sensitivity`, `monte-carlo`, ...: one subcommand for every kind of task.

Place in the pipeline: `rfem_jax.task_kinds` -> **tasks** -> the reports on tasks.
"""

import argparse
import time
from dataclasses import replace
from pathlib import Path

from rfem_jax.report.commands.command import (
    CASE_FAILED,
    DONE,
    Answer,
    Command,
    add_pictures,
    add_processes,
    add_study_and_folder,
)
from rfem_jax.report.commands.folders import open_folder, require_folder
from rfem_jax.report.commands.steps import (
    files_document,
    finish,
    prepare_pictures,
    read_study,
    require_task_folders,
    settle_method,
    write_task,
)
from rfem_jax.report.contents.annotations import Study
from rfem_jax.task_kinds import TaskKind, task_kinds


def task_commands() -> list[Command]:
    """The subcommands of all kinds of tasks that are known."""
    return [_command_of(kind) for kind in task_kinds().values()]


def _command_of(kind: TaskKind) -> Command:
    def add_arguments(parser: argparse.ArgumentParser) -> None:
        add_study_and_folder(parser)
        add_pictures(parser)
        if kind.many_processes:
            add_processes(parser)
        if kind.data:
            parser.add_argument("--data", metavar="FILE.csv", help="the measurements, in the place of the table's")

    return Command(
        name=kind.command or kind.name,
        purpose=kind.purpose,
        description=f"Do the task of the study's table [{kind.name}]: {kind.purpose}. Writes JSON, CSV "
        f"and pictures: {kind.results}.",
        epilog=f"An interruption (Ctrl-C) leaves {kind.kept or 'the evaluations that are done'}, and the same command "
        "goes on from there.",
        add_arguments=add_arguments,
        act=lambda arguments: _do(kind.name, arguments),
    )


def _do(task: str, arguments: argparse.Namespace) -> Answer:
    started = time.perf_counter()
    study = read_study(arguments.study)

    from rfem_jax.report.tasks.catalogue import require_task

    require_task(study, task)
    if getattr(arguments, "data", None) is not None:
        study = _with_data(study, task, arguments.data)
    require_folder(arguments.out)
    require_task_folders(study, (task,), arguments.out)
    prepare_pictures(arguments.pictures)
    study = settle_method(study, task)
    folder = open_folder(arguments.out)
    good, written = write_task(study, task, folder, arguments.pictures)
    if written:  # not by the helpers of process 0
        return finish(folder, written, good, started, arguments.pictures)
    return Answer(DONE if good else CASE_FAILED, files_document(folder, written))


def _with_data(study: Study, task: str, path: str) -> Study:
    """The study with another file of measurements."""
    from rfem_jax.description.tasks import Tasks

    asked = dict(study.tasks.asked)
    asked[task] = replace(asked[task], data=str(Path(path).absolute()))
    return replace(study, tasks=Tasks(study.tasks.tolerances, **asked))
