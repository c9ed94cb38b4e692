"""The tolerance studies on the simulated four-bar: each against another way to the same number."""

import jax
import numpy as np
import pytest

from rfem_jax import (
    MomentRamp,
    Normal,
    Problem,
    Reciprocal,
    RungeKutta4,
    Simulation,
    Tolerances,
    Uniform,
    allocate,
    discretise,
    expand,
    monte_carlo,
    sensitivity,
    worst_case,
)
from tests.mechanisms import four_bar

WIDTHS = {"D.delta_x": 2e-3, "D.delta_z": 2e-3, "D.d_y": 1e-4}
METRICS = ("A.mean_square_moment", "D.mean_square_moment", "A.mean_square_force")
KEY = jax.random.key(5)


TRACES = []


class Counted(Problem):
    """The simulator, noting each time it is traced: once for every compiled program."""

    def __call__(self, errors):
        TRACES.append(len(TRACES))
        return super().__call__(errors)


@pytest.fixture(scope="module")
def problem():
    model = discretise(four_bar(3))
    settings = {"duration": 5e-4, "method": RungeKutta4(step=2.5e-5), "save_every": 2.5e-4}
    return Counted(Simulation(model, drive=MomentRamp("A", 1.5, 2.5e-4), **settings), METRICS)


@pytest.fixture(scope="module")
def quadratic(problem):
    """Value, gradient and Hessian of all metrics at the perfect mechanism."""
    return expand(problem, names=tuple(WIDTHS))


@pytest.fixture(scope="module")
def worst_corner(problem):
    """The largest mean-square moment in A at the corners of a box of tolerances."""
    run = jax.jit(jax.vmap(lambda e: problem(e)[0]["A.mean_square_moment"]))
    signs = np.array(np.meshgrid(*[[-1.0, 1.0]] * 3)).reshape(3, -1)

    def largest(tolerances):
        corners = {name: signs[i] * float(tolerances[name]) for i, name in enumerate(WIDTHS)}
        return float(run(corners).max())

    return largest


@pytest.mark.long
def test_gradients_vanish_and_hessians_are_symmetric(problem, quadratic):
    found = sensitivity(problem, scale=WIDTHS)
    assert "even" in str(found) or "kink" in str(found)
    hessians = np.asarray(quadratic.hessian)
    np.testing.assert_allclose(hessians, np.swapaxes(hessians, -1, -2), rtol=1e-7)
    t = np.array(list(WIDTHS.values()))
    changes = np.einsum("i,mij,j->m", t, hessians, t)
    assert np.all(np.abs(np.asarray(quadratic.gradient) @ t) < 1e-9 * np.abs(changes))
    # Moments vanish at the perfect mechanism: their Hessians are positive semidefinite.
    for hessian in hessians[:2]:
        values = np.linalg.eigvalsh(hessian * np.outer(t, t))
        assert values.min() > -1e-9 * values.max()


@pytest.mark.long
def test_quadratic_form_equals_differences_of_mean_squares(problem, quadratic):
    run = jax.jit(problem)
    e = {name: 0.02 * width for name, width in WIDTHS.items()}
    at = [run({name: s * v for name, v in e.items()})[0] for s in (-1.0, 0.0, 1.0)]
    vector = np.array(list(e.values()))
    for i, name in enumerate(METRICS):
        difference = float(at[2][name] - 2 * at[1][name] + at[0][name])
        form = vector @ np.asarray(quadratic.hessian)[i] @ vector
        np.testing.assert_allclose(form, difference, rtol=1e-5)


@pytest.mark.long
def test_mean_of_small_tolerances_is_the_hessian_s(problem, quadratic):
    tolerances = Tolerances({name: Normal(0.1 * width) for name, width in WIDTHS.items()})
    result = monte_carlo(problem, tolerances, 512, KEY, batch=32, sampling="sobol")
    assert np.all(np.asarray(result.status) == 0)
    means = np.asarray(result.values).mean(axis=0)
    covariance = np.asarray(tolerances.covariance())
    for i in range(len(METRICS)):
        nominal = float(np.asarray(quadratic.value)[i])
        caused = 0.5 * np.trace(np.asarray(quadratic.hessian)[i] @ covariance)
        np.testing.assert_allclose(means[i] - nominal, caused, rtol=0.05)


@pytest.mark.long
def test_worst_case_is_the_exhaustive_corner(problem, worst_corner):
    found = worst_case(problem, WIDTHS, "A.mean_square_moment", key=KEY)
    np.testing.assert_allclose(found.value, worst_corner(WIDTHS), rtol=1e-8)


@pytest.mark.long
def test_allocation_is_verified_and_compiles_the_simulator_twice(problem, worst_corner):
    limit = 1.0  # the perfect mechanism has no moment
    before = len(TRACES)
    result = allocate(
        problem,
        limits={"A.mean_square_moment": limit},
        cost=Reciprocal(1.0),
        bounds={name: (0.05 * w, 20.0 * w) for name, w in WIDTHS.items()},
        key=KEY,
    )
    assert result.status == "ok", str(result)
    # Values, and values with derivatives; each was tried without names first, which this problem does not allow.
    assert len(TRACES) - before <= 4
    before = len(TRACES)
    found = worst_case(problem, result.tolerances, "A.mean_square_moment", key=KEY)
    assert len(TRACES) == before and found.value <= limit * (1.0 + 1e-3)
    assert found.hessian_error < 1e-3
    worst = worst_corner(result.tolerances)
    assert 0.97 * limit < worst <= limit * (1.0 + 1e-3)


def test_samples_that_fail_are_counted(problem):
    """Errors far beyond what the links can bend to."""
    tolerances = Tolerances({"D.d_y": Uniform(interval=(0.0, 2.0))})
    result = monte_carlo(problem, tolerances, 16, KEY, batch=16)
    failed = np.asarray(result.status) != 0
    assert 0 < failed.sum() < 16
    assert "not_assembled" in str(result) or "diverged" in str(result)
