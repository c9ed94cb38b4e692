"""Links that neither stretch nor shear: Euler and Bernoulli's beam, rigid bodies with springs, and the limit of links
with all coordinates."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from rfem_jax import (
    Compliance,
    Coordinates,
    GeneralisedAlpha,
    InputError,
    Joint,
    Leapfrog,
    Link,
    Mechanism,
    PointForce,
    PointMoment,
    Rectangle,
    RungeKutta4,
    Simulation,
    State,
    assemble,
    describe,
    discretise,
    largest_stable_step,
    natural_frequencies,
    simulate,
)
from rfem_jax.mechanics.dynamics.dynamics import accelerations
from rfem_jax.mechanics.model.errors import assembly_errors
from rfem_jax.mechanics.model.inputs import DriveInput, Stabilisation
from rfem_jax.mechanics.model.with_errors import apply_errors
from rfem_jax.simulation.vibrations.stability import eigenvalues
from tests.derivatives import check_derivatives
from tests.mechanisms import STEEL, four_bar, slender

BOTH = pytest.mark.parametrize("elements", ["linear", "geometrically_exact"])
ANGLES = ("bending", "torsion")
LENGTH, BLADE = 0.3, Rectangle(0.012, 0.006)
STIFFNESS = BLADE.properties(STEEL)
ERROR = 5e-3
NOTHING = Stabilisation(0.0, 0.0, 0.3)


def bar(rfes, kind="fixed", forces=(), **more):
    """A slender bar on the base."""
    arm = Link("arm", LENGTH, BLADE, STEEL, rfes=rfes, flexibility=ANGLES)
    return Mechanism([arm], [Joint("A", "base", "arm", kind=kind)], forces=forces, **more)


def bodies(rfes, kind="fixed", **more):
    """The same as rigid bodies, joined by fixed joints that three springs let turn."""
    apart = LENGTH / (rfes - 1)
    pieces = [0.5 * apart, *[apart] * (rfes - 2), 0.5 * apart]
    links = [Link(f"b{k}", piece, BLADE, STEEL, rigid=True) for k, piece in enumerate(pieces)]
    springs = {"R_x": STIFFNESS.torsion, "R_y": STIFFNESS.bending_y, "R_z": STIFFNESS.bending_z}
    springs = {name: value / apart for name, value in springs.items()}
    springs |= {f"{name}_damping": STEEL.damping * value for name, value in springs.items()}
    compliance = Compliance(**springs)
    joints = [Joint(f"J{k}", f"b{k - 1}", f"b{k}", kind="fixed", compliance=compliance) for k in range(1, len(pieces))]
    return Mechanism(links, [Joint("A", "base", "b0", kind=kind), *joints], **more)


@pytest.mark.long
@BOTH
def test_deflection_and_twist_of_a_cantilever(elements):
    """Moments at the middles of m segments: the midpoint rule of P (L - x)^2 / EI."""
    m, load = 3, 1e-3
    end = (LENGTH, 0.0, 0.0)
    forces = PointForce("down", "arm", end, force=(0, 0, load)), PointMoment("twist", "arm", end, moment=(load, 0, 0))
    found = assemble(discretise(bar(m + 1, forces=forces, gravity=(0.0, 0.0, 0.0)), elements=elements), hold={})
    x, _, z, about_x, about_y, _ = np.asarray(found.state.position.elastic)[:, -1]
    expected = load * LENGTH**3 / (3.0 * STIFFNESS.bending_y) * (1.0 - 0.25 / m**2)
    assert int(found.status) == 0
    assert z - LENGTH / (4.0 * m) * about_y == pytest.approx(expected, rel=1e-6)
    assert about_x == pytest.approx(load * LENGTH / STIFFNESS.torsion, rel=1e-6)
    assert -1e-8 < x < 0.0  # it bends without becoming longer


@pytest.mark.long
def test_frequencies_are_those_of_euler_and_bernoulli_and_of_torsion():
    """Rotary inertia lowers the second bending frequencies by a few thousandths; errors are of second order."""
    coarse, fine = (natural_frequencies(discretise(bar(n)), count=8) for n in (5, 9))
    roots, mass = np.array([1.8751041, 4.6940911]), STIFFNESS.line_density
    for shape, rigidity in ((4, STIFFNESS.bending_y), (5, STIFFNESS.bending_z)):
        found = []
        for modes in (coarse, fine):
            angles = np.abs(np.asarray(modes.elastic)[:, 3:]).max(axis=2)
            found.append(np.asarray(modes.frequency)[angles.argmax(axis=1) == shape - 3][:2])
        limit = found[1] + (found[1] - found[0]) / 3.0
        expected = roots**2 / (2.0 * np.pi) * np.sqrt(rigidity / (mass * LENGTH**4))
        np.testing.assert_allclose(limit, expected, rtol=6e-3)
        assert limit[0] == pytest.approx(expected[0], rel=1e-3)
    turning = np.sqrt(STIFFNESS.torsion / STIFFNESS.rotary_x) / (4.0 * LENGTH)
    angles = [np.abs(np.asarray(modes.elastic)[:, 3:]).max(axis=2).argmax(axis=1) for modes in (coarse, fine)]
    first, second = (np.asarray(m.frequency)[a == 0][0] for m, a in zip((coarse, fine), angles, strict=True))
    assert second + (second - first) / 3.0 == pytest.approx(turning, rel=1e-4)


@pytest.mark.long
def test_limit_of_links_with_all_coordinates():
    """Frequencies of a loop, to first order in the compliances that the links do not have."""
    loop, off = four_bar(3, gravity=(0.0, 0.0, 0.0)), []
    full, rigid = discretise(loop), natural_frequencies(discretise(slender(loop)), count=6).frequency
    for factor in (1e2, 1e4):
        stiff = full.section.stiffness.at[:3].multiply(factor)
        stiff = eqx.tree_at(lambda m: m.section.stiffness, full, stiff)
        off.append(np.abs(natural_frequencies(stiff, count=6).frequency / rigid - 1.0).max())
    assert off[0] < 2e-3
    assert off[1] == pytest.approx(1e-2 * off[0], rel=0.05)


@pytest.mark.long
@BOTH
def test_planar_motion_is_that_of_rigid_bodies_with_springs(elements):
    """Far from straight and fast: in the plane the springs of both forms of elements are linear in the angles."""
    rfes, rng = 4, np.random.default_rng(2)
    angles, rates = 0.5 * rng.normal(size=rfes), 20.0 * rng.normal(size=rfes)
    one, other = discretise(bar(rfes, "revolute"), elements=elements), discretise(bodies(rfes, "revolute"))

    def elastic(values):
        rows = np.zeros((6, rfes - 1))
        rows[4] = np.cumsum(values[1:])
        return Coordinates(jnp.asarray(values[:1]), jnp.asarray(rows))

    def of_bodies(values):
        about_y = [i for i, freedom in enumerate(other.topology.freedoms) if freedom.rotation and freedom.axis == 1]
        assert len(about_y) == rfes
        joints = np.zeros(other.topology.n_freedoms)
        joints[about_y] = values
        return Coordinates(jnp.asarray(joints), jnp.zeros((6, 0))), about_y

    found = []
    for model, (position, velocity) in (
        (one, (elastic(angles), elastic(rates))),
        (other, (of_bodies(angles)[0], of_bodies(rates)[0])),
    ):
        actual = apply_errors(model, assembly_errors(model))
        state = State(position, velocity)
        found.append(accelerations(actual, state, DriveInput(), NOTHING).coordinates)
    chain, expected = found[0], np.asarray(found[1].joints)[of_bodies(rates)[1]]
    found = np.append(chain.joints, np.diff(np.asarray(chain.elastic)[4], prepend=0.0))
    np.testing.assert_allclose(found, expected, rtol=1e-9)


@pytest.mark.long
def test_small_motion_in_space_is_that_of_rigid_bodies_with_springs():
    model = discretise(bar(3, gravity=(0.0, 0.0, 0.0)))
    expected = natural_frequencies(discretise(bodies(3, gravity=(0.0, 0.0, 0.0))), count=6)
    found = natural_frequencies(model, count=6)
    np.testing.assert_allclose(found.frequency, expected.frequency, rtol=1e-7)
    np.testing.assert_allclose(found.damping, expected.damping, rtol=1e-6)
    # The limit of the step has its own matrices.
    rates = np.sort(np.unique(np.round(np.abs(eigenvalues(model)), 3)))
    np.testing.assert_allclose(rates[-1], 2.0 * np.pi * np.asarray(found.frequency)[-1], rtol=1e-5)


@pytest.fixture(scope="module")
def models():
    """The study's four-bar with few rfes, with all coordinates and without axial and shear ones."""
    return discretise(four_bar(4)), discretise(slender(four_bar(4)))


