"""Links: flexible beams or rigid ones along their local x axis, or rigid bodies, with point masses on them.

Place in the pipeline: a mechanism is links joined by joints; `mechanics` divides a flexible link
into rigid finite elements (rfes).

Symbols: length L [m], from joint to joint; rfes n [1], m = n - 1 spring-damping elements per link.
Source: theory (1.3) to (1.6).
"""

from dataclasses import dataclass, fields
from typing import Any, ClassVar

import numpy as np

from rfem_jax.description.basics.errors import (
    ABSENT,
    Checks,
    ChecksItself,
    InputError,
    require_entries,
    require_flag,
    require_instance,
    require_name,
)
from rfem_jax.description.basics.numbers import (
    ANY,
    NOT_NEGATIVE,
    POSITIVE,
    Fields,
    Number,
    NumberTree,
    is_known,
    non_negative_number,
    number,
    number_vector,
    positive_number,
    read_number,
    traced,
)
from rfem_jax.description.basics.units import DERIVED, Quantity, short
from rfem_jax.description.mechanism.axes import AxisPoint, curve_of, require_curve
from rfem_jax.description.mechanism.cambers import CamberPoint, camber_of, require_between_ends
from rfem_jax.description.mechanism.curves import Camber, Curve
from rfem_jax.description.mechanism.materials import Material
from rfem_jax.description.mechanism.reduced_bodies import ReducedBody
from rfem_jax.description.mechanism.rigid_bodies import RigidBody
from rfem_jax.description.mechanism.section_bases import OwnStiffness, SectionProperties, require_triangle
from rfem_jax.description.mechanism.sections import SECTION_KINDS, Section
from rfem_jax.description.mechanism.stations import (
    Span,
    Station,
    require_alike,
    require_order,
    section_between,
    spans_of,
)

MOST_RFES = 1000
_USUAL_RFES = 5
SAME_LENGTH = 1e-9  # of the length that a copy of a link with an axis has
GRADIENTS = ("temperature_gradient_y", "temperature_gradient_z")
FLEXIBILITIES = ("axial", "shear", "bending", "torsion")
_SLENDER = frozenset(("bending", "torsion"))


@dataclass(frozen=True)
class PointMass(NumberTree, ChecksItself):
    """A mass fixed on a link (a bearing, a pin).

    Args:
        mass: [kg], > 0.
        position: (x, y, z) [m] in the link frame; a single number x means on the axis.
        inertia: principal moments of inertia about the link's axes through its centre [kg m^2].
    """

    mass: float
    position: tuple[float, float, float]
    inertia: tuple[float, float, float] = (0.0, 0.0, 0.0)

    numbers: ClassVar[Fields] = {
        "mass": ("mass", POSITIVE),
        "position": ("length", ANY),
        "inertia": ("moment_of_inertia", NOT_NEGATIVE),
    }

    def _check_fields(self, checks: Checks) -> None:
        checks.convert("mass", positive_number, "mass", "`mass` of a point mass")
        checks.convert("position", place_on_link, "`position` of a point mass")
        checks.convert("inertia", _inertia, "`inertia` of a point mass")


def place_on_link(place: Any, where: str) -> tuple[float, float, float]:
    """Return a place in the frame of a link as floats [m]; else raise InputError.  A single number is x on the axis."""
    if isinstance(place, (list, tuple)) or getattr(place, "ndim", 0):
        return number_vector(place, "length", where)
    return number(place, "length", where), 0.0, 0.0  # a number: on the axis


def _inertia(inertia: Any, where: str) -> tuple[float, float, float]:
    principal = number_vector(inertia, "moment_of_inertia", where)
    for entry in principal:
        non_negative_number(entry, "moment_of_inertia", where)
    require_triangle(principal, where)
    return principal


