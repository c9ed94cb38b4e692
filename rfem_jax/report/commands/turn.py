"""`rfem-jax turn`: the mechanism held still at one position of its drive after another.

Place in the pipeline: `load_study` (description) -> `analyses.turn_report` -> tables, files, a picture.
"""

import argparse
import time
from typing import Any

from rfem_jax.report.commands.command import Answer, Command, add_axes, add_study_and_folder
from rfem_jax.report.commands.folders import open_folder, require_folder, writing_into
from rfem_jax.report.commands.steps import announce, discretise_study, finish, prepare_pictures, read_study
from rfem_jax.report.contents.annotations import Model
from rfem_jax.report.terminal.messages import show


def command() -> Command:
    """The subcommand."""
    return Command(
        name="turn",
        purpose="loads of the mechanism held still over the range of its drive",
        description="The kinetostatic turn: the mechanism of every case held still at positions of its first drive. "
        "Preload of all joints, holding moment, stresses, contacts of joints with clearance. Writes "
        "turn.json, turn.csv, a picture and report.html.",
        add_arguments=_add_arguments,
        act=act,
    )


def _add_arguments(parser: argparse.ArgumentParser) -> None:
    add_study_and_folder(parser)
    add_axes(parser)
    parser.add_argument("--positions", metavar="N", type=int, default=72, help="number of positions (default: 72)")
    parser.add_argument("--from", dest="start", metavar="X", help='first position, as "30 deg" (default: the start)')
    parser.add_argument("--to", dest="stop", metavar="X", help="last position (default: over a revolution)")


def act(arguments: argparse.Namespace) -> Answer:
    """Assemble at all positions, print, write, draw. Raises InputError."""
    started = time.perf_counter()
    study = read_study(arguments.study)

    from rfem_jax.report.analyses import turn_report as report
    from rfem_jax.simulation.rest.turn import turn_positions

    require_folder(arguments.out)
    model = discretise_study(study)
    start, stop = (_position(getattr(arguments, name), name, model) for name in ("start", "stop"))
    positions = turn_positions(model, arguments.positions, start, stop)
    prepare_pictures(beside=False)
    announce(f"Finding equilibria at {len(positions)} positions")
    turn = report.compute_turn(study, model, positions, arguments.axes)
    folder = open_folder(arguments.out)
    show(report.turn_text(study, model, turn), end="\n\n")
    with writing_into(folder):
        written = report.write_turn(folder, study, model, turn)
        written += report.draw_turn(folder, study, model, turn)
    return finish(folder, written, set(report.labelled(study, turn).statuses()) == {"ok"}, started)


def _position(text: str | None, name: str, model: Model) -> float | None:
    """A position of the first drive in rad or m, of a number or a string with a unit."""
    from rfem_jax.description.basics.units import quantity

    if text is None:
        return None
    driven = model.topology.driven_coordinate
    dimension = "length" if driven is not None and model.topology.slides[driven] else "angle"
    try:
        value: Any = float(text)
    except ValueError:
        value = text
    return quantity(value, dimension, {"start": "--from", "stop": "--to"}[name])
