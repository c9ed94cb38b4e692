"""Metrics that designs are judged by, against closed forms of beams, and their derivatives in both modes."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rfem_jax import (
    Bearing,
    Circle,
    GivenSection,
    InputError,
    Joint,
    Link,
    Mechanism,
    PointForce,
    PointMass,
    PointMoment,
    PrescribedRate,
    Problem,
    Rectangle,
    RungeKutta4,
    Simulation,
    Tube,
    design,
    discretise,
    metric,
    simulate,
)
from rfem_jax.description.mechanism.bearings import LIFE_EXPONENTS
from rfem_jax.description.metrics.design_metrics import MILLION_REVOLUTIONS
from tests.derivatives import check_derivatives, jacobians
from tests.evaluation import evaluated
from tests.mechanisms import STEEL

LENGTH, WIDTH, HEIGHT, FORCE, TORQUE = 0.5, 0.008, 0.01, 2.0, 0.7
STEP = 1e-5  # m, of differences
STILL = PrescribedRate("A", 0.0)
METRICS = ("bar.max_stress", "bar.peak_stress", "bar.end_deflection", "bar@0.5.peak_deflection", "mass", "bar.mass")
E, G = STEEL.youngs_modulus, STEEL.modulus_of_rigidity
SLENDER = Rectangle(WIDTH, HEIGHT)


def cantilever(elements="linear", force=FORCE, torque=TORQUE, rfes=3):
    """A clamped bar that is bent and twisted at its end, without weight."""
    loads = (
        PointForce("push", "bar", (LENGTH, 0, 0), force=(0, 0, -force)),
        PointMoment("twist", "bar", (LENGTH, 0, 0), moment=(torque, 0, 0)),
    )
    bar = Link("bar", LENGTH, SLENDER, STEEL, rfes=rfes, point_masses=(PointMass(0.1, LENGTH),))
    mechanism = Mechanism([bar], [Joint("A", "base", "bar")], (0, 0, 0), driven_joint="A", forces=loads)
    return discretise(mechanism, elements=elements)


def problem_of(model):
    return Problem(Simulation(model, drive=STILL, duration=1e-7, method=RungeKutta4(step=1e-7)), METRICS)


def expected(length=LENGTH, force=FORCE, torque=TORQUE, m=2, width=WIDTH, height=HEIGHT):
    """Largest stress at the clamp (a corner without shear stress, or the middle of a side with it), deflections of m
    segments at the end and in the middle, mass."""
    corners = 6 * force * length / (width * height**2)
    edge = np.array(Rectangle(width, height).edge_stresses())
    moment = force * length
    von_mises = np.sqrt((edge[:, 1] * moment) ** 2 + 3 * (edge[:, 3] * torque) ** 2).max()
    assert von_mises > corners
    bending, shear = E * width * height**3 / 12, G * width * height / 1.2
    end = force * (length**3 / (3 * bending) * (1 - 1 / (4 * m**2)) + length / shear)
    return von_mises, end, STEEL.density * width * height * length + 0.1


@pytest.fixture(scope="module", params=["linear", "geometrically_exact"])
def bent(request):
    """Kind of the elements, metrics as a function of the length's error, and their values without an error."""
    problem = problem_of(cantilever(request.param))

    def values(length):
        found = problem({"bar.length": length})[0]
        return jnp.stack([found[name] for name in METRICS])

    return request.param, values, dict(zip(METRICS, evaluated(values)(jnp.zeros(()))))


@pytest.mark.slow
def test_stress_and_deflection_of_a_cantilever_are_those_of_beam_theory(bent):
    _, _, values = bent
    stress, end, mass = expected()
    assert float(values["bar.max_stress"]) == pytest.approx(stress, rel=2e-4)  # FL, not F (L - Delta/2)
    assert float(values["bar.end_deflection"]) == pytest.approx(end, rel=1e-4)
    assert float(values["mass"]) == float(values["bar.mass"]) == pytest.approx(mass, rel=1e-12)
    # In the middle of 2 segments: a rfe that is turned by what bends the one on its left.
    bending, step = E * WIDTH * HEIGHT**3 / 12, LENGTH / 2
    place = 0.5 * step
    middle = FORCE * (LENGTH - place) * step / bending * (0.5 * LENGTH - place)
    middle += FORCE * step / (G * WIDTH * HEIGHT / 1.2)
    assert float(values["bar@0.5.peak_deflection"]) == pytest.approx(middle, rel=1e-4)


