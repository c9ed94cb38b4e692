"""Models of limits: constraints h(t) <= 0 on the tolerances of an allocation (theory (10.15) to (10.17)).

Place in the pipeline: under the corrected model; differentiable models (quadratic, with corrections from the full
problem) that the augmented Lagrangian solves on. They are pytrees: new numbers do not compile again. Their t (k,) has
the size of every coordinate: those of one zone have the same.

    Scenarios    h_j(t) = F_j + D_j.d + 1/2 d^T H d,   d = t z_j - e_j            (worst case)
    Sampled      h_il(t) the same at fixed standard points u_i, for every limit l
    Moments      h_l(t) = k1 + c sqrt(k2) + (c^2 - 1)/6 k3/k2 + correction_l(t)   (RSS)
    Sample       h(t) = quantile over samples i of max_l h_il(t)                  (yield)

F, D are value and gradient of the full problem at the anchor e_j (at first the nominal point: then h is the quadratic
model itself). For a linear metric Moments is the root sum of squares exactly; for an even one (chi-square-like, skewed)
the term of k3 matters. Its correction is the sample quantile (mean) of the full problem's expansion minus that of the
quadratic model at the same standard points, so that the sample's own error cancels to first order. The quantile of
Sample is a weighted mean of order statistics (Harrell and Davis, Biometrika 69 (1982) 635-640): smooth in t but for
ties of neighbours, and with less scatter than one order statistic.
"""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from scipy.stats import beta

from rfem_jax.compilation.program import Program
from rfem_jax.tolerancing.optimisation.augmented_lagrangian import Solution, minimise
from rfem_jax.tolerancing.robust_design.cost_models import CostModel, total_cost

INSIDE = 1e-7  # answers lie this part of the headroom inside their limits (above solver error)


class Quadratic(eqx.Module):
    """Normalised quadratic models of l limits: h = offset + gradient.e + 1/2 e^T hessian e."""

    offset: Float[Array, " l"]
    gradient: Float[Array, "l k"]
    hessian: Float[Array, "l k k"]

    def __call__(self, e: Float[Array, " k"]) -> Float[Array, " l"]:
        """h (l,) at errors e (k,) from the centre."""
        quadratic = 0.5 * jnp.einsum("lij,i,j->l", self.hessian, e, e)
        return self.offset + self.gradient @ e + quadratic


class Scenarios(eqx.Module):
    """Constraints at chosen points z_j of the unit box, each of one limit (`owner`), with values and gradients at the
    anchors; rows where `mask` is False are not used."""

    quadratic: Quadratic
    points: Float[Array, "j k"]
    owner: Int[Array, " j"]
    mask: Bool[Array, " j"]
    anchors: Float[Array, "j k"]
    values: Float[Array, " j"]
    gradients: Float[Array, "j k"]

    def __call__(self, t: Float[Array, " k"]) -> Float[Array, " j"]:
        """h (j,) of half-widths t (k,)."""
        away = self.points * t[None] - self.anchors
        quadratic = jnp.einsum("jab,ja,jb->j", self.quadratic.hessian[self.owner], away, away)
        h = self.values + jnp.sum(self.gradients * away, axis=1) + 0.5 * quadratic
        return jnp.where(self.mask, h, -1.0)


class Sampled(eqx.Module):
    """Expansions of l limits at n standard points, about errors `anchors` (n, k)."""

    quadratic: Quadratic
    units: Float[Array, "n k"]
    anchors: Float[Array, "n k"]
    values: Float[Array, "n l"]
    gradients: Float[Array, "n l k"]

    def __call__(self, t: Float[Array, " k"]) -> Float[Array, "n l"]:
        """h (n, l) of half-widths t (k,)."""
        away = self.units * t[None] - self.anchors
        curved = jnp.einsum("lab,na->nlb", self.quadratic.hessian, away)
        quadratic = jnp.einsum("nlb,nb->nl", curved, away)
        return self.values + jnp.einsum("nlk,nk->nl", self.gradients, away) + 0.5 * quadratic


