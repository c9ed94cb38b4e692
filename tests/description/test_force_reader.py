"""Tables in a joint, springs and forces at points in study files: other ways of writing what has classes."""

import tomllib
from pathlib import Path

import numpy as np
import pytest

from rfem_jax import InputError, JointFriction, JointSpring, PointForce, PointMoment, PointSpring, PointSpringTable
from rfem_jax.description.study_file.force_reader import FORCES, read_force, read_joint, read_spring
from rfem_jax.description.study_file.study_reader import read_drive, read_mechanism

from .test_study_files import FULL

IN_JOINTS = """
stiffness = { radial = "100 N/um", axial = 5e7 }
damping = { radial = "2 N s/mm" }
spring = { stiffness = "3 N m/rad", damping = 0.1, rest = "10 deg" }
friction = { constant = "2 N m", sliding_rate = 0.01 }
"""
SPRINGS = """
[[mechanism.springs]]
name = "gas_spring"
links = ["base", "one"]
points = [["-1 cm", 0, "0.1 m"], "20 mm"]
stiffness = "2 N/mm"
[[mechanism.springs]]
name = "stop"
links = ["two", "three"]
points = [0.1, [0.05, 0, 0]]
lengths = [0, "90 mm"]
forces = [0, "1.5 kN"]
[[mechanism.springs]]
name = "return"
joint = "A"
stiffness = 2
[[mechanism.forces]]
name = "shove"
link = "two"
position = "30 mm"
force = [0, 0, "1 kN"]
frame = "link"
[[mechanism.forces]]
name = "wrench"
link = "one"
position = 0
moment = ["1 N m", 0, 0]
"""
PLACE = "[[mechanism.joints]] `B`"


def joint(text, kind="revolute"):
    return read_joint(tomllib.loads(f'name = "B"\nkind = "{kind}"\nparent = "a"\nchild = "b"\n{text}'), PLACE)


def test_a_joint_holds_its_compliance_springs_and_friction():
    tables, forces = joint(IN_JOINTS)
    written, none = joint('compliance = { radial = "100 N/um", axial = 5e7, radial_damping = "2 N s/mm" }')
    assert tables.springs == written.springs and none == []
    spring = JointSpring("B_spring", "B", stiffness="3 N m/rad", damping=0.1, rest="10 deg")
    assert forces == [spring, JointFriction("B_friction", "B", constant="2 N m", sliding_rate=0.01)]


def test_letters_name_single_directions():
    tables, _ = joint('stiffness = { x = 1, y = 2, rx = 3 }\ndamping = { rx = "4 N m s/rad", y = 5 }', "fixed")
    written, _ = joint("compliance = { T_x = 1, T_y = 2, R_x = 3, R_x_damping = 4, T_y_damping = 5 }", "fixed")
    assert {spring.name: spring for spring in tables.springs} == {spring.name: spring for spring in written.springs}
    assert tables.sprung == written.sprung and len(tables.sprung) == 3


def test_springs_and_friction_of_several_motions_are_lists():
    text = 'spring = [{ motion = "R_y", stiffness = 1 }, { motion = "T_y", stiffness = 2 }]\n'
    _, forces = joint(text, "cylindrical")
    assert forces == [
        JointSpring("B_spring_R_y", "B", stiffness=1, motion="R_y"),
        JointSpring("B_spring_T_y", "B", stiffness=2, motion="T_y"),
    ]
    _, (spring,) = joint('spring = { motion = "T_y", stiffness = 2 }', "cylindrical")
    assert spring == JointSpring("B_spring", "B", stiffness=2, motion="T_y")


def test_springs_and_forces_say_what_they_are():
    content = tomllib.loads(SPRINGS)["mechanism"]
    gas, stop, back = (read_spring(one, "[[mechanism.springs]]") for one in content["springs"])
    assert gas == PointSpring("gas_spring", ["base", "one"], [["-1 cm", 0, "0.1 m"], "20 mm"], stiffness="2 N/mm")
    assert isinstance(stop, PointSpringTable) and stop.forces == (0.0, 1500.0)
    assert back == JointSpring("return", "A", stiffness=2)
    shove, wrench = (read_force(one, "[[mechanism.forces]]") for one in content["forces"])
    assert shove == PointForce("shove", "two", "30 mm", [0, 0, "1 kN"], axes="link")
    assert wrench == PointMoment("wrench", "one", 0, [1, 0, 0])
    assert read_force({**content["forces"][0], "kind": "point_force"}, "[[mechanism.forces]]") == shove


def test_a_mechanism_holds_them_all():
    text = FULL.replace('name = "B"\n', f'name = "B"\n{IN_JOINTS}', 1)
    text = text.replace("[drive]", f"{SPRINGS}[drive]")
    mechanism = read_mechanism(tomllib.loads(text)["mechanism"])
    names = ["B_spring", "B_friction", "gas_spring", "stop", "return", "shove", "wrench"]
    assert [force.name for force in mechanism.forces] == names
    assert mechanism.joint("B").sprung == ("T_x", "T_z", "T_y")
    assert mechanism.force("B_spring").rest == pytest.approx(np.radians(10.0))


