"""`rfem-jax run`: all cases of a study, and then every task that it declares.

Place in the pipeline: `load_study` (description) -> `check_step`, `run_cases` (simulation) -> summary, tables, files,
pictures -> the reports on tasks.
"""

import argparse
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rfem_jax.report.commands.command import (
    Answer,
    Command,
    Interrupted,
    add_axes,
    add_motion,
    add_pictures,
    add_study_and_folder,
)
from rfem_jax.report.commands.folders import open_folder, require_folder, writing_into
from rfem_jax.report.commands.steps import (
    announce,
    files_document,
    finish,
    prepare_pictures,
    read_study,
    require_task_folders,
    settle_method,
    settle_task,
    timed,
    write_task,
)
from rfem_jax.report.contents.annotations import Run, Study, Summaries
from rfem_jax.report.terminal.messages import paint, remark, show
from rfem_jax.task_kinds import task_kinds

UNFINISHED = "unfinished_cases.npz"


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
        add_arguments=_add_arguments,
        act=act,
    )


def _add_arguments(parser: argparse.ArgumentParser) -> None:
    add_study_and_folder(parser)
    add_axes(parser)
    add_motion(parser)
    add_pictures(parser)


def act(arguments: argparse.Namespace) -> Answer:
    """Simulate, print, write, draw; then the tasks. Raises InputError."""
    started = time.perf_counter()
    study = read_study(arguments.study)

    from rfem_jax.mechanics.model.status import PAST_LIMIT
    from rfem_jax.report.contents.files import start_of, write_files
    from rfem_jax.report.contents.overview import start_text
    from rfem_jax.report.contents.summary import readable, summarise
    from rfem_jax.report.contents.tables import results_text
    from rfem_jax.simulation import STATUS
    from rfem_jax.text_layout import wrap_lines

    require_folder(arguments.out)
    require_task_folders(study, study.tasks.declared, arguments.out)
    study = settle_method(study)
    folder = open_folder(arguments.out)
    prepare_pictures(arguments.pictures)
    runs = {name: readable(run) for name, run in _simulate(study, folder).items()}
    statuses = {name: STATUS[int(run.status)] for name, run in runs.items()}
    if any(int(run.status) == PAST_LIMIT for run in runs.values()):
        statuses = _with_place(statuses, runs, study)
    summaries = summarise(study, runs, statuses, arguments.axes)
    start = start_of(runs)
    show(results_text(study, summaries), end="\n\n")
    if start is not None:
        show(wrap_lines(start_text(start)), end="\n\n")
    written: list[Path] = []
    try:
        with writing_into(folder):
            written += write_files(folder, study, runs, summaries, start, arguments.axes)
            written += write_run_pictures(folder, study, runs, summaries, arguments.pictures)
            written += write_run_animation(folder, runs, arguments.motion)
    except KeyboardInterrupt:
        sentence = f"the cases are done; of their files these are in {folder}: {_names(written)}. {_go_on(arguments)}"
        raise Interrupted(sentence, files_document(folder, written)) from None
    failed = [name for name, one in summaries.items() if one["status"] != "ok"]
    if failed:
        remark(paint(f"Not every case is complete: {', '.join(failed)}.", "red", sys.stderr))
    done, files = _do_tasks(study, folder, arguments, written)
    return finish(folder, written + files, done and not failed, started, arguments.pictures)


def _with_place(statuses: dict[str, Any], runs: dict[str, Run], study: Study) -> dict[str, Any]:
    """The statuses of runs past the limit of their mechanism with the place of this limit in their messages."""
    from rfem_jax.mechanics.model.status import PAST_LIMIT, STATUS
    from rfem_jax.simulation.locking import drive_limit

    model = next(iter(runs.values())).model
    limit = None if model is None else drive_limit(model, study.designed_drive, study.require_duration())
    if limit is None:
        return statuses
    told = STATUS[PAST_LIMIT]._replace(message=f"{STATUS[PAST_LIMIT].message} It locks {limit.text}.")
    return {name: told if one.name == told.name else one for name, one in statuses.items()}


def _names(files: list[Path]) -> str:
    return ", ".join(one.name for one in files) or "none"


def _go_on(arguments: argparse.Namespace, tasks: Sequence[str] = ()) -> str:
    """The commands that do the rest: of these tasks, or all again."""
    kinds = task_kinds()
    commands = [kinds[task].command for task in tasks] or ["run"]
    written = " && ".join(f"rfem-jax {one} {arguments.study} --out {arguments.out}" for one in commands)
    return f"Go on with: {written}"


def _do_tasks(study: Study, folder: Path, arguments: argparse.Namespace, before: list[Path]) -> tuple[bool, list[Path]]:
    """All tasks that the study declares. Raises: InputError; Interrupted, with the commands for the rest."""
    if study.tasks.declared:
        show()
    good, written = True, []
    for number, task in enumerate(study.tasks.declared):
        try:
            done, files = write_task(settle_task(study, task, folder), task, folder, arguments.pictures)
        except Interrupted as end:
            complete = ", ".join(("the cases", *(one.replace("_", " ") for one in study.tasks.declared[:number])))
            kept = end.sentence.removesuffix("; the same command goes on from there.").removesuffix(".")
            sentence = f"{complete} done, in {folder}; {kept}. {_go_on(arguments, study.tasks.declared[number:])}"
            raise Interrupted(sentence, files_document(folder, before + written)) from None
        good, written = good and done, written + files
    return good, written


def _simulate(study: Study, folder: Path) -> dict[str, Run]:
    """All cases with their progress on standard error; returns {case: run}. Raises: Interrupted."""
    from rfem_jax.simulation import run_cases

    count = len(study.cases)
    stage = f"Simulating {count} case{'s' if count > 1 else ''}"
    announce(stage)
    reached, kept, duration = 0.0, folder / UNFINISHED, study.require_duration()

    def progress(done: float) -> None:
        nonlocal reached
        reached = done
        announce(stage, done)

    try:
        with timed(study, left=UNFINISHED if kept.exists() else ""):
            _, runs = run_cases(study, progress=progress, keep=kept)
    except KeyboardInterrupt:
        if not kept.exists():
            raise
        raise Interrupted(
            f"the cases are simulated up to {reached * duration:.3g} s of {duration:g} s, which is kept in "
            f"{kept}; the same command goes on from there."
        ) from None
    return runs


def write_run_pictures(
    folder: Path, study: Study, runs: dict[str, Run], summaries: Summaries, wanted: bool = True
) -> list[Path]:
    """Draw the pictures of a run, if they are `wanted` and unless matplotlib is missing, which is said."""
    from rfem_jax.report.drawings.pictures import drawn

    def write():
        from rfem_jax.report.drawings.figures import write_figures

        return write_figures(folder, study, runs, summaries)

    return drawn(write) if wanted else []


def write_run_animation(folder: Path, runs: dict[str, Run], formats: Sequence[str] = ()) -> list[Path]:
    """Write where the mechanism is, for the page, and in the formats of other programs (`motion_files`)."""
    from rfem_jax.report.page.animation import record_animation, write_arrays

    announce("Tracing where the mechanism is")
    records = record_animation(runs)
    if records is None:
        return []
    written = [write_arrays(folder, *records)]
    if formats:
        from rfem_jax.report.contents.motion_files import write_motions

        written += write_motions(folder, runs, records, formats)
    return written
