"""Units of reduced matrices in files: finite element models have lengths in mm and masses in t as often as SI units.

Place in the pipeline: units -> **file_units** -> body_files.

Symbols: units of length l [m], of mass m [kg] and of time t [s]; s of a row: l of a displacement and of the amplitude
of a mode, 1 of a rotation.  Energies are m l^2 / t^2, so that entries of a mass matrix are m l^2 / (s_i s_j).
"""

from typing import Any

import numpy as np
from jaxtyping import Float

from rfem_jax.description.basics.errors import InputError, subject
from rfem_jax.description.basics.units import positive_quantity

SI_UNITS = ("m", "kg", "s")
_DIMENSIONS = ("length", "mass", "time")


def read_units(units: Any, where: str = "units") -> tuple[float, float, float]:
    """Units of length [m], mass [kg] and time [s]; else raise InputError.

    Args: units, three texts, each a unit or a quantity, as ["mm", "t", "s"] and ["in", "175.1 kg", "s"].
    """
    if not isinstance(units, (list, tuple)) or len(units) != 3 or any(not isinstance(one, str) for one in units):
        raise InputError(
            f"{subject(where)} must be the units of length, mass and time of the file, but was {units!r}; write for "
            'example ["mm", "t", "s"], whose unit of force is N.'
        )
    found = [
        positive_quantity(one if one[:1].isdigit() else f"1 {one}", dimension, where)
        for one, dimension in zip(units, _DIMENSIONS, strict=True)
    ]
    return found[0], found[1], found[2]


def in_si(content: dict[str, Any], units: tuple[float, float, float]) -> dict[str, Any]:
    """The arguments of a ReducedBody in SI units, of arrays in those of a file."""
    length, mass, time = units
    if units == (1.0, 1.0, 1.0):
        return content
    size, frames = len(content["mass"]), len(content["interfaces"])
    row = np.full(size, length)
    row[: 6 * frames] = np.tile([length] * 3 + [1.0] * 3, frames)[:size]
    each: Float[np.ndarray, "N N"] = 1.0 / row[:, None] / row[None]
    factors = {
        "interfaces": length,
        "mass": mass * length**2 * each,
        "stiffness": mass * length**2 / time**2 * each,
        "damping": time,
        "moments": mass * length**2 / row,
        "stresses": mass / length / time**2 / row,
    }
    return content | {name: factors[name] * content[name] for name in factors if content.get(name) is not None}
