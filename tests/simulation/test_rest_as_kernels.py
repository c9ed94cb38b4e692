"""What is left to XLA of mechanisms at rest and in given motions, beside kernels: little, for it takes long to compile.

The sine of a joint's angle stands for the kinematics, and all that follows from these.
"""

from collections.abc import Iterator

import jax
import numpy as np
import pytest
from jax.extend.core import Jaxpr

from rfem_jax import (
    GeneralisedAlpha,
    MomentRamp,
    Simulation,
    assemble,
    discretise,
    inverse_dynamics,
    kinetostatic_turn,
    simulate,
)
from rfem_jax.validation.clearances import flexible_four_bar
from tests.mechanisms import four_bar

SHORT = GeneralisedAlpha(step=2.5e-3)


def outside_of_kernels(jaxpr: Jaxpr) -> Iterator[str]:
    """Names of all operations that are in no kernel."""
    for equation in jaxpr.eqns:
        if equation.primitive.name == "kernel":
            continue
        yield equation.primitive.name
        for inner in jax.tree.leaves(equation.params, is_leaf=lambda x: isinstance(x, Jaxpr) or hasattr(x, "jaxpr")):
            inner = getattr(inner, "jaxpr", inner)
            if isinstance(inner, Jaxpr):
                yield from outside_of_kernels(inner)


def preload():
    """Of a pin in its bush, which contacts hold."""
    model = discretise(flexible_four_bar())
    return lambda tilt: assemble(model, {"D.delta_x": tilt}).preload["D"].moment


def unstable():
    """Of a mechanism whose stability is tested."""
    model = discretise(four_bar(2), elements="geometrically_exact")
    return lambda tilt: assemble(model, {"D.delta_x": tilt}, hold={}).stability.growth


def turn():
    model = discretise(four_bar(2))
    return lambda tilt: kinetostatic_turn(model, {"D.delta_x": tilt}, np.array([0.1, 0.2]) - np.pi / 2).holding


def moment():
    model = discretise(four_bar(1))
    return lambda longer: inverse_dynamics(
        model, {"A": [0.1]}, {"A": [2.0]}, {"A": [9.0]}, {"coupler.length": longer}
    ).holding["A"]


@pytest.mark.parametrize(
    "make, derivative",
    [
        (preload, jax.jacfwd),
        (unstable, lambda function: function),
        (turn, jax.jacfwd),
        (turn, jax.jacrev),
        (moment, jax.jacrev),
    ],
)
def test_no_kinematics_is_left_to_xla(make, derivative):
    left = [*outside_of_kernels(jax.make_jaxpr(derivative(make()))(1e-3).jaxpr)]
    assert left and not {"sin", "cos", "atan2"} & {*left}


def test_no_check_is_left_to_xla():
    """What judges a run is no part of its derivatives, such as whether all its numbers are finite."""
    simulation = Simulation(discretise(four_bar(2)), drive=MomentRamp("A", 1.5, 0.02), duration=0.01, method=SHORT)
    moment = lambda tilt: simulate(simulation, {"D.delta_x": tilt}).metrics.mean_square_moment["D"]  # noqa: E731
    left = [*outside_of_kernels(jax.make_jaxpr(jax.jacfwd(moment))(1e-3).jaxpr)]
    assert left.count("is_finite") == 1  # of the static start, which its derivative depends on
