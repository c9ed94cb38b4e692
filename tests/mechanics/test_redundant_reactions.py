"""Redundant reactions: the least ones over all joints, in any plane, of links of any mass.

States of self-stress are found here anew, from the equilibrium of all bodies: wrenches in joints that balance on every
link and do no work on free motions. The least reactions are orthogonal to all of them.
"""

from dataclasses import replace
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rfem_jax import (
    STATUS,
    Coordinates,
    GeneralisedAlpha,
    InputError,
    Joint,
    Link,
    Mechanism,
    PointForce,
    PrescribedRate,
    RigidBody,
    RungeKutta4,
    Simulation,
    State,
    assemble,
    assembly_errors,
    describe,
    design,
    discretise,
    kinetostatic_turn,
    natural_frequencies,
    simulate,
)
from rfem_jax.description.methods import named_method
from rfem_jax.mechanics.dynamics import loads as joint_loads
from rfem_jax.mechanics.dynamics.dynamics import accelerations
from rfem_jax.mechanics.model.inputs import DriveInput, Stabilisation
from rfem_jax.mechanics.model.model import length_scale
from rfem_jax.mechanics.model.nominal_geometry import closure_jacobian, geometry_of, place
from rfem_jax.mechanics.model.with_errors import apply_errors
from rfem_jax.mechanics.reference.loads import reference_reactions
from tests.derivatives import check_derivatives, jacobians
from tests.mechanisms import four_bar, link, twisted_spatial_loop

GRAVITY = 9.81
LEAST = {"redundant_reactions": "minimum_norm"}


def plain(name, length, mass=1.0, centre=0.0, inertia=None):
    """A rigid link, its mass `centre` along it."""
    inertia = (1e-3 * mass,) * 3 if inertia is None else inertia
    return Link(name, length, body=RigidBody(mass, (centre, 0.0, 0.0), inertia))


def door(cut="upper", names=("lower", "upper"), **settings):
    """A door of 13 kg on two hinges in line, 1.5 m apart, its mass centre in the middle of them."""
    leaf = Link("leaf", 1.3, body=RigidBody(13.0, (0.65, 0.0, 1.15), (5.73, 7.56, 1.83)))
    upright = (np.pi / 2, 0.0, 0.0)
    joints = [
        Joint(name, "base", "leaf", position=(0, 0, z), orientation=upright, child_position=(0, 0, z),
              child_orientation=upright, cut=place == cut)
        for name, place, z in zip(names, ("lower", "upper"), (0.4, 1.9))
    ]  # fmt: skip
    return Mechanism([leaf], joints, **{**LEAST, **settings})


def loop(cut="C", load=(3.0, 40.0, -5.0)):
    """A rigid planar four-bar, loaded across its plane, cut at C or at D."""
    links = [link("crank", 0.12), link("coupler", 0.3), link("rocker", 0.3)]
    joints = [
        Joint("A", "base", "crank", angle=-np.pi / 2),
        Joint("B", "crank", "coupler", angle=np.radians(54.4)),
        Joint("C", "coupler", "rocker", position=(0.3, 0, 0), child_position=(0.3, 0, 0), cut=cut == "C",
              **({} if cut == "C" else {"angle": np.radians(-65.2)})),
        Joint("D", "base", "rocker", position=(0.3, 0, 0), child_position=(0, 0, 0), cut=cut == "D",
              **({} if cut == "D" else {"angle": np.radians(-100.8)})),
    ]  # fmt: skip
    forces = [PointForce("push", "coupler", (0.1, 0.0, 0.02), force=load)]
    return Mechanism(links, joints, driven_joint="A", forces=forces, **LEAST)


def slider_crank(mass=1.0, **settings):
    joints = [
        Joint("A", "base", "crank", angle=np.radians(45)),
        Joint("B", "crank", "rod", angle=np.radians(-57)),
        Joint("G", "base", "slide", kind="prismatic", displacement=0.39),
        Joint("P", "slide", "rod", position=(0, 0, 0), cut=True),
    ]
    rod = plain("rod", 0.33, 2.0 * mass, 0.11, (1e-3 * mass, 0.04 * mass, 0.04 * mass))
    links = [plain("crank", 0.1, mass), rod, plain("slide", 0.1, 2.0 * mass)]
    return Mechanism(links, joints, driven_joint="A", **{**LEAST, **settings})


