"""Picture of the rocker: its mesh, the stresses under two of the unit loads, and where they are recovered."""

from pathlib import Path

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure
from matplotlib.tri import Triangulation
from rocker_mesh import Solid
from skfem import ElementHex2

from rfem_jax.report.drawings.pictures import write_pictures
from rfem_jax.report.drawings.style import SETTINGS

PANELS = {"bent": "(a) force of 1 N on C, across", "bent_sideways": "(b) force of 1 N on C, along its pin"}


def face_of(mesh: Solid) -> tuple[np.ndarray, np.ndarray]:
    """Triangles (k, 3) of nodes on the near face, and the outlines (m, 9) of its elements."""
    local = np.rint(2.0 * ElementHex2().doflocs).astype(int)
    near = [int(np.flatnonzero((local == (i, j, 0)).all(axis=1))[0]) for i in range(3) for j in range(3)]
    elements = mesh.basis.element_dofs[near]
    elements = elements[:, np.isclose(mesh.nodes[elements[4], 1], mesh.nodes[:, 1].max())]
    corners = [(0, 3, 4), (0, 4, 1), (1, 4, 5), (1, 5, 2), (3, 6, 7), (3, 7, 4), (4, 7, 8), (4, 8, 5)]
    return np.concatenate([elements[list(one)].T for one in corners]), elements[[0, 1, 2, 5, 8, 7, 6, 3, 0]].T


def write_picture(folder: Path, mesh: Solid, stresses: dict[str, np.ndarray], places: np.ndarray) -> list[Path]:
    """Draw rocker.png into a folder: von Mises stresses [Pa] {load: (p,)} at all nodes, and places of some of them."""
    triangles, outlines = face_of(mesh)
    x, z = 1e3 * mesh.nodes[:, 0], 1e3 * mesh.nodes[:, 2]
    with rc_context(SETTINGS | {"axes.grid": False}):
        figure = Figure(figsize=(7.6, 4.0), layout="constrained")
        for axes, (name, title) in zip(figure.subplots(2, 1, sharex=True), PANELS.items()):
            for outline in outlines:
                axes.plot(x[outline], z[outline], color="#D9D9D9", linewidth=0.3)
            value = np.where(mesh.nodes[:, 1] > 0.0, 1e-6 * stresses[name], 0.0)
            drawn = axes.tripcolor(Triangulation(x, z, triangles), value, shading="gouraud")
            axes.plot(1e3 * places[:, 0], 1e3 * places[:, 2], "o", markersize=4, mfc="none", mec="#D55E00")
            figure.colorbar(drawn, ax=axes, label="von Mises, MPa", pad=0.01)
            axes.set_aspect("equal")
            axes.set_title(title, loc="left")
            axes.set_ylabel("z, mm")
        axes.set_xlabel("x, mm; circles: where stresses are recovered")
    return write_pictures(folder, {"rocker": figure})
