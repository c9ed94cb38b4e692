"""What too much play costs as the mechanism moves: loads of joint D over its radial clearance at 300 rpm.

    python studies/clearance/motion.py --out results/clearance_motion [--quick] [--finer]

The four-bar of `study.py`, whose crank now makes one turn at a constant rate, links and pin starting in equilibrium.
The errors of case P5 are tolerances, uniform; the pin of D strikes its bush with a coefficient of restitution of 0.7.
Little play leaves preload, much play impacts: the RMS and the largest force of D, mean and 95 % quantile of a batch.
Single runs are chaotic after a few impacts, statistics of a batch are not: `--finer` halves the steps and the parts of
them that follow contacts.

Files: `motion.csv`, `motion_over_clearance.png`.  Units: N, N m; clearances um.  `--quick` is a trial of the command.
"""

import argparse
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from study import AXIAL, CASE, JOINT, with_play

import jax  # isort: skip
import clearance_figures
import equinox as eqx
import jax.numpy as jnp
import numpy as np
from scipy.stats import qmc

from rfem_jax import GeneralisedAlpha, PrescribedRate, Simulation, assembly_errors, design, load_study, simulate
from rfem_jax.report.contents.output import write_csv

RATE = 300.0 * 2.0 * np.pi / 60.0  # rad/s
SAVED = 0.01  # s
RESTITUTION = 0.7
STEP, TOLERANCE = 5e-4, 0.02  # s; of the parts that follow contacts
QUANTILE = 0.95


class Size(NamedTuple):
    """rfes of a flexible link, radial clearances [um], samples, and those at once, a divisor: the slowest of them holds
    back the others; duration [s], 0.2 for one turn."""

    rfes: int
    clearances: tuple[float, ...]
    samples: int
    batch: int
    duration: float


FULL = Size(3, (0.0, 12.5, 25.0, 37.5, 50.0, 75.0, 100.0, 150.0), 32, 8, 0.2)
QUICK = Size(2, (0.0, 100.0), 2, 2, 0.1)


class Found(NamedTuple):
    """Of joint D in one run: RMS force [N] and moment [N m], largest normal force [N]; how often a contact closed or
    opened, change of the energy, status."""

    force: jax.Array
    moment: jax.Array
    peak: jax.Array
    changes: jax.Array
    balance: jax.Array
    status: jax.Array


@eqx.filter_jit
def of_batch(model, names, method, duration, errors, radial) -> Found:
    """The motion of every row of errors [rad, m] with a radial clearance [m]."""

    def one(row):
        wanted = design(model, {f"{JOINT}.clearance.radial": radial, f"{JOINT}.clearance.axial": AXIAL * radial})
        run = simulate(
            Simulation(
                model,
                drive=PrescribedRate("A", RATE),
                duration=duration,
                method=method,
                save_every=SAVED,
                design=wanted,
            ),
            assembly_errors(model, dict(zip(names, row, strict=True))),
        )
        of = run.metrics
        loads = of.rms_force[JOINT], of.rms_moment[JOINT], of.max_normal_force[JOINT]
        return Found(*loads, run.contact_changes, run.checks.energy_balance_error, run.status)

    return jax.vmap(one)(errors)


def row_of(clearance: float, found: Found) -> dict:
    """Statistics of the runs that succeeded with one clearance [um]."""
    good = found.status == 0
    row = {"radial_um": clearance, "samples": len(good), "failed": int(np.sum(~good))}
    for name, values in (
        ("rms_force_N", found.force),
        ("rms_moment_Nm", found.moment),
        ("largest_force_N", found.peak),
    ):
        row[f"mean_{name}"] = float(np.mean(values[good]))
        row[f"95_percent_{name}"] = float(np.quantile(values[good], QUANTILE))
    row["mean_contact_changes"] = float(np.mean(found.changes[good]))
    row["largest_energy_balance_error"] = float(np.max(found.balance[good]))
    return row


def least(rows: list[dict], column: str) -> str:
    """Where a column is least, as text."""
    best = min(rows, key=lambda row: row[column])
    return f"{best[column]:.1f} N at {best['radial_um']:g} um"


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, required=True, help="folder for the table and the picture")
    parser.add_argument(
        "--quick", action="store_true", help=f"{len(QUICK.clearances)} clearances, half a turn: a trial"
    )
    parser.add_argument("--finer", action="store_true", help="half the steps and the parts that follow contacts")
    options = parser.parse_args()
    size, start = QUICK if options.quick else FULL, time.monotonic()
    options.out.mkdir(parents=True, exist_ok=True)
    study = load_study(Path(__file__).parents[1] / "four_bar" / "study.toml")
    study = replace(study, title="Steel four-bar, play in joint D", note="Substitute for the paper's lost data.")
    model = with_play(study, size.rfes, restitution=RESTITUTION)
    (case,) = (one for one in study.cases if one.name == CASE)
    most = np.array([float(value) for value in case.errors.values()])
    errors = (2.0 * qmc.Sobol(len(most), seed=0).random(size.samples) - 1.0) * most
    share = 0.5 if options.finer else 1.0
    method = GeneralisedAlpha(step=share * STEP, contact_tolerance=share**2 * TOLERANCE)
    rows = []
    for clearance in size.clearances:
        print(f"[{time.monotonic() - start:4.0f} s] radial clearance {clearance:g} um", file=sys.stderr, flush=True)
        parts = [
            jax.tree.map(
                np.asarray,
                of_batch(
                    model, tuple(case.errors), method, size.duration, jnp.asarray(part), jnp.asarray(1e-6 * clearance)
                ),
            )
            for part in errors.reshape(-1, size.batch, len(most))
        ]
        rows.append(row_of(clearance, jax.tree.map(lambda *values: np.concatenate(values), *parts)))
    write_csv(options.out / "motion.csv", rows)
    clearance_figures.write_motion(options.out, study, rows)
    print("  um   RMS force: mean   95 %   largest force: mean   95 %   RMS moment: mean   changes of contact   failed")
    for row in rows:
        print(
            f"{row['radial_um']:5.1f}{row['mean_rms_force_N']:17.1f}{row['95_percent_rms_force_N']:7.1f}"
            f"{row['mean_largest_force_N']:22.0f}{row['95_percent_largest_force_N']:7.0f}"
            f"{row['mean_rms_moment_Nm']:19.2f}{row['mean_contact_changes']:21.0f}{row['failed']:9d}"
        )
    for column, title in (("95_percent_rms_force_N", "RMS"), ("95_percent_largest_force_N", "largest")):
        print(f"The 95 % {title} force of {JOINT} is least, {least(rows, column)}.")
    print(f"Table and picture are in {options.out} ({time.monotonic() - start:.0f} s).")


if __name__ == "__main__":
    main()
