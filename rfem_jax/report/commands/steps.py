"""What several subcommands do: read a study, settle its method, say what begins, do a task, list the files.

Place in the pipeline: used by the subcommands; imports what it needs when it is called.
"""

import json
import sys
import threading
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from rfem_jax.report.commands.command import CASE_FAILED, DONE, Answer, Interrupted
from rfem_jax.report.commands.folders import cannot_write, writing_into
from rfem_jax.report.contents.annotations import Model, Study
from rfem_jax.report.terminal.messages import note, paint, remark, say, show


def announce(stage: str, done: float | None = None) -> None:
    """Tell the progress line what begins, or how much of it is done."""
    from rfem_jax.compilation.stages import on_stage

    on_stage(stage, done)


def read_study(path: str) -> Study:
    """The study of a file; remarks on numbers that most likely lack their unit. Raises InputError."""
    from rfem_jax.description import load_study
    from rfem_jax.description.study_file.plausibility import doubtful_numbers

    announce(f"Reading {path}")
    study = load_study(path)
    for sentence in doubtful_numbers(study):
        remark(sentence)
    return study


def discretise_study(study: Study, at_rest: bool = False) -> Model:
    """The model of the study's mechanism, `at_rest` with what its table [statics] holds; what is wrong with it is said
    with the file's name."""
    from rfem_jax.description.basics.errors import located
    from rfem_jax.mechanics.statics.designs import model_of_study

    with located(f"Study file `{study.path}`"):
        return model_of_study(study, at_rest)


def settle_method(study: Study, task: str = "") -> Study:
    """The study with a method whose step is known to be stable; says what "auto" stands for, for its cases or a
    task. Raises InputError for a study without a simulation, but for tasks of a mechanism at rest."""
    if task and study.statics is not None:
        return study
    duration = study.require_duration()
    from rfem_jax.simulation import check_step

    model = discretise_study(study)
    if study.method.name != "auto":
        announce("Looking for the largest stable step")
        check_step(model, study.method, study.designed_drive)
        return study
    from dataclasses import replace

    from rfem_jax.simulation import choose_method

    announce("Choosing the method and its step")
    trials = _trials(study, task) if task else None
    method = choose_method(model, study.method, study.designed_drive, duration, trials, study.save_every)
    purpose = "" if trials is None else f" for {task.replace('_', ' ')}"
    note(f"Method auto{purpose}: {method.name} with a step of {method.step:.3g} s.")
    return replace(study, method=method, asked_method=study.method)


def settle_task(study: Study, task: str, folder: Path) -> Study:
    """The study, whose method is that of its cases, with the method for a task. Raises Interrupted."""
    if study.asked_method is None or study.statics is not None or _trials(study, task) is None:
        return study
    from dataclasses import replace

    with _interruptible(study, task, folder):
        return settle_method(replace(study, method=study.asked_method, asked_method=None), task)


def _trials(study: Study, task: str) -> Any:
    from rfem_jax.report.tasks.catalogue import report_on

    return report_on(study, task).trials()


def write_task(study: Study, task: str, folder: Path, pictures: bool = True) -> tuple[bool, list[Path]]:
    """Do a task of a study, `pictures`: with these; returns whether it succeeded, and the files written. Raises:
    InputError; Interrupted."""
    from rfem_jax.report.tasks.catalogue import do_task, report_on

    try:
        with _interruptible(study, task, folder), timed(study, task, report_on(study, task).left(folder)):
            return do_task(study, task, folder, pictures)
    except TimeoutError as problem:  # another process that shares the work has stopped
        say(paint(str(problem), "red", sys.stderr))
        return False, []


