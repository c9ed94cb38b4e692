"""Symbols of the joints, springs and forces in the picture of the assembled mechanism, as textbooks draw them.

Place in the pipeline: called by `shapes`. Positions m, in global axes; a joint's frame G is that of its seat on the
parent at the start of the perfect mechanism. A slider is a box on the line of its guide, a hinge a circle on its axis,
a ball a grey disc, a universal joint a crossed circle with both axes; the base has a hatched triangle.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from rfem_jax.description.basics.joint_kinds import KINDS
from rfem_jax.description.mechanism.couplings import Coupling
from rfem_jax.description.mechanism.forces import JointForce, JointForceTable, JointSpring
from rfem_jax.description.mechanism.joints import Joint
from rfem_jax.description.mechanism.mechanism import Mechanism
from rfem_jax.report.contents.annotations import Axes3D, Model, Run

Point = Float[np.ndarray, " 3"]

# Arguments of `plot` by kind.
MARKERS: dict[str, dict[str, Any]] = {
    "revolute": {"marker": "o", "markersize": 6, "mfc": "white"},
    "prismatic": {"marker": "s", "markersize": 7, "mfc": "white"},
    "cylindrical": {"marker": "o", "markersize": 6, "mfc": "#BFBFBF"},
    "universal": {"marker": "$\\otimes$", "markersize": 9, "mfc": "black"},
    "spherical": {"marker": "o", "markersize": 8, "mfc": "#808080"},
    "planar": {"marker": "D", "markersize": 6, "mfc": "white"},
    "fixed": {"marker": "s", "markersize": 6, "mfc": "black"},
    "free": {"marker": "o", "markersize": 6, "mfc": "none"},
}
GUIDE: dict[str, Any] = {"color": "#404040", "linestyle": "-", "linewidth": 0.9}
AXIS: dict[str, Any] = {"color": "#404040", "linestyle": (0, (8, 2, 2, 2)), "linewidth": 0.8}
SPRING: dict[str, Any] = {"color": "#CC79A7", "linewidth": 1.2}
FORCE = "#009E73"
# Shares of the mechanism's size.
HALF_AXIS, HALF_BOX, END_OF_GUIDE, ARROW, COIL = 0.07, (0.045, 0.028, 0.028), 0.09, 0.13, 0.025
TURNS = 6  # of a coil


class Seat(NamedTuple):
    """Frame G of a joint (3, 3), (3,) m, and the joint's point on the child (3,) m, of the perfect mechanism at the
    start."""

    rotation: Float[np.ndarray, "3 3"]
    centre: Point
    child_centre: Point


def joint_seats(mechanism: Mechanism, model: Model | None = None) -> dict[str, Seat]:
    """The seats of all joints of the perfect mechanism at the start; `model`: where it was discretised already."""
    from rfem_jax.mechanics.model.discretisation import discretise
    from rfem_jax.mechanics.model.nominal_geometry import geometry_of, place

    model = discretise(mechanism) if model is None else model
    placed = place(geometry_of(model), np.asarray(model.start_joints))
    frames = zip(model.topology.joints, placed.joint_rotation, placed.centre, placed.child_centre, strict=True)
    return {name: Seat(rotation, centre, child) for name, rotation, centre, child in frames}


def guide_ends(joint: Joint, seat: Seat, runs: Mapping[str, Run], size: float) -> list[tuple[Point, Point]]:
    """Ends of the line of each translation of a joint: as far as it slides in the runs, and a little beyond."""
    sliding = [freedom.axis for freedom in KINDS[joint.kind].freedoms if not freedom.rotation]
    if joint.kind == "free":
        return []
    start = seat.rotation.T @ (seat.child_centre - seat.centre)
    found = []
    for number, axis in enumerate(sliding):
        travel = [np.ravel(start[axis])]
        for run in runs.values():
            values = np.asarray(run.motion.displacements.get(joint.name, np.zeros(0)))
            travel.append(values if values.ndim == 1 else values[:, number])
        travel = np.concatenate(travel)
        travel = travel[np.isfinite(travel)]
        middle = seat.centre + seat.rotation @ np.where(np.arange(3) == axis, 0.0, start)
        along = seat.rotation[:, axis]
        low, high = travel.min() - END_OF_GUIDE * size, travel.max() + END_OF_GUIDE * size
        found.append((middle + low * along, middle + high * along))
    return found


def draw_guides(axes: Axes3D, joint: Joint, ends: list[tuple[Point, Point]]) -> None:
    """The lines along which a joint slides; on the base they end on the ground."""
    for low, high in ends:
        axes.plot(*np.stack([low, high], axis=1), **GUIDE, zorder=1.5)
        if joint.parent == "base":
            for end in (low, high):
                axes.plot(*end[:, None], **_ground(size=9), zorder=1.5)


def draw_joint(axes: Axes3D, joint: Joint, point: Point, seat: Seat | None, size: float) -> None:
    """The symbol of a joint at `point` (3,); without a seat only what needs no direction."""
    kind = KINDS[joint.kind]
    if joint.parent == "base" and not kind.displacements:
        axes.plot(*point[:, None], **_ground(size=13), zorder=3)
    if joint.compliance is not None:
        axes.plot(*point[:, None], **_bushing(), zorder=6)
    if seat is not None:
        if kind.angles == 1 or joint.kind == "universal":
            _draw_axis(axes, point, seat.rotation[:, 1], size)
        if joint.kind == "prismatic":
            _draw_box(axes, point, seat.rotation, size)
            return
    axes.plot(*point[:, None], linestyle="none", color="black", zorder=5, **MARKERS[joint.kind])


def _bushing() -> dict[str, Any]:
    """Arguments of `plot` for the mark of a compliant joint: a spring across it."""
    from matplotlib.path import Path

    x, y = np.linspace(-1.0, 1.0, 9), 0.35 * np.array([0.0, 0.0, 1.0, -1.0, 1.0, -1.0, 1.0, 0.0, 0.0])
    path = Path(np.stack([x, y], axis=1))
    return {"linestyle": "none", "marker": path, "markersize": 20, "color": "black", "mfc": "none", "mew": 0.9}


def _ground(size: float) -> dict[str, Any]:
    """Arguments of `plot` for the mark of the base: a triangle under the point, on hatched ground."""
    from matplotlib.path import Path

    move, line = Path.MOVETO, Path.LINETO
    triangle = [(0.0, 0.0), (-0.6, -1.0), (0.6, -1.0), (0.0, 0.0)]
    ground = [(-0.9, -1.0), (0.9, -1.0)]
    hatch = [(x, -1.0 - y) for x in (-0.6, -0.2, 0.2, 0.6) for y in (0.0, 0.4)]
    hatch = [(x - 0.3 * (i % 2), y) for i, (x, y) in enumerate(hatch)]
    codes = [move, line, line, line, move, line, *[move, line] * 4]
    path = Path([*triangle, *ground, *hatch], codes)
    return {"linestyle": "none", "marker": path, "markersize": size, "color": "black", "mfc": "white", "mew": 0.8}


def _draw_axis(axes: Axes3D, point: Point, direction: Point, size: float) -> None:
    half = HALF_AXIS * size * direction
    axes.plot(*np.stack([point - half, point + half], axis=1), **AXIS, zorder=4)


def _draw_box(axes: Axes3D, point: Point, rotation: Float[np.ndarray, "3 3"], size: float) -> None:
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    faces = []
    for axis in range(3):
        for side in (-1.0, 1.0):
            face = np.insert(corners, axis, side, axis=1) * np.array(HALF_BOX) * size
            faces.append(point + face @ rotation.T)
    box = Poly3DCollection(faces, facecolor="#FFFFFFD0", edgecolor="black", linewidth=0.9)
    box.set_zorder(2.5)
    axes.add_collection3d(box)


def draw_force(axes: Axes3D, mechanism: Mechanism, force: JointForce, point: Point, seat: Seat, size: float) -> None:
    """A spring as a coil between the seat and the child, or around the axis; a law as an arrow with its name."""
    joint = mechanism.joint(force.joint)
    kind = KINDS[joint.kind]
    freedom = kind.freedoms[force.coordinate(joint)]
    along = seat.rotation[:, freedom.axis]
    if isinstance(force, JointSpring):
        line = _spiral(point, seat.rotation, freedom.axis, size)
        if not freedom.rotation:
            line = _coil(seat.centre, point, seat.rotation, freedom.axis, size)
        axes.plot(*line.T, **SPRING, zorder=3)
        place = line[len(line) // 2]
    elif freedom.rotation:
        arc = _arc(point, seat.rotation, freedom.axis, size)
        axes.plot(*arc[:-3].T, color=FORCE, linewidth=1.8, zorder=4)
        _draw_arrow(axes, arc[-4], arc[-1])
        place = arc[-1]
    else:
        sign = _sign(force, float((seat.child_centre - seat.centre) @ along))
        tip = point - sign * HALF_BOX[0] * size * along
        place = tip - sign * ARROW * size * along
        _draw_arrow(axes, place, tip)
    axes.text(
        place[0],
        place[1],
        place[2],
        f"{force.name}  ",
        fontsize=8,
        ha="right",
        va="top",
        color="#404040",
        parse_math=False,
        zorder=6,
    )


def _sign(force: JointForce, position: float) -> float:
    """Which way a law pushes at the start: that of its table; along the axis where it is a function."""
    if not isinstance(force, JointForceTable):
        return 1.0
    positions: Any = force.positions  # numbers, as the mechanism has resolved them
    values: Any = force.forces
    now = np.interp(position, positions, values)
    return -1.0 if (now or np.mean(values)) < 0.0 else 1.0


def _draw_arrow(axes: Axes3D, start: Point, tip: Point) -> None:
    axes.quiver(*start, *(tip - start), color=FORCE, linewidth=1.8, arrow_length_ratio=0.35, zorder=4)


def _coil(
    start: Point, end: Point, rotation: Float[np.ndarray, "3 3"], axis: int, size: float
) -> Float[np.ndarray, "points 3"]:
    """A zigzag from the seat to the child, beside the guide; of some length where both are at one place."""
    along, across = rotation[:, axis], rotation[:, (axis + 2) % 3]
    length = float((end - start) @ along)
    if abs(length) < 2.0 * COIL * size:
        start, length = end - 3.0 * ARROW * size * along, 3.0 * ARROW * size
    share = np.concatenate([[0.0], np.linspace(0.15, 0.85, 2 * TURNS + 1), [1.0]])
    side = np.zeros(len(share))
    side[2:-2] = np.where(np.arange(len(share) - 4) % 2, -1.0, 1.0)
    return start + share[:, None] * length * along + COIL * size * side[:, None] * across


def _circle(
    point: Point, rotation: Float[np.ndarray, "3 3"], axis: int, angles: Float[np.ndarray, " n"], radius: Any
) -> Float[np.ndarray, "n 3"]:
    one, other = rotation[:, (axis + 1) % 3], rotation[:, (axis + 2) % 3]
    return point + np.reshape(radius, (-1, 1)) * (np.cos(angles)[:, None] * one + np.sin(angles)[:, None] * other)


def _spiral(point: Point, rotation: Float[np.ndarray, "3 3"], axis: int, size: float) -> Float[np.ndarray, "n 3"]:
    angles = np.linspace(0.0, 5.0 * np.pi, 100)
    return _circle(point, rotation, axis, angles, np.linspace(0.01, 0.05, 100) * size)


def _arc(point: Point, rotation: Float[np.ndarray, "3 3"], axis: int, size: float) -> Float[np.ndarray, "n 3"]:
    return _circle(point, rotation, axis, np.linspace(0.3, 5.0, 40), np.full(40, 0.06 * size))


def legend_handles(mechanism: Mechanism) -> list[Any]:
    """Handles with labels of the kinds of joints and forces that the mechanism has."""
    from matplotlib.lines import Line2D

    kinds = list(dict.fromkeys(joint.kind for joint in mechanism.joints))
    found = [Line2D([], [], linestyle="none", color="black", label=kind, **MARKERS[kind]) for kind in kinds]
    if any(joint.parent == "base" for joint in mechanism.joints):
        found.append(Line2D([], [], label="base", **_ground(size=11)))
    if any(joint.compliance is not None for joint in mechanism.joints):
        found.append(Line2D([], [], label="compliant", **_bushing()))
    if any(isinstance(force, JointSpring) for force in mechanism.forces):
        found.append(Line2D([], [], label="spring, damper", **SPRING))
    if any(not isinstance(force, (JointSpring, Coupling)) for force in mechanism.forces):
        found.append(Line2D([], [], label="force", color=FORCE, linewidth=1.8, marker=">", markersize=6))
    return found
