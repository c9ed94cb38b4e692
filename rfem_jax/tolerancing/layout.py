"""How the results of the tolerance studies write numbers.

Place in the pipeline: used where a result of this package prints itself, and by the reports on them; no symbols.
"""

from typing import SupportsFloat

from rfem_jax.description.tolerances.error_catalogue import as_specified

NEGLIGIBLE = 1e-12  # of the scale: rounding, shown as 0


def without_rounding(value: SupportsFloat, scale: SupportsFloat) -> float:
    """0 for a number that is only rounding of numbers of size `scale`, else the number."""
    value = float(value)
    return 0.0 if abs(value) <= NEGLIGIBLE * abs(float(scale)) else value


def show_error(value: SupportsFloat, unit: str, digits: int = 5) -> str:
    """An error or a tolerance of the SI unit "rad" or "m" for a table, in deg or mm."""
    specified, factor = as_specified(unit)
    return f"{show_number(factor * float(value), digits)} {specified}"


def show_number(value: SupportsFloat, digits: int = 5, scale: SupportsFloat = 0.0) -> str:
    """A number for a table; "-" where it does not exist, 0 where it is rounding of `scale`."""
    value = without_rounding(value, scale)
    return "-" if value != value else f"{value:.{digits}g}"