def test_steps_grow(models):
    full, chains = models
    for method in (RungeKutta4(step=1e-6), Leapfrog(step=1e-6)):
        steps = [largest_stable_step(model, method) for model in (full, chains)]
        assert steps[1] > 2.0 * steps[0]


def test_coordinates_and_mobility(models):
    full, chains = (describe(model) for model in models)
    assert (full.coordinates - chains.coordinates, full.rank) == (3 * 6, chains.rank)
    assert not chains.redundant


def run(model, method, errors, duration=0.03):
    return simulate(Simulation(model, drive=None, method=method, duration=duration, save_every=0.01), errors)


@pytest.mark.long
def test_loads_and_balances_of_explicit_and_implicit_methods(models):
    full, chains = models
    errors = {"D.delta_x": ERROR}
    expected = run(full, RungeKutta4(step=2e-5), errors)
    step = 0.9 * largest_stable_step(chains, RungeKutta4(step=1e-6))
    runs = [run(chains, method, errors) for method in (RungeKutta4(step=step), GeneralisedAlpha(step=2e-4))]
    for one in (expected, *runs):
        assert int(one.status) == 0
    for name, load in runs[0].metrics.rms_force.items():
        assert load == pytest.approx(float(expected.metrics.rms_force[name]), rel=5e-3)
        assert load == pytest.approx(float(runs[1].metrics.rms_force[name]), rel=2e-3)


