"""Numbers with units: every number of the user passes through here and leaves in SI.

Place in the pipeline: used by all of `description`, and wherever a number or a string with a unit
("0.5 deg", "0.5 mm", "210 GPa", "1.5 N m", "7.85 g/cm^3") enters; imports only `errors`.

A dimension is the tuple of exponents of (kg, m, s, rad, K); the angle counts as a base quantity, so
that a rate in "Hz" or a length in "deg" is refused. SI units, angles in radians.
"""

import math
import numbers
import re
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from rfem_jax.description.basics.errors import InputError, subject, suggestion

# What a user may write for a number. At run time anything may come, and is refused in a sentence (not by a check of
# types) where it is no number.
if TYPE_CHECKING:
    from jax.typing import ArrayLike

    Quantity = ArrayLike | str
    Quantities = list[Quantity] | tuple[Quantity, ...] | np.ndarray
else:
    Quantity = Quantities = Any

DERIVED: Any = None  # default of a field that `__post_init__` makes of the others: None is never seen

HIGHEST_POWER = 20  # of a unit
# Magnitudes that no mechanism has, and from which products leave double precision.
LARGEST, SMALLEST = 1e15, 1e-15
RANGES = {  # of other dimensions: smallest (where a value must be positive) and largest magnitude
    "none": (1e-50, 1e50),
    "length": (1e-12, 1e9),
    "time": (1e-30, 1e12),
    "area": (1e-24, 1e18),
    "second_moment": (1e-48, 1e36),
    "section_modulus": (1e-36, 1e27),
    "pressure": (1e-6, 1e20),
    "axial_stiffness": (1e-20, 1e30),
    "bending_stiffness": (1e-30, 1e30),
    "line_density": (1e-18, 1e15),
    "rotary_inertia": (1e-40, 1e20),
    "moment_of_inertia": (1e-40, 1e25),
    "hertz_stiffness": (1e-20, 1e25),
}

# name: (exponents of kg, m, s, rad, K; SI unit; an example of a string with a unit)
DIMENSIONS = {
    "none": ((0, 0, 0, 0, 0), "1", "5 %"),
    "length": ((0, 1, 0, 0, 0), "m", "0.5 mm"),
    "angle": ((0, 0, 0, 1, 0), "rad", "0.5 deg"),
    "mass": ((1, 0, 0, 0, 0), "kg", "20 g"),
    "temperature": ((0, 0, 0, 0, 1), "K", "40 K"),
    "temperature_gradient": ((0, -1, 0, 0, 1), "K/m", "0.5 K/mm"),
    "thermal_expansion": ((0, 0, 0, 0, -1), "1/K", "12e-6 1/K"),
    "time": ((0, 0, 1, 0, 0), "s", "10 ms"),
    "area": ((0, 2, 0, 0, 0), "m^2", "100 mm^2"),
    "second_moment": ((0, 4, 0, 0, 0), "m^4", "833 mm^4"),
    "section_modulus": ((0, 3, 0, 0, 0), "m^3", "208 mm^3"),
    "density": ((1, -3, 0, 0, 0), "kg/m^3", "7.85 g/cm^3"),
    "pressure": ((1, -1, -2, 0, 0), "Pa", "210 GPa"),
    "force": ((1, 1, -2, 0, 0), "N", "12 kN"),
    "moment": ((1, 2, -2, 0, 0), "N m", "1.5 N m"),
    "rate": ((0, 0, -1, 1, 0), "rad/s", "60 rpm"),
    "speed": ((0, 1, -1, 0, 0), "m/s", "0.2 m/s"),
    "acceleration": ((0, 1, -2, 0, 0), "m/s^2", "9.81 m/s^2"),
    "angular_acceleration": ((0, 0, -2, 1, 0), "rad/s^2", "100 rad/s^2"),
    "axial_stiffness": ((1, 1, -2, 0, 0), "N", "21 MN"),
    "bending_stiffness": ((1, 3, -2, 0, 0), "N m^2", "175 N m^2"),
    "line_density": ((1, -1, 0, 0, 0), "kg/m", "0.785 kg/m"),
    "rotary_inertia": ((1, 1, 0, 0, 0), "kg m", "6.5e-6 kg m"),
    "moment_of_inertia": ((1, 2, 0, 0, 0), "kg m^2", "2 kg mm^2"),
    "stiffness": ((1, 0, -2, 0, 0), "N/m", "12 N/mm"),
    "line_load": ((1, 0, -2, 0, 0), "N/m", "2 kN/m"),
    "rotational_stiffness": ((1, 2, -2, -1, 0), "N m/rad", "3 N m/deg"),
    "hertz_stiffness": ((1, -0.5, -2, 0, 0), "N/m^1.5", "60 kN/mm^1.5"),
    "damping": ((1, 0, -1, 0, 0), "N s/m", "5 N s/m"),
    "rotational_damping": ((1, 2, -1, -1, 0), "N m s/rad", "0.1 N m s/rad"),
    "contact_damping": ((0, -1, 1, 0, 0), "s/m", "0.2 s/m"),
    "rotational_contact_damping": ((0, 0, 1, -1, 0), "s/rad", "0.2 s/rad"),
    "length_per_angle": ((0, 1, 0, -1, 0), "m/rad", "5 mm/rev"),
    "angle_per_length": ((0, -1, 0, 1, 0), "rad/m", "36 deg/mm"),
}