class Moments(eqx.Module):
    """Cornish-Fisher quantile (or the mean) of each limit's quadratic form in normal errors.

    `sampled` is None before the first observation, `weights` (n,) are those of its order statistics (all equal for the
    mean); `extra` (l,) is the shortfall of fresh runs.
    """

    quadratic: Quadratic
    deviation: Float[Array, " k"]
    coverage: Float[Array, ""]
    extra: Float[Array, " l"]
    sampled: Sampled | None
    weights: Float[Array, " n"]
    statistic: str = eqx.field(static=True)

    def __call__(self, t: Float[Array, " k"]) -> Float[Array, " l"]:
        """h (l,) of half-widths t (k,)."""
        h = self.moments(t) + self.extra
        if self.sampled is None:
            return h
        quadratic = jax.vmap(self.quadratic)(self.sampled.units * t[None])
        full = self.sampled(t)
        if self.statistic != "mean":
            full, quadratic = jnp.sort(full, axis=0), jnp.sort(quadratic, axis=0)
        return h + self.weights @ full - self.weights @ quadratic

    def moments(self, t: Float[Array, " k"]) -> Float[Array, " l"]:
        """The statistic (l,) of the quadratic model alone."""
        sigma = t * self.deviation
        g = self.quadratic.gradient * sigma[None]
        h = self.quadratic.hessian * jnp.outer(sigma, sigma)[None]
        mean = self.quadratic.offset + 0.5 * jnp.trace(h, axis1=1, axis2=2)
        if self.statistic == "mean":
            return mean
        # Traces of the square and the cube of h, which is symmetric.
        squares, cubes = jnp.sum(h * h, axis=(1, 2)), jnp.sum(jnp.einsum("lij,ljk->lik", h, h) * h, axis=(1, 2))
        second = jnp.sum(g * g, axis=1) + 0.5 * squares
        third = 3 * jnp.einsum("li,lij,lj->l", g, h, g) + cubes
        varies = second > 0
        safe = jnp.where(varies, second, 1.0)
        c = self.coverage
        skew = (c**2 - 1) / 6 * third / safe
        return mean + jnp.where(varies, c * jnp.sqrt(safe) + skew, 0.0)


class Sample(eqx.Module):
    """Quantile of the worst limit over fixed standard points; weights (n,) of the order statistics."""

    sampled: Sampled
    weights: Float[Array, " n"]

    def __call__(self, t: Float[Array, " k"]) -> Float[Array, "1"]:
        """h (1,) of half-widths t (k,)."""
        return (self.weights @ jnp.sort(jnp.max(self.sampled(t), axis=1)))[None]


Model = Scenarios | Moments | Sample


def quantile_weights(n: int, level: float) -> Float[np.ndarray, " n"]:
    """Harrell-Davis weights (n,) of the order statistics for the quantile `level`.

    A level of 1 or more (which n samples do not reach) gives the largest sample.
    """
    if level >= 1:
        return np.eye(n)[-1]
    edges = beta.cdf(np.arange(n + 1) / n, (n + 1) * level, (n + 1) * (1 - level))
    return np.diff(edges)


def sample_quantile(h: Float[np.ndarray, " n"], level: float) -> float:
    """Quantile of samples h (n,), where a failed one (NaN) counts as above every limit.

    Infinite when the good samples are fewer than the fraction `level` of all.
    """
    good = np.sort(h[np.isfinite(h)])
    if len(good) < level * len(h) or len(good) == 0:
        return np.inf
    return float(quantile_weights(len(good), level * len(h) / len(good)) @ good)


@Program
def cheapest(
    model: Model,
    costs: Sequence[CostModel],
    owner: Int[Array, " k"],
    x: Float[Array, " v"],
    lower: Float[Array, " v"],
    upper: Float[Array, " v"],
    rounds: int = 25,
    evaluations: int = 1000,
) -> tuple[Solution, Float[Array, ""], Float[Array, " c"]]:
    """Minimise the total cost under model(t) <= 0; x, lower, upper (v,) are logarithms of the sizes, owner (k,) is the
    size of each coordinate, of which the model is a function.

    Returns: the Solution in x, the unit of cost it was solved in (its multipliers are in that unit), and the values
        (c,) of the constraints there.
    """
    start = total_cost(costs, jnp.exp(x))
    unit = jnp.where(jnp.abs(start) > 0, jnp.abs(start), 1.0)
    solution = minimise(
        lambda y: total_cost(costs, jnp.exp(y)) / unit,
        lambda y: model(jnp.exp(y)[owner]) + INSIDE,
        x,
        lower,
        upper,
        rounds=rounds,
        evaluations=evaluations,
    )
    return solution, unit, model(jnp.exp(solution.point)[owner])
