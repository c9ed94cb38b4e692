"""Paths of points against closed kinematics: coupler curves, relative motion, deformed links, and metrics of them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

from rfem_jax import (
    InputError,
    Joint,
    Mechanism,
    MomentTable,
    Point,
    PrescribedRate,
    Problem,
    RungeKutta4,
    Simulation,
    design,
    discretise,
    kinetostatic_turn,
    sensitivity,
    simulate,
)
from rfem_jax.description.metrics.path_metrics import path_instant
from tests.derivatives import check_derivatives
from tests.evaluation import evaluated
from tests.mechanisms import link

CRANK, COUPLER, ROCKER, GROUND = 0.12, 0.3, 0.25, 0.32
RATE, START = 9.0, 0.4
PLACE = (0.12, 0.0, 0.07)


def four_bar(*points, coupler=None, **more):
    """A crank-rocker driven at a constant rate, rigid but for the coupler's rfes; its base hinges are in one plane."""
    links = [link("crank", CRANK), link("coupler", COUPLER, coupler), link("rocker", ROCKER)]
    joints = [
        Joint("A", "base", "crank", angle=-START),
        Joint("B", "crank", "coupler", angle=-0.35),
        Joint("D", "base", "rocker", position=(GROUND, 0.0, 0.0), angle=-1.5),
        Joint("C", "coupler", "rocker", cut=True),
    ]
    settings = {"redundant_reactions": "minimum_norm", "driven_joint": "A"} | more
    return Mechanism(links, joints, points=points, **settings)


def exact_coupler(t, crank=CRANK, coupler=COUPLER, rocker=ROCKER, ground=GROUND, place=PLACE, rate=RATE):
    """Place (2,) in x and z of a point of the coupler, and the coupler's slope, from the circles about B and D."""
    a = START + rate * t
    bx, bz = crank * jnp.cos(a), crank * jnp.sin(a)
    dx, dz = ground - bx, -bz
    d = jnp.sqrt(dx**2 + dz**2)
    along = (coupler**2 - rocker**2 + d**2) / (2.0 * d)
    slope = jnp.arctan2(dz, dx) + jnp.arccos(along / coupler)
    x, z = place[0], place[2]
    return jnp.stack([
        bx + x * jnp.cos(slope) - z * jnp.sin(slope), bz + x * jnp.sin(slope) + z * jnp.cos(slope), slope,
    ])  # fmt: skip


def simulated(mechanism, errors=None, record=(), duration=0.3, step=1e-3, save_every=0.02, rate=RATE):
    simulation = Simulation(
        discretise(mechanism), drive=PrescribedRate("A", -rate), method=RungeKutta4(step=step), duration=duration,
        save_every=save_every,
    )  # fmt: skip
    return simulate(simulation, errors, record=record)


@pytest.fixture(scope="module")
def run():
    return simulated(
        four_bar(
            Point("P", "coupler", PLACE), Point("Q", "coupler", PLACE, "crank"), Point("R", "coupler", PLACE, "rocker")
        )
    )


@pytest.mark.long
def test_a_coupler_curve_has_its_closed_kinematics(run):
    exact, rates, seconds = with_derivatives(exact_coupler, run.times)
    path = run.points["P"]
    assert_allclose(path.position[:, [0, 2]], exact[:, :2], atol=1e-9)
    assert_allclose(path.velocity[:, [0, 2]], rates[:, :2], atol=1e-7)
    assert_allclose(path.acceleration[:, [0, 2]], seconds[:, :2], atol=1e-5)
    # Turning from x to z is turning about -y.
    assert_allclose(path.angles[:, 1], -exact[:, 2], atol=1e-8)
    assert_allclose(path.angular_velocity[:, 1], -rates[:, 2], atol=1e-7)
    assert_allclose(path.position[:, 1], 0.0, atol=1e-12)