def test_the_p_norm_of_the_stress_keeps_its_bounds(bent):
    _, _, values = bent
    largest, norm = float(values["bar.max_stress"]), float(values["bar.peak_stress"])
    times, sections, points = 2, 2 + 2 * 4, 8
    assert largest / times ** (1 / 64) <= norm <= (sections * points) ** (1 / 64) * largest
    assert norm == pytest.approx(largest, rel=0.03)


@pytest.mark.long
def test_derivatives_by_the_length_are_those_of_the_closed_forms_in_both_modes(bent):
    _, values, _ = bent
    forward = check_derivatives(values, 0.0, STEP, reverse=1e-9, differences=1e-6).forward
    high, low = (np.array(expected(LENGTH + h)) for h in (1e-6, -1e-6))
    slope = (high - low) / 2e-6
    np.testing.assert_allclose(forward[[0, 2, 5]], slope, rtol=1e-3)
    assert float(forward[1]) == pytest.approx(float(forward[0]), rel=0.04)


@pytest.mark.long
def test_derivatives_by_the_section_of_a_design_are_those_of_the_closed_forms_in_both_modes():
    model = cantilever()
    asked = ("bar.max_stress", "bar.end_deflection", "mass")
    settings = {"drive": STILL, "duration": 1e-7, "method": RungeKutta4(step=1e-7)}

    def values(section):
        named = {"bar.section.width": section[0], "bar.section.height": section[1]}
        problem = Problem(Simulation(model, design=design(model, named), **settings), asked)
        found = problem({"bar.length": 0.0})[0]
        return jnp.stack([found[name] for name in asked])

    point = np.array([WIDTH, HEIGHT])
    forward = check_derivatives(values, point, STEP, reverse=1e-9, differences=1e-5).forward
    h = 1e-6
    slopes = [
        (
            np.array(expected(width=point[0] + h * w, height=point[1] + h * z))
            - np.array(expected(width=point[0] - h * w, height=point[1] - h * z))
        )
        / (2 * h)
        for w, z in ((1, 0), (0, 1))
    ]
    np.testing.assert_allclose(forward.T, slopes, rtol=1e-3)


@pytest.mark.long
def test_derivatives_are_finite_without_load():
    problem = problem_of(cantilever(force=0.0, torque=0.0))

    def values(length):
        found = problem({"bar.length": length})[0]
        return jnp.stack([found[name] for name in METRICS[:4]])

    found = jacobians(values, 0.0, STEP)
    assert np.all(np.abs(found.values) < 1e-12)
    assert np.isfinite(found.forward).all() and np.isfinite(found.reverse).all()


@pytest.mark.slow
def test_the_tension_of_a_turning_bar_is_that_of_its_mass_farther_out():
    """rho A w^2 (L^2 - x^2) / 2 along a rigid bar, plus a point mass at its end."""
    rate, mass = 40.0, 0.2
    bar = Link("bar", LENGTH, SLENDER, STEEL, rigid=True, point_masses=(PointMass(mass, LENGTH),))
    model = discretise(Mechanism([bar], [Joint("A", "base", "bar")], (0, 0, 0), driven_joint="A"))
    drive, method = PrescribedRate("A", rate), RungeKutta4(step=1e-5)
    run = evaluated(
        lambda: simulate(Simulation(model, drive=drive, duration=1e-5, method=method), record="bar.sections")
    )()
    sections = run.recorded["bar.sections"]
    x = np.asarray(sections.place)
    tension = rate**2 * (STEEL.density * WIDTH * HEIGHT * (LENGTH**2 - x**2) / 2 + mass * LENGTH)
    found = np.asarray(sections.resultants[-1])
    outside = [i for i, one in enumerate(x) if one in (0.0, LENGTH) and abs(found[0, i]) < 1e-6 * tension.max()]
    assert len(outside) == 2  # before the joint, and beyond the mass
    inside = [i for i in range(len(x)) if i not in outside]
    np.testing.assert_allclose(found[0, inside], tension[inside], rtol=1e-9)
    assert np.abs(found[1:]).max() < 1e-6 * tension.max()
    np.testing.assert_allclose(sections.stress[-1, inside], tension[inside] / (WIDTH * HEIGHT), rtol=1e-9)


