"""The command `rfem-jax`: from a study file to tables, files and pictures.

Place in the pipeline: the outermost layer; it calls `load_study` (description), `discretise` and `describe`
(mechanics), `check_step` and `run_cases` (simulation), `tasks` for tolerance studies (one subcommand for every kind of
task), and the other modules of this package; `progress_line` shows what is being done. Exit codes: 0 done; 2 the input
is wrong (one sentence on standard error); 3 a case or a task failed (results are written all the same); 1 nobody reads
what is printed any more; 130 interrupted.

Imports that take seconds (JAX, matplotlib) are inside the functions: `--help` is instant.
"""

import argparse
import gc
import os
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NoReturn

from rfem_jax.report.annotations import Model, Run, Study, Summaries
from rfem_jax.report.process import count_devices, join_processes, require_platform, set_up_jax
from rfem_jax.report.progress_line import ClosedPipe, ProgressLine, discard, say, show
from rfem_jax.task_kinds import task_kinds

DONE, UNREAD, WRONG_INPUT, CASE_FAILED, INTERRUPTED = 0, 1, 2, 3, 130


class _Parser(argparse.ArgumentParser):
    """A parser whose complaints are one sentence, like all others of this command."""

    def error(self, message: str) -> NoReturn:
        self.exit(WRONG_INPUT, f"{message} (see `{self.prog} --help`)\n")


def _version() -> str:
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version("rfem-jax")
    except PackageNotFoundError:
        return "(not installed)"


def build_parser() -> argparse.ArgumentParser:
    """Parser of the command with its subcommands."""
    parser = _Parser(
        prog="rfem-jax",
        description="Loads in the joints of mechanisms with flexible links and assembly errors.",
        epilog="Exit codes: 0 done; 1 the output is no longer read (as in a pipe to head); 2 the input is wrong; "
        "3 a case or a task failed; 130 interrupted.",
    )
    parser.add_argument("--version", action="version", version=f"rfem-jax {_version()}")
    commands = parser.add_subparsers(title="commands", dest="command", required=True)
    run = commands.add_parser(
        "run",
        help="simulate all cases of a study, then do every task that it declares",
        description="Simulate all cases of a study together, print the loads in all joints and "
        "write results.json, one CSV of time histories per case, and pictures; then do every task "
        f"that the study declares ({', '.join(f'[{name}]' for name in task_kinds())}).",
        epilog="Pictures need the extra `plots`. Compiled programs are kept in the user's cache "
        "folder, so that the next run starts at once.",
    )
    _add_common(run)
    run.set_defaults(action=_run, kept=" and ".join(kind.kept for kind in task_kinds().values() if kind.kept))
    for kind in task_kinds().values():
        one = commands.add_parser(
            kind.command or kind.name,
            help=kind.purpose,
            description=f"Do the task of the study's table [{kind.name}]: {kind.purpose}. Writes JSON, CSV "
            f"and pictures: {kind.results}.",
        )
        _add_common(one)
        one.set_defaults(action=_do_task, task=kind.name, kept=kind.kept)
        if kind.many_processes:
            _add_processes(one)
    check = commands.add_parser(
        "check",
        help="validate a study and print what was understood",
        description="Validate a study file and print what was understood (links, joints, "
        "coordinates, mobility, rank, largest stable step, cases, tasks, what they cost) without simulating.",
    )
    check.add_argument("study", metavar="STUDY.toml", help="the study file")
    _add_cache(check)
    check.set_defaults(action=_check)
    keys = commands.add_parser(
        "keys",
        help="print all keys of study files",
        description="Print all tables and keys that a study file may have, their defaults, and what they mean. "
        'Numbers are in SI units and radians, or strings with a unit such as "0.5 deg".',
    )
    keys.add_argument(
        "table", metavar="WORD", nargs="?", help='tables with this word in their header, such as "joints"'
    )
    keys.set_defaults(action=_keys, cache=True)
    _add_validate(commands)
    _add_report(commands)
    return parser