def with_derivatives(place, times):
    """A function of time, its first and its second derivative, at times."""
    slope = jax.jacfwd(place)
    return evaluated(jax.vmap(lambda t: (place(t), slope(t), jax.jacfwd(slope)(t))))(jnp.asarray(times))


def frame_of(link, t):
    """Origin (2,) in x and z and slope of the crank or the rocker."""
    a = START + RATE * t
    if link == "crank":
        return jnp.zeros(2), a
    slope = exact_coupler(t)[2]
    x = CRANK * jnp.cos(a) + COUPLER * jnp.cos(slope) - GROUND
    z = CRANK * jnp.sin(a) + COUPLER * jnp.sin(slope)
    return jnp.array([GROUND, 0.0]), jnp.arctan2(z, x)


@pytest.mark.parametrize(("point", "link"), [("Q", "crank"), ("R", "rocker")])
def test_a_path_seen_from_a_link_is_that_of_its_frame(run, point, link):
    def seen(t):
        x, z, slope = exact_coupler(t)
        (x0, z0), a = frame_of(link, t)
        x, z = x - x0, z - z0
        return jnp.stack([x * jnp.cos(a) + z * jnp.sin(a), z * jnp.cos(a) - x * jnp.sin(a), slope - a])

    path, others = run.points[point], with_derivatives(seen, run.times)
    for values, exact, within in zip((path.position, path.velocity, path.acceleration), others, (1e-9, 1e-7, 1e-5)):
        assert_allclose(values[:, [0, 2]], exact[:, :2], atol=within)
    assert_allclose(path.angles[:, 1], -others[0][:, 2], atol=1e-8)
    assert_allclose(path.angular_velocity[:, 1], -others[1][:, 2], atol=1e-7)


def exact_with_error(t, change):
    """The point with a coupler that is longer by a change [m], on which places stretch along it."""
    stretched = (PLACE[0] * (1.0 + change / COUPLER), 0.0, PLACE[2])
    return exact_coupler(t, coupler=COUPLER + change, place=stretched)


METRICS = (
    "P.x", "P.z", "P@0.1337s.x", "P@-60deg.x", "P@-60deg.deviation_x", "P@-60deg.deviation_z", "P@0.1337s.angle_y",
    "P@0.1337s.angle_deviation_y", "P.deviation", "P.rms_deviation", "P.max_deviation", "P.rms_deviation_along",
    "P.rms_deviation_across", "P.rms_deviation_out_of_plane", "P.rms_angle_deviation", "P.max_angle_deviation",
    "P.mean_square_deviation", "P.y", "P.max_speed", "P.max_acceleration",
)  # fmt: skip


@pytest.fixture(scope="module")
def problem():
    simulation = Simulation(
        discretise(four_bar(Point("P", "coupler", PLACE))), drive=PrescribedRate("A", -RATE),
        method=RungeKutta4(step=1e-3), duration=0.3, save_every=0.005,
    )  # fmt: skip
    return Problem(simulation, METRICS)


