"""Joints with clearance in motion: single impacts against closed forms, the slider-crank of independent programs before
its impacts become chaotic, a pin that stays pressed.

The reference of the slider-crank was integrated for this project by DOP853 and RK45 with contact steps of 2e-6 s; a new
contact begins where the penetration passes zero upwards.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import brentq

from rfem_jax import (
    STATUS,
    Clearance,
    Coordinates,
    Joint,
    Link,
    Mechanism,
    Method,
    MomentRamp,
    PrescribedRate,
    RigidBody,
    State,
    design,
    discretise,
    simulate,
)

COMPILED_AS_SHIPPED = True  # thousands of steps, and derivatives of stiff contacts

MASS, SPEED, RADIAL, STIFFNESS = 0.5, 0.3, 2e-4, 106153846154.0
GUIDED = Clearance(
    radial=RADIAL, length=0.02, stiffness=STIFFNESS / 2.0, axial=1e-3, axial_stiffness=1e7, axial_exponent=1.0
)


def body(name, mass, centre=0.0, inertia=(1e-4, 2.5e-4, 2.5e-4), length=0.1):
    return Link(name, length, body=RigidBody(mass, (centre, 0.0, 0.0), inertia))


def guided(**losses):
    """A pin on a guide through the middle of a fixed bush."""
    joints = [
        Joint("G", "base", "pin", kind="prismatic"),
        Joint("P", "base", "pin", position=(0, 0, 0), child_position=(0, 0, 0), cut=True,
              clearance=dataclasses.replace(GUIDED, **losses)),
    ]  # fmt: skip
    return discretise(Mechanism([body("pin", MASS)], joints, gravity=(0.0, 0.0, 0.0), driven_joint="G"))


def thrown(model, speed=SPEED):
    return State(model.start_coordinates(), Coordinates(jnp.asarray(speed)[None], jnp.zeros((6, 0))))


def rebound_of(chi, speed=SPEED):
    """Speed after an impact (theory (15.5))."""
    found: float = brentq(lambda v: chi * (speed + v) - np.log((1 + chi * speed) / (1 - chi * v)), 1e-6, speed)  # pyright: ignore[reportAssignmentType] # no full output
    return found


def deepest_of(chi, speed=SPEED):
    energy = MASS / chi * (speed - np.log(1 + chi * speed) / chi)
    return (2.5 * energy / STIFFNESS) ** 0.4


def speed_at_the_end(run):
    return np.sqrt(2.0 * float(run.energy.kinetic[-1]) / MASS)


class TestSingleImpact:
    def test_with_restitution_by_the_implicit_method(self):
        model = guided(restitution=0.9)
        run = simulate(model, drive=None, duration=8.2e-4, method=Method("generalised_alpha", step=4e-7),
                       save_every=2e-6, start=thrown(model))  # fmt: skip
        assert int(run.status) == 0
        np.testing.assert_allclose(speed_at_the_end(run), 0.273953003342, rtol=1e-5)
        np.testing.assert_allclose(run.metrics.max_normal_force["P"], 4368.88018678, rtol=5e-5)
        lost = float(run.energy.kinetic[0] - run.energy.kinetic[-1])
        np.testing.assert_allclose(run.energy.dissipation[-1], lost, rtol=3e-5)
        depth = np.asarray(run.contacts["P"].penetration)[:, 0]
        closed = np.asarray(run.times)[depth > 0.0]
        assert closed[0] == pytest.approx(RADIAL / SPEED, abs=2e-6)
        assert closed[-1] - closed[0] == pytest.approx(1.218e-4, abs=4e-6)
        np.testing.assert_allclose(depth.max(), 1.1859753346e-05, rtol=2e-3)

    @pytest.mark.parametrize("damping", [0.475])
    def test_with_fixed_chi_by_an_adaptive_explicit_method(self, damping):
        model = guided(damping=damping)
        run = simulate(model, drive=None, duration=8.2e-4, method=Method("dopri8", rtol=1e-10, atol=1e-12),
                       save_every=2e-6, start=thrown(model))  # fmt: skip
        assert int(run.status) == 0
        np.testing.assert_allclose(speed_at_the_end(run), rebound_of(damping), rtol=1e-8)
        np.testing.assert_allclose(np.max(run.contacts["P"].penetration), deepest_of(damping), rtol=2e-3)
        lost = float(run.energy.kinetic[0] - run.energy.kinetic[-1])
        np.testing.assert_allclose(run.energy.dissipation[-1], lost, rtol=1e-6)
        assert float(run.energy_balance_error) < 1e-8

    def test_an_impact_that_the_steps_do_not_follow_is_named_and_spoils_no_other(self):
        """Steps of half a contact lose a tenth of the speed; a slower pin has not touched the bush yet."""
        model, duration = guided(restitution=0.9), 8.2e-4
        method = Method("generalised_alpha", step=duration / 12)

        def of_speed(speed):
            run = simulate(model, drive=None, duration=duration, method=method, save_every=duration,
                           start=thrown(model, speed))  # fmt: skip
            return run.status, run.energy.kinetic[-1], run.energy_balance_error

        statuses, kinetic, balances = jax.jit(jax.vmap(of_speed))(jnp.array([SPEED, 0.2]))
        assert [STATUS[int(one)].name for one in statuses] == ["contact_not_resolved", "ok"]
        assert np.sqrt(2.0 * float(kinetic[0]) / MASS) < 0.95 * 0.273953003342 and float(balances[0]) > 0.05
        np.testing.assert_allclose(kinetic[1], 0.5 * MASS * 0.2**2, rtol=1e-8)  # the weak spring centres the pin

    def test_restitution_needs_a_method_with_a_memory(self):
        model = guided(restitution=0.9)
        with pytest.raises(ValueError, match='`method` must be "generalised_alpha" with `restitution`'):
            simulate(model, drive=None, duration=1e-4, method=Method("rk4", step=1e-6), start=thrown(model))


IMPACTS = (  # start [s], peak force [N]
    (2.27287117707e-4, 45874.5123041),
    (6.37681655137e-4, 20983.4487424),
    (7.50263729244e-4, 25904.0162874),
)


def slider_crank():
    """Rigid, with play at the wrist pin, at 5000 rpm: pin and bush concentric, rates of the ideal mechanism."""
    rate, stiffness = 523.598775598, 66101983979.0
    play = Clearance(radial=5e-4, length=0.02, stiffness=stiffness / 2.0, restitution=0.9, axial=1e-3,
                     axial_stiffness=1e7, axial_exponent=1.0, pin="parent")  # fmt: skip
    links = [body("crank", 0.1, length=0.05), body("rod", 0.21, 0.06, length=0.12), body("slider", 0.14, length=0.05)]
    joints = [
        Joint("A", "base", "crank"),
        Joint("B", "crank", "rod"),
        Joint("G", "base", "slider", kind="prismatic", displacement=0.17),
        Joint("C", "rod", "slider", child_position=(0, 0, 0), cut=True, clearance=play),
    ]
    model = discretise(Mechanism(links, joints, driven_joint="A"))
    rates = {"A": rate, "B": -rate * 0.05 / 0.12 - rate, "G": 0.0}
    order = model.topology.joints[: model.topology.n_links]
    start = State(model.start_coordinates(), Coordinates(jnp.array([rates[j] for j in order]), jnp.zeros((6, 0))))
    return model, PrescribedRate("A", rate), start


def test_first_impacts_of_a_slider_crank():
    model, drive, start = slider_crank()
    run = simulate(model, drive=drive, duration=8.2e-4, method=Method("generalised_alpha", step=4e-7),
                   save_every=8e-7, start=start)  # fmt: skip
    assert int(run.status) == 0
    times, depth = np.asarray(run.times), np.asarray(run.contacts["C"].penetration)[:, 0]
    force = np.linalg.norm(run.loads["C"].force, axis=1)
    begins = np.flatnonzero((depth[1:] > 0.0) & (depth[:-1] <= 0.0)) + 1
    assert len(begins) == len(IMPACTS)
    for n, (begin, end) in enumerate(zip(begins, [*begins[1:], len(times)])):
        share = depth[begin] / (depth[begin] - depth[begin - 1])
        began = times[begin] - share * (times[begin] - times[begin - 1])
        assert began == pytest.approx(IMPACTS[n][0], abs=1e-7)
        assert force[begin:end].max() == pytest.approx(IMPACTS[n][1], rel=1e-3)


def pendulum(clearance):
    return Mechanism([body("arm", 2.0, 0.2, length=0.3)], [Joint("D", "base", "arm", clearance=clearance)],
                     driven_joint="D", gravity=(9.81, 0.0, 0.0))  # fmt: skip


@pytest.fixture(scope="module")
def pressed():
    """A heavy pendulum that hangs at rest, its pin pressed into its bush."""
    return discretise(pendulum(Clearance(radial=1e-4, length=0.02, stiffness=2e7, exponent=1.0, damping=300.0)))


def swing(model, duration=0.02, **settings):
    """Under a moment that grows."""
    method = Method("generalised_alpha", step=1e-4, corrections=20)
    return simulate(model, drive=MomentRamp("D", 0.4, 0.02), duration=duration, method=method, save_every=5e-4,
                    **settings)  # fmt: skip


def test_a_pressed_pin_moves_as_an_ideal_hinge(pressed):
    run, ideal = swing(pressed), swing(discretise(pendulum(None)))
    assert int(run.status) == 0
    assert (np.asarray(run.contacts["D"].penetration)[:, :2] > 0.0).all()
    np.testing.assert_allclose(run.metrics.rms_force["D"], ideal.metrics.rms_force["D"], rtol=5e-3)
    assert float(run.momentum_balance_error) < 1e-7 and float(run.hinge_moment_error) < 1e-5


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
