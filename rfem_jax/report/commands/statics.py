"""`rfem-jax statics`: loads in a mechanism or a structure at rest.

Place in the pipeline: `load_study` (description) -> `analyses.statics_report` -> tables, files.
"""

import argparse
import time
from dataclasses import replace
from typing import Any

from rfem_jax.report.commands.command import Answer, Command, add_study_and_folder
from rfem_jax.report.commands.folders import open_folder, require_folder, writing_into
from rfem_jax.report.commands.steps import announce, discretise_study, finish, read_study
from rfem_jax.report.contents.annotations import Study
from rfem_jax.report.terminal.messages import show


def command() -> Command:
    """The subcommand."""
    return Command(
        name="statics",
        purpose="loads in all joints, sections and points at rest",
        description="Static loads of every case, of a mechanism or of a structure, at its start or at given positions: "
        "loads in all joints, what holds the mechanism, internal forces, stresses and deflections of flexible links, "
        "places of points. The study needs neither [simulation] nor a drive. Writes statics.json, statics.csv, "
        "statics_sections.csv and report.html.",
        add_arguments=_add_arguments,
        act=act,
    )


def _add_arguments(parser: argparse.ArgumentParser) -> None:
    add_study_and_folder(parser)
    parser.add_argument(
        "--positions", metavar="JOINT=X,...", action="append", default=[],
        help='positions of a joint, held there, as "A=0 deg,30 deg"; may be repeated (default: as [statics] says)',
    )  # fmt: skip
    for name, words, example in (
        ("rates", "rates", "A=60 rpm"), ("accelerations", "accelerations", "A=0 rad/s^2,100 rad/s^2"),
    ):  # fmt: skip
        parser.add_argument(
            f"--{name}", metavar="JOINT=X,...", action="append", default=[],
            help=f'{words} of a joint of a mechanism of rigid links, as "{example}": loads in this motion',
        )  # fmt: skip
    parser.add_argument(
        "--hold", metavar="JOINT", action="append", default=[], help="hold a joint at its start; may be repeated"
    )


def act(arguments: argparse.Namespace) -> Answer:
    """Find the equilibria, print, write. Raises InputError."""
    started = time.perf_counter()
    study = _with_arguments(read_study(arguments.study), arguments)

    from rfem_jax.report.analyses import statics_report as report

    require_folder(arguments.out)
    model = discretise_study(study, at_rest=True)
    announce("Finding static equilibria")
    found = report.compute_statics(study, model)
    folder = open_folder(arguments.out)
    show(report.statics_text(study, found), end="\n\n")
    with writing_into(folder):
        written = report.write_statics(folder, study, found)
    return finish(folder, written, set(found.statuses) == {"ok"}, started)


def _with_arguments(study: Study, arguments: argparse.Namespace) -> Study:
    """The study with what the options hold, in the place of what its table [statics] says of the same."""
    from rfem_jax.description.basics.errors import InputError
    from rfem_jax.description.study_file.statics import Statics

    given: dict[str, dict[str, Any]] = {name: {} for name in ("positions", "rates", "accelerations")}
    if not arguments.hold and not any(getattr(arguments, name) for name in given):
        return study
    for name, of_joints in given.items():
        for text in getattr(arguments, name):
            joint, equals, values = text.partition("=")
            if not equals:
                raise InputError(
                    f"Argument `--{name}` must name a joint and its {name}, but was {text!r}; write for example "
                    '"A=0 deg,30 deg".'
                )
            of_joints[joint.strip()] = [_number_or_text(one) for one in values.split(",")]
    asked = Statics() if study.statics is None else study.statics
    chosen = {name: of_joints or getattr(asked, name) for name, of_joints in given.items()}
    asked = replace(asked, hold=(*asked.hold, *arguments.hold), **chosen)
    return replace(study, statics=asked, tasks=type(study.tasks)())


def _number_or_text(text: str) -> float | str:
    try:
        return float(text)
    except ValueError:
        return text.strip()
