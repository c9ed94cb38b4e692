"""Subcommands of `rfem-jax` for analyses: `modes` and `turn`.

Place in the pipeline: modes_report, turn_report -> **commands** -> command_line.
"""

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rfem_jax.description.study import Study
    from rfem_jax.mechanics.model import Model

Announce = Callable[[str], None]
Show = Callable[[str], None]


def add_analyses(commands: Any, add_common: Callable[[argparse.ArgumentParser], None], action: Callable) -> None:
    """Add the parsers of the analyses; `action` gets the arguments, with `analysis` the function that does it."""
    modes = commands.add_parser(
        "modes",
        help="natural frequencies and modes of the assembled mechanism",
        description="Natural frequencies and modes of every case about its assembled start, with its preload and "
        "weight, and their derivatives by the errors of [tolerances] and of the cases. Writes modes.json, modes.csv "
        "and a picture.",
    )
    add_common(modes)
    modes.add_argument("--count", metavar="N", type=int, default=6, help="number of modes (default: 6)")
    modes.add_argument("--free", action="store_true", help="the drive does not lock its joint")
    modes.set_defaults(action=action, analysis=_modes)
    turn = commands.add_parser(
        "turn",
        help="loads of the mechanism held still over the range of its drive",
        description="The kinetostatic turn: the mechanism of every case held still at positions of its first drive. "
        "Preload of all joints, holding moment, stresses. Writes turn.json, turn.csv and a picture.",
    )
    add_common(turn)
    turn.add_argument("--positions", metavar="N", type=int, default=72, help="number of positions (default: 72)")
    turn.add_argument("--from", dest="start", metavar="X", help='first position, as "-30 deg" (default: the start)')
    turn.add_argument("--to", dest="stop", metavar="X", help="last position (default: over a revolution)")
    turn.set_defaults(action=action, analysis=_turn)


def _modes(arguments: argparse.Namespace, study: "Study", model: "Model", folder: Path, announce: Announce, show: Show):
    """Natural frequencies of all cases; returns whether all were assembled, and the files."""
    from rfem_jax.report.analyses import modes_report as report

    announce("Finding natural frequencies")
    result = report.compute_modes(study, model, arguments.count, not arguments.free)
    show(report.modes_text(study, result))
    written = report.write_modes(folder, study, result)
    announce("Drawing pictures")
    pictures, hint = report.draw_modes(folder, study, model, result)
    if hint:
        show(hint)
    return set(report.statuses(result)) == {"ok"}, [*written, *pictures]


def _turn(arguments: argparse.Namespace, study: "Study", model: "Model", folder: Path, announce: Announce, show: Show):
    """The kinetostatic turn of all cases; returns whether all were assembled, and the files."""
    from rfem_jax.report.analyses import turn_report as report
    from rfem_jax.simulation.turn import turn_positions

    start, stop = (_position(getattr(arguments, name), name, model) for name in ("start", "stop"))
    positions = turn_positions(model, arguments.positions, start, stop)
    announce(f"Finding equilibria at {len(positions)} positions")
    turn = report.compute_turn(study, model, positions)
    show(report.turn_text(study, model, turn))
    written = report.write_turn(folder, study, model, turn)
    announce("Drawing pictures")
    pictures, hint = report.draw_turn(folder, study, model, turn)
    if hint:
        show(hint)
    return set(report.statuses(turn)) == {"ok"}, [*written, *pictures]


def _position(text: str | None, name: str, model: "Model") -> float | None:
    """A position of the first drive in rad or m, of a number or a string with a unit."""
    from rfem_jax.description.units import quantity

    if text is None:
        return None
    driven = model.topology.driven_coordinate
    dimension = "length" if driven is not None and model.topology.slides[driven] else "angle"
    option = {"start": "--from", "stop": "--to"}[name]
    try:
        value: Any = float(text)
    except ValueError:
        value = text
    return quantity(value, dimension, option)
