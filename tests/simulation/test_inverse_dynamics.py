"""Inverse dynamics of rigid links: a slider-crank by virtual work, a four-bar beside its simulation, and in
tasks; what moves otherwise is refused."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

from rfem_jax import (
    InputError,
    Joint,
    JointFriction,
    JointSpring,
    Link,
    Mechanism,
    Point,
    PrescribedFunction,
    Rectangle,
    RigidBody,
    RungeKutta4,
    Simulation,
    StaticProblem,
    discretise,
    inverse_dynamics,
    parameters,
    sensitivity,
    simulate,
    static_loads,
)
from tests.derivatives import jacobians
from tests.evaluation import evaluated
from tests.mechanisms import STEEL, link

CRANK, ROD, MASS, RATE, ACCELERATION = 0.05, 0.2, 0.8, 30.0, 200.0
ANGLES = np.array([0.3, 1.2, 2.5])


def slider_crank(mass=1e-9, **more):
    """Its piston alone has a mass: the crank's moment follows from the piston's stroke by virtual work."""
    nothing = RigidBody(mass, (0.0, 0.0, 0.0), (1e-3 * mass, 1e-3 * mass, 1e-3 * mass))
    links = [
        Link("crank", CRANK, body=nothing), Link("rod", ROD, body=nothing),
        Link("piston", 0.04, body=RigidBody(MASS, (0.0, 0.0, 0.0), (1e-4, 1e-4, 1e-4))),
    ]  # fmt: skip
    joints = [
        Joint("A", "base", "crank", angle=-0.3),
        Joint("B", "crank", "rod", angle=0.37),
        Joint("G", "base", "piston", kind="prismatic", displacement=0.247),
        Joint("P", "rod", "piston", cut=True, child_position=(0.0, 0.0, 0.0)),
    ]
    settings = {"driven_joint": "A", "gravity": (0.0, 0.0, 0.0)} | more
    return Mechanism(links, joints, **settings)


def stroke(angle, crank=CRANK, rod=ROD):
    return crank * jnp.cos(angle) + jnp.sqrt(rod**2 - (crank * jnp.sin(angle)) ** 2)


def exact_moment(angle, rate, acceleration, crank=CRANK, rod=ROD):
    """Moment about the crank's axis, by which virtual work equals that of the piston's inertia."""
    slope = jax.grad(stroke)(angle, crank, rod)
    curvature = jax.grad(jax.grad(stroke))(angle, crank, rod)
    return MASS * (slope * acceleration + curvature * rate**2) * slope


@pytest.mark.long
def test_a_slider_crank_by_virtual_work():
    # The joint turns from z to x: angles of the figure are its negative.
    found = inverse_dynamics(discretise(slider_crank()), {"A": -ANGLES}, {"A": -RATE}, {"A": -ACCELERATION})
    exact = jax.vmap(exact_moment, in_axes=(0, None, None))(jnp.asarray(ANGLES), RATE, ACCELERATION)
    assert (np.asarray(found.status) == 0).all()
    assert_allclose(found.holding["A"], -exact, rtol=1e-6)
    curvature = jax.vmap(jax.grad(jax.grad(stroke)))(jnp.asarray(ANGLES))
    slope = jax.vmap(jax.grad(stroke))(jnp.asarray(ANGLES))
    piston = MASS * (slope * ACCELERATION + curvature * RATE**2)
    # The force in the pin along the line of the piston is all that accelerates it.
    rod_force = np.linalg.norm(found.loads["P"].force, axis=1)
    slant = np.arcsin(CRANK * np.sin(ANGLES) / ROD)
    assert_allclose(rod_force, np.abs(piston) / np.cos(slant), rtol=1e-6)
    assert_allclose(found.energy.kinetic, 0.5 * MASS * (slope * RATE) ** 2, rtol=1e-6)
    assert float(found.checks.momentum_balance_error) < 1e-9
    assert_allclose(found.rate["A"], -RATE)
    assert_allclose(found.acceleration["A"], -ACCELERATION)


@pytest.mark.long
def test_derivatives_by_errors_in_both_modes():
    """With masses of crank and rod, and nearly without, where virtual work has the derivatives; by one program."""
    names = ("crank.length", "rod.length")
    model = discretise(slider_crank(0.05))
    masses = [f"{link}.{part}" for link in ("crank", "rod") for part in ("mass", *(f"inertia.{x}" for x in "xyz"))]

    def moments(x):
        def with_less_mass(share):
            errors = dict(zip(names, x)) | {name: -share * parameters(model)[name].value for name in masses}
            return inverse_dynamics(model, {"A": -ANGLES}, {"A": -RATE}, {"A": -ACCELERATION}, errors).holding["A"]

        return jax.vmap(with_less_mass)(jnp.array([0.0, 1.0 - 1e-6]))

    at = np.array([1e-4, -2e-4])
    found = jacobians(moments, at, 1e-6)
    assert_allclose(found.reverse[0], found.forward[0], rtol=1e-9)
    assert_allclose(found.differences[0], found.forward[0], rtol=1e-6)
    slopes = evaluated(jax.vmap(jax.grad(exact_moment, (3, 4)), in_axes=(0, *(4 * [None]))))
    exact = slopes(jnp.asarray(ANGLES), RATE, ACCELERATION, CRANK + at[0], ROD + at[1])
    assert_allclose(found.forward[1], -np.stack(exact, axis=1), rtol=1e-5)


@pytest.mark.long
def test_a_four_bar_with_springs_and_an_error_as_in_its_simulation():
    joints = [
        Joint("A", "base", "crank", angle=-0.4), Joint("B", "crank", "coupler", angle=-0.35),
        Joint("D", "base", "rocker", position=(0.32, 0.0, 0.0), angle=-1.5),
        Joint("C", "coupler", "rocker", cut=True),
    ]  # fmt: skip
    links = [link("crank", 0.12), link("coupler", 0.3), link("rocker", 0.25)]
    mechanism = Mechanism(
        links, joints, driven_joint="A", forces=[JointSpring("s", "D", stiffness=3.0, damping=0.2)],
        points=[Point("P", "coupler", (0.12, 0.0, 0.07))],
    )  # fmt: skip
    model, errors = discretise(mechanism), {"coupler.length": 2e-4}
    rate, acceleration = -9.0, -40.0
    drive = PrescribedFunction("A", lambda t: rate * t + 0.5 * acceleration * t**2)
    run = simulate(
        Simulation(model, drive=drive, method=RungeKutta4(step=1e-3), duration=0.02, save_every=0.01), errors
    )
    found = inverse_dynamics(model, {}, {"A": rate}, {"A": acceleration}, errors)
    for name, load in found.loads.items():
        assert_allclose(load.force[0], run.loads[name].force[0], atol=1e-9)
        assert_allclose(load.moment[0], run.loads[name].moment[0], atol=1e-9)
    assert_allclose(found.holding["A"][0], run.motion.drives["A"].force[0], rtol=1e-9)
    assert_allclose(found.points["P"].acceleration[0], run.points["P"].acceleration[0], atol=1e-9)


def test_no_motion_is_rest():
    model = discretise(slider_crank(mass=0.1, gravity=(3.0, 0.0, -9.81)))
    still, moving = static_loads(model, None, {"A": -ANGLES}), inverse_dynamics(model, {"A": -ANGLES})
    assert_allclose(moving.holding["A"], still.holding["A"], rtol=1e-9)
    for name, load in still.loads.items():
        assert_allclose(moving.loads[name].force, load.force, atol=1e-8)


def test_springs_and_dampers_of_a_held_joint_are_no_part_of_what_holds_it():
    """A hand on a torsion spring with a damper, at rest and in motion, with its weight."""
    stiffness, damping, free = 4.0, 0.3, 0.2
    spring = JointSpring("s", "A", stiffness=stiffness, damping=damping, rest=free)
    hand = Mechanism(
        [Link("hand", 0.3, body=RigidBody(2.0, (0.1, 0.0, 0.0), (0.01, 0.05, 0.05)))], [Joint("A", "base", "hand")],
        driven_joint="A", forces=[spring], gravity=(0.0, 0.0, -9.81),
    )  # fmt: skip
    model = discretise(hand)
    held, moved = (
        static_loads(model, None, {"A": ANGLES}),
        inverse_dynamics(model, {"A": ANGLES}, {"A": 3.0}, {"A": 7.0}),
    )
    # The joint turns from z to x, so that at an angle q the centre is at -0.1 sin q along z.
    weight = -2.0 * 9.81 * 0.1 * np.cos(ANGLES)
    rest = weight + stiffness * (ANGLES - free)
    assert_allclose(held.holding["A"], rest, rtol=1e-9)
    assert_allclose(moved.holding["A"], rest + damping * 3.0 + (0.05 + 2.0 * 0.1**2) * 7.0, rtol=1e-9)


@pytest.mark.long
def test_samples_of_a_given_motion():
    problem = StaticProblem(
        discretise(slider_crank()), ("A.end_drive_moment",), {"A": -1.2}, rates={"A": -RATE}, accelerations={"A": -50.0}
    )
    found = sensitivity(problem, names=("rod.length",), order=1)
    exact = jax.grad(exact_moment, 4)(1.2, RATE, 50.0, CRANK, ROD)
    assert found.status == "ok" and found.gradient[0, 0] == pytest.approx(-float(exact), rel=1e-5)


def test_what_would_swing_is_refused():
    flexible = [Link("beam", 0.3, Rectangle(0.01, 0.01), STEEL)]
    model = discretise(Mechanism(flexible, [Joint("A", "base", "beam")], driven_joint="A"), rfes=3)
    with pytest.raises(InputError, match="links are flexible, and would swing"):
        inverse_dynamics(model, {}, {"A": 1.0})
    rigid = discretise(slider_crank())
    with pytest.raises(InputError, match="`rates` must name coordinates that are held, but 'B' is not"):
        inverse_dynamics(rigid, {}, {"B": 1.0})
    with pytest.raises(InputError, match="`accelerations` must have one finite number for each of 3 positions"):
        inverse_dynamics(rigid, {"A": -ANGLES}, {"A": 1.0}, {"A": [0.0, 1.0]})
    with pytest.raises(InputError, match="no friction that depends on loads"):
        rubbing = JointFriction("pin", "A", coefficient=0.3, radius=0.02, sliding_rate=0.1)
        inverse_dynamics(discretise(slider_crank(forces=[rubbing])), {}, {"A": 1.0})
    with pytest.raises(InputError, match="`rates` must be a rate .*, but was '1 m/s'"):
        inverse_dynamics(rigid, {}, {"A": "1 m/s"})
    with pytest.raises(InputError, match="`rates` must hold known numbers"):
        jax.grad(lambda rate: inverse_dynamics(rigid, {}, {"A": rate}).holding["A"][0])(1.0)
    with pytest.raises(InputError, match="it starts in equilibrium"):
        inverse_dynamics(discretise(slider_crank(driven_joint=None, start="equilibrium")), {}, {"A": 1.0})


@pytest.mark.long
@pytest.mark.parametrize("moving", [False, True])
def test_a_dead_centre_is_refused_where_the_slide_is_held(moving):
    """There the crank may go on either way, and whatever holds the slide is infinite; beside it loads are large."""
    model = discretise(slider_crank(mass=0.1, driven_joint="G", gravity=(0.0, 0.0, -9.81)))

    def at(place):
        return inverse_dynamics(model, {"G": place}, {"G": 1.0}) if moving else static_loads(model, None, {"G": place})

    for place in (CRANK + ROD, ROD - CRANK):
        with pytest.raises(InputError, match=f"decides how the mechanism stands, but at G = {place:g}.*dead centre"):
            at([0.247, place])
    assert (np.asarray(at([0.247, 0.2499]).status) == 0).all()
    # The crank's dead centres are none where the crank is held.
    held = discretise(slider_crank(mass=0.1))
    assert (np.asarray(inverse_dynamics(held, {"A": [0.0, -np.pi]}, {"A": RATE}).status) == 0).all()


def test_positions_and_rates_with_units():
    model = discretise(slider_crank())
    found = inverse_dynamics(model, {"A": ["-20 deg", -1.0]}, {"A": "60 rpm"}, {"A": ("1 rad/s^2", 2.0)})
    assert_allclose(found.position["A"], [np.radians(-20.0), -1.0])
    assert_allclose(found.rate["A"], 2.0 * np.pi)
    assert_allclose(found.acceleration["A"], [1.0, 2.0])
