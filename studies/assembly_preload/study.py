"""What assembly errors do to the joints before anything moves: preload over a revolution of the crank.

    python studies/assembly_preload/study.py --out results/assembly_preload [--quick]

The main study's four-bar (studies/four_bar/study.toml, a substitute for the paper's lost data) in static equilibrium
at every crank angle, the crank held: no dynamics (theory (6.1)).  Equilibria are those of the kinetostatic turn
(`rfem_jax.simulation.rest.turn`; `rfem-jax turn STUDY.toml` for any mechanism), from the closed perfect mechanism
there.

    derivatives  of the preload of every joint by every error, at zero error (jacfwd)
    differences  preload with an error of 1 deg or 1 mm minus that of the perfect mechanism
    drive        moment that holds the crank, and the energy whose derivative along the angle it is

A *crooked pin* tilts seat and bore alike at the start angle; its derivative is a sum of theirs.
Files: one CSV a question, `results.json`, four pictures.  Units: N, N m, deg, mm; loads in hinge
frames.  `--quick` takes 8 positions and fewer rfes, as a trial of the command.
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
import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
import preload_figures  # noqa: E402
from jax import Array  # noqa: E402

from rfem_jax import (  # noqa: E402
    AssemblyErrors,
    InputError,
    Model,
    Study,
    assembly_errors,
    discretise,
    load_study,
)
from rfem_jax.description.tolerances.error_catalogue import error_dimension  # noqa: E402
from rfem_jax.report.contents.output import write_csv, write_json  # noqa: E402
from rfem_jax.simulation.rest.turn import ClosedPose, closed_poses, held_at  # noqa: E402


class Size(NamedTuple):
    """rfes of a flexible link; other numbers of them, at the start only, for the discretisation error; number of
    crank angles over a revolution."""

    rfes: int
    others: tuple[int, ...]
    angles: int


FULL, QUICK = Size(9, (5, 17), 72), Size(3, (), 8)
SHOWN = (
    "D.delta_x",
    "D.delta_z",
    "D.d_y",
    "B.delta_x",
    "B.delta_z",
    "C.delta_x",
    "C.child.delta_z",
    "coupler.twist",
    "rocker.twist",
    "coupler.length",
    "D.d_x",
)
UNIT = {"angle": np.pi / 180.0, "length": 1e-3}
UNIT_NAME = {"angle": "deg", "length": "mm"}


def unit_error(name: str) -> float:
    """1 deg or 1 mm in rad or m."""
    return UNIT[error_dimension(name)]


def poses_over_revolution(model: Model, angles: np.ndarray) -> ClosedPose:
    """The closed perfect rigid mechanism at all crank angles [rad].

    Raises: SystemExit where it cannot close (a crank that cannot make a full revolution).
    """
    try:
        return closed_poses(model, angles)
    except InputError as problem:
        raise SystemExit(str(problem)) from None


def held(model: Model, pose: ClosedPose, errors: AssemblyErrors) -> tuple[Array, Array, Array]:
    """Preload (joints by name, force and moment, 3) [N, N m], potential energy [J], status, the crank held."""
    found = held_at(model, errors, pose, stresses=False)
    preload = [jnp.stack([found.loads[name].force, found.loads[name].moment]) for name in sorted(model.joint_names)]
    return jnp.stack(preload), found.energy, found.status


@eqx.filter_jit
def equilibria(model, poses, values):
    """`held` at all poses (axis 0) for every row of error values of the names SHOWN (axis 1)."""

    def one(pose, row):
        return held(model, pose, assembly_errors(model, dict(zip(SHOWN, row))))

    along_errors = jax.vmap(one, in_axes=(None, 0))
    return jax.lax.map(lambda pose: along_errors(pose, values), poses)


@eqx.filter_jit
def derivatives(model, names, poses):
    """Derivatives of the preload at zero error, per rad or m (poses, joints, 2, 3, errors)."""

    def one(pose):
        def preload(values):
            return held(model, pose, assembly_errors(model, dict(zip(names, values))))[0]

        return jax.jacfwd(preload)(jnp.zeros(len(names)))

    return jax.lax.map(one, poses)


def with_crooked_pins(model: Model, names: Sequence[str], values: np.ndarray) -> tuple[list[str], np.ndarray]:
    """Names and derivatives (..., errors) with those of crooked pins, through seat and bore, added.

    The tilt of the bore is that of the seat, rotated back by the joint's angle at the start (theory (2.4)).
    """
    all_names, parts = list(names), [values]
    angles = np.concatenate([model.start_joints, model.cut_angles])
    for joint, angle in zip(model.topology.joints, angles):
        cosine, sine = np.cos(angle), np.sin(angle)
        for axis, (by_x, by_z) in (("x", (cosine, sine)), ("z", (-sine, cosine))):
            shares = {
                f"{joint}.delta_{axis}": 1.0,
                f"{joint}.child.delta_x": by_x,
                f"{joint}.child.delta_z": by_z,
            }
            pin = sum((share * values[..., all_names.index(name)] for name, share in shares.items()), 0.0)
            parts.append(np.asarray(pin)[..., None])
            all_names.append(f"{joint}.pin_tilt_{axis}")
    return all_names, np.concatenate(parts, axis=-1)


def derivative_along_revolution(values: np.ndarray, angles: np.ndarray) -> np.ndarray:
    """Derivative along axis 0 [1/rad] of values at equal distances over a period, by Fourier series."""
    waves = np.fft.rfftfreq(len(angles), (angles[1] - angles[0]) / (2.0 * np.pi))
    shape = (-1, *[1] * (values.ndim - 1))
    spectrum = np.fft.rfft(values, axis=0) * (1j * waves).reshape(shape)
    return np.fft.irfft(spectrum, len(angles), axis=0)


def resultants(preload: np.ndarray, axis: int) -> np.ndarray:
    """Lengths of the vectors along an axis."""
    return np.sqrt(np.sum(preload**2, axis=axis))


def history_rows(joints, names, degrees, per_unit) -> list[dict]:
    """Preload per unit error at every angle: components of every joint; per_unit as `derivatives`."""
    rows = []
    for e, name in enumerate(names):
        for i, angle in enumerate(degrees):
            row = {"error": name, "per": UNIT_NAME[error_dimension(name)], "crank_angle_deg": angle}
            for j, joint in enumerate(joints):
                for k, (load, unit) in enumerate((("force", "N"), ("moment", "Nm"))):
                    for axis, letter in enumerate("xyz"):
                        row[f"{joint}_{load}_{letter}_{unit}"] = float(per_unit[i, j, k, axis, e])
            rows.append(row)
    return rows


def peak_rows(joints, names, degrees, per_unit) -> list[dict]:
    """Largest resultants over the revolution, and where, by error and joint."""
    rows = []
    sizes = resultants(per_unit, 3)
    for e, name in enumerate(names):
        row = {"error": name, "per": UNIT_NAME[error_dimension(name)]}
        for k, (load, unit) in enumerate((("force", "N"), ("moment", "Nm"))):
            for j, joint in enumerate(joints):
                row[f"{joint}_{load}_{unit}"] = float(sizes[:, j, k, e].max())
                row[f"{joint}_{load}_at_deg"] = float(degrees[sizes[:, j, k, e].argmax()])
        rows.append(row)
    return rows


def linearity_rows(joints, names, per_unit, differences) -> list[dict]:
    """Derivative against difference for a unit error: largest deviation over the revolution, relative to the
    largest preload of that error."""
    rows = []
    for e, name in enumerate(SHOWN):
        linear = per_unit[..., names.index(name)]
        row = {"error": name, "unit_error": f"1 {UNIT_NAME[error_dimension(name)]}"}
        for k, (load, unit) in enumerate((("force", "N"), ("moment", "Nm"))):
            largest = resultants(differences[:, e, :, k], -1).max()
            off = resultants(differences[:, e, :, k] - linear[:, :, k], -1).max()
            row[f"largest_{load}_{unit}"] = float(largest)
            row[f"deviation_of_{load}_{unit}"] = float(off)
            row[f"relative_deviation_of_{load}"] = float(off / largest)
        rows.append(row)
    return rows


def drive_rows(degrees, angles, moment, energy) -> list[dict]:
    """Moment that holds the crank: perfect, and its change by each unit error."""
    rate = derivative_along_revolution(energy, angles)
    columns = {"perfect": (moment[:, 0], rate[:, 0])} | {
        name: (moment[:, e] - moment[:, 0], rate[:, e] - rate[:, 0]) for e, name in enumerate(SHOWN, start=1)
    }
    return [
        {
            "case": name,
            "crank_angle_deg": float(angle),
            "moment_Nm": float(of_moment[i]),
            "derivative_of_energy_Nm": float(of_energy[i]),
        }
        for name, (of_moment, of_energy) in columns.items()
        for i, angle in enumerate(degrees)
    ]


def discretisation_rows(study, joints, names, usual, size: Size) -> list[dict]:
    """Preload per unit D.delta_x, D.delta_z, D.d_y at the start for several numbers of rfes."""
    rows, units = [], np.array([unit_error(name) for name in names])
    for rfes in sorted((size.rfes, *size.others)):
        if rfes == size.rfes:
            values = usual[0]
        else:
            model = discretise(study.mechanism, rfes=rfes)
            pose = ClosedPose(model.start_joints[None], model.cut_angles[None])
            values = np.asarray(derivatives(model, names, pose))[0] * units
        sizes = resultants(values, 2)
        for name in SHOWN[:3]:
            row = {"error": name, "per": UNIT_NAME[error_dimension(name)], "rfes": rfes}
            for k, (load, unit) in enumerate((("force", "N"), ("moment", "Nm"))):
                for j, joint in enumerate(joints):
                    row[f"{joint}_{load}_{unit}"] = float(sizes[j, k, names.index(name)])
            rows.append(row)
    return rows


def print_summary(tables, joints) -> None:
    """The main results."""
    print(
        "\nLargest preload over the revolution per unit error: force in "
        f"{', '.join(joints)} [N], moment in {', '.join(joints)} [N m]"
    )
    for row in tables["peaks"]:
        numbers = "".join(f"{row[f'{j}_force_N']:9.3f}" for j in joints) + "  "
        numbers += "".join(f"{row[f'{j}_moment_Nm']:9.3f}" for j in joints)
        print(f"  {row['error']:<17}per {row['per']:<4}{numbers}")
    print("\nA unit error against the derivative (largest deviation / largest preload)")
    for row in tables["linearity"]:
        print(
            f"  {row['error']:<16}{row['unit_error']:<6} force {row['largest_force_N']:9.4f} N, "
            f"off by {row['relative_deviation_of_force']:.1e};  moment "
            f"{row['largest_moment_Nm']:8.4f} N m, off by {row['relative_deviation_of_moment']:.1e}"
        )
    print(f"\nPreload per unit error at the start against the number of rfes (moments in {', '.join(joints)})")
    for row in tables["discretisation"]:
        numbers = "".join(f"{row[f'{j}_moment_Nm']:10.4f}" for j in joints)
        print(f"  {row['error']:<10}rfes {row['rfes']:<4}force {row['A_force_N']:9.4f} N   moments {numbers} N m")
    print("\nMoment that holds the crank: extremes over the revolution, and the derivative of the energy")
    for name in dict.fromkeys(row["case"] for row in tables["drive"]):
        rows = [row for row in tables["drive"] if row["case"] == name]
        moment = np.array([row["moment_Nm"] for row in rows])
        off = moment - np.array([row["derivative_of_energy_Nm"] for row in rows])
        print(
            f"  {name:<16}{moment.min():9.4f} ... {moment.max():.4f} N m, mean "
            f"{moment.mean():.1e}, derivative of the energy differs by {np.abs(off).max():.1e}"
        )


def compute(study: Study, size: Size, progress: Callable[[str], None]):
    """Joints, crank angles [deg], names of errors, preload per unit error (angles, joints, 2, 3, errors), tables.

    Raises: SystemExit if an equilibrium is not found.
    """
    model = discretise(study.mechanism, rfes=size.rfes)
    joints = sorted(model.joint_names)
    rotation = 2.0 * np.pi * np.arange(size.angles) / size.angles
    angles = float(model.start_joints[model.topology.driven]) + rotation
    degrees = np.round(np.rad2deg(angles), 9)
    poses = poses_over_revolution(model, angles)

    progress("derivatives by all errors over the revolution")
    names = tuple(name for name in model.topology.error_names if "pin_tilt" not in name)
    values = np.asarray(derivatives(model, names, poses))
    names, values = with_crooked_pins(model, names, values)
    per_unit = values * np.array([unit_error(name) for name in names])

    progress(f"{len(SHOWN)} unit errors over the revolution")
    rows = np.concatenate([np.zeros((1, len(SHOWN))), np.diag([unit_error(n) for n in SHOWN])])
    preload, energy, status = map(np.asarray, equilibria(model, poses, jnp.asarray(rows)))
    if (status != 0).any():
        raise SystemExit(f"{(status != 0).sum()} positions not assembled; nothing was written.")
    differences = preload[:, 1:] - preload[:, :1]

    progress("the start with other numbers of rfes")
    free = names[: len(names) - 2 * len(joints)]
    holding = preload[:, :, joints.index("A"), 1, 1]
    tables = {
        "peaks": peak_rows(joints, names, degrees, per_unit),
        "linearity": linearity_rows(joints, names, per_unit, differences),
        "drive": drive_rows(degrees, angles, holding, energy),
        "discretisation": discretisation_rows(study, joints, tuple(free), per_unit, size),
        "preload_per_unit_error": history_rows(joints, names, degrees, per_unit),
    }
    return joints, degrees, names, per_unit, tables


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, required=True, help="folder for tables and pictures")
    parser.add_argument("--quick", action="store_true", help=f"{QUICK.angles} positions, {QUICK.rfes} rfes: a trial")
    options = parser.parse_args()
    folder, size = options.out, QUICK if options.quick else FULL
    folder.mkdir(parents=True, exist_ok=True)
    start = time.monotonic()

    def progress(text):
        print(f"[{time.monotonic() - start:4.0f} s] {text}", file=sys.stderr, flush=True)

    study = load_study(Path(__file__).parents[1] / "four_bar" / "study.toml")
    study = replace(study, title="Steel four-bar", note="Substitute for the paper's lost data.")
    joints, degrees, names, per_unit, tables = compute(study, size, progress)
    for name, table in tables.items():
        write_csv(folder / f"{name}.csv", table)
    small = {name: table for name, table in tables.items() if name != "preload_per_unit_error"}
    content = {
        "title": study.title,
        "note": study.note,
        "rfes": size.rfes,
        "angles": size.angles,
        "tables": small,
    }
    write_json(folder / "results.json", content)
    preload_figures.write_figures(folder, study, joints, degrees, names, per_unit, tables)
    print_summary(tables, joints)
    print(f"\nTables and pictures are in {folder} ({time.monotonic() - start:.0f} s).")


if __name__ == "__main__":
    main()
