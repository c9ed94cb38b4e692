"""Forces on the free motions of joints: what is described, what is refused, and in study files."""

import jax.numpy as jnp
import numpy as np
import pytest

from rfem_jax import (
    Compliance,
    Joint,
    JointForceFunction,
    JointForceTable,
    JointFriction,
    JointSpring,
    Link,
    Mechanism,
    Rectangle,
    load_study,
)
from tests.mechanisms import STEEL

from .test_study_files import FULL

BAR = Rectangle(0.01, 0.01)
GAS = JointForceTable("gas", "P", ["10 cm", 0.2], ["1 kN", -3])

FORCES = """
[[mechanism.forces]]
kind = "joint_spring"
name = "return_spring"
joint = "A"
stiffness = "2 N m/deg"
damping = 0.1
rest = "10 deg"
preload = "-30 N mm"
[[mechanism.forces]]
kind = "joint_table"
name = "cam"
joint = "B"
positions = [0, "90 deg"]
forces = [0, "1.5 N m"]
motion = "R_y"
[[mechanism.forces]]
kind = "friction"
name = "bearing"
joint = "D"
coefficient = "15 %"
radius = "8 mm"
length = 0.02
constant = "20 N mm"
viscous = 1e-3
sliding_rate = "10 rpm"
law = "brown_mcphee"
static_coefficient = 0.2
"""


def mechanism(*forces):
    links = [Link(name, 0.1, BAR, STEEL, rigid=True) for name in "abcd"]
    joints = [
        Joint("A", "base", "a"),
        Joint("P", "a", "b", kind="prismatic"),
        Joint("C", "b", "c", kind="cylindrical"),
        Joint("S", "c", "d", kind="spherical"),
        Joint("F", "a", "c", kind="fixed", cut=True),
    ]
    return Mechanism(links, joints, forces=list(forces))


def with_forces(text):
    return FULL.replace("[drive]", f"{text}[drive]", 1)


def test_units_follow_the_motion():
    made = mechanism(
        JointSpring("turn", "A", stiffness="2 N m/deg", damping="0.1 N m s/rad", rest="10 deg", preload="3 N m"),
        JointSpring("slide", "C", stiffness="2 N/mm", damping="5 N s/m", rest="10 mm", preload="3 N", motion="T_y"),
        GAS,
    )
    spring = made.force("turn")
    np.testing.assert_allclose(
        [spring.stiffness, spring.damping, spring.rest, spring.preload], [360.0 / np.pi, 0.1, np.pi / 18.0, 3.0]
    )
    spring = made.force("slide")
    assert (spring.stiffness, spring.damping, spring.rest, spring.preload) == (2000.0, 5.0, 0.01, 3.0)
    assert made.force("turn").motion == "R_y"
    assert (made.force("gas").positions, made.force("gas").forces) == ((0.1, 0.2), (1000.0, -3.0))


@pytest.mark.parametrize(
    "force, pieces",
    [
        (JointSpring("k", "B"), ("`joint` of force `k`", "`B` is not a joint")),
        (JointSpring("k", "F"), ("joint of the tree", "`F` is cut", "cut another joint")),
        (JointSpring("k", "C"), ("`motion` of force `k`", "cylindrical", '"R_y", "T_y"')),
        (JointSpring("k", "C", motion="T_x"), ("`motion` of force `k`", "T_y")),
        (JointSpring("k", "S"), ("`motion` of force `k`", "spherical", "not offered")),
        (JointSpring("k", "A", stiffness="2 N/m"), ("`stiffness` of force `k`", "a rotational stiffness")),
        (JointSpring("k", "P", stiffness=-1.0), ("`stiffness` of force `k`", "negative")),
        (JointSpring("k", "P", rest="1 deg"), ("`rest` of force `k`", "an angle")),
        (JointForceTable("k", "P", [0.0, 0.0], [1.0, 2.0]), ("`positions` of force `k`", "increasing")),
        (JointForceTable("k", "P", [0.0, 1.0], [1.0]), ("`forces` of force `k`", "has 1")),
    ],
)
def test_forces_that_do_not_fit_their_joint_are_refused(refused, force, pieces):
    with refused(*pieces):
        mechanism(force)


SLIDING = {"constant": 1.0, "sliding_rate": 0.1}
LOADED = {"coefficient": 0.1, "sliding_rate": 0.1}