def exact_metrics(change):
    """What the metrics are by closed kinematics, by their names."""
    times = jnp.linspace(0.0, 0.3, 61)
    real, perfect = (jax.vmap(lambda t, c=c: exact_with_error(t, c))(times) for c in (change, 0.0))
    speed = jax.vmap(jax.jacfwd(lambda t: exact_with_error(t, 0.0)[:2]))(times)
    speed = speed / jnp.linalg.norm(speed, axis=1, keepdims=True)
    away = real - perfect
    parts = jnp.sum(away[:, :2] * speed, axis=1), away[:, 0] * speed[:, 1] - away[:, 1] * speed[:, 0]

    def rms(values):
        return jnp.sqrt(jnp.sum(0.5 * (values[1:] ** 2 + values[:-1] ** 2)) / 60.0)

    at_angle, at_time = (np.radians(60.0) - START) / RATE, 0.1337
    now, before = (exact_with_error(at_angle, c) for c in (change, 0.0))
    rates = jax.vmap(jax.jacfwd(lambda t: exact_with_error(t, change)[:2]))(times)
    seconds = jax.vmap(jax.jacfwd(jax.jacfwd(lambda t: exact_with_error(t, change)[:2])))(times)
    size = jnp.linalg.norm(away[:, :2], axis=1)
    return {
        "P.x": real[-1, 0], "P.y": 0.0, "P.z": real[-1, 1], "P@-60deg.x": now[0],
        "P@0.1337s.x": exact_with_error(at_time, change)[0],
        "P@-60deg.deviation_x": now[0] - before[0], "P@-60deg.deviation_z": now[1] - before[1],
        "P@0.1337s.angle_y": -exact_with_error(at_time, change)[2],
        "P@0.1337s.angle_deviation_y": exact_with_error(at_time, 0.0)[2] - exact_with_error(at_time, change)[2],
        "P.deviation": size[-1], "P.rms_deviation": rms(size), "P.max_deviation": jnp.max(size),
        "P.mean_square_deviation": rms(size) ** 2,
        "P.rms_deviation_along": rms(parts[0]), "P.rms_deviation_across": rms(parts[1]),
        "P.rms_deviation_out_of_plane": 0.0,
        "P.rms_angle_deviation": rms(away[:, 2]), "P.max_angle_deviation": jnp.max(jnp.abs(away[:, 2])),
        "P.max_speed": jnp.max(jnp.linalg.norm(rates, axis=1)),
        "P.max_acceleration": jnp.max(jnp.linalg.norm(seconds, axis=1)),
    }  # fmt: skip


@pytest.mark.long
def test_metrics_of_a_path_are_those_of_closed_kinematics(problem):
    change = 4e-4
    values, status = problem({"coupler.length": change})
    assert int(status) == 0
    for name, exact in evaluated(exact_metrics)(change).items():
        # Between saved times, 5 ms apart, paths are cubics.
        assert_allclose(values[name], exact, rtol=2e-6, atol=2e-8 if "acceleration" not in name else 1e-4, err_msg=name)


@pytest.mark.long
def test_derivatives_of_position_errors_are_those_of_closed_kinematics(problem):
    names = ["P@-60deg.deviation_x", "P@-60deg.x", "P.rms_deviation", "P.rms_deviation_across"]
    names += ["P.rms_angle_deviation", "P.max_deviation"]

    def chosen(change):
        values, _ = problem({"coupler.length": change[0]})
        return jnp.stack([values[name] for name in names])

    # At zero error a deviation has a kink, where it is said to have the derivative zero; components have none.
    slopes, changes = evaluated(jax.jacfwd(chosen)), (4e-4, 0.0)
    forward, none = (slopes(jnp.array([change]))[:, 0] for change in changes)
    of_exact = evaluated(jax.jacfwd(lambda change: jnp.stack([exact_metrics(change)[name] for name in names])))
    exact, at_none = map(of_exact, changes)
    assert_allclose(forward, exact, rtol=1e-4, atol=1e-6)
    assert np.isfinite(none).all()
    component = names.index("P@-60deg.deviation_x")
    assert_allclose(none[component], at_none[component], rtol=1e-5)
    assert none[names.index("P.rms_deviation")] == 0.0


@pytest.mark.long
def test_derivatives_of_paths_agree_in_both_modes():
    mechanism = Mechanism(
        [link("arm", 0.3)], [Joint("A", "base", "arm", angle=0.2)], driven_joint="A",
        points=[Point("P", "arm", (0.25, 0.01, 0.02))],
    )  # fmt: skip
    simulation = Simulation(
        discretise(mechanism), drive=PrescribedRate("A", 9.0), method=RungeKutta4(step=1e-3), duration=0.1,
        save_every=0.01,
    )  # fmt: skip
    names = ("P@0.035s.x", "P@30deg.deviation_z", "P.rms_deviation", "P.rms_deviation_out_of_plane",
             "P.max_angle_deviation", "P.rms_straightness", "P.circularity", "P.peak_deviation")  # fmt: skip
    problem = Problem(simulation, names)

    def chosen(errors):
        values, _ = problem({"arm.length": errors[0], "A.delta_x": errors[1]})
        return jnp.stack([values[name] for name in names])

    check_derivatives(chosen, [4e-4, 3e-3], [1e-5, 1e-5], reverse=1e-7, differences=2e-4, floor=1e-3)


