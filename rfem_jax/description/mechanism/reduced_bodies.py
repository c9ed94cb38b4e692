"""Bodies whose mass and stiffness matrices were reduced to interfaces and a few modes by a finite element program.

Place in the pipeline: units -> **reduced_bodies** -> links.

Symbols: n interfaces, m modes, N = 6 n + m rows of the matrices: of every interface three displacements [m] and three
rotations [rad] along and about the axes of the link, then the amplitudes of the modes, which move no interface.
Source: theory (19.1), (19.2); Craig and Bampton, AIAA J. 6 (1968) 1313-1319.
"""

import copy
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import jax
import numpy as np
from jax.tree_util import GetAttrKey
from jaxtyping import Float

from rfem_jax.description.basics.errors import Checks, ChecksItself, InputError, require_entries
from rfem_jax.description.basics.numbers import NOT_NEGATIVE, Fields, read_number
from rfem_jax.description.basics.units import short

_SYMMETRY = 1e-5  # of the largest entry of both rows: files are written with six digits
_MOMENTS = 0.05  # of the largest angular momentum of a row: nodes of beams turn, which is no moment
_RIGID = 1e-4  # of the forces that the interfaces move by, in a motion that deforms nothing
_LEAST = 1e-9  # of an eigenvalue, where the diagonal is 1
_INERTIA = 1e-8  # of the diagonal of the mass, for motions without any: far below what its digits say
SAME_PLACE = 1e-6  # of the largest distance of two interfaces
Matrix = Sequence[Sequence[float]]


