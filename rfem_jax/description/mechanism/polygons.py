"""Sections of any outline: polygons.

Place in the pipeline: section_bases -> **polygons** -> sections.

Areas and moments are exact, by Green's theorem. What needs a boundary value problem (torsion, shear) is given, or
computed once, when the section is made, by the package sectionproperties (finite elements, Poisson's ratio 0): so
corners are no parameters, and the size of the whole is one.
Source: theory (18.9); sectionproperties: R. van Leeuwen, J. Open Source Software 9 (2024) 6105.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from importlib import import_module
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Float

from rfem_jax.description.basics.errors import Checks, InputError
from rfem_jax.description.basics.numbers import ANY, POSITIVE, Fields, Numbers, positive_number, read_number, traced
from rfem_jax.description.basics.units import DERIVED, short
from rfem_jax.description.mechanism.materials import Material
from rfem_jax.description.mechanism.section_bases import (
    CoupledProperties,
    EdgePoint,
    Shape,
    convert_numbers,
    coupled_edge,
    coupled_properties,
)

_DERIVED = ("torsion", "shear_factor_y", "shear_factor_z", "shear_factor_yz", "shear_centre")
_TRIANGLES = 600  # of the mesh: torsion constants within 0.1 %, where corners reach inwards, too
_FLAT = 1e-9  # area over the square of the extent, below which corners are on a line
Corner = tuple[float, float]


@dataclass(frozen=True)
class PolygonSection(Shape):
    """A solid section whose outline is a polygon, drawn in axes of its own; the centroid is on the axis of the link.

    Args:
        points: corners (y, z) [m] around the section, y along the hinge axis, z in the plane of motion; at least three.
        torsion: torsion constant J_t [m^4], > 0; None = it, and what else is None, computed by sectionproperties.
        shear_factor_y, shear_factor_z: kappa [1] of forces along y and z, > 0.
        shear_factor_yz: what couples them [1]; None = 0 where all others are given.
        shear_centre: its place (y, z) [m] in the axes of the points.
        torsion_modulus: torque over the largest shear stress of torsion [m^3], > 0, for stresses; None: nothing is said
            of stresses.
        scale: what all sizes are multiplied by [1], > 0, those that are given as well: 1 but for designs, deviations
            and tapers.
        name: a word, by which parameters of the section are named; None = they are named by the link.
    Raises:
        InputError: a value is out of range, the outline crosses itself, or what is missing cannot be computed.
    """

    points: tuple[Corner, ...]
    torsion: float = DERIVED
    shear_factor_y: float = DERIVED
    shear_factor_z: float = DERIVED
    shear_factor_yz: float = DERIVED
    shear_centre: Corner = DERIVED
    torsion_modulus: float | None = None
    scale: float = 1.0
    name: str | None = field(default=None, kw_only=True, compare=False)

    numbers: ClassVar[Fields] = {"scale": ("none", POSITIVE)}

    def _check_fields(self, checks: Checks) -> None:
        convert_numbers(checks, self.numbers)
        checks.convert("points", _read_points)
        given = [("torsion", "second_moment"), ("torsion_modulus", "section_modulus")]
        for name, dimension in (*given, ("shear_factor_y", "none"), ("shear_factor_z", "none")):
            if getattr(self, name) is not None:
                checks.convert(name, positive_number, dimension, f"`{name}` of PolygonSection")
        if self.shear_factor_yz is not None:
            checks.convert("shear_factor_yz", read_number, ("none", ANY), "`shear_factor_yz` of PolygonSection")
        if self.shear_centre is not None:
            checks.convert("shear_centre", _read_corner, "`shear_centre` of PolygonSection")
        checks.relation(("points", *_DERIVED), self._complete)

    def _complete(self) -> None:
        """What is missing of torsion and shear."""
        missing = [name for name in _DERIVED if getattr(self, name) is None]
        if missing == ["shear_factor_yz"]:
            object.__setattr__(self, "shear_factor_yz", 0.0)
        elif missing:
            computed = by_finite_elements(self.points, next(name for name in missing if name != "shear_factor_yz"))
            for name in missing:
                object.__setattr__(self, name, computed[name])
        y, z, yz = self.shear_factor_y, self.shear_factor_z, self.shear_factor_yz
        if yz**2 >= y * z:
            raise InputError(
                "Argument `shear_factor_yz` of PolygonSection must be less than the geometric mean of the others, but "
                f"was {yz:g}; correct it."
            )

    @property
    def area(self) -> Numbers:
        return self._moments[0]

    @property
    def centroid(self) -> tuple[Numbers, Numbers]:
        """In the axes in which the section is drawn [m]."""
        return self._moments[1]

    @property
    def second_moment_y(self) -> Numbers:
        return self._moments[2][0]

    @property
    def second_moment_z(self) -> Numbers:
        return self._moments[2][1]

    @property
    def product_of_inertia(self) -> Numbers:
        """I_yz, the integral of y z over the section, about the centroid [m^4]."""
        return self._moments[2][2]

    @property
    def torsion_constant(self) -> Numbers:
        return self.torsion * self.scale**4

    @property
    def from_centroid(self) -> tuple[Numbers, Numbers]:
        """The shear centre (y, z) from the centroid [m]."""
        y, z = self.centroid
        return self.shear_centre[0] * self.scale - y, self.shear_centre[1] * self.scale - z

    @property
    def _corners(self) -> list[tuple[Numbers, Numbers]]:
        return [(y * self.scale, z * self.scale) for y, z in self.points]

    @property
    def _moments(self) -> tuple[Numbers, tuple[Numbers, Numbers], tuple[Numbers, Numbers, Numbers]]:
        """Area, centroid, and second moments I_y, I_z, I_yz about it (theory (18.9))."""
        corners = self._corners
        y0, z0 = corners[0]
        area, first = _first_moments([(y - y0, z - z0) for y, z in corners])
        centre = first[0] / area, first[1] / area
        about = [(y - y0 - centre[0], z - z0 - centre[1]) for y, z in corners]
        return area, (y0 + centre[0], z0 + centre[1]), _second_moments(about)

    def edge_stresses(self) -> tuple[EdgePoint, ...]:
        """At the corners, with the largest shear stress of torsion; none if the torsion modulus is not given."""
        if self.torsion_modulus is None:
            return ()
        y0, z0 = self.centroid
        by_torque = 1.0 / (self.torsion_modulus * self.scale**3)
        return coupled_edge(
            self.area,
            (self.second_moment_y, self.second_moment_z, self.product_of_inertia),
            self.from_centroid,
            [(y - y0, z - z0, by_torque) for y, z in self._corners],
        )

    def properties(self, material: Material | None) -> CoupledProperties:
        """Return the properties per unit length of this section made of `material`."""
        plain = super().properties(material)
        assert isinstance(material, Material), "else refused"
        factors = self.shear_factor_y, self.shear_factor_yz, self.shear_factor_z
        return coupled_properties(plain, material, self.area, factors, self.from_centroid, self.product_of_inertia)

    def _shears(self, rigidity: Numbers) -> tuple[Numbers, Numbers]:
        return rigidity * self.area / self.shear_factor_y, rigidity * self.area / self.shear_factor_z


def _first_moments(corners: Sequence[tuple[Numbers, Numbers]]) -> tuple[Any, tuple[Any, Any]]:
    """Area, and its first moments along y and z, of a polygon that is run through with y turning to z."""
    area, y, z = 0.0, 0.0, 0.0
    for (a, b), (c, d) in zip(corners, (*corners[1:], corners[0])):
        part = 0.5 * (a * d - c * b)
        area, y, z = area + part, y + part * (a + c) / 3.0, z + part * (b + d) / 3.0
    return area, (y, z)


def _second_moments(corners: Sequence[tuple[Numbers, Numbers]]) -> tuple[Any, Any, Any]:
    """I_y, I_z and I_yz about the origin."""
    about_y, about_z, product = 0.0, 0.0, 0.0
    for (a, b), (c, d) in zip(corners, (*corners[1:], corners[0])):
        part = (a * d - c * b) / 12.0
        about_y, about_z = about_y + part * (b * b + b * d + d * d), about_z + part * (a * a + a * c + c * c)
        product = product + 0.5 * part * (a * d + 2.0 * a * b + 2.0 * c * d + c * b)
    return about_y, about_z, product


@lru_cache
def by_finite_elements(points: tuple[Corner, ...], asked: str) -> dict[str, Any]:
    """Torsion constant [m^4], shear factors and shear centre [m] of a polygon, by the package sectionproperties.

    **Raises:** `InputError` for `asked`, the key that is missing, where the package is.
    """
    try:
        geometries, analysis = import_module("sectionproperties.pre"), import_module("sectionproperties.analysis")
    except ImportError:
        raise InputError(
            f"Argument `{asked}` of PolygonSection must be given where the package sectionproperties is not installed, "
            "but is missing; give `torsion`, `shear_factor_y`, `shear_factor_z` and `shear_centre`, or install "
            "rfem_jax[sections]."
        ) from None
    size = math.sqrt(_first_moments(points)[0])  # in its own units: meshes of small things fail
    geometry = geometries.Geometry.from_points(
        [[y / size, z / size] for y, z in points],
        [[n, (n + 1) % len(points)] for n in range(len(points))],
        control_points=[list(_inside(np.array(points) / size))],
    )
    section = analysis.Section(geometry.create_mesh(mesh_sizes=[1.0 / _TRIANGLES]))
    section.calculate_geometric_properties()
    section.calculate_warping_properties()
    along_y, along_z = section.get_as()
    both, centre = section.section_props.a_sxy, section.get_sc()
    return {
        "torsion": float(section.get_j()) * size**4,
        "shear_factor_y": 1.0 / float(along_y),
        "shear_factor_z": 1.0 / float(along_z),
        "shear_factor_yz": 1.0 / float(both),
        "shear_centre": (float(centre[0]) * size, float(centre[1]) * size),
    }


def _read_corner(given: Any, where: str) -> Corner:
    if not isinstance(given, (list, tuple)) or len(given) != 2:
        raise InputError(f"Argument {where} must be two numbers (y, z) [m], but was {short(given)}; write both.")
    y, z = (read_number(one, ("length", ANY), where) for one in given)
    if traced((y, z)):
        raise InputError(
            f"Argument {where} must be known numbers, since torsion and shear of a polygon would not follow its "
            "corners, but was traced; change `scale`, or use a section with sizes."
        )
    return float(y), float(z)


def _read_points(given: Any) -> tuple[Corner, ...]:
    """Corners with y turning to z, of an outline that does not cross itself; else raise InputError."""
    where = "`points` of PolygonSection"
    if not isinstance(given, (list, tuple)) or len(given) < 3:
        raise InputError(
            f"Argument {where} must be at least three corners (y, z) [m] around the section, but was {short(given)}; "
            "write for example [[0, 0], [0.02, 0], [0, 0.03]]."
        )
    points = [_read_corner(one, f"{where}, number {n},") for n, one in enumerate(given, start=1)]
    area, extent = _first_moments(points)[0], np.ptp(np.array(points), axis=0).max()
    if abs(area) <= _FLAT * extent**2:
        raise InputError(
            f"Argument {where} must enclose an area, but all corners are on one line, or sides cross each other; put "
            "the corners in order around the section."
        )
    sides = list(zip(points, (*points[1:], points[0])))
    for i, one in enumerate(sides):
        for j in range(i + 1, len(sides)):
            beside = j == i + 1 or (i == 0 and j == len(sides) - 1)
            if one[0] == one[1] or (_folds(one, sides[j]) if beside else _touch(one, sides[j])):
                raise InputError(
                    f"Argument {where} must be an outline that does not touch itself, but its sides {i + 1} and "
                    f"{j + 1} do, or one has no length; put the corners in order around the section."
                )
    return tuple(points if area > 0.0 else points[::-1])


def _folds(one: tuple[Corner, Corner], other: tuple[Corner, Corner]) -> bool:
    """Whether a side leads back along the one beside it."""
    (a, b), (c, d) = ((q[0] - p[0], q[1] - p[1]) for p, q in (one, other))
    return a * c + b * d < 0.0 and abs(a * d - b * c) <= _FLAT * math.hypot(a, b) * math.hypot(c, d)


def _touch(one: tuple[Corner, Corner], other: tuple[Corner, Corner]) -> bool:
    """Whether two sides that are no neighbours have a point in common."""

    def side(a: Corner, b: Corner, c: Corner) -> float:
        return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])

    apart = [max(p[k] for p in a) < min(p[k] for p in b) for a, b in ((one, other), (other, one)) for k in (0, 1)]
    across = [side(*a, b[0]) * side(*a, b[1]) <= 0.0 for a, b in ((one, other), (other, one))]
    return not any(apart) and all(across)


def _inside(points: Float[np.ndarray, "n 2"]) -> tuple[float, float]:
    """A point inside a polygon: halfway into it from its longest side."""
    following = np.roll(points, -1, axis=0)
    n = int(np.linalg.norm(following - points, axis=1).argmax())
    middle, along = 0.5 * (points[n] + following[n]), following[n] - points[n]
    inwards = np.array([-along[1], along[0]]) / np.linalg.norm(along)
    hits = []
    for a, b in zip(points, following):
        matrix = np.array([inwards, a - b]).T
        if abs(np.linalg.det(matrix)) > 0.0:
            depth, share = np.linalg.solve(matrix, a - middle)
            hits += [depth] if depth > 1e-9 and -1e-9 <= share <= 1.0 + 1e-9 else []
    y, z = middle + 0.5 * min(hits) * inwards
    return float(y), float(z)
