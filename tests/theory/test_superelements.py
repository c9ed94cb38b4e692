"""Reduced bodies: against beam finite elements, closed forms, links of rfes, and mass points that they stand for."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import eigh
from scipy.spatial.transform import Rotation

from rfem_jax import (
    AxisPoint,
    DistributedForce,
    GeneralisedAlpha,
    GivenSection,
    InputError,
    Joint,
    Leapfrog,
    Link,
    Mechanism,
    MomentRamp,
    Point,
    PointForce,
    PointMass,
    PrescribedRate,
    Problem,
    ReducedBody,
    RungeKutta4,
    Simulation,
    assemble,
    assembly_errors,
    discretise,
    equations_of_motion,
    natural_frequencies,
    simulate,
    static_loads,
)
from rfem_jax.mechanics.dynamics.energy_and_momentum import energies, momentum, momentum_residual
from rfem_jax.mechanics.dynamics.loads import base_wrench
from rfem_jax.mechanics.elements.elasticity import dissipated_power
from rfem_jax.mechanics.implicit.condensation import link_operators
from rfem_jax.mechanics.implicit.residual import evaluate_residual
from rfem_jax.mechanics.model.inputs import DriveInput
from rfem_jax.mechanics.model.model import Coordinates, State
from rfem_jax.mechanics.model.orientations import position_rate
from rfem_jax.mechanics.model.with_errors import apply_errors
from rfem_jax.simulation.vibrations.modes import linearised
from rfem_jax.simulation.vibrations.vibration import Vibration
from tests.derivatives import check_derivatives, jacobians
from tests.frames_of_beams import (
    AREA,
    DENSITY,
    INERTIA,
    MODULUS,
    SHEAR_MODULUS,
    TORSION,
    WIDTH,
    frame_of,
    reduced,
    straight,
)
from tests.mechanisms import link as steel_bar

NOTHING = (0.0, 0.0, 0.0)
ERRORS = {"D.d_y": 1e-3, "D.delta_x": np.radians(0.5)}
DAMPING = 0.02  # s, of the body of mass points
SLENDER = 1e3  # times the shear stiffness: the finite elements do not shear
BEAM = GivenSection(
    axial_stiffness=MODULUS * AREA,
    shear_stiffness_y=SLENDER * SHEAR_MODULUS * AREA,
    shear_stiffness_z=SLENDER * SHEAR_MODULUS * AREA,
    torsion_stiffness=SHEAR_MODULUS * TORSION,
    bending_stiffness_y=MODULUS * INERTIA,
    bending_stiffness_z=MODULUS * INERTIA,
    line_density=DENSITY * AREA,
    rotary_inertia_x=DENSITY * 2.0 * INERTIA,
    rotary_inertia_y=DENSITY * INERTIA,
    rotary_inertia_z=DENSITY * INERTIA,
    damping=1e-5,
)
ANGLE_FRAME = np.array([[0.01 * k, 0.0, 0.0] for k in range(21)] + [[0.2, 0.0, 0.01 * k] for k in range(1, 16)])


def bar(name, length, modes=6):
    body, _ = reduced(straight(length), (0, 24), modes, damping=1e-5)
    return Link(name, body=body)


def four_bar(link, **more):
    links = [Link("crank", 0.12, BEAM, rigid=True), link("coupler", 0.3), link("rocker", 0.3)]
    joints = [
        Joint("A", "base", "crank", angle=-np.pi / 2.0),
        Joint("B", "crank", "coupler", angle=np.radians(54.4)),
        Joint("D", "base", "rocker", position=(0.3, 0.0, 0.0), angle=np.radians(-100.8)),
        Joint("C", "coupler", "rocker", cut=True),
    ]
    return Mechanism(links, joints, gravity=(0.0, 0.0, -9.81), driven_joint="A", **more)


def clamped(body, **more):
    joint = Joint("A", "base", "part", kind="fixed")
    return Mechanism([Link("part", body=body)], [joint], **{"gravity": NOTHING, **more})


@pytest.fixture(scope="module")
def linkage():
    return discretise(four_bar(bar))


@pytest.fixture(scope="module")
def of_rfes():
    return [discretise(four_bar(lambda name, length, n=n: Link(name, length, BEAM, rfes=n))) for n in (9, 17)]


def extrapolated(coarse, fine):
    """Richardson's value of results whose error falls with the square of the number of sdes (8 and 16)."""
    return fine + (fine - coarse) / 3.0


