"""What shakes the frame: the force and the moment on the base against closed forms and the rate of momentum."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rfem_jax import (
    InputError,
    Joint,
    Mechanism,
    Point,
    PointForce,
    PointMoment,
    PointSpring,
    PrescribedRate,
    Problem,
    RungeKutta4,
    Simulation,
    StaticProblem,
    discretise,
    inverse_dynamics,
    kinetostatic_turn,
    simulate,
    static_loads,
)
from tests.derivatives import check_derivatives
from tests.mechanisms import arm, body

RATE, ABOUT = 7.0, (0.1, 0.02, -0.05)
GRAVITY = np.array([0.0, 0.0, -9.81])
METRICS = tuple(f"{kind}_shaking_{load}" for load in ("force", "moment") for kind in ("mean_square", "rms", "max"))


def simulation_of(mechanism, duration=0.3, rate=RATE):
    return Simulation(
        discretise(mechanism), drive=PrescribedRate("A", rate), method=RungeKutta4(step=2e-3), duration=duration,
        save_every=0.01,
    )  # fmt: skip


def arm_alone(times, length, start=0.4):
    """Force of the arm on its base, and its moment about the point, turning steadily about y."""
    angle, mass = start + RATE * times, 7850.0 * 1e-4 * length
    centre = 0.5 * length * np.stack([np.cos(angle), 0.0 * angle, -np.sin(angle)], axis=1)
    force = mass * (RATE**2 * centre + GRAVITY)
    return force, np.cross(centre, mass * GRAVITY) - np.cross(ABOUT, force)


def test_an_arm_that_turns_steadily_pulls_at_its_hinge_and_weighs():
    times, error = np.linspace(0.0, 0.3, 31), 2e-3
    problem = Problem(simulation_of(arm(shaking_point=ABOUT)), (*METRICS, "peak_shaking_force"))
    values, status = problem({"arm.length": error})
    assert int(status) == 0
    for load, exact in zip(("force", "moment"), arm_alone(times, 0.3 + error), strict=True):
        squares = np.sum(exact**2, axis=1)
        mean = np.trapezoid(squares, times) / 0.3
        np.testing.assert_allclose(values[f"mean_square_shaking_{load}"], mean, rtol=1e-6)
        np.testing.assert_allclose(values[f"rms_shaking_{load}"], np.sqrt(mean), rtol=1e-6)
        np.testing.assert_allclose(values[f"max_shaking_{load}"], np.sqrt(squares.max()), rtol=1e-6)
    largest = values["max_shaking_force"]
    assert largest / 31 ** (1 / 16) <= values["peak_shaking_force"] < largest


def shaken(**more):
    """A four-bar of bodies whose centres lie beside their lines, with springs to the base and within, and given
    loads, of which the base feels nothing but what joints carry."""
    bodies = (("crank", 0.4, (0.03, 0.01, 0.02), 0.12), ("coupler", 0.7, (0.2, -0.02, 0.04), 0.3),
              ("rocker", 0.5, (0.1, 0.0, -0.03), 0.25))  # fmt: skip
    links = [body(name, mass, centre, (2e-3, 3e-3, 4e-3), length) for name, mass, centre, length in bodies]
    joints = [
        Joint("A", "base", "crank", angle=-0.4),
        Joint("B", "crank", "coupler", angle=-0.35),
        Joint("D", "base", "rocker", position=(0.32, 0.0, 0.0), angle=-1.5),
        Joint("C", "coupler", "rocker", cut=True),
    ]
    forces = [
        PointSpring("near", ["base", "coupler"], [(0.1, 0.1, 0.5), (0.1, 0.0, 0.02)], 200.0, 3.0, 0.2),
        PointSpring("far", ["rocker", "base"], [(0.2, 0.02, 0.0), (0.5, -0.1, 0.1)], 300.0, 2.0, 0.3),
        PointSpring("within", ["crank", "rocker"], [(0.05, 0.01, 0.02), (0.2, 0.0, 0.01)], 100.0, 1.0, 0.1),
        PointForce("push", "rocker", (0.2, 0.01, 0.0), (3.0, 1.0, -2.0)),
        PointMoment("twist", "coupler", 0.1, (0.5, 0.2, -0.1)),
    ]
    points = [Point(f"{name}_centre", name, centre) for name, _, centre, _ in bodies]
    points += [Point(f"{name}_beside", name, np.add(centre, (0.1, 0.0, 0.0))) for name, _, centre, _ in bodies]
    points.append(Point("pushed", "rocker", (0.2, 0.01, 0.0)))
    settings = {"driven_joint": "A", "redundant_reactions": "minimum_norm", "forces": forces, "points": points}
    return Mechanism(links, joints, **settings | more), bodies


@pytest.mark.long
def test_the_base_carries_the_rate_of_momentum_less_weight_and_given_loads():
    mechanism, bodies = shaken(shaking_point=ABOUT)
    run = jax.tree.map(np.asarray, simulate(simulation_of(mechanism), record="shaking"))
    push, twist = np.array([3.0, 1.0, -2.0]), np.array([0.5, 0.2, -0.1])
    moment = twist + np.cross(run.points["pushed"].position - np.array(ABOUT), push)
    force = np.broadcast_to(push, moment.shape)
    for name, mass, *_ in bodies:
        here, beside = (run.points[f"{name}_{at}"] for at in ("centre", "beside"))
        arm_of, spin = beside.position - here.position, here.angular_velocity
        # Turning in the plane: what the acceleration beside has across the arm is the angular acceleration.
        across = beside.acceleration - here.acceleration - np.cross(spin, np.cross(spin, arm_of))
        turning = np.cross(arm_of, across) / 0.1**2
        rate = mass * (here.acceleration - GRAVITY)
        force = force - rate
        # With principal axes along the link and a spin about y the rest of Euler's equations vanishes.
        moment = moment - 3e-3 * turning - np.cross(here.position - np.array(ABOUT), rate)
    shaking = run.recorded["shaking"]
    np.testing.assert_allclose(shaking.force, force, rtol=0, atol=1e-6 * np.abs(force).max())
    np.testing.assert_allclose(shaking.moment, moment, rtol=0, atol=1e-6 * np.abs(moment).max())
    # The springs at the base have a part in it, and so has the drive.
    at_joints = sum(np.abs(run.loads[name].force).max() for name in "AD")
    assert np.abs(run.forces["near"].force).max() > 1e-2 * at_joints
    assert np.abs(run.motion.drive_moment).max() > 0.1


@pytest.mark.long
def test_derivatives_agree_in_both_modes():
    names = (*METRICS, "peak_shaking_moment")
    problem = Problem(simulation_of(arm(shaking_point=ABOUT), duration=0.1), names)

    def values(errors):
        found, _ = problem({"arm.length": errors[0], "A.delta_x": errors[1]})
        return jnp.stack([found[name] for name in names])

    check_derivatives(values, [4e-4, 3e-3], [1e-5, 1e-5], reverse=1e-9, differences=1e-5, floor=1e-3)


@pytest.mark.long
def test_a_given_motion_shakes_the_base_as_the_simulation_of_it_does():
    mechanism, _ = shaken(shaking_point=ABOUT)
    model, rate = discretise(mechanism), {"A": RATE}
    run = simulate(simulation_of(mechanism, duration=0.1), record="shaking")
    still = inverse_dynamics(model, {"A": -0.4 + RATE * np.asarray(run.times)}, rate, {}, record="shaking")
    for load in ("force", "moment"):
        exact = np.asarray(getattr(run.recorded["shaking"], load))
        found = getattr(still.recorded["shaking"], load)
        np.testing.assert_allclose(found, exact, rtol=0, atol=1e-5 * np.abs(exact).max())


@pytest.mark.long
def test_a_mechanism_at_rest_weighs_on_its_base():
    """At rest the base carries the weight and what is given; it has its moment about the stated point."""
    mechanism, bodies = shaken(shaking_point=ABOUT)
    model, positions = discretise(mechanism), np.array([-0.4, 0.3, 1.2])
    turn = jax.tree.map(np.asarray, kinetostatic_turn(model, {"crank.length": 1e-3}, positions))
    push, twist = np.array([3.0, 1.0, -2.0]), np.array([0.5, 0.2, -0.1])
    moment = twist + np.cross(turn.places["pushed"] - np.array(ABOUT), push)
    for name, mass, *_ in bodies:
        moment = moment + np.cross(turn.places[f"{name}_centre"] - np.array(ABOUT), mass * GRAVITY)
    force = push + sum(mass for _, mass, *_ in bodies) * GRAVITY
    np.testing.assert_allclose(turn.shaking.force, np.broadcast_to(force, (3, 3)), atol=1e-8)
    np.testing.assert_allclose(turn.shaking.moment, moment, atol=1e-8)
    rest = static_loads(model, {"crank.length": 1e-3}, {"A": positions}, record="shaking")
    np.testing.assert_allclose(rest.recorded["shaking"].moment, moment, atol=1e-8)
    assert kinetostatic_turn(discretise(shaken()[0]), positions=positions[:1]).shaking is None


@pytest.mark.long
def test_metrics_at_rest_and_derivatives_of_turns_agree_in_both_modes():
    model = discretise(arm(shaking_point=ABOUT))
    problem = StaticProblem(
        model, ("max_shaking_force", "max_shaking_moment", "peak_shaking_moment"), {"A": [0.2, 1.0]}
    )

    def values(errors):
        wrong = {"arm.length": errors[0], "A.delta_x": errors[1]}
        turn = kinetostatic_turn(model, wrong, np.array([0.2, 1.0]))
        return jnp.concatenate([jnp.stack([*problem(wrong)[0].values()]), turn.shaking.moment.ravel()])

    found = check_derivatives(values, [4e-4, 3e-3], [1e-5, 1e-5], reverse=1e-8, differences=1e-4, floor=1e-3)
    weight, lengths = 7850.0 * 1e-4 * 9.81, 0.3 + 4e-4
    moments = np.linalg.norm(found.values[3:].reshape(2, 3), axis=1)
    values = dict(zip(sorted(one.name for one in problem.metrics), found.values))
    np.testing.assert_allclose(values["max_shaking_force"], weight * lengths, rtol=1e-9)
    np.testing.assert_allclose(values["max_shaking_moment"], moments.max(), rtol=1e-9)
    with pytest.raises(InputError, match="`rms_shaking_force` is of a motion"):
        StaticProblem(model, ("rms_shaking_force",))


def test_a_run_that_is_not_asked_records_nothing():
    run = simulate(simulation_of(arm(), duration=0.02))
    assert "shaking" not in run.recorded


def test_a_point_must_be_three_lengths():
    with pytest.raises(InputError, match="`shaking_point` must have three components"):
        arm(shaking_point=(0.0, 0.0))
    with pytest.raises(InputError, match="`shaking_point`"):
        replace(arm(), shaking_point=("1 N", 0.0, 0.0))
