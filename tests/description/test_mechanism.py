"""Links, joints and the mechanism: defaults, order of the tree, names of errors, refusals."""

import itertools
import math
from dataclasses import replace

import pytest

from rfem_jax import Circle, GivenSection, Joint, Link, Material, Mechanism, PointMass
from rfem_jax.description.tolerances.error_catalogue import error_dimension

STEEL = Material("steel", 210e9, 7850.0, poisson_ratio=0.3)
ROUND = Circle("10 mm")
GIVEN = GivenSection(1e6, 1e6, 1e6, 1e2, 1e2, 1e2, 1.0, 2e-5, 1e-5, 1e-5)


def beam(name, **settings):
    return Link(name, settings.pop("length", 0.3), ROUND, STEEL, **settings)


LINKS = [beam("crank", rigid=True), beam("coupler"), beam("rocker")]
JOINTS = [
    Joint("A", "base", "crank", angle="-90 deg"),
    Joint("B", "crank", "coupler"),
    Joint("D", "base", "rocker", position=[0.3, 0, 0]),
    Joint("C", "coupler", "rocker", cut=True),
]


def four_bar(**joints):
    """The four-bar; D=joint replaces the joint D, D=None leaves it out."""
    changed = [joints.get(joint.name, joint) for joint in JOINTS]
    return Mechanism(LINKS, [joint for joint in changed if joint is not None])


def test_link_defaults_and_number_of_elements():
    link = beam("coupler")
    assert (link.elements, link.flexible, link.point_masses) == (5, True, ())
    for rigid in (beam("coupler", rigid=True), beam("coupler", rfes=1)):
        assert (rigid.elements, rigid.flexible) == (1, False)
    assert beam("coupler", rfes=9).elements == 9
    assert link.properties == ROUND.properties(STEEL)
    assert Link("crank", "30 cm", GIVEN).properties == GIVEN.properties()
    assert Link("crank", "30 cm", GIVEN).length == 0.3


def test_point_masses():
    assert PointMass("20 g", "5 cm").position == (0.05, 0.0, 0.0)
    mass = PointMass(0.02, [0.05, 0.0, "-2 mm"], ["1 kg mm^2", 1e-6, 1e-6])
    assert mass.position == (0.05, 0.0, -0.002)
    assert mass.inertia == (1e-6, 1e-6, 1e-6)
    assert beam("coupler", point_masses=[mass]).point_masses == (mass,)
    assert beam("crank", rigid=True, point_masses=[PointMass(1.0, -0.1)]).point_masses


@pytest.mark.parametrize(
    ("build", "pieces"),
    [
        (lambda: beam("base"), ("`name` of a link", "reserved")),
        (lambda: beam("a.b"), ("`name` of a link",)),
        (lambda: beam("a", length=-0.1), ("`length` of link `a`", "greater than 0")),
        (lambda: beam("a", length="1 deg"), ("`length` of link `a`", "angle")),
        (lambda: Link("a", 0.1, None, STEEL), ("`section` of link `a`",)),
        (lambda: Link("a", 0.1, ROUND), ("`material` of link `a`",)),
        (lambda: Link("a", 0.1, ROUND, "steel"), ("`material` of link `a`", "steel")),
        (lambda: Link("a", 0.1, GIVEN, STEEL), ("`material` of link `a`", "left out")),
        (lambda: beam("a", rigid="yes"), ("`rigid` of link `a`", "true or false")),
        (lambda: beam("a", rfes=0), ("`rfes` of link `a`",)),
        (lambda: beam("a", rfes=5.0), ("`rfes` of link `a`", "whole number")),
        (lambda: beam("a", rfes=True), ("`rfes` of link `a`",)),
        (lambda: beam("a", point_masses=[0.1]), ("`point_masses` of link `a`",)),
        (lambda: beam("a", point_masses=[PointMass(1, 0.31)]), ("`point_masses`", "0.31")),
        (lambda: beam("a", point_masses=[PointMass(1, -0.01)]), ("`point_masses`", "-0.01")),
        (lambda: PointMass(0.0, 0.1), ("`mass` of a point mass",)),
        (lambda: PointMass(1.0, "1 kg"), ("`position` of a point mass",)),
        (lambda: PointMass(1.0, [0.1, 0.2]), ("`position` of a point mass",)),
        (lambda: PointMass(1.0, 0.1, (-1e-6, 0, 0)), ("`inertia` of a point mass",)),
        (lambda: PointMass(1.0, 0.1, (1e-6, 0, 0)), ("`inertia` of a point mass", "real body")),
        (lambda: Joint("A.x", "base", "crank"), ("`name` of a joint",)),
        (lambda: Joint("A", None, "crank"), ("`parent` of joint `A`",)),
        (lambda: Joint("A", "crank", "base"), ("`child` of joint `A`", "the base")),
        (lambda: Joint("A", "crank", "crank"), ("`child` of joint `A`", "differ")),
        (lambda: Joint("A", "base", "crank", position=[0, 0]), ("`position` of joint `A`",)),
        (lambda: Joint("A", "base", "crank", orientation=["1 mm", 0, 0]), ("`orientation`",)),
        (lambda: Joint("A", "base", "crank", child_position=1.0), ("`child_position`",)),
        (lambda: Joint("A", "base", "crank", child_orientation=1.0), ("`child_orientation`",)),
        (lambda: Joint("A", "base", "crank", angle="1 m"), ("`angle` of joint `A`",)),
        (lambda: Joint("A", "base", "crank", cut=1), ("`cut` of joint `A`",)),
        (lambda: Joint("C", "a", "b", angle=0.0, cut=True), ("`angle` of joint `C`", "cut")),
    ],
)
def test_bad_links_and_joints_are_refused(refused, build, pieces):
    with refused(*pieces):
        build()


