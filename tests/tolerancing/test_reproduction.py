"""Derivatives through impacts: what a finer step does not reproduce guides no search."""

import jax
import pytest

from rfem_jax import (
    FunctionProblem,
    InputError,
    Reciprocal,
    Tolerances,
    Uniform,
    allocate,
    optimise,
    reliability,
    worst_case,
)

jax.config.update("jax_enable_x64", True)

NAMES = ("D.delta_x", "D.delta_z", "coupler.length")
UNITS = {"coupler.length": "m"}
WIDTHS = dict.fromkeys(NAMES, 0.1)


def loads(errors):
    """A force that rises with every error."""
    a, b, c = (errors[name] for name in NAMES)
    return {"force": 2.0 + 3.0 * c + 5.0 * a**2 + b**2 * c}


def striking_problem(slope):
    """The closed-form loads with a slope more, which half the step does not have, as if pins struck their bushes."""

    def coarse(errors):
        return {"force": loads(errors)["force"] + slope * errors["coupler.length"]}

    class Striking(FunctionProblem):
        strikes = True

        def refined(self):
            return FunctionProblem(loads, NAMES, "force", error_units=UNITS)

    return Striking(coarse, NAMES, "force", error_units=UNITS)


SEARCHES = {
    "worst case": lambda one: worst_case(one, WIDTHS, "force", key=jax.random.key(0)),
    "worst case without a model": lambda one: worst_case(one, WIDTHS, "force", key=jax.random.key(0), model=False),
    "allocation": lambda one: allocate(
        one, {"force": 30.0}, Reciprocal(1e-3), dict.fromkeys(NAMES, (0.01, 0.2)), key=jax.random.key(0)
    ),
    "optimum": lambda one: optimise(
        one, {}, dict.fromkeys(NAMES, (0.01, 0.2)), "cost", {"force": 30.0}, cost=Reciprocal(1e-3),
        key=jax.random.key(0), robust="worst_case", starts=1,
    ),
    "reliability": lambda one: reliability(
        one, Tolerances({name: Uniform(0.1) for name in NAMES}), {"force": 4.0},
        jax.random.key(0), n=100, starts=2, rounds=4,
    ),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("name", SEARCHES)
def test_searches_that_derivatives_guide_refuse_those_that_a_finer_step_does_not_reproduce(name):
    SEARCHES[name](striking_problem(0.03))
    with pytest.raises(InputError, match="force by coupler.length changes by .* chaotic"):
        SEARCHES[name](striking_problem(3.0))
