"""The command `rfem-jax`: from a study file to tables, files and pictures.

Place in the pipeline: the outermost layer; it calls `load_study` (description), `discretise` and
`describe` (mechanics), `check_step` and `run_cases` (simulation) and the other modules of this
room. Exit codes: 0 done; 2 the input is wrong (one sentence on standard error); 3 a case failed
(results are written all the same); 130 interrupted.

Imports that take seconds (JAX, matplotlib) are inside the functions: `--help` is instant.
"""

import argparse
import os
import sys
import time
from pathlib import Path

DONE, WRONG_INPUT, CASE_FAILED, INTERRUPTED = 0, 2, 3, 130

_PLOTS_HINT = (
    'No pictures were drawn: matplotlib is not installed (pip install "rfem_jax[plots]").'
)


class _Parser(argparse.ArgumentParser):
    """A parser whose complaints are one sentence, like all others of this command."""

    def error(self, message):
        self.exit(WRONG_INPUT, f"{message} (see `{self.prog} --help`)\n")


def build_parser() -> argparse.ArgumentParser:
    """Parser of the command with its subcommands `run` and `check`."""
    parser = _Parser(
        prog="rfem-jax",
        description="Loads in the joints of mechanisms with flexible links and assembly errors.",
        epilog="Exit codes: 0 done; 2 the input is wrong; 3 a case failed; 130 interrupted.",
    )
    commands = parser.add_subparsers(title="commands", dest="command", required=True)
    run = commands.add_parser(
        "run",
        help="simulate all cases of a study; write tables, histories and pictures",
        description="Simulate all cases of a study together, print the loads in all joints and "
        "write results.json, one CSV of time histories per case, and pictures.",
        epilog="Pictures need the extra `plots`. Compiled programs are kept in the user's cache "
        "folder; set JAX_COMPILATION_CACHE_DIR to keep them elsewhere.",
    )
    run.add_argument("study", metavar="STUDY.toml", help="the study file")
    run.add_argument("--out", metavar="DIR", required=True, help="folder for the results")
    run.set_defaults(action=_run)
    check = commands.add_parser(
        "check",
        help="validate a study and print what was understood",
        description="Validate a study file and print what was understood (links, joints, "
        "coordinates, mobility, rank, largest stable step, cases) without simulating.",
    )
    check.add_argument("study", metavar="STUDY.toml", help="the study file")
    check.set_defaults(action=_check)
    return parser


def user_cache_folder() -> Path:
    """The platform's folder for files that may be deleted at any time, `.../rfem_jax`."""
    if sys.platform == "win32":
        base = os.environ.get("LOCALAPPDATA") or Path.home() / "AppData" / "Local"
    elif sys.platform == "darwin":
        base = Path.home() / "Library" / "Caches"
    else:
        base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "rfem_jax"


def set_up_jax() -> None:
    """Double precision and, unless the user chose a folder, a cache of compiled programs."""
    import jax

    jax.config.update("jax_enable_x64", True)
    if jax.config.jax_compilation_cache_dir is not None:
        return
    try:
        folder = user_cache_folder() / "compiled"
        folder.mkdir(parents=True, exist_ok=True)
    except (OSError, RuntimeError):
        # No home, or one that cannot be written: compiling again each time is all that is lost.
        return
    jax.config.update("jax_compilation_cache_dir", str(folder))
    # The default keeps only what took a second; a study has dozens of smaller programs.
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)


def open_folder(out) -> Path:
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


def _cannot_write(folder, problem):
    from rfem_jax.description.errors import InputError

    return InputError(
        f"Argument `--out` must be a folder that can be written, but {folder} is not "
        f"({problem.strerror or problem}); choose another one or make room."
    )


