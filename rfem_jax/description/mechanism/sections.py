"""Cross sections of links and what they give per unit length.

Place in the pipeline: links hold a section and a material; `mechanics` reads `SectionProperties`.

Axes of a section: y along the hinge axis, z in the plane of motion. Symbols: A [m^2] area; I_y
[m^4] second moment for bending in the plane of motion (about y), I_z out of it (about z); J_t [m^4]
torsion constant; kappa [1] shear factor (effective shear stiffness = G A / kappa).
The formulas take floats, and traced numbers of a design alike.
Source: theory (1.1), (1.2); G. R. Cowper, J. Appl. Mech. 33 (1966) 335-340 (tube, nu = 0). Stresses at the edge of
a section: theory (8.11); torsion of a rectangle: W. C. Young, R. G. Budynas, Roark's Formulas for Stress and Strain,
7th ed. (2002), table 10.1, and the series of S. Timoshenko, J. N. Goodier, Theory of Elasticity (1970), section 109.
"""

import math
from collections.abc import Collection
from dataclasses import dataclass, field
from typing import ClassVar, get_args

from rfem_jax.description.basics.errors import Checks, ChecksItself, InputError
from rfem_jax.description.basics.numbers import (
    NOT_NEGATIVE,
    POSITIVE,
    Fields,
    Numbers,
    NumberTree,
    chosen,
    is_known,
    larger,
    smaller,
    traced,
)
from rfem_jax.description.basics.units import DERIVED
from rfem_jax.description.mechanism.composite_sections import CompositeSection
from rfem_jax.description.mechanism.materials import Material
from rfem_jax.description.mechanism.polygons import PolygonSection
from rfem_jax.description.mechanism.section_bases import (
    EdgePoint,
    OwnStiffness,
    SectionProperties,
    Shape,
    check_edge,
    convert_numbers,
    refuse_material,
    require_triangle,
)
from rfem_jax.description.mechanism.walled_sections import (
    AngleSection,
    ChannelSection,
    CoupledShape,
    HollowRectangle,
    ISection,
    TeeSection,
)


@dataclass(frozen=True)
class Rectangle(Shape):
    """A solid rectangle.

    Args:
        width: b [m], along y (the hinge axis), > 0.
        height: h [m], along z (in the plane of motion), > 0.
        shear_factor: kappa [1], > 0; 1.2 is the static value.
        name: a word, by which parameters of the section are named; None = they are named by the link.
    """

    width: float
    height: float
    shear_factor: float = 1.2
    name: str | None = field(default=None, kw_only=True, compare=False)

    numbers: ClassVar[Fields] = {
        "width": ("length", POSITIVE),
        "height": ("length", POSITIVE),
        "shear_factor": ("none", POSITIVE),
    }

    @property
    def area(self) -> Numbers:
        return self.width * self.height

    @property
    def second_moment_y(self) -> Numbers:
        return self.width * self.height**3 / 12.0

    @property
    def second_moment_z(self) -> Numbers:
        return self.height * self.width**3 / 12.0

    @property
    def torsion_constant(self) -> Numbers:
        """J_t = a c^3 (1/3 - 0.21 (c/a) (1 - c^4 / (12 a^4))), a >= c [m^4].

        Against the exact series: 0.2 % for a square and for a >= 1.5 c, 0.5 % in between (at
        a = 1.14 c); a GivenSection may use the series.  The derivatives of a square with respect to both of its sides
        are alike, the means of those to either side.
        """
        long, short = larger(self.width, self.height), smaller(self.width, self.height)
        ratio = short / long
        return long * short**3 * (1.0 / 3.0 - 0.21 * ratio * (1.0 - ratio**4 / 12.0))

    def edge_stresses(self) -> tuple[EdgePoint, ...]:
        """At the corners, where torsion has no shear stress, and at the middles of the sides.

        Shear stress of a torque in the middle of a long side against the exact series: within 0.3 %; that of a short
        side over it, a polynomial fitted to the series: within 0.4 %.
        """
        y, z = self.width / 2.0, self.height / 2.0
        long, short = larger(self.width, self.height), smaller(self.width, self.height)
        r = short / long
        on_long = 3.0 / (long * short**2) * (1.0 + r * (0.6095 + r * (0.8865 + r * (-1.8023 + 0.91 * r))))
        on_short = on_long * (0.746045 + r * (-0.065367 + r * (0.099597 + r * (0.689470 - 0.472976 * r))))
        across_y = chosen(self.height >= self.width, on_long, on_short)
        across_z = chosen(self.height >= self.width, on_short, on_long)
        corners = tuple(self._edge_point(y * a, z * b, 0.0) for a in (1.0, -1.0) for b in (1.0, -1.0))
        sides = tuple(self._edge_point(y * a, 0.0, across_y) for a in (1.0, -1.0))
        return corners + sides + tuple(self._edge_point(0.0, z * a, across_z) for a in (1.0, -1.0))


