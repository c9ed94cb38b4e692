"""Sections of flat walls: hollow rectangle, I, channel, angle and tee.

Place in the pipeline: section_bases, shear_flows -> **walled_sections** -> sections.

Corners are sharp: fillets are left out, which makes a rolled section of steel up to a few per cent too light and too
compliant. Areas and second moments are exact; shear factors (Poisson's ratio 0) and shear centres are those of thin
walls. Warping is free: an end that prevents it makes torsion of an I, a channel or a hollow rectangle stiffer.
Source: theory (18.1) to (18.8); G. R. Cowper, J. Appl. Mech. 33 (1966) 335-340; torsion constants: I. A. El Darwish,
B. G. Johnston, Torsion of structural shapes, J. Struct. Div. ASCE 91 (ST1, 1965) 203-227.
"""

import abc
import math
from dataclasses import dataclass, field
from typing import ClassVar, NamedTuple

from rfem_jax.description.basics.errors import Checks, InputError
from rfem_jax.description.basics.numbers import POSITIVE, Fields, Numbers, is_known, larger, smaller
from rfem_jax.description.basics.units import DERIVED
from rfem_jax.description.mechanism.materials import Material
from rfem_jax.description.mechanism.section_bases import (
    EdgePoint,
    SectionProperties,
    Shape,
    convert_numbers,
    coupled_edge,
    coupled_properties,
)
from rfem_jax.description.mechanism.shear_flows import ShearFlow, Wall, shear_flow

# Of a right-angled corner of a closed wall in torsion: the squares of wall that it takes from the two middle lines
# (conformal mapping: 1 less 2 ln 2 / pi of a square is left); what it takes from the enclosed area and adds to the
# torsion of the open walls, in squares and fourth powers of the wall (fitted to finite elements).
_CORNER_SQUARES, _CORNER_AREA, _CORNER_TORSION = 2.0 * math.log(2.0) / math.pi, 0.1044, 0.0698


class Part(NamedTuple):
    """A rectangle of a section: its middle (y, z), its sizes along y and z [m]."""

    y: Numbers
    z: Numbers
    width: Numbers
    height: Numbers


class WalledShape(Shape):
    """A section of rectangles side by side, drawn in axes of its own; subclasses give these and its torsion."""

    def _check_fields(self, checks: Checks) -> None:
        given = [name for name in self.numbers if not (name in _FACTORS and getattr(self, name) is None)]
        convert_numbers(checks, given)
        for name, below, words in self._limits if checks.passed(*self.numbers) else ():
            checks.relation((name,), self._check_limit, name, below, words)

    def _check_limit(self, name: str, below: Numbers, words: str) -> None:
        value = getattr(self, name)
        if is_known(value, below) and value >= below:
            raise InputError(
                f"Argument `{name}` of {type(self).__name__} must be less than {words} ({below} m), but was {value} m; "
                "reduce it, or give the section's constants."
            )

    @property
    @abc.abstractmethod
    def parts(self) -> tuple[Part, ...]:
        """The rectangles."""

    @property
    @abc.abstractmethod
    def _limits(self) -> tuple[tuple[str, Numbers, str], ...]:
        """Names of sizes, what they must be less than [m], and words for it."""

    @property
    def gaps(self) -> tuple[Numbers, ...]:
        return tuple(below - getattr(self, name) for name, below, _ in self._limits)

    @property
    def area(self) -> Numbers:
        return sum((one.width * one.height for one in self.parts[1:]), self.parts[0].width * self.parts[0].height)

    @property
    def centroid(self) -> tuple[Numbers, Numbers]:
        """In the axes in which the section is drawn [m]."""
        y, z = (
            sum((one.width * one.height * middle for one, middle in zip(self.parts, middles, strict=True)), 0.0)
            for middles in zip(*((one.y, one.z) for one in self.parts), strict=True)
        )
        return y / self.area, z / self.area

    @property
    def second_moment_y(self) -> Numbers:
        _, z = self.centroid
        return sum((p.width * p.height * (p.height**2 / 12.0 + (p.z - z) ** 2) for p in self.parts), 0.0)

    @property
    def second_moment_z(self) -> Numbers:
        y, _ = self.centroid
        return sum((p.width * p.height * (p.width**2 / 12.0 + (p.y - y) ** 2) for p in self.parts), 0.0)

    @property
    @abc.abstractmethod
    def kappas(self) -> tuple[Numbers, Numbers]:
        """Shear factors along y and z [1], given or derived."""

    def _given(self, along_y: Numbers, along_z: Numbers) -> tuple[Numbers, Numbers]:
        """Shear factors, those that are given in the place of those that are derived."""
        y, z = (getattr(self, name, None) for name in _FACTORS)
        return along_y if y is None else y, along_z if z is None else z

    def _shears(self, rigidity: Numbers) -> tuple[Numbers, Numbers]:
        along_y, along_z = self.kappas
        return rigidity * self.area / along_y, rigidity * self.area / along_z


