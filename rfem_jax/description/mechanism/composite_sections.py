"""A section given by its full stiffness matrix: laminates, and whatever couples stretch, shear, torsion and bending.

Place in the pipeline: section_bases -> **composite_sections** -> sections.

Source: theory (18.7), (18.8). Matrices of this kind come from programs for cross sections of composites.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np

from rfem_jax.description.basics.errors import Checks, ChecksItself, InputError
from rfem_jax.description.basics.numbers import (
    ANY,
    NOT_NEGATIVE,
    POSITIVE,
    Fields,
    Number,
    Numbers,
    NumberTree,
    is_known,
    read_number,
    value_of,
)
from rfem_jax.description.basics.units import short
from rfem_jax.description.mechanism.section_bases import (
    CoupledProperties,
    EdgePoint,
    OwnStiffness,
    check_edge,
    convert_numbers,
    inverse_of,
    refuse_material,
    require_triangle,
)

_SYMMETRY = 1e-9  # of the roots of both entries of the diagonal
_SINGULAR = 1e-10  # of a matrix whose diagonal is 1
_LOADS = 6


@dataclass(frozen=True)
class CompositeSection(OwnStiffness, NumberTree, ChecksItself):
    """A section given by a full stiffness matrix and its inertias per unit length; takes no material.

    Args:
        stiffness: six rows of six: of the axial force N, the shear forces along y and z [N], the torque and the bending
            moments about y and z [N m] by the stretch, the shear strains [1], the twist and the curvatures [1/m], in
            [N], [N m] and [N m^2]; symmetric and positive definite.
        line_density: rho A [kg/m].
        rotary_inertia_x, rotary_inertia_y, rotary_inertia_z: rho I [kg m] about axes through the mass centre.
        rotary_inertia_yz: [kg m], entry yz of that tensor, minus the integral of rho y z.
        mass_offset_y, mass_offset_z: place of the mass centre [m] in the axes of the section.
        damping: eta [s], >= 0.
        edge_y, edge_z: largest distances [m] of the edge from the section's axes, for stresses.
        edge_modulus: Young's modulus [Pa] at the edge, for stresses.
        torsion_modulus: torque over the largest shear stress of torsion [m^3], for stresses; these four all or none.
        name: a word, by which parameters of the section are named; None = they are named by the link.
    Raises:
        InputError: a value is out of range, the matrix is not symmetric or not positive definite, the rotary inertias
            belong to no body, or some of the edge is missing.
    """

    stiffness: tuple[tuple[float, ...], ...]
    line_density: float
    rotary_inertia_x: float
    rotary_inertia_y: float
    rotary_inertia_z: float
    rotary_inertia_yz: float = 0.0
    mass_offset_y: float = 0.0
    mass_offset_z: float = 0.0
    damping: float = 0.0
    edge_y: float | None = None
    edge_z: float | None = None
    edge_modulus: float | None = None
    torsion_modulus: float | None = None
    name: str | None = field(default=None, kw_only=True, compare=False)

    numbers: ClassVar[Fields] = {
        "line_density": ("line_density", POSITIVE),
        **dict.fromkeys([f"rotary_inertia_{axis}" for axis in "xyz"], ("rotary_inertia", POSITIVE)),
        "rotary_inertia_yz": ("rotary_inertia", ANY),
        **dict.fromkeys(("mass_offset_y", "mass_offset_z"), ("length", ANY)),
        "damping": ("time", NOT_NEGATIVE),
    }
    inertias: ClassVar[tuple[str, ...]] = (
        "line_density", "rotary_inertia_x", "rotary_inertia_y", "rotary_inertia_z", "rotary_inertia_yz",
    )  # fmt: skip

    def _check_fields(self, checks: Checks) -> None:
        checks.convert("stiffness", _read_matrix)
        convert_numbers(checks, self.numbers)
        checks.relation(self.inertias[1:], self._check_inertias)
        check_edge(checks, self)

    def _check_inertias(self) -> None:
        entries = [getattr(self, name) for name in self.inertias[1:]]
        if not is_known(entries):
            return
        x, y, z, yz = map(float, entries)
        principal = np.linalg.eigvalsh([[y, yz], [yz, z]]).tolist()
        if principal[0] <= 0.0:
            raise InputError(
                "Argument `rotary_inertia_yz` of CompositeSection must be less than the geometric mean of those about "
                f"y and z, but was {yz}; correct it."
            )
        require_triangle(
            (x, principal[0], principal[1]), "`rotary_inertia_x`, `_y`, `_z` and `_yz` of CompositeSection"
        )

    @property
    def gaps(self) -> tuple[Number, ...]:
        """The pivots of the stiffness."""
        return tuple(inverse_of(self.stiffness)[1])

    def edge_stresses(self) -> tuple[EdgePoint, ...]:
        """At the corners of the rectangle around the section, of the strains there, with the largest shear stress of
        torsion; none if the edge is not given."""
        if self.edge_y is None or self.edge_z is None or self.edge_modulus is None or self.torsion_modulus is None:
            return ()
        flexibility, _ = inverse_of(self.stiffness)
        shear = 0.0, 0.0, 0.0, 1.0 / self.torsion_modulus, 0.0, 0.0
        points = []
        for a in (1.0, -1.0):
            for b in (1.0, -1.0):
                y, z = a * self.edge_y, b * self.edge_z
                strains = (
                    flexibility[..., 0, i] + z * flexibility[..., 4, i] - y * flexibility[..., 5, i]
                    for i in range(_LOADS)
                )
                points.append((*(self.edge_modulus * strain for strain in strains), *shear))
        return tuple(points)

    def properties(self, material: Any = None) -> CoupledProperties:
        """Return the given values; `material` must be None."""
        refuse_material(material)
        axial, shear_y, shear_z, torsion, bending_y, bending_z = (self.stiffness[i][i] for i in range(_LOADS))
        return CoupledProperties(
            axial=axial,
            shear_y=shear_y,
            shear_z=shear_z,
            torsion=torsion,
            bending_y=bending_y,
            bending_z=bending_z,
            line_density=self.line_density,
            rotary_x=self.rotary_inertia_x,
            rotary_y=self.rotary_inertia_y,
            rotary_z=self.rotary_inertia_z,
            damping=self.damping,
            matrix=self.stiffness,
            offset_y=self.mass_offset_y,
            offset_z=self.mass_offset_z,
            product=self.rotary_inertia_yz,
        )


def _read_matrix(given: Any) -> tuple[tuple[Numbers, ...], ...]:
    """Six rows of six numbers, a symmetric matrix that is positive definite; else raise InputError."""
    where = "`stiffness` of CompositeSection"
    rows = [list(row) if _listed(row) else [] for row in given] if _listed(given) else []
    if [len(row) for row in rows] != [_LOADS] * _LOADS:
        raise InputError(
            f"Argument {where} must be six rows of six numbers, but was {short(given)}; write the forces before the "
            "moments, as [[EA, 0, 0, 0, 0, 0], ...]."
        )
    read = tuple(tuple(_entry(rows[i][j], i, j) for j in range(_LOADS)) for i in range(_LOADS))
    if not is_known(*read):
        return read
    matrix = np.array([[value_of(x) for x in row] for row in read])
    size = np.sqrt(np.outer(matrix.diagonal(), matrix.diagonal()))
    apart = np.abs(matrix - matrix.T) / size
    if apart.max() > _SYMMETRY:
        i, j = (int(k) for k in np.unravel_index(apart.argmax(), apart.shape))
        raise InputError(
            f"Argument {where} must be symmetric, but has {matrix[i, j]:.6g} in row {i + 1} and column {j + 1} and "
            f"{matrix[j, i]:.6g} in row {j + 1} and column {i + 1}; give both alike."
        )
    if np.linalg.eigvalsh(matrix / size)[0] < _SINGULAR:
        raise InputError(
            f"Argument {where} must be positive definite, so that every deformation takes energy, but is not; check "
            "the signs of its couplings and the order of its rows."
        )
    return read


def _entry(value: Any, i: int, j: int) -> Numbers:
    return read_number(value, entry_field(i, j), f"`stiffness` of CompositeSection, row {i + 1}, column {j + 1},")


def entry_field(i: int, j: int) -> tuple[str, str]:
    """Dimension and sign of an entry of the stiffness matrix."""
    dimension = ("axial_stiffness", "moment", "bending_stiffness")[(i > 2) + (j > 2)]
    return dimension, POSITIVE if i == j else ANY


def _listed(value: Any) -> bool:
    return (isinstance(value, Sequence) and not isinstance(value, str)) or bool(np.ndim(value))