def test_joint_defaults():
    joint = Joint("A", "base", "crank", orientation=["90 deg", 0, 0])
    assert joint.angle == 0.0 and joint.position is None and joint.child_position is None
    assert joint.orientation == (math.pi / 2, 0.0, 0.0)
    assert joint.child_orientation == (0.0, 0.0, 0.0)
    assert Joint("C", "a", "b", cut=True).angle is None


def test_the_tree_and_the_cut_joints():
    mechanism = four_bar()
    assert [joint.name for joint in mechanism.tree_joints] == ["A", "D", "B"]
    assert [joint.name for joint in mechanism.cut_joints] == ["C"]
    assert mechanism.link("rocker") is LINKS[2]
    assert mechanism.joint("A").angle == -math.pi / 2
    assert mechanism.gravity == (0.0, 0.0, -9.81)
    assert hash(mechanism) == hash(four_bar())


def test_parents_come_first_whatever_the_order_given():
    """A branched tree: base-a-b-c and a-d."""
    links = [beam(name) for name in "abcd"]
    joints = [Joint(f"J{c}", p, c) for p, c in (("base", "a"), ("a", "b"), ("b", "c"), ("a", "d"))]
    for order in itertools.permutations(links):
        tree = Mechanism(order, joints[::-1]).tree_joints
        seen = ["base"]
        for joint in tree:
            assert joint.parent in seen
            seen.append(joint.child)
        assert len(tree) == 4
    assert [joint.child for joint in Mechanism(links, joints[::-1]).tree_joints] == list("abdc")


def test_several_loops_are_expressible():
    links = [*LINKS, beam("second_coupler"), beam("second_rocker")]
    joints = [
        *JOINTS,
        Joint("E", "rocker", "second_coupler", position=["10 cm", 0, 0]),
        Joint("G", "base", "second_rocker", position=[0.6, 0, 0]),
        Joint("F", "second_coupler", "second_rocker", cut=True),
    ]
    assert [joint.name for joint in Mechanism(links, joints).cut_joints] == ["C", "F"]


def test_error_names_are_those_of_the_contract():
    mechanism = four_bar()
    kinds = ["delta_x", "delta_z", "d_x", "d_y", "d_z"]
    expected = {f"{joint}.{kind}" for joint in "ABCD" for kind in kinds}
    expected |= {f"{joint}.child.{kind}" for joint in "ABCD" for kind in kinds}
    expected |= {f"{joint}.pin_tilt_{axis}" for joint in "ABCD" for axis in "xz"}
    expected |= {f"{link.name}.{kind}" for link in LINKS for kind in ("length", "twist")}
    assert set(mechanism.error_names) == expected
    assert len(mechanism.error_names) == len(expected)
    units = {name: mechanism.error_unit(name) for name in expected}
    metres = {name for name in expected if ".d_" in name or name.endswith(".length")}
    assert {name for name, unit in units.items() if unit == "m"} == metres
    assert {name for name, unit in units.items() if unit == "rad"} == expected - metres


