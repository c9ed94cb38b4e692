"""Joints with clearance in motion: impacts that the steps do not follow, a pin that stays pressed.

`validation.impacts` has the impacts that are compared with closed forms and with independent programs; the tests of
validation check them.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rfem_jax import (
    STATUS,
    Automatic,
    Clearance,
    Explicit,
    GeneralisedAlpha,
    Joint,
    Mechanism,
    MomentRamp,
    Problem,
    RungeKutta4,
    Simulation,
    choose_method,
    design,
    discretise,
    simulate,
)
from rfem_jax.simulation.solvers import contact_steps
from rfem_jax.tolerancing.problems.linearisation import choose_mode
from rfem_jax.validation.impacts import FAST, MASS, REFERENCE, SPEED, guided, rebound_of, slider_crank, thrown
from rfem_jax.validation.rigid_links import body


class TestSingleImpact:
    @pytest.mark.long
    @pytest.mark.parametrize(("steps", "status"), [(12, "contact_not_resolved"), (28, "ok")])
    def test_an_impact_that_the_steps_do_not_follow_is_named_and_spoils_no_other(self, steps, status):
        """Steps of half a contact lose a tenth of the speed, those of a fifth less than a hundredth; a slower pin has
        not touched the bush yet."""
        model, duration = guided(restitution=0.9), 8.2e-4
        method = GeneralisedAlpha(step=duration / steps, contact_tolerance=0)

        def of_speed(speed):
            run = simulate(
                Simulation(
                    model, drive=None, duration=duration, method=method, save_every=duration, start=thrown(model, speed)
                )
            )
            return run.status, run.energy.kinetic[-1], run.checks.energy_balance_error

        statuses, kinetic, balances = jax.jit(jax.vmap(of_speed))(jnp.array([SPEED, 0.2]))
        assert [STATUS[int(one)].name for one in statuses] == [status, "ok"]
        away = abs(np.sqrt(2.0 * float(kinetic[0]) / MASS) / REFERENCE["rebound_speed"] - 1.0)
        assert (away < 0.01, float(balances[0]) < 0.03) == (status == "ok",) * 2
        np.testing.assert_allclose(kinetic[1], 0.5 * MASS * 0.2**2, rtol=1e-8)  # the weak spring centres the pin

    @pytest.mark.long
    def test_steps_that_follow_contact_resolve_an_impact_within_one_of_them(self):
        """Any step gives the rebound; of a batch one sample hits, one hits later, one touches nothing."""
        model, duration = guided(restitution=0.9), 8.2e-4
        method = GeneralisedAlpha(step=duration)

        def of_speed(speed):
            run = simulate(
                Simulation(
                    model, drive=None, duration=duration, method=method, save_every=duration, start=thrown(model, speed)
                )
            )
            return (
                run.status,
                run.energy.kinetic[-1],
                run.checks.energy_balance_error,
                run.contact_changes,
                (run.contact_losses["P"], run.energy.dissipation),
            )

        speeds = jnp.array([SPEED, 0.29, 0.2])
        statuses, kinetic, balances, changes, energies = jax.jit(jax.vmap(of_speed))(speeds)
        losses, dissipation = map(np.asarray, energies)
        assert not np.asarray(statuses).any()
        np.testing.assert_array_equal(changes, [4.0, 4.0, 0.0])  # both ends close and open
        after = np.sqrt(2.0 * np.asarray(kinetic) / MASS)
        np.testing.assert_allclose(after[0], REFERENCE["rebound_speed"], rtol=1e-3)
        np.testing.assert_allclose(after[1] / 0.29, REFERENCE["rebound_speed"] / SPEED, rtol=2e-3)  # theory (15.5)
        np.testing.assert_allclose(after[2], 0.2, rtol=1e-8)
        assert np.max(balances) < 5e-3
        np.testing.assert_array_equal(losses[:, -1], dissipation[:, -1])  # nothing else loses energy
        assert losses[0, -1] > 0.0 == losses[2, -1]
        alone = jax.jit(of_speed)(speeds[1])
        np.testing.assert_allclose(kinetic[1], alone[1], rtol=1e-9)

    @pytest.mark.slow
    def test_a_step_that_is_tried_too_often_is_told(self, monkeypatch):
        monkeypatch.setattr(contact_steps, "MOST_TRIALS", 3)
        model, duration = guided(restitution=0.9), 8.1e-4
        method = GeneralisedAlpha(step=duration)
        run = simulate(
            Simulation(model, drive=None, duration=duration, method=method, save_every=duration, start=thrown(model))
        )
        assert STATUS[int(run.status)].name == "steps_exhausted"

    @pytest.mark.long
    def test_no_step_is_chosen_where_impacts_are_chaotic(self):
        model, drive, _ = slider_crank(FAST)
        with pytest.raises(ValueError, match="after a few impacts motion is chaotic"):
            choose_method(model, Automatic(), drive, 0.008)

    @pytest.mark.long
    def test_adaptive_steps_follow_contacts_of_every_sample(self):
        """One sample has struck and left, one is in contact, one touches nothing."""
        model, duration = guided(damping=0.475), 8.2e-4
        method = Explicit("dopri8", rtol=1e-8, atol=1e-10)

        def of_speed(speed):
            run = simulate(
                Simulation(
                    model,
                    drive=None,
                    duration=duration,
                    method=method,
                    save_every=duration / 2,
                    start=thrown(model, speed),
                )
            )
            return run.status, run.energy.kinetic[-1], run.contacts["P"].penetration[-1, 0]

        speeds = jnp.array([SPEED, 0.28, 0.2])
        statuses, kinetic, depths = jax.jit(jax.vmap(of_speed))(speeds)
        assert not np.asarray(statuses).any()
        np.testing.assert_array_equal(np.asarray(depths) > 0.0, [False, True, False])
        np.testing.assert_allclose(np.sqrt(2.0 * kinetic[0] / MASS), rebound_of(0.475), rtol=1e-6)
        alone = [float(jax.jit(of_speed)(speed)[1]) for speed in speeds[1:]]
        np.testing.assert_allclose(kinetic[1:], alone, rtol=1e-6)

    @pytest.mark.long
    def test_smaller_contact_tolerances_are_more_accurate(self):
        model, duration = guided(restitution=0.9), 8.2e-4

        def error(tolerance):
            method = GeneralisedAlpha(step=duration, contact_tolerance=tolerance)
            run = simulate(
                Simulation(
                    model, drive=None, duration=duration, method=method, save_every=duration, start=thrown(model)
                )
            )
            return abs(float(run.metrics.max_normal_force["P"]) / REFERENCE["impact_peak_force"] - 1.0)

        coarse, fine = error(0.2), error(2e-3)
        assert fine < 1e-3 < coarse < 0.1

    def test_restitution_needs_a_method_with_a_memory(self):
        model = guided(restitution=0.9)
        with pytest.raises(ValueError, match='`method` must be "generalised_alpha" with `restitution`'):
            simulate(Simulation(model, drive=None, duration=1e-4, method=RungeKutta4(step=1e-6), start=thrown(model)))


def pendulum(clearance):
    arm, joint = (
        body("arm", 0.3, 2.0, (0.2, 0, 0), (1e-4, 2.5e-4, 2.5e-4)),
        Joint("D", "base", "arm", clearance=clearance),
    )
    return Mechanism([arm], [joint], driven_joint="D", gravity=(9.81, 0.0, 0.0))


@pytest.fixture(scope="module")
def pressed():
    """A heavy pendulum that hangs at rest, its pin pressed into its bush."""
    return discretise(pendulum(Clearance(radial=1e-4, length=0.02, stiffness=2e7, exponent=1.0, damping=300.0)))


def swing(model, duration=0.02, contact_tolerance=0.02, **settings):
    """Under a moment that grows."""
    method = GeneralisedAlpha(step=1e-4, corrections=20, contact_tolerance=contact_tolerance)
    return simulate(
        Simulation(
            model, drive=MomentRamp("D", 0.4, 0.02), duration=duration, method=method, save_every=5e-4, **settings
        )
    )


@pytest.mark.long
def test_a_pressed_pin_moves_as_an_ideal_hinge(pressed):
    run, ideal = swing(pressed), swing(discretise(pendulum(None)))
    assert int(run.status) == 0
    assert (np.asarray(run.contacts["D"].penetration)[:, :2] > 0.0).all()
    assert float(run.contact_changes) == 0.0
    np.testing.assert_allclose(run.metrics.rms_force["D"], ideal.metrics.rms_force["D"], rtol=5e-3)
    assert float(run.checks.momentum_balance_error) < 1e-7 and float(run.checks.hinge_moment_error) < 1e-5


@pytest.mark.long
def test_derivatives_of_continuous_contact(pressed):
    def mean_square(values):
        wanted = design(pressed, {"D.clearance.radial": values[0], "D.clearance.stiffness": values[1]})
        return swing(pressed, duration=5e-3, design=wanted).metrics.mean_square_force["D"]

    at = jnp.array([1e-4, 2e7])
    forward = jax.jacfwd(mean_square)(at)
    for n, size in enumerate((1e-8, 2e3)):
        step = size * np.eye(2)[n]
        difference = (mean_square(at + step) - mean_square(at - step)) / (2 * size)
        np.testing.assert_allclose(forward[n], difference, rtol=1e-5)


@pytest.mark.long
def test_reverse_mode_through_whole_steps_with_contact(pressed):
    def mean_square(values):
        wanted = design(pressed, {"D.clearance.radial": values[0], "D.clearance.stiffness": values[1]})
        return swing(pressed, duration=1e-3, design=wanted, contact_tolerance=0.0).metrics.mean_square_force["D"]

    at = jnp.array([1e-4, 2e7])
    np.testing.assert_allclose(jax.grad(mean_square)(at), jax.jacfwd(mean_square)(at), rtol=1e-9)


def test_a_problem_that_follows_contact_is_differentiated_forwards(pressed):
    def problem(tolerance, *metrics):
        method = GeneralisedAlpha(step=1e-4, contact_tolerance=tolerance)
        return Problem(
            Simulation(pressed, drive=MomentRamp("D", 0.4, 0.02), duration=1e-3, method=method),
            metrics or "D.rms_force",
        )

    assert choose_mode("auto", 100, 1, problem(0.02)) == "forward"
    assert choose_mode("auto", 100, 1, problem(0.0)) == "reverse"
    with pytest.raises(ValueError, match="contact_tolerance = 0"):
        choose_mode("reverse", 100, 1, problem(0.02))
    finer = problem(0.02).refined()
    assert (finer.strikes, finer.method.step, finer.method.contact_tolerance) == (True, 5e-5, 0.005)
    # No step has a part in the start at rest.
    assert not problem(0.02, "D.preload_force_square").strikes
    assert problem(0.02, "D.preload_force_square", "D.rms_force").strikes


class Accelerations(NamedTuple):
    """What `for_length` takes of a memory."""

    accelerations: jax.Array
    auxiliary: jax.Array


def test_accelerations_of_the_method_move_with_the_length_unless_they_vibrate():
    """A smooth change, one that the bound cuts off, one as large as the acceleration itself, and one from zero."""
    present, away = jnp.array([10.0, -10.0, 5.0, 0.0]), jnp.array([0.2, -0.8, 6.0, -1.0])

    def moved(length, before):
        found = contact_steps.for_length(Accelerations(present, present + away), jnp.array(length), jnp.array(before))
        return found.auxiliary - present

    np.testing.assert_allclose(moved(2e-5, 1e-5), [0.4, -1.0, 6.0, -1.0], rtol=1e-12)
    np.testing.assert_allclose(moved(1e-5, 4e-5), 0.25 * np.asarray(away), rtol=1e-12)
    np.testing.assert_allclose(moved(1e-5, 0.0), away, rtol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize(("length", "before", "share"), [(1e-5, 1e-5, 1.0), (1e-5, 4e-5, 0.25), (2e-5, 1e-5, 1.0)])
def test_derivatives_of_accelerations_that_are_zero(length, before, share):
    """As those of motions out of plane without errors, which may be vibrations: they do not grow with the length."""

    def auxiliary(values):
        memory = Accelerations(jnp.zeros(1), values)
        return contact_steps.for_length(memory, jnp.array(length), jnp.array(before)).auxiliary

    for mode in (jax.jacfwd, jax.jacrev):
        np.testing.assert_allclose(jax.jit(mode(auxiliary))(jnp.zeros(1)), [[share]], rtol=1e-12)