_KG, _M, _S, _RAD, _K = (1, 0, 0, 0, 0), (0, 1, 0, 0, 0), (0, 0, 1, 0, 0), (0, 0, 0, 1, 0), (0, 0, 0, 0, 1)
_N, _PA, _NM = (1, 1, -2, 0, 0), (1, -1, -2, 0, 0), (1, 2, -2, 0, 0)
UNITS = {
    "m": (1.0, _M), "km": (1e3, _M), "dm": (1e-1, _M), "cm": (1e-2, _M), "mm": (1e-3, _M),
    "um": (1e-6, _M), "in": (0.0254, _M), "ft": (0.3048, _M),
    "rad": (1.0, _RAD), "mrad": (1e-3, _RAD), "deg": (math.pi / 180, _RAD),
    "arcmin": (math.pi / 10800, _RAD), "arcsec": (math.pi / 648000, _RAD),
    "rev": (2 * math.pi, _RAD),
    "kg": (1.0, _KG), "g": (1e-3, _KG), "mg": (1e-6, _KG), "t": (1e3, _KG), "lb": (0.45359237, _KG),
    "s": (1.0, _S), "ms": (1e-3, _S), "us": (1e-6, _S), "min": (60.0, _S), "h": (3600.0, _S),
    "N": (1.0, _N), "mN": (1e-3, _N), "kN": (1e3, _N), "MN": (1e6, _N),
    "Pa": (1.0, _PA), "kPa": (1e3, _PA), "MPa": (1e6, _PA), "GPa": (1e9, _PA), "bar": (1e5, _PA),
    "psi": (6894.757293168361, _PA),
    "Nm": (1.0, _NM), "kNm": (1e3, _NM), "Nmm": (1e-3, _NM),
    "rpm": (math.pi / 30, (0, 0, -1, 1, 0)), "Hz": (1.0, (0, 0, -1, 0, 0)),
    "K": (1.0, _K),
    "%": (1e-2, (0, 0, 0, 0, 0)), "1": (1.0, (0, 0, 0, 0, 0)),
}  # fmt: skip

_NUMBER = re.compile(r"\s*([+-]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][+-]?\d+)?)\s*(.*?)\s*$", re.DOTALL)
_ASCII = str.maketrans(  # as pasted from documents: degree sign, micro, middle dot, powers
    {"\u00b0": " deg", "\u00b5": "u", "\u03bc": "u", "\u00b7": " ", "\u00b2": "^2", "\u00b3": "^3"}
)
_UNIT = re.compile(r"([A-Za-z]+|%|1)(?:(?:\^|\*\*)([+-]?\d+(?:\.\d+)?))?$")


def quantity(value: Quantity, dimension: str, where: str) -> float:
    """Return `value` as a finite float in SI units.

    Args:
        value: an int or float (SI, radians), or a string with a unit ("0.5 deg").
        dimension: a key of DIMENSIONS, such as "length".
        where: the argument's name for the message (see `errors.subject`).
    Raises:
        InputError: not a number, not finite, an unknown unit, or a unit of another dimension.
    """
    _, si_unit, example = DIMENSIONS[dimension]
    if isinstance(value, str):
        number = _parse(value, dimension, where)
    elif _is_number(value):
        number = _as_float(value, where)
    else:
        raise InputError(
            f"{subject(where)} must be a number, but was {value!r}; "
            f'give a number in {si_unit} or a string with a unit such as "{example}".'
        )
    if not math.isfinite(number):
        raise InputError(f"{subject(where)} must be finite, but was {value}; give a finite number.")
    largest = RANGES.get(dimension, (SMALLEST, LARGEST))[1]
    if abs(number) > largest:
        raise InputError(
            f"{subject(where)} must not be larger than {_in_unit(largest, si_unit)}, but was {short(value)}; "
            "check the number and its unit."
        )
    return number


def positive_quantity(value: Quantity, dimension: str, where: str) -> float:
    """Like `quantity`, and greater than zero."""
    number = quantity(value, dimension, where)
    if number <= 0.0:
        raise InputError(f"{subject(where)} must be greater than 0, but was {value}; give a positive value.")
    smallest = RANGES.get(dimension, (SMALLEST, LARGEST))[0]
    if number < smallest:
        raise InputError(
            f"{subject(where)} must not be smaller than {_in_unit(smallest, DIMENSIONS[dimension][1])}, but was "
            f"{value}; check the number and its unit."
        )
    return number


def non_negative_quantity(value: Quantity, dimension: str, where: str) -> float:
    """Like `quantity`, and not less than zero."""
    number = quantity(value, dimension, where)
    if number < 0.0:
        raise InputError(f"{subject(where)} must not be negative, but was {value}; give 0 or a positive value.")
    return number


