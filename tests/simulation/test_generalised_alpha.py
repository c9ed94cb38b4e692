"""The implicit method: order, agreement with Runge-Kutta, clean reactions, derivatives, failures."""

from dataclasses import replace
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rfem_jax import (
    STATUS,
    Automatic,
    GeneralisedAlpha,
    InputError,
    Joint,
    Leapfrog,
    Mechanism,
    MomentRamp,
    PrescribedRate,
    Simulation,
    assembly_errors,
    choose_method,
    discretise,
    load_study,
    simulate,
)
from rfem_jax.mechanics.model.model import Coordinates, State
from rfem_jax.mechanics.model.with_errors import apply_errors
from rfem_jax.simulation.accuracy import estimate_change, loads_of_trials
from rfem_jax.simulation.solvers.generalised_alpha import GeneralisedAlphaSolver
from rfem_jax.simulation.solvers.implicit_step import StepConstants, StepStart
from rfem_jax.simulation.stages import integration
from rfem_jax.simulation.stages.stepping import Integration
from rfem_jax.simulation.system.driving import active_drives
from rfem_jax.simulation.system.equations import Conditions, start_trajectory
from rfem_jax.simulation.system.stabilisation import stabilisation_of
from rfem_jax.simulation.system.time_grid import divide_time
from rfem_jax.validation.reference_values import read_reference
from tests.mechanisms import link

STUDY = Path(__file__).parents[2] / "studies" / "four_bar" / "study.toml"
LARGEST_STEP = read_reference("four_bar_study")["largest_stable_step"]["study"]["rk4"]
ERRORS = {"D.delta_x": 0.005, "D.d_y": 5e-4, "B.child.delta_z": 0.002, "coupler.length": 1e-4}


def rms(model, run):
    metrics = run.metrics
    return np.array([[float(metrics.rms_force[j]), float(metrics.rms_moment[j])] for j in model.joint_names])


@pytest.fixture(scope="module")
def soft(small):
    """A four-bar of links a thousand times softer, whose vibrations all steps resolve."""
    return eqx.tree_at(lambda m: m.section.stiffness, small.model, 1e-3 * small.model.section.stiffness)


@pytest.fixture(scope="module")
def bent(small):
    """Mean-square force in D over 0.5 s, as a function of a factor on errors of all joints and links."""
    sizes = {"delta_x": 1.5e-3, "delta_z": 1.5e-3, "d_y": 1.2e-4}
    sizes = {f"{j}.{side}{kind}": e for kind, e in sizes.items() for j in "ABCD" for side in ("", "child.")}
    sizes |= {f"{name}.length": 1e-3 for name in small.model.link_names}
    signs = np.random.default_rng(3).choice([-1.0, 1.0], len(sizes))
    flaws = {name: sign * size for sign, (name, size) in zip(signs, sizes.items())}

    def force(factor, method):
        errors = assembly_errors(small.model, {name: factor * e for name, e in flaws.items()})
        run = simulate(
            Simulation(small.model, drive=MomentRamp("A", 1.5, 0.1), duration=0.5, method=method, save_every=2.5e-2),
            errors,
        )
        return run.metrics.mean_square_force["D"]

    return force


@pytest.fixture(scope="module")
def found(small, soft):
    """The soft four-bar by the implicit method."""
    method = GeneralisedAlpha(step=2.5e-4, corrections=4)
    settings = {**small.settings, "save_every": 2e-3, "method": method}
    return jax.tree.map(np.asarray, simulate(Simulation(soft, **settings), assembly_errors(soft, ERRORS)))


@pytest.mark.long
def test_converges_to_runge_kutta_with_order_two(small, soft):
    errors = jax.tree.map(lambda x: x[None], assembly_errors(soft, ERRORS))
    method = GeneralisedAlpha(step=2e-3, corrections=4)
    grid, _ = integration.grid_for(small.drive, 0.02, method, 2e-3)
    steps = (4.0, 8.0, 16.0, 32.0)
    by_steps = [Integration(soft, small.drive, grid, method, jnp.asarray(k)) for k in steps]
    loads = [np.asarray(loads_of_trials(one, *integration.prepare_batch(one, errors))[0]) for one in by_steps]
    exact = rms(soft, simulate(Simulation(soft, **small.settings), assembly_errors(soft, ERRORS)))
    changes = np.array([np.abs(one[0].T / exact - 1.0).max() for one in loads])
    np.testing.assert_allclose(np.log2(changes[1:-1] / changes[2:]), 2.0, atol=0.3)
    assert changes[-1] < 5e-4


