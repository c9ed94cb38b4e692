"""Tapered and stepped links against closed forms, a table and beam finite elements."""

import dataclasses
from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rfem_jax import (
    Circle,
    GivenSection,
    InputError,
    Joint,
    Link,
    Material,
    Mechanism,
    PointForce,
    PointMoment,
    Rectangle,
    StaticProblem,
    Station,
    Tolerances,
    Tube,
    Uniform,
    assemble,
    assembly_errors,
    discretise,
    monte_carlo,
    static_loads,
)
from rfem_jax.mechanics.model.with_errors import apply_errors
from rfem_jax.mechanics.statics.designs import designed
from rfem_jax.simulation.vibrations.modes import natural_frequencies
from tests.derivatives import check_derivatives
from tests.mechanisms import STEEL

LENGTH, LOAD = 0.4, 1e-3
NOTHING = (0.0, 0.0, 0.0)
POINTS, WEIGHTS = np.polynomial.legendre.leggauss(40)


def clamped(section, stations, rfes=5, forces=(), material=STEEL, length=LENGTH, **more):
    beam = Link("beam", length, section, material, rfes=rfes, stations=stations)
    joint = Joint("A", "base", "beam", kind="fixed")
    return discretise(Mechanism([beam], [joint], forces=forces, gravity=NOTHING, **more))


def tip(model, m):
    """Displacement and rotation of the end of the clamped beam, small ones."""
    position = assemble(model, assembly_errors(model))
    assert int(position.status) == 0
    u, phi = np.asarray(position.state.position.elastic).reshape(2, 3, -1)[:, :, -1]
    return u + np.cross(phi, [LENGTH / (4.0 * m), 0.0, 0.0]), phi


def integral(function, places=(0.0, LENGTH)):
    """Of a function of x that is smooth between places."""
    total = 0.0
    for low, high in pairwise(places):
        x = low + 0.5 * (high - low) * (1.0 + POINTS)
        total += 0.5 * (high - low) * WEIGHTS @ function(x)
    return total


def cone(first=0.02, last=0.012):
    return Circle(first), (Station(section=Circle(last)),)


@pytest.mark.parametrize("elements", ["linear", "geometrically_exact"])
def test_a_cone_is_stretched_and_twisted_as_its_closed_forms_say(elements):
    """Whatever the number of rfes: their compliances are the integrals."""
    forces = [
        PointForce("pull", "beam", (LENGTH, 0, 0), force=(LOAD, 0, 0), axes="link"),
        PointMoment("turn", "beam", (LENGTH, 0, 0), moment=(LOAD, 0, 0), axes="link"),
    ]
    u, phi = tip(clamped(*cone(), 4, forces, elements=elements), 3)
    stiffness, rigidity = STEEL.youngs_modulus, STEEL.modulus_of_rigidity
    a, b = 0.02, 0.012
    assert u[0] == pytest.approx(4.0 * LOAD * LENGTH / (np.pi * stiffness * a * b), rel=1e-8)
    expected = 32.0 * LOAD * LENGTH / (3.0 * np.pi * rigidity * (a - b)) * (1.0 / b**3 - 1.0 / a**3)
    assert phi[0] == pytest.approx(expected, rel=1e-8)


def test_a_stepped_shaft_is_twisted_as_the_sum_of_its_parts():
    """With steps within segments."""
    steps = (Station(0.07, after=Tube(0.03, 0.004)), Station(0.23, after=Circle(0.015)))
    turn = PointMoment("turn", "beam", (LENGTH, 0, 0), moment=(LOAD, 0, 0), axes="link")
    _, phi = tip(clamped(Circle(0.02), steps, 4, [turn]), 3)
    per_length = [32.0 / (np.pi * d) for d in (0.02**4, 0.03**4 - 0.022**4, 0.015**4)]
    expected = LOAD / STEEL.modulus_of_rigidity * np.dot(per_length, [0.07, 0.16, 0.17])
    assert phi[0] == pytest.approx(expected, rel=1e-9)