@pytest.mark.long
def test_a_batch_shares_the_perfect_path(problem):
    changes = jnp.array([0.0, 2e-4, 4e-4])
    values, status = jax.vmap(lambda change: problem({"coupler.length": change}))(changes)
    assert (status == 0).all()
    assert values["P.max_deviation"][0] == 0.0
    alone, _ = problem({"coupler.length": 4e-4})
    for name in METRICS:
        assert_allclose(values[name][2], alone[name], rtol=1e-9, atol=1e-12, err_msg=name)


@pytest.mark.long
def test_deviations_of_parameters_are_errors_and_designs_are_not(problem):
    change = 5e-4
    deviated, _ = problem({"D.position.x": change})
    exact = exact_coupler(0.3, ground=GROUND + change) - exact_coupler(0.3)
    assert_allclose(deviated["P.deviation"], np.hypot(*exact[:2]), rtol=1e-6)
    model = problem.model
    made = Problem(
        Simulation(
            model, drive=PrescribedRate("A", -RATE), method=RungeKutta4(step=1e-3), duration=0.3, save_every=0.005,
            design=design(model, {"D.position.x": GROUND + change, "P.position.x": 0.2}),
        ),
        ("P.x", "P.deviation", "P.straightness"),
    )  # fmt: skip
    values, _ = made({})
    assert values["P.deviation"] == 0.0
    moved = exact_coupler(0.3, ground=GROUND + change, place=(0.2, 0.0, PLACE[2]))
    assert_allclose(values["P.x"], moved[0], rtol=1e-8)


@pytest.mark.long
def test_a_drive_that_is_given_passes_an_angle_at_another_time():
    """Under a given moment a heavier link is late: the deviation at a time has the delay in it, at an angle not."""
    mechanism = Mechanism(
        [link("arm", 0.3)], [Joint("A", "base", "arm")], driven_joint="A", gravity=(0.0, 0.0, 0.0),
        points=[Point("P", "arm", 0.3)],
    )  # fmt: skip
    drive = MomentTable("A", (0.0, 1.0), (0.05, 0.05))
    simulation = Simulation(
        discretise(mechanism), drive=drive, method=RungeKutta4(step=1e-3), duration=0.5, save_every=0.01
    )
    problem = Problem(simulation, ("P@30deg.deviation", "P@0.3s.deviation", "P@30deg.x", "P@0.3s.x"))
    values, status = problem({"steel.density": 100.0})
    assert int(status) == 0
    assert values["P@30deg.deviation"] < 1e-7
    inertia = 0.235 * 1.0 * 0.3**2 / 3.0  # of the arm, to its order
    assert values["P@0.3s.deviation"] > 1e-4 * 0.05 / inertia * 0.3**2
    # However late it is, at 30 deg the arm's end is where it is: the time of the passage has its derivative, too.
    slopes = evaluated(jax.jacfwd(lambda density: problem({"steel.density": density})[0]))(100.0)
    assert abs(slopes["P@30deg.x"]) < 1e-4 * abs(slopes["P@0.3s.x"])


@pytest.mark.long
def test_a_path_of_a_deformed_link_has_its_deformation_in_it():
    mechanism = four_bar(Point("E", "coupler", COUPLER), coupler=4)
    run = simulated(mechanism, {"D.d_y": 2e-3}, duration=0.02, step=1e-5)
    assert int(run.status) == 0
    assert_allclose(run.points["E"].position, run.motion.ends["coupler"], atol=1e-14)
    assert np.abs(run.points["E"].position[:, 1]).max() > 1e-4


