"""Make the reduced body of the rocker from its mesh: rocker.npz, which study.toml beside this file reads.

    python studies/rocker_from_mesh/make_rocker.py --out results/rocker_from_mesh [--quick]

The mesh (rocker_shape.py) has hexahedra of second order; scikit-fem (`pip install "rfem_jax[mesh]"`) has their
functions.  Bore D rides on a bearing, whose frame follows the average of the bore; the pin of C is pressed into its
bore, which is rigid.  Stresses are recovered where those of shank and fillets are largest under unit loads on C, and at
the mirror images.

Files: `rocker.npz`, `rocker.csv` (frequencies and compliances beside those of the mesh and of a beam), `rocker.png`.
Units: m, kg, s.  `--quick` takes a coarse mesh, as a trial of the command.
"""

import argparse
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from rocker_mesh import STEEL, Solid, bore_of, solid, stress_rows, thickened
from rocker_picture import write_picture
from rocker_shape import FULL, LENGTH, QUICK, SHANK, THICKNESS, C, D, blocks
from scipy.linalg import eigh
from scipy.sparse.linalg import eigsh

from rfem_jax import Interface, ReducedBody, craig_bampton, save_body
from rfem_jax.report.contents.output import write_csv

MODES, DAMPING = 10, 1e-5
LOADS = {"bent": 2, "bent_sideways": 1, "twisted": 3, "turned_sideways": 5}  # on C: F_z, F_y, M_x, M_z
SHIFT = -1e7  # 1/s^2, below the eigenvalues of a free body, which begin with zero


def reduced(body: Solid, modes: int = MODES, stresses=None) -> ReducedBody:
    """The body with frames at both bores, the first of which is the origin."""
    (at_d, area), (at_c, _) = bore_of(body, 0.0, D.bore), bore_of(body, LENGTH, C.bore)
    frames = [Interface((0.0, 0.0, 0.0), at_d, weights=area), Interface((LENGTH, 0.0, 0.0), at_c, "rigid")]
    return craig_bampton(body.mass, body.stiffness, body.nodes, frames, modes, DAMPING, stresses)


def deflections(body: ReducedBody) -> dict[str, np.ndarray]:
    """Displacements and rotations of C under unit loads on it, where D is held."""
    inverse = np.linalg.inv(np.asarray(body.stiffness)[6:12, 6:12])
    return {name: inverse[:, row] for name, row in LOADS.items()}


def von_mises(stress: np.ndarray) -> np.ndarray:
    """Of stresses (..., 6): xx, yy, zz, xy, yz, zx."""
    x, y, z, *shears = np.moveaxis(stress, -1, 0)
    return np.sqrt(0.5 * ((x - y) ** 2 + (y - z) ** 2 + (z - x) ** 2) + 3.0 * sum(one**2 for one in shears))


def outside_of_eyes(nodes: np.ndarray) -> np.ndarray:
    """Numbers of nodes of fillets and shank."""
    away = [np.hypot(nodes[:, 0] - x, nodes[:, 2]) - eye.outside for x, eye in ((0.0, D), (LENGTH, C))]
    return np.flatnonzero((away[0] > 1e-6) & (away[1] > 1e-6))


def highest(body: ReducedBody, places: np.ndarray) -> dict[str, int]:
    """{name: number} of the nodes of shank and fillets with the largest stress under each load, and of their images."""
    chosen: dict[str, int] = {}
    outside = outside_of_eyes(places)
    for deflection in deflections(body).values():
        stress = np.asarray(body.stresses)[outside][:, :, 6:12] @ deflection
        x, y, z = places[outside[int(von_mises(stress).argmax())]]
        for up, side in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
            image = int(np.linalg.norm(places - [x, side * abs(y), up * abs(z)], axis=1).argmin())
            name = f"x{1e3 * x:.0f}mm_{'top' if up > 0 else 'bottom'}_{'near' if side > 0 else 'far'}"
            chosen[name] = image
    return chosen


