"""MJCF: round trips, what MuJoCo itself has in its files, motions of MuJoCo and ours."""

from dataclasses import replace
from xml.etree import ElementTree as Xml

import numpy as np
import pytest

from rfem_jax import (
    Case,
    Coupling,
    InputError,
    Joint,
    JointSpring,
    Mechanism,
    RungeKutta4,
    Simulation,
    assembly_errors,
    describe,
    discretise,
    load_study,
    simulate,
)
from rfem_jax.description import Study
from rfem_jax.exchange.exudyn_writer import exudyn_text
from rfem_jax.exchange.files import read_layout
from rfem_jax.exchange.frame_table import table_text
from rfem_jax.exchange.layout import motion_frame
from rfem_jax.exchange.mjcf_writer import mjcf_text
from rfem_jax.exchange.mujoco_motion import ComparedMotion, compared, rigid_study
from rfem_jax.exchange.study_layout import layout_of
from rfem_jax.exchange.study_writer import study_text
from rfem_jax.exchange.urdf_writer import urdf_text
from rfem_jax.report.command_line import main

from .machines import MACHINES, MOBILITY, bar, same_places, study

try:
    import mujoco
except ImportError:
    mujoco = None
needs_mujoco = pytest.mark.skipif(mujoco is None, reason="the package mujoco is not installed")


def pendulum():
    """Two bars, springs and dampers in both hinges, the second askew to the first: an open chain."""
    joints = (
        Joint("A", "base", "one", position=(0.1, 0.0, 0.2), angle=0.4),
        Joint("B", "one", "two", orientation=(0.3, 0.0, 0.2), angle=-0.9),
    )
    springs = JointSpring("a", "A", stiffness=0.3, damping=2e-3, rest=1.0, preload=0.02), JointSpring(
        "b", "B", stiffness=0.05, damping=1e-3)  # fmt: skip
    return Mechanism((bar("one", 0.2, 0.1), bar("two", 0.15, 0.08)), joints, forces=springs)


def written(name, folder, case=None):
    layout = layout_of(study(name) if isinstance(name, str) else name, case)
    path = folder / "machine.xml"
    path.write_text(mjcf_text(layout, "a test")[0], encoding="utf-8")
    return layout, path


@pytest.mark.parametrize("name", MACHINES)
def test_the_file_has_all_bodies_and_joints(name):
    """Without MuJoCo: what is in the text, nested as the tree is."""
    layout = layout_of(study(name))
    text, left = mjcf_text(layout, "a test -- with dashes")
    root = Xml.fromstring(text)
    assert left == () and {body.get("name") for body in root.iter("body")} == {one.name for one in layout.bodies}
    for joint in layout.joints:
        body = root.find(f".//body[@name='{joint.child}']")
        if joint.cut:
            assert root.find(f"equality/*[@name='{joint.name}']") is not None
        else:
            carried = {item.get("name") for item in body if item.tag in ("joint", "freejoint")}
            assert joint.name in carried
        assert root.find(f".//site[@name='{joint.name}.seat']") is not None
    assert sum(float(one.get("mass")) for one in root.iter("inertial")) == pytest.approx(
        sum(one.mass for one in layout.bodies)
    )


@needs_mujoco
@pytest.mark.parametrize("name", MACHINES)
def test_round_trip(name, tmp_path):
    """Study, MJCF, study: bodies, frames, start values, springs."""
    layout, path = written(name, tmp_path)
    again, kind = read_layout(path)
    assert kind == "MJCF" and again.framed and again.remarks == ()
    toml = tmp_path / "again.toml"
    toml.write_text(study_text(again, "a test", toml.name), encoding="utf-8")
    found = load_study(toml)
    described = describe(discretise(found.mechanism))
    assert described.rigid_mobility == MOBILITY[name] and described.gap < 1e-9
    second = layout_of(found)
    assert same_places(layout, second)
    others = {joint.name: joint for joint in second.joints}
    for joint in layout.joints:
        other = others[joint.name]
        np.testing.assert_allclose(other.start, joint.start, atol=1e-9)
        np.testing.assert_allclose(other.seat.rotation, joint.seat.rotation, atol=1e-9)
        np.testing.assert_allclose(other.bore.position, joint.bore.position, atol=1e-9)
        assert other.springs == joint.springs
    assert [(one.name, one.bodies) for one in second.pulls] == [(one.name, one.bodies) for one in layout.pulls]
    for one, other in zip(layout.pulls, second.pulls, strict=True):
        np.testing.assert_allclose(other.points, one.points, atol=1e-12)
        numbers = ((each.stiffness, each.damping, each.free_length) for each in (one, other))
        np.testing.assert_allclose(*numbers)
    for body in layout.bodies:
        assert second.body(body.name).length == pytest.approx(body.length)


