"""What a cross section gives per unit length, and what all homogeneous sections have in common.

Place in the pipeline: materials -> **section_bases** -> sections, walled_sections, polygons.

Symbols: A [m^2] area; I_y [m^4] second moment for bending in the plane of motion (about y), I_z out of it (about z);
J_t [m^4] torsion constant; kappa [1] shear factor. Source: theory (1.1), (8.11), (18.7).
"""

import abc
import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rfem_jax.description.basics.errors import Checks, ChecksItself, InputError, require_name
from rfem_jax.description.basics.numbers import (
    Fields,
    Numbers,
    NumberTree,
    is_known,
    positive_number,
    read_number,
    traced,
)
from rfem_jax.description.mechanism.materials import Material

ROUND_POINTS = 32  # at the edge of a round section: the largest stress is found to within 0.5 %

# Stresses at a point of the edge per unit of axial force [1/m^2], of bending moment about y and z, and of torque
# [1/m^3]; of a coupled section twelve numbers: direct stress, and then shear stress, per unit of each of the six loads.
EdgePoint = tuple[Numbers, ...]


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


@dataclass(frozen=True)
class CoupledProperties(SectionProperties):
    """Of a section whose stretch, shear, torsion and bending act on each other.

    matrix: stiffness (6 rows of 6) in the order of the stiffnesses above, which are its diagonal [N, N m, N m^2];
    offset_y, offset_z: place of the mass centre in the section [m], about which the rotary inertias are; product: the
    entry yz of their tensor [kg m].
    """

    matrix: tuple[tuple[Numbers, ...], ...]
    offset_y: Numbers
    offset_z: Numbers
    product: Numbers


class Shape(abc.ABC, NumberTree, ChecksItself):
    """A homogeneous section of known geometry; subclasses give area, I_y, I_z, J_t and kappa."""

    numbers: ClassVar[Fields]
    shear_factor: float

    def _check_fields(self, checks: Checks) -> None:
        convert_numbers(checks, self.numbers)

    @property
    def kappa(self) -> Numbers:
        """Shear factor [1]."""
        return self.shear_factor

    @property
    def gaps(self) -> tuple[Numbers, ...]:
        """Distances [m] that must be greater than zero, besides its sizes."""
        return ()

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
        shear_y, shear_z = self._shears(rigidity)
        return SectionProperties(
            axial=stiffness * self.area,
            shear_y=shear_y,
            shear_z=shear_z,
            torsion=rigidity * self.torsion_constant,
            bending_y=stiffness * self.second_moment_y,
            bending_z=stiffness * self.second_moment_z,
            line_density=density * self.area,
            rotary_x=density * (self.second_moment_y + self.second_moment_z),
            rotary_y=density * self.second_moment_y,
            rotary_z=density * self.second_moment_z,
            damping=material.damping,
        )

    def _shears(self, rigidity: Numbers) -> tuple[Numbers, Numbers]:
        """Effective shear stiffnesses along y and z [N]."""
        shear = rigidity * self.area / self.kappa
        return shear, shear


def coupled_properties(
    plain: SectionProperties,
    material: Material,
    area: Numbers,
    factors: tuple[Numbers, Numbers, Numbers],
    centre: tuple[Numbers, Numbers],
    product: Numbers,
) -> CoupledProperties:
    """Of a homogeneous section with the given `plain` ones; shear factors kappa_y, kappa_yz, kappa_z [1], shear centre
    (y, z) from the centroid [m], product of inertia I_yz [m^4] (theory (18.7))."""
    (kappa_y, kappa_yz, kappa_z), (y, z) = factors, centre
    rigid = material.modulus_of_rigidity * area / (kappa_y * kappa_z - kappa_yz**2)
    along_y, mixed, along_z = rigid * kappa_z, -rigid * kappa_yz, rigid * kappa_y
    # A twist about the centroid shears the shear centre by (-z, y) of it.
    twist_y, twist_z = mixed * y - along_y * z, along_z * y - mixed * z
    torsion = plain.torsion + y * twist_z - z * twist_y
    bending = -material.youngs_modulus * product
    matrix = (
        (plain.axial, 0.0, 0.0, 0.0, 0.0, 0.0),
        (0.0, along_y, mixed, twist_y, 0.0, 0.0),
        (0.0, mixed, along_z, twist_z, 0.0, 0.0),
        (0.0, twist_y, twist_z, torsion, 0.0, 0.0),
        (0.0, 0.0, 0.0, 0.0, plain.bending_y, bending),
        (0.0, 0.0, 0.0, 0.0, bending, plain.bending_z),
    )
    values = {**vars(plain), "shear_y": along_y, "shear_z": along_z, "torsion": torsion}
    return CoupledProperties(**values, matrix=matrix, offset_y=0.0, offset_z=0.0, product=-material.density * product)


