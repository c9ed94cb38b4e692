"""The outline of the rocker and its division into hexahedra: two eyes, a tapered shank, fillets between them.

The rocker lies along x from bore D, the origin, to bore C; pins are along y, by which the outline is thickened, and z
is across, in the plane of motion.  Blocks are grids of points, every second one a corner of an element, the others at
the middles of its edges, faces and inside: on the arcs themselves, which elements of second order follow.
"""

from typing import NamedTuple

import numpy as np


class Eye(NamedTuple):
    """An end of the rocker [m]: radius of the bore, radius outside, radius of the fillets; half the height that the
    shank would have at its bore, and how that changes away from it."""

    bore: float
    outside: float
    fillet: float
    height: float
    slope: float


class Divisions(NamedTuple):
    """Numbers of elements: along the free part of an eye, along each of its fillets, across the shank, along it, from
    bore to outline, through the thickness."""

    round: int
    fillet: int
    across: int
    along: int
    wall: int
    thick: int


LENGTH, THICKNESS = 0.3, 0.012
SHANK = (0.014, 0.010)  # half its height at D and at C
TAPER = (SHANK[0] - SHANK[1]) / LENGTH
D, C = Eye(0.015, 0.025, 0.012, SHANK[0], -TAPER), Eye(0.010, 0.018, 0.012, SHANK[1], TAPER)
FULL, QUICK = Divisions(12, 4, 4, 16, 2, 3), Divisions(6, 2, 2, 6, 1, 1)
FAN = (0.2, 0.65)  # rad: parts of a bore from which the elements fan out that meet the shank, and the fillets
BELOW = np.array([1.0, -1.0])


class Fillet(NamedTuple):
    """The fillet above the axis: its centre, where it leaves the eye, where it meets the straight side."""

    centre: np.ndarray
    leaves: np.ndarray
    meets: np.ndarray


def fillet_of(eye: Eye) -> Fillet:
    """The arc that is tangent to an eye at the origin and to the side of the shank, which leads away along x."""
    normal = np.array([-eye.slope, 1.0]) / np.hypot(eye.slope, 1.0)
    off, reach = normal[1] * eye.height + eye.fillet, eye.outside + eye.fillet
    centre = off * normal + np.sqrt(reach**2 - off**2) * np.array([normal[1], -normal[0]])
    return Fillet(centre, centre * eye.outside / reach, centre - eye.fillet * normal)


def angle(vector) -> float:
    return float(np.arctan2(vector[1], vector[0]))


def arc(radius: float, first: float, last: float, elements: int) -> np.ndarray:
    """Points on an arc about the origin, by angles [rad]."""
    angles = np.linspace(first, last, 2 * elements + 1)
    return radius * np.stack([np.cos(angles), np.sin(angles)], axis=1)


def ring(eye: Eye, n: Divisions) -> np.ndarray:
    """Points (around, from bore to outline, 2) of an eye at the origin and its fillets, to where the shank begins."""
    fillet = fillet_of(eye)
    turned = angle(fillet.meets - fillet.centre), angle(fillet.leaves - fillet.centre) - 2.0 * np.pi
    upper = fillet.centre + arc(eye.fillet, turned[0], turned[1] % (-2.0 * np.pi), n.fillet)
    free = arc(eye.outside, angle(fillet.leaves), 2.0 * np.pi - angle(fillet.leaves), n.round)
    cut = np.linspace(fillet.meets * BELOW, fillet.meets, 2 * n.across + 1)
    outline = np.concatenate([cut[:-1], upper[:-1], free[:-1], BELOW * upper[::-1]])
    ends = (-FAN[0], *FAN, 2.0 * np.pi - FAN[1], 2.0 * np.pi - FAN[0])
    parts = [arc(eye.bore, *ends[k : k + 2], size) for k, size in enumerate((n.across, n.fillet, n.round, n.fillet))]
    bore = np.concatenate([*(part[:-1] for part in parts[:-1]), parts[-1]])
    share = np.linspace(0.0, 1.0, 2 * n.wall + 1)[:, None]
    return bore[:, None] * (1.0 - share) + outline[:, None] * share


def blocks(n: Divisions) -> list[np.ndarray]:
    """Grids (2 a + 1, 2 b + 1, 2) of points in the plane x, z: eye D, shank, eye C."""
    end = np.array([LENGTH, 0.0])
    mirrored = end - BELOW * ring(C, n)[::-1]
    first, last = fillet_of(D).meets, end - BELOW * fillet_of(C).meets
    share = np.linspace(0.0, 1.0, 2 * n.along + 1)[:, None]
    upper = first * (1.0 - share) + last * share
    across = np.linspace(-1.0, 1.0, 2 * n.across + 1)
    shank = np.stack([np.broadcast_to(upper[:, :1], (len(upper), len(across))), upper[:, 1:] * across], axis=2)
    return [ring(D, n)[:, ::-1], shank, mirrored[:, ::-1]]