@dataclass(frozen=True, eq=False)
class ReducedBody(ChecksItself):
    """A flexible body of any shape, by the reduced matrices of its finite element model.

    Args:
        interfaces: places (n, 3) [m] of the interfaces, in the axes of the link; joints, masses, forces and points lie
            on these. The first one becomes the origin of the link's frame.
        mass, stiffness: (N, N) [kg, kg m, kg m^2; N/m, N, N m], symmetric; rigid motions of the interfaces exert no
            forces.
        damping: eta [s] >= 0: the damping matrix is eta times the stiffness.
        moments: integrals (3, 3, N) over the mass of x_a times displacement b by unit rows, x from the first interface
            [kg m]; None: as the interfaces say.
        stresses: (k, 6, N) [Pa] at k places by unit rows: xx, yy, zz, xy, yz, zx.
        stress_names: of these places.
    Raises:
        InputError: shapes or signs are wrong, a matrix is not symmetric, rigid motions exert forces, some motion has a
            negative inertia, or the moments are not those of the mass matrix.
    """

    interfaces: Float[np.ndarray, "n 3"] | Matrix
    mass: Float[np.ndarray, "N N"] | Matrix
    stiffness: Float[np.ndarray, "N N"] | Matrix
    damping: float = 0.0
    moments: Float[np.ndarray, "3 3 N"] | None = None
    stresses: Float[np.ndarray, "k 6 N"] | None = None
    stress_names: tuple[str, ...] = ()

    numbers: ClassVar[Fields] = {"damping": ("time", NOT_NEGATIVE)}

    def _check_fields(self, checks: Checks) -> None:
        checks.convert("interfaces", _array, (None, 3), "interfaces")
        for name in ("mass", "stiffness"):
            checks.convert(name, _symmetric, name)
        checks.convert("damping", read_number, self.numbers["damping"], "`damping` of a reduced body")
        checks.relation(("interfaces", "mass", "stiffness"), self._check_sizes)
        for name, shape in (("moments", (3, 3, None)), ("stresses", (None, 6, None))):
            if getattr(self, name) is not None:
                checks.convert(name, _array, shape, name)
                checks.relation(("interfaces", "mass", "stiffness", name), self._check_columns, name)
        where, write = "`stress_names` of a reduced body", 'write for example ["fillet", "bore"].'
        checks.convert("stress_names", require_entries, where, str, "texts", write)
        checks.relation(("stresses", "stress_names"), self._check_names)
        if not checks.failed:
            checks.relation(("interfaces", "mass", "stiffness"), self._check_physics)
        if not checks.failed and self.moments is not None:
            checks.relation(("interfaces", "mass", "moments"), self._check_moments)
        if not checks.failed:
            checks.relation(("mass",), self._add_least_inertia)
        if not checks.failed:  # the frame of the link begins in the first interface
            object.__setattr__(self, "interfaces", self.interfaces - np.asarray(self.interfaces)[:1])

    def _check_sizes(self) -> None:
        n, rows = len(self.interfaces), len(self.mass)
        for name in ("mass", "stiffness"):
            size = len(getattr(self, name))
            if size < 6 * n or size != rows:
                raise InputError(
                    f"Argument `{name}` of a reduced body must have six rows for each of its {n} interfaces and one "
                    f"for each mode, as many as `mass`, but has {size} (`mass`: {rows}); leave out rows of other nodes."
                )
        if n == 1:
            raise InputError(
                "Argument `interfaces` of a reduced body must be two or more, but is one; give a free end an "
                "interface, too, and write a rigid body with mass, centre and inertia."
            )
        apart = np.linalg.norm(np.asarray(self.interfaces)[:, None] - np.asarray(self.interfaces)[None], axis=2)
        if apart[~np.eye(n, dtype=bool)].min() <= SAME_PLACE * apart.max():
            raise InputError(
                "Argument `interfaces` of a reduced body must lie apart, but two are at one place; join them in the "
                "finite element model."
            )

    def _check_columns(self, name: str) -> None:
        given = getattr(self, name).shape[2]
        if given != len(self.mass):
            raise InputError(
                f"Argument `{name}` of a reduced body must have a column for each of the {len(self.mass)} rows of its "
                f"matrices, but has {given}; give them for all interfaces and modes."
            )

    def _check_names(self) -> None:
        places = 0 if self.stresses is None else len(self.stresses)
        if self.stress_names and len(self.stress_names) != places:
            raise InputError(
                f"Argument `stress_names` of a reduced body must be one for each of {places} places, but are "
                f"{len(self.stress_names)}; leave them out for numbers."
            )
        if not self.stress_names:
            object.__setattr__(self, "stress_names", tuple(f"place_{k}" for k in range(1, places + 1)))

    def _check_physics(self) -> None:
        """Rigid motions move the whole mass and exert no forces; all other motions do."""
        stiffness, mass, rigid = np.asarray(self.stiffness), np.asarray(self.mass), self.rigid_motions
        held = np.abs(stiffness) @ np.abs(rigid)
        share = np.abs(stiffness @ rigid).max(initial=0.0, axis=0) / np.maximum(held.max(axis=0), 1e-300)
        if share.max() > _RIGID:
            motion = ("T_x", "T_y", "T_z", "R_x", "R_y", "R_z")[int(share.argmax())]
            raise InputError(
                "Argument `stiffness` of a reduced body must exert no forces in rigid motions of its interfaces, but "
                f"{share.max():.2g} of its entries remain in the motion {motion}; check the order of the rows (T_x, "
                "T_y, T_z, R_x, R_y, R_z of every interface, then modes between fixed interfaces), the units and the "
                "places of the interfaces."
            )
        inertia = rigid.T @ mass @ rigid
        total = np.trace(inertia[:3, :3]) / 3.0
        if not total > 0.0 or np.abs(inertia[:3, :3] - total * np.eye(3)).max() > _RIGID * total:
            raise InputError(
                "Argument `mass` of a reduced body must be one mass in all directions of a rigid motion, but is "
                f"{short(np.diag(inertia)[:3].tolist())} kg along x, y and z; check the order of its rows and units."
            )
        for name, matrix, free in (("mass", mass, 0), ("stiffness", stiffness, 6)):
            if not (np.diag(matrix) > 0.0).all():
                raise InputError(
                    f"Argument `{name}` of a reduced body must have a diagonal greater than 0, but has "
                    f"{np.diag(matrix).min():.3g} on it; check its sign, and leave out rows without any."
                )
            scale = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
            values = np.linalg.eigvalsh(matrix / scale[:, None] / scale[None])
            if values[0] < -_SYMMETRY or (free and values[free] <= _LEAST):
                raise InputError(
                    f"Argument `{name}` of a reduced body must be that of a body, but has an eigenvalue of "
                    f"{values[0] if values[0] < -_SYMMETRY else values[free]:.2g} where its diagonal is 1"
                    f"{', beside its six rigid motions' if free else ''}; give all rows with all their digits."
                )

    def _add_least_inertia(self) -> None:
        """Masses lumped at nodes leave motions without any inertia, or with a negative one in the last digits."""
        mass = np.asarray(self.mass)
        scale = np.sqrt(np.diag(mass))
        least = np.linalg.eigvalsh(mass / scale[:, None] / scale[None])[0]
        if least < _LEAST:
            object.__setattr__(self, "mass", mass + (_INERTIA - min(least, 0.0)) * np.diag(np.diag(mass)))

    def _check_moments(self) -> None:
        """What the matrices know of the moments: those of the momentum about the first interface."""
        mass, rigid, moments = np.asarray(self.mass), self.rigid_motions, np.asarray(self.moments)
        turned = rigid[:, 3:].T @ mass
        told = np.stack([moments[(k + 1) % 3, (k + 2) % 3] - moments[(k + 2) % 3, (k + 1) % 3] for k in range(3)])
        size = np.sqrt(np.trace(rigid[:, 3:].T @ mass @ rigid[:, 3:]) * np.diag(mass))
        apart = (np.abs(told - turned) / size).max()
        if apart > _MOMENTS:
            raise InputError(
                "Argument `moments` of a reduced body must give the angular momentum about the first interface that "
                f"its mass matrix has, but is {apart:.2g} of the largest apart; take x from the first interface, the "
                "first axis for x and the second for the displacement, and the units of the matrices; or leave it out."
            )

    @property
    def rigid_motions(self) -> Float[np.ndarray, "N 6"]:
        """Rows of the matrices by displacements of the first interface and rotations about it (theory (19.2))."""
        places = np.asarray(self.interfaces)
        motions = np.zeros((len(self.mass), 6))
        for i, (x, y, z) in enumerate(places - places[:1]):
            motions[6 * i : 6 * i + 6] = np.eye(6)
            motions[6 * i : 6 * i + 3, 3:] = [[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]]
        return motions

    @property
    def total_mass(self) -> float:
        """Mass [kg]."""
        return float(np.asarray(self.mass).dot(self.rigid_motions[:, 0]).dot(self.rigid_motions[:, 0]))

    @property
    def mass_centre(self) -> Float[np.ndarray, "3"]:
        """Its mass centre [m]."""
        tensor = self.rigid_motions.T @ np.asarray(self.mass) @ self.rigid_motions
        return np.array([tensor[5, 1], tensor[3, 2], tensor[4, 0]]) / self.total_mass

    @property
    def nodes(self) -> int:
        """Number of nodes of six coordinates that hold those of its interfaces and its modes."""
        return len(self.interfaces) - (-self.modes // 6)

    @property
    def modes(self) -> int:
        """Number of its modes m."""
        return len(self.mass) - 6 * len(self.interfaces)

    def _content(self) -> tuple[Any, ...]:
        arrays = (np.asarray(one) for one in (self.interfaces, self.mass, self.stiffness))
        more = (None if one is None else one.tobytes() for one in (self.moments, self.stresses))
        return (*(one.tobytes() for one in arrays), *more, self.stress_names)

    def with_fields(self, **values: Any) -> "ReducedBody":
        """A copy with other values in some fields; nothing is checked."""
        other = copy.copy(self)
        for name, value in values.items():
            object.__setattr__(other, name, value)
        return other

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, ReducedBody):
            return NotImplemented
        return self._content() == other._content() and bool(self.damping == other.damping)

    def __hash__(self) -> int:
        return hash(self._content())

    def __repr__(self) -> str:
        return f"ReducedBody({len(self.interfaces)} interfaces, {self.modes} modes, {self.total_mass:.4g} kg)"