def _add_report(commands: Any) -> None:
    report = commands.add_parser(
        "report",
        help="write report.html from the files of a folder",
        description="Write report.html, a page for any browser, from the files that other commands have written into "
        "a folder: the mechanism as it moves, loads over time, tables, tasks, checks. Nothing is computed.",
    )
    report.add_argument("folder", metavar="DIR", help="the folder that was given to --out")
    report.set_defaults(action=_report, cache=True)


def _add_validate(commands: Any) -> None:
    validate = commands.add_parser(
        "validate",
        help="compute published benchmarks and compare with their reference values",
        description="Compute published benchmarks and print every value beside its reference; exit "
        "code 3 if one fails.",
    )
    _add_cache(validate)
    validate.add_argument("--full", action="store_true", help="fine discretisations too (slow)")
    validate.add_argument("--only", metavar="NAME", nargs="+", help="these benchmarks only")
    validate.add_argument("--out", metavar="DIR", help="folder for tables and pictures")
    validate.set_defaults(action=_validate)


def _add_common(command: argparse.ArgumentParser) -> None:
    command.add_argument("study", metavar="STUDY.toml", help="the study file")
    command.add_argument("--out", metavar="DIR", required=True, help="folder for the results")
    command.add_argument("--devices", metavar="K", type=int, help="CPU devices for samples (default: all cores)")
    _add_cache(command)


def _add_cache(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "--no-cache", dest="cache", action="store_false", help="keep no compiled programs, and use none"
    )


def _add_processes(command: argparse.ArgumentParser) -> None:
    group = command.add_argument_group(
        "several processes or machines",
        "Start the same command once per process; they share the folder DIR.",
    )
    group.add_argument("--coordinator", metavar="HOST:PORT", help="address of process 0")
    group.add_argument("--processes", metavar="N", type=int, help="number of processes")
    group.add_argument("--process-id", metavar="I", type=int, help="number of this process, from 0")


def require_folder(out: str | Path) -> None:
    """See that a folder for the results can be made, without making it. Raises InputError."""
    if not str(out).strip():
        from rfem_jax.description.errors import InputError

        raise InputError("Argument `--out` must name a folder, but is empty; write . for the current one.")
    folder = Path(out).absolute()
    existing = next(path for path in (folder, *folder.parents) if path.exists())
    if not existing.is_dir():
        raise _cannot_write(folder, NotADirectoryError(20, f"{existing} is a file"))
    if not os.access(existing, os.W_OK | os.X_OK):
        raise _cannot_write(folder, PermissionError(13, "permission denied"))


def open_folder(out: str | Path) -> Path:
    """Make the folder for the results and see that files can be written into it.

    Raises InputError before anything is simulated, not after.
    """
    folder = Path(out)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe = folder / f".{os.getpid()}.part"
        probe.touch()
        probe.unlink()
    except OSError as problem:
        raise _cannot_write(folder, problem) from problem
    return folder


def _cannot_write(folder: str | Path, problem: OSError) -> ValueError:
    from rfem_jax.description.errors import InputError

    return InputError(
        f"Argument `--out` must be a folder that can be written, but {folder} is not "
        f"({problem.strerror or problem}); choose another one or free some space."
    )


def _settle_method(study: Study) -> Study:
    """The study with a method whose step is known to be stable; says what "auto" stands for."""
    from rfem_jax.simulation import check_step

    model = _discretise(study)
    if study.method.name != "auto":
        _announce("Looking for the largest stable step")
        check_step(model, study.method, study.drive)
        return study
    from dataclasses import replace

    from rfem_jax.simulation import choose_method

    _announce("Choosing the method and its step")
    method = choose_method(model, study.method, study.drive, study.duration, save_every=study.save_every)
    show(f"Method auto: {method.name} with a step of {method.step:.3g} s.")
    return replace(study, method=method, asked_method=study.method)