def toggle(mass, load=882.9):
    """Two arms of 2 m, the knee 0.258 m above their ends, which a slide holds."""
    arm, angle = np.hypot(1.983, 0.258), np.arctan2(0.258, 1.983)
    links = [plain(name, length, mass) for name, length in (("left", arm), ("right", arm), ("shoe", 0.1))]
    joints = [
        Joint("one", "base", "left", angle=-angle),
        Joint("two", "left", "right", angle=2 * angle),
        Joint("guide", "base", "shoe", kind="prismatic", displacement=3.966),
        Joint("three", "shoe", "right", position=(0, 0, 0), cut=True),
    ]
    forces = [PointForce("knee", "left", (arm, 0.0, 0.0), force=(0.0, 0.0, -load))]
    settings = {"driven_joint": "guide", "gravity": (0.0, 0.0, 0.0), "forces": forces}
    return Mechanism(links, joints, **settings, **LEAST)


def turned(model, rotation):
    """The model with the base's side of everything, and gravity, turned by a rotation (3, 3)."""
    on_base = np.array([parent == -1 for parent in model.topology.parents])
    place = jnp.where(on_base, rotation @ model.parent_position, model.parent_position)
    axes = jnp.einsum("ij,jkn->ikn", rotation, model.parent_rotation)
    axes = jnp.where(on_base, axes, model.parent_rotation)
    found = eqx.tree_at(
        lambda m: (m.parent_position, m.parent_rotation, m.gravity), model, (place, axes, rotation @ model.gravity)
    )
    for name in model.frame_forces or {}:
        found = eqx.tree_at(lambda m, name=name: m.frame_forces[name].parent.rotation, found, rotation)
    return found


def self_stresses(model):
    """Basis (k, 6 J) of wrenches (force, moment about the child's point, in axes of the child's frame) of all joints at
    the start, and the points' frames."""
    topology = model.topology
    placed = place(geometry_of(model), np.asarray(model.start_joints))
    joints, rows = len(topology.joints), []
    balance = np.zeros((6 * topology.n_links, 6 * joints))
    for j in range(joints):
        axes, point = placed.child_rotation[j], placed.child_centre[j]
        at_origin = np.zeros((6, 6))
        at_origin[:3, :3] = at_origin[3:, 3:] = axes
        at_origin[3:, :3] = np.cross(point[None], axes.T).T
        for node, sign in ((topology.children[j], 1.0), (topology.parents[j], -1.0)):
            if node >= 0:
                balance[6 * node : 6 * node + 6, 6 * j : 6 * j + 6] += sign * at_origin
        free = {"revolute": 4, "prismatic": 0}[topology.kinds[j]]
        rows.append(np.eye(6 * joints)[6 * j + free])
    _, singular, right = np.linalg.svd(np.vstack([balance, *rows]))
    return right[np.sum(singular > 1e-7) :]


def flat_loads(model, loads, length):
    """Forces, and moments over a length, of all joints as one vector, in the order of the topology; axes of the
    child."""
    placed = place(geometry_of(model), np.asarray(model.start_joints))
    parts = []
    for j, name in enumerate(model.topology.joints):
        # Loads of cut joints are in the axes of the parent's frame.
        turn = np.eye(3)
        if j >= model.topology.n_links:
            turn = placed.child_rotation[j].T @ placed.joint_rotation[j]
        parts += [turn @ np.asarray(loads[name].force), turn @ np.asarray(loads[name].moment) / length]
    return np.concatenate(parts)


def require_least(model, loads, length=None):
    length = float(np.max(model.length)) if length is None else length
    scale = np.tile([1.0, 1.0, 1.0, length, length, length], len(model.topology.joints))
    states = self_stresses(model) / scale  # moments over the length
    assert len(states) == describe(model).constraints - describe(model).rank > 0
    states = states / np.linalg.norm(states, axis=1, keepdims=True)
    found = flat_loads(model, loads, length)
    assert np.linalg.norm(found) > 1.0
    np.testing.assert_allclose(states @ found / np.linalg.norm(found), 0.0, atol=1e-10)