def test_the_guide_has_a_table_of_each_kind():
    """Its block is a whole mechanism, and is read as it is written there."""
    guide = (Path(__file__).parents[2] / "docs" / "guides" / "own_mechanism.md").read_text(encoding="utf-8")
    content = tomllib.loads(guide.split("```toml\n")[1].split("```")[0])
    mechanism = read_mechanism(content["mechanism"])
    assert {type(force) for force in mechanism.forces} == set(FORCES.values())
    assert mechanism.joint("D").sprung == ("T_x", "T_z", "T_y")
    assert read_drive(content["drive"]).joint == "A"


@pytest.mark.parametrize(
    ("text", "kind", "pieces"),
    [
        ("stiffness = { radial = 1 }\ncompliance = { tilt = 1 }", "revolute", ("either `compliance` or", "both")),
        ("damping = { radial = 1 }", "revolute", ("must have `stiffness` beside `damping`", "`spring`")),
        ("stiffness = { radal = 1 }", "revolute", ("`B` stiffness", "`radal`", "`radial`")),
        (
            "stiffness = { x = 1, rx = 1 }",
            "revolute",
            ("`stiffness` of joint `B`", "`rx` is not one of", "`tilt`"),
        ),
        ("stiffness = { x = 1 }", "planar", ("`x` is not one of them", "planar", "`axial`")),
        ("stiffness = { radial = 1, z = 1 }", "revolute", ("`radial` and `z` both",)),
        ("stiffness = { axial = 1 }\ndamping = { radial = 1 }", "revolute", ("`radial` beside `damping.radial`",)),
        ("stiffness = { tilt = '3 N/m' }", "revolute", ("`stiffness.tilt` of joint `B`",)),
        ("stiffness = { x = 1 }\ndamping = { x = '3 N m s/rad' }", "revolute", ("`damping.x` of joint `B`",)),
        ("stiffness = 3", "revolute", ("`B` stiffness must be a table of directions", "spring = { stiffness")),
        ("stiffness = {}", "revolute", ("must spring a direction", "radial, axial, tilt, x")),
        ("stiffness = { x = 1 }", "free", ("`stiffness` of joint `B`", "holds nothing")),
        ("spring = { stifness = 1 }", "revolute", ("`B` spring", "`stifness`", "`stiffness`")),
        ("spring = 3", "revolute", ("`B` spring must be a table",)),
        ("spring = [{ stiffness = 1 }, { motion = 'T_y' }]", "cylindrical", ("`B` spring", "the key `motion`")),
        ("friction = { law = 'dry' }", "revolute", ("`law` of force `B_friction`", "tanh")),
    ],
)
def test_wrong_tables_in_a_joint_are_refused(refused, text, kind, pieces):
    with refused(*pieces):
        joint(text, kind)


@pytest.mark.parametrize(
    ("read", "table", "pieces"),
    [
        (read_force, {"name": "f", "link": "a", "position": 0, "force": [1, 0, 0], "frame": "body"},
         ("`frame` must be one of", '"link"')),
        (read_force, {"name": "f", "link": "a", "position": 0, "force": [1, 0, 0], "frame": "link", "axes": "link"},
         ("either `frame` or `axes`",)),
        (read_force, {"name": "f", "link": "a", "force": [1, 0, 0]}, ("the key `position`",)),
        (read_force, {"name": "f", "link": "a", "position": 0}, ("the key `kind`",)),
        (read_force, {"name": "f", "kind": "joint_spring", "joint": "A", "frame": "link"},
         ('kind "joint_spring"', "`frame`")),
        (read_spring, {"name": "s", "stiffness": 1, "links": ["a", "b"]}, ("between points", "the key `points`")),
        (read_spring, {"name": "s", "joint": "A", "lengths": [0, 1]}, ("at a joint", "`lengths`")),
    ],
)  # fmt: skip
def test_wrong_springs_and_forces_are_refused(refused, read, table, pieces):
    with refused(*pieces):
        read(table, "[[mechanism.forces]] `f`")


def test_keys_of_other_kinds_are_not_suggested():
    """`points` is a key of springs."""
    with pytest.raises(InputError) as caught:
        read_force({"name": "f", "link": "a", "point": 0, "force": [1, 0, 0]}, "[[mechanism.forces]] `f`")
    unknown, missing = caught.value.problems
    assert "`point`; known are" in unknown and "`points`" not in unknown and "the key `position`" in missing


def test_mistakes_in_a_joint_are_told_together():
    with pytest.raises(InputError) as caught:
        joint("angel = 3\nstiffness = { radal = 1 }\nspring = { stiffness = 1, rst = 2 }")
    assert len(caught.value.problems) == 3
