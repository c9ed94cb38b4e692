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

import abc
import math
from collections.abc import Collection
from dataclasses import dataclass, field
from typing import ClassVar

from rfem_jax.description.basics.errors import Checks, ChecksItself, InputError, require_name
from rfem_jax.description.basics.numbers import (
    NOT_NEGATIVE,
    POSITIVE,
    Fields,
    Numbers,
    NumberTree,
    chosen,
    is_known,
    larger,
    positive_number,
    read_number,
    smaller,
    traced,
)
from rfem_jax.description.basics.units import DERIVED
from rfem_jax.description.mechanism.materials import Material

ROUND_POINTS = 32  # at the edge of a round section: the largest stress is found to within 0.5 %

# Stresses at a point of the edge per unit of axial force [1/m^2], of bending moment about y and z, and of torque
# [1/m^3].
EdgePoint = tuple[Numbers, Numbers, Numbers, Numbers]


@dataclass(frozen=True)
class SectionProperties:
    """Stiffnesses, inertias and damping per unit length of a link.

    axial EA [N]; shear_y, shear_z G A / kappa [N]; torsion G J_t [N m^2]; bending_y E I_y and
    bending_z E I_z [N m^2]; line_density rho A [kg/m]; rotary_x, rotary_y, rotary_z
    rho (I_y + I_z), rho I_y, rho I_z [kg m]; damping eta [s].
    """

    axial: Numbers
    shear_y: Numbers
    shear_z: Numbers
    torsion: Numbers
    bending_y: Numbers
    bending_z: Numbers
    line_density: Numbers
    rotary_x: Numbers
    rotary_y: Numbers
    rotary_z: Numbers
    damping: Numbers


class _Shape(abc.ABC, NumberTree, ChecksItself):
    """A homogeneous section of known geometry; subclasses give area, I_y, I_z, J_t and kappa."""

    numbers: ClassVar[Fields]
    shear_factor: float

    def _check_fields(self, checks: Checks) -> None:
        _convert(checks, self.numbers)

    @property
    def kappa(self) -> Numbers:
        """Shear factor [1]."""
        return self.shear_factor

    @property
    @abc.abstractmethod
    def area(self) -> Numbers:
        """A [m^2]."""

    @property
    @abc.abstractmethod
    def second_moment_y(self) -> Numbers:
        """I_y [m^4]."""

    @property
    @abc.abstractmethod
    def second_moment_z(self) -> Numbers:
        """I_z [m^4]."""

    @property
    @abc.abstractmethod
    def torsion_constant(self) -> Numbers:
        """J_t [m^4]."""

    @abc.abstractmethod
    def edge_stresses(self) -> tuple[EdgePoint, ...]:
        """Stresses at points of the edge per unit of axial force, bending moments about y and z, and torque."""

    def _edge_point(self, y: Numbers, z: Numbers, by_torque: Numbers) -> EdgePoint:
        return 1.0 / self.area, z / self.second_moment_y, -y / self.second_moment_z, by_torque

    def _round_edge(self, radius: Numbers) -> tuple[EdgePoint, ...]:
        angles = [2.0 * math.pi * n / ROUND_POINTS for n in range(ROUND_POINTS)]
        by_torque = radius / self.torsion_constant
        return tuple(self._edge_point(radius * math.sin(a), radius * math.cos(a), by_torque) for a in angles)

    def properties(self, material: Material | None) -> SectionProperties:
        """Return the properties per unit length of this section made of `material`."""
        if not isinstance(material, Material):
            raise InputError(
                f"Argument `material` must be a Material for a {type(self).__name__} section, "
                f"but was {material!r}; give the link a material, or use a section of given "
                "stiffnesses."
            )
        stiffness, rigidity = material.youngs_modulus, material.modulus_of_rigidity
        density = material.density
        shear = rigidity * self.area / self.kappa
        return SectionProperties(
            axial=stiffness * self.area,
            shear_y=shear,
            shear_z=shear,
            torsion=rigidity * self.torsion_constant,
            bending_y=stiffness * self.second_moment_y,
            bending_z=stiffness * self.second_moment_z,
            line_density=density * self.area,
            rotary_x=density * (self.second_moment_y + self.second_moment_z),
            rotary_y=density * self.second_moment_y,
            rotary_z=density * self.second_moment_z,
            damping=material.damping,
        )


