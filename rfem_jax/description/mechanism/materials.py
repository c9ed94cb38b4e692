"""Material: linear elastic and isotropic, with stiffness-proportional damping.

Place in the pipeline: a section combines with a material to stiffnesses per length (`sections`).

Symbols: youngs_modulus E [Pa]; shear_modulus G [Pa]; poisson_ratio nu [1], G = E / (2 (1 + nu));
density rho [kg/m^3]; damping eta [s] (Kelvin-Voigt: damping matrix = eta * stiffness matrix); thermal_expansion alpha
[1/K]. Source: theory (1.1), (1.7), (2.21).
"""

from dataclasses import dataclass
from typing import ClassVar

from rfem_jax.description.basics.errors import Checks, ChecksItself, InputError, require_name
from rfem_jax.description.basics.numbers import (
    ANY,
    NOT_NEGATIVE,
    POSITIVE,
    Fields,
    Number,
    NumberTree,
    is_known,
    number,
    read_number,
)
from rfem_jax.description.basics.units import Quantity


@dataclass(frozen=True)
class Material(NumberTree, ChecksItself):
    """A linear elastic, isotropic material; numbers in SI or strings with a unit.

    Args:
        name: a word.
        youngs_modulus: E [Pa], > 0.
        density: rho [kg/m^3], > 0.
        poisson_ratio: nu, -1 < nu <= 0.5; give either this or `shear_modulus`.
        shear_modulus: G [Pa], > 0.
        damping: eta [s], >= 0.
        thermal_expansion: alpha [1/K], by which links of another temperature than at assembly change their lengths.
    Raises:
        InputError: a value is out of range, or not exactly one of nu and G is given.
    """

    name: str
    youngs_modulus: float
    density: float
    poisson_ratio: float | None = None
    shear_modulus: float | None = None
    damping: float = 0.0
    thermal_expansion: Quantity | None = None

    numbers: ClassVar[Fields] = {
        "youngs_modulus": ("pressure", POSITIVE),
        "density": ("density", POSITIVE),
        "poisson_ratio": ("none", ANY),
        "shear_modulus": ("pressure", POSITIVE),
        "damping": ("time", NOT_NEGATIVE),
        "thermal_expansion": ("thermal_expansion", ANY),
    }

    def _check_fields(self, checks: Checks) -> None:
        checks.convert("name", require_name, "`name` of a material")
        where = f"of material `{self.name}`"
        if (self.poisson_ratio is None) == (self.shear_modulus is None):
            given = "both are" if self.shear_modulus is not None else "neither is"
            checks.found.append(
                f"Argument `poisson_ratio` {where} must be given or else `shear_modulus`, "
                f"but {given}; give exactly one of the two."
            )
        for name in ("youngs_modulus", "density", "damping", "shear_modulus", "thermal_expansion"):
            if name not in ("shear_modulus", "thermal_expansion") or getattr(self, name) is not None:
                checks.convert(name, read_number, self.numbers[name], f"`{name}` {where}")
        if self.poisson_ratio is not None:
            checks.convert("poisson_ratio", _poisson_ratio, f"`poisson_ratio` {where}")

    @property
    def modulus_of_rigidity(self) -> Number:
        """G [Pa], as given or from E and nu."""
        if self.shear_modulus is not None:
            return self.shear_modulus
        ratio = 0.0 if self.poisson_ratio is None else self.poisson_ratio
        return self.youngs_modulus / (2.0 * (1.0 + ratio))


def _poisson_ratio(value: Quantity, where: str) -> float:
    ratio = number(value, "none", where)
    if is_known(ratio) and not -1.0 < ratio <= 0.5:
        raise InputError(f"Argument {where} must be above -1 and at most 0.5, but was {ratio}; metals have about 0.3.")
    return ratio