@needs_mujoco
def test_errors_stay_in_the_file(tmp_path):
    """The two sides of a cut joint are where the errors of the case put them."""
    errors = {"D.d_x": "1 mm", "C.child.d_z": "2 mm", "B.d_x": "0.3 mm"}
    layout, path = written(study("four_bar", cases=(Case("off", errors),)), tmp_path, "off")
    assert layout.remarks == ()
    again, _ = read_layout(path)
    assert same_places(layout, again)
    perfect = layout_of(study("four_bar"))
    assert abs(layout.sides(layout.joints[3])[0].position - perfect.sides(perfect.joints[3])[0].position).max() > 1e-4


def ours(mechanism, duration, joints):
    """Coordinates of joints at the end."""
    model = discretise(mechanism)
    run = simulate(
        Simulation(model, drive=None, duration=duration, method=RungeKutta4(step=5e-4)), assembly_errors(model)
    )
    assert int(run.status) == 0
    angles, shifts = run.motion.angles, run.motion.displacements
    return np.array([np.asarray((angles if name in angles else shifts)[name])[-1] for name in joints])


def theirs(path, duration, joints, step):
    """The same by MuJoCo's Runge-Kutta method of fourth order."""
    model = mujoco.MjModel.from_xml_path(str(path))
    model.opt.integrator, model.opt.timestep = mujoco.mjtIntegrator.mjINT_RK4, step
    data = mujoco.MjData(model)
    for _ in range(round(duration / step)):
        mujoco.mj_step(model, data)
    return np.array([data.joint(name).qpos[0] for name in joints])


@needs_mujoco
@pytest.mark.slow
def test_an_open_chain_moves_as_in_mujoco(tmp_path):
    """Both methods are of fourth order: equal to 1e-7 rad after half a second of large motion."""
    _, path = written(Study("pendulum", pendulum(), duration=1.0), tmp_path)
    mine, other = ours(pendulum(), 0.5, "AB"), theirs(path, 0.5, "AB", 1e-3)
    assert np.abs(mine - [0.4, -0.9]).max() > 0.5
    np.testing.assert_allclose(other, mine, atol=1e-7)


@needs_mujoco
@pytest.mark.slow
@pytest.mark.parametrize(("name", "joints"), [("four_bar", "ABD"), ("slider_crank", "ABG")])
def test_loops_move_as_in_mujoco(name, joints, tmp_path):
    """MuJoCo's loops are soft: their gaps decay with the time constant of the file, which leaves a thousandth."""
    _, path = written(name, tmp_path)
    mine, other = ours(MACHINES[name](), 0.2, joints), theirs(path, 0.2, joints, 2e-4)
    began = [one.start_values[0] for one in MACHINES[name]().joints if one.name in joints]
    moved = np.abs(mine - began)
    assert moved.max() > 0.1
    np.testing.assert_allclose(other, mine, atol=2e-3 * moved.max())


def geared():
    """Two bars on parallel hinges with an ideal gear pair between them, the heavier one let go."""
    joints = (
        Joint("A", "base", "one", angle=0.3),
        Joint("B", "base", "two", position=(0.4, 0.0, 0.0), angle=-0.8),
    )
    gear = Coupling("mesh", ("A", "B"), ratio=-2.0)
    return Study(
        "geared", Mechanism((bar("one", 0.2, 0.3), bar("two", 0.15, 0.05)), joints, forces=(gear,)), duration=1.0
    )


