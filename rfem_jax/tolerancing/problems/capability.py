"""Process capability: from Cp and Cpk to mean and standard deviation, and back (theory (10.20)).

Place in the pipeline: **capability** -> `distributions` (`ProcessNormal`).

    Cp = t/(3 sigma),   Cpk = (t - |mean - centre|)/(3 sigma),   mean - centre = +- t (1 - Cpk/Cp)

Symbols: t half-width and centre of the interval between the limits [rad or m], sigma standard deviation.
Source: ISO 22514-2:2017, Statistical methods in process management, part 2 (for a normal distribution).
"""

import jax.core
from jaxtyping import Array, Float

from rfem_jax.description.basics.errors import InputError, require_choice

SIDES = ("upper", "lower")


def mean_shift(cp: Float[Array, ""], cpk: Float[Array, ""], side: str) -> Float[Array, ""]:
    """Distance of the mean to the middle of the interval, in half-widths, to the upper or the lower side.

    Raises: InputError for another side, and a cpk above cp.
    """
    require_choice(side, SIDES, "side")
    if not isinstance(cp, jax.core.Tracer) and not isinstance(cpk, jax.core.Tracer) and cpk > cp:
        raise InputError(
            f"Argument `cpk` must be at most cp, but it is {float(cpk):g} and cp {float(cp):g}; swap them."
        )
    shift = 1.0 - cpk / cp
    return shift if side == "upper" else -shift


def process_capability(mean: float, std: float, interval: tuple[float, float]) -> tuple[float, float]:
    """(Cp, Cpk) of a normal process between limits.

    Args: mean, std > 0 and interval (low, high), all in one unit. Cpk is negative for a mean outside of the limits.
    Raises: InputError for a standard deviation that is not positive, and limits that do not rise.
    """
    low, high = map(float, interval)
    if not std > 0.0:
        raise InputError(f"Argument `std` must be positive, but it is {std!r}; a process scatters.")
    if not low < high:
        raise InputError(f"Argument `interval` must rise from low to high, but it is {interval!r}; swap its ends.")
    return (high - low) / (6.0 * std), min(high - mean, mean - low) / (3.0 * std)