def test_a_wedge_bends_as_the_integral_over_it_with_an_error_of_second_order():
    """The sdes are in the middles of their segments, where they have the compliances of these."""
    first, last, width = 0.02, 0.008, 0.01
    push = PointForce("push", "beam", (LENGTH, 0, 0), force=(0, 0, LOAD), axes="link")
    section, stations = Rectangle(width, first), (Station(section=Rectangle(width, last)),)

    def height(x):
        return first + (last - first) * x / LENGTH

    def bent(places, lever):
        by_moment = integral(lambda x: lever(x) ** 2 * 12.0 / (width * height(x) ** 3), places)
        return LOAD * by_moment / STEEL.youngs_modulus

    def of_segments(m):
        edges = np.linspace(0.0, LENGTH, m + 1)
        return sum(bent(edges[e : e + 2], lambda x, e=e: LENGTH - (e + 0.5) * LENGTH / m + 0.0 * x) for e in range(m))

    shear = LOAD * integral(lambda x: 1.2 / (width * height(x))) / STEEL.modulus_of_rigidity
    assert tip(clamped(section, stations, 5, [push]), 4)[0][2] == pytest.approx(of_segments(4) + shear, rel=1e-6)
    exact = bent((0.0, LENGTH), lambda x: LENGTH - x)
    errors = np.array([of_segments(m) for m in (4, 32, 64)]) / exact - 1.0
    assert abs(errors[0]) < 0.05
    assert errors[1] / errors[2] == pytest.approx(4.0, rel=0.02)


def frequencies(section, stations, rfes, count=2, **more):
    """Angular frequencies [rad/s] of bending in the plane and across it, sorted."""
    modes = natural_frequencies(clamped(section, stations, rfes, **more), count=count)
    assert int(modes.status) == 0
    return 2.0 * np.pi * np.asarray(modes.frequency)


def finite_elements(height, width, length, material, count=60):
    """First two angular frequencies of a clamped beam of Euler and Bernoulli, by Hermite's elements."""
    n, size = 2 * (count + 1), length / count
    stiffness, mass = np.zeros((n, n)), np.zeros((n, n))
    for e in range(count):
        nodes, weights = np.polynomial.legendre.leggauss(5)
        for s, weight in zip(0.5 * (1.0 + nodes), 0.5 * weights * size):
            shape = np.array([1 - 3 * s**2 + 2 * s**3, size * (s - 2 * s**2 + s**3), 3 * s**2 - 2 * s**3,
                              size * (s**3 - s**2)])  # fmt: skip
            bent = np.array([-6 + 12 * s, size * (-4 + 6 * s), 6 - 12 * s, size * (6 * s - 2)]) / size**2
            h = height((e + s) * size)
            at = slice(2 * e, 2 * e + 4)
            stiffness[at, at] += weight * material.youngs_modulus * width * h**3 / 12.0 * np.outer(bent, bent)
            mass[at, at] += weight * material.density * width * h * np.outer(shape, shape)
    values = np.linalg.eigvals(np.linalg.solve(mass[2:, 2:], stiffness[2:, 2:]))
    return np.sqrt(np.sort(values.real)[:2])


SLENDER = Material("slender", youngs_modulus=210e9, density=7850.0, poisson_ratio=0.3)


def test_frequencies_of_a_tapered_cantilever_are_those_of_beam_finite_elements():
    """In the plane; the width is large, so that the lowest modes are in the plane, and stiff in shear."""
    first, last, width = 0.004, 0.0016, 0.05
    section = Rectangle(width, first, shear_factor=1e-3)
    stations = (Station(0.1, after=Rectangle(width, 0.003, shear_factor=1e-3)),
                Station(section=Rectangle(width, last, shear_factor=1e-3)))  # fmt: skip

    def height(x):
        return first if x < 0.1 else 0.003 + (last - 0.003) * (x - 0.1) / 0.3

    expected = finite_elements(height, width, LENGTH, SLENDER)
    np.testing.assert_allclose(frequencies(section, stations, 17, material=SLENDER), expected, rtol=5e-3)


def test_finite_elements_of_the_test_itself_meet_the_frequency_of_a_wedge_that_ends_in_an_edge():
    """5.315 sqrt(E I / (rho A)) / L^2 of the clamped end: G. Kirchhoff (1879), in S. Timoshenko, Vibration Problems in
    Engineering; the tip here is a ten-thousandth of the root."""
    first, width = 0.004, 0.05
    found = finite_elements(lambda x: first * (1.0 - 0.9999 * x / LENGTH), width, LENGTH, SLENDER)[0]
    unit = np.sqrt(SLENDER.youngs_modulus * first**2 / 12.0 / SLENDER.density) / LENGTH**2
    assert found / unit == pytest.approx(5.315, abs=1e-3)