@contextmanager
def _interruptible(study: Study, task: str, folder: Path) -> Iterator[None]:
    """In which Ctrl-C and files that cannot be written end a task with a sentence."""
    from rfem_jax.report.tasks.catalogue import report_on

    try:
        yield
    except TimeoutError:
        raise
    except OSError as problem:
        raise cannot_write(folder, problem) from problem
    except KeyboardInterrupt:
        left = report_on(study, task).left(folder)
        going_on = f"{left}; the same command goes on from there." if left else "start it again from its beginning."
        raise Interrupted(f"{task.replace('_', ' ')} is not complete: {going_on}") from None


LONG = 5.0  # s from which the time of cases is told beforehand


@contextmanager
def timed(study: Study, task: str = "", left: str = "") -> Iterator[None]:
    """In which a task of a study ("": its cases) is done: says before how long that will take, and records what it took
    for the next time. `left`: what an interrupted run has left, with which it takes less."""
    from rfem_jax.compilation import keeping
    from rfem_jax.report.terminal import timings

    key, samples = timings.key_of(study, task), timings.samples_of(study, task)
    if task:
        from rfem_jax.report.tasks.catalogue import report_on
        from rfem_jax.task_kinds import task_kinds

        needed = "; ".join(report_on(study, task).simulations())
        what = ": ".join(one for one in (task_kinds()[task].title, needed) if one)
        remark(timings.estimate_text(what + (f"; {left}, and serve" if left else ""), key, samples))
    elif (known := timings.estimate(key, samples)) is not None and known[0] > LONG:
        remark(timings.estimate_text(f"{len(study.cases)} cases", key, samples))
    started, traced = time.perf_counter(), keeping.statistics.traced
    yield
    if not left:
        timings.record(key, time.perf_counter() - started, samples, keeping.statistics.traced > traced)


def write_page(folder: Path) -> list[Path]:
    """Write the page of all results that the folder has; says which other file in it is damaged, and writes none then.
    Raises InputError."""
    from rfem_jax.description.basics.errors import InputError
    from rfem_jax.report.page.document import write_folder

    announce("Writing report.html")
    with writing_into(folder):
        try:
            return [write_folder(folder)]
        except InputError as problem:
            remark(f"report.html is not written: {problem}")
    return []


def finish(folder: Path, written: list[Path], good: bool, started: float, pictures: bool = True) -> Answer:
    """Write the page of all results, and say how many files were written since `started` [s of `perf_counter`], and
    without `pictures` that those in the folder are older; the answer of a command whose results are `good`, or failed
    in part."""
    written = written + write_page(folder)
    if not pictures and any(folder.glob("*.png")):
        remark(f"Pictures in {folder} are older than these results.")
    show(f"{len(written)} files written to {folder} ({time.perf_counter() - started:.1f} s in all).")
    return Answer(DONE if good else CASE_FAILED, files_document(folder, written))


def require_task_folders(study: Study, tasks: Sequence[str], out: str | Path) -> None:
    """See that the folder can hold what these tasks keep there, before anything is computed."""
    if not tasks:
        return
    from rfem_jax.report.tasks.catalogue import report_on

    for task in tasks:
        report_on(study, task).require_folder(Path(out))


def prepare_pictures(wanted: bool = True, beside: bool = True) -> None:
    """Import what pictures need in the background, while something is computed, if they are `wanted`; `beside`: in the
    process that draws half of many, too."""
    from rfem_jax.report.drawings.pictures import draw_beside

    def load():
        with suppress(Exception):  # said where they are drawn
            import matplotlib.backends.backend_agg  # noqa: F401

            import rfem_jax.report.drawings.figures  # noqa: F401

    if not wanted:
        return
    if beside:
        draw_beside()
    threading.Thread(target=load, daemon=True).start()


def files_document(folder: Path | None, files: Iterable[Path]) -> dict[str, Any]:
    """Part of an answer: the folder, the files written, and what the JSON files among them say, by their names."""
    files = list(files)
    contents = {one.name: json.loads(one.read_text(encoding="utf-8")) for one in files if one.suffix == ".json"}
    return {"folder": None if folder is None else str(folder), "files": [str(one) for one in files]} | contents