@dataclass(frozen=True)
class Rectangle(_Shape):
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


@dataclass(frozen=True)
class Circle(_Shape):
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

    @property
    def second_moment_z(self) -> Numbers:
        return self.second_moment_y

    @property
    def torsion_constant(self) -> Numbers:
        return 2.0 * self.second_moment_y


@dataclass(frozen=True)
class Tube(_Shape):
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
        _convert(checks, ("outer_diameter", "wall"))
        checks.relation(("outer_diameter", "wall"), self._check_wall)
        if self.shear_factor is not None:
            _convert(checks, ("shear_factor",))
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

    @property
    def second_moment_z(self) -> Numbers:
        return self.second_moment_y

    @property
    def torsion_constant(self) -> Numbers:
        return 2.0 * self.second_moment_y


@dataclass(frozen=True)
class GivenSection(NumberTree, ChecksItself):
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
        _convert(checks, self.numbers)
        inertias = ("rotary_inertia_x", "rotary_inertia_y", "rotary_inertia_z")
        where = "`rotary_inertia_x`, `_y` and `_z` of GivenSection"
        checks.relation(inertias, require_triangle, tuple(getattr(self, one) for one in inertias), where)
        for name, dimension in _EDGE.items():
            if getattr(self, name) is not None:
                checks.convert(name, positive_number, dimension, f"`{name}` of GivenSection")
        checks.relation(tuple(_EDGE), self._check_edge)

    def _check_edge(self) -> None:
        missing = [name for name in _EDGE if getattr(self, name) is None]
        if missing and len(missing) < len(_EDGE):
            raise InputError(
                f"Argument `{missing[0]}` of GivenSection must be given where the edge of the section is, but is "
                f"missing; give {', '.join(_EDGE)}, or none of these."
            )

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
        if material is not None:
            raise InputError(
                "Argument `material` must be left out for a section of given stiffnesses, "
                f"but was {material!r}; remove it (the section holds the density and the damping)."
            )
        return SectionProperties(*(getattr(self, name) for name in _GIVEN))


# In the order of the fields of SectionProperties.
_GIVEN = (
    "axial_stiffness", "shear_stiffness_y", "shear_stiffness_z", "torsion_stiffness", "bending_stiffness_y",
    "bending_stiffness_z", "line_density", "rotary_inertia_x", "rotary_inertia_y", "rotary_inertia_z", "damping",
)  # fmt: skip
_EDGE = {"edge_y": "length", "edge_z": "length", "edge_modulus": "pressure", "torsion_modulus": "section_modulus"}

Section = Rectangle | Circle | Tube | GivenSection


def plane_names(plane: str) -> tuple[str, str]:
    """Names of a section's axes that lie along y and z of its link, with the plane of a description; signs apart."""
    return ("y", "z") if plane == "xz" else ("z", "y")


def plane_edges(points: Collection[EdgePoint], plane: str) -> tuple[EdgePoint, ...]:
    """Stresses at the edge per unit of loads in the axes of a link."""
    if plane == "xz":
        return tuple(points)
    # Moments about y of the section are about z of the link, those about its z about -y.
    return tuple((axial, -about_z, about_y, torque) for axial, about_y, about_z, torque in points)


def require_triangle(inertias: tuple[float, float, float], where: str) -> None:
    """Raise InputError unless no principal inertia exceeds the sum of the two others, as far as these are known."""
    if not is_known(inertias):
        return
    largest = max(inertias)
    if largest > (sum(inertias) - largest) * (1.0 + 1e-9):
        raise InputError(
            f"Argument {where} must be the inertia of a real body (none larger than the sum of the "
            f"two others), but was {tuple(inertias)}; correct the largest."
        )


def _convert(checks: Checks, names: Collection[str]) -> None:
    if checks.owner.name is not None:
        checks.convert("name", require_name, "`name` of a section")
    for name in names:
        checks.convert(name, read_number, checks.owner.numbers[name], f"`{name}` of {type(checks.owner).__name__}")