_FACTORS = ("shear_factor_y", "shear_factor_z")
_SIZE = ("length", POSITIVE)
_DERIVED_FACTORS: Fields = dict.fromkeys(_FACTORS, ("none", POSITIVE))


def cowper_factor(flanges: Numbers, ratio: Numbers) -> Numbers:
    """Cowper's shear factor (Poisson's ratio 0) of thin webs along the force with flanges across them [1].

    Args: flanges, area of the flanges over that of the webs; ratio, width of the flanges over the distance of these.
    """
    m = flanges
    return (1.2 + m * (7.2 + m * (15.0 + 9.0 * m)) + 3.0 * ratio**2 * m * (1.0 + m)) / (1.0 + 3.0 * m) ** 2


@dataclass(frozen=True)
class HollowRectangle(WalledShape):
    """A rectangular tube of one thickness with sharp corners.

    Args:
        width: b [m], outside, along y (the hinge axis), > 0.
        height: h [m], outside, along z (in the plane of motion), > 0.
        wall: thickness [m], > 0 and less than half of the smaller side.
        shear_factor_y, shear_factor_z: kappa [1] of forces along y and z, > 0; None = Cowper's values for thin walls
            and nu = 0, too large by 2 to 5 % where the wall is a twentieth of the sides.
        name: a word, by which parameters of the section are named; None = they are named by the link.
    """

    width: float
    height: float
    wall: float
    shear_factor_y: float | None = DERIVED
    shear_factor_z: float | None = DERIVED
    name: str | None = field(default=None, kw_only=True, compare=False)

    numbers: ClassVar[Fields] = {**dict.fromkeys(("width", "height", "wall"), _SIZE), **_DERIVED_FACTORS}

    @property
    def _limits(self) -> tuple[tuple[str, Numbers, str], ...]:
        return (("wall", smaller(self.width, self.height) / 2.0, "half of the smaller side"),)

    @property
    def parts(self) -> tuple[Part, ...]:
        b, h, t = self.width, self.height, self.wall
        y, z = (b - t) / 2.0, (h - t) / 2.0
        webs = Part(-y, 0.0, t, h), Part(y, 0.0, t, h)
        return (*webs, Part(0.0, -z, b - 2.0 * t, t), Part(0.0, z, b - 2.0 * t, t))

    @property
    def torsion_constant(self) -> Numbers:
        """Bredt's formula with its corners, and the open walls: within 0.02 % of finite elements for walls from a
        twentieth to three tenths of the smaller side."""
        t, around = self.wall, 2.0 * (self.width + self.height - 2.0 * self.wall)
        enclosed = (self.width - t) * (self.height - t) - 4.0 * _CORNER_AREA * t**2
        closed = 4.0 * enclosed**2 / (around / t - 4.0 * _CORNER_SQUARES)
        return closed + around * t**3 / 3.0 + 4.0 * _CORNER_TORSION * t**4

    @property
    def kappas(self) -> tuple[Numbers, Numbers]:
        ratio = (self.width - self.wall) / (self.height - self.wall)
        return self._given(cowper_factor(1.0 / ratio, 1.0 / ratio), cowper_factor(ratio, ratio))

    def edge_stresses(self) -> tuple[EdgePoint, ...]:
        """At the corners, with the shear stress of the walls, T / (2 (b - t) (h - t) t)."""
        y, z, t = self.width / 2.0, self.height / 2.0, self.wall
        by_torque = 1.0 / (2.0 * (self.width - t) * (self.height - t) * t)
        return tuple(self._edge_point(a * y, b * z, by_torque) for a in (1.0, -1.0) for b in (1.0, -1.0))


