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
LEAST = 1e-6  # largest effect over the value of a metric, below which errors have none
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
    both = problem, problem.refined()
    found = [linearise_points(one, names, base, point, mode=mode, batch=batch) for one in both]
    if any(status[0] != 0 for _, _, status in found):
        return  # such samples are counted where they are used
    (values, coarse, _), (_, fine, _) = found
    change = changes_of_effects(t * (fine - coarse)[0], t * coarse[0], values[0])
    if (change <= REPRODUCED).all():
        return
    m, k = np.unravel_index(np.argmax(change), change.shape)
    raise InputError(
        f"Argument `problem` must have derivatives that guide a search, but with a finer step that of "
        f"{problem.metrics[m].name} by {names[k]} changes by {100.0 * change[m, k]:.3g} % of the largest effect: pins "
        "strike their bushes, and after a few impacts the motion is chaotic. Take statistics of a batch (monte-carlo) "
        "or a sweep, a shorter time, or loads at rest."
    )


def changes_of_effects(
    changes: Float[np.ndarray, "m k"], effects: Float[np.ndarray, "m k"], values: Float[np.ndarray, " m"]
) -> Float[np.ndarray, "m k"]:
    """Changes of derivatives, times their tolerances, over the largest effect of every metric; zero where there is no
    derivative, as at a kink, and next to nothing where no error has an effect on the values."""
    largest = np.maximum(np.abs(effects).max(axis=1), LEAST * np.abs(values))
    return np.nan_to_num(np.abs(changes) / np.maximum(largest, 1e-300)[:, None])
