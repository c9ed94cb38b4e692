"""`rfem-jax modes`: natural frequencies and modes of the assembled mechanism.

Place in the pipeline: `load_study` (description) -> `analyses.modes_report` -> tables, files, a picture.
"""

import argparse
import time

from rfem_jax.report.commands.command import Answer, Command, add_study_and_folder
from rfem_jax.report.commands.folders import open_folder, require_folder, writing_into
from rfem_jax.report.commands.steps import announce, discretise_study, finish, prepare_pictures, read_study
from rfem_jax.report.terminal.messages import show


def command() -> Command:
    """The subcommand."""
    return Command(
        name="modes",
        purpose="natural frequencies and modes of the assembled mechanism",
        description="Natural frequencies and modes of every case about its assembled start, with its preload and "
        "weight, and their derivatives by the errors of [tolerances] and of the cases. Writes modes.json, modes.csv "
        "a picture and report.html.",
        add_arguments=_add_arguments,
        act=act,
    )


def _add_arguments(parser: argparse.ArgumentParser) -> None:
    add_study_and_folder(parser)
    parser.add_argument("--count", metavar="N", type=int, default=6, help="number of modes (default: 6)")
    parser.add_argument("--free", action="store_true", help="the drive does not lock its joint")


def act(arguments: argparse.Namespace) -> Answer:
    """Assemble, find the modes, print, write, draw. Raises InputError."""
    started = time.perf_counter()
    study = read_study(arguments.study)

    from rfem_jax.report.analyses import modes_report as report

    require_folder(arguments.out)
    model = discretise_study(study)
    prepare_pictures(beside=False)
    announce("Finding natural frequencies")
    result = report.compute_modes(study, model, arguments.count, not arguments.free)
    folder = open_folder(arguments.out)
    show(report.modes_text(study, result), end="\n\n")
    with writing_into(folder):
        shapes = report.mode_shapes(study, model, result)
        written = report.write_modes(folder, study, result, shapes)
        written += report.draw_modes(folder, study, result, shapes)
    return finish(folder, written, set(report.statuses(result)) == {"ok"}, started)