@dataclass(frozen=True)
class FlangedShape(WalledShape):
    """A section of a web and flanges, of whose thicknesses neither may be many times the other one."""

    width: float
    height: float
    web: float
    flange: float
    shear_factor_y: float | None = DERIVED
    shear_factor_z: float | None = DERIVED
    name: str | None = field(default=None, kw_only=True, compare=False)

    numbers: ClassVar[Fields] = {**dict.fromkeys(("width", "height", "web", "flange"), _SIZE), **_DERIVED_FACTORS}

    @property
    def _limits(self) -> tuple[tuple[str, Numbers, str], ...]:
        return (
            ("web", smaller(self.width / 2.0, 2.0 * self.flange), "half of the width and twice `flange`"),
            ("flange", smaller(self.height / 2.0, 4.0 * self.web), "half of the height and four times `web`"),
        )


@dataclass(frozen=True)
class ISection(FlangedShape):
    """An I: a web along z (in the plane of motion) between two flanges along y (the hinge axis).

    Args:
        width: of the flanges [m], > 0.
        height: outside [m], > 0.
        web: thickness of the web [m], > 0, less than half of the width and than twice `flange`.
        flange: thickness of the flanges [m], > 0, less than half of the height and than four times `web`.
        shear_factor_y, shear_factor_z: kappa [1] of forces along y and z, > 0; None = of flanges that are rectangles,
            and Cowper's value for thin walls and nu = 0.
        name: a word, by which parameters of the section are named; None = they are named by the link.
    """

    @property
    def parts(self) -> tuple[Part, ...]:
        b, t = self.width, self.flange
        z = (self.height - t) / 2.0
        return Part(0.0, -z, b, t), Part(0.0, 0.0, self.web, self.height - 2.0 * t), Part(0.0, z, b, t)

    @property
    def torsion_constant(self) -> Numbers:
        """Of rectangles with their ends and junctions: within 2.5 % of finite elements where the web is no thicker than
        the flanges; 5 % too large where it is nearly twice as thick and a fifth of the width."""
        t = self.flange
        rectangles = 2.0 / 3.0 * self.width * t**3 + (self.height - 2.0 * t) * self.web**3 / 3.0
        return rectangles + 2.0 * _tee_junction(self.web, t) - 4.0 * _FREE_END * t**4

    @property
    def kappas(self) -> tuple[Numbers, Numbers]:
        between, flanges = self.height - self.flange, 2.0 * self.width * self.flange
        along_z = cowper_factor(flanges / (between * self.web), self.width / between)
        return self._given(1.2 * self.area / flanges, along_z)

    def edge_stresses(self) -> tuple[EdgePoint, ...]:
        """At the corners of the flanges and at the ends of the web, with the shear stress T t / J_t of their walls."""
        y, z, inner = self.width / 2.0, self.height / 2.0, self.height / 2.0 - self.flange
        signs = [(a, b) for a in (1.0, -1.0) for b in (1.0, -1.0)]
        in_flange, in_web = self.flange / self.torsion_constant, self.web / self.torsion_constant
        corners = tuple(self._edge_point(a * y, b * z, in_flange) for a, b in signs)
        return corners + tuple(self._edge_point(a * self.web / 2.0, b * inner, in_web) for a, b in signs)


class CoupledShape(WalledShape):
    """A section of open walls whose shear centre is not its centroid, or whose principal axes are not y and z."""

    @property
    @abc.abstractmethod
    def walls(self) -> tuple[Wall, ...]:
        """Its walls for the shear flow, in the axes in which the section is drawn."""

    @property
    @abc.abstractmethod
    def edge(self) -> tuple[tuple[Numbers, Numbers, Numbers], ...]:
        """Places (y, z) [m] of its outer corners, in the same axes, and thicknesses [m] of their walls."""

    @property
    def product_of_inertia(self) -> Numbers:
        """I_yz, the integral of y z over the section, about the centroid [m^4]."""
        y, z = self.centroid
        return sum((p.width * p.height * (p.y - y) * (p.z - z) for p in self.parts), 0.0)

    @property
    def shear_centre(self) -> tuple[Numbers, Numbers]:
        """(y, z) from the centroid [m], of thin walls."""
        return self._from_centroid(shear_flow(self.walls))

    def _from_centroid(self, flow: ShearFlow) -> tuple[Numbers, Numbers]:
        y, z = self.centroid
        return flow.centre[0] - y, flow.centre[1] - z

    @property
    def kappas(self) -> tuple[Numbers, Numbers]:
        along_y, _, along_z = shear_flow(self.walls).factors
        return self._given(along_y, along_z)

    def edge_stresses(self) -> tuple[EdgePoint, ...]:
        """At the outer corners, with the shear stress T t / J_t of their walls; T about the shear centre."""
        (y0, z0), constant = self.centroid, self.torsion_constant
        return coupled_edge(
            self.area,
            (self.second_moment_y, self.second_moment_z, self.product_of_inertia),
            self.shear_centre,
            [(y - y0, z - z0, thickness / constant) for y, z, thickness in self.edge],
        )

    def properties(self, material: Material | None) -> SectionProperties:
        """Return the properties per unit length of this section made of `material`."""
        plain = super().properties(material)
        assert isinstance(material, Material), "else refused"
        flow = shear_flow(self.walls)
        kappa_y, kappa_z = self._given(flow.factors[0], flow.factors[2])
        return coupled_properties(
            plain,
            material,
            self.area,
            (kappa_y, flow.factors[1], kappa_z),
            self._from_centroid(flow),
            self.product_of_inertia,
        )


