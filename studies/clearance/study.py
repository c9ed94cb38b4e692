"""How much play relieves what misalignment loads: preload of the four-bar over the clearance of its joint D.

    python studies/clearance/study.py --out results/clearance [--quick]

The main study's four-bar (studies/four_bar/study.toml, a substitute for the paper's lost data) stands still with its
crank held, and joint D is a pin of 20 mm in a bush (theory (15.1) to (15.9)).  The axial clearance is three times the
radial one.  Gravity stays: it is what presses a pin that no misalignment presses.

    sweep   loads of all joints over the clearance for the errors of case P5, their derivatives by the radial clearance
            (jacfwd through the contact equilibrium), and which contacts carry
    batch   the same errors as tolerances, uniform: mean and quantiles of the loads over the clearance, and the share of
            mechanisms whose pin is pressed at one end, at both, or at none
    fits    what two ISO fits of the pin take of the 95 % forces, by interpolation

Files: one CSV a question, `results.json`, two pictures.  Units: N, N m; lengths of clearances um.  `--quick` takes few
clearances and samples, as a trial of the command.
"""

import argparse
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import jax

jax.config.update("jax_enable_x64", True)

import clearance_figures  # noqa: E402
import equinox as eqx  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
from scipy.stats import qmc  # noqa: E402

from rfem_jax import Clearance, Model, Study, assemble, assembly_errors, design, discretise, load_study  # noqa: E402
from rfem_jax.description.basics.iso_fits import fit  # noqa: E402
from rfem_jax.report.contents.output import write_csv, write_json  # noqa: E402


class Size(NamedTuple):
    """rfes of a flexible link, radial clearances [um], samples (a power of two)."""

    rfes: int
    clearances: tuple[float, ...]
    samples: int


FULL = Size(5, tuple(np.linspace(0.0, 150.0, 31).tolist()), 512)
QUICK = Size(2, (0.0, 40.0, 80.0, 120.0), 16)
JOINT, CASE = "D", "P5"
LENGTH, STIFFNESS = 0.02, 5e7  # m; N/m of each end of the pin
AXIAL = 3.0  # axial over radial clearance
QUANTILES = (0.5, 0.95)
FITS = ("20 H7/f7", "20 H8/d9")
KINK = 70.0  # um: up to here no contact opens or closes
LOADS = (("force", "N"), ("moment", "Nm"))


class Found(NamedTuple):
    """Resultants (joints by name, force and moment) [N, N m], normal forces (3,) [N] of the contacts, status."""

    loads: jax.Array
    pressed: jax.Array
    status: jax.Array


def with_play(study: Study, rfes: int, restitution: float | None = None) -> Model:
    """The study's mechanism whose joint D is a pin in a bush."""
    play = Clearance(radial=0.0, axial=0.0, length=LENGTH, stiffness=STIFFNESS, exponent=1, restitution=restitution)
    mechanism = study.mechanism
    joints = [replace(joint, clearance=play) if joint.name == JOINT else joint for joint in mechanism.joints]
    return discretise(replace(mechanism, joints=joints), rfes=rfes)


def at_rest(model: Model, names: tuple[str, ...], errors, radial) -> Found:
    """The static mechanism with errors [rad, m] and a radial clearance [m]."""
    wanted = design(model, {f"{JOINT}.clearance.radial": radial, f"{JOINT}.clearance.axial": AXIAL * radial})
    found = assemble(model, assembly_errors(model, dict(zip(names, errors, strict=True))), design=wanted)
    loads = jnp.stack([jnp.stack(found.preload[name]) for name in sorted(model.joint_names)])
    # The square root has no derivative at zero, which a planar mechanism's moments have.
    square = jnp.sum(loads**2, axis=-1)
    size = jnp.sqrt(jnp.where(square > 0.0, square, 1.0)) * (square > 0.0)
    return Found(size, found.contacts[JOINT].normal_force, found.status)