def test_a_mechanism_held_still_has_its_points_where_kinematics_has_them():
    model = discretise(four_bar(Point("P", "coupler", PLACE)))
    turn = kinetostatic_turn(model, {"coupler.length": 4e-4}, np.array([-START, -1.2, -2.0]))
    exact = jax.vmap(lambda a: exact_with_error((a - START) / RATE, 4e-4))(jnp.array([START, 1.2, 2.0]))
    assert_allclose(turn.places["P"][:, [0, 2]], exact[:, :2], atol=1e-8)


@pytest.mark.long
def test_shapes_of_paths_that_are_known():
    """A hinge's end goes round, a slide's along a line, and the slide dwells where the crank turns it."""
    links = [link("crank", 0.1), link("rod", 0.3), link("slide", 0.05)]
    joints = [
        Joint("A", "base", "crank", angle=0.0),
        Joint("B", "crank", "rod", angle=0.0),
        Joint("C", "base", "slide", kind="prismatic", displacement=0.4),
        Joint("D", "rod", "slide", cut=True, child_position=(0.0, 0.0, 0.0)),
    ]
    points = [Point("round", "crank", 0.1), Point("line", "slide", (0.02, 0.01, 0.03)), Point("arc", "crank", 0.05)]
    mechanism = Mechanism(links, joints, driven_joint="A", redundant_reactions="minimum_norm", points=points)
    simulation = Simulation(
        discretise(mechanism), drive=PrescribedRate("A", 20.0), method=RungeKutta4(step=5e-4), duration=0.3,
        save_every=0.005,
    )  # fmt: skip
    names = ("round.circularity", "round.straightness", "line.straightness", "line.rms_straightness", "line.dwell")
    problem = Problem(simulation, names)

    def chosen(change):
        return jnp.stack([problem({"A.d_x": change})[0][name] for name in names])

    values, slopes = evaluated(lambda change: (chosen(change), jax.jacfwd(chosen)(change)))(0.0)
    values = dict(zip(names, values))
    assert values["round.circularity"] < 1e-10 and values["line.straightness"] < 1e-10
    places = np.array(simulate(simulation).points["round"].position)
    places -= places.mean(axis=0)
    direction = np.linalg.svd(places)[2][0]
    across = np.linalg.norm(places - np.outer(places @ direction, direction), axis=1)
    assert_allclose(values["round.straightness"], 2.0 * across.max(), rtol=1e-9)
    assert np.isfinite(slopes).all()
    # Slower than a hundredth of its largest speed: twice in a half turn, each time for about that share of 1 / rate.
    assert 0.0 < values["line.dwell"] < 4 * 0.02 / 20.0


@pytest.mark.parametrize(
    ("owner", "found"),
    [("P", ("P", "end", 0.0)), ("P@0.3s", ("P", "time", 0.3)), ("P@-90deg", ("P", "drive", -np.pi / 2)),
     ("P@25 mm", ("P", "drive", 0.025)), ("P@300ms", ("P", "time", 0.3))],
)  # fmt: skip
def test_instants_are_times_or_coordinates_of_the_drive(owner, found):
    assert path_instant(owner)[:2] == found[:2]
    assert_allclose(path_instant(owner).value, found[2])


@pytest.mark.parametrize("text", ["P@0.3", "P@", "P@fast", "P@3N", "P@nan", "P@1e3"])
def test_instants_without_a_meaning_are_refused(text):
    with pytest.raises(InputError, match="with its unit"):
        path_instant(text)