@pytest.mark.parametrize(
    "friction, pieces",
    [
        (JointFriction("f", "S", **SLIDING), ("`joint` of force `f`", "`S` is spherical")),
        (JointFriction("f", "F", viscous=1.0), ("`joint` of force `f`", "`F` is fixed")),
        (JointFriction("f", "B", viscous=1.0), ("`joint` of force `f`", "`B` is not a joint")),
        (JointFriction("f", "C", **SLIDING), ("`motion` of force `f`", '"R_y", "T_y"')),
        (JointFriction("f", "A", constant=1.0), ("`sliding_rate` of force `f`", "is missing")),
        (JointFriction("f", "A", **LOADED), ("`radius` of force `f`", "radius of the pin")),
        (JointFriction("f", "P", radius=0.1, **LOADED), ("`radius` of force `f`", "a rotation")),
        (JointFriction("f", "P", length=0.1, **SLIDING), ("`length` of force `f`", "`coefficient`")),
        (JointFriction("f", "A", viscous=1.0, sliding_rate=0.1), ("`sliding_rate` of force `f`", "not used")),
        (JointFriction("f", "A", static_constant=2.0, **SLIDING), ("`static_constant` of force `f`", "brown_mcphee")),
        (JointFriction("f", "A", static_constant=0.5, law="brown_mcphee", **SLIDING), ("at least `constant` (1)",)),
        (JointFriction("f", "P", constant="1 N m", sliding_rate=0.1), ("`constant` of force `f`", "a force")),
        (JointFriction("f", "P", constant=1.0, sliding_rate="1 rpm"), ("`sliding_rate` of force `f`", "a speed")),
        (JointFriction("f", "A", constant=-1.0, sliding_rate=0.1), ("`constant` of force `f`", "negative")),
        (JointFriction("f", "A", constant=1.0, sliding_rate=0.0), ("`sliding_rate` of force `f`",)),
    ],
)
def test_friction_that_does_not_fit_its_joint_is_refused(refused, friction, pieces):
    with refused(*pieces):
        mechanism(friction)


def test_friction_about_an_axis_whose_tilt_is_sprung_is_refused_in_the_tree(refused):
    links, friction = [Link("a", 0.1, BAR, STEEL, rigid=True)], JointFriction("f", "A", **SLIDING)
    with refused("`joint` of force `f`", "the tilt of `A` is sprung"):
        Mechanism(links, [Joint("A", "base", "a", compliance=Compliance(tilt=1.0))], forces=[friction])
    Mechanism(links, [Joint("A", "base", "a", compliance=Compliance(radial=1.0))], forces=[friction])


def test_an_unknown_law_of_friction_is_refused(refused):
    with refused("`law` of force `f`", '"tanh"'):
        JointFriction("f", "A", law="tan", **SLIDING)


def test_a_joint_without_a_free_motion_has_no_force(refused):
    links = [Link("a", 0.1, BAR, STEEL, rigid=True)]
    with refused("`joint` of force `k`", "`F` is fixed"):
        Mechanism(links, [Joint("F", "base", "a", kind="fixed")], forces=[JointSpring("k", "F")])


def test_names_are_unique_and_objects_are_forces(refused):
    with refused("`forces`", "`gas` occurs twice"):
        mechanism(GAS, GAS)
    with refused("`forces`", "Force objects"):
        mechanism("spring")


@pytest.mark.parametrize(
    "function, pieces",
    [
        (3.0, ("`function` of force `f`", "3.0")),
        (lambda q: q, ("function(position, rate)", "TypeError")),
        (lambda q, v: jnp.stack([q, v]), ("float64 scalar",)),
    ],
)
def test_functions_are_checked(refused, function, pieces):
    with refused(*pieces):
        JointForceFunction("f", "A", function)


def test_forces_of_a_study_file(tmp_path):
    path = tmp_path / "study.toml"
    path.write_text(with_forces(FORCES), encoding="utf-8")
    spring, cam, bearing = load_study(path).mechanism.forces
    np.testing.assert_allclose([spring.stiffness, spring.rest, spring.preload], [360.0 / np.pi, np.pi / 18.0, -0.03])
    np.testing.assert_allclose([*cam.positions, *cam.forces], [0.0, np.pi / 2.0, 0.0, 1.5])
    found = bearing.coefficient, bearing.radius, bearing.constant, bearing.sliding_rate, bearing.static_coefficient
    np.testing.assert_allclose(found, [0.15, 0.008, 0.02, np.pi / 3.0, 0.2])
    assert (bearing.joint, bearing.motion, bearing.static_constant) == ("D", "R_y", None)


@pytest.mark.parametrize(
    "old, new, pieces",
    [
        ('kind = "joint_spring"', 'kind = "spring"', ("[[mechanism.forces]] `return_spring`", '"joint_spring"')),
        ("damping", "dampng", ("`dampng`", "`damping`?")),
        ('joint = "A"', 'joint = "D"', ("`return_spring`", "`D` is cut")),
        ('positions = [0, "90 deg"]\n', "", ('of kind "joint_table"', "`positions`")),
    ],
)
def test_mistakes_in_a_study_file_are_named(refused, tmp_path, old, new, pieces):
    path = tmp_path / "study.toml"
    path.write_text(with_forces(FORCES.replace(old, new, 1)), encoding="utf-8")
    with refused(*pieces):
        load_study(path)
