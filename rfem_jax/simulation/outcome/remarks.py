"""Remarks on runs that are complete and passed their checks, but whose numbers deserve caution.

Place in the pipeline: run -> **remarks** -> tolerancing, report.
"""

from typing import Any

import numpy as np

from rfem_jax.mechanics.elements.linear_validity import REMARKABLE_LINEAR_ERROR
from rfem_jax.mechanics.model.planar_loops import model_reactions_text
from rfem_jax.mechanics.model.status import OK
from rfem_jax.mechanics.statics.equilibrium_stability import Stability

# Of the energy that is exchanged, and of the largest joint load: with a larger error of a balance a run is not
# accepted (loads of a four-bar whose step is too long are off by some 8 % there); from the lower limit on it is
# remarked.
BALANCE_LIMIT, REMARKABLE_BALANCE = 0.03, 0.01


def linear_remark(error: float) -> str:
    """Sentence on the estimated error of linear elements; empty for a small error, and for NaN, which a failed run
    has."""
    if not error > REMARKABLE_LINEAR_ERROR:
        return ""
    return (
        f"linear elements are off by about {100.0 * error:.2g} % in the deflections and moments of a link, which bends "
        'too far or carries too large an axial force for them; take elements = "geometrically_exact".'
    )


def leaving_text(stability: Stability) -> str:
    """Clause on how an unstable equilibrium is left: how fast, and where."""
    growth = float(stability.growth)
    time = f"by a factor of e within {_duration(1.0 / growth)}" if np.isfinite(growth) else "at once"
    return f"a disturbance grows {time}, mostly in {stability.place}"


def _duration(seconds: float) -> str:
    return f"{1e3 * seconds:.3g} ms" if seconds < 0.1 else f"{seconds:.3g} s"


def start_remark(stability: Stability | None) -> str:
    """Sentence on an unstable equilibrium that a run starts from; empty of a stable or a given one."""
    if stability is None or not float(stability.growth) > 0.0:
        return ""
    return (
        f"the static equilibrium at the start is unstable: {leaving_text(stability)}; without one the run may stay "
        "there for a while, which a real mechanism does not: give it a small error or force."
    )


def balance_remark(error: float, what: str) -> str:
    """Sentence on the error of a balance; empty for a small error, and for NaN, which a failed run has."""
    if not error >= REMARKABLE_BALANCE:
        return ""
    return (
        f"{what} are off by {100.0 * error:.2g} %, and joint loads may be by several times that; halve the step until "
        'it is far below 1 %, or take the method "auto".'
    )


def remarks_on(run: Any) -> tuple[str, ...]:
    """Sentences, without the name of the case, on one run."""
    remarks = (
        balance_remark(float(run.checks.energy_balance_error), "the energies"),
        balance_remark(float(run.checks.momentum_balance_error), "joint forces beside the rate of momentum"),
        linear_remark(float(run.checks.linear_error)),
        start_remark(run.checks.start_stability),
        model_reactions_text(run.model) if int(run.status) == OK else "",
    )
    return tuple(filter(None, remarks))