def forces_of(loads):
    return np.concatenate([np.concatenate([one.force, one.moment]) for one in loads.values()])


@pytest.mark.long
def test_a_bar_is_assembled_as_a_beam(linkage, of_rfes):
    found = forces_of(assemble(linkage, ERRORS).preload)
    coarse, fine = (forces_of(assemble(model, ERRORS).preload) for model in of_rfes)
    assert np.abs(coarse - found).max() > 5e-3 * np.abs(found).max()  # the rfes need extrapolation
    np.testing.assert_allclose(found, extrapolated(coarse, fine), atol=2e-4 * np.abs(found).max())


@pytest.mark.long
def test_a_bar_moves_as_a_beam(linkage, of_rfes):
    def run(model):
        return simulate(
            Simulation(
                model,
                drive=MomentRamp("A", 24.0, 0.02),
                method=GeneralisedAlpha(step=5e-5),
                duration=0.03,
                save_every=2e-3,
            ),
            ERRORS,
        )

    runs = [run(model) for model in (linkage, *of_rfes)]
    found, coarse, fine = (
        np.concatenate([np.concatenate([one.force, one.moment], axis=1) for one in run.loads.values()], axis=1)
        for run in runs
    )
    size = np.abs(found).max(axis=0)
    scale = np.maximum(size, 0.02 * size.max())
    assert runs[0].motion.rate[-1] > 30.0  # rad/s: inertia counts
    assert float(runs[0].checks.energy_balance_error) < 1e-4 and float(runs[0].checks.momentum_balance_error) < 1e-12
    assert (np.abs(found - extrapolated(coarse, fine)) / scale).max() < 0.01


def test_frequencies_of_a_cantilever():
    # Blevins, Formulas for Natural Frequency and Mode Shape (1979), table 8-1.
    model = discretise(clamped(reduced(straight(0.3), (0, 24), 9)[0]))
    found = natural_frequencies(model, count=100)
    assert len(found.frequency) == 6 + 9  # none of what the places of six more leave over
    frequencies = found.frequency[:4]
    closed = np.repeat([1.8751041, 4.6940911], 2) ** 2 * np.sqrt(MODULUS * INERTIA / (DENSITY * AREA)) / 0.3**2
    np.testing.assert_allclose(frequencies, closed / (2.0 * np.pi), rtol=2e-4)


@pytest.mark.long
def test_a_free_body_vibrates_as_its_matrices_say_in_any_axes_and_order():
    """The same body turned, and with another interface first, whose frame the link has."""
    body, _ = reduced(ANGLE_FRAME, (0, 20, 35), 2)
    turn = Rotation.from_rotvec([0.4, -0.7, 1.1]).as_matrix()
    axes = np.eye(len(body.mass))
    axes[:18, :18] = np.kron(np.eye(6), turn)
    order = np.r_[12:18, 0:12, 18:20]
    arrays = [np.asarray(one) for one in (body.interfaces, body.mass, body.stiffness)]
    turned = ReducedBody(arrays[0] @ turn.T, *(axes @ one @ axes.T for one in arrays[1:]))
    other = ReducedBody(arrays[0][[2, 0, 1]], *(one[np.ix_(order, order)] for one in arrays[1:]))
    squares = eigh(body.stiffness, body.mass, eigvals_only=True)[6:]
    for one in (body, turned, other):
        mechanism = Mechanism([Link("part", body=one)], [Joint("A", "base", "part", kind="free")], gravity=NOTHING)
        found = natural_frequencies(discretise(mechanism), count=20).frequency[6:]
        np.testing.assert_allclose(found, np.sqrt(squares) / (2.0 * np.pi), rtol=1e-7)


def test_modes_that_limit_steps_are_those_of_beams(linkage, of_rfes):
    found, coarse, fine = (
        np.sqrt(np.sort(Vibration(model).modes(np.asarray(model.start_joints)).squares)[1:7])
        for model in (linkage, *of_rfes)
    )
    # The finite elements have no rotary inertia, which lowers the higher ones.
    np.testing.assert_allclose(found, extrapolated(coarse, fine), rtol=3e-3)