ENTRIES = {
    "axis": (
        AxisPoint, "AxisPoint", "write for example [AxisPoint((0.1, 0.0, 0.0)), AxisPoint((0.2, 0.0, 0.05))].",
    ),
    "camber": (
        CamberPoint, "CamberPoint", "write for example [CamberPoint(0.1, y=5e-5), CamberPoint(0.2, y=8e-5)].",
    ),
    "point_masses": (PointMass, "PointMass", "write for example [PointMass(0.05, 0.12)]."),
    "stations": (Station, "Station", "write for example [Station(section=Rectangle(0.01, 0.005))]."),
}  # fmt: skip


@dataclass(frozen=True)
class Link(NumberTree, ChecksItself):
    """A rigid or flexible link; its frame has x along the beam and its origin at its start.

    Args:
        name: a word, other than "base".
        length: L [m], > 0; of a link with an axis that along it, of one with a reduced body that from interface to
            interface, and left out.
        section: a Rectangle, a GivenSection or of another shape (a rigid link needs it for its mass, unless it has a
            body), of a link with stations that at its start.
        material: a Material; None with a section that states its own stiffnesses.
        rigid: True makes the link one rigid body.
        rfes: number n of rigid finite elements of a flexible link; 1 is the same as rigid.
        point_masses: PointMass objects on the link.
        body: in the place of section and material a RigidBody, of a rigid link, or a ReducedBody, by the matrices of
            its finite element model.
        temperature: its difference to the temperature of assembly [K], by which it and all places on it grow by the
            share thermal_expansion * temperature.
        thermal_expansion: alpha [1/K]; None: that of its material.
        temperature_gradient_y, temperature_gradient_z: how fast the temperature rises across a flexible link, along y
            and z of its frame [K/m], by which it bends without load.
        stations: Station objects, where the section changes; their places are along the axis.
        axis: AxisPoint objects, through which the axis of a link leads that is not straight, from the origin of its
            frame; (): the axis is x.
        smooth: True makes the axis the smooth curve through all points.
        camber: CamberPoint objects, the measured shape of a straight link with a section; it has errors of form then.
        form_errors: True gives a straight link with a section errors of form: its bow, and a twist that grows evenly
            along it.
        flexibility: how a flexible link gives way, ["bending", "torsion"] or all four with "axial" and "shear" (None).
    Raises:
        InputError: a value is out of range or of the wrong kind.
    """

    name: str
    length: float = DERIVED
    section: Section | None = None
    material: Material | None = None
    rigid: bool = False
    rfes: int = _USUAL_RFES
    point_masses: tuple[PointMass, ...] = ()
    body: RigidBody | ReducedBody | None = None
    temperature: Quantity | None = None
    thermal_expansion: Quantity | None = None
    temperature_gradient_y: Quantity | None = None
    temperature_gradient_z: Quantity | None = None
    stations: tuple[Station, ...] = ()
    axis: tuple[AxisPoint, ...] = ()
    smooth: bool = False
    camber: tuple[CamberPoint, ...] = ()
    form_errors: bool = False
    flexibility: tuple[str, ...] | None = None

    numbers: ClassVar[Fields] = {
        "temperature": ("temperature", ANY),
        "thermal_expansion": ("thermal_expansion", ANY),
        "temperature_gradient_y": ("temperature_gradient", ANY),
        "temperature_gradient_z": ("temperature_gradient", ANY),
    }

    def _check_fields(self, checks: Checks) -> None:
        checks.convert("name", require_name, "`name` of a link", ("base",))
        of = f"of link `{self.name}`"
        checks.convert("axis", require_entries, f"`axis` {of}", *ENTRIES["axis"])
        checks.convert("camber", require_entries, f"`camber` {of}", *ENTRIES["camber"])
        checks.convert("smooth", require_flag, f"`smooth` {of}")
        checks.convert("form_errors", require_flag, f"`form_errors` {of}")
        if self.axis:
            checks.relation(("axis", "smooth"), self._take_axis, of)
        elif self.reduced:
            checks.relation((), self._take_length_along, "body", of)
        elif self.body is not ABSENT or self.length is not None:  # what a body that cannot be read would say of it
            checks.convert("length", _length, of)
        if self.body is None:
            give = "give a rigid link one too, for its mass, or a `body`."
            checks.convert("section", require_instance, f"`section` {of}", SECTION_KINDS, give)
            checks.relation(("section", "material"), self._check_material, of)
        else:
            write = "write for example RigidBody(0.5, (0.05, 0.0, 0.0), (1e-4, 3e-4, 3e-4))."
            checks.convert("body", require_instance, f"`body` {of}", (RigidBody, ReducedBody), write)
            checks.relation(("section", "material", "body"), self._check_body, of)
        for name, field in self.numbers.items():
            if getattr(self, name) is not None:
                checks.convert(name, read_number, field, f"`{name}` {of}")
        if self.reduced:
            checks.relation((), self._check_reduced, of)
        for name in ("temperature", *GRADIENTS):
            checks.relation(("material", name, "thermal_expansion"), self._check_temperature, name, of)
        checks.convert("rigid", require_flag, f"`rigid` {of}")
        checks.convert("rfes", _number_of_rfes, of)
        for name in GRADIENTS:
            checks.relation(("rigid", "rfes", "axis", name), self._check_bends, name, of)
        checks.relation(("axis", "smooth", "body", "form_errors", "camber", "length"), self._check_forms, of)
        if self.flexibility is not None:
            checks.convert("flexibility", _flexibility, of)
            checks.relation(("rigid", "rfes", "body", "flexibility"), self._check_flexible, of)
        for name in ("point_masses", "stations"):
            checks.convert(name, require_entries, f"`{name}` {of}", *ENTRIES[name])
        checks.relation(("length", "section", "body", "stations"), self._check_stations, of)
        for entry in self.point_masses if checks.passed("point_masses") else ():
            checks.relation(("length", "rigid", "rfes"), self._check_point_mass, entry, of)

    def _check_material(self, of: str) -> None:
        self._check_material_of(self.section, of)

    def _check_material_of(self, section: Section | None, of: str) -> None:
        if isinstance(section, OwnStiffness):
            if self.material is not None:
                raise InputError(
                    f"Argument `material` {of} must be left out where the section gives its own "
                    "stiffnesses, but a material was given; remove it."
                )
        elif not isinstance(self.material, Material):
            raise InputError(
                f"Argument `material` {of} must be a Material, but was {self.material!r}; "
                "a section needs one for its stiffness and its mass."
            )

    def _check_reduced(self, of: str) -> None:
        """What the matrices of a body know nothing of."""
        for name in ("temperature", "thermal_expansion", *GRADIENTS, "flexibility"):
            if getattr(self, name) is not None:
                raise InputError(
                    f"Argument `{name}` {of} must be left out where the link has a reduced body, whose matrices do not "
                    f"say what it changes, but was {short(getattr(self, name))}; leave it out."
                )

    def _check_temperature(self, name: str, of: str) -> None:
        if getattr(self, name) is not None and self.expansion is None:
            raise InputError(
                f"Argument `{name}` {of} must be left out where nothing says by how much the link grows, but was "
                f"{short(getattr(self, name))}; give `thermal_expansion` of its material, or of the link."
            )

    def _check_bends(self, name: str, of: str) -> None:
        if getattr(self, name) is not None and self.axis:
            raise InputError(
                f"Argument `{name}` {of} must be left out where the link has an `axis`, along which it would change, "
                f"but was {short(getattr(self, name))}; leave it out."
            )
        if getattr(self, name) is not None and not self.flexible:
            raise InputError(
                f"Argument `{name}` {of} must be left out where the link is rigid, as it does not bend, but was "
                f"{short(getattr(self, name))}; make the link flexible, or leave it out."
            )

    def _take_axis(self, of: str) -> None:
        """The length along the axis."""
        if self.body is not None:
            raise InputError(
                f"Argument `axis` {of} must be left out where the link has a body, which has no axis, but was given; "
                "remove one of the two."
            )
        require_curve(self.axis, self.smooth, of)
        self._take_length_along("axis", of)

    def _take_length_along(self, source: str, of: str) -> None:
        along, given = self.curve.length, None if self.length is None else _length(self.length, of)
        if given is not None and not (is_known(given, along) and abs(given / along - 1.0) < SAME_LENGTH):
            raise InputError(
                f"Argument `length` {of} must be left out where `{source}` says where the link leads, but was "
                f"{short(given)}; remove it."
            )
        object.__setattr__(self, "length", along if traced(along) else float(along))

    def _check_forms(self, of: str) -> None:
        if self.smooth and not self.axis:
            raise InputError(
                f"Argument `smooth` {of} must be left out where there is no `axis`, but was True; give one."
            )
        if (self.form_errors or self.camber) and (self.axis or self.body is not None):
            name = "camber" if self.camber else "form_errors"
            raise InputError(
                f"Argument `{name}` {of} must be left out where the link has an `axis`, whose points may deviate, "
                "or a body, but was given; leave it out."
            )
        if self.camber:
            require_between_ends(self.camber, self.length, of)
            object.__setattr__(self, "form_errors", True)

    def _check_flexible(self, of: str) -> None:
        if self.flexibility is not None and not self.flexible:
            raise InputError(
                f"Argument `flexibility` {of} must be left out where the link is rigid, but was "
                f"{list(self.flexibility)!r}; make the link flexible, or leave it out."
            )

    def _check_stations(self, of: str) -> None:
        if not self.stations:
            return
        if self.section is None:
            raise InputError(
                f"Argument `stations` {of} must be left out where the link has a body, but was given; remove one of "
                "the two."
            )
        require_order(self.length, self.stations, of)
        require_alike(self.spans, of)
        for span in self.spans:
            for section in span[2:]:
                self._check_material_of(section, of)

    def _check_body(self, of: str) -> None:
        for field in ("section", "material"):
            if getattr(self, field) is not None:
                raise InputError(
                    f"Argument `{field}` {of} must be left out where the link has a body, but was given; remove one "
                    "of the two."
                )
        if self.rfes not in (1, _USUAL_RFES):
            raise InputError(
                f"Argument `rfes` {of} must be left out where the link has a body, which is not divided, but was "
                f"{self.rfes!r}; remove it, or give a section and a material."
            )

    def _check_point_mass(self, mass: PointMass, of: str) -> None:
        known = is_known(mass.position[0], self.length)
        if self.flexible and not self.reduced and known and not 0.0 <= mass.position[0] <= self.length * (1.0 + 1e-12):
            raise InputError(
                f"Argument `point_masses` {of} must lie on the flexible link "
                f"(x from 0 to {self.length} m), but one has x = {mass.position[0]} m; "
                "move it, or make the link rigid."
            )

    @property
    def elements(self) -> int:
        """Number of rigid finite elements; 1 for a rigid link."""
        if self.body is None:
            return 1 if self.rigid else self.rfes
        return self.body.nodes if isinstance(self.body, ReducedBody) and not self.rigid else 1

    @property
    def reduced(self) -> bool:
        """True if the link has a reduced body."""
        return isinstance(self.body, ReducedBody)

    @property
    def course(self) -> tuple[AxisPoint, ...]:
        """Where a link leads that is not along x: the points of its axis, or the interfaces of its reduced body."""
        if not isinstance(self.body, ReducedBody):
            return self.axis
        _, *others = np.asarray(self.body.interfaces).tolist()
        return tuple(AxisPoint(tuple(place)) for place in others)

    @property
    def expansion(self) -> Number | None:
        """Its thermal expansion [1/K]; None where none is given."""
        if self.thermal_expansion is not None:
            return self.thermal_expansion  # pyright: ignore[reportReturnType]  # converted
        return None if self.material is None else self.material.thermal_expansion  # pyright: ignore[reportReturnType]

    @property
    def flexible(self) -> bool:
        """True if the link has spring-damping elements (two rfes or more)."""
        return self.elements > 1

    @property
    def slender(self) -> bool:
        """True if the segments of a flexible link neither stretch nor shear."""
        return self.flexibility is not None and set(self.flexibility) == _SLENDER

    @property
    def properties(self) -> SectionProperties:
        """Stiffnesses, inertias and damping per unit length, zeros of a body."""
        if self.section is None:
            return SectionProperties(**dict.fromkeys((field.name for field in fields(SectionProperties)), 0.0))
        return self.section.properties(self.material)

    @property
    def curve(self) -> Curve:
        """Its axis, by the length along it."""
        axis = self.course or (AxisPoint((self.length, 0.0, 0.0)),)
        return curve_of(axis, self.smooth and bool(self.axis))

    @property
    def offsets(self) -> Camber:
        """Its measured offsets from x, by the place along it; zero without a camber."""
        return camber_of(self.camber, self.length)

    @property
    def spans(self) -> tuple[Span, ...]:
        """The parts of a link with a section, between its stations."""
        assert self.section is not None, "a body has none"
        return spans_of(self.length, self.section, self.stations)

    @property
    def sections(self) -> tuple[Section, ...]:
        """Its sections in their order, those of its stations included; none of a body."""
        of_stations = (one for station in self.stations for one in (station.section, station.after))
        return tuple(one for one in (self.section, *of_stations) if one is not None)

    @property
    def beam_mass(self) -> Number:
        """Mass [kg] without point masses and body."""
        if not self.stations:
            return self.properties.line_density * self.length
        total: Number = 0.0
        for begin, end, first, last in self.spans:  # Simpson's rule, which is exact for areas of linear sizes
            for share, weight in ((0.0, 1.0), (0.5, 4.0), (1.0, 1.0)):
                density = section_between(first, last, share).properties(self.material).line_density
                total = total + weight / 6.0 * (end - begin) * density
        return total

    @property
    def mass(self) -> Number:
        """All mass [kg], that of point masses included."""
        if isinstance(self.body, ReducedBody):
            own = self.body.total_mass
        else:
            own = self.beam_mass if self.body is None else self.body.mass
        return own + sum(point.mass for point in self.point_masses)