@eqx.filter_jit
def over_clearances(model, names, errors, clearances):
    """`at_rest`, and the derivatives of its loads [N/m, N m/m], for every clearance [m]."""

    def one(radial):
        def loads(radial):
            found = at_rest(model, names, errors, radial)
            return found.loads, found

        _, slope, found = jax.jvp(loads, (radial,), (jnp.ones(()),), has_aux=True)
        return found, slope

    return jax.lax.map(one, clearances)


@eqx.filter_jit
def of_batch(model, names, errors, clearances):
    """`at_rest` for every clearance [m] (axis 0) and every row of errors (axis 1)."""
    return jax.lax.map(lambda radial: jax.vmap(lambda row: at_rest(model, names, row, radial))(errors), clearances)


def carrying(pressed) -> str:
    """Which contacts carry."""
    names = [name for name, force in zip(("start", "end", "axial"), pressed, strict=True) if force > 1e-9]
    return "+".join(names) or "none"


def sweep_rows(joints, clearances, found: Found, slopes) -> list[dict]:
    """A row per clearance: loads of all joints, their derivatives per um, the contacts that carry."""
    rows = []
    for i, clearance in enumerate(clearances):
        row = {"radial_um": clearance, "axial_um": AXIAL * clearance, "carrying": carrying(found.pressed[i])}
        for j, joint in enumerate(joints):
            for k, (load, unit) in enumerate(LOADS):
                row[f"{joint}_{load}_{unit}"] = float(found.loads[i, j, k])
                row[f"{joint}_{load}_by_radial_{unit}_per_um"] = 1e-6 * float(slopes[i, j, k])
        rows.append(row)
    return rows


def batch_rows(joints, clearances, found: Found) -> list[dict]:
    """A row per clearance: statistics of the loads, shares of pins by the number of ends that carry, failures."""
    rows = []
    for i, clearance in enumerate(clearances):
        good = found.status[i] == 0
        ends = np.sum(found.pressed[i][good][:, :2] > 1e-9, axis=1)
        row = {"radial_um": clearance, "samples": int(good.size), "failed": int((~good).sum())}
        row |= {f"share_{count}_ends": float(np.mean(ends == count)) for count in range(3)}
        for j, joint in enumerate(joints):
            for k, (load, unit) in enumerate(LOADS):
                values = found.loads[i][good][:, j, k]
                row[f"{joint}_{load}_mean_{unit}"] = float(values.mean())
                for q in QUANTILES:
                    row[f"{joint}_{load}_{100 * q:g}_percent_{unit}"] = float(np.quantile(values, q))
        rows.append(row)
    return rows


def fit_rows(joints, rows) -> list[dict]:
    """A row per fit of the pin: its radial clearances, and what each takes from the 95 % force, as a share of what the
    largest clearance of the study takes."""
    clearances = [row["radial_um"] for row in rows]
    found = []
    for code in FITS:
        middle, half = fit(code).radial
        row = {"fit": code}
        for end, radial in (("smallest", middle - half), ("largest", middle + half)):
            row[f"{end}_radial_um"] = 1e6 * radial
            for joint in joints:
                force = np.array([row[f"{joint}_force_95_percent_N"] for row in rows])
                taken = (force[0] - force) / (force[0] - force[-1])
                row[f"{joint}_{end}_takes"] = float(np.interp(1e6 * radial, clearances, taken))
        found.append(row)
    return found


def derivative_error(rows) -> float:
    """Largest difference of the derivative of the moment in D from central differences of the rows up to `KINK`,
    relative to them."""
    moment = np.array([row[f"{JOINT}_moment_Nm"] for row in rows])
    slope = np.array([row[f"{JOINT}_moment_by_radial_Nm_per_um"] for row in rows])
    clearances = np.array([row["radial_um"] for row in rows])
    difference = (moment[2:] - moment[:-2]) / (clearances[2:] - clearances[:-2])
    used = clearances[1:-1] <= KINK
    return float(np.max(np.abs(slope[1:-1] / difference - 1.0)[used]))