def _discretise(study: Study) -> Model:
    """The model of the study's mechanism; what is wrong with it is said with the file's name."""
    from rfem_jax.description.errors import located
    from rfem_jax.mechanics import discretise

    with located(f"Study file `{study.path}`"):
        return discretise(study.mechanism)


def _announce(stage: str, done: float | None = None) -> None:
    """Tell the progress line what begins, or how much of it is done."""
    from rfem_jax.compilation.stages import on_stage

    on_stage(stage, done)


def _simulate(study: Study) -> dict[str, Run]:
    """All cases with their progress on standard error; returns {case: run}."""
    from rfem_jax.simulation import run_cases

    count = len(study.cases)
    stage = f"Simulating {count} case{'s' if count > 1 else ''}"
    _announce(stage)
    _, runs = run_cases(study, progress=lambda done: _announce(stage, done))
    return runs


def _write_pictures(folder: Path, study: Study, runs: dict[str, Run], summaries: Summaries) -> list[Path]:
    try:
        import matplotlib  # noqa: F401
    except ImportError:
        from rfem_jax.report.summary import PLOTS_HINT

        show(PLOTS_HINT)
        return []
    _announce("Drawing pictures")
    from rfem_jax.report.figures import write_figures

    return write_figures(folder, study, runs, summaries)


def _write_animation(folder: Path, runs: dict[str, Run]) -> list[Path]:
    from rfem_jax.report.page.animation import write_animation

    _announce("Tracing where the mechanism is")
    return write_animation(folder, runs)


def _write_page(folder: Path) -> list[Path]:
    """The page of all results that the folder has."""
    from rfem_jax.report.page.document import write_folder

    _announce("Writing report.html")
    try:
        return [write_folder(folder)]
    except OSError as problem:
        raise _cannot_write(folder, problem) from problem


def _report(arguments: argparse.Namespace) -> int:
    from rfem_jax.report.page.document import write_folder

    try:
        path = write_folder(arguments.folder)
    except OSError as problem:
        raise _cannot_write(arguments.folder, problem) from problem
    show(f"Written: {path}")
    return DONE


def _run(arguments: argparse.Namespace) -> int:
    from rfem_jax.description import load_study

    started = time.perf_counter()
    _announce(f"Reading {arguments.study}")
    study = load_study(arguments.study)

    from rfem_jax.report.files import write_files
    from rfem_jax.report.summary import summarise
    from rfem_jax.report.tables import results_text
    from rfem_jax.simulation import STATUS

    require_folder(arguments.out)
    _require_task_folders(study, study.tasks.declared, arguments.out)
    study = _settle_method(study)
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
        raise _cannot_write(folder, problem) from problem
    good = all(one["status"] == "ok" for one in summaries.values())
    if study.tasks.declared:
        show()
    for task in study.tasks.declared:
        done, files = _write_task(study, task, folder)
        good, written = good and done, written + files
    written += _write_page(folder)
    seconds = time.perf_counter() - started
    show(f"{len(written)} files written to {folder} ({seconds:.1f} s in all).")
    return DONE if good else CASE_FAILED


def _write_task(study: Study, task: str, folder: Path) -> tuple[bool, list[Path]]:
    from rfem_jax.report.tasks.task_report import do_task

    try:
        return do_task(study, task, folder)
    except OSError as problem:
        raise _cannot_write(folder, problem) from problem


def _require_task_folders(study: Study, tasks: Sequence[str], out: str | Path) -> None:
    """See that the folder can hold what these tasks keep there, before anything is computed."""
    if not tasks:
        return
    from rfem_jax.report.tasks.task_report import report_on

    for task in tasks:
        report_on(study, task).require_folder(Path(out))


