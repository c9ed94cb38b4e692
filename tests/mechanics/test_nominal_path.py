"""The path of the perfect, rigid mechanism beside a real one: loops closed, driven joints as they are."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rfem_jax import Compliance, Joint, Mechanism, discretise
from rfem_jax.mechanics.model.nominal_geometry import gaps, geometry_of, place
from rfem_jax.mechanics.model.nominal_path import nearest_closed, nominal_shapes
from tests.mechanisms import chain_with_balls, four_bar, link, loop_with_a_ball

CRANK, COUPLER, ROCKER, BASE = 0.12, 0.30, 0.30, 0.30


def four_bar_path(model, turn=6.0, count=40, off=0.02):
    """Positions at which the crank has gone some way and the other joints stand a little wrong."""
    generator = np.random.default_rng(1)
    path = np.empty((count, 3))
    path[:, 0] = np.asarray(model.start_joints)[0] + np.linspace(0.0, turn, count)
    near = np.asarray(model.start_joints)
    for row in path:
        near = nearest_closed(geometry_of(model), np.array([[row[0], *near[1:]]]))[0]
        row[1:] = near[1:] + off * generator.uniform(-1.0, 1.0, 2)
    return path


def test_a_four_bar_is_the_one_of_trigonometry():
    model = discretise(four_bar(3))
    path = four_bar_path(model)
    shape = nominal_shapes(model, path)
    crank = path[:, 0]
    end = CRANK * np.stack([np.cos(crank), 0.0 * crank, -np.sin(crank)], axis=1)
    points = dict(zip(model.link_names, np.split(shape.points, np.cumsum([2, 4]), axis=1), strict=True))
    np.testing.assert_allclose(points["crank"][:, -1], end, rtol=0, atol=1e-12)
    # Where the coupler meets the rocker: two circles about the crank's end and D.
    apart = np.array([BASE, 0.0, 0.0]) - end
    distance = np.linalg.norm(apart, axis=1)
    along = (distance**2 + COUPLER**2 - ROCKER**2) / (2.0 * distance)
    unit = apart / distance[:, None]
    up = np.stack([-unit[:, 2], 0.0 * crank, unit[:, 0]], axis=1)
    meeting = end + along[:, None] * unit + np.sqrt(COUPLER**2 - along**2)[:, None] * up
    np.testing.assert_allclose(points["coupler"][:, -1], meeting, rtol=0, atol=1e-8)
    np.testing.assert_allclose(points["rocker"][:, -1], meeting, rtol=0, atol=1e-8)
    assert np.abs(np.diff(np.diff(points["coupler"], axis=1), axis=1))[..., 1].max() < 1e-12  # straight, in the plane


def test_closed_positions_stay_and_many_are_placed_as_one_is():
    model = discretise(loop_with_a_ball())
    geometry = geometry_of(model)
    start = np.tile(np.asarray(model.start_joints), (3, 1))
    found = nearest_closed(geometry, start)
    np.testing.assert_allclose(found, start, rtol=0, atol=1e-7)
    together, alone = place(geometry, found), place(geometry, found[1])
    for many, one in zip(together, alone, strict=True):
        np.testing.assert_array_equal(many[1], one)
    np.testing.assert_array_equal(gaps(geometry, together).residual[1], gaps(geometry, alone).residual)


def test_a_ball_in_a_loop_turns_to_close_it():
    model = discretise(loop_with_a_ball())
    geometry, topology = geometry_of(model), model.topology
    wrong = np.tile(np.asarray(model.start_joints), (2, 1))
    driven = [topology.place_of(k) for k in topology.held]
    quaternions = [at.stop - 4 for l, at in enumerate(topology.positions) if topology.kind(l).ball]
    for at in quaternions:
        q = Rotation.from_quat(wrong[:, at : at + 4], scalar_first=True) * Rotation.from_rotvec([0.03, -0.02, 0.01])
        wrong[:, at : at + 4] = q.as_quat(scalar_first=True)
    assert quaternions and np.abs(gaps(geometry, place(geometry, wrong)).residual).max() > 1e-3
    found = nearest_closed(geometry, wrong)
    assert np.abs(gaps(geometry, place(geometry, found)).residual).max() < 1e-9
    np.testing.assert_array_equal(found[:, driven], wrong[:, driven])


def test_an_open_chain_has_rigid_links_at_the_angles_of_the_real_one():
    model = discretise(chain_with_balls())
    joints = np.asarray(model.start_joints)[None]
    np.testing.assert_array_equal(nearest_closed(geometry_of(model), joints), joints)


def test_springs_of_a_compliant_joint_are_at_rest():
    bar = link("bar", 0.3)
    joint = Joint("A", "base", "bar", compliance=Compliance(radial=1e6))
    model = discretise(Mechanism((bar,), (joint,)))
    topology = model.topology
    joints = np.full((2, len(np.asarray(model.start_joints))), 0.01)
    found = nearest_closed(geometry_of(model), joints)
    sprung = [topology.place_of(k) for k in topology.sprung_coordinates]
    assert len(sprung) == 2 and not found[:, sprung].any()
    assert found[:, topology.place_of(topology.own_coordinates[0][0])] == pytest.approx(0.01)


def test_a_driven_joint_moves_where_the_loop_does_not_close_otherwise():
    """Beyond a toggle: the rocker's angle is the driven one, which the crank does not let go further."""
    model = discretise(four_bar(3))
    geometry = geometry_of(model)
    wrong = four_bar_path(model, count=1)
    topology = model.topology
    held_elsewhere = geometry._replace(topology=topology._replace(drives=(2,)))
    beyond = wrong + np.array([[0.0, 0.0, 2.5]])
    found = nearest_closed(held_elsewhere, beyond)
    assert np.abs(gaps(geometry, place(geometry, found)).residual).max() < 1e-9
    assert abs(found[0, 2] - beyond[0, 2]) > 1e-3