def test_balances_of_a_run(found):
    assert found.status == 0
    assert found.checks.closure_drift < 1e-8
    assert found.checks.momentum_balance_error < 1e-11
    assert found.checks.hinge_moment_error < 1e-4
    assert found.checks.solution_residual < 1e-2
    assert found.checks.energy_balance_error < 1e-3  # of the kinetic energy of a start-up


@pytest.mark.long
def test_reactions_do_not_oscillate_from_step_to_step(small):
    """A smooth drive at rest to motion: second differences of a load fall with the square of the step;
    an oscillation from step to step would keep them."""
    drive = PrescribedRate("A", 20.0, 0.02)
    rough = []
    for h in (5e-4, 2.5e-4):
        run = simulate(
            Simulation(small.model, drive=drive, duration=0.02, method=GeneralisedAlpha(step=h), save_every=h),
            assembly_errors(small.model, ERRORS),
        )
        force = np.asarray(run.loads["C"].force)[4:]
        rough.append(np.abs(np.diff(force, 2, axis=0)).max() / np.abs(force).max())
        assert int(run.status) == 0
    assert rough[1] < 0.45 * rough[0] and rough[1] < 0.1


@pytest.mark.slow
def test_newton_s_method_stops_at_the_tolerance(small):
    """The residual is below the tolerance, but not far below: no further increments are made."""
    loads = {}
    for tolerance in (1e-2, 1e-8):
        method = GeneralisedAlpha(step=1e-3, corrections=9, tolerance=tolerance)
        settings = {**small.settings, "method": method, "save_every": 2e-3}
        run = simulate(Simulation(small.model, **settings), assembly_errors(small.model, ERRORS))
        assert int(run.status) == 0
        assert 1e-4 * tolerance < run.checks.solution_residual <= tolerance
        loads[tolerance] = rms(small.model, run)
    np.testing.assert_allclose(loads[1e-2], loads[1e-8], rtol=0.05)


@pytest.mark.slow
def test_the_first_guess_follows_the_motion(small):
    """What one increment leaves falls with the third power of the step, with the second one if accelerations of joints
    are first taken as they were."""
    drive, residuals = MomentRamp("A", 1.5, 0.1), []
    for h in (2e-3, 1e-3):
        method = GeneralisedAlpha(step=h, corrections=1, tolerance=1e-2)
        run = simulate(
            Simulation(small.model, drive=drive, duration=0.1, method=method, save_every=1e-2),
            assembly_errors(small.model, {"D.delta_x": 5e-3}),
        )
        assert int(run.status) == 0
        residuals.append(float(run.checks.solution_residual))
    assert residuals[0] / residuals[1] == pytest.approx(8.0, abs=1.5)


@pytest.mark.parametrize(("length", "share"), [(1e-3, 1.0), (5e-4, 0.5), (2e-3, 2.0), (3e-3, 0.0), (0.0, 0.0)])
def test_the_first_guess_after_a_step_of_another_length(small, length, share):
    """Joint accelerations change in proportion to the lengths; none where these are unlike, nor in one of length
    zero."""
    model, solver = small.model, GeneralisedAlphaSolver(GeneralisedAlpha(step=1e-3))
    actual, velocity = apply_errors(model, assembly_errors(model)), model.start_coordinates()
    trajectory = start_trajectory(model, State(velocity, velocity))
    conditions = Conditions(
        actual, active_drives(model, small.drive), jnp.asarray(0), stabilisation_of(model, GeneralisedAlpha(step=1e-3))
    )
    now, before = jnp.array([5.0, -2.0, 1.0]), jnp.array([4.0, 2.0, 0.5])
    memory = solver.start(conditions, trajectory)
    present = Coordinates(now, memory.accelerations.elastic)
    memory = memory._replace(accelerations=present, auxiliary=present, earlier=before)
    h = jnp.asarray(length)
    trajectory, memory = solver.formulas.at_new_length(trajectory, memory, jnp.asarray(1e-3), h)
    guess = solver.predict(StepConstants(h, h, jnp.zeros(())), StepStart(conditions, trajectory, memory))
    np.testing.assert_allclose(guess.accelerations.joints, now + share * (now - before), rtol=1e-14)