def _do_task(arguments: argparse.Namespace) -> int:
    from rfem_jax.description import load_study

    started = time.perf_counter()
    _announce(f"Reading {arguments.study}")
    study = load_study(arguments.study)

    from rfem_jax.report.tasks.task_report import require_task

    require_task(study, arguments.task)
    require_folder(arguments.out)
    _require_task_folders(study, (arguments.task,), arguments.out)
    study = _settle_method(study)
    folder = open_folder(arguments.out)
    good, written = _write_task(study, arguments.task, folder)
    if written:  # not by the helpers of process 0
        written += _write_page(folder)
    seconds = time.perf_counter() - started
    if written:
        show(f"{len(written)} files written to {folder} ({seconds:.1f} s in all).")
    return DONE if good else CASE_FAILED


def _check(arguments: argparse.Namespace) -> int:
    from rfem_jax.description import load_study

    _announce(f"Reading {arguments.study}")
    study = load_study(arguments.study)

    from rfem_jax.mechanics import describe
    from rfem_jax.report.overview import study_text
    from rfem_jax.report.study_cost import cost_text
    from rfem_jax.report.tasks.task_overview import tasks_text
    from rfem_jax.simulation import check_step

    model = _discretise(study)
    show(study_text(study, describe(model)), end="\n\n")
    if text := tasks_text(study):
        show(text, end="\n\n")
    show(cost_text(study), end="\n\n")
    if study.method.name == "auto":
        _settle_method(study)
        return DONE
    _announce("Looking for the largest stable step")
    step = check_step(model, study.method, study.drive)
    found = "any, chosen by the method, or not known" if step is None else f"{float(step):.3g} s"
    show(f"Largest stable step of {study.method.name}: {found}.")
    return DONE


def _keys(arguments: argparse.Namespace) -> int:
    from rfem_jax.report.keys_text import reference_text

    show(reference_text(arguments.table))
    return DONE


def _validate(arguments: argparse.Namespace) -> int:
    from rfem_jax.report.validation_command import validate

    folder = None if arguments.out is None else open_folder(arguments.out)
    try:
        good, written = validate(arguments.only, arguments.full, folder, _announce)
    except OSError as problem:
        if folder is None:
            raise
        raise _cannot_write(folder, problem) from problem
    if written:
        show(f"{len(written)} files written to {folder}.")
    return DONE if good else CASE_FAILED


@contextmanager
def _rare_collections() -> Iterator[None]:
    """Hundreds of thousands of objects of JAX and matplotlib live as long as the command: looking through them for
    garbage as often as Python does by itself takes a tenth of the time."""
    before = gc.get_threshold()
    gc.set_threshold(50_000, 20, 100)
    try:
        yield
    finally:
        gc.set_threshold(*before)


def _act(arguments: argparse.Namespace, line: ProgressLine) -> int:
    set_up_jax(count_devices(arguments), arguments.cache, getattr(arguments, "out", None))
    join_processes(arguments)
    require_platform()
    from rfem_jax.compilation.stages import listening

    with listening(line):
        return arguments.action(arguments)


def _what_is_kept(arguments: argparse.Namespace) -> str:
    kept = getattr(arguments, "kept", "")
    return f"; {kept} are kept, and the same command continues it" if kept else ""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command with the arguments `argv` (default: those of the process).

    Returns the exit code; wrong input, an interruption and files that cannot be written become
    one sentence on standard error, anything else is a fault of this program and raises.
    """
    try:
        code = _main(argv)
        sys.stdout.flush()
    except (ClosedPipe, BrokenPipeError):
        discard(sys.stdout)
        return UNREAD
    return code


def _main(argv: Sequence[str] | None) -> int:
    try:
        arguments = build_parser().parse_args(argv)
    except SystemExit as end:
        return int(end.code or 0)
    try:
        with _rare_collections(), ProgressLine(sys.stderr) as line:
            line("Loading JAX")
            from rfem_jax.description.errors import InputError

            try:
                return _act(arguments, line)
            except InputError as problem:
                for sentence in problem.problems:
                    say(" ".join(sentence.split()))
                return WRONG_INPUT
    except KeyboardInterrupt:
        print(f"Interrupted: the results of this study are not complete{_what_is_kept(arguments)}.", file=sys.stderr)
        return INTERRUPTED


if __name__ == "__main__":
    sys.exit(main())
