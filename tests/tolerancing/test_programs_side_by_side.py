"""Programs that are compiled ahead, side by side, are those that are used: each is traced once."""

import jax
import numpy as np
import pytest

from rfem_jax import Method, MomentRamp, discretise
from rfem_jax.compilation import call
from rfem_jax.simulation.accuracy import choose_method
from rfem_jax.tolerancing.problems.evaluation import evaluate_points, split_errors
from rfem_jax.tolerancing.problems.quadratic_model import expand_by_differences
from rfem_jax.tolerancing.problems.simulated_problem import Problem
from rfem_jax.tolerancing.sensitivities import sensitivity
from tests.compilation.functions import covered
from tests.mechanisms import four_bar

COMPILED_AS_SHIPPED = True

DRIVE, DURATION = MomentRamp("A", 0.5, 0.01), 0.02
WIDTHS = {"D.delta_x": 0.01}


@pytest.fixture
def traced(monkeypatch, tmp_path):
    """Names of the traced programs, with an empty folder of kept ones."""
    names, trace = [], call.trace

    def noted(function, *others):
        names.append(function.__name__)
        return trace(function, *others)

    monkeypatch.setattr(call, "trace", noted)
    with covered(tmp_path / "programs"):
        yield names


@pytest.fixture
def problem():
    return Problem(
        discretise(four_bar(2)), DRIVE, DURATION, "A.mean_square_moment", Method("generalised_alpha", step=2e-3)
    )


def test_sensitivities_with_a_finer_step(traced, problem):
    found = sensitivity(problem, order=1, scale=WIDTHS, refined=problem.refined())
    assert found.status == "ok" and np.all(found.gradient_change < 0.1)
    assert traced.count("_differentiate_along") == 2


def test_values_after_an_expansion(traced, problem):
    expand_by_differences(problem, None, WIDTHS, values_follow=True)
    base, _ = split_errors(problem, None, tuple(WIDTHS))
    values, _ = evaluate_points(problem, tuple(WIDTHS), base, [[0.0], [0.01]])
    assert np.all(np.isfinite(values))
    assert sorted(traced) == ["_evaluate_chunk", "_linearise"]


def test_trials_of_auto(traced):
    jax.clear_caches()
    assert choose_method(discretise(four_bar(2)), Method("auto"), DRIVE, DURATION).step > 0.0
    assert [traced.count(name) for name in ("prepare_trials", "loads_of_trials")] == [1, 1]