@pytest.mark.long
@pytest.mark.parametrize("method", [RungeKutta4(step=4e-5), GeneralisedAlpha(step=1e-3, tolerance=1e-12)])
def test_derivatives(models, method):
    def loads(numbers):
        errors = {"D.delta_x": numbers[0], "coupler.length": 1e-2 * numbers[1]}
        found = run(models[1], method, errors, 0.004)
        return jnp.stack([found.metrics.rms_force["C"], found.metrics.rms_moment["B"]])

    at, steps = [ERROR, 1e-2], [1e-5, 1e-4]
    check_derivatives(loads, at, steps, reverse=1e-6, differences=1e-4, floor=1e-3)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (("bending",), r'must be \["bending", "torsion"\] or all of'),
        (("bending", "torsion", "axial"), "but was"),
        (("bending", "torsion", "torsion"), "leave it out for all"),
        ("bending", "must be"),
    ],
)
def test_other_words_are_refused(given, words):
    with pytest.raises(InputError, match=words):
        Link("arm", LENGTH, BLADE, STEEL, flexibility=given)


def test_a_rigid_link_is_refused():
    with pytest.raises(InputError, match="`flexibility` of link `arm` must be left out where the link is rigid"):
        Link("arm", LENGTH, BLADE, STEEL, rigid=True, flexibility=ANGLES)


def test_all_four_are_the_usual_link():
    assert not Link("arm", LENGTH, BLADE, STEEL, flexibility=("axial", "shear", "bending", "torsion")).slender


def test_redundant_loops_are_refused():
    loop = four_bar(None, redundant_reactions="minimum_norm")
    arm, hinge = Link("arm", LENGTH, BLADE, STEEL, rfes=3, flexibility=ANGLES), Joint("E", "rocker", "arm")
    loop = dataclasses.replace(loop, links=(*loop.links, arm), joints=(*loop.joints, hinge))
    with pytest.raises(InputError, match="`flexibility` of link"):
        discretise(loop)
