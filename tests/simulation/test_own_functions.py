"""Drives, forces and metrics of the user's own: in programs that are made by themselves the same values as within one
program of the user, and derivatives by the numbers that they hold or close over."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rfem_jax import (
    GeneralisedAlpha,
    Joint,
    JointForceFunction,
    Mechanism,
    Metric,
    MomentFunction,
    PointForce,
    Problem,
    RungeKutta4,
    Simulation,
    discretise,
    simulate,
)
from rfem_jax.compilation import keeping
from tests.mechanisms import link


class Sine(eqx.Module):
    """A moment with a number to differentiate by."""

    moment: jax.Array

    def __call__(self, t, phase):
        return self.moment * jnp.sin(200.0 * t)


DURATION, ERROR = 0.02, 2e-3
METRIC = Metric("mean_square", "N^2", function=lambda run: jnp.mean(run.loads["A"].force ** 2))


def arm(forces=()):
    return Mechanism([link("arm", 0.3)], [Joint("A", "base", "arm")], driven_joint="A", forces=forces)


@pytest.fixture(scope="module")
def model():
    return discretise(arm())


@pytest.fixture
def traced(monkeypatch):
    """Programs that are made by themselves, as for a user who keeps none."""
    monkeypatch.setattr(keeping, "_choice", keeping._Choice(None))
    monkeypatch.setattr(keeping, "statistics", keeping.Statistics())
    return keeping.statistics


METHODS = {"rk4": RungeKutta4(step=1e-3), "generalised_alpha": GeneralisedAlpha(step=1e-3)}


@pytest.mark.long
@pytest.mark.parametrize("method", METHODS)
def test_values_and_derivatives_are_those_of_one_program(model, traced, method):
    def mean_square(moment, tilt):
        problem = Problem(
            Simulation(model, drive=MomentFunction("A", Sine(moment)), duration=DURATION, method=METHODS[method]),
            METRIC,
        )
        return problem({"A.delta_x": tilt})[0]["mean_square"]

    at = jnp.asarray(0.7), jnp.asarray(ERROR)
    value = mean_square(*at)
    assert traced.traced > 0 and traced.written == 0
    np.testing.assert_allclose(value, jax.jit(mean_square)(*at), rtol=1e-12)
    gradient = jax.grad(mean_square, argnums=(0, 1))(*at)
    np.testing.assert_allclose(jax.jacfwd(mean_square, argnums=(0, 1))(*at), gradient, rtol=1e-9, atol=1e-12)
    step = 1e-4 * np.array([0.7, ERROR])
    for i, slope in enumerate(gradient):
        apart = [mean_square(*(x + sign * step[i] * (i == k) for k, x in enumerate(at))) for sign in (1, -1)]
        np.testing.assert_allclose(slope, (apart[0] - apart[1]) / (2.0 * step[i]), rtol=1e-6, atol=1e-9 * abs(value))


@pytest.mark.long
def test_functions_may_close_over_what_is_differentiated():
    """By the implicit method, whose rules of differentiation see the leaves of a function alone."""

    def mean_square(x):
        drive = MomentFunction("A", lambda t, phase: x[0] * jnp.sin(200.0 * t))
        spring = JointForceFunction("spring", "A", lambda angle, rate: -x[1] * angle)
        force = PointForce("force", "arm", 0.2, lambda t, phase: x[2] * jnp.stack([t, 0.0 * t, t]))
        changed = discretise(arm(forces=[spring, force]))
        run = simulate(
            Simulation(changed, drive=drive, duration=5e-3, method=METHODS["generalised_alpha"], save_every=5e-3)
        )
        return run.metrics.mean_square_force["A"]

    at = jnp.asarray([1.0, 50.0, 500.0])
    slopes = jax.grad(mean_square)(at)
    np.testing.assert_allclose(jax.jacfwd(mean_square)(at), slopes, rtol=1e-9)
    for slope, step in zip(slopes, 1e-4 * jnp.diag(at)):
        differences = (mean_square(at + step) - mean_square(at - step)) / 2.0
        np.testing.assert_allclose(slope * step.sum(), differences, rtol=1e-5)