def _length(length: Any, of: str) -> Any:
    if length is None:
        raise InputError(
            f"Argument `length` {of} must be given, but is missing; add it, or an `axis` if the link is not straight."
        )
    return positive_number(length, "length", f"`length` {of}")


def _number_of_rfes(rfes: Any, of: str) -> int:
    whole = isinstance(rfes, (int, np.integer)) and not isinstance(rfes, bool)
    if not whole or rfes < 1:
        raise InputError(
            f"Argument `rfes` {of} must be a whole number of at least 1, but was "
            f"{rfes!r}; 5 is usual, 1 makes the link rigid."
        )
    if rfes > MOST_RFES:
        raise InputError(
            f"Argument `rfes` {of} must be at most {MOST_RFES}, but was {short(rfes)}; 5 is usual, and the "
            "error falls with its square."
        )
    return int(rfes)


def _flexibility(given: Any, of: str) -> tuple[str, ...]:
    """Words of `FLEXIBILITIES`, all of them or those of a link whose segments neither stretch nor shear."""
    words = tuple(map(str, given)) if isinstance(given, (list, tuple)) else ()
    if len(set(words)) != len(words) or set(words) not in (set(FLEXIBILITIES), _SLENDER):
        raise InputError(
            f'Argument `flexibility` {of} must be ["bending", "torsion"] or all of {list(FLEXIBILITIES)}, but was '
            f"{short(given)}; leave it out for all."
        )
    return words