class RoundShape(Shape):
    """A section that is the same about all axes across it."""

    @property
    def second_moment_z(self) -> Numbers:
        return self.second_moment_y

    @property
    def torsion_constant(self) -> Numbers:
        return 2.0 * self.second_moment_y


@dataclass(frozen=True)
class Circle(RoundShape):
    """A solid circle.

    Args:
        diameter: [m], > 0.
        shear_factor: kappa [1], > 0; 10/9 is the static value.
        name: a word, by which parameters of the section are named; None = they are named by the link.
    """

    diameter: float
    shear_factor: float = 10.0 / 9.0
    name: str | None = field(default=None, kw_only=True, compare=False)

    numbers: ClassVar[Fields] = {"diameter": ("length", POSITIVE), "shear_factor": ("none", POSITIVE)}

    @property
    def area(self) -> Numbers:
        return math.pi * self.diameter**2 / 4.0

    def edge_stresses(self) -> tuple[EdgePoint, ...]:
        """At points around the circle."""
        return self._round_edge(self.diameter / 2.0)

    @property
    def second_moment_y(self) -> Numbers:
        return math.pi * self.diameter**4 / 64.0


@dataclass(frozen=True)
class Tube(RoundShape):
    """A circular tube.

    Args:
        outer_diameter: [m], > 0.
        wall: thickness [m], > 0 and less than half of the outer diameter.
        shear_factor: kappa [1], > 0; None = Cowper's value for nu = 0,
            7/6 + (10/3) r^2 / (1 + r^2)^2 with r = inner / outer diameter (2 for a thin wall); of traced diameters it
            stays None.
        name: a word, by which parameters of the section are named; None = they are named by the link.
    """

    outer_diameter: float
    wall: float
    shear_factor: float = DERIVED
    name: str | None = field(default=None, kw_only=True, compare=False)

    numbers: ClassVar[Fields] = {
        "outer_diameter": ("length", POSITIVE),
        "wall": ("length", POSITIVE),
        "shear_factor": ("none", POSITIVE),
    }

    def _check_fields(self, checks: Checks) -> None:
        convert_numbers(checks, ("outer_diameter", "wall"))
        checks.relation(("outer_diameter", "wall"), self._check_wall)
        if self.shear_factor is not None:
            convert_numbers(checks, ("shear_factor",))
        elif checks.passed("outer_diameter", "wall") and not traced((self.outer_diameter, self.wall)):
            object.__setattr__(self, "shear_factor", self.derived_factor)

    def _check_wall(self) -> None:
        if is_known(self.wall, self.outer_diameter) and self.wall >= self.outer_diameter / 2.0:
            raise InputError(
                "Argument `wall` of Tube must be less than half of the outer diameter "
                f"({self.outer_diameter / 2.0} m), but was {self.wall} m; reduce it, or use Circle."
            )

    @property
    def derived_factor(self) -> Numbers:
        """Cowper's shear factor [1]."""
        square = (self.inner_diameter / self.outer_diameter) ** 2
        return 7.0 / 6.0 + (10.0 / 3.0) * square / (1.0 + square) ** 2

    @property
    def kappa(self) -> Numbers:
        return self.derived_factor if self.shear_factor is None else self.shear_factor

    @property
    def gaps(self) -> tuple[Numbers, ...]:
        return (self.inner_diameter,)

    @property
    def inner_diameter(self) -> Numbers:
        return self.outer_diameter - 2.0 * self.wall

    def edge_stresses(self) -> tuple[EdgePoint, ...]:
        """At points around the outer circle."""
        return self._round_edge(self.outer_diameter / 2.0)

    @property
    def area(self) -> Numbers:
        return math.pi * self.wall * (self.outer_diameter - self.wall)

    @property
    def second_moment_y(self) -> Numbers:
        return self.area * (self.outer_diameter**2 + self.inner_diameter**2) / 16.0