def test_an_ideal_coupling_is_in_the_files():
    """With the offset of the start; one by a table or with a mesh that gives way is told."""
    layout = layout_of(geared())
    (ratio,) = layout.ratios
    assert (ratio.name, ratio.joints, ratio.ratio) == ("mesh", ("A", "B"), -2.0) and layout.remarks == ()
    assert ratio.offset == pytest.approx(-0.8 + 2.0 * 0.3)
    root = Xml.fromstring(mjcf_text(layout, "a test")[0])
    constraint = root.find("equality/joint[@name='mesh']")
    assert (constraint.get("joint1"), constraint.get("joint2")) == ("B", "A")
    assert [float(x) for x in constraint.get("polycoef").split()] == pytest.approx([0.0, -2.0, 0.0, 0.0, 0.0])
    mimic = Xml.fromstring(urdf_text(layout, "a test")[0]).find("joint[@name='B']/mimic")
    assert (mimic.get("joint"), float(mimic.get("multiplier"))) == ("A", -2.0)
    assert float(mimic.get("offset")) == pytest.approx(ratio.offset)
    assert "The coupling mesh." in table_text(layout, "a test")[1]
    soft = replace(geared().mechanism, forces=(Coupling("mesh", ("A", "B"), ratio=-2.0, stiffness=5.0),))
    assert layout_of(replace(geared(), mechanism=soft)).remarks == ("The coupling mesh.",)
    with pytest.raises(InputError, match="without couplings of joints, but the study has `mesh`"):
        exudyn_text(geared(), None, "x")


@needs_mujoco
@pytest.mark.slow
def test_a_coupling_makes_the_round_trip_and_moves_as_in_mujoco(tmp_path):
    layout, path = written(geared(), tmp_path)
    again, _ = read_layout(path)
    (one,), (other,) = layout.ratios, again.ratios
    assert (other.name, other.joints) == (one.name, one.joints)
    assert (other.ratio, other.offset) == pytest.approx((one.ratio, one.offset))
    rigid = replace(rigid_study(geared(), None, layout), method=RungeKutta4(step=5e-4))
    found = compared(path.read_text(encoding="utf-8"), rigid, layout)
    assert abs(found.ours["A"][-1] - 0.3) > 0.1 and found.largest() < 1e-3 < found.tolerance


@needs_mujoco
@pytest.mark.slow
@pytest.mark.parametrize("name", ["double_wishbone", "stewart"])
def test_spatial_loops_move_as_in_mujoco(name):
    """Balls and hinges that are not parallel; the strut moves the wheel, gravity the platform."""
    one = study(name)
    layout = layout_of(one)
    rigid = replace(rigid_study(one, None, layout), method=RungeKutta4(step=5e-4))
    found = compared(mjcf_text(layout, "a test")[0], rigid, layout)
    assert max(np.ptp(values) for values in found.ours.values()) > 1e-2
    assert found.largest() < found.tolerance


@needs_mujoco
@pytest.mark.slow
def test_the_command_verifies(tmp_path, capsys):
    """Both motions side by side, and a verdict; a file that holds less than the study is not compared."""
    path = tmp_path / "mine.toml"
    assert main(["init", str(path), "--kind", "slider-crank"]) == 0
    assert main(["export", str(path), "--to", "mjcf", "-o", str(tmp_path / "a.xml"), "--verify"]) == 0
    said = capsys.readouterr().out
    assert "Equal within 0.005 of the longest way" in said and "by MuJoCo" in said
    case = ["--case", "guide_tilted", "-o", str(tmp_path / "b.xml")]
    assert main(["export", str(path), "--to", "mjcf", "--verify", *case]) == 2
    assert "loops stay open by" in capsys.readouterr().err