def test_mass_centre_and_inertia_of_a_cone_are_exact():
    first, last, longer = 0.02, 0.012, 0.01
    model = clamped(*cone(first, last), rfes=4)
    actual = apply_errors(model, assembly_errors(model, {"beam.length": longer}))
    length, density = LENGTH + longer, STEEL.density
    points = np.concatenate([[0.0], np.asarray(actual.rest)])

    def radius(x):
        return 0.5 * (first + (last - first) * x / length)

    ends = (0.0, length)
    mass = density * np.pi * length / 12.0 * (first**2 + first * last + last**2)
    centre = density * integral(lambda x: np.pi * radius(x) ** 2 * x, ends) / mass
    about_y = density * integral(lambda x: np.pi * (radius(x) ** 2 * x**2 + radius(x) ** 4 / 4.0), ends)
    about_x = density * integral(lambda x: np.pi * radius(x) ** 4 / 2.0, ends)
    places = points + np.asarray(actual.centre)[0]
    assert float(actual.mass.sum()) == pytest.approx(mass, rel=1e-12)
    assert clamped(*cone(first, last)).topology.links == ("beam",)
    assert float(np.asarray(actual.mass) @ places) == pytest.approx(mass * centre, rel=1e-12)
    whole = np.asarray(actual.inertia).sum(axis=2)
    assert whole[1, 1] + np.asarray(actual.mass) @ places**2 == pytest.approx(about_y, rel=1e-12)
    assert whole[0, 0] == pytest.approx(about_x, rel=1e-12)
    assert Link("beam", LENGTH, *cone()[:1], STEEL, stations=cone()[1]).mass == pytest.approx(
        mass * LENGTH / length, rel=1e-12
    )


def test_stations_that_change_nothing_leave_the_link_as_it_is():
    """And a mechanism without stations has no arrays of them."""
    section = Tube(0.02, 0.003)
    plain, same = clamped(section, ()), clamped(section, (Station(0.13, section), Station(0.2, after=section)))
    assert plain.taper is None and plain.profiles is None and plain.topology.stations == ()
    errors = {"beam.length": 0.02}
    one, other = (apply_errors(model, assembly_errors(model, errors)) for model in (plain, same))
    for name in ("mass", "centre", "inertia", "stiffness", "rest", "lever_left"):
        expected = np.asarray(getattr(one, name))
        np.testing.assert_allclose(getattr(other, name), expected, rtol=1e-12, atol=1e-12 * np.abs(expected).max())


def test_a_given_section_may_change_and_a_warm_link_keeps_its_mass():
    numbers = np.array([3e7, 9e4, 6e4, 150.0, 400.0, 900.0, 1.0, 2e-4, 1e-4, 1e-4])
    thick, thin = GivenSection(*numbers), GivenSection(*(0.5 * numbers))
    beam = Link("beam", LENGTH, thick, rfes=3, thermal_expansion=1e-3, temperature=20.0,
                stations=[Station(0.1, after=thin), Station(section=thick)])  # fmt: skip
    model = discretise(Mechanism([beam], [Joint("A", "base", "beam", kind="fixed")]))
    actual = apply_errors(model, assembly_errors(model))
    assert float(actual.mass.sum()) == pytest.approx(0.1 + 0.3 * 0.75, rel=1e-12)
    assert beam.mass == pytest.approx(0.1 + 0.3 * 0.75)


def test_stresses_are_those_of_the_local_section():
    """The largest is just behind the step, not at the clamp; here in the plane of x and y."""
    force = PointForce("push", "beam", (LENGTH, 0, 0), force=(0.0, 0.05, 0.0), axes="link")
    steps = (Station(0.15, Rectangle(0.01, 0.03), after=Rectangle(0.01, 0.01)),)
    model = clamped(Rectangle(0.01, 0.04), steps, 4, [force], plane="xy")
    longer = 0.975
    errors = {"beam.length": (longer - 1.0) * LENGTH}  # with which the step moves
    found = static_loads(model, errors, record=("beam.sections",))
    stress = longer * 6.0 * 0.05 * (LENGTH - 0.15) / (0.01 * 0.01**2)
    assert np.max(found.stress["beam"]) == pytest.approx(stress, rel=1e-6)
    record = found.recorded["beam.sections"]
    place = np.asarray(record.place)
    at_clamp = np.argmin(np.where(place > 0.0, place, LENGTH))
    clamp = longer * 6.0 * 0.05 * LENGTH / (0.01 * 0.04**2)
    assert np.asarray(record.stress)[..., at_clamp].item() == pytest.approx(clamp, rel=1e-6)


NAMES = "beam.stations.1.x", "thin.height", "end.width", "beam.section.height", "beam.length"