def coupled_edge(
    area: Numbers,
    moments: tuple[Numbers, Numbers, Numbers],
    centre: tuple[Numbers, Numbers],
    places: Sequence[tuple[Numbers, Numbers, Numbers]],
) -> tuple[EdgePoint, ...]:
    """Stresses at places (y, z) from the centroid [m], with the shear stress by the torque about the shear centre
    [1/m^3]; moments I_y, I_z, I_yz [m^4], shear centre from the centroid (theory (18.8))."""
    (about_y, about_z, product), (y_s, z_s) = moments, centre
    determinant, points = about_y * about_z - product**2, []
    for y, z, by_torque in places:
        by_y, by_z = (z * about_z - y * product) / determinant, (z * product - y * about_y) / determinant
        direct = 1.0 / area, 0.0, 0.0, 0.0, by_y, by_z
        points.append((*direct, 0.0, z_s * by_torque, -y_s * by_torque, by_torque, 0.0, 0.0))
    return tuple(points)


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


class OwnStiffness:
    """Base of sections that state their stiffnesses and inertias themselves, and take no material."""

    damping: float
    inertias: ClassVar[tuple[str, ...]] = ("line_density", "rotary_inertia_x", "rotary_inertia_y", "rotary_inertia_z")

    @property
    def gaps(self) -> tuple[Numbers, ...]:
        """Numbers that must be greater than zero, besides those that are given."""
        return ()


# Of a section that states its stiffnesses: what stresses need besides.
EDGE_FIELDS = {"edge_y": "length", "edge_z": "length", "edge_modulus": "pressure", "torsion_modulus": "section_modulus"}


def check_edge(checks: Checks, section: Any) -> None:
    """Check and convert the edge of a section."""
    for name, dimension in EDGE_FIELDS.items():
        if getattr(section, name) is not None:
            checks.convert(name, positive_number, dimension, f"`{name}` of {type(section).__name__}")
    checks.relation(tuple(EDGE_FIELDS), _require_edge, section)


def _require_edge(section: Any) -> None:
    """Raise InputError if only some of the edge of a section is given."""
    missing = [name for name in EDGE_FIELDS if getattr(section, name) is None]
    if missing and len(missing) < len(EDGE_FIELDS):
        raise InputError(
            f"Argument `{missing[0]}` of {type(section).__name__} must be given where the edge of the section is, but "
            f"is missing; give {', '.join(EDGE_FIELDS)}, or none of these."
        )


def refuse_material(material: Any) -> None:
    """Raise InputError for a material beside a section of given stiffnesses."""
    if material is not None:
        raise InputError(
            "Argument `material` must be left out for a section of given stiffnesses, "
            f"but was {material!r}; remove it (the section holds the density and the damping)."
        )


def stacked(rows: Sequence[Sequence[Numbers]]) -> Float[np.ndarray, "*n r c"] | Float[Array, "*n r c"]:
    """Rows of numbers, or of one number for each of several places, as a matrix for each place."""
    xp: Any = jnp if traced(rows) else np
    entries = xp.broadcast_arrays(*(xp.asarray(x, float) for row in rows for x in row))
    return xp.stack(entries, axis=-1).reshape((*entries[0].shape, len(rows), len(rows[0])))


def inverse_of(rows: Sequence[Sequence[Numbers]]) -> tuple[Any, list[Numbers]]:
    """The inverse of a symmetric matrix (r, r), or of one for each of several places (n, r, r), and its pivots: all are
    positive if it is positive definite."""
    matrix, pivots, n = stacked(rows), [], len(rows)
    for k in range(n):
        unit = np.eye(n)[k].reshape((1,) * (matrix.ndim - 2) + (n,))
        others, pivot = 1.0 - unit, matrix[..., k, k, None]
        pivots.append(pivot[..., 0])
        row = (matrix[..., k, :] * others + unit) / pivot
        column = unit - matrix[..., :, k] * others
        matrix = matrix * (others[..., None] * others[..., None, :]) + column[..., None] * row[..., None, :]
    return matrix, pivots


def convert_numbers(checks: Checks, names: Collection[str]) -> None:
    if checks.owner.name is not None:
        checks.convert("name", require_name, "`name` of a section")
    for name in names:
        checks.convert(name, read_number, checks.owner.numbers[name], f"`{name}` of {type(checks.owner).__name__}")
