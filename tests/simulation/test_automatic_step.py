"""The step that "auto" takes: from trial assemblies of its own, or from those of the user."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rfem_jax import (
    Automatic,
    FunctionProblem,
    GeneralisedAlpha,
    Metric,
    MomentRamp,
    Problem,
    Simulation,
    Tolerances,
    Uniform,
    assembly_errors,
    choose_method,
    discretise,
    first_samples,
    monte_carlo,
)
from rfem_jax.simulation.accuracy import _longer, estimate_change
from rfem_jax.tolerancing.problems.evaluation import evaluate_points
from tests.mechanisms import four_bar

DRIVE, DURATION, ACCURACY = MomentRamp("A", 0.5, 0.02), 0.04, 1e-3
TOLERANCES = Tolerances({"D.delta_x": Uniform(0.01), "D.d_y": Uniform(5e-4)})
KEY = jax.random.key(2)


@pytest.mark.parametrize("order", [0.5, 1.0, 2.0, 3.0, 4.5])
@pytest.mark.parametrize("share", [1.0, 0.7, 0.3, 0.01])
def test_a_longer_step_keeps_the_accuracy_where_errors_grow_by_a_power_of_it(order, share):
    error = share * ACCURACY
    factor = _longer(error, error * 2.0**order, ACCURACY)
    assert 1.0 <= factor <= 2.0
    assert error * factor**order <= ACCURACY * (1.0 + 1e-12)
    if order >= 2.0 and factor < 2.0:
        np.testing.assert_allclose(error * factor**order, ACCURACY)
    assert _longer(error, None, ACCURACY) == pytest.approx(min(2.0, share**-0.5))


def test_errors_that_are_zero_or_not_finite():
    assert _longer(0.0, 0.0, ACCURACY) == 2.0
    assert _longer(0.5 * ACCURACY, np.inf, ACCURACY) == 1.0


@pytest.fixture(scope="module")
def model():
    return discretise(four_bar(2))


@pytest.mark.long
def test_assemblies_by_their_names(model):
    samples = first_samples(TOLERANCES, KEY)
    stacked = jax.vmap(lambda one: assembly_errors(model, one))(samples)
    settings = model, Automatic(accuracy=ACCURACY), DRIVE, DURATION
    chosen = choose_method(*settings, stacked)
    assert choose_method(*settings, samples) == chosen
    # What is no error of a joint or link is left out; of nothing else remain the assemblies of its own.
    assert choose_method(*settings, samples | {"drive.moment": jnp.zeros(8)}) == chosen
    assert choose_method(*settings, {"drive.moment": jnp.zeros(8)}) == choose_method(*settings)
    problem = Problem(
        Simulation(model, drive=DRIVE, duration=DURATION, method=settings[1], trials=samples), "A.rms_force"
    )
    assert problem.method == chosen != choose_method(*settings)


@pytest.mark.slow
def test_a_sample_that_fails_does_not_spoil_the_choice(model, monkeypatch):
    settings = model, Automatic(accuracy=ACCURACY), DRIVE, DURATION
    samples = first_samples(TOLERANCES, KEY, 3)
    # One that cannot be assembled is left out; where one fails with all steps, the assemblies of "auto" decide.
    spoilt = {name: values.at[1].set(jnp.nan) for name, values in samples.items()}
    others = {name: values[jnp.array([0, 2])] for name, values in samples.items()}
    assert choose_method(*settings, spoilt) == choose_method(*settings, others)
    monkeypatch.setattr("rfem_jax.simulation.accuracy._longest_step", lambda *given: None if given[-1] else 1e-3)
    assert choose_method(*settings, samples).step == 1e-3


def test_the_first_samples_are_those_of_the_study():
    def total(errors):
        return {"sum": sum(errors.values())}, jnp.int32(0)

    problem = FunctionProblem(total, TOLERANCES.names, Metric("sum"))
    for sampling in ("sobol", "pseudo_random"):
        samples = first_samples(TOLERANCES, KEY, 5, sampling)
        found = monte_carlo(problem, TOLERANCES, 64, KEY, sampling=sampling).errors
        for i, name in enumerate(TOLERANCES.names):
            np.testing.assert_array_equal(samples[name], found[:5, i])


@pytest.mark.long
def test_other_samples_are_as_accurate(model):
    tried = first_samples(TOLERANCES, KEY)
    chosen = choose_method(model, Automatic(accuracy=ACCURACY), DRIVE, DURATION, tried)
    others = first_samples(TOLERANCES, jax.random.key(7), 16)

    names = [f"{joint}.{load}" for load in ("rms_force", "rms_moment") for joint in "ABDC"]
    points = np.stack([others[name] for name in TOLERANCES.names], axis=1)

    def loads(method):
        """(samples, 2, joints), by one program for all steps."""
        problem = Problem(
            Simulation(model, drive=DRIVE, duration=DURATION, method=method, save_every=DURATION / 2), names
        )
        values, status = evaluate_points(problem, TOLERANCES.names, {}, points)
        assert not status.any()
        return values.reshape(len(points), 2, -1)

    fine = loads(GeneralisedAlpha(step=chosen.step / 8.0, tolerance=1e-7))
    error = estimate_change(loads(chosen), fine, float(np.max(model.length)))
    assert 0.02 * ACCURACY < error < ACCURACY
