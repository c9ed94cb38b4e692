"""Rigid bodies of any shape: mass, mass centre and inertia as they are measured or computed elsewhere.

Place in the pipeline: units -> **rigid_bodies** -> links.

Symbols: mass m [kg], centre c [m] in the link frame, inertia J [kg m^2] about the mass centre.
"""

from dataclasses import dataclass
from typing import Any, ClassVar

import jax
import numpy as np
from jaxtyping import Array, Float

from rfem_jax.description.basics.errors import Checks, ChecksItself, InputError
from rfem_jax.description.basics.numbers import (
    ANY,
    POSITIVE,
    Fields,
    NumberTree,
    array_of,
    is_known,
    non_negative_number,
    number_vector,
    rotation_of_angles,
    value_of,
)
from rfem_jax.description.mechanism.section_bases import require_triangle

_SYMMETRY = 1e-9  # relative to the largest entry
Tensor = tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]]


@dataclass(frozen=True)
class RigidBody(NumberTree, ChecksItself):
    """Mass and inertia of a rigid link.

    Args:
        mass: [kg], > 0, or 0 of a body that only carries loads, for positions at rest (then `inertia` is zero, too).
        centre: (x, y, z) [m] of the mass centre in the link frame.
        inertia: about the mass centre [kg m^2], positive definite (zero without mass): three principal moments, or the
            tensor as three rows, in the axes of the link.
        orientation: angles (about x, y, z) [rad] of the axes of `inertia` in the link frame, R = R_z R_y R_x.
    Raises:
        InputError: a value is out of range, or the inertia is that of no body.
    """

    mass: float
    centre: tuple[float, float, float]
    inertia: tuple[float, float, float] | Tensor
    orientation: tuple[float, float, float] = (0.0, 0.0, 0.0)

    # But for the inertia, whose entries have names of their own, and a mass of zero, which no design changes.
    numbers: ClassVar[Fields] = {"mass": ("mass", POSITIVE), "centre": ("length", ANY), "orientation": ("angle", ANY)}

    def _check_fields(self, checks: Checks) -> None:
        checks.convert("mass", non_negative_number, "mass", "`mass` of a body")
        checks.convert("centre", number_vector, "length", "`centre` of a body")
        checks.convert("inertia", _inertia)
        checks.convert("orientation", number_vector, "angle", "`orientation` of a body")
        checks.relation(("mass", "inertia"), self._check_inertia)

    def _check_inertia(self) -> None:
        if not is_known(self.mass, self.inertia):
            return
        tensor, where = _as_tensor(jax.tree.map(value_of, self.inertia)), "`inertia` of a body"
        if np.abs(tensor - tensor.T).max() > _SYMMETRY * np.abs(tensor).max():
            raise InputError(
                f"Argument {where} must be symmetric, but was {tensor.tolist()}; give the products of inertia twice, "
                "with the sign of minus the integral of x y."
            )
        if self.mass == 0.0:
            if np.any(tensor != 0.0):
                raise InputError(
                    f"Argument `mass` of a body must be greater than 0 where it has inertia, but was {self.mass}; give "
                    "a mass, or zeros for both in a mechanism at rest."
                )
            return
        principal = np.linalg.eigvalsh(tensor)
        if principal[0] <= 0.0:
            raise InputError(
                f"Argument {where} must be positive definite, but has the principal moments {principal.tolist()}; "
                "correct the signs, and give a thin rod its small moment about its axis."
            )
        first, second, third = principal.tolist()
        require_triangle((first, second, third), where)

    @property
    def tensor(self) -> Float[np.ndarray, "3 3"] | Float[Array, "3 3"]:
        """J [kg m^2] about the mass centre in the axes of the link."""
        rotation = rotation_of_angles(self.orientation)
        return rotation @ _as_tensor(self.inertia) @ rotation.T


def _as_tensor(inertia: Any) -> Any:
    given = array_of(inertia)
    return given[:, None] * np.eye(3) if given.ndim == 1 else given


def _inertia(inertia: Any) -> Any:
    """Three moments, or three rows of three."""
    where = "`inertia` of a body"
    rows = list(inertia) if isinstance(inertia, (list, tuple)) or np.ndim(inertia) else []
    if len(rows) != 3:
        raise InputError(
            f"Argument {where} must be three principal moments or three rows of a tensor, but was {inertia!r}; write "
            "for example [1e-4, 3e-4, 3e-4]."
        )
    if not any(isinstance(row, (list, tuple)) or np.ndim(row) for row in rows):
        return number_vector(rows, "moment_of_inertia", where)
    return tuple(number_vector(row, "moment_of_inertia", f"{where} (row {n})") for n, row in enumerate(rows, start=1))
