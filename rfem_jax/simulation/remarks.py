"""Remarks on runs that are complete and passed their checks, but whose numbers deserve caution.

Place in the pipeline: run -> **remarks** -> tolerancing, report.
"""

from typing import Any

from rfem_jax.mechanics.elements.linear_validity import REMARKABLE_LINEAR_ERROR


def linear_remark(error: float) -> str:
    """What an estimated error of linear elements means, "" where it is small; NaN of a failed run is."""
    if not error > REMARKABLE_LINEAR_ERROR:
        return ""
    return (
        f"linear elements are off by about {100.0 * error:.2g} % in the deflections and moments of a link, which bends "
        'too far or carries too large an axial force for them; take elements = "geometrically_exact".'
    )


def remarks_on(run: Any) -> tuple[str, ...]:
    """Sentences, without the name of the case, on one run."""
    return tuple(filter(None, (linear_remark(float(run.linear_error)),)))