@pytest.mark.parametrize("shape", [Circle(0.02), Tube(0.03, 0.004), Rectangle(0.01, 0.02), Rectangle(0.02, 0.013)])
def test_stresses_at_the_edge_of_sections(shape):
    """Unit loads against the section's moments, and the torsion of a rectangle against Timoshenko's series."""
    edge = np.array(shape.edge_stresses())
    sizes = {Circle: ("diameter", "diameter"), Tube: ("outer_diameter",) * 2, Rectangle: ("width", "height")}
    y, z = (getattr(shape, name) / 2 for name in sizes[type(shape)])
    np.testing.assert_allclose(edge[:, 0], 1 / shape.area)
    assert np.abs(edge[:, 1]).max() == pytest.approx(z / shape.second_moment_y)
    assert np.abs(edge[:, 2]).max() == pytest.approx(y / shape.second_moment_z)
    torsion = edge[:, 3].max()
    if not isinstance(shape, Rectangle):
        assert torsion == pytest.approx(y / shape.torsion_constant)
        # Bending about any axis, of points on a circle.
        angles = np.linspace(0, 2 * np.pi, 77)
        largest = np.abs(edge[:, 1:3] @ np.stack([np.cos(angles), np.sin(angles)])).max(axis=0)
        np.testing.assert_allclose(largest, y / shape.second_moment_y, rtol=5e-3)
        return
    a, c = 2 * max(y, z), 2 * min(y, z)
    n = np.arange(1, 200, 2.0)
    argument = np.minimum(n * np.pi * a / (2 * c), 300)
    constant = (1 - 192 / np.pi**5 * c / a * np.sum(np.tanh(argument) / n**5)) / 3
    long = (1 - 8 / np.pi**2 * np.sum(1 / (n**2 * np.cosh(argument)))) / (constant * a * c**2)
    signs = (-1.0) ** ((n - 1) / 2)
    short = 8 / np.pi**2 * np.sum(signs * np.tanh(argument) / n**2) / (constant * a * c**2)
    middles = edge[4:]
    at_long = middles[:2] if z > y else middles[2:]
    at_short = middles[2:] if z > y else middles[:2]
    np.testing.assert_allclose(at_long[:, 3], long, rtol=3e-3)
    np.testing.assert_allclose(at_short[:, 3], short, rtol=6e-3)
    assert not edge[:4, 3].any()


GIVEN = (3e7, 9e4, 6e4, 150.0, 400.0, 900.0, 1.0, 2e-4, 1e-4, 1e-4)


def test_a_section_of_given_stiffnesses_needs_its_edge_for_stresses():
    with pytest.raises(InputError, match="`torsion_modulus` of GivenSection must be given"):
        GivenSection(*GIVEN, edge_y=0.01, edge_z=0.02, edge_modulus="210 GPa")
    edge = np.array(GivenSection(*GIVEN, 0.0, 0.01, 0.02, 210e9, 1e-6).edge_stresses())
    np.testing.assert_allclose(edge[0], [210e9 / 3e7, 210e9 * 0.02 / 400, 210e9 * 0.01 / 900, 1e6])
    bar = Link("bar", LENGTH, GivenSection(*GIVEN), rfes=2)
    model = discretise(Mechanism([bar], [Joint("A", "base", "bar")], driven_joint="A"))
    with pytest.raises(InputError, match="there is no `bar.peak_stress`: the edge of its section is not known"):
        Problem(Simulation(model, drive=STILL, duration=1e-4, method=RungeKutta4(step=1e-6)), "bar.peak_stress")


def bearing_run(force, rate, times, rolling="ball"):
    bearing = SimpleNamespace(dynamic=2000.0, static=1500.0, moment=20.0, exponent=LIFE_EXPONENTS[rolling])
    loads = SimpleNamespace(force=force, moment=0.01 * force)
    recorded = {"A.bearing": bearing, "A.turning": rate}
    return SimpleNamespace(times=times, loads={"A": loads}, recorded=recorded)