@pytest.mark.long
def test_frequencies_of_a_bent_part_under_its_weight():
    """A rocker of two legs, which its weight bends by 1 mrad: frequencies change as those of rfes, a little."""
    end = ANGLE_FRAME[35]
    body, _ = reduced(ANGLE_FRAME, (0, 20, 35), 6)
    corner = [AxisPoint(tuple(ANGLE_FRAME[k].tolist())) for k in (20, 35)]
    changes = []
    for rocker in (Link("rocker", body=body), Link("rocker", section=BEAM, axis=corner, rfes=7)):
        links = [Link("crank", 0.12, BEAM, rigid=True), Link("coupler", 0.3, BEAM, rigid=True), rocker]
        joints = [
            Joint("A", "base", "crank", angle=-np.pi / 2.0),
            Joint("B", "crank", "coupler", angle=1.13),
            Joint("D", "base", "rocker", position=(0.3, 0.0, 0.0), angle=-1.04),
            Joint("C", "coupler", "rocker", cut=True, child_position=tuple(end.tolist())),
        ]
        model = discretise(Mechanism(links, joints, gravity=NOTHING, driven_joint="A"))
        light, heavy = (
            natural_frequencies(replace(model, gravity=jnp.array([0.0, 0.0, g])), count=5) for g in (0.0, -40.0)
        )
        assert light.status == 0 and heavy.status == 0 and np.abs(heavy.position.elastic).max() > 1e-3
        changes.append(np.asarray(heavy.frequency / light.frequency)[[0, 2, 4]] - 1.0)
    np.testing.assert_allclose(*changes, atol=5e-4)


@pytest.mark.parametrize("modes", [0, 4])
def test_a_frame_under_a_force_bends_as_its_finite_elements(modes):
    body, _ = reduced(ANGLE_FRAME, (0, 20, 35), modes)
    end = tuple(ANGLE_FRAME[35])
    force = np.array([0.2, 0.3, -0.4])
    points = [Point("corner", "part", tuple(ANGLE_FRAME[20])), Point("end", "part", end)]
    forces = [PointForce("pull", "part", end, tuple(force))]
    model = discretise(clamped(body, forces=forces, points=points))
    stiffness, _ = frame_of(ANGLE_FRAME)
    load = np.zeros(6 * 36)
    load[6 * 35 : 6 * 35 + 3] = force
    moved = np.zeros(6 * 36)
    moved[6:] = np.linalg.solve(stiffness[6:, 6:], load[6:])
    result = static_loads(model)
    assert result.status == 0
    for name, node in (("corner", 20), ("end", 35)):
        shift = np.asarray(result.points[name].position)[0] - ANGLE_FRAME[node]
        np.testing.assert_allclose(shift, moved[6 * node : 6 * node + 3], atol=2e-3 * np.abs(moved).max())


@pytest.mark.long
def test_weight_of_a_frame():
    gravity = np.array([2.0, 3.0, -9.0])
    body, rows = reduced(ANGLE_FRAME, (0, 20, 35), 12)
    model = discretise(clamped(body, gravity=tuple(gravity), points=[Point("end", "part", tuple(ANGLE_FRAME[35]))]))
    stiffness, mass = frame_of(ANGLE_FRAME)
    weight = mass @ np.tile(np.concatenate([gravity, NOTHING]), 36)
    along = rows[6:, 6:]
    moved = along @ np.linalg.solve(along.T @ stiffness[6:, 6:] @ along, along.T @ weight[6:])
    result = static_loads(model)
    shift = np.asarray(result.points["end"].position)[0] - ANGLE_FRAME[35]
    np.testing.assert_allclose(shift, moved[-6:-3], rtol=1e-3)
    load = result.loads["A"]
    np.testing.assert_allclose(np.asarray(load.force)[0], -weight.reshape(36, 6)[:, :3].sum(axis=0), rtol=1e-6)
    moment = np.cross(ANGLE_FRAME, weight.reshape(36, 6)[:, :3]).sum(axis=0) + weight.reshape(36, 6)[:, 3:].sum(axis=0)
    np.testing.assert_allclose(np.asarray(load.moment)[0], -moment, atol=1e-3 * np.abs(moment).max())


