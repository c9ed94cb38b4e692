"""A moving mechanism as programs that draw know it: bodies with frames at instants, lines, and loads of joints.

Place in the pipeline: the records of a run's page -> **scene** -> vtk_writer, gltf_writer.

Global axes, SI units; T instants.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from rfem_jax.mechanics.dynamics.centre_lines import Bodies
from rfem_jax.mechanics.model.topology import Topology


@dataclass(frozen=True)
class Part:
    """A rigid finite element: link, number within it from 0, where it begins and ends in its frame [m], its frame."""

    link: str
    number: int
    ends: Float[np.ndarray, "2 3"]
    rotation: Float[np.ndarray, "T 3 3"]
    point: Float[np.ndarray, "T 3"]


@dataclass(frozen=True)
class JointPlace:
    """A joint: where its centre is, its deviation from the perfect mechanism's [m], force [N] and moment [N m] on the
    child, in global axes."""

    name: str
    centre: Float[np.ndarray, "T 3"]
    deviation: Float[np.ndarray, "T 3"]
    force: Float[np.ndarray, "T 3"]
    moment: Float[np.ndarray, "T 3"]


@dataclass(frozen=True)
class Line:
    """Points along a link, P of them, and their deviations from those of the perfect mechanism [m]."""

    link: str
    points: Float[np.ndarray, "T P 3"]
    deviation: Float[np.ndarray, "T P 3"]


@dataclass(frozen=True)
class Scene:
    """A motion: title, times (T,) [s], bodies, lines, joints."""

    title: str
    times: Float[np.ndarray, " T"]
    parts: tuple[Part, ...]
    lines: tuple[Line, ...]
    joints: tuple[JointPlace, ...]

    @property
    def size(self) -> float:
        """The largest distance of any point from the first one [m]."""
        points = np.concatenate([line.points for line in self.lines], axis=1)
        return float(np.nanmax(np.linalg.norm(points - points[0, 0], axis=-1)))


def parts_of(topology: Topology, bodies: Bodies) -> tuple[Part, ...]:
    """The rfes, link by link."""
    rotation, point = np.asarray(bodies.rotation), np.asarray(bodies.point)
    ends, found = np.asarray(bodies.ends), []
    for l, (name, (a, b)) in enumerate(zip(topology.links, topology.ranges, strict=True)):
        nodes = [l, *range(topology.n_links + a, topology.n_links + b)]
        found += [
            Part(name, number, ends[:, node], rotation[:, node], point[:, node]) for number, node in enumerate(nodes)
        ]
    return tuple(found)


def scene_of(
    title: str, description: dict[str, Any], arrays: dict[str, np.ndarray], parts: tuple[Part, ...],
    loads: dict[str, tuple[np.ndarray, np.ndarray]],
) -> Scene:  # fmt: skip
    """The scene of a case.

    **Arguments:** `description`, `arrays`: what the page's records say of it (`report.page.animation`); `loads`: force
    (T, 3) and moment (T, 3) of every joint, in the frames of these records.
    """
    points, away, lines, first = arrays["points"], arrays["points"] - arrays["nominal_points"], [], 0
    for link in description["links"]:
        those = slice(first, first + link["points"])
        lines.append(Line(link["name"], points[:, those], away[:, those]))
        first = those.stop
    joints = []
    for j, joint in enumerate(description["joints"]):
        turned = (np.einsum("tij,tj->ti", arrays["rotation"][:, j], load) for load in loads[joint["name"]])
        centre = arrays["centre"][:, j]
        joints.append(JointPlace(joint["name"], centre, centre - arrays["nominal_centre"][:, j], *turned))
    return Scene(title, arrays["times"], parts, tuple(lines), tuple(joints))
