"""Forces at points in the picture of the assembled mechanism: springs as zigzags, forces and moments as arrows.

Place in the pipeline: called by `shapes`; `run.forces` has forces, moments and points at the start of the run.
"""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from rfem_jax.description.mechanism.distributed_forces import DistributedForce
from rfem_jax.description.mechanism.mechanism import Mechanism
from rfem_jax.description.mechanism.point_forces import LoadOnLink
from rfem_jax.report.annotations import Axes3D, Run

ARROW = 0.15  # of the size of the mechanism
COIL = 0.015  # half the width of a zigzag, likewise
WINDINGS = 8
COLOUR = "#8b1a1a"

Point = Float[np.ndarray, " 3"]
Drawn = Callable[[str, float, Point], Point]  # link, x of a point on it [m], where it is -> where it is drawn


def draw_forces(axes: Axes3D, mechanism: Mechanism, run: Run, size: float, drawn: Drawn) -> None:
    """Draw the forces at points of a mechanism of a size [m] at the start of a run."""
    for force in mechanism.point_forces:
        history = run.forces[force.name]
        places = [np.asarray(part)[0] for part in (history.first_place, history.place)]
        if isinstance(force, LoadOnLink):
            places = places[1:]
        ends = force.ends()
        if isinstance(force, DistributedForce):
            # All of it, at the middle of the loaded piece.
            begin, end = force.along(mechanism.link(force.link))
            ends = ((force.link, (float(0.5 * (begin + end)), 0.0, 0.0)),)
        points = [drawn(link, at[0], place) for (link, at), place in zip(ends, places, strict=True)]
        if not np.isfinite(points).all():
            continue
        if isinstance(force, LoadOnLink):
            vector = arrow(np.asarray(getattr(history, force.dimension)), ARROW * size)
            style = "--" if force.dimension == "moment" else "-"
            # Its tip is at the point: arrows that start there would hide the links that they pull.
            axes.quiver(*(points[0] - vector), *vector, color=COLOUR, linewidth=1.4, linestyle=style)
            label = points[0] - vector
        else:
            axes.plot(*zigzag(points[0], points[1], COIL * size).T, color=COLOUR, linewidth=1.0)
            label = 0.5 * (points[0] + points[1])
        axes.text(label[0], label[1], label[2], f" {force.name}", fontsize=7, color=COLOUR)


def arrow(values: Float[np.ndarray, "times 3"], length: float) -> Point:
    """An arrow along a force or moment at the start, or where it is largest if there is none; zero if it always is."""
    sizes = np.linalg.norm(values, axis=1)
    at = 0 if sizes[0] > 0.0 else int(np.argmax(sizes))
    return length * values[at] / sizes[at] if sizes[at] > 0.0 else np.zeros(3)


def zigzag(start: Point, end: Point, half_width: float) -> Float[np.ndarray, "points 3"]:
    """The points of a zigzag between two points, straight at its ends."""
    along = end - start
    across = np.cross(along, [0.0, 1.0, 0.0])
    if np.linalg.norm(across) < 1e-6 * np.linalg.norm(along):
        across = np.cross(along, [1.0, 0.0, 0.0])
    across = half_width * across / max(float(np.linalg.norm(across)), 1e-300)
    shares = np.concatenate([[0.0, 0.2], 0.2 + 0.6 * (np.arange(2 * WINDINGS) + 0.5) / (2 * WINDINGS), [0.8, 1.0]])
    sides = np.concatenate([[0.0, 0.0], np.tile([1.0, -1.0], WINDINGS), [0.0, 0.0]])
    return start + shares[:, None] * along + sides[:, None] * across