def test_a_turning_bar_is_stretched_by_its_weight_in_the_turn():
    # rho w^2 L^3 / (3 E): each part carries the centrifugal forces beyond it.
    body = reduced(straight(0.3), (0, 24), 6, damping=2e-4)[0]
    link = Link("part", body=body)
    mechanism = Mechanism([link], [Joint("A", "base", "part")], gravity=NOTHING, driven_joint="A")
    rate = 200.0
    simulation = Simulation(
        discretise(mechanism),
        drive=PrescribedRate("A", rate, rise_time=0.02),
        method=GeneralisedAlpha(step=5e-5),
        duration=0.06,
        save_every=0.06,
    )
    run = simulate(simulation, record=["part.deflection"])
    stretched = DENSITY * rate**2 * 0.3**3 / (3.0 * MODULUS)
    np.testing.assert_allclose(np.asarray(run.recorded["part.deflection"])[-1, 0], stretched, rtol=1e-3)


def mass_points(seed=3, n=40, interfaces=3, modes=5):
    """Points with masses whose displacements are linear in those of interfaces and in amplitudes of modes."""
    random = np.random.default_rng(seed)
    places = np.array([[0.0, 0.0, 0.0], [0.25, 0.02, 0.05], [0.1, -0.03, -0.12]])
    points, masses = random.normal(size=(n, 3)) * 0.1, random.uniform(0.01, 0.02, n)
    shapes = random.normal(size=(n, 3, 6 * interfaces + modes))
    # Rigid motions of the interfaces move all points as one body.
    rigid = np.zeros((6 * interfaces + modes, 6))
    for i, (x, y, z) in enumerate(places):
        rigid[6 * i : 6 * i + 6] = np.eye(6)
        rigid[6 * i : 6 * i + 3, 3:] = [[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]]
    wanted = np.concatenate([np.broadcast_to(np.eye(3), (n, 3, 3)), -cross_matrices(points)], axis=2)
    shapes = shapes - (shapes @ rigid - wanted) @ np.linalg.pinv(rigid)
    moments = np.einsum("n,na,nbk->abk", masses, points, shapes)
    mass = np.einsum("n,nak,nal->kl", masses, shapes, shapes)
    spread = random.normal(size=(6 * interfaces + modes,) * 2)
    stiffness = spread @ spread.T * 1e3
    stiffness = stiffness - stiffness @ rigid @ np.linalg.solve(rigid.T @ stiffness @ rigid, rigid.T @ stiffness)
    return places, points, masses, shapes, ReducedBody(places, mass, stiffness, moments=moments)


def cross_matrices(vectors):
    x, y, z = vectors.T
    zero = np.zeros_like(x)
    return np.stack([np.stack([zero, -z, y]), np.stack([z, zero, -x]), np.stack([-y, x, zero])]).transpose(2, 0, 1)


def test_inertia_is_that_of_the_mass_points_to_first_order():
    """Kinetic energy and momenta of a moving, deformed body beside sums over the points, each at its place; what is
    left is of second order in the deformation."""
    _, points, masses, shapes, body = mass_points()
    part = Link("part", body=body)
    joint = Joint("A", "base", "part", kind="free", position=(0.3, -0.2, 0.1))
    model = discretise(Mechanism([part], [joint], gravity=(1.0, 2.0, -9.0)))
    actual = apply_errors(model, assembly_errors(model))
    random = np.random.default_rng(5)
    rates = random.normal(size=model.topology.n_freedoms)
    q, q_dot = random.normal(size=(2, 18)) * 0.02
    q, q_dot = (one.reshape(6, 3) * (np.arange(18) != 17).reshape(6, 3) for one in (q, q_dot))  # 5 modes, 6 places
    start = np.asarray(model.start_joints)
    size = np.sqrt(body.total_mass / np.diag(body.mass)[18:])
    length = np.linalg.norm(np.ptp(np.asarray(body.interfaces), axis=0))
    at = [*range(6, 18), *range(18, 23)]  # rows of the body by the coordinates

    @jax.jit
    def ours(share):
        elastic = [share * x for x in (q, q_dot)]
        state = State(Coordinates(jnp.asarray(start), elastic[0]), Coordinates(jnp.asarray(rates), elastic[1]))
        found = energies(actual, state)
        return jnp.concatenate([jnp.stack([found.kinetic, found.gravity]), *momentum(actual, state)])

    def exact(share):
        both = []
        for values in (q, q_dot):
            values = share * values
            amplitudes = values[:, 2][:5] * np.where(np.arange(5) < 3, size, size * length)
            both.append(np.concatenate([values[:, 0], values[:, 1], amplitudes]))
        moved, moving = (shapes[:, :, at] @ one for one in both)
        spin, velocity = rates[3:], rates[:3]
        here = points + moved
        speed = velocity + np.cross(spin, here) + moving
        there = here + np.array([0.3, -0.2, 0.1])
        linear, angular = masses @ speed, masses @ np.cross(there, speed)
        weight = -(masses @ here) @ np.array([1.0, 2.0, -9.0])
        return np.concatenate([[0.5 * masses @ (speed**2).sum(axis=1), weight], linear, angular])

    for share, most in ((0.0, 1e-12), (1.0, 0.2), (0.1, 2e-3)):
        gap = np.abs(np.asarray(ours(share)) - exact(share)) / np.abs(exact(share)).max()
        assert gap.max() <= most
    first, tenth = (np.abs(np.asarray(ours(share)) - exact(share)) for share in (1.0, 0.1))
    counted = first > 1e-9
    assert counted.any() and (tenth[counted] < 0.012 * first[counted]).all()