def test_points_that_cannot_be_are_refused():
    for point, words in (
        (Point("P", "couple", 0.1), "did you mean `coupler`"),
        (Point("P", "coupler", 0.1, "coupler"), "does not move in its frame"),
        (Point("B", "coupler", 0.1), "there is a joint `B`, too"),
        (Point("P", "coupler", 0.1, "cranc"), "did you mean `crank`"),
    ):
        with pytest.raises(InputError, match=words):
            four_bar(point)
    with pytest.raises(InputError, match="must lie on the flexible link"):
        four_bar(Point("P", "coupler", 0.4), coupler=3)
    with pytest.raises(InputError, match="unique names"):
        four_bar(Point("P", "coupler", 0.1), Point("P", "crank", 0.1))


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("Q.x", "it has no point `Q`"),
        ("P.max_deviaton", "did you mean `P.max_deviation`"),
        ("P@0.3.x", "with its unit"),
        ("P@0.1s.max_deviation", "of the whole path"),
    ],
)
def test_metrics_of_points_that_are_not_there_are_refused(problem, name, words):
    with pytest.raises(InputError, match=words):
        Problem(Simulation(problem.model, drive=problem.drive, method=problem.method, duration=0.1), (name,))


def test_an_instant_that_a_run_does_not_reach_is_no_number(problem):
    simulation = Simulation(problem.model, drive=problem.drive, method=problem.method, duration=0.1)
    values, _ = Problem(simulation, ("P@0.3s.x", "P@170deg.x"))({})
    assert np.isnan(values["P@0.3s.x"]) and np.isnan(values["P@170deg.x"])


@pytest.mark.long
def test_what_a_run_does_not_reach_has_no_sensitivity_that_says_ok(problem):
    simulation = Simulation(problem.model, drive=problem.drive, method=problem.method, duration=0.05)
    asked = Problem(simulation, ("P@170deg.x", "P.x"))
    found = sensitivity(asked, names=("coupler.length",), order=1)
    assert found.status == "no_value" and "no value of P@170deg.x:" in str(found)
    assert np.isnan(found.gradient[0]).all() and np.isfinite(found.gradient[1]).all()


def test_few_saved_places_have_no_straightness():
    mechanism = Mechanism(
        [link("arm", 0.3)], [Joint("A", "base", "arm")], driven_joint="A", points=[Point("P", "arm", 0.3)]
    )
    for saved, few in ((3, True), (4, False)):
        simulation = Simulation(
            discretise(mechanism), drive=PrescribedRate("A", 9.0), method=RungeKutta4(step=1e-3),
            duration=3e-2 * (saved - 1), save_every=3e-2,
        )  # fmt: skip
        values, _ = Problem(simulation, ("P.straightness", "P.circularity"))({})
        assert all(bool(np.isnan(value)) is few for value in values.values())


@pytest.mark.long
def test_repeatability_of_a_hand_that_is_turned_meanwhile():
    """A quarter turn of the second link in a turn of the first one moves its end by the root of 2 of its length."""
    mechanism = Mechanism(
        [link("arm", 0.3), link("hand", 0.1)],
        [Joint("A", "base", "arm"), Joint("B", "arm", "hand")],
        driven_joint=("A", "B"),
        points=[Point("elbow", "arm", 0.3), Point("tip", "hand", 0.1)],
    )
    names = ("elbow.repeatability", "tip.repeatability")

    def found(rate, duration):
        simulation = Simulation(
            discretise(mechanism), drive=(PrescribedRate("A", rate), PrescribedRate("B", 0.25 * rate)),
            method=RungeKutta4(step=2e-3), duration=duration, save_every=2e-3,
        )  # fmt: skip
        return Problem(simulation, names)({})[0]

    for rate in (20.0, -20.0):
        values = found(rate, 0.7)
        # Cubics between saved times, 0.04 rad apart, err by h^4 / 384 of the radius.
        assert values["elbow.repeatability"] < 5e-9
        assert values["tip.repeatability"] == pytest.approx(0.1 * np.sqrt(2.0), rel=1e-7)
    assert np.isnan(found(20.0, 0.6)["tip.repeatability"])  # 1.9 turns