@dataclass(frozen=True)
class GivenSection(OwnStiffness, NumberTree, ChecksItself):
    """A section given by its own stiffnesses and inertias per unit length; takes no material.

    Args:
        axial_stiffness: EA [N].
        shear_stiffness_y, shear_stiffness_z: effective GA_y, GA_z [N], shear factor included.
        torsion_stiffness: GJ [N m^2].
        bending_stiffness_y, bending_stiffness_z: EI_y (in the plane of motion), EI_z [N m^2].
        line_density: rho A [kg/m].
        rotary_inertia_x, rotary_inertia_y, rotary_inertia_z: rho I [kg m] about the axes; for a
            real section x = y + z.
        damping: eta [s], >= 0.
        edge_y, edge_z: largest distances [m] of the edge from the section's axes, for stresses.
        edge_modulus: Young's modulus [Pa] at the edge, for stresses.
        torsion_modulus: torque over the largest shear stress of torsion [m^3], for stresses; these four all or none.
        name: a word, by which parameters of the section are named; None = they are named by the link.
    Raises:
        InputError: a value is out of range, the rotary inertias belong to no body, or some of the edge is missing.
    """

    axial_stiffness: float
    shear_stiffness_y: float
    shear_stiffness_z: float
    torsion_stiffness: float
    bending_stiffness_y: float
    bending_stiffness_z: float
    line_density: float
    rotary_inertia_x: float
    rotary_inertia_y: float
    rotary_inertia_z: float
    damping: float = 0.0
    edge_y: float | None = None
    edge_z: float | None = None
    edge_modulus: float | None = None
    torsion_modulus: float | None = None
    name: str | None = field(default=None, kw_only=True, compare=False)

    numbers: ClassVar[Fields] = {
        **dict.fromkeys(("axial_stiffness", "shear_stiffness_y", "shear_stiffness_z"), ("axial_stiffness", POSITIVE)),
        **dict.fromkeys(
            ("torsion_stiffness", "bending_stiffness_y", "bending_stiffness_z"), ("bending_stiffness", POSITIVE)
        ),
        "line_density": ("line_density", POSITIVE),
        **dict.fromkeys([f"rotary_inertia_{axis}" for axis in "xyz"], ("rotary_inertia", POSITIVE)),
        "damping": ("time", NOT_NEGATIVE),
    }

    def _check_fields(self, checks: Checks) -> None:
        convert_numbers(checks, self.numbers)
        inertias = ("rotary_inertia_x", "rotary_inertia_y", "rotary_inertia_z")
        where = "`rotary_inertia_x`, `_y` and `_z` of GivenSection"
        checks.relation(inertias, require_triangle, tuple(getattr(self, one) for one in inertias), where)
        check_edge(checks, self)

    def edge_stresses(self) -> tuple[EdgePoint, ...]:
        """At the corners of the rectangle around the section, together with the largest shear stress of torsion; none
        if the edge is not given."""
        if self.edge_y is None or self.edge_z is None or self.edge_modulus is None or self.torsion_modulus is None:
            return ()
        modulus = self.edge_modulus
        along, by_torque = modulus / self.axial_stiffness, 1.0 / self.torsion_modulus
        about_y = modulus * self.edge_z / self.bending_stiffness_y
        about_z = modulus * self.edge_y / self.bending_stiffness_z
        return tuple((along, a * about_y, b * about_z, by_torque) for a in (1.0, -1.0) for b in (1.0, -1.0))

    def properties(self, material: Material | None = None) -> SectionProperties:
        """Return the given values; `material` must be None."""
        refuse_material(material)
        return SectionProperties(*(getattr(self, name) for name in _GIVEN))


# In the order of the fields of SectionProperties.
_GIVEN = (
    "axial_stiffness", "shear_stiffness_y", "shear_stiffness_z", "torsion_stiffness", "bending_stiffness_y",
    "bending_stiffness_z", "line_density", "rotary_inertia_x", "rotary_inertia_y", "rotary_inertia_z", "damping",
)  # fmt: skip

Section = (
    Rectangle
    | Circle
    | Tube
    | HollowRectangle
    | ISection
    | ChannelSection
    | AngleSection
    | TeeSection
    | GivenSection
    | CompositeSection
    | PolygonSection
)
SECTION_KINDS: tuple[type, ...] = get_args(Section)
CoupledSection = CoupledShape | CompositeSection | PolygonSection  # those whose properties are a matrix


def plane_names(plane: str) -> tuple[str, str]:
    """Names of a section's axes that lie along y and z of its link, with the plane of a description; signs apart."""
    return ("y", "z") if plane == "xz" else ("z", "y")


def plane_edges(points: Collection[EdgePoint], plane: str) -> tuple[EdgePoint, ...]:
    """Stresses at the edge per unit of loads in the axes of a link."""
    if plane == "xz":
        return tuple(points)
    # Moments about y of the section are about z of the link, those about its z about -y; forces alike.
    return tuple(_turned(point) for point in points)


def _turned(point: EdgePoint) -> EdgePoint:
    if len(point) == 4:
        axial, about_y, about_z, torque = point
        return axial, -about_z, about_y, torque
    axial, along_y, along_z, torque, about_y, about_z = point[:6]
    direct = axial, -along_z, along_y, torque, -about_z, about_y
    return direct if len(point) == 6 else (*direct, *_turned(point[6:]))


def coupled_edges(points: Collection[EdgePoint]) -> tuple[EdgePoint, ...]:
    """Points of any section with twelve numbers each, as those of a coupled one."""

    def of(point: EdgePoint) -> EdgePoint:
        if len(point) == 12:
            return point
        axial, about_y, about_z, torque = point
        return axial, 0.0, 0.0, 0.0, about_y, about_z, 0.0, 0.0, 0.0, torque, 0.0, 0.0

    return tuple(of(point) for point in points)