def free_part():
    """The body of mass points, with damping and a mass on an interface, and nothing that holds it."""
    *_, body = mass_points()
    far = tuple(np.asarray(body.interfaces)[1].tolist())
    masses = [PointMass(0.1, far, (1e-3, 2e-3, 2e-3))]
    part = Link("part", body=replace(body, damping=DAMPING), point_masses=masses)
    joint = Joint("A", "base", "part", kind="free", position=(0.3, -0.2, 0.1))
    return Mechanism([part], [joint], gravity=(1.0, 2.0, -9.0))


@pytest.mark.long
def test_loads_are_those_of_the_momenta_and_the_energy():
    """In any motion, whether it obeys the equations or not, the base exerts the rate of the momenta, and all forces
    that are left over do the work that the energies change by. Both hold for the linear energy without a remainder."""
    model = discretise(free_part())
    actual = apply_errors(model, assembly_errors(model))
    topology = model.topology

    @jax.jit
    def gaps(position, velocity, accelerations):
        state = State(position, velocity)
        found = evaluate_residual(actual, state, accelerations, jnp.zeros(0), DriveInput(), 1.0)
        base = base_wrench(topology, found.wrenches)
        tangents = position_rate(topology, position, velocity), accelerations
        _, power = jax.jvp(lambda *at: sum(energies(actual, State(*at))), (position, velocity), tangents)
        elastic = jnp.concatenate([found.force, found.moment])
        work = jnp.vdot(found.hinge, velocity.joints) + jnp.vdot(elastic, velocity.elastic) + found.dissipated
        size = jnp.abs(found.hinge) @ jnp.abs(velocity.joints) + jnp.vdot(jnp.abs(elastic), jnp.abs(velocity.elastic))
        momenta = jnp.concatenate(momentum_residual(actual, state, accelerations, base))
        again = jnp.abs(dissipated_power(actual, state) / found.dissipated - 1.0)
        return jnp.abs(momenta).max() / jnp.abs(base).max(), jnp.abs(work + power) / size, again

    random, start = np.random.default_rng(8), np.asarray(model.start_joints)
    for _ in range(8):  # the generalised loads do not depend on the rates of the coordinates, all of which are tried
        q, rates, second = random.normal(size=(3, 6, topology.n_rfes)) * [[[0.02]], [[1.0]], [[10.0]]]
        joints, turned = random.normal(size=(2, topology.n_freedoms)) * [[3.0], [20.0]]
        at = (start, q), (joints, rates), (turned, second)
        assert max(gaps(*(Coordinates(*map(jnp.asarray, one)) for one in at))) < 1e-12


def test_a_body_is_condensed_as_its_whole_matrices():
    """To its frame, in a step by which coordinates and rates follow accelerations: the Schur complement of M + s K."""
    model = discretise(replace(free_part(), gravity=NOTHING))
    actual, by_position, by_rate = apply_errors(model, assembly_errors(model)), 1e-6, 2e-5
    start = Coordinates(jnp.asarray(model.start_joints), jnp.zeros((6, model.topology.n_rfes)))
    whole = jax.jit(lambda at: linearised(actual, at, jnp.zeros(0), jnp.ones(())))(start)
    frame, rest = np.arange(6), np.arange(6, 24)
    system = np.asarray(whole.mass) + (by_position + DAMPING * by_rate) * np.asarray(whole.stiffness)
    condensed = system[:6, :6] - system[np.ix_(frame, rest)] @ np.linalg.solve(system[6:, 6:], system[6:, :6])
    (found,) = link_operators(actual, jnp.asarray(by_position), jnp.asarray(by_rate))
    angles_first = np.roll(frame, 3)
    wanted = condensed[np.ix_(angles_first, angles_first)]
    np.testing.assert_allclose(found.inertia, wanted, atol=1e-10 * np.abs(wanted).max())