def test_unknown_errors_are_refused_with_the_nearest(refused):
    with refused("`D.delt_x`", "did you mean `D.delta_x`?"):
        four_bar().error_unit("D.delt_x")
    with refused("`D.delta_y`", "the free motions of a revolute joint make it good"):
        four_bar().error_unit("D.delta_y")
    with refused("`E.d_y`", "`D.d_y`"):
        Mechanism(LINKS[2:], JOINTS[2:3]).error_unit("E.d_y")
    with refused("`delta`", "`D.delta`"):
        error_dimension("D.delta")
    for name in ("delta_x", ".delta_x", 7):
        with refused("a dot"):
            error_dimension(name)


def test_unknown_names_are_refused_with_the_nearest(refused):
    with refused("`roker`", "did you mean `rocker`?"):
        four_bar().link("roker")
    with refused("`E`", "`A`"):
        four_bar().joint("E")


@pytest.mark.parametrize(
    ("build", "pieces"),
    [
        (lambda: Mechanism([], []), ("`links`", "at least one")),
        (lambda: Mechanism(LINKS[0], JOINTS), ("`links`", "list")),
        (lambda: Mechanism(LINKS, ["A"]), ("`joints`", "list")),
        (lambda: Mechanism([*LINKS, LINKS[0]], JOINTS), ("`links`", "unique", "`crank`")),
        (lambda: Mechanism(LINKS, [*JOINTS, JOINTS[0]]), ("`joints`", "unique", "`A`")),
        (lambda: Mechanism(LINKS, JOINTS, gravity=9.81), ("`gravity`",)),
        (lambda: Mechanism(LINKS, JOINTS, gravity=["9 m", 0, 0]), ("`gravity`", "acceleration")),
        (lambda: Mechanism(LINKS, JOINTS, redundant_reactions="minimum"), ("`minimum_norm`?",)),
        (lambda: Mechanism(LINKS, JOINTS, driven_joint="C"), ("`driven_joint`", "`C` is cut")),
        (lambda: Mechanism(LINKS, JOINTS, driven_joint="E"), ("joint of the mechanism", "`E`")),
        (lambda: four_bar(B=Joint("B", "crnk", "coupler")), ("`parent`", "`crank`?")),
        (lambda: four_bar(B=Joint("B", "crank", "couple")), ("`child`", "`coupler`?")),
        (lambda: four_bar(C=replace(JOINTS[3], cut=False)), ("`rocker`", "cut = true")),
        (lambda: four_bar(B=None, C=None), ("`coupler`", "add a joint with child")),
        (lambda: four_bar(D=None), ("`rocker`", "cut joint `C`", "uncut")),
        (lambda: four_bar(A=None), ("`crank`", "only the parent of joint `B`")),
        (
            lambda: four_bar(A=Joint("A", "coupler", "crank")),
            ("crank -> coupler -> crank", "cut = true"),
        ),
    ],
)
def test_bad_mechanisms_are_refused(refused, build, pieces):
    with refused(*pieces):
        build()


@pytest.mark.parametrize("x", [-0.01, 0.31])
def test_positions_off_a_flexible_link_are_refused(refused, x):
    with refused("`position` of joint `C`", "`coupler`", str(x)):
        four_bar(C=replace(JOINTS[3], position=(x, 0, 0)))
    with refused("`child_position` of joint `C`", "`rocker`", str(x)):
        four_bar(C=replace(JOINTS[3], child_position=(x, 0, 0)))
    assert four_bar(B=replace(JOINTS[1], position=(x, 0, 0)))  # the crank is rigid
    assert four_bar(D=replace(JOINTS[2], position=(x, 0, 0)))  # the base is anywhere


def test_the_child_of_a_tree_joint_is_held_at_its_first_element(refused):
    """Rocker of 0.3 m in 5 elements: the first one ends at 0.3 / 8 m."""
    assert four_bar(D=replace(JOINTS[2], child_position=(0.0375, 0, 0)))
    with refused("`child_position` of joint `D`", "first rigid finite element", "0.0375"):
        four_bar(D=replace(JOINTS[2], child_position=(0.04, 0, 0)))
