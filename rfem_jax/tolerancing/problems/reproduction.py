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

from rfem_jax.description.basics.errors import InputError
from rfem_jax.tolerancing.problems.linearisation import linearise_points
from rfem_jax.tolerancing.problems.problem import StrikingProblem, ToleranceProblem
from rfem_jax.tolerancing.problems.sample_values import Base

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
    (values, (coarse,), _), (_, (fine,), _) = found
    neither = ~np.isfinite(coarse) & ~np.isfinite(fine)
    change = changes_of_effects(np.where(neither, 0.0, t * (fine - coarse)), t * coarse, values[0])
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
    changes: Float[np.ndarray, "m n"], effects: Float[np.ndarray, "m k"], values: Float[np.ndarray, " m"]
) -> Float[np.ndarray, "m n"]:
    """Changes of effects over the largest effect of every metric, next to nothing where no error has one; infinite
    where only one of both steps has derivatives.

    Args: NaN among the effects where there is no derivative, as at a kink; there the changes are to be zero.
    """
    largest = np.maximum(np.nan_to_num(np.abs(effects)).max(axis=1), LEAST * np.abs(values))
    found = np.abs(changes) / np.maximum(largest, 1e-300)[:, None]
    return np.where(np.isnan(found), np.inf, found)


def changes_by_step(finer, widths, g, h, effects) -> tuple[np.ndarray | None, np.ndarray | None]:
    """Differences to the model of the refined problem, relative to the effects and to the largest |H|."""
    if finer is None:
        return None, None
    gradient = np.abs(np.asarray(finer.gradient) * widths - g)
    gradient = np.divide(gradient, effects, out=np.zeros_like(g), where=effects > 0)
    if h is None:
        return gradient, None
    difference = np.abs(np.asarray(finer.hessian) * np.outer(widths, widths) - h).max(axis=(1, 2))
    largest = np.abs(h).max(axis=(1, 2))
    return gradient, np.divide(difference, largest, out=np.zeros_like(largest), where=largest > 0)


def changes_that_count(character, gradient_change, hessian_change, h, effects, value) -> np.ndarray:
    """What `changes_by_step` are of the largest effect of every metric that has derivatives and depends on errors."""
    changes = gradient_change * effects
    if h is not None:  # alone where gradients vanish by symmetry
        changes = np.column_stack([changes, 0.5 * hessian_change * np.abs(h).max(axis=(1, 2))])
    without = np.isin(character, ("none", "kink", "flat"))[:, None]
    return changes_of_effects(np.where(without, 0.0, changes), effects, value)