def beam_deflections(steps: int = 2000) -> dict[str, float]:
    """Those of a Timoshenko beam with the shank's rectangle all along, and closed forms of its torsion."""
    modulus, poisson, _ = STEEL
    x = (np.arange(steps) + 0.5) * LENGTH / steps
    b, h = THICKNESS, 2.0 * (SHANK[0] + (SHANK[1] - SHANK[0]) * x / LENGTH)
    shear = 0.5 * modulus / (1.0 + poisson)
    odd = np.arange(1, 40, 2)[:, None]
    # Torsion constant of a rectangle b < h: Timoshenko and Goodier, section 109.
    series = (np.tanh(0.5 * np.pi * odd * h / b) / odd**5).sum(axis=0)
    torsion = h * b**3 / 3.0 * (1.0 - 192.0 / np.pi**5 * b / h * series)
    step, arm = LENGTH / steps, LENGTH - x
    return {
        "bent": step * (arm**2 / (modulus * b * h**3 / 12.0) + 1.2 / (shear * b * h)).sum(),
        "bent_sideways": step * (arm**2 / (modulus * h * b**3 / 12.0) + 1.2 / (shear * b * h)).sum(),
        "twisted": step * (1.0 / (shear * torsion)).sum(),
        "turned_sideways": step * (1.0 / (modulus * h * b**3 / 12.0)).sum(),
    }


def comparison(mesh: Solid, body: ReducedBody) -> list[dict[str, object]]:
    """Rows of the table: frequencies [Hz] of the free part, and its compliances."""
    full = np.sort(eigsh(mesh.stiffness, 12, mesh.mass, sigma=SHIFT, return_eigenvectors=False))[6:]
    own = eigh(np.asarray(body.stiffness), np.asarray(body.mass), eigvals_only=True)[6:12]
    frequencies = np.sqrt(np.stack([full, own])) / (2.0 * np.pi)
    rows: list[dict[str, object]] = [
        {"quantity": f"frequency {k}, Hz", "mesh": mesh_has, "reduced": reduced_has, "beam": ""}
        for k, (mesh_has, reduced_has) in enumerate(frequencies.T.tolist(), start=1)
    ]
    beams = beam_deflections()
    for name, row in LOADS.items():
        unit = "m/N" if row < 3 else "rad/(N m)"
        found = float(deflections(body)[name][row])
        rows.append({"quantity": f"{name}, {unit}", "mesh": "", "reduced": found, "beam": beams[name]})
    return rows


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="folder of the results")
    parser.add_argument("--quick", action="store_true", help="a coarse mesh")
    asked = parser.parse_args(arguments)
    asked.out.mkdir(parents=True, exist_ok=True)
    n = QUICK if asked.quick else FULL
    mesh = solid(thickened(blocks(n), n.thick, THICKNESS))
    whole = reduced(mesh, stresses=stress_rows(mesh))
    chosen = highest(whole, mesh.nodes)
    recovery = np.asarray(whole.stresses)[list(chosen.values())]
    body = replace(whole, stresses=recovery, stress_names=tuple(chosen))
    path = save_body(body, asked.out / "rocker.npz")
    rows = comparison(mesh, body)
    write_csv(asked.out / "rocker.csv", rows)
    shown = {name: von_mises(np.asarray(whole.stresses)[:, :, 6:12] @ one) for name, one in deflections(body).items()}
    write_picture(asked.out, mesh, shown, mesh.nodes[list(chosen.values())])
    print(f"{len(mesh.nodes)} nodes, {body.total_mass:.4f} kg, {body.modes} modes; stresses at {', '.join(chosen)}")
    for row in rows:
        cells = (f"{row[key]:12.5g}" if row[key] != "" else f"{'':12s}" for key in ("mesh", "reduced", "beam"))
        print(f"{row['quantity']:28s}", *cells)
    print(f"The body is in {path}.")


if __name__ == "__main__":
    main(sys.argv[1:])
