"""A mechanism that is described in the plane of x and y is that of x and z, turned by a quarter about x."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from rfem_jax import (
    InputError,
    Joint,
    JointSpring,
    Link,
    Mechanism,
    Point,
    PointForce,
    PointMass,
    Rectangle,
    RigidBody,
    RungeKutta4,
    Simulation,
    assemble,
    design,
    discretise,
    load_study,
    metric,
    simulate,
)
from rfem_jax.mechanics.model.status import STATUS
from tests.mechanisms import STEEL, arm

TURN = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])  # z is y turned, and -y is z
ERRORS = {"A.delta_x": 2e-3, "P.d_y": 1e-4, "G.child.delta_z": 1e-3, "rod.length": 1e-4, "rod.twist": 3e-3}


def turned(vector):
    return tuple((TURN @ np.array(vector, float)).tolist())


def inclined_slider_crank(plane):
    """With all that a plane concerns: sections of two widths, bodies, masses and points beside the axes, a slide that
    is inclined, loads in global and in link axes."""
    place = turned if plane == "xy" else tuple

    def inertia(x, y, z):
        return (x, z, y) if plane == "xy" else (x, y, z)

    def about_hinge(angle):
        return (0.0, 0.0, angle) if plane == "xy" else (0.0, angle, 0.0)

    tensor = np.array([[2e-4, 1e-5, 2e-5], [1e-5, 3e-4, -1e-5], [2e-5, -1e-5, 4e-4]])
    tensor = TURN @ tensor @ TURN.T if plane == "xy" else tensor
    flat = Rectangle(width=0.02, height=0.005)
    links = [
        Link("crank", 0.1, body=RigidBody(0.4, place((0.03, 0.01, 0.02)), tensor.tolist())),
        Link("rod", 0.33, flat, STEEL, rfes=3,
             point_masses=[PointMass(0.2, place((0.2, 0.01, 0.03)), inertia(1e-5, 2e-5, 3e-5))]),
        Link("slide", 0.1, flat, STEEL, rigid=True),
    ]  # fmt: skip
    joints = [
        Joint("A", "base", "crank", position=place((0.01, 0.02, 0.03)), angle=np.radians(45)),
        Joint("B", "crank", "rod", angle=np.radians(-58)),
        Joint("G", "base", "slide", kind="prismatic", position=place((0.02, 0.02, 0.04)),
              orientation=about_hinge(0.1), displacement=0.39),
        Joint("P", "slide", "rod", position=place((0.02, 0.0, 0.01)), cut=True),
    ]  # fmt: skip
    forces = [
        JointSpring("back", "G", stiffness=500.0, rest=0.3),
        PointForce("push", "rod", place((0.1, 0.0, 0.01)), force=place((3.0, 4.0, -5.0))),
        PointForce("pull", "rod", place((0.3, 0.0, 0.0)), force=place((1.0, -2.0, 2.0)), axes="link"),
    ]
    gravity, points = place((0.5, 1.0, -9.0)), [Point("K", "rod", place((0.15, 0.01, 0.05)))]
    return Mechanism(links, joints, gravity=gravity, driven_joint="A", forces=forces, points=points, plane=plane)


def require_alike(one, other, rtol):
    assert one.keys() == other.keys()
    for part in ("force", "moment"):
        scale = max(float(np.abs(getattr(load, part)).max()) for load in one.values())
        for name in one:
            left, right = (np.asarray(getattr(loads[name], part)) for loads in (one, other))
            np.testing.assert_allclose(right, left, atol=rtol * scale, err_msg=f"{name}.{part}")


@pytest.mark.long
def test_loads_at_rest_are_alike():
    """In the frames of joints, whose y axis is the hinge in both planes; with a design, whose numbers are turned.
    Geometrically exact, since linear elements take small rotations about their axes one after another."""
    found = {}
    for plane in ("xz", "xy"):
        model = discretise(inclined_slider_crank(plane), elements="geometrically_exact")
        shifted = {"xz": "P.position.z", "xy": "P.position.y"}[plane]
        changed = design(model, {shifted: {"xz": 0.02, "xy": -0.02}[plane], "G.position.x": 0.03})
        found[plane] = [assemble(model, ERRORS), assemble(model, ERRORS, design=changed)]
        assert all(STATUS[int(one.status)].name == "ok" for one in found[plane])
    for one, other in zip(found["xz"], found["xy"], strict=True):
        require_alike(one.preload, other.preload, 1e-7)
    first, second = (one.preload["P"].force for one in found["xz"])
    assert np.abs(first - second).max() > 0.1


@pytest.mark.long
def test_motions_and_paths_are_alike():
    deviations = ("along", "across", "out_of_plane")
    names = [*(f"K.rms_deviation_{part}" for part in deviations), "K.max_angle_deviation", "rod.max_stress"]
    records = tuple(dict.fromkeys(record for name in names for record in metric(name).records))
    runs = {}
    for plane in ("xz", "xy"):
        model = discretise(inclined_slider_crank(plane), elements="geometrically_exact")
        settings = {"drive": None, "duration": 4e-4, "method": RungeKutta4(step=2e-6), "save_every": 1e-4}
        runs[plane] = simulate(Simulation(model, **settings), ERRORS, record=records)
        assert STATUS[int(runs[plane].status)].name == "ok"
    one, other = runs["xz"], runs["xy"]
    require_alike(one.loads, other.loads, 1e-6)
    np.testing.assert_allclose(other.motion.angle, one.motion.angle, rtol=1e-10)
    path, turn = one.points["K"], other.points["K"]
    np.testing.assert_allclose(turn.position, path.position @ TURN.T, atol=1e-9)
    np.testing.assert_allclose(turn.angles, path.angles @ TURN.T, atol=1e-7)
    assert np.abs(path.angles[:, 0]).max() > 1e-5
    for name in names:
        np.testing.assert_allclose(metric(name)(other), metric(name)(one), rtol=1e-5, err_msg=name)
    for before in ("", "deviation_", "angle_", "angle_deviation_"):
        values = {plane: [metric(f"K.{before}{axis}")(run) for axis in "xyz"] for plane, run in runs.items()}
        scale = np.abs(values["xz"]).max()
        np.testing.assert_allclose(values["xy"], TURN @ np.array(values["xz"]), atol=1e-5 * scale, err_msg=before)


def test_angles_and_gravity_are_those_of_the_figure():
    """An arm at 30 deg to the right and up: its weight asks for a moment that turns it to the left."""
    joint = [Joint("A", "base", "arm", angle="30 deg")]
    model = discretise(replace(arm(), joints=joint, gravity=None, plane="xy"))
    np.testing.assert_array_equal(model.gravity, (0.0, -9.81, 0.0))
    found = assemble(model)
    weight = 7850.0 * 1e-4 * 0.3 * 9.81
    np.testing.assert_allclose(found.preload["A"].moment[1], 0.15 * weight * np.cos(np.radians(30)), rtol=1e-9)
    np.testing.assert_array_equal(discretise(arm()).gravity, (0.0, 0.0, -9.81))


def test_traced_orientations():
    """A start's frame that is traced is turned as a number is."""

    def moment(angle):
        joint = [Joint("A", "base", "arm", orientation=(0.0, 0.0, angle), angle=0.1)]
        return assemble(discretise(Mechanism(arm().links, joint, driven_joint="A", plane="xy"))).preload["A"].moment[1]

    slope = jax.jit(jax.grad(moment))(0.4)
    np.testing.assert_allclose(slope, -0.15 * 7850.0 * 1e-4 * 0.3 * 9.81 * np.sin(0.5), rtol=1e-9)


def test_another_plane_is_refused(tmp_path):
    with pytest.raises(InputError, match='`plane` must be one of "xz", "xy"'):
        arm(plane="yz")
    file = tmp_path / "study.toml"
    file.write_text(STUDY)
    study = load_study(file)
    assert study.mechanism.plane == "xy" and study.mechanism.gravity == (0.0, -9.81, 0.0)


STUDY = """
title = "An arm"
[mechanism]
plane = "xy"
[[mechanism.links]]
name = "arm"
length = 0.3
body = { mass = 1.0, centre = [0.15, 0.0, 0.0], inertia = [1e-4, 1e-3, 1e-3] }
[[mechanism.joints]]
name = "A"
parent = "base"
child = "arm"
[simulation]
duration = 0.1
[[cases]]
name = "perfect"
"""