def test_without_moments_interfaces_say_them():
    """Of a bar along x the linear field along it is one that its interfaces can have; fields across it are as its ends
    are joined by a straight line."""
    length, parts = 0.3, 24
    body, rows = reduced(straight(length, parts), (0, parts), 6)
    _, mass = frame_of(straight(length, parts))
    x = straight(length, parts)[:, 0]
    moments = np.zeros((3, 3, len(body.mass)))
    for b in range(3):
        field = np.zeros((parts + 1, 6))
        field[:, b] = x
        if b:  # the slope of the field
            field[:, 4 if b == 2 else 5] = -1.0 if b == 2 else 1.0
        moments[0, b] = rows.T @ mass @ field.reshape(-1)
    told = ReducedBody(body.interfaces, body.mass, body.stiffness, moments=moments)
    models = [discretise(clamped(some)) for some in (body, told)]
    one, other = (np.asarray(model.superelements[0].inertia) for model in models)
    np.testing.assert_allclose(one, other, atol=1e-6 * np.abs(other).max())


@pytest.mark.long
def test_exact_elements_and_point_masses_beside_it():
    def mixed(elements):
        def link(name, length):
            if name == "coupler":
                return steel_bar(name, length, 5)
            one = bar(name, length)
            return replace(one, point_masses=(PointMass(0.1, (length, 0.0, 0.0), (1e-5, 1e-5, 1e-5)),))

        return discretise(four_bar(link, elements=elements))

    method, drive = GeneralisedAlpha(step=1e-4), MomentRamp("A", 4.0, 0.01)
    simulations = [
        Simulation(mixed(one), drive=drive, method=method, duration=5e-3, save_every=1e-3)
        for one in ("linear", "geometrically_exact")
    ]
    runs = [simulate(one, ERRORS) for one in simulations]
    assert all(run.status == 0 and float(run.checks.momentum_balance_error) < 1e-12 for run in runs)
    linear, exact = (run.metrics.rms_force["C"] for run in runs)
    np.testing.assert_allclose(linear, exact, rtol=5e-3)


@pytest.mark.long
def test_derivatives(linkage):
    def loads(numbers):
        names = "D.d_y", "D.delta_x", "rocker.length", "rocker.damping"
        errors = dict(zip(names, numbers * jnp.array([1.0, 10.0, 1.0, 1e-2]), strict=True))
        simulation = Simulation(
            linkage,
            drive=MomentRamp("A", 4.0, 2e-3),
            method=GeneralisedAlpha(step=2e-4, tolerance=1e-12),
            duration=4e-3,
        )
        found = simulate(simulation, errors)
        return jnp.stack([found.metrics.rms_force["C"], found.metrics.rms_moment["B"]])

    at, steps = np.array([1e-3, 1e-3, 1e-4, 0.0]), np.full(4, 1e-6)
    found = check_derivatives(loads, at, steps, reverse=1e-6, differences=1e-4, floor=1e-4)
    assert (np.abs(found.forward) > 0.0).all()


@pytest.mark.long
def test_derivatives_without_errors_and_loads():
    """At rest, where nothing is loaded and stresses, as all sizes of loads, are at the foot of a square root."""
    part, _ = reduced(straight(0.3), (0, 24), 2)
    rows = np.zeros((1, 6, len(part.mass)))
    rows[0, 0], rows[0, 3] = np.asarray(part.stiffness)[4:6] * 1e6
    part = replace(part, stresses=rows)

    def link(name, length):
        return Link(name, body=part) if name == "rocker" else Link(name, length, BEAM, rigid=True)

    model = discretise(replace(four_bar(link), gravity=NOTHING))
    names, units = ("D.d_y", "D.delta_x", "C.child.delta_z", "rocker.length"), np.array([1.0, 10.0, 10.0, 1.0])

    def loads(numbers):
        found = static_loads(model, dict(zip(names, numbers * units, strict=True)))
        forces = [found.loads[name].force[0] for name in "BC"], [found.loads[name].moment[0] for name in "BC"]
        return jnp.concatenate([*forces[0], *forces[1], 1e-6 * found.stress["rocker"].reshape(-1)])

    at = np.zeros(4)
    found = jacobians(loads, at, np.full(4, 1e-6))
    sizes = np.abs(found.forward).max()
    assert sizes > 1e5 and np.isfinite(found.forward).all()  # that of the stress may have either sign
    np.testing.assert_allclose(found.reverse, found.forward, atol=1e-9 * sizes)
    np.testing.assert_allclose(found.differences[:-1], found.forward[:-1], atol=1e-9 * sizes)
    several = np.array([at, [1e-4, 0.0, 0.0, 0.0]])
    alone = np.stack([jax.jit(loads)(one) for one in several])
    np.testing.assert_allclose(jax.vmap(loads)(jnp.asarray(several)), alone, atol=1e-9 * np.abs(alone).max())


