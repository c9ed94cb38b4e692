"""A criterion on the quadratic model, which observations of the full problem correct: what an allocation is solved on.

Place in the pipeline: request, observations, models -> **corrected model** -> worst case, statistics -> allocation.

The tolerances of the cheapest answer are solved for on a model that costs nothing; the problem is observed at the
answer, and corrects the model for the next solve.  `Criterion` (criteria.py) needs no model: it observes the problem at
every step.

Symbols: t (v,) sizes [rad, m], x = log t, h (l,) normalised limits (<= 0 holds).
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from rfem_jax.description.basics.errors import InputError
from rfem_jax.tolerancing.robust_design.models import Model, Quadratic, cheapest
from rfem_jax.tolerancing.robust_design.observations import Observer

HalfWidths = Float[np.ndarray, " v"]
Normalised = Float[np.ndarray, " l"]


class Answer(NamedTuple):
    """Solution on a model: x = log t (v,), cost, h (l,) per limit, the largest constraint, and dcost/dh (l,) per
    limit."""

    x: Float[np.ndarray, " v"]
    cost: float
    h: Normalised
    violation: float
    prices: Normalised


class CorrectedModel:
    """What both criteria of an allocation share.

    Each has `model()`, constraints as a function of the size of every coordinate, as it is corrected so far; `solve`,
    the cheapest x on it, from a start and between lower and upper (v,); `observe`, the constraints of the full problem
    at t, which corrects the model; `verify`, a fresh run at t; `learn`, a correction by one that fell short (which
    cannot verify an answer any more); `quadratic_worst`, h of the quadratic model alone; `best`, the lowest h that the
    full problem can reach: that of the smallest tolerances.

    Attributes: joint, whether one constraint counts all limits; settling, how much looser the cost settles than limits
    hold; level, the fraction of samples that it refers to (NaN without); failed samples so far.
    """

    joint = False
    settling = 1.0
    level = np.nan

    def __init__(self, observer: Observer):
        self.observer, self.request = observer, observer.request
        self.variables, self.sizes = self.request.variables, self.request.variables.sizes
        self.quadratic = self._quadratic()
        self.failed = 0

    def _quadratic(self) -> Quadratic:
        """The quadratic model of h by coordinates. Raises InputError for a metric without derivatives at the centre."""
        model, limits, matrix = self.request.model, self.request.limits, self.sizes.matrix
        assert model is not None and model.hessian is not None  # of an allocation
        rows = np.array([limit.position for limit in limits])
        factor = np.array([limit.sign / limit.scale for limit in limits])
        offset = [limit.normalise(float(model.value[limit.position])) for limit in limits]
        gradient = np.asarray(model.gradient)[rows] @ matrix * factor[:, None]
        hessian = matrix.T @ np.asarray(model.hessian)[rows] @ matrix * factor[:, None, None]
        finite = all(np.all(np.isfinite(a)) for a in (offset, gradient, hessian))
        if int(model.status) != 0 or not finite:
            raise InputError(
                "Argument `limits` must be on metrics that are smooth at the centre of the tolerances, but one has no "
                "finite value, gradient or Hessian there; limit its mean square, not the root."
            )
        return Quadratic(jnp.asarray(offset), jnp.asarray(gradient), jnp.asarray(hessian))

    def predicted_yield(self, t: HalfWidths) -> float:
        """Fraction of samples within all limits by the corrected model, NaN but for a yield."""
        return np.nan

    def best_yield(self) -> float:
        """Fraction of samples within all limits at the smallest tolerances, NaN but for a yield."""
        return np.nan

    def _cheapest(
        self, model: Model, x: HalfWidths, lower: HalfWidths, upper: HalfWidths, **effort: int
    ) -> tuple[HalfWidths, float, Float[np.ndarray, " c"], Float[np.ndarray, " c"]]:
        """x of the cheapest sizes on the model, their cost, the constraints (c,) there and their multipliers (c,)."""
        arrays = map(jnp.asarray, (self.sizes.owner, x, lower, upper))
        solution, unit, h = cheapest(model, self.request.costs, *arrays, **effort)
        multipliers = np.asarray(solution.multipliers) * float(unit)
        return np.asarray(solution.point), float(solution.cost) * float(unit), np.asarray(h), multipliers
