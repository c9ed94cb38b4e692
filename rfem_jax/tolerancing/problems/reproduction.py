"""Whether derivatives can be trusted where pins strike their bushes: a finer step must reproduce them.

Place in the pipeline: before searches that derivatives guide (worst cases, allocation, designs), and beside them
(sensitivities).  Through an impact a derivative is exact, but each one multiplies it, and after a few the motion is
chaotic: derivatives grow without bound, and no step has the same.  Statistics of values are what counts then.
Source: theory (15.16).

Symbols: k errors, m metrics; x (k,) errors, t (k,) half-widths of the tolerances [rad, m, or units of parameters].
"""

from typing import TypeGuard

import numpy as np
from jaxtyping import Float

from rfem_jax.description.errors import InputError
from rfem_jax.tolerancing.problems.evaluation import Base
from rfem_jax.tolerancing.problems.linearisation import linearise_points
from rfem_jax.tolerancing.problems.problem import StrikingProblem, ToleranceProblem

REPRODUCED = 0.1  # change of a derivative, times its tolerance, over a metric's largest effect
ASIDE = 0.5  # tolerances between the centre and the point that is looked at: at the centre gradients may vanish


def may_strike(problem: ToleranceProblem) -> TypeGuard[StrikingProblem]:
    """Whether the problem has pins that may strike their bushes."""
    return bool(getattr(problem, "strikes", False))


def require_reproduced(
    problem: ToleranceProblem,
    names: tuple[str, ...],
    base: Base,
    x: Float[np.ndarray, " k"],
    t: Float[np.ndarray, " k"],
    *,
    mode: str,
    batch: int,
) -> None:
    """Refuse derivatives through impacts that a finer step does not reproduce; nothing is run where no pin may strike.

    Args: names (k), base, mode and batch as of `linearise_points`, whose program is used; x, the centre; t,
        half-widths.
    Raises: InputError if an effect changes by more than a tenth of the metric's largest one half a tolerance away from
        the centre.
    """
    if not may_strike(problem):
        return
    point = (np.asarray(x) + ASIDE * np.asarray(t))[None]
    effects = []
    for one in (problem, problem.refined()):
        _, (jacobian,), (status,) = linearise_points(one, names, base, point, mode=mode, batch=batch)
        if int(status) != 0:
            return  # such samples are counted where they are used
        effects.append(jacobian * t)
    coarse, fine = effects
    largest = np.maximum(np.abs(coarse).max(axis=1, keepdims=True), 1e-300)
    change = np.nan_to_num(np.abs(fine - coarse) / largest)  # a kink has no derivative
    if (change <= REPRODUCED).all():
        return
    m, k = np.unravel_index(np.argmax(change), change.shape)
    raise InputError(
        f"Argument `problem` must have derivatives that guide a search, but with a finer step that of "
        f"{problem.metrics[m].name} by {names[k]} changes by {100.0 * change[m, k]:.3g} % of the largest effect: pins "
        "strike their bushes, and after a few impacts the motion is chaotic. Take statistics of a batch (monte-carlo) "
        "or a sweep, a shorter time, or loads at rest."
    )