def test_stresses_follow_from_moments():
    """Stress at the clamp by rows of its moments, M / W, at two places of it."""
    body, _ = reduced(straight(0.3), (0, 24), 4)
    rows = np.zeros((2, 6, len(body.mass)))
    rows[0, 0] = np.asarray(body.stiffness)[4] / (INERTIA / (WIDTH / 2.0))
    rows[0, 3] = 0.5 * rows[0, 0]
    rows[1, 1] = rows[1, 2] = 3.0 * rows[0, 0]
    rows[1, 0] = 2.5 * rows[0, 0]  # a pressure but for a small part
    body = ReducedBody(body.interfaces, body.mass, body.stiffness, stresses=rows, stress_names=("clamp", "other"))
    model = discretise(clamped(body, forces=[PointForce("push", "part", (0.3, 0.0, 0.0), (0.0, 0.0, 2.0))]))
    result = static_loads(model)
    direct = 2.0 * 0.3 / (INERTIA / (WIDTH / 2.0))
    np.testing.assert_allclose(np.asarray(result.stress["part"])[0], direct * np.sqrt(1.0 + 0.75), rtol=1e-5)


def test_a_longer_body_moves_its_interface():
    """A length error moves the far interface as an error of the joint there moves the joint."""
    model = discretise(replace(four_bar(bar), gravity=NOTHING))
    found = [assemble(model, {name: 2e-4}).state.position.joints for name in ("rocker.length", "C.child.d_x")]
    assert np.abs(found[0] - np.asarray(model.start_joints)).max() > 1e-4
    np.testing.assert_allclose(found[0], found[1], atol=1e-8)


def test_what_needs_an_implicit_method_says_so(linkage):
    for method in (RungeKutta4(step=1e-6), Leapfrog(step=1e-6)):
        simulation = Simulation(linkage, drive=MomentRamp("A", 1.0, 0.01), method=method, duration=0.01)
        with pytest.raises(InputError, match="generalised_alpha"):
            simulate(simulation)
        with pytest.raises(InputError, match="reduced bodies"):
            equations_of_motion(simulation)


def test_what_is_off_the_interfaces_is_refused(linkage):
    with pytest.raises(InputError, match=r"must be an interface .* \(0, 0, 0\), \(0.3, 0, 0\)"):
        discretise(four_bar(bar, points=[Point("middle", "rocker", (0.15, 0.0, 0.0))]))
    with pytest.raises(InputError, match="interfaces alone forces act"):
        four_bar(bar, forces=[DistributedForce("wind", "rocker", (0.0, 1.0, 0.0))])
    method, drive = GeneralisedAlpha(step=1e-4), MomentRamp("A", 1.0, 0.01)
    simulation = Simulation(linkage, drive=drive, method=method, duration=0.01)
    with pytest.raises(InputError, match="no sections between"):
        Problem(simulation, ["rocker@0.5.peak_deflection"])
    with pytest.raises(InputError, match="does not|do not"):
        Link("part", body=bar("part", 0.3).body, temperature=20.0)


def test_a_rigid_body_has_no_stress():
    body, _ = reduced(straight(0.3), (0, 24), 0)
    body = replace(body, stresses=np.ones((1, 6, 12)))
    joint = Joint("A", "base", "part", kind="fixed")
    result = static_loads(discretise(Mechanism([Link("part", body=body, rigid=True)], [joint])))
    assert result.status == 0 and "part" not in result.stress  # rather than zero