@pytest.mark.slow
@pytest.mark.parametrize(("rolling", "power"), [("ball", 3.0), ("roller", 10 / 3)])
def test_the_life_of_an_oscillating_bearing_is_that_of_its_swept_angle(rolling, power):
    swing, periods, load = 0.4, 3, 600.0
    times = jnp.linspace(0.0, periods * 1.0, 60001)
    rate = 2 * np.pi * swing * jnp.cos(2 * np.pi * times)
    force = jnp.stack([0 * times, 0.6 * load + 0 * times, 0.8 * load + 0 * times], axis=1)
    run = bearing_run(force, rate, times, rolling)
    revolutions = 4 * swing * periods / (2 * np.pi)
    life = (2000 / load) ** power * 1e6 / revolutions * periods
    assert float(metric("A.bearing_life")(run)) == pytest.approx(life, rel=1e-7)
    assert float(metric("A.bearing_damage")(run)) == pytest.approx(periods / life, rel=1e-7)
    assert float(metric("A.equivalent_load")(run)) == pytest.approx(load, rel=1e-7)
    assert float(metric("A.force_ratio")(run)) == pytest.approx(load / 1500, rel=1e-9)
    assert float(metric("A.moment_ratio")(run)) == pytest.approx(6.0 / 20, rel=1e-9)
    # Two halves of one turn under two loads: the mean of their powers.
    steps = jnp.linspace(0.0, 1.0, 4001)
    force = jnp.stack([jnp.where(steps < 0.5, 300.0, 900.0), 0 * steps, 0 * steps], axis=1)
    run = bearing_run(force, 2 * np.pi + 0 * steps, steps, rolling)
    mean = (0.5 * 300**power + 0.5 * 900**power) ** (1 / power)
    assert float(metric("A.equivalent_load")(run)) == pytest.approx(mean, rel=1e-3)
    assert float(metric("A.bearing_damage")(run)) == pytest.approx((mean / 2000) ** power / 1e6, rel=2e-3)
    assert pytest.approx(2e6 * np.pi) == MILLION_REVOLUTIONS


@pytest.mark.slow
def test_an_unloaded_bearing_lives_for_ever_and_has_derivatives():
    times = jnp.linspace(0.0, 1.0, 11)

    def found(scale):
        run = bearing_run(scale * jnp.ones((11, 3)), scale * jnp.ones(11), times)
        return {name: metric(f"A.{name}")(run) for name in ("bearing_damage", "equivalent_load", "force_ratio")}

    assert float(metric("A.bearing_life")(bearing_run(jnp.zeros((11, 3)), jnp.ones(11), times))) == np.inf
    for derivative in (jax.jacfwd, jax.jacrev, jax.hessian):
        one = evaluated(derivative(found))(jnp.zeros(()))
        assert all(np.isfinite(value) for value in one.values())


@pytest.mark.slow
def test_the_loads_of_a_crank_s_bearing_and_its_power():
    """A pendulum that a motor turns at a constant rate: moment and power are those of its weight."""
    rate, mass, gravity = 5.0, 0.3, 9.81
    bar = Link("bar", 0.2, SLENDER, STEEL, rigid=True, point_masses=(PointMass(mass, 0.2),))
    bearing = Bearing(dynamic_capacity="2 kN", static_capacity="1 kN", moment_capacity="3 N m")
    joint = Joint("A", "base", "bar", bearing=bearing)
    model = discretise(Mechanism([bar], [joint], (0, 0, -gravity), driven_joint="A"))
    names = ("A.peak_drive_power", "peak_drive_power", "A.bearing_damage", "A.equivalent_load")
    problem = Problem(
        Simulation(
            model, drive=PrescribedRate("A", rate), duration=0.1, method=RungeKutta4(step=1e-3), save_every=1e-3
        ),
        names,
    )
    values = evaluated(lambda: problem({})[0])()
    own = STEEL.density * WIDTH * HEIGHT * 0.2
    angle = rate * np.linspace(0.0, 0.1, 101)
    power = rate * gravity * (mass + own / 2) * 0.2 * np.cos(angle)
    assert float(values["peak_drive_power"]) == pytest.approx(np.mean(power**16) ** (1 / 16), rel=1e-6)
    assert float(values["A.peak_drive_power"]) == float(values["peak_drive_power"])
    swept, load = rate * 0.1, float(values["A.equivalent_load"])
    assert float(values["A.bearing_damage"]) == pytest.approx((load / 2000) ** 3 * swept / (2e6 * np.pi), rel=1e-9)
    inertial = rate**2 * 0.2 * (mass + own / 2)
    assert abs(load - (mass + own) * gravity) < inertial
    with pytest.raises(InputError, match="there is no `A.friction_loss`: it has no friction"):
        Problem(
            Simulation(model, drive=PrescribedRate("A", rate), duration=0.1, method=RungeKutta4(step=1e-3)),
            "A.friction_loss",
        )