def print_summary(joints, tables) -> None:
    """The main results."""
    print("\nJoint D over its radial clearance; errors of case P5, and as uniform tolerances")
    print("  um   carrying            force, N  moment, N m   mean force   95 % force  mean moment  95 % moment")
    for one, many in zip(tables["sweep"], tables["batch"], strict=True):
        print(
            f"{one['radial_um']:5.0f}  {one['carrying']:<16}{one['D_force_N']:12.3f}{one['D_moment_Nm']:13.4f}"
            f"{many['D_force_mean_N']:13.3f}{many['D_force_95_percent_N']:13.3f}"
            f"{many['D_moment_mean_Nm']:13.4f}{many['D_moment_95_percent_Nm']:13.4f}"
        )
    first, last = tables["batch"][0], tables["batch"][-1]
    shares = {j: 1.0 - last[f"{j}_force_95_percent_N"] / first[f"{j}_force_95_percent_N"] for j in joints}
    text = ", ".join(f"{joint} {100 * share:.0f} %" for joint, share in shares.items())
    print(f"\nThe largest clearance takes from the 95 % force of {text}")
    for row in tables["fits"]:
        ends = [f"{100 * row[f'{JOINT}_{end}_takes']:.0f} %" for end in ("smallest", "largest")]
        print(f"  of it a pin {row['fit']} takes {ends[0]} to {ends[1]} in {JOINT}")
    error = derivative_error(tables["sweep"])
    print(f"Derivatives differ from differences of the rows up to {KINK:g} um by at most {100 * error:.2g} %")


def compute(study: Study, size: Size, progress: Callable[[str], None]):
    """Joints and tables. Raises: SystemExit where an equilibrium of the sweep is not found."""
    model = with_play(study, size.rfes)
    joints = sorted(model.joint_names)
    (case,) = (one for one in study.cases if one.name == CASE)
    names = tuple(case.errors)
    most = np.array([float(value) for value in case.errors.values()])
    clearances = 1e-6 * jnp.asarray(size.clearances)

    progress(f"errors of {CASE} over {len(clearances)} clearances")
    found, slopes = jax.tree.map(np.asarray, over_clearances(model, names, jnp.asarray(most), clearances))
    if found.status.any():
        raise SystemExit("An equilibrium was not found; nothing was written.")

    progress(f"{size.samples} mechanisms over {len(clearances)} clearances")
    places = qmc.Sobol(len(names), seed=0).random(size.samples)
    batch = jax.tree.map(np.asarray, of_batch(model, names, jnp.asarray((2.0 * places - 1.0) * most), clearances))
    tables = {
        "sweep": sweep_rows(joints, size.clearances, found, slopes),
        "batch": batch_rows(joints, size.clearances, batch),
    }
    tables["fits"] = fit_rows(joints, tables["batch"])
    return joints, tables


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, required=True, help="folder for tables and pictures")
    parser.add_argument("--quick", action="store_true", help=f"{len(QUICK.clearances)} clearances: a trial")
    options = parser.parse_args()
    folder, size = options.out, QUICK if options.quick else FULL
    folder.mkdir(parents=True, exist_ok=True)
    start = time.monotonic()

    def progress(text):
        print(f"[{time.monotonic() - start:4.0f} s] {text}", file=sys.stderr, flush=True)

    study = load_study(Path(__file__).parents[1] / "four_bar" / "study.toml")
    study = replace(study, title="Steel four-bar, play in joint D", note="Substitute for the paper's lost data.")
    joints, tables = compute(study, size, progress)
    for name, table in tables.items():
        write_csv(folder / f"{name}.csv", table)
    content = {"title": study.title, "note": study.note, "rfes": size.rfes, "samples": size.samples, "tables": tables}
    write_json(folder / "results.json", content)
    clearance_figures.write_figures(folder, study, joints, tables)
    print_summary(joints, tables)
    print(f"\nTables and pictures are in {folder} ({time.monotonic() - start:.0f} s).")


if __name__ == "__main__":
    main()
