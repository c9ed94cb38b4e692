"""Continuous contact beside an ideal joint: a second of a flexible four-bar whose pin stays pressed.

    python benchmarks/contact_steps.py [--rfes 5] [--repeats 5] [--whole]

The four-bar of `rfem_jax.validation.clearances` turns once in a second, joint D shifted by 0.2 mm and tilted by 2 mrad,
by steps of 1 ms: with an ideal joint D; with a pin whose ends change their contact six times in that second, and steps
that follow; with whole steps, if asked.  All in one process: shortest run in processor time, ratio to the ideal joint,
RMS force of D, changes of contact and status.
"""

import argparse
import dataclasses
import time

import jax
import numpy as np

from rfem_jax import STATUS, GeneralisedAlpha, PrescribedRate, Simulation, assembly_errors, discretise, simulate
from rfem_jax.validation.clearances import SOFT, flexible_four_bar
from rfem_jax.validation.nonideal_joints import bars

ERRORS = {"D.delta_x": 0.002, "D.d_y": 2e-4}
CHI = 50.0  # s/m, of the contacts
STEP, SAVED, SECOND = 1e-3, 5e-3, 1.0  # s


def main() -> int:
    """The command."""
    parser = argparse.ArgumentParser(description="Continuous contact beside an ideal joint.")
    parser.add_argument("--repeats", type=int, default=5, help="runs, the shortest of which counts")
    parser.add_argument("--rfes", type=int, default=5, help="of coupler and rocker")
    parser.add_argument("--whole", action="store_true", help="a row for steps that stay whole, too")
    repeats, rfes = (options := parser.parse_args()).repeats, options.rfes
    jax.config.update("jax_enable_x64", True)
    sprung = dataclasses.replace(flexible_four_bar(dataclasses.replace(SOFT, damping=CHI)), links=bars(rfes))
    joints = tuple(dataclasses.replace(joint, clearance=None) for joint in sprung.joints)
    rows = (
        ("ideal joint", dataclasses.replace(sprung, joints=joints), 0.0),
        ("play, steps that follow", sprung, 0.02),
        ("play, whole steps", sprung, 0.0),
    )
    print("| | CPU ms | over ideal | RMS force of D, N | changes of contact | status |\n|---|---|---|---|---|---|")
    ideal = None
    for name, mechanism, tolerance in rows if options.whole else rows[:2]:
        model = discretise(mechanism)
        method = GeneralisedAlpha(step=STEP, contact_tolerance=tolerance)
        errors, drive, times = assembly_errors(model, ERRORS), PrescribedRate("A", 2.0 * np.pi), []
        for _ in range(repeats + 1):  # the first one compiles
            start = time.process_time()
            run = simulate(Simulation(model, drive=drive, duration=SECOND, method=method, save_every=SAVED), errors)
            jax.block_until_ready(run.status)
            times.append(time.process_time() - start)
        shortest = 1e3 * min(times[1:])
        ideal = shortest if ideal is None else ideal
        changes = "-" if run.contact_changes is None else f"{float(run.contact_changes):.0f}"
        force, status = float(run.metrics.rms_force["D"]), STATUS[int(run.status)].name
        print(f"| {name} | {shortest:.0f} | {shortest / ideal:.2f} | {force:.3f} | {changes} | {status} |", flush=True)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