def test_motions_that_differ_are_told():
    """The largest difference over the longest way of its dimension."""
    rows = {name: np.array(values) for name, values in {"A": [0.0, 1.0], "B": [0.0, 0.1], "S": [0.0, 0.01]}.items()}
    theirs = {"A": rows["A"], "B": rows["B"] + 0.01, "S": rows["S"] + [0.0, 1e-3]}
    units = {"A": "rad", "B": "rad", "S": "m"}
    assert ComparedMotion(np.array([0.0, 1.0]), units, rows, theirs, 0.1).largest() == pytest.approx(0.1)
    still = {"A": np.zeros(2)}
    assert ComparedMotion(np.array([0.0, 1.0]), {"A": "rad"}, still, still, 0.1).largest() == 0.0
    assert ComparedMotion(np.array([0.0, 1.0]), {"A": "rad"}, still, {"A": np.ones(2)}, 0.1).largest() == np.inf


FOREIGN = """<mujoco model="crane"><compiler angle="degree"/><option gravity="0 0 -9.8"/>
<default><joint damping="0.1"/></default>
<worldbody><geom type="plane" size="1 1 .1"/>
<body name="mast" pos="0 0 0.5"><joint name="turn" axis="0 0 1" ref="20"/><geom type="box" size=".1 .2 .3" mass="3"/>
<body name="boom arm" pos="0.1 0 0.3" euler="0 -30 0"><joint name="lift" axis="0 1 0" range="-40 40" limited="true"/>
<joint name="out" type="slide" axis="0 1 0" stiffness="50" springref="0.1" damping="2"/>
<geom type="capsule" fromto="0 0 0 1 0 0" size=".05" mass="2"/><site name="tip" pos="1 0 0"/>
<body name="hook" pos="1 0 0"><joint name="swing" type="ball"/><geom size=".04" pos="0 0 -.2" mass=".5"/></body></body>
</body><body name="load" pos="0.4 0 0.1"><freejoint/><geom size=".05" mass="1"/></body>
<body name="block" pos="0.4 0.3 0.1"><joint name="a" type="slide" axis="1 0 0"/>
<joint name="b" type="slide" axis="0 1 0"/>
<joint name="c" axis="0 0 1"/><geom size=".05" mass="1"/></body></worldbody>
<equality><weld name="grip" body1="hook" body2="load"/>
<connect name="rope" body1="block" anchor="0 0 0" body2="world"/>
<connect name="idle" body1="block" body2="world" anchor="0 0 0" active="false"/></equality>
<tendon><spatial name="line" stiffness="20" damping="1" springlength="0.3">
<site site="tip"/><site site="ground"/></spatial>
</tendon><actuator><motor joint="turn"/></actuator></mujoco>""".replace(
    '<geom type="plane"', '<site name="ground" pos="1 0 0"/><geom type="plane"'
)


@needs_mujoco
def test_a_file_of_others(tmp_path):
    """Defaults, degrees, several joints of a body, capsules, what is left out."""
    path = tmp_path / "crane.xml"
    path.write_text(FOREIGN, encoding="utf-8")
    layout, _ = read_layout(path)
    kinds = {one.name: (one.kind, one.cut) for one in layout.joints}
    assert kinds == {
        "turn": ("revolute", False), "lift": ("cylindrical", False), "swing": ("spherical", False),
        "load_free" if "load_free" in kinds else "joint4": ("free", False), "a": ("planar", False),
        "grip": ("fixed", True), "rope": ("spherical", True),
    }  # fmt: skip
    said = " ".join(layout.remarks)
    for words in ("limits of joint lift", "swing, of the kind spherical", "idle, which is not active", "actuators",
                  "Contacts", "`boom arm` is called `boom_arm`"):  # fmt: skip
        assert words in said, words
    model = mujoco.MjModel.from_xml_string(FOREIGN)
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    for body in layout.bodies:
        number = model.body(body.name.replace("boom_arm", "boom arm")).id
        np.testing.assert_allclose(
            body.pose.position + body.pose.rotation @ body.centre, data.xipos[number], atol=1e-12
        )
        axes = data.ximat[number].reshape(3, 3)
        np.testing.assert_allclose(
            body.pose.rotation @ body.inertia @ body.pose.rotation.T,
            (axes * model.body_inertia[number]) @ axes.T, atol=1e-12,
        )  # fmt: skip
    for joint in layout.joints:
        left, right = layout.sides(joint)
        np.testing.assert_allclose(left.position, right.position, atol=1e-12) if joint.name != "lift" else None
    lift = next(one for one in layout.joints if one.name == "lift")
    assert {one.motion: (one.stiffness, one.damping) for one in lift.springs} == {"R_y": (0.0, 0.1), "T_y": (50.0, 2.0)}
    toml = tmp_path / "crane.toml"
    toml.write_text(study_text(layout, "crane.xml", toml.name), encoding="utf-8")
    found = describe(discretise(replace(load_study(toml).mechanism, driven_joint=None)))
    assert found.coordinates == 1 + 2 + 3 + 6 + 3 and found.constraints == 6 + 3