def door_loads(length):
    """Forces across and moments (closed form): least F^2 + (M / l)^2 of both hinges under a moment."""
    moment, apart = 13.0 * GRAVITY * 0.65, 1.5
    force = moment * apart / (apart**2 + 4.0 * length**2)
    return force, 0.5 * (moment - force * apart)


@pytest.mark.long
@pytest.mark.parametrize(("cut", "names"), [("upper", ("lower", "upper")), ("lower", ("zeta", "alpha"))])
@pytest.mark.parametrize("length", [None, 1.0, 0.01])
def test_a_door_hangs_alike_on_both_hinges(cut, names, length):
    model = discretise(door(cut, names, reaction_length=length))
    found = assemble(model, assembly_errors(model), {})
    assert STATUS[int(found.status)].name == "ok"
    force, moment = door_loads(1.3 if length is None else length)
    if length == 1.0:
        np.testing.assert_allclose((force, moment), (19.895, 26.526), rtol=1e-4)
    if length == 0.01:  # moments count so much that there are nearly none
        np.testing.assert_allclose(force, 55.263, rtol=1e-3)
    for name in names:
        load = found.preload[name]
        np.testing.assert_allclose(np.abs(load.force[1]), 63.765, rtol=1e-12)
        np.testing.assert_allclose(np.hypot(load.force[0], load.force[2]), force, rtol=1e-9)
        np.testing.assert_allclose(np.linalg.norm(load.moment), moment, rtol=1e-9, atol=1e-9)
    require_least(model, found.preload, length)


@pytest.mark.parametrize("method", [RungeKutta4(step=1e-3), GeneralisedAlpha(step=1e-3)])
def test_a_door_hangs_alike_in_its_motion(method):
    model = discretise(door(reaction_length=1.0))
    run = simulate(Simulation(model, drive=None, duration=2e-3, method=method))
    assert STATUS[int(run.status)].name == "ok"
    force, moment = door_loads(1.0)
    for load in run.loads.values():
        np.testing.assert_allclose(np.abs(load.force[:, 1]), 63.765, rtol=1e-9)
        np.testing.assert_allclose(np.hypot(load.force[:, 0], load.force[:, 2]), force, rtol=1e-9)
        np.testing.assert_allclose(np.linalg.norm(load.moment, axis=1), moment, rtol=1e-9)


def test_the_length_is_checked():
    with pytest.raises(InputError, match="`reaction_length` must be greater than 0"):
        door(reaction_length=-1.0)
    with pytest.raises(InputError, match="`reaction_length` must be left out"):
        door(redundant_reactions="refuse", reaction_length=1.0)


