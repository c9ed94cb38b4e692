"""Material: linear elastic and isotropic, with stiffness-proportional damping.

Place in the pipeline: a section combines with a material to stiffnesses per length (`sections`).

Symbols: youngs_modulus E [Pa]; shear_modulus G [Pa]; poisson_ratio nu [1], G = E / (2 (1 + nu));
density rho [kg/m^3]; damping eta [s] (Kelvin-Voigt: damping matrix = eta * stiffness matrix).
Source: theory (1.1), (1.7).
"""

from collections.abc import Callable
from dataclasses import dataclass

from rfem_jax.description.errors import ChecksItself, InputError, require_name
from rfem_jax.description.units import non_negative_quantity, positive_quantity, quantity


@dataclass(frozen=True)
class Material(ChecksItself):
    """A linear elastic, isotropic material; numbers in SI or strings with a unit.

    Args:
        name: a word.
        youngs_modulus: E [Pa], > 0.
        density: rho [kg/m^3], > 0.
        poisson_ratio: nu, -1 < nu <= 0.5; give either this or `shear_modulus`.
        shear_modulus: G [Pa], > 0.
        damping: eta [s], >= 0.
    Raises:
        InputError: a value is out of range, or not exactly one of nu and G is given.
    """

    name: str
    youngs_modulus: float
    density: float
    poisson_ratio: float | None = None
    shear_modulus: float | None = None
    damping: float = 0.0

    def __post_init__(self):
        require_name(self.name, "`name` of a material")
        where = f"of material `{self.name}`"
        if (self.poisson_ratio is None) == (self.shear_modulus is None):
            given = "both are" if self.shear_modulus is not None else "neither is"
            raise InputError(
                f"Argument `poisson_ratio` {where} must be given or else `shear_modulus`, "
                f"but {given}; give exactly one of the two."
            )
        self._set("youngs_modulus", positive_quantity, "pressure", where)
        self._set("density", positive_quantity, "density", where)
        self._set("damping", non_negative_quantity, "time", where)
        if self.shear_modulus is not None:
            self._set("shear_modulus", positive_quantity, "pressure", where)
        else:
            ratio = self._set("poisson_ratio", quantity, "none", where)
            if not -1.0 < ratio <= 0.5:
                raise InputError(
                    f"Argument `poisson_ratio` {where} must be above -1 and at most 0.5, but was "
                    f"{ratio}; metals have about 0.3."
                )

    def _set(self, field: str, convert: Callable[[float, str, str], float], dimension: str, where: str) -> float:
        value = convert(getattr(self, field), dimension, f"`{field}` {where}")
        object.__setattr__(self, field, value)
        return value

    @property
    def modulus_of_rigidity(self) -> float:
        """G [Pa], as given or from E and nu."""
        if self.shear_modulus is not None:
            return self.shear_modulus
        ratio = 0.0 if self.poisson_ratio is None else self.poisson_ratio
        return self.youngs_modulus / (2.0 * (1.0 + ratio))
