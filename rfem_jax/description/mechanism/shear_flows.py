"""Shear flow in thin-walled open sections: shear centre and shear factors.

Place in the pipeline: **shear_flows** -> walled_sections.

A wall is straight, of one thickness, and stands for its middle line. The flow q [N/m] along it starts with what the
walls before it bring, nothing at a free end, and grows by the bending stress that a shear force makes along the link.
Source: theory (18.5), (18.6). The formulas take floats, arrays and traced numbers alike.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

from rfem_jax.description.basics.numbers import Numbers

_ROOT = 0.15**0.5  # of Gauss' three places in a wall, at which the products of two flows are integrated exactly
GAUSS = (0.5 - _ROOT, 5.0 / 18.0), (0.5, 8.0 / 18.0), (0.5 + _ROOT, 5.0 / 18.0)


class Wall(NamedTuple):
    """A wall from `start` to `end` (y, z) [m]; `before`: numbers of the walls whose flows arrive at its start."""

    start: tuple[Numbers, Numbers]
    end: tuple[Numbers, Numbers]
    thickness: Numbers
    length: Numbers
    before: tuple[int, ...] = ()


class ShearFlow(NamedTuple):
    """What the flow of a section gives: shear centre (y, z) [m] in the axes of its walls; shear factors [1], of strains
    along y by forces along y, along y by z (or z by y), along z by z."""

    centre: tuple[Numbers, Numbers]
    factors: tuple[Numbers, Numbers, Numbers]


class _Moments(NamedTuple):
    """Area [m^2], centroid [m], second moments about y, about z and their product [m^4] of all walls."""

    area: Any
    centre_y: Any
    centre_z: Any
    about_y: Any
    about_z: Any
    product: Any


def shear_flow(walls: Sequence[Wall]) -> ShearFlow:
    """The shear flow of an open section, every wall of which comes after those before it."""
    moments = _moments(walls)
    flows, ends, torques, factors = [], [], [0.0, 0.0], [0.0, 0.0, 0.0]
    for wall in walls:
        arriving = [sum((ends[one][k] for one in wall.before), 0.0) for k in range(2)]
        flows = [_flows(wall, moments, arriving, share) for share, _ in GAUSS]
        ends.append(_flows(wall, moments, arriving, 1.0))
        (y, z), (end_y, end_z) = wall.start, wall.end
        arm = y * (end_z - z) - z * (end_y - y)  # times the length
        for (by_y, by_z), (_, weight) in zip(flows, GAUSS, strict=True):
            torques = [torques[0] + weight * arm * by_y, torques[1] + weight * arm * by_z]
            share = weight * wall.length / wall.thickness
            products = by_y * by_y, by_y * by_z, by_z * by_z
            factors = [old + share * one for old, one in zip(factors, products, strict=True)]
    yy, yz, zz = (moments.area * one for one in factors)
    return ShearFlow((torques[1], -torques[0]), (yy, yz, zz))


def _moments(walls: Sequence[Wall]) -> _Moments:
    areas = [wall.thickness * wall.length for wall in walls]
    area = sum(areas[1:], areas[0])

    def mean(axis: int) -> Any:
        return sum(a * 0.5 * (wall.start[axis] + wall.end[axis]) for a, wall in zip(areas, walls, strict=True)) / area

    y, z = mean(0), mean(1)

    def second(one: int, other: int) -> Any:
        total: Any = 0.0
        for a, wall in zip(areas, walls, strict=True):
            (b, c), (d, e) = (
                (wall.start[axis] - middle, wall.end[axis] - middle)
                for axis, middle in ((one, (y, z)[one]), (other, (y, z)[other]))
            )
            total = total + a * (2.0 * b * d + b * e + c * d + 2.0 * c * e) / 6.0
        return total

    return _Moments(area, y, z, second(1, 1), second(0, 0), second(0, 1))


def _flows(wall: Wall, moments: _Moments, arriving: Sequence[Any], share: float) -> tuple[Any, Any]:
    """Flows [1/m] per force along y and along z at a share of a wall."""
    (y, z), (end_y, end_z) = wall.start, wall.end
    area = wall.thickness * wall.length * share
    # First moments of the wall up to here about the axes through the centroid.
    of_y = area * (y - moments.centre_y + 0.5 * share * (end_y - y))
    of_z = area * (z - moments.centre_z + 0.5 * share * (end_z - z))
    determinant = moments.about_y * moments.about_z - moments.product * moments.product
    by_y = (moments.about_y * of_y - moments.product * of_z) / determinant
    by_z = (moments.about_z * of_z - moments.product * of_y) / determinant
    return arriving[0] - by_y, arriving[1] - by_z