# As the other things of a description, a pytree whose leaves are its numbers; its matrices do not change.
jax.tree_util.register_pytree_with_keys(
    ReducedBody,
    lambda body: (((GetAttrKey("damping"), body.damping),), body.with_fields(damping=0.0)),
    lambda body, numbers: body.with_fields(damping=next(iter(numbers))),
)


def _array(given: Any, shape: tuple[int | None, ...], name: str) -> Any:
    """Return an array of floats with this shape, None for any length; else raise InputError."""
    words = " x ".join("n" if size is None else str(size) for size in shape)
    try:
        found = None if np.iscomplexobj(given) else np.array(given, dtype=float)
    except (TypeError, ValueError):
        found = None
    if found is None or found.ndim != len(shape) or any(a not in (None, b) for a, b in zip(shape, found.shape)):
        raise InputError(
            f"Argument `{name}` of a reduced body must be {words} numbers, but was {short(given)}; give all of them."
        )
    if not found.size or not np.isfinite(found).all():
        raise InputError(f"Argument `{name}` of a reduced body must be finite numbers, but has others; correct them.")
    return found


def _symmetric(given: Any, name: str) -> Any:
    matrix = _array(given, (None, None), name)
    if matrix.shape[0] != matrix.shape[1]:
        raise InputError(f"Argument `{name}` of a reduced body must be square, but is {matrix.shape}; give all rows.")
    size = np.sqrt(np.abs(np.diag(matrix)))
    apart = np.abs(matrix - matrix.T)
    if (apart > _SYMMETRY * np.maximum(size[:, None] * size[None], 1e-300)).any():
        raise InputError(
            f"Argument `{name}` of a reduced body must be symmetric, but entries differ by {apart.max():.3g}; "
            "give both halves."
        )
    return 0.5 * (matrix + matrix.T)