@pytest.mark.long
def test_derivatives_do_not_grow_from_step_to_step(bent):
    """Few increments for bent links with errors of their lengths: the error of a derivative must not grow from step to
    step (to 1e37 with the iteration matrix of the perfect links)."""
    method = GeneralisedAlpha(step=2.5e-3, tolerance=1e-3)
    derivative = jax.jit(lambda x: jax.jvp(lambda x: bent(x, method), (x,), (1.0,))[1])
    exact = GeneralisedAlpha(step=2.5e-3, corrections=9, tolerance=1e-10)
    values = jax.jit(jax.vmap(lambda x: bent(x, exact)))(jnp.array([0.999, 1.001]))
    difference = float(values[1] - values[0]) / 0.002
    np.testing.assert_allclose(float(derivative(1.0)), difference, rtol=2e-2)


@pytest.mark.long
def test_derivatives_of_a_batch_are_those_of_its_samples():
    """Also where a step's end does not depend on the sample: an open chain without a drive has no drift."""
    pendulum = Mechanism([link("bar", 0.3, 2)], [Joint("A", "base", "bar", angle=0.4)])
    model, method = discretise(pendulum), GeneralisedAlpha(step=1e-3)

    def force(error):
        run = simulate(
            Simulation(model, drive=None, duration=4e-3, method=method, save_every=2e-3),
            assembly_errors(model, {"bar.length": error}),
        )
        return run.metrics.mean_square_force["A"]

    errors, batch = jnp.array([2e-3, 5e-3]), jax.vmap(force)
    expected = jax.jit(jax.vmap(lambda x: jax.jvp(force, (x,), (1.0,))[1]))(errors)
    assert np.all(np.abs(expected) > 0.0)
    forward = jax.jit(lambda x: jax.jvp(batch, (x,), (jnp.ones(2),))[1])(errors)
    reverse = jax.jit(jax.grad(lambda x: jnp.sum(batch(x))))(errors)
    np.testing.assert_allclose(forward, expected, rtol=1e-9)
    np.testing.assert_allclose(reverse, expected, rtol=1e-9)


def test_a_step_that_does_not_converge_says_so(small):
    """One Newton increment in a long step, with a large error, after the jump."""
    method = GeneralisedAlpha(step=5e-3, corrections=1)
    settings = {**small.settings, "method": method, "save_every": 2e-3}
    run = simulate(Simulation(small.model, **settings), assembly_errors(small.model, {"D.delta_x": 0.02}))
    assert STATUS[int(run.status)].name in ("not_converged", "diverged", "drifted")


def test_a_jump_restarts_the_method():
    grid, steps = divide_time(0.5, 1e-3, 1e-2, (0.1, 0.255), restarting=True)
    assert grid.restarts == (11, 28) and steps == 10
    assert np.all(grid.lengths[list(grid.restarts)] == 0.0)
    assert list(grid.phases[[10, 11, 27, 28]]) == [0, 1, 1, 2]
    times = (grid.starts + grid.lengths)[grid.saved]
    assert np.all(np.diff(times) > 0.0) and times[0] == 0.0
    np.testing.assert_allclose(grid.distinct[grid.kinds], grid.lengths, atol=1e-12)
    # With friction the start is a jump, too.
    again, _ = divide_time(0.5, 1e-3, 1e-2, (0.1, 0.255), restarting=True, from_start=True)
    assert again.restarts == (1, 12, 29)
    np.testing.assert_array_equal(again.starts[again.saved], grid.starts[grid.saved])


@pytest.mark.parametrize("rfes", [2, None])
def test_a_mechanism_of_fixed_joints(rfes):
    """No joint has a coordinate: a beam bent by its weight stays as it is, whatever its errors."""
    model = discretise(Mechanism([link("beam", 0.3, rfes)], [Joint("A", "base", "beam", kind="fixed")]))
    tilts = jnp.asarray([0.0, 0.3])
    settings = {"drive": None, "duration": 2e-3, "method": GeneralisedAlpha(step=1e-3), "save_every": 1e-3}

    def weighed(tilt):
        run = simulate(Simulation(model, **settings), assembly_errors(model, {"A.delta_x": tilt}))
        return run.loads["A"].force[-1], run.status

    force, status = jax.jit(jax.vmap(weighed))(tilts)
    weight = 9.81 * 7850.0 * 0.01**2 * 0.3
    np.testing.assert_array_equal(status, 0)
    np.testing.assert_allclose(force[:, 1], weight * np.sin(tilts), rtol=0, atol=1e-9)
    np.testing.assert_allclose(force[:, 2], weight * np.cos(tilts), rtol=0, atol=1e-9)


