"""Forces at points in the picture of the assembled mechanism: springs as zigzags, forces and moments as arrows.

Place in the pipeline: called by `shapes`; `run.forces` has forces, moments and points at the start of the run.
"""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from rfem_jax.description.mechanism.distributed_forces import DistributedForce
from rfem_jax.description.mechanism.mechanism import Mechanism
from rfem_jax.description.mechanism.point_forces import LoadOnLink
from rfem_jax.report.contents.annotations import Axes3D, Model

ARROW = 0.15  # of the size of the mechanism
COIL = 0.015  # half the width of a zigzag, likewise
WINDINGS = 8
COLOUR = "#8b1a1a"

Point = Float[np.ndarray, " 3"]
Drawn = Callable[[str, float, Point], Point]  # link, x of a point on it [m], where it is -> where it is drawn


class ForceAtStart(NamedTuple):
    """Force [N] and moment [N m] of a force at points, and its places [m], at the start, as of `PointHistory`."""

    force: Float[np.ndarray, "1 3"]
    moment: Float[np.ndarray, "1 3"]
    place: Float[np.ndarray, "1 3"]
    first_place: Float[np.ndarray, "1 3"]


def forces_at_start(model: Model) -> dict[str, ForceAtStart]:
    """The given forces and moments at points of the perfect mechanism at its start, and the places of springs, whose
    forces are not drawn."""
    from rfem_jax.mechanics.laws.frame_forces import START
    from rfem_jax.mechanics.laws.point_laws import GivenLoad
    from rfem_jax.mechanics.model.nominal_geometry import axis_places, geometry_of, node_place, place

    geometry, found = geometry_of(model), {}
    placed = place(geometry, np.asarray(model.start_joints))
    for name, law in (model.frame_forces or {}).items():
        ends = [(node_place(geometry, placed, end.node), end) for end in (law.parent, law.child)]
        first, second = ((point + rotation @ np.asarray(end.position))[None] for (rotation, point), end in ends)
        value = np.zeros(3)
        if isinstance(law, GivenLoad):
            value = np.asarray(law.value.at(START))
            value = ends[1][0][0] @ np.asarray(law.child.rotation) @ value if law.turning else value
        found[name] = ForceAtStart(value[None], value[None], second, first)
    for name, law in (model.line_loads or {}).items():
        # All of it, at the middle of the loaded piece.
        rotation, origin = placed.rotation[law.link], placed.origin[law.link]
        value = float(law.end - law.begin) * np.asarray(law.at(START)).mean(axis=1)
        value = rotation @ value if law.turning else value
        share = np.array([0.5 * float(law.begin + law.end) / float(model.length[law.link])])
        middle = origin[None] + axis_places(model, law.link, share) @ rotation.T
        found[name] = ForceAtStart(value[None], np.zeros((1, 3)), middle, middle)
    return found


def draw_forces(axes: Axes3D, mechanism: Mechanism, forces: Mapping[str, Any], size: float, drawn: Drawn) -> None:
    """Draw the forces at points of a mechanism of a size [m], by their histories from the start."""
    for force in mechanism.point_forces:
        history = forces[force.name]
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