@pytest.mark.slow
def test_no_state_of_self_stress_makes_reactions_smaller_wherever_the_loop_is_cut():
    found = {}
    for cut in ("C", "D"):
        model = discretise(loop(cut))
        assembled = assemble(model, assembly_errors(model))
        assert STATUS[int(assembled.status)].name == "ok"
        require_least(model, assembled.preload)
        sizes = [
            [np.linalg.norm(load.force), load.force[1], np.linalg.norm(load.moment)]
            for _, load in sorted(assembled.preload.items())
        ]
        found[cut] = np.array(sizes)
    assert found["C"][:, 2].min() > 0.1
    np.testing.assert_allclose(found["C"], found["D"], rtol=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize("make", [twisted_spatial_loop, slider_crank])
def test_least_reactions_of_spatial_loops_and_slides(make):
    settings = {"gravity": (2.0, 5.0, -8.0), **LEAST}
    mechanism = replace(make(), driven_joint="A", **settings)
    rigid = [replace(one, rfes=1, rigid=True) if one.body is None else one for one in mechanism.links]
    model = discretise(replace(mechanism, links=rigid))
    assembled = assemble(model, assembly_errors(model))
    assert STATUS[int(assembled.status)].name == "ok"
    require_least(model, assembled.preload)


@pytest.mark.slow
def test_reactions_are_least_in_motion_in_both_formulations_of_a_step():
    model = discretise(loop())
    runs = [
        simulate(Simulation(model, drive=None, duration=h, method=named_method(name, step=h)))
        for name, h in (("rk4", 1e-6), ("generalised_alpha", 1e-6))
    ]
    for run in runs:
        loads = jax.tree.map(lambda x: x[0], dict(run.loads))
        require_least(model, loads)
    one, other = (np.concatenate([np.ravel([x.force, x.moment]) for x in run.loads.values()]) for run in runs)
    np.testing.assert_allclose(one, other, rtol=0, atol=1e-5 * np.abs(one).max())


def random_rotations(count):
    turns = Rotation.random(count, random_state=3).as_matrix()
    return jnp.asarray(
        np.concatenate(
            [np.eye(3)[None], Rotation.from_rotvec(np.pi / 2 * np.array([[1, 0, 0], [2, 0, 0]])).as_matrix(), turns]
        )
    )


@pytest.mark.slow
@pytest.mark.parametrize("gravity", [(0.0, 0.0, 0.0), (0.5, 3.0, -9.0)])
def test_any_plane_and_any_mass(gravity):
    model = discretise(slider_crank(gravity=gravity))
    errors = assembly_errors(model)

    def started(rotation, mass):
        heavy = eqx.tree_at(lambda m: (m.point_mass, m.point_inertia), turned(model, rotation),
                            (mass * model.point_mass, mass * model.point_inertia))  # fmt: skip
        found = assemble(heavy, errors)
        return found.status, found.preload

    masses = jnp.array([1.0, 1.001, 1e-6, 1e6])
    over_masses = jax.vmap(started, in_axes=(None, 0))
    status, preload = jax.jit(jax.vmap(over_masses, in_axes=(0, None)))(random_rotations(40), masses)
    assert (np.asarray(status) == 0).all()
    for load in preload.values():
        for part in load:
            largest = max(float(np.abs(np.asarray(one.force[0, 0])).max()) for one in preload.values())
            scaled = np.asarray(part) / np.asarray(masses)[None, :, None]
            np.testing.assert_allclose(
                scaled, np.broadcast_to(scaled[:1, :1], scaled.shape), atol=1e-9 * largest + 1e-13
            )


def test_a_mechanism_that_rests_in_any_plane_is_described_alike():
    for rotation in random_rotations(20):
        model = turned(discretise(slider_crank()), rotation)
        assert (describe(model).rank, describe(model).redundant) == (2, True)
        hung = turned(discretise(door()), rotation)
        assert (describe(hung).rank, describe(hung).mobility) == (0, 1)


@pytest.mark.slow
@pytest.mark.parametrize("method", [RungeKutta4(step=1e-4), GeneralisedAlpha(step=1e-4)])
def test_nothing_acts_in_any_plane(method):
    model = turned(discretise(slider_crank(gravity=(0.0, 0.0, 0.0))), random_rotations(1)[3])
    run = simulate(Simulation(model, drive=None, duration=5e-4, method=method))
    assert STATUS[int(run.status)].name == "ok"
    np.testing.assert_allclose(run.motion.angles["A"], np.radians(45), atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("mass", [0.0, 1e-3, 10.0])
def test_a_toggle_of_light_links_holds_its_load(mass):
    model = discretise(toggle(mass))
    turn = kinetostatic_turn(model, positions=np.array([3.966]))
    assert STATUS[int(turn.status[0])].name == "ok"
    push = 882.9 * 1.983 / (2.0 * 0.258)
    np.testing.assert_allclose(-turn.holding[0], push, rtol=1e-9)
    arms = np.hypot(push, 882.9 / 2.0)
    for name in ("one", "two", "three"):
        np.testing.assert_allclose(np.linalg.norm(turn.loads[name].force[0]), arms, rtol=1e-9)


@pytest.mark.long
def test_modes_in_any_plane():
    squares = []
    for rotation in random_rotations(1)[jnp.array([0, 3])]:
        model = turned(discretise(replace(four_bar(3), **LEAST, links=loop().links)), rotation)
        squares.append(np.asarray(natural_frequencies(model, locked=False, count=1).square))
    assert abs(squares[0][0]) > 1.0
    np.testing.assert_allclose(squares[0], squares[1], rtol=1e-8)


@pytest.mark.long
def test_derivatives_of_least_reactions():
    """By one error after the other."""
    model = discretise(loop())

    def loads_at(values):
        found = assemble(model, assembly_errors(model, {"coupler.length": values[0], "D.d_x": values[1]}))
        parts = [part for _, load in sorted(found.preload.items()) for part in load]
        return jnp.concatenate(parts)

    _, forward, reverse, difference = jacobians(loads_at, [0.0, 0.0], 1e-5)
    scale = np.abs(difference).max(axis=0)
    assert np.all(scale > 1.0)
    np.testing.assert_allclose(forward / scale, difference / scale, atol=1e-7)
    np.testing.assert_allclose(reverse / scale, forward / scale, atol=1e-11)


def test_links_without_mass_are_for_positions_at_rest():
    model = discretise(toggle(0.0))
    with pytest.raises(InputError, match="`mass` of the body of `left`, .* must be greater than 0 in a motion"):
        simulate(Simulation(model, drive=None, duration=1e-3, method=RungeKutta4(step=1e-4)))
    with pytest.raises(InputError, match="`mass` of the body"):
        natural_frequencies(model)
    with pytest.raises(InputError, match="`mass` of a body must be greater than 0 where it has inertia"):
        RigidBody(0.0, (0.0, 0.0, 0.0), (1e-3, 1e-3, 1e-3))
    with pytest.raises(InputError, match="must not be negative"):
        RigidBody(-1.0, (0.0, 0.0, 0.0), (1e-3, 1e-3, 1e-3))


def test_a_tree_without_mass_and_without_redundancy():
    """A crank of no mass carries a weight at its end."""
    weight = PointForce("weight", "arm", (0.4, 0.0, 0.0), force=(0.0, 0.0, -20.0))
    mechanism = Mechanism([plain("arm", 0.4, 0.0)], [Joint("A", "base", "arm")], driven_joint="A", forces=[weight])
    model = discretise(mechanism)
    found = assemble(model, assembly_errors(model))
    assert STATUS[int(found.status)].name == "ok"
    np.testing.assert_allclose(found.preload["A"].force, (0.0, 0.0, 20.0), atol=1e-12)
    np.testing.assert_allclose(found.preload["A"].moment, (0.0, -8.0, 0.0), atol=1e-12)
    moment = lambda x: assemble(model, assembly_errors(model, {"arm.length": x})).preload["A"].moment[1]  # noqa: E731
    slope = jax.jit(jax.grad(moment))(0.0)
    np.testing.assert_allclose(slope, -20.0, rtol=1e-9)


def moving_at_the_start(model, rate):
    """The closed start, all joints moving as the first one turns at a rate [rad/s]."""
    geometry = geometry_of(model)
    jacobian = closure_jacobian(geometry, place(geometry, np.asarray(model.start_joints)))
    slides = np.where(np.array(model.topology.slides, bool), geometry.scale, 1.0)
    free = np.linalg.svd(jacobian)[2][-1] * slides
    start = model.start_coordinates()
    return State(start, Coordinates(jnp.asarray(rate * free / free[0]), jnp.zeros_like(start.elastic)))


@pytest.mark.parametrize(
    "make",
    [
        pytest.param(loop, marks=pytest.mark.exhaustive),
        pytest.param(partial(slider_crank, gravity=(0.5, 3.0, -9.0)), marks=pytest.mark.long),
        pytest.param(partial(door, reaction_length=0.7), marks=pytest.mark.long),
    ],
)
def test_the_dense_formulation_finds_the_same_reactions(make):
    model = turned(discretise(make()), random_rotations(1)[3])
    actual, state = apply_errors(model, assembly_errors(model)), moving_at_the_start(model, 3.0)
    drive = DriveInput({} if model.topology.driven_coordinate is None else {0: jnp.asarray(7.0)})
    gains = Stabilisation(jnp.zeros(()), jnp.zeros(()), length_scale(model))
    fast = accelerations(actual, state, drive, gains)
    found = joint_loads.joint_loads(actual, fast, drive)
    coordinates, dense = reference_reactions(actual, state, drive, gains)
    np.testing.assert_allclose(fast.coordinates.joints, coordinates.joints, rtol=1e-9, atol=1e-9)
    placed = place(geometry_of(model), np.asarray(model.start_joints))
    for j, kind in enumerate(model.topology.kinds):
        turn = np.eye(3)
        if j >= model.topology.n_links:
            turn = placed.child_rotation[j].T @ placed.joint_rotation[j]
        force, moment = turn @ np.asarray(found.force[:, j]), turn @ np.asarray(found.moment[:, j])
        if j == 0 and drive.forces:  # a given moment is no part of the joint's load
            dense = dense.at[4, j].add(-7.0)
        scale = np.abs(dense[:3]).max(), np.abs(dense[3:]).max()
        np.testing.assert_allclose(force / scale[0], dense[:3, j] / scale[0], atol=1e-9, err_msg=kind)
        np.testing.assert_allclose(moment / scale[1], dense[3:, j] / scale[1], atol=1e-9, err_msg=kind)


@pytest.mark.long
def test_a_length_that_is_a_parameter_changes_the_norm():
    model = discretise(door())

    def across(length):
        found = assemble(model, assembly_errors(model), {}, design=design(model, {"leaf.length": length}))
        return found.preload["lower"].force[0]

    np.testing.assert_allclose(across(1.0), 19.895, rtol=1e-4)
    force, h, moment = across(1.3), 1.5, 13.0 * GRAVITY * 0.65
    slope = -8.0 * 1.3 * moment * h / (h**2 + 4.0 * 1.3**2) ** 2
    np.testing.assert_allclose(force, moment * h / (h**2 + 4.0 * 1.3**2), rtol=1e-9)
    for mode in (jax.jacfwd, jax.grad):
        np.testing.assert_allclose(jax.jit(mode(across))(1.3), slope, rtol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("angle", [1e-2, 1e-5])
def test_near_a_dead_centre_loads_are_large_and_right(angle):
    """A parallelogram that is almost stretched: the coupler pulls its rocker with the weight over the angle."""
    links = [link("crank", 0.1), link("coupler", 0.3), link("rocker", 0.1)]
    joints = [
        Joint("A", "base", "crank", angle=angle),
        Joint("B", "crank", "coupler", angle=-angle),
        Joint("D", "base", "rocker", position=(0.3, 0, 0), angle=angle),
        Joint("C", "coupler", "rocker", cut=True),
    ]
    model = discretise(Mechanism(links, joints, driven_joint="A", gravity=(0.0, 2.0, -9.0), **LEAST))
    found = assemble(model, assembly_errors(model))
    assert STATUS[int(found.status)].name == "ok"
    mass = 7850.0 * 1e-4
    # The rocker's weight at its middle, and half the coupler's at its end, turn it; only the pull holds it.
    pull = (0.5 * 0.1 * mass + 0.5 * 0.3 * mass) * 9.0 / np.tan(angle)
    np.testing.assert_allclose(found.preload["C"].force[0], pull, rtol=1e-10 / angle)  # of a step that counts as none


@pytest.mark.long
@pytest.mark.parametrize("method", [RungeKutta4(step=2e-4), GeneralisedAlpha(step=2e-4, tolerance=1e-10)])
def test_derivatives_of_least_reactions_in_motion(method):
    model = discretise(loop())

    def squares(error):
        errors, drive = assembly_errors(model, {"coupler.length": error}), PrescribedRate("A", 8.0)
        run = simulate(Simulation(model, drive=drive, duration=4e-4, method=method, save_every=4e-4), errors)
        return jnp.stack([run.metrics.mean_square_moment["D"], run.metrics.mean_square_force["C"]])

    found = check_derivatives(squares, 0.0, 1e-5, reverse=1e-8, differences=1e-6)
    assert np.abs(found.differences).min() > 1.0