def varied():
    """A beam with a step and a taper, whose numbers of `NAMES` deviate as errors."""
    thin, end = Rectangle(0.01, 0.012, name="thin"), Rectangle(0.012, 0.006, name="end")
    push = PointForce("push", "beam", (LENGTH, 0, 0), force=(0, 0.01, 0.02), axes="link")
    return clamped(Rectangle(0.015, 0.02), (Station(0.17, after=thin), Station(section=end)), 4, [push])


@pytest.mark.long
def test_derivatives_of_masses_and_stiffnesses_by_station_and_sections():
    """The step moves within a segment and within an rfe."""
    model = varied()
    weights = jnp.asarray(np.random.default_rng(0).uniform(0.5, 1.5, (9, 4)))

    def values(numbers):
        made = designed(model, None, dict(zip(NAMES, numbers, strict=True)))
        actual = apply_errors(made.model, made.errors)
        return jnp.stack([
            actual.mass @ weights[0], actual.centre[0] @ weights[1],
            1e4 * jnp.einsum("iik,ik->", actual.inertia, weights[:3]),
            jnp.sum(actual.stiffness / actual.stiffness.mean(axis=1, keepdims=True) * weights[:6, :3]),
        ])  # fmt: skip

    check_derivatives(values, np.zeros(5), np.full(5, 2e-6), reverse=1e-9, differences=1e-5, floor=1e-2)


@pytest.mark.long
def test_derivatives_of_stress_and_energy_by_station_and_sections():
    model, scales = varied(), np.array([1e3, 1e-7])

    def values(numbers):
        found = static_loads(model, dict(zip(NAMES, numbers, strict=True)))
        return jnp.stack([jnp.reshape(found.stress["beam"], ()), jnp.reshape(found.energy.elastic, ())]) / scales

    found = check_derivatives(values, np.zeros(5), np.full(5, 2e-6), reverse=1e-8, differences=2e-5, floor=1e-2)
    # Just behind the step, of forces along y and z.
    stress = 6.0 * (LENGTH - 0.17) * (0.01 / (0.012 * 0.01**2) + 0.02 / (0.01 * 0.012**2))
    assert found.values[0] * scales[0] == pytest.approx(stress, rel=1e-5)


@pytest.mark.parametrize(
    ("stations", "words"),
    [
        ([Station(0.5, after=Circle(0.01))], "follow each other between 0 and 0.4 m"),
        ([Station(0.2, after=Circle(0.01)), Station(0.1, after=Circle(0.02))], "put them in order"),
        ([Station(section=Circle(0.01)), Station(0.2, after=Circle(0.01))], "station 1 has none"),
        ([Station(after=Circle(0.01))], "no `after` at the end"),
        ([Station(section=Rectangle(0.01, 0.01))], "from Circle to Rectangle"),
        ([Station(0.1, after=GivenSection(*[1.0] * 10))], "`material` of link `beam` must be left out"),
        ("all", "must be a list of Station"),
    ],
)
def test_stations_that_cannot_be_are_refused(stations, words):
    with pytest.raises(InputError, match=words):
        Link("beam", LENGTH, Circle(0.02), STEEL, stations=stations)


def test_a_station_without_a_section_is_refused():
    with pytest.raises(InputError, match="must be given where there is no `after`"):
        Station(0.1)
    with pytest.raises(InputError, match="greater than 0"):
        Station(-0.1, after=Circle(0.01))
    with pytest.raises(InputError, match="`section` of a station"):
        Station(0.1, section=dataclasses.replace(STEEL))


def test_samples_of_tapered_links():
    """A Monte Carlo study over the length of a tapered cantilever: it carries its weight, which grows with it."""
    wide, thin = Rectangle(0.01, 0.02), Rectangle(0.01, 0.01)
    beam = Link("beam", LENGTH, wide, STEEL, rfes=3, stations=[Station(section=thin)])
    mechanism = Mechanism([beam], [Joint("A", "base", "beam", kind="fixed")], gravity=(0.0, 0.0, -9.81))
    problem = StaticProblem(discretise(mechanism), ("A.max_force",))
    result = monte_carlo(problem, Tolerances({"beam.length": Uniform(1e-2)}), 8, jax.random.key(1))
    weight = 9.81 * STEEL.density * 0.01 * 0.015 * LENGTH
    np.testing.assert_allclose(result.values[:, 0], weight * (1.0 + result.errors[:, 0] / LENGTH), rtol=1e-12)
    assert result.good == 8