class Progress:
    """How far a simulation is, on `stream`: one line that is rewritten, or four in a log file.

    An instance is the callable `progress` of `run_cases`: it takes the fraction done (0 to 1).
    """

    def __init__(self, label, stream):
        self.label, self.stream = label, stream
        self.live = stream.isatty()
        self.started = time.perf_counter()
        self.percent = 0
        self._write(f"{label}: compiling ...")

    def __call__(self, fraction):
        percent = int(100.0 * min(max(float(fraction), 0.0), 1.0))
        step = 1 if self.live else 25
        # Reports come from the threads of a batch, late or twice.
        if percent // step <= self.percent // step:
            return
        self.percent = percent
        seconds = time.perf_counter() - self.started
        self._write(f"{self.label}: {percent:3d} % after {seconds:.1f} s")

    def close(self):
        """End the line, so that what is printed next starts on its own."""
        if self.live:
            self.stream.write("\n")

    def _write(self, text):
        self.stream.write(f"\r{text:<60}" if self.live else f"{text}\n")
        self.stream.flush()


def _simulate(study):
    """All cases with their progress on standard error; returns {case: run}."""
    from rfem_jax.simulation import run_cases

    count = len(study.cases)
    progress = Progress(f"Simulating {count} case{'s' if count > 1 else ''}", sys.stderr)
    try:
        _, runs = run_cases(study, progress=progress)
    finally:
        progress.close()
    return runs


def _write_pictures(folder, study, runs, summaries) -> list[Path]:
    try:
        import matplotlib  # noqa: F401
    except ImportError:
        print(_PLOTS_HINT)
        return []
    from rfem_jax.report.figures import write_figures

    return write_figures(folder, study, runs, summaries)


def _run(arguments) -> int:
    from rfem_jax.description import load_study

    started = time.perf_counter()
    study = load_study(arguments.study)

    from rfem_jax.mechanics import discretise
    from rfem_jax.report.files import write_files
    from rfem_jax.report.summary import summarise
    from rfem_jax.report.tables import results_text
    from rfem_jax.simulation import STATUS, check_step

    check_step(discretise(study.mechanism), study.method)
    folder = open_folder(arguments.out)
    runs = _simulate(study)
    statuses = {name: STATUS[int(run.status)] for name, run in runs.items()}
    summaries = summarise(study, runs, statuses)
    print(results_text(study, summaries), end="\n\n", flush=True)
    try:
        written = write_files(folder, study, runs, summaries)
        written += _write_pictures(folder, study, runs, summaries)
    except OSError as problem:
        raise _cannot_write(folder, problem) from problem
    seconds = time.perf_counter() - started
    print(f"{len(written)} files written to {folder} ({seconds:.1f} s in all).")
    failed = any(one["status"] != "ok" for one in summaries.values())
    return CASE_FAILED if failed else DONE


def _check(arguments) -> int:
    from rfem_jax.description import load_study

    study = load_study(arguments.study)

    from rfem_jax.mechanics import describe, discretise
    from rfem_jax.report.overview import study_text
    from rfem_jax.simulation import check_step

    model = discretise(study.mechanism)
    print(study_text(study, describe(model)), end="\n\n", flush=True)
    step = check_step(model, study.method)
    found = "chosen by the method" if step is None else f"{float(step):.3g} s"
    print(f"Largest stable step of {study.method.name}: {found}.")
    return DONE


def main(argv=None) -> int:
    """Run the command with the arguments `argv` (default: those of the process).

    Returns the exit code; wrong input, an interruption and files that cannot be written become
    one sentence on standard error, anything else is a fault of this program and raises.
    """
    try:
        arguments = build_parser().parse_args(argv)
    except SystemExit as end:
        return int(end.code or 0)
    try:
        set_up_jax()
        from rfem_jax.description.errors import InputError

        try:
            return arguments.action(arguments)
        except InputError as problem:
            print(" ".join(str(problem).split()), file=sys.stderr)
            return WRONG_INPUT
    except KeyboardInterrupt:
        print("Interrupted: the results of this study are not complete.", file=sys.stderr)
        return INTERRUPTED


if __name__ == "__main__":
    sys.exit(main())
