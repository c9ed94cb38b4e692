"""Cost models: the cost of a tolerance as a function of its half-width.

Place in the pipeline: input of `allocate` and `optimise`. A cost model is any callable of one half-width t [rad or m]
that returns a cost (in any currency), decreasing in t; the total is the sum over errors. Each error may have a model of
its own.

    Reciprocal          c(t) = fixed + factor / t
    ReciprocalSquared   c(t) = fixed + factor / t^2
    Exponential         c(t) = fixed + factor exp(-rate t)

Symbols: fixed [cost], factor [cost times the unit of t, of t^2, or cost], rate [1/unit of t].
Source: theory (10.13); M. Hallmann, B. Schleich, S. Wartzack, From tolerance allocation to tolerance-cost
optimization, Int. J. Adv. Manuf. Technol. 107 (2020) 4859-4912, section on tolerance-cost functions.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import partial
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from rfem_jax.description.basics.errors import InputError
from rfem_jax.tolerancing.checks import check_known

CostModel = Callable[[Float[Array, ""]], ArrayLike]


@dataclass(frozen=True)
class _FallingCost:
    """What costs of this file share: all numbers but `fixed` are positive."""

    def __post_init__(self):
        for one in fields(self):
            value = getattr(self, one.name)
            if one.name != "fixed" and not (np.isfinite(value) and value > 0):
                raise InputError(
                    f"Argument `{one.name}` of {type(self).__name__} must be positive, but it is {value}; a cost that "
                    "does not fall with the tolerance has no cheapest one."
                )


@dataclass(frozen=True)
class Reciprocal(_FallingCost):
    """c(t) = fixed + factor / t."""

    factor: float = 1.0
    fixed: float = 0.0

    def __call__(self, t: ArrayLike) -> Any:
        """Cost of the half-width t [rad or m]."""
        return self.fixed + self.factor / t


@dataclass(frozen=True)
class ReciprocalSquared(_FallingCost):
    """c(t) = fixed + factor / t^2."""

    factor: float = 1.0
    fixed: float = 0.0

    def __call__(self, t: ArrayLike) -> Any:
        """Cost of the half-width t [rad or m]."""
        return self.fixed + self.factor / (t * t)


@dataclass(frozen=True)
class Exponential(_FallingCost):
    """c(t) = fixed + factor exp(-rate t)."""

    factor: float
    rate: float
    fixed: float = 0.0

    def __call__(self, t: ArrayLike) -> Any:
        """Cost of the half-width t [rad or m]."""
        return self.fixed + self.factor * jnp.exp(-self.rate * t)


def assign_costs(cost: CostModel | Mapping[str, CostModel], names: Sequence[str]) -> tuple[CostModel, ...]:
    """Cost models of `names`, in their order: from one model for all, or from a mapping name -> model.

    Raises: InputError if one is missing or is not callable.
    """
    if isinstance(cost, Mapping):
        check_known(cost, names, "cost")
        missing = [name for name in names if name not in cost]
        if missing:
            raise InputError(
                f"Argument `cost` must have a model for every error with bounds, but `{missing[0]}` "
                "has none; add it, or give one model for all."
            )
        models = tuple(cost[name] for name in names)
    else:
        models = (cost,) * len(names)
    for name, model in zip(names, models, strict=True):
        if not callable(model):
            raise InputError(
                f"Argument `cost` must be a callable of one tolerance (or a mapping of them), but for "
                f"`{name}` it is {model!r}; use Reciprocal(factor) for example."
            )
    return tuple(model if _hashable(model) else partial(model) for model in models)


def _hashable(model: CostModel) -> bool:
    """Whether programs can be found by it; a function of it always can."""
    try:
        hash(model)
    except TypeError:
        return False
    return True


def total_cost(models: Sequence[CostModel], tolerances: Float[Array, " k"]) -> Float[Array, ""]:
    """Sum of the costs of tolerances (k,), a scalar; traced and differentiable."""
    return sum(
        (jnp.asarray(model(tolerances[i]), jnp.float64) for i, model in enumerate(models)),
        start=jnp.zeros(()),
    )
