"""Symbols of joints and forces in the picture of the assembled mechanism: where they are and which way they point."""

from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("matplotlib", reason="pictures need the extra `plots`")

from matplotlib.figure import Figure
from mpl_toolkits.mplot3d.art3d import Poly3DCollection

from rfem_jax import Joint, JointForceTable, JointSpring, Mechanism
from rfem_jax.description.basics.joint_kinds import KINDS
from rfem_jax.report.drawings.joint_symbols import (
    MARKERS,
    draw_force,
    draw_joint,
    guide_ends,
    joint_seats,
    legend_handles,
)
from tests.mechanisms import chain_of_kinds, link

TURNED = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])  # R_z(-90 deg)


@pytest.fixture
def slider():
    """A block that slides along -Y, 0.1 m from its seat, pulled by a spring and pushed back by gas."""
    joints = [
        Joint("G", "base", "block", kind="prismatic", position=(0, 0, 0.2), orientation=(0, 0, -np.pi / 2),
              displacement=0.1),
        Joint("T", "block", "wheel"),
    ]  # fmt: skip
    forces = [
        JointSpring("coil", "G", stiffness=80.0),
        JointForceTable("gas", "G", [0.0, 0.3], [-1.0, -5.0]),
        JointForceTable("cam", "T", [0.0, 1.0], [1.0, 2.0]),
    ]
    return Mechanism([link("block", 0.1), link("wheel", 0.1)], joints, forces=forces)


@pytest.fixture
def axes():
    return Figure().add_subplot(projection="3d")


def points_of(line):
    return np.stack(line.get_data_3d(), axis=1)


def test_seats_are_those_of_the_perfect_start(slider):
    seat = joint_seats(slider)["G"]
    np.testing.assert_allclose(seat.rotation, TURNED, atol=1e-15)
    np.testing.assert_allclose([seat.centre, seat.child_centre], [[0, 0, 0.2], [0, -0.1, 0.2]], atol=1e-15)
    every_kind = chain_of_kinds()
    assert set(joint_seats(every_kind)) == {joint.name for joint in every_kind.joints}


def test_a_guide_is_as_long_as_the_way_of_the_slider(slider):
    runs = {
        "one": SimpleNamespace(motion=SimpleNamespace(displacements={"G": np.array([0.1, 0.3, np.nan])})),
        "other": SimpleNamespace(motion=SimpleNamespace(displacements={"G": np.array([-0.2, 0.0])})),
    }
    ((low, high),) = guide_ends(slider.joint("G"), joint_seats(slider)["G"], runs, size=1.0)
    np.testing.assert_allclose([low, high], [[0, 0.29, 0.2], [0, -0.39, 0.2]], atol=1e-14)
    assert guide_ends(slider.joint("T"), joint_seats(slider)["T"], runs, size=1.0) == []


def test_a_slider_is_a_box_along_its_guide(slider, axes):
    draw_joint(axes, slider.joint("G"), np.array([0.0, -0.1, 0.2]), joint_seats(slider)["G"], size=1.0)
    (box,) = [one for one in axes.collections if isinstance(one, Poly3DCollection)]
    corners = np.reshape(box._faces if hasattr(box, "_faces") else box._vec[:3].T, (-1, 3))
    extent = np.ptp(corners, axis=0)
    assert extent[1] > 1.4 * extent[0] and extent[0] == pytest.approx(extent[2])
    np.testing.assert_allclose(corners.mean(axis=0), [0.0, -0.1, 0.2], atol=1e-12)


def test_a_hinge_shows_its_axis(slider, axes):
    seat = joint_seats(slider)["T"]
    draw_joint(axes, slider.joint("T"), seat.centre, seat, size=1.0)
    axis = next(points_of(line) for line in axes.lines if len(line.get_data_3d()[0]) == 2)
    direction = axis[1] - axis[0]
    np.testing.assert_allclose(np.abs(direction) / np.linalg.norm(direction), [1, 0, 0], atol=1e-12)


def test_springs_reach_from_seat_to_child_and_arrows_push_as_the_table_says(slider, axes, monkeypatch):
    arrows = []
    monkeypatch.setattr(axes, "quiver", lambda *numbers, **style: arrows.append(np.array(numbers)))
    seats = joint_seats(slider)
    point = seats["G"].child_centre
    draw_force(axes, slider, slider.forces[0], point, seats["G"], size=1.0)
    coil = points_of(axes.lines[-1])
    np.testing.assert_allclose(coil[[0, -1]], [seats["G"].centre, point], atol=1e-14)
    assert np.ptp(coil[:, [0, 2]]) > 0.03
    draw_force(axes, slider, slider.forces[1], point, seats["G"], size=1.0)
    start, arrow = np.split(arrows[-1], 2)
    np.testing.assert_allclose(arrow / np.linalg.norm(arrow), [0, 1, 0], atol=1e-14)  # back to the seat
    assert (start + arrow)[1] < point[1]  # it ends at the box
    draw_force(axes, slider, slider.forces[2], point, seats["T"], size=1.0)
    assert [text.get_text().strip() for text in axes.texts] == ["coil", "gas", "cam"]


def test_every_kind_has_a_marker_and_the_legend_names_what_there_is(slider):
    assert set(MARKERS) == set(KINDS)
    labels = [handle.get_label() for handle in legend_handles(slider)]
    assert labels == ["prismatic", "revolute", "base", "spring, damper", "force"]
