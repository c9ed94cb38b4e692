"""What one objective costs of another: answers of `optimise` for several weights.

Place in the pipeline: optimisation -> **front** -> reports.

Each answer minimises (1 - w) f / f_0 + w g / g_0 with both terms over their sizes at the first answer, so that weights
from 0 to 1 go from the least f to the least g.  Points of the front in a dent of it are minima of no weighted sum
(I. Das, J. E. Dennis, Struct. Optim. 14 (1997) 63-69): there a limit on one objective finds them.
"""

from collections.abc import Callable, Mapping, Sequence

from rfem_jax.description.basics.errors import InputError
from rfem_jax.tolerancing.robust_design.result import DesignOptimum

WEIGHTS = (0.0, 0.25, 0.5, 0.75, 1.0)


def pareto_front(
    solve: Callable[[Mapping[str, float]], DesignOptimum], terms: Sequence[str], weights: Sequence[float] = WEIGHTS
) -> dict[float, DesignOptimum]:
    """Answers for several weights of two terms of the objective.

    Arguments: solve, objective {term: weight} -> answer, as `lambda weights: optimise(problem, designs, tolerances,
    weights, ...)`; terms, two metrics, or a metric and "cost"; weights of the second one, from 0 to 1.

    Returns: {weight: answer}, in the order of the weights.

    Raises: InputError for other than two different terms, and weights beyond 0 and 1.
    """
    if len(terms) != 2 or terms[0] == terms[1]:
        raise InputError(f"Argument `terms` must be two different terms of an objective, but is {list(terms)!r}.")
    if not weights or any(not 0.0 <= weight <= 1.0 for weight in weights):
        raise InputError(f"Argument `weights` must lie between 0 and 1, but is {list(weights)!r}.")
    first, second = terms
    even = solve({first: 1.0, second: 1.0})
    sizes = [abs(even.terms[term]) or 1.0 for term in terms]
    return {
        float(weight): solve({first: (1.0 - weight) / sizes[0], second: weight / sizes[1]})
        for weight in sorted(weights)
    }
