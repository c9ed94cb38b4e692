"""What a run keeps at its saved times beside the loads: ends of links, branch, integrals of loads."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rfem_jax import Joint, Mechanism, assembly_errors, discretise
from rfem_jax.mechanics.dynamics.loads import static_state
from rfem_jax.mechanics.kinematics.branches import assembly_modes
from rfem_jax.mechanics.kinematics.cut_joints import closure
from rfem_jax.mechanics.kinematics.motion import motion_of
from rfem_jax.mechanics.model.model import length_scale
from rfem_jax.mechanics.model.with_errors import apply_errors
from tests.derivatives import check_derivatives
from tests.mechanisms import link


@pytest.fixture(scope="module")
def run(small):
    return jax.tree.map(np.asarray, small.run({"D.delta_x": 0.004}))


@pytest.mark.slow
def test_ends_of_a_rigid_crank_and_of_two_links_that_meet(run):
    direction = np.stack([np.cos(run.motion.angle), 0.0 * run.motion.angle, -np.sin(run.motion.angle)], axis=1)
    np.testing.assert_allclose(run.motion.ends["crank"], 0.12 * direction, rtol=0, atol=1e-12)
    assert np.ptp(run.motion.ends["coupler"], axis=0)[2] > 1e-4  # it moves
    np.testing.assert_allclose(run.motion.ends["coupler"], run.motion.ends["rocker"], rtol=0, atol=1e-9)
    for name, line in run.motion.centre_lines.items():
        np.testing.assert_allclose(run.motion.ends[name][0], line[-1], rtol=0, atol=1e-12)


def test_window_is_the_mean_over_its_times(run):
    whole = run.window(0.0, run.times[-1])
    first, second = run.window(0.0, 0.01), run.window(0.01, 0.02)
    for joint in "ABCD":
        for kind in ("force", "moment"):
            total = getattr(run.metrics, f"mean_square_{kind}")[joint]
            np.testing.assert_allclose(getattr(whole, f"mean_square_{kind}")[joint], total, rtol=1e-9)
            halves = [getattr(part, f"mean_square_{kind}")[joint] for part in (first, second)]
            np.testing.assert_allclose(np.mean(halves), total, rtol=1e-9)
            assert abs(halves[0] - halves[1]) > 1e-3 * total  # so that the halves say something
            np.testing.assert_allclose(getattr(first, f"rms_{kind}")[joint] ** 2, halves[0], rtol=1e-12)


@pytest.mark.long
def test_derivative_of_a_window(small):
    def load(tilt):
        return small.run({"D.delta_x": tilt}).window(0.01, 0.02).mean_square_moment["D"]

    check_derivatives(load, 0.004, 1e-5, reverse=1e-8, differences=1e-6)


def four_bar_on_the_side(sign):
    """The study's four-bar closed with C above (+1) or below (-1) the line from B to D."""
    b, d, length = np.array([0.0, 0.12]), np.array([0.3, 0.0]), 0.3
    across = d - b
    half = 0.5 * np.linalg.norm(across)
    normal = np.array([-across[1], across[0]]) / (2.0 * half)
    c = b + 0.5 * across + sign * np.sqrt(length**2 - half**2) * normal

    def angle(v):
        return -np.arctan2(v[1], v[0])

    joints = [
        Joint("A", "base", "crank", position=(0, 0, 0), angle=-np.pi / 2),
        Joint("B", "crank", "coupler", angle=angle(c - b) + np.pi / 2),
        Joint("D", "base", "rocker", position=(0.3, 0, 0), angle=angle(c - d)),
        Joint("C", "coupler", "rocker", cut=True),
    ]
    links = [link("crank", 0.12), link("coupler", 0.3, 3), link("rocker", 0.3, 3)]
    return discretise(Mechanism(links, joints, driven_joint="A"))


@eqx.filter_jit
def mode_of(model):
    actual = apply_errors(model, assembly_errors(model))
    now = motion_of(actual, static_state(model.topology, model.start_coordinates()))
    return assembly_modes(actual, now, closure(actual, now, length_scale(model)))


def test_the_two_ways_to_close_a_four_bar_are_two_branches():
    above, below = (float(mode_of(four_bar_on_the_side(sign))[0]) for sign in (1.0, -1.0))
    # With x to the right and z up, y points into the plane: for C above, (C - B) x (C - D) is along
    # -y, towards the reader.
    assert (above, below) == (-1.0, 1.0)


def test_a_run_stays_on_the_branch_of_its_start(run):
    assert list(run.motion.branch) == ["C"]
    np.testing.assert_array_equal(run.motion.branch["C"], -1.0)


def at_positions(model, coordinates):
    """Assembly modes with the given coordinates {joint: values (n,)} of the tree joints."""
    names = model.topology.joints[: model.topology.n_links]
    actual = apply_errors(model, assembly_errors(model))

    def one(joints):
        state = static_state(model.topology, eqx.tree_at(lambda c: c.joints, model.start_coordinates(), joints))
        now = motion_of(actual, state)
        return assembly_modes(actual, now, closure(actual, now, length_scale(model)))

    found = jax.jit(jax.vmap(one))(jnp.stack([jnp.asarray(coordinates[name]) for name in names], axis=1))
    return dict(zip([model.topology.joints[j] for j in model.topology.cuts], np.asarray(found).T, strict=True))