def vector(
    value: Quantities, dimension: str, where: str, read: Callable[[Any, str, str], float] = quantity
) -> tuple[float, float, float]:
    """Return three quantities, along (or about) x, y and z, as a tuple of floats in SI units, or of what `read` makes
    of each."""
    components = sequence(value, dimension, where, read)
    if len(components) != 3:
        raise InputError(
            f"{subject(where)} must have three components (x, y, z), but has {len(components)}; write it as [x, y, z]."
        )
    x, y, z = components
    return x, y, z


def sequence(
    value: Quantities, dimension: str, where: str, read: Callable[[Any, str, str], float] = quantity
) -> tuple[float, ...]:
    """Return a list of quantities of one dimension as a tuple of floats in SI units, or of what `read` makes of
    each."""
    if not isinstance(value, (list, tuple)) and not getattr(value, "ndim", 0):
        raise InputError(f"{subject(where)} must be a list of numbers, but was {value!r}; write it in square brackets.")
    name = where if "`" in where else f"`{where}`"
    return tuple(read(entry, dimension, f"{name} (entry {index})") for index, entry in enumerate(value, start=1))


def _in_unit(number: float, unit: str) -> str:
    """A number with its SI unit, which is "1" for one without a dimension."""
    return f"{number:g}" if unit == "1" else f"{number:g} {unit}"


def short(value: object) -> str:
    """A value as text, without the middle of hundreds of digits."""
    text = str(value)
    return text if len(text) <= 40 else f"{text[:20]}... ({len(text)} characters)"


def _is_number(value: object) -> bool:
    if isinstance(value, (bool, np.bool_)):
        return False
    if isinstance(value, numbers.Real):
        return True
    return getattr(value, "shape", None) == () and getattr(value, "dtype", None) != np.dtype(bool)


def _as_float(value: Any, where: str) -> float:
    try:
        return float(value)
    except OverflowError:
        raise InputError(
            f"{subject(where)} must be a number that fits into double precision, but was {short(value)}; check it."
        ) from None
    except TypeError:  # a traced value, a complex array
        raise InputError(
            f"{subject(where)} must be a number known before compilation, but was {value!r}; "
            "give it outside `jit`: traced may be assembly errors, and the numbers of a mechanism that "
            "`rfem_jax.parameters` names."
        ) from None


def _parse(text: str, dimension: str, where: str) -> float:
    wanted, si_unit, example = DIMENSIONS[dimension]
    match = _NUMBER.match(text.translate(_ASCII))
    if match is None:
        raise InputError(
            f"{subject(where)} must start with a number, but was {text!r}; "
            f'give a number in {si_unit} or a string with a unit such as "{example}".'
        )
    if not match.group(2):
        raise InputError(
            f"{subject(where)} must have a unit where it is in quotes, but was {text!r}; "
            f'write {match.group(1)} without quotes ({si_unit}) or with a unit, as in "{example}".'
        )
    factor, exponents = _unit(match.group(2), text, where, dimension)
    if exponents != wanted:
        raise InputError(
            f"{subject(where)} must be {_phrase(dimension)} ({si_unit}), but was {text!r}, "
            f"which is {_name(exponents)}; give a number in {si_unit} or a string such as "
            f'"{example}".'
        )
    # Powers of ten below one are divided by: 0.5 / 1000 is the float 5e-4, 0.5 * 1e-3 need not be.
    inverse = 1.0 / factor
    number = float(match.group(1))
    if factor < 1.0 and abs(inverse - round(inverse)) <= 1e-9 * inverse:
        return number / round(inverse)
    return number * factor


def _unit(unit: str, text: str, where: str, dimension: str) -> tuple[float, tuple[int | float, ...]]:
    """Return (factor to SI, exponents) of a product of units such as "kg/m^3" or "N m^2"."""
    wanted, _, example = DIMENSIONS[dimension]
    exponents: tuple[int | float, ...]
    factor, exponents = 1.0, (0, 0, 0, 0, 0)
    for position, part in enumerate(unit.replace("**", "^").split("/")):
        factors = re.split(r"[\s*]+", part.strip())
        for symbol in factors:
            match = _UNIT.match(symbol)
            if match is None or match.group(1) not in UNITS or abs(float(match.group(2) or 1)) > HIGHEST_POWER:
                same = [name for name, (_, exponents) in UNITS.items() if exponents == wanted]
                raise InputError(
                    f"{subject(where)} must have a known unit, but `{symbol or unit}` in {text!r} "
                    f'is not a known unit; write it as in "{example}"; {suggestion(symbol, same or UNITS)}'
                )
            power = float(match.group(2) or 1) * (1 if position == 0 else -1)
            power = int(power) if power.is_integer() else power  # powers of floats round differently
            scale, base = UNITS[match.group(1)]
            factor *= scale**power
            exponents = tuple(e + power * b for e, b in zip(exponents, base))
    return factor, exponents


def _phrase(dimension: str) -> str:
    if dimension == "none":
        return "a plain number"
    name = dimension.replace("_", " ")
    return f"{'an' if name[0] in 'aeiou' else 'a'} {name}"


def _name(exponents: tuple[int | float, ...]) -> str:
    for dimension, (known, _, _) in DIMENSIONS.items():
        if known == exponents:
            return _phrase(dimension)
    return "something else"