CARDAN = """<mujoco><worldbody><body name="a"><joint name="first" axis="0 1 0" ref="20"/>
<joint name="second" axis="0 0 1" ref="35"/><geom size=".1" pos=".2 0 0" mass="1"/></body></worldbody></mujoco>"""


@needs_mujoco
def test_a_universal_joint_that_is_turned_at_its_start(tmp_path):
    """Both axes are where MuJoCo has them, and the coordinates count as its own."""
    path = tmp_path / "cardan.xml"
    path.write_text(CARDAN, encoding="utf-8")
    (joint,) = (layout := read_layout(path)[0]).joints
    left, right = layout.sides(joint)
    assert joint.kind == "universal" and joint.start == pytest.approx(np.radians([20.0, 35.0]))
    np.testing.assert_allclose(left.rotation[:, 1], [0.0, 1.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(right.rotation[:, 2], [0.0, 0.0, 1.0], atol=1e-12)
    np.testing.assert_allclose(left.then(motion_frame("universal", joint.start)).rotation, right.rotation, atol=1e-12)


@needs_mujoco
@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ('name="b" type="slide"', 'name="b"', "must be those of a kind that a study has"),
        ('mass="3"', 'mass="-3"', "MuJoCo must be able to compile"),
        ('axis="0 0 1" ref', 'axis="0 0 0" ref', "MuJoCo must be able to compile"),
        ("<mujoco", "<!DOCTYPE mujoco><mujoco", "without a document type"),
        ("</worldbody>", "", "must be XML"),
        ("<mujoco", "<muhoco", "must be XML"),
        ('name="mast"', 'name="base"', "No body of the file may be called `base`"),
    ],
)
def test_what_is_wrong_is_told_in_a_sentence(old, new, says, tmp_path):
    path = tmp_path / "crane.xml"
    assert old in FOREIGN
    path.write_text(FOREIGN.replace(old, new, 1), encoding="utf-8")
    with pytest.raises(InputError, match=says) as found:
        read_layout(path)
    assert len(found.value.problems) == 1


def test_without_mujoco_it_says_what_to_install(tmp_path, monkeypatch):
    import sys

    monkeypatch.setitem(sys.modules, "mujoco", None)
    path = tmp_path / "crane.xml"
    path.write_text(FOREIGN, encoding="utf-8")
    with pytest.raises(InputError, match=r"pip install \"rfem_jax\[mujoco\]\""):
        read_layout(path)


def test_what_mjcf_cannot_have():
    mechanism = replace(MACHINES["slider_crank"]())
    joints = [replace(one, cut=one.name == "G", displacement=None if one.name == "G" else one.displacement,
                      start=None, angle=None if one.name in "G" else (0.0 if one.name == "P" else one.angle),
                      child_position=(0.0, 0.0, 0.0) if one.name == "G" else one.child_position)
              for one in mechanism.joints]  # fmt: skip
    joints[3] = Joint("P", "rod", "slider", angle=-0.2629)
    layout = layout_of(Study("x", replace(mechanism, joints=joints, forces=()), duration=1.0))
    with pytest.raises(InputError, match="must be a hinge, a ball or fixed"):
        mjcf_text(layout, "x")
