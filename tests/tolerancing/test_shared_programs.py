"""Programs are shared: one serves all steps of a method, values and what follows from them; each is traced once."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rfem_jax import (
    Automatic,
    ForceRamp,
    GeneralisedAlpha,
    InputError,
    Joint,
    Mechanism,
    MomentRamp,
    Problem,
    RungeKutta4,
    Simulation,
    Tolerances,
    Uniform,
    assembly_errors,
    choose_method,
    discretise,
    monte_carlo,
    sensitivity,
    simulate,
)
from rfem_jax.compilation import program
from rfem_jax.description.methods import named_method
from rfem_jax.simulation.stages.integration import grid_for
from rfem_jax.simulation.system.time_grid import of_any_step
from rfem_jax.tolerancing.problems.evaluation import evaluate_points, split_errors
from rfem_jax.tolerancing.problems.linearisation import linearise_points
from rfem_jax.tolerancing.problems.quadratic_model import expand_by_differences
from tests.compilation.functions import covered
from tests.mechanisms import arm, four_bar, link

DRIVE, DURATION = MomentRamp("A", 0.5, 0.01), 0.02
WIDTHS = {"A.delta_x": 0.01}
KEY = jax.random.key(1)


@pytest.fixture
def traced(monkeypatch, tmp_path):
    """Names of the traced programs, with an empty folder of kept ones."""
    names, compiled = [], program.compiled

    def noted(function, *others):
        names.append(function.__name__)
        return compiled(function, *others)

    monkeypatch.setattr(program, "compiled", noted)
    with covered(tmp_path / "programs"):
        yield names


@pytest.fixture
def problem():
    model, method = discretise(arm()), GeneralisedAlpha(step=2e-3)
    return Problem(Simulation(model, drive=DRIVE, duration=DURATION, method=method), "A.mean_square_moment")


@pytest.mark.slow
def test_sensitivities_with_a_finer_step(traced, problem):
    found = sensitivity(problem, order=1, scale=WIDTHS, refined=problem.refined())
    assert found.status == "ok" and np.all(found.gradient_change < 0.1)
    assert traced.count("_differentiate") == 1  # one program for both steps


@pytest.mark.long
def test_values_after_an_expansion(traced, problem):
    """And those of a Monte Carlo study, whose distribution has a program of its own."""
    expand_by_differences(problem, None, WIDTHS)
    base, _ = split_errors(problem, None, tuple(WIDTHS))
    values, _ = evaluate_points(problem, tuple(WIDTHS), base, [[0.0], [0.01]])
    assert np.all(np.isfinite(values))
    assert sorted(traced) == ["_linearise", "evaluate_lanes"]
    study = monte_carlo(problem, Tolerances({name: Uniform(width) for name, width in WIDTHS.items()}), 4, KEY)
    assert study.good == 4 and sorted(traced) == ["_draw", "_linearise", "evaluate_lanes"]
    again, _ = evaluate_points(problem, tuple(WIDTHS), base, study.errors)
    np.testing.assert_array_equal(again, study.values)


def stepped(step, save_every=4e-3, method="generalised_alpha"):
    model = discretise(arm())
    return Problem(
        Simulation(
            model, drive=DRIVE, duration=DURATION, method=named_method(method, step=step), save_every=save_every
        ),
        "A.mean_square_moment",
    )


@pytest.mark.long
def test_one_program_serves_all_steps(traced):
    jax.clear_caches()
    at, tilts, found = {"arm.length": jnp.asarray(2e-4)}, [[0.002], [0.01]], []
    for step in (2e-3, 1e-3):
        problem = stepped(step)
        values, statuses = evaluate_points(problem, tuple(WIDTHS), at, tilts)
        same, jacobians, _ = linearise_points(problem, tuple(WIDTHS), at, tilts, mode="forward")
        assert not statuses.any()
        np.testing.assert_allclose(same, values, rtol=1e-12)
        found.append((values[:, 0], jacobians[:, 0, 0]))
    assert sorted(traced) == ["_linearise", "evaluate_lanes"]
    for one, other in zip(*found):
        assert np.all(one != other) and np.allclose(one, other, rtol=0.2)
    # This step alone, of values and in reverse mode.
    by_step = jax.value_and_grad(lambda x: problem({"A.delta_x": x, **at})[0]["A.mean_square_moment"])
    alone, gradient = jax.jit(by_step)(jnp.asarray(0.01))
    np.testing.assert_allclose(alone, found[1][0][1], rtol=1e-12)
    np.testing.assert_allclose(gradient, found[1][1][1], rtol=1e-6)
    assert abs(gradient) * WIDTHS["A.delta_x"] > 0.1 * alone


def of(problem):
    """Its metrics (m,) by the tilt."""
    return lambda x: jnp.stack([problem({"A.delta_x": x})[0][one.name] for one in problem.metrics])


@pytest.mark.long
def test_one_program_has_the_gradients_of_all_metrics(traced):
    """In reverse mode, at zero error, too."""
    model, method = discretise(arm()), GeneralisedAlpha(step=2e-3)
    asked, tilts = ("A.mean_square_moment", "A.mean_square_force"), [[0.0], [0.01]]
    problem = Problem(Simulation(model, drive=DRIVE, duration=DURATION, method=method), asked)
    values, gradients, _ = linearise_points(problem, tuple(WIDTHS), {}, tilts, mode="reverse")
    for i in range(2):
        same, gradient, _ = linearise_points(problem, tuple(WIDTHS), {}, tilts, metric=i, mode="reverse")
        np.testing.assert_array_equal(same, values)
        np.testing.assert_array_equal(gradient, gradients[:, i])
    assert traced == ["_linearise"]
    exact = jax.jit(jax.vmap(jax.jacfwd(of(problem))))(jnp.asarray(tilts)[:, 0])
    assert np.all(np.isfinite(gradients)) and np.all(np.abs(gradients[1]) > 0.0)
    np.testing.assert_allclose(gradients[:, :, 0], exact, rtol=1e-6, atol=1e-9 * np.abs(exact).max())


def test_the_angle_is_of_no_slide():
    block = Mechanism([link("block", 0.1)], [Joint("P", "base", "block", kind="prismatic")], driven_joint="P")
    method, drive = GeneralisedAlpha(step=2e-3), ForceRamp("P", 5.0, 0.01)
    simulation = Simulation(discretise(block), drive=drive, duration=DURATION, method=method)
    with pytest.raises(InputError, match="moves `P` along an axis"):
        Problem(simulation, "angle_error")


@pytest.mark.long
def test_a_program_of_simulations_serves_all_steps(traced):
    """Of a loop with one flexible link, where the number of steps is no part of the program."""
    links = [link("crank", 0.12), link("coupler", 0.3, 2), link("rocker", 0.3)]
    model, forces = discretise(dataclasses.replace(four_bar(), links=links)), []
    coarse = Simulation(model, drive=DRIVE, duration=DURATION, method=GeneralisedAlpha(step=2e-3), save_every=4e-3)
    fine = dataclasses.replace(coarse, method=GeneralisedAlpha(step=1e-3))
    for simulation in (coarse, fine):
        run = simulate(simulation)
        assert int(run.status) == 0
        forces.append(float(run.metrics.rms_force["A"]))
    assert traced == ["simulated"]
    assert 1e-6 < abs(forces[1] / forces[0] - 1.0) < 0.1
    alone = jax.jit(lambda errors: simulate(fine, errors).metrics.rms_force["A"])(assembly_errors(model))
    np.testing.assert_allclose(alone, forces[1], rtol=1e-9)


def test_the_form_that_serves_all_steps():
    problem = stepped(1.3e-3)
    shared = problem.of_any_step()
    assert (shared.method.step, shared.save_every, float(shared.steps)) == (4e-3, 4e-3, 4.0)
    assert shared.of_any_step() is shared
    # Saved times by default: a step that is longer than between them is the time between them.
    assert stepped(1e-3, None).of_any_step().save_every == 1e-3
    assert float(stepped(1e-3, None).of_any_step().steps) == 1.0
    explicit = stepped(1e-5, method="rk4")
    assert explicit.of_any_step() is explicit
    # The finer one keeps the times, and shares the program of the other.
    finer = problem.refined()
    assert (finer.method.step, finer.save_every) == (0.5 * 1.3e-3, 4e-3)
    assert jax.tree.structure(finer.of_any_step()) == jax.tree.structure(shared)


def test_programs_of_cases_serve_any_step():
    """What they are kept by is the same for two steps of an implicit method, whose number is traced."""
    taken = []
    for step in (4e-4, 3e-4):
        method = GeneralisedAlpha(step=step)
        grid, steps = grid_for(None, 0.01, method, 1e-3)
        taken.append((steps, *of_any_step(method, grid, steps)))
    (few, first, _, traced), (more, second, *_) = taken
    assert few < more and first == second and int(traced) == few and isinstance(traced, jax.Array)
    explicit = RungeKutta4(step=1e-4)
    assert of_any_step(explicit, grid, 10) == (explicit, grid, 10)


def test_a_problem_is_shown_in_a_line(problem):
    """JAX asks for it in every transformation."""
    said = "arm: A.mean_square_moment over 0.02 s by generalised_alpha with steps of 0.002 s"
    assert repr(problem) == f"<Problem of {said}>"


@pytest.mark.slow
def test_trials_of_auto(traced):
    jax.clear_caches()
    assert choose_method(discretise(arm()), Automatic(), DRIVE, DURATION).step > 0.0
    assert [traced.count(name) for name in ("prepare_batch", "loads_of_trials")] == [1, 1]