@dataclass(frozen=True)
class ChannelSection(FlangedShape, CoupledShape):
    """A channel: a web along z (in the plane of motion) with two flanges towards +y (the hinge axis).

    Its shear centre lies on the other side of the web: forces in the plane of motion through its centroids, which are
    the axis of the link, twist it.

    Args:
        width: of the flanges [m], outside, > 0.
        height: outside [m], > 0.
        web: thickness of the web [m], > 0, less than half of the width and than twice `flange`.
        flange: thickness of the flanges [m], > 0, less than half of the height and than four times `web`.
        shear_factor_y, shear_factor_z: kappa [1] of forces along y and z, > 0; None = those of thin walls, nu = 0.
        name: a word, by which parameters of the section are named; None = they are named by the link.
    """

    @property
    def parts(self) -> tuple[Part, ...]:
        b, t = self.width, self.flange
        z = (self.height - t) / 2.0
        web = Part(self.web / 2.0, 0.0, self.web, self.height - 2.0 * t)
        return Part(b / 2.0, -z, b, t), web, Part(b / 2.0, z, b, t)

    @property
    def walls(self) -> tuple[Wall, ...]:
        y, length, z = self.web / 2.0, self.width - self.web / 2.0, (self.height - self.flange) / 2.0
        lower = Wall((self.width, -z), (y, -z), self.flange, length)
        web = Wall((y, -z), (y, z), self.web, 2.0 * z, (0,))
        return lower, web, Wall((y, z), (self.width, z), self.flange, length, (1,))

    @property
    def torsion_constant(self) -> Numbers:
        """Of rectangles with their ends and corners: within 1 % of finite elements for walls up to a tenth of the sides
        and alike, 6 % too small for a web of a quarter of the flanges."""
        t = self.flange
        rectangles = 2.0 / 3.0 * self.width * t**3 + (self.height - 2.0 * t) * self.web**3 / 3.0
        return rectangles + 2.0 * _corner_junction(self.web, t) - 4.0 * _FREE_END * t**4

    @property
    def edge(self) -> tuple[tuple[Numbers, Numbers, Numbers], ...]:
        z, thicker = self.height / 2.0, larger(self.web, self.flange)
        return tuple(
            (y, side * z, wall) for y, wall in ((0.0, thicker), (self.width, self.flange)) for side in (1.0, -1.0)
        )