def quick_return(crank):
    """A driven crank turns a lever by a block that slides on it, and the lever a ram by a rod; its coordinates at
    angles of the crank, which turn x towards -z."""
    pin = np.stack([0.08 * np.cos(crank), 0.15 - 0.08 * np.sin(crank)])
    lever, along = -np.arctan2(pin[1], pin[0]), np.hypot(*pin)
    rod = -np.arcsin((0.4 + 0.35 * np.sin(lever)) / 0.12)
    ram = 0.35 * np.cos(lever) + 0.12 * np.cos(rod)
    coordinates = {"A": crank, "L": lever, "S": along, "R": rod - lever, "G": ram}
    joints = [
        Joint("A", "base", "crank", position=(0, 0, 0.15), angle=crank[0]),
        Joint("L", "base", "lever", angle=lever[0]),
        Joint("S", "lever", "block", kind="prismatic", position=(0, 0, 0), displacement=along[0]),
        Joint("C", "crank", "block", child_position=(0, 0, 0), cut=True),
        Joint("R", "lever", "rod", angle=rod[0] - lever[0]),
        Joint("G", "base", "ram", kind="prismatic", position=(0, 0, 0.4), displacement=ram[0]),
        Joint("D", "ram", "rod", position=(0, 0, 0), cut=True),
    ]
    lengths = {"crank": 0.08, "lever": 0.35, "block": 0.04, "rod": 0.12, "ram": 0.3}
    links = [link(name, length) for name, length in lengths.items()]
    mechanism = Mechanism(links, joints, driven_joint="A", redundant_reactions="minimum_norm")
    return discretise(mechanism), coordinates


def test_a_full_turn_of_a_driven_crank_is_no_change_of_branch():
    model, coordinates = quick_return(np.linspace(0.1, 0.1 + 2.0 * np.pi, 25))
    found = at_positions(model, coordinates)
    assert set(found) == {"C", "D"}
    for modes in found.values():
        assert np.abs(modes[0]) == 1.0
        np.testing.assert_array_equal(modes, modes[0])


@pytest.mark.slow
@pytest.mark.parametrize("cut", ["B", "C", "D"])
def test_the_side_of_a_four_bar_wherever_it_is_cut(cut):
    """Over a turn of the crank each way to close it has its side: it changes where coupler and rocker are in line."""
    crank = np.linspace(0.2, 0.2 + 2.0 * np.pi, 13)[:-1]
    b, d, length = np.stack([0.08 * np.cos(crank), -0.08 * np.sin(crank)]), np.array([[0.3], [0.0]]), 0.25
    across = d - b
    half = 0.5 * np.hypot(*across)
    normal = np.stack([-across[1], across[0]]) / (2.0 * half)
    sides = []
    for sign in (1.0, -1.0):
        c = b + 0.5 * across + sign * np.sqrt(length**2 - half**2) * normal
        coupler, rocker = (-np.arctan2(*(c - start)[::-1]) for start in (b, d))
        joints = {
            "A": Joint("A", "base", "crank", angle=crank[0]),
            "B": Joint("B", "crank", "coupler", angle=coupler[0] - crank[0]),
            "C": Joint("C", "coupler", "rocker", angle=rocker[0] - coupler[0]),
            "D": Joint("D", "base", "rocker", position=(0.3, 0, 0), angle=rocker[0]),
        }
        angles = {"A": crank, "B": coupler - crank, "C": rocker - coupler, "D": rocker}
        if cut != "C":  # the rocker's frame is at its far end where the coupler carries it, and the other way round
            joints, angles = chain_of(cut, joints, angles, coupler, rocker)
        else:
            joints["C"] = Joint("C", "coupler", "rocker", cut=True)
        links = [link("crank", 0.08), link("coupler", length), link("rocker", length)]
        mechanism = Mechanism(links, list(joints.values()), driven_joint="A", redundant_reactions="minimum_norm")
        modes = at_positions(discretise(mechanism), angles)[cut]
        np.testing.assert_array_equal(modes, modes[0])
        sides.append(modes[0])
    assert sorted(sides) == [-1.0, 1.0]


def chain_of(cut, joints, angles, coupler, rocker):
    """The joints with another one cut than that of coupler and rocker, and the angles of the others."""
    end = (0.25, 0.0, 0.0)
    if cut == "D":  # base, crank, coupler, rocker from its far end
        joints["C"] = Joint("C", "coupler", "rocker", child_position=end, angle=rocker[0] - coupler[0])
        joints["D"] = Joint("D", "base", "rocker", position=(0.3, 0, 0), child_position=(0, 0, 0), cut=True)
        return joints, angles
    joints["C"] = Joint("C", "rocker", "coupler", position=end, child_position=end, angle=coupler[0] - rocker[0])
    joints["B"] = Joint("B", "crank", "coupler", child_position=(0, 0, 0), cut=True)
    return joints, angles | {"C": coupler - rocker}
