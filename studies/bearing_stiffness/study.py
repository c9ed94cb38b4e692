"""What stiff bearings do to a misaligned four-bar: preload over the stiffness of its bearings.

    python studies/bearing_stiffness/study.py --out results/bearing_stiffness [--quick]

The four-bar of study.toml beside this file, with all errors of its case "all", stands still with its crank held;
gravity is left out, so that all loads come from the misalignment.  All stiffnesses of all bearings are multiplied by
one factor, and the preload is computed with rigid links and with flexible ones (theory (13.1), (6.1)).

    sweep       preload over the stiffness, rigid and flexible links; the two limits in series
    ideal       preload with flexible links and ideal joints
    distance    of the preload with flexible links from that of ideal joints, and its order in the compliance
    directions  logarithmic derivatives of the preload by each stiffness, at the bearings of study.toml

Files: one CSV a question, `results.json`, two pictures.  Units: N, N m; loads in hinge frames.  `--quick` takes few
stiffnesses and rfes, as a trial of the command.
"""

import argparse
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import jax

jax.config.update("jax_enable_x64", True)

import equinox as eqx  # noqa: E402
import numpy as np  # noqa: E402
import stiffness_figures  # noqa: E402

from rfem_jax import AssemblyErrors, Mechanism, Model, assemble, assembly_errors, discretise, load_study  # noqa: E402
from rfem_jax.report.contents.output import write_csv, write_json  # noqa: E402


class Size(NamedTuple):
    """rfes of a flexible link, and the powers of ten by which stiffnesses are multiplied."""

    rfes: int
    powers: tuple[float, ...]


FULL = Size(5, tuple(np.round(np.linspace(-3.0, 5.0, 33), 6).tolist()))
QUICK = Size(2, (-1.0, 0.0, 1.0, 3.0, 4.0, 5.0))
CASE = "all"
STEP = 1e-3  # of the logarithm of a stiffness
LOADS = (("force", "N"), ("moment", "Nm"))


def variant(mechanism: Mechanism, rfes: int | None, ideal: bool = False) -> Mechanism:
    """The mechanism without gravity; with this number of rfes in flexible links (None: all links rigid), and ideal
    joints if wanted."""
    links = [
        replace(link, rigid=True, rfes=1) if rfes is None else link if link.rigid else replace(link, rfes=rfes)
        for link in mechanism.links
    ]
    joints = [replace(joint, compliance=None) for joint in mechanism.joints] if ideal else mechanism.joints
    return replace(mechanism, links=links, joints=joints, gravity=(0.0, 0.0, 0.0))


def preload(model: Model, errors: AssemblyErrors, factors: np.ndarray) -> np.ndarray:
    """Resultants (joints by name, force and moment) [N, N m] of the static mechanism, its crank held, with the
    stiffness of every spring of `model.springs` times a factor (springs,); none for ideal joints.

    Raises: SystemExit if the equilibrium is not found.
    """
    if model.springs:
        names = list(model.springs)
        changed = [factor * model.springs[name].stiffness for name, factor in zip(names, factors, strict=True)]
        model = eqx.tree_at(lambda m: [m.springs[name].stiffness for name in names], model, changed)
    assembled = assemble(model, errors)
    if int(assembled.status) != 0:
        raise SystemExit("An equilibrium was not found; nothing was written.")
    return np.linalg.norm([assembled.preload[name] for name in sorted(model.joint_names)], axis=-1)


def sweep(model: Model, errors: AssemblyErrors, powers: Sequence[float]) -> tuple[np.ndarray, np.ndarray]:
    """Preload with all stiffnesses times powers of ten (powers, joints, 2), and its logarithmic derivatives by each
    spring at the model's stiffnesses (joints, 2, springs), by central differences.
    """
    count = len(model.springs)
    loads = [preload(model, errors, np.full(count, 10.0**power)) for power in powers]
    derivatives = [
        np.log(preload(model, errors, np.exp(step)) / preload(model, errors, np.exp(-step))) / (2.0 * STEP)
        for step in STEP * np.eye(count)
    ]
    return np.stack(loads), np.stack(derivatives, axis=-1)


def load_columns(joints: Sequence[str], loads: np.ndarray) -> dict[str, float]:
    """Resultants (joints, 2) by the names of columns."""
    return {
        f"{joint}_{load}_{unit}": float(loads[j, k])
        for k, (load, unit) in enumerate(LOADS)
        for j, joint in enumerate(joints)
    }


def sweep_rows(joints, radial, tilt, curves: dict[str, np.ndarray]) -> list[dict]:
    """Preload over the stiffness of each curve (factors, joints, 2)."""
    return [
        {"links": name, "radial_N_per_m": float(k), "tilt_Nm_per_rad": float(c)} | load_columns(joints, loads)
        for name, values in curves.items()
        for k, c, loads in zip(radial, tilt, values, strict=True)
    ]