@dataclass(frozen=True)
class TeeSection(FlangedShape, CoupledShape):
    """A T: a flange along y (the hinge axis) on top, at +z, and a web along z (in the plane of motion) below.

    Its shear centre is where they meet: forces along the hinges through its centroids, which are the axis of the link,
    twist it.

    Args:
        width: of the flange [m], > 0.
        height: outside [m], > 0.
        web: thickness of the web [m], > 0, less than half of the width and than twice `flange`.
        flange: thickness of the flange [m], > 0, less than half of the height and than four times `web`.
        shear_factor_y, shear_factor_z: kappa [1] of forces along y and z, > 0; None = those of thin walls, nu = 0.
        name: a word, by which parameters of the section are named; None = they are named by the link.
    """

    @property
    def parts(self) -> tuple[Part, ...]:
        web = self.height - self.flange
        return Part(0.0, 0.5 * web, self.web, web), Part(0.0, web + 0.5 * self.flange, self.width, self.flange)

    @property
    def walls(self) -> tuple[Wall, ...]:
        y, z = self.width / 2.0, self.height - self.flange / 2.0
        left, right = Wall((-y, z), (0.0, z), self.flange, y), Wall((y, z), (0.0, z), self.flange, y)
        return left, right, Wall((0.0, z), (0.0, 0.0), self.web, z, (0, 1))

    @property
    def torsion_constant(self) -> Numbers:
        """Of rectangles with their ends and junction: within 2 % of finite elements where the web is no thicker than
        the flange; 3 % too large where it is nearly twice as thick and a fifth of the width."""
        t = self.flange
        rectangles = self.width * t**3 / 3.0 + (self.height - t) * self.web**3 / 3.0
        return rectangles + _tee_junction(self.web, t) - _FREE_END * (2.0 * t**4 + self.web**4)

    @property
    def edge(self) -> tuple[tuple[Numbers, Numbers, Numbers], ...]:
        y, top = self.width / 2.0, self.height
        half = (y, top, self.flange), (y, top - self.flange, self.flange), (self.web / 2.0, 0.0, self.web)
        return tuple((side * y, z, wall) for y, z, wall in half for side in (1.0, -1.0))


@dataclass(frozen=True)
class AngleSection(CoupledShape):
    """An L of one thickness: legs towards +y (the hinge axis) and +z (in the plane of motion) from its corner.

    Its principal axes are not y and z, so that a force in the plane of motion bends it out of the plane, too. Its shear
    centre is in the corner, its axis the line of the centroids.

    Args:
        width: of the leg along y [m], outside, > 0.
        height: of the leg along z [m], outside, > 0.
        wall: thickness [m], > 0 and less than both legs.
        name: a word, by which parameters of the section are named; None = they are named by the link.
    """

    width: float
    height: float
    wall: float
    name: str | None = field(default=None, kw_only=True, compare=False)

    numbers: ClassVar[Fields] = dict.fromkeys(("width", "height", "wall"), _SIZE)

    @property
    def _limits(self) -> tuple[tuple[str, Numbers, str], ...]:
        return (("wall", smaller(self.width, self.height), "the shorter leg"),)

    @property
    def parts(self) -> tuple[Part, ...]:
        t, above = self.wall, self.height - self.wall
        return Part(self.width / 2.0, t / 2.0, self.width, t), Part(t / 2.0, t + above / 2.0, t, above)

    @property
    def walls(self) -> tuple[Wall, ...]:
        t = self.wall
        corner = t / 2.0, t / 2.0
        leg = Wall((self.width, t / 2.0), corner, t, self.width - t / 2.0)
        return leg, Wall(corner, (t / 2.0, self.height), t, self.height - t / 2.0, (0,))

    @property
    def torsion_constant(self) -> Numbers:
        """Of rectangles with their ends and corner: within 1 % of finite elements for walls up to a tenth of the longer
        leg, 1.6 % up to a fifth."""
        t = self.wall
        return (self.width + self.height - t) * t**3 / 3.0 + _corner_junction(t, t) - 3.0 * _FREE_END * t**4

    @property
    def edge(self) -> tuple[tuple[Numbers, Numbers, Numbers], ...]:
        b, h, t = self.width, self.height, self.wall
        return tuple((y, z, t) for y, z in ((0.0, 0.0), (b, 0.0), (b, t), (t, h), (0.0, h)))


_FREE_END = 0.105  # what the end of a rectangle takes from its torsion constant, of the fourth power of its thickness


def _tee_junction(web: Numbers, flange: Numbers) -> Numbers:
    """What the junction of a web with the middle of a flange adds to the torsion constant [m^4]."""
    ratio = web / flange
    circle = flange + web * ratio / 4.0  # diameter of the largest circle in it
    return (-0.042 + ratio * (0.2204 - 0.0725 * ratio)) * circle**4


def _corner_junction(web: Numbers, flange: Numbers) -> Numbers:
    """What the junction of a web with the end of a flange adds to the torsion constant [m^4]."""
    ratio = web / flange
    circle = 2.0 * (web + flange - (2.0 * web * flange) ** 0.5)
    return (-0.0908 + ratio * (0.2621 - 0.0945 * ratio)) * circle**4
