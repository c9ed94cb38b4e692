"""`rfem-jax cycle`: loads over one revolution of the steady cycle of a driven mechanism, without a start-up.

Place in the pipeline: `load_study` (description) -> `steady_cycle` (simulation) -> summary, tables, files, pictures,
all as those of `rfem-jax run`; how it was found -> cycle.json.
"""

import argparse
import time
from dataclasses import replace
from typing import Any

from rfem_jax.report.commands.command import Answer, Command, add_axes, add_motion, add_pictures, add_study_and_folder
from rfem_jax.report.commands.folders import open_folder, require_folder, writing_into
from rfem_jax.report.commands.run import write_run_animation, write_run_pictures
from rfem_jax.report.commands.steps import (
    announce,
    discretise_study,
    finish,
    prepare_pictures,
    read_study,
    settle_method,
)
from rfem_jax.report.contents.annotations import Cycle, Study
from rfem_jax.report.terminal.messages import note, show


def command() -> Command:
    """The subcommand."""
    return Command(
        name="cycle",
        purpose="loads over one revolution of the steady cycle, without a start-up",
        description="Simulate every case, driven at the constant rate of its prescribed_rate drive, until the motion "
        "repeats with every revolution; print and write the loads of one revolution in the files of `rfem-jax run`, "
        "report.html among them, and in cycle.json how the cycle was found.",
        add_arguments=_add_arguments,
        act=act,
    )


def _add_arguments(parser: argparse.ArgumentParser) -> None:
    add_study_and_folder(parser)
    add_axes(parser)
    add_motion(parser)
    add_pictures(parser)
    parser.add_argument("--tolerance", metavar="X", type=float, default=1e-6, help="of the motion (default: 1e-6)")
    parser.add_argument("--most", metavar="N", type=int, default=200, help="revolutions at most (default: 200)")


def act(arguments: argparse.Namespace) -> Answer:
    """Find the cycles, print, write, draw. Raises InputError."""
    started = time.perf_counter()
    study = _of_one_revolution(read_study(arguments.study))

    from rfem_jax.report.analyses.analysis import write_analysis
    from rfem_jax.report.contents.files import write_files
    from rfem_jax.report.contents.summary import readable, summarise
    from rfem_jax.report.contents.tables import results_text
    from rfem_jax.simulation import STATUS
    from rfem_jax.simulation.cycle import require_constant_rate

    require_folder(arguments.out)
    require_constant_rate(discretise_study(study), study.designed_drive)
    study = settle_method(study)
    folder = open_folder(arguments.out)
    prepare_pictures(arguments.pictures)
    cycles = _cycles(study, arguments.tolerance, arguments.most)
    runs = {name: readable(cycle.run) for name, cycle in cycles.items()}
    statuses = {name: STATUS[int(run.status)] for name, run in runs.items()}
    summaries = summarise(study, runs, statuses, arguments.axes)
    show(results_text(study, summaries), end="\n\n")
    with writing_into(folder):
        written = write_files(folder, study, runs, summaries, axes=arguments.axes)
        written += write_run_pictures(folder, study, runs, summaries, arguments.pictures)
        written += write_run_animation(folder, runs, arguments.motion)
        written.append(write_analysis(folder / "cycle.json", study, "cycle", {"cases": _convergence(cycles)}))
    good = all(cycle.converged for cycle in cycles.values())
    good = good and all(one["status"] == "ok" for one in summaries.values())
    return finish(folder, written, good, started, arguments.pictures)


def _of_one_revolution(study: Study) -> Study:
    """The study with the constant rate of its drive, over one revolution. Raises InputError."""
    import math

    from rfem_jax.description.basics.errors import InputError
    from rfem_jax.description.drives.rotations import PrescribedRate

    drive = study.designed_drive
    if not isinstance(drive, PrescribedRate) or float(drive.rate) == 0.0:
        raise InputError(
            "Argument `drive` of a cycle must be one drive of the kind prescribed_rate that turns, but the study has "
            "another; give the constant rate."
        )
    period = 2.0 * math.pi / abs(float(drive.rate))
    constant = PrescribedRate(drive.joint, float(drive.rate), motion=drive.motion)
    saving = None if study.save_every is None else min(study.save_every, period)
    return replace(study, drive=constant, duration=period, save_every=saving)


def _convergence(cycles: dict[str, Cycle]) -> dict[str, Any]:
    """How the cycle of every case was found."""
    return {
        name: {"converged": cycle.converged, "revolutions": cycle.revolutions, "residual": cycle.residual}
        for name, cycle in cycles.items()
    }


def _cycles(study: Study, tolerance: float, most: int) -> dict[str, Cycle]:
    """The cycle of every case, whose runs are NumPy arrays."""
    import jax
    import numpy as np

    from rfem_jax.description.drives.rotations import PrescribedRate
    from rfem_jax.description.metrics.catalogue import records_for
    from rfem_jax.mechanics.model.errors import deviations
    from rfem_jax.simulation.cycle import steady_cycle
    from rfem_jax.simulation.specification import Simulation

    model, drive, cycles = discretise_study(study), study.drives[0], {}
    assert isinstance(drive, PrescribedRate), "_of_one_revolution has seen to it"
    for case in study.cases:
        announce(f"Finding the cycle of case {case.name}")
        cycle = steady_cycle(
            Simulation(model, drive=drive, method=study.method, save_every=study.save_every),
            deviations(model, case.errors),
            tolerance=tolerance,
            most=most,
            record=records_for(study.metrics),
        )
        cycles[case.name] = replace(cycle, run=jax.tree.map(np.asarray, cycle.run))
        state = "repeats" if cycle.converged else "does not yet repeat"
        note(f"Case {case.name} {state} after {cycle.revolutions} revolutions, to {cycle.residual:.1e}.")
    return cycles