def distance_rows(joints, radial, flexible, ideal) -> list[dict]:
    """Relative distance from the preload of ideal joints, and its order in 1/k between neighbours."""
    off = np.abs(flexible / ideal - 1.0)
    order = np.full_like(off, np.nan)
    order[1:] = -np.diff(np.log(off), axis=0) / np.diff(np.log(radial))[:, None, None]
    return [
        {"joint": joint, "load": load, "radial_N_per_m": float(k), "distance": float(off[i, j, n])}
        | {"order": float(order[i, j, n])}
        for j, joint in enumerate(joints)
        for n, (load, _) in enumerate(LOADS)
        for i, k in enumerate(radial)
    ]


def direction_rows(joints, springs, values: dict[str, np.ndarray]) -> list[dict]:
    """Logarithmic derivatives (joints, 2, springs) of each kind of links by spring."""
    return [
        {"links": links, "spring": spring}
        | {f"{joint}_{load}": float(of[j, k, s]) for k, (load, _) in enumerate(LOADS) for j, joint in enumerate(joints)}
        for links, of in values.items()
        for s, spring in enumerate(springs)
    ]


def compute(study, size: Size, progress: Callable[[str], None]) -> tuple[tuple[str, ...], dict[str, list[dict]]]:
    """Joints, and tables by name."""
    misaligned = next(case for case in study.cases if case.name == CASE).errors
    found, derivatives = {}, {}
    for name, rfes in (("rigid", None), ("flexible", size.rfes)):
        progress(f"{name} links")
        model = discretise(variant(study.mechanism, rfes))
        found[name], derivatives[name] = sweep(model, assembly_errors(model, misaligned), size.powers)
    usual = {name: float(spring.stiffness) for name, spring in model.springs.items()}
    progress("ideal joints")
    model = discretise(variant(study.mechanism, size.rfes, ideal=True))
    limit = preload(model, assembly_errors(model, misaligned), np.empty(0))

    joints = tuple(sorted(model.joint_names))
    radial, tilt = (usual[f"A.{name}"] * 10.0 ** np.array(size.powers) for name in ("radial", "tilt"))
    found["series"] = 1.0 / (1.0 / found["rigid"] + 1.0 / limit)
    return joints, {
        "sweep": sweep_rows(joints, radial, tilt, found),
        "ideal": [load_columns(joints, limit)],
        "distance": distance_rows(joints, radial, found["flexible"], limit),
        "directions": direction_rows(joints, tuple(usual), derivatives),
    }


def print_summary(tables, joints) -> None:
    """The main results."""
    columns = [f"{joint}_{load}_{unit}" for load, unit in LOADS for joint in joints]
    print(f"\nPreload by the radial stiffness: force, then moment, in {', '.join(joints)} [N, N m]")
    whole = [row for row in tables["sweep"] if np.log10(row["radial_N_per_m"]) % 1.0 < 1e-6]
    for row in (*whole, {"links": "ideal", "radial_N_per_m": np.inf} | tables["ideal"][0]):
        numbers = "".join(f"{row[name]:11.4g}" for name in columns)
        print(f"  {row['links']:<9}{row['radial_N_per_m']:9.2e} N/m{numbers}")
    print("\nDistance from ideal joints, and its order in 1/k")
    for row in tables["distance"]:
        if row["joint"] == joints[0] and np.log10(row["radial_N_per_m"]) % 1.0 < 1e-6:
            print(f"  {row['load']:<7} {row['radial_N_per_m']:9.2e} N/m  {row['distance']:.3e}  {row['order']:6.3f}")
    print("\nPer cent of change by 1 % of a stiffness (logarithmic derivatives)")
    names = [f"{joint}_{load}" for load, _ in LOADS for joint in joints]
    for row in tables["directions"]:
        print(f"  {row['links']:<9}{row['spring']:<9}" + "".join(f"{row[name]:9.4f}" for name in names))


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, required=True, help="folder for tables and pictures")
    parser.add_argument(
        "--quick", action="store_true", help=f"{len(QUICK.powers)} stiffnesses, {QUICK.rfes} rfes: a trial"
    )
    options = parser.parse_args()
    folder, size = options.out, QUICK if options.quick else FULL
    folder.mkdir(parents=True, exist_ok=True)
    start = time.monotonic()

    def progress(text):
        print(f"[{time.monotonic() - start:4.0f} s] {text}", file=sys.stderr, flush=True)

    study = load_study(Path(__file__).parent / "study.toml")
    joints, tables = compute(study, size, progress)
    for name, table in tables.items():
        write_csv(folder / f"{name}.csv", table)
    content = {"title": study.title, "note": study.note, "rfes": size.rfes, "tables": tables}
    write_json(folder / "results.json", content)
    stiffness_figures.write_figures(folder, study, joints, tables)
    print_summary(tables, joints)
    print(f"\nTables and pictures are in {folder} ({time.monotonic() - start:.0f} s).")


if __name__ == "__main__":
    main()