@pytest.mark.long
def test_auto_takes_the_step_from_the_accuracy(monkeypatch):
    study = load_study(STUDY)
    model = discretise(study.mechanism)
    steps = [choose_method(model, Automatic(accuracy=accuracy), study.drive, 0.5) for accuracy in (1e-2, 1e-3)]
    assert all(method.name == "generalised_alpha" for method in steps)
    assert 1e-3 < steps[0].step < 5e-3 and 3e-4 < steps[1].step < 1.5e-3
    same = Leapfrog(step=1e-6)
    assert choose_method(model, same) is same
    with pytest.raises(InputError, match="`duration` must be given"):
        choose_method(model, Automatic(), study.drive)
    # Where no implicit step is accurate enough, the explicit method at a stable step.
    monkeypatch.setattr("rfem_jax.simulation.accuracy.LAST", 4)
    chosen = choose_method(model, Automatic(accuracy=1e-3), study.drive, 0.5)
    assert chosen.name == "rk4"
    np.testing.assert_allclose(chosen.step, 0.9 * LARGEST_STEP, rtol=0.02)


def test_changes_are_relative_to_the_load_or_to_a_twentieth_of_the_largest():
    one, other = np.array([[[1.0, 100.0]]]), np.array([[[1.5, 101.0]]])
    one, other = (np.concatenate([x, x], axis=1) for x in (one, other))
    np.testing.assert_allclose(estimate_change(one, other, 0.3), 0.5 / (0.05 * 101.0))
    assert estimate_change(np.full_like(one, np.nan), other, 0.3) == np.inf
    one[:, 1], other[:, 1] = [1e-14, 2e-14], [2e-14, 1e-14]
    one[:, 0] = other[:, 0]
    np.testing.assert_allclose(estimate_change(one, other, 0.3), 1e-14 / (0.01 * 0.3 * 101.0))


@pytest.mark.parametrize("save_every", [1e-4, 2e-2, None])
def test_auto_takes_no_step_longer_than_between_saved_times(save_every, monkeypatch):
    study = load_study(STUDY)
    model = discretise(study.mechanism)
    for name, free in (("generalised_alpha", 1e-3), ("rk4", None)):
        monkeypatch.setattr("rfem_jax.simulation.accuracy._longest_step", lambda *_, step=free: step)
        chosen = choose_method(model, Automatic(), study.drive, 0.5, save_every=save_every)
        longest = 1e-3 if free else 0.9 * LARGEST_STEP
        np.testing.assert_allclose(chosen.step, min(longest, save_every or 0.5), rtol=0.02)
        assert chosen.name == name


@pytest.mark.long
def test_auto_on_rigid_links_that_errors_keep_from_closing():
    study = load_study(STUDY)
    links = [replace(link, rigid=True) for link in study.mechanism.links]
    rigid = replace(study.mechanism, links=links, redundant_reactions="minimum_norm")
    model = discretise(rigid)
    chosen = choose_method(model, Automatic(), study.drive, 0.5)
    assert chosen.name == "generalised_alpha" and 1e-4 < chosen.step < 1e-2
    run = simulate(Simulation(model, drive=study.drive, duration=0.5, method=chosen))
    assert STATUS[int(run.status)][0] == "ok"


@pytest.mark.long
def test_a_rigid_mechanism_has_no_longer_steps_than_were_tried(monkeypatch):
    study = load_study(STUDY)
    links = [replace(link, rigid=True) for link in study.mechanism.links]
    model = discretise(replace(study.mechanism, links=links, redundant_reactions="minimum_norm"))
    monkeypatch.setattr("rfem_jax.simulation.accuracy._longest_step", lambda *_: None)
    chosen = choose_method(model, Automatic(), study.drive, 0.5)
    assert chosen.name == "rk4" and 0.98 * 0.5 / 50 / 256 < chosen.step <= 0.5 / 50 / 256