def test_a_stiffness_of_the_wrong_sign_is_refused():
    body, _ = reduced(straight(0.3), (0, 24), 2)
    with pytest.raises(InputError, match="`stiffness` .* diagonal greater than 0"):
        ReducedBody(body.interfaces, body.mass, -np.asarray(body.stiffness))


@pytest.mark.long
def test_motions_without_inertia_get_a_little():
    """Rigid masses at interfaces, and matrices that lost digits: what vibrates slowly does so as before, and fast
    motions are fast. A mass that is negative beyond its digits is refused."""
    body, _ = reduced(straight(0.3), (0, 24), 4)
    mass, size = np.asarray(body.mass), np.sqrt(np.diag(body.mass))
    values, vectors = np.linalg.eigh(mass / size[:, None] / size)
    by_interfaces = np.linalg.pinv(body.rigid_motions)
    rigid = by_interfaces.T @ (body.rigid_motions.T @ mass @ body.rigid_motions) @ by_interfaces
    rigid += np.diag(np.where(np.arange(16) < 12, 0.0, np.diag(mass)))

    def lost(least):
        return mass - (values[0] + least) * np.outer(size * vectors[:, 0], size * vectors[:, 0])

    def lowest(one):
        model = discretise(Mechanism([Link("part", body=one)], [Joint("A", "base", "part", kind="fixed")]))
        return np.asarray(natural_frequencies(model, count=3).frequency)

    for given in (lost(5e-6), rigid):
        found = ReducedBody(body.interfaces, given, body.stiffness)
        assert float(found.total_mass) == pytest.approx(float(body.total_mass), rel=2e-5)
        assert ReducedBody(found.interfaces, found.mass, found.stiffness) == found
        free = np.linalg.eigvals(np.linalg.solve(np.asarray(body.stiffness)[6:, 6:], given[6:, 6:])).real
        slow = np.sort(1.0 / np.sqrt(free[free > 1e-4 * free.max()]))[:3] / (2.0 * np.pi)
        np.testing.assert_allclose(lowest(found)[: len(slow)], slow, rtol=1e-4)
    with pytest.raises(InputError, match="`mass` .* must be that of a body, but has an eigenvalue"):
        ReducedBody(body.interfaces, lost(1e-3), body.stiffness)


@pytest.mark.long
def test_a_part_that_leads_along_the_hinges():
    """As a fork with two bores on one axis: nothing says how sections would be turned, and it has none."""
    along, _ = reduced(straight(0.3), (0, 12, 24), 2)
    turn, rows = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), np.eye(20)
    rows[:18, :18] = np.kron(np.eye(6), turn)
    body = ReducedBody(along.interfaces @ turn.T, rows @ along.mass @ rows.T, rows @ along.stiffness @ rows.T)
    assert (body.interfaces[:, [0, 2]] == 0.0).all()
    model = discretise(Mechanism([Link("part", body=body)], [Joint("A", "base", "part", kind="fixed")]))
    mass, stiffness = (np.asarray(one)[6:, 6:] for one in (body.mass, body.stiffness))
    wanted = np.sqrt(eigh(stiffness, mass, eigvals_only=True)[:4]) / (2.0 * np.pi)
    np.testing.assert_allclose(natural_frequencies(model, count=4).frequency, wanted, rtol=1e-6)
    run = simulate(Simulation(model, drive=None, method=GeneralisedAlpha(step=1e-3), duration=4e-3))
    assert int(run.status) == 0
    weight = float(body.total_mass) * 9.81
    assert float(run.metrics.rms_force["A"]) == pytest.approx(weight, rel=1e-3)


def test_moments_that_the_mass_does_not_have_are_refused():
    *_, body = mass_points()
    moments = np.asarray(body.moments)
    apart = np.asarray(body.mass) @ body.rigid_motions[:, :3]  # of another origin
    elsewhere = moments + np.einsum("a,nb->abn", [0.0, 0.1, 0.0], apart)
    for wrong in (0.0 * moments, moments.swapaxes(0, 1), 1e-3 * moments, elsewhere):
        with pytest.raises(InputError, match="`moments` .* angular momentum about the first interface"):
            replace(body, moments=wrong)
    with pytest.raises(InputError, match="`stiffness` of a reduced body must be n x n numbers"):
        replace(body, stiffness=np.asarray(body.stiffness) * (1.0 + 0.02j))
