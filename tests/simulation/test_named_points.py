"""Points that have names already, centres of joints and ends of links, against closed kinematics."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

from rfem_jax import (
    InputError,
    Joint,
    Mechanism,
    Point,
    PointSpring,
    PrescribedRate,
    Problem,
    RungeKutta4,
    Simulation,
    StaticProblem,
    design,
    discretise,
    kinetostatic_turn,
    simulate,
)
from tests.derivatives import check_derivatives
from tests.mechanisms import link
from tests.simulation.test_point_paths import COUPLER, CRANK, GROUND, RATE, START, exact_coupler, four_bar, simulated

ERRORS = {"coupler.length": 4e-4, "B.child.d_x": 3e-4}


def exact_joint(t, longer=0.0, ground=GROUND):
    """Place (2,) in x and z of joint C with a coupler that is longer between its hinges."""
    length = COUPLER + longer
    return exact_coupler(t, coupler=length, place=(length, 0.0, 0.0), ground=ground)[:2]


@pytest.fixture(scope="module")
def run():
    return simulated(four_bar("B", "C", "coupler.end", "coupler.start", "rocker.end"), ERRORS)


@pytest.mark.long
def test_centres_of_joints_are_where_they_meet_and_ends_of_links_where_these_end(run):
    times = jnp.asarray(run.times)
    # The bore at the coupler's start lies within it, which makes the coupler shorter between its hinges.
    at_c = jax.vmap(lambda t: exact_joint(t, 1e-4))(times)
    at_b = CRANK * np.stack([np.cos(START + RATE * times), np.sin(START + RATE * times)], axis=1)
    along = (at_c - at_b) / np.linalg.norm(at_c - at_b, axis=1, keepdims=True)
    exact = {
        "B": at_b, "C": at_c, "coupler.start": at_b - 3e-4 * along, "coupler.end": at_c, "rocker.end": at_c,
    }  # fmt: skip
    assert set(run.points) == set(exact)
    for name, places in exact.items():
        assert_allclose(run.points[name].position[:, [0, 2]], places, atol=1e-9, err_msg=name)
    assert_allclose(run.points["B"].velocity, RATE * np.stack([-at_b[:, 1], 0 * times, at_b[:, 0]], axis=1), atol=1e-9)


def test_a_slide_is_where_its_child_is():
    guide = Joint("C", "base", "slide", kind="prismatic", displacement=0.1, orientation=(0.0, "90 deg", 0.0))
    points = ["C", "slide.end"]
    mechanism = Mechanism([link("slide", 0.05)], [guide], driven_joint="C", gravity=(0.0, 0.0, 0.0), points=points)
    turn = kinetostatic_turn(discretise(mechanism), {"slide.length": 1e-3}, np.array([0.1, 0.3]))
    for name in points:  # x of the joint points down
        assert_allclose(turn.places[name][1] - turn.places[name][0], (0.0, 0.0, -0.2), atol=1e-9)
    away = turn.places["slide.end"] - turn.places["C"]
    assert_allclose(np.linalg.norm(away, axis=1), 0.051, rtol=1e-9)


@pytest.fixture(scope="module")
def problem():
    simulation = Simulation(
        discretise(four_bar()), drive=PrescribedRate("A", -RATE), method=RungeKutta4(step=1e-3), duration=0.3,
        save_every=0.01,
    )  # fmt: skip
    return simulation, Problem(simulation, ("C@0.2s.x", "coupler.end@0.2s.z", "C.rms_deviation", "rocker.end.x"))


@pytest.mark.long
def test_only_what_metrics_name_is_followed(problem):
    simulation, asking = problem
    assert simulation.model.points is None and set(asking.model.points) == {"C", "coupler.end", "rocker.end"}
    assert Problem(simulation, ("A.rms_force",)).model is simulation.model
    assert simulate(simulation).points == {}


@pytest.mark.long
def test_metrics_and_their_derivatives_are_those_of_closed_kinematics(problem):
    _, asking = problem

    def chosen(changes):
        values, _ = asking({"coupler.length": changes[0], "D.position.x": changes[1]})
        return jnp.stack([values[one.name] for one in asking.metrics])

    def exact(changes):
        times = jnp.linspace(0.0, 0.3, 31)
        now, end = exact_joint(0.2, *_moved(changes)), exact_joint(0.3, *_moved(changes))
        away = jax.vmap(lambda t: exact_joint(t, *_moved(changes)) - exact_joint(t))(times)
        squares = jnp.sum(away**2, axis=1)
        mean = jnp.sum(0.5 * (squares[1:] + squares[:-1])) / 30.0
        return jnp.stack([now[0], now[1], jnp.sqrt(mean), end[0]])

    at = np.array([4e-4, -3e-4])
    found = check_derivatives(chosen, at, 1e-5, reverse=1e-7, differences=1e-4, floor=1e-3)
    assert_allclose(found.values, exact(at), rtol=1e-7, atol=1e-9)
    assert_allclose(found.forward, jax.jacfwd(exact)(at), rtol=1e-5, atol=1e-6)


def _moved(changes):
    return changes[0], GROUND + changes[1]


@pytest.mark.long
def test_designs_move_them(problem):
    simulation, _ = problem
    made = design(simulation.model, {"D.position.x": GROUND + 2e-3, "coupler.length": COUPLER + 1e-3})
    simulation = Simulation(
        simulation.model, drive=simulation.drive, method=simulation.method, duration=0.3, save_every=0.01, design=made
    )
    values, status = Problem(simulation, ("C.x", "coupler.end.z", "C.deviation"))({})
    assert int(status) == 0 and values["C.deviation"] == 0.0
    exact = exact_joint(0.3, 1e-3, GROUND + 2e-3)
    assert_allclose([values["C.x"], values["coupler.end.z"]], exact, rtol=1e-7)


@pytest.mark.long
def test_the_end_of_a_flexible_link_has_its_deformation_in_it():
    errors = {"D.d_y": 2e-3, "coupler.length": 3e-4}
    run = simulated(four_bar("coupler.end", "coupler.start", "B", coupler=4), errors, duration=0.02, step=1e-5)
    assert int(run.status) == 0
    assert_allclose(run.points["coupler.end"].position, run.motion.ends["coupler"], atol=1e-14)
    assert np.abs(run.points["coupler.end"].position[:, 1]).max() > 1e-4
    assert_allclose(run.points["coupler.start"].position, run.points["B"].position, atol=1e-14)


@pytest.mark.long
def test_ends_of_a_warm_link_move_apart_at_rest():
    hand = replace(link("hand", 0.3), thermal_expansion=12e-6, temperature=20.0)
    model = discretise(Mechanism([hand], [Joint("A", "base", "hand", angle=0.4)], driven_joint="A"))
    problem = StaticProblem(model, ("hand.end.x", "hand.end.deviation", "A.x"))

    def at(errors):
        values, _ = problem({"hand.temperature": errors[0], "A.d_x": errors[1]})
        return jnp.stack([values[one.name] for one in problem.metrics])

    def exact(errors):
        # The seat at the base moves, and carries the hand with it.
        longer = 0.3 * 12e-6 * errors[0]
        x = 0.3 * (1.0 + 12e-6 * (20.0 + errors[0])) * jnp.cos(0.4) + errors[1]
        away = jnp.hypot(longer * jnp.cos(0.4) + errors[1], longer * jnp.sin(0.4))
        return jnp.stack([x, away, errors[1]])

    errors = np.array([30.0, 1e-4])
    found = check_derivatives(at, errors, np.array([1e-2, 1e-7]), reverse=1e-9, differences=1e-5, floor=1e-3)
    assert_allclose(found.values, exact(errors), rtol=1e-9)
    assert_allclose(found.forward, jax.jacfwd(exact)(errors), rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize(
    ("points", "words"),
    [
        (["cupler.end"], "did you mean `coupler.end`"),
        (["coupler.middle"], "has no such `coupler.middle`"),
        (["B", "B"], "`B` occurs twice"),
        ([3], "names of joints and ends of links, but was"),
    ],
)
def test_names_of_nothing_are_refused(points, words):
    with pytest.raises(InputError, match=words):
        four_bar(*points)


def test_names_are_of_the_joints_and_links_that_there_are():
    mechanism = four_bar("C", "coupler.end")
    turned = [replace(one, parent="rocker", child="coupler") if one.cut else one for one in mechanism.joints]
    assert [point.link for point in replace(mechanism, joints=turned).points] == ["coupler", "coupler"]
    with pytest.raises(InputError, match="has no such `C`"):
        replace(mechanism, joints=mechanism.joints[:-1])


def test_a_joint_and_a_force_of_one_name_are_not_told_apart():
    spring = PointSpring("B", ("crank", "rocker"), (0.05, 0.05), stiffness=10.0, free_length=0.1)
    with pytest.raises(InputError, match="there is a force `B`, too.*rename the force"):
        four_bar("B", forces=[spring])


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("E.max_deviation", "name a joint or an end of a link, as `B` and `coupler.end`"),
        ("coupler.ende.x", "`coupler.ende.x` is of a point and it has none of this name"),
        ("B@0.1s.max_deviation", "of the whole path"),
    ],
)
def test_metrics_of_points_that_are_not_there_are_refused(problem, name, words):
    with pytest.raises(InputError, match=words):
        Problem(problem[0], (name,))


@pytest.mark.long
def test_all_points_are_those_that_the_mechanism_names():
    model = discretise(four_bar("B", Point("P", "coupler", 0.1)))
    simulation = Simulation(model, drive=PrescribedRate("A", -RATE), method=RungeKutta4(step=1e-3), duration=0.1)
    assert [one.name for one in Problem(simulation, ("P.x", "B.x")).metrics] == ["P.x", "B.x"]
