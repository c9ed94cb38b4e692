"""The path of the perfect, rigid mechanism beside that of the real one, in NumPy.

Place in the pipeline: model + positions over time -> **nominal_path** -> report.

What errors and elasticity do to a mechanism is small beside its motion, and is seen only if it is exaggerated; for
that one must know from where it is measured. Here from the perfect mechanism with rigid links whose driven joints
stand where those of the real one do: then a difference in phase, which grows with time, is no deflection. The other
joints stand where the loops close, nearest to where they are: Gauss and Newton's iteration with the solution of least
norm, since the closure equations of a planar mechanism are redundant.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from rfem_jax.mechanics.model.model import Model
from rfem_jax.mechanics.model.nominal_geometry import (
    NominalGeometry,
    Placed,
    axis_places,
    gaps,
    geometry_of,
    joint_units,
    moved,
    offset,
    place,
    shortest,
)
from rfem_jax.mechanics.model.topology import Topology

ITERATIONS = 12
CLOSED = 1e-9  # of the longest link, or rad
STEP = 1e-6  # of differences, likewise
LONGEST = 0.3  # of an iteration, likewise
REDUNDANT = 1e-5  # singular values below this share of the largest one are of redundant equations


class NominalShape(NamedTuple):
    """The perfect mechanism at many times, as `centre_lines.Shape`; besides of all joints the frame on the parent
    without the joint's motion, and its centre [m], and the frame on the child; followed: places [m] of the points whose
    paths are followed, in the order of their names."""

    points: Float[np.ndarray, "times points 3"]
    rotation: Float[np.ndarray, "times joints 3 3"]
    centre: Float[np.ndarray, "times joints 3"]
    seat_rotation: Float[np.ndarray, "times joints 3 3"]
    seat_centre: Float[np.ndarray, "times joints 3"]
    bore_rotation: Float[np.ndarray, "times joints 3 3"]
    followed: Float[np.ndarray, "times followed 3"]


def nominal_shapes(model: Model, joints: Float[np.ndarray, "times numbers"]) -> NominalShape:
    """The perfect mechanism beside positions of the tree joints (as `Coordinates.joints`)."""
    geometry = geometry_of(model)
    topology = geometry.topology
    placed = place(geometry, nearest_closed(geometry, np.asarray(joints)))
    n = topology.n_links
    rotation = np.concatenate([placed.child_rotation[:, :n], placed.joint_rotation[:, n:]], axis=1)
    return NominalShape(
        points=_points(geometry, placed, model),
        rotation=rotation,
        centre=placed.child_centre,
        seat_rotation=placed.joint_rotation,
        seat_centre=placed.centre,
        bore_rotation=placed.child_rotation,
        followed=_followed(model, geometry, placed),
    )


def nearest_closed(
    geometry: NominalGeometry, joints: Float[np.ndarray, "times numbers"]
) -> Float[np.ndarray, "times numbers"]:
    """Positions at which the loops of the perfect mechanism are closed, with the driven coordinates as they are.

    Springs of compliant joints are at rest. Where the loops do not close with the driven coordinates held, these move
    too; where they close nowhere, positions are as near as the iteration came.
    """
    topology = geometry.topology
    start = np.array(joints, dtype=float)
    start[:, [topology.place_of(k) for k in topology.sprung_coordinates]] = 0.0
    if topology.n_constraints == 0:
        return start
    closed, left = _close(geometry, start, topology.held)
    again = ~(left < CLOSED)
    if again.any() and topology.held:
        closed[again], _ = _close(geometry, start[again], ())
    return closed


def _close(
    geometry: NominalGeometry, start: Float[np.ndarray, "times numbers"], held: tuple[int, ...]
) -> tuple[Float[np.ndarray, "times numbers"], Float[np.ndarray, " times"]]:
    """The closed positions with some coordinates held, and the largest residual that is left."""
    topology, positions = geometry.topology, start
    kept = {*held, *topology.sprung_coordinates}
    free = [k for k in range(topology.n_freedoms) if k not in kept]
    units = joint_units(geometry)
    probes = STEP * np.eye(topology.n_freedoms)[free]  # (free, F)
    residual = gaps(geometry, place(geometry, positions)).residual
    for _ in range(ITERATIONS):
        if not free or not np.any(np.abs(residual) >= CLOSED):
            break
        beside = moved(topology, np.repeat(positions[:, None], len(free), axis=1), probes * units)
        change = gaps(geometry, place(geometry, beside)).residual - residual[:, None]
        by_unit = np.moveaxis(np.nan_to_num(change), 1, 2) / STEP
        step = -shortest(by_unit, np.nan_to_num(residual), REDUNDANT)
        size = np.linalg.norm(step, axis=1, keepdims=True)
        step *= np.minimum(1.0, LONGEST / np.maximum(size, LONGEST))
        whole = np.zeros((len(positions), topology.n_freedoms))
        whole[:, free] = step
        positions = moved(topology, positions, whole * units)
        residual = gaps(geometry, place(geometry, positions)).residual
    return positions, np.max(np.abs(residual), axis=1, initial=0.0)


def _points(geometry: NominalGeometry, placed: Placed, model: Model) -> Float[np.ndarray, "times points 3"]:
    lines = []
    for l, places in enumerate(_places(geometry.topology, geometry.rest, model)):
        if places.ndim == 2:
            lines.append(placed.origin[:, None, l] + np.einsum("tij,pj->tpi", placed.rotation[:, l], places))
            continue
        along = placed.rotation[:, l, :, 0]
        lines.append(placed.origin[:, None, l] + places[:, None] * along[:, None])
    return np.concatenate(lines, axis=1)


def _followed(model: Model, geometry: NominalGeometry, placed: Placed) -> Float[np.ndarray, "times followed 3"]:
    """Places of the points whose paths are followed, on undeformed links."""
    topology, found = geometry.topology, [np.zeros((len(placed.origin), 0, 3))]
    for _, point in sorted((model.points or {}).items()):
        l, place = topology.link_of(point.node), np.array(point.position)
        place += offset(geometry, np.eye(3), point.node)
        found.append((placed.origin[:, l] + placed.rotation[:, l] @ place)[:, None])
    return np.concatenate(found, axis=1)


def _places(
    topology: Topology, rest: Float[np.ndarray, " rfes *axes"], model: Model
) -> list[Float[np.ndarray, " points *axes"]]:
    """Places x [m], of links with forms vectors, on every link of the points of `centre_lines.link_lines`."""
    length = np.asarray(model.length)
    if model.form is not None:
        return [axis_places(model, l, topology.drawn(l)[0]) for l in range(topology.n_links)]
    return [np.concatenate([[0.0], rest[a:b], [length[l]]]) for l, (a, b) in enumerate(topology.ranges)]
