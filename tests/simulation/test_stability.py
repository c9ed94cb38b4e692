"""Largest stable steps: predicted from damped eigenvalues, and confirmed by simulations."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rfem_jax import (
    Automatic,
    Explicit,
    InputError,
    PrescribedRate,
    RungeKutta4,
    Simulation,
    assembly_errors,
    check_step,
    discretise,
    largest_stable_step,
    load_study,
    simulate,
)
from rfem_jax.description.methods import named_method
from rfem_jax.simulation.stages.integration import grid_for
from rfem_jax.simulation.vibrations.stability import eigenvalues
from rfem_jax.validation.reference_values import read_reference

REFERENCE = read_reference("four_bar_study")
STUDIES = Path(__file__).parents[2] / "studies" / "four_bar"


@pytest.fixture(scope="module")
def models():
    return {name: discretise(load_study(STUDIES / f"{name}.toml").mechanism) for name in ("study", "undamped")}


@pytest.mark.parametrize(
    ("name", "method", "limit"),
    [
        *(
            (name, method, step)
            for name, steps in REFERENCE["largest_stable_step"].items()
            for method, step in steps.items()
        ),
        # Lower than the 7.6e-6 s of the first-order variant, which uses the last step's velocity.
        ("study", "leapfrog", 4.66e-6),
    ],
)
def test_limits_of_the_study(models, name, method, limit):
    got = largest_stable_step(models[name], named_method(method, step=1e-6))
    np.testing.assert_allclose(got, limit, rtol=5e-3)


def test_frequencies_with_the_crank_held(models):
    values = np.sort(np.abs(eigenvalues(models["undamped"], PrescribedRate("A", 1.0)).imag))
    elastic = values[values > 100.0][::2]
    known = REFERENCE["angular_frequencies"]
    np.testing.assert_allclose(elastic[:4], known["lowest"], atol=2.0)
    np.testing.assert_allclose(elastic[-1], known["highest"], rtol=1e-3)


def test_a_step_too_large_is_refused_with_the_allowed_one(models):
    with pytest.raises(InputError, match=r"`step` must be at most 1.9\de-05 s .* but is 3e-05"):
        check_step(models["study"], RungeKutta4(step=3e-5))
    assert check_step(models["study"], RungeKutta4(step=1e-5)) > 1.9e-5
    assert check_step(models["study"], Explicit("dopri5", rtol=1e-6, atol=1e-8)) is None


def test_auto_must_be_chosen_before_times_are_divided(small):
    with pytest.raises(InputError, match="choose_method"):
        grid_for(small.drive, 0.02, Automatic(), None)


@pytest.mark.slow
def test_simulations_confirm_the_limit(small, method="rk4"):
    """Just below the limit the run is fine, just above it diverges."""
    limit = largest_stable_step(small.model, named_method(method, step=1e-6))
    errors = assembly_errors(small.model, {"D.delta_x": 5e-3})
    settings = {**small.settings, "duration": 0.03, "save_every": 3e-2}
    states = []
    for share in (0.97, 1.06):
        settings["method"] = replace(named_method(method, step=1e-6), step=share * limit)
        states.append(simulate(Simulation(small.model, **settings), errors))
    assert int(states[0].status) == 0
    assert int(states[1].status) != 0 or float(states[1].checks.energy_balance_error) > 1.0
