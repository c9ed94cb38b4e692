"""Compliant joints: which directions a kind has, what is refused, and in study files."""

from dataclasses import replace

import numpy as np
import pytest

from rfem_jax import Compliance, InputError, Joint, Link, Mechanism, Rectangle, describe, discretise, load_study
from rfem_jax.description.basics.joint_kinds import KINDS, JointKind, compliant
from rfem_jax.report.contents.overview import _compliance_text
from tests.mechanisms import STEEL, compliant_four_bar, four_bar

from .test_study_files import FULL

COMPLIANCE = """compliance = { radial = "100 N/um", tilt = "1e4 N m/rad", tilt_damping = 0.1, axial = AXIAL }
""".replace("AXIAL", '{ positions = [0, "1 mm", "2 mm"], forces = [0, "2 kN", "6 kN"] }')


def joint(kind="revolute", cut=False, **compliance):
    return Joint("J", "a", "b", kind=kind, cut=cut, compliance=Compliance(**compliance))


def test_the_directions_of_all_kinds_follow_from_their_motions():
    names = {kind: {name for name in KINDS[kind].directions if name[1] != "_"} for kind in KINDS}
    assert names == {
        "revolute": {"radial", "axial", "tilt"},
        "prismatic": {"normal", "tilt", "roll"},
        "cylindrical": {"radial", "tilt"},
        "universal": {"radial", "tilt"},
        "spherical": {"radial"},
        "planar": {"axial", "tilt"},
        "fixed": {"radial"},
        "free": set(),
    }
    assert KINDS["revolute"].directions["tilt"] == ("R_x", "R_z")
    assert KINDS["universal"].directions["tilt"] == ("R_x",)
    assert KINDS["prismatic"].directions["normal"] == ("T_y", "T_z")
    # A kind that is in no table: a screw without thread about z.
    ninth = JointKind("sleeve", ("R_z", "T_z"))
    assert ninth.directions["radial"] == ("T_x", "T_y")
    assert compliant(ninth, ("T_x", "R_x", "R_y")).motions == ("T_x", "T_z", "R_z", "R_x", "R_y")


def test_sprung_directions_are_coordinates_and_the_nominal_ones_keep_their_names():
    whole = Compliance(radial=1.0, axial=1.0, tilt=1.0)
    made = compliant(KINDS["revolute"], joint(radial=1.0, axial=1.0, tilt=1.0).sprung)
    assert made.motions == ("T_x", "T_y", "T_z", "R_y", "R_z", "R_x")
    assert (made.own, made.to_hinge_frame, made.axis, made.name) == ((3,), 4, 1, "revolute")
    assert made.errors(child=True) == KINDS["revolute"].errors(child=True)
    assert Joint("J", "a", "b", angle=0.3, compliance=whole).start_values == (0.3,)
    made = compliant(KINDS["cylindrical"], ("T_x",))
    assert (made.motions, made.own) == (("T_x", "T_y", "R_y"), (2, 1))
    made = compliant(KINDS["universal"], ("R_x",))
    assert (made.motions, made.own, made.to_hinge_frame) == (("R_y", "R_x", "R_z"), (0, 2), 3)
    made = compliant(KINDS["spherical"], ("T_x", "T_y", "T_z"))
    assert made.motions == ("T_x", "T_y", "T_z", "R") and made.own == (3, 4, 5)


def test_units_and_tables_of_both_senses():
    made = joint("prismatic", roll="2 N m/deg", T_y={"positions": ["-1 mm", 0, 0.002], "forces": [-3, 0, "1 N"]},
                 T_z={"positions": [0, 0.5], "forces": [0, 2]}, T_z_damping="5 N s/m")  # fmt: skip
    springs = {spring.name: spring for spring in made.springs}
    np.testing.assert_allclose(springs["roll"].stiffness, 360.0 / np.pi)
    assert springs["T_y"].positions == (-0.001, 0.0, 0.002) and springs["T_y"].forces == (-3.0, 0.0, 1.0)
    assert springs["T_z"].positions == (-0.5, 0.0, 0.5) and springs["T_z"].forces == (-2.0, 0.0, 2.0)
    assert springs["T_z"].damping == 5.0 and springs["roll"].rotation and not springs["T_z"].rotation


@pytest.mark.parametrize(
    "kind, cut, compliance, message",
    [
        ("revolute", False, {}, "must spring a direction, but is empty; give one of radial, axial, tilt"),
        ("revolute", False, {"normal": 1.0}, "a revolute joint holds, but `normal` is not one of them"),
        ("revolute", False, {"R_x": 1.0}, "a revolute joint holds, but `R_x` is not one of them"),
        ("spherical", False, {"tilt": 1.0}, "a spherical joint holds, but `tilt` is not one of them"),
        ("free", False, {"radial": 1.0}, "must be left out because a free joint holds nothing"),
        ("revolute", False, {"radial": 1.0, "T_x": 2.0}, "but `radial` and `T_x` both do so along or about x"),
        ("revolute", False, {"radial_damping": 1.0}, "must have the stiffness `radial` beside `radial_damping`"),
        ("revolute", False, {"radial": 0.0}, "`compliance.radial` of joint `J` must be greater than 0"),
        ("revolute", False, {"tilt": "3 N/m"}, "`compliance.tilt` of joint `J` must be"),
        (
            "revolute",
            False,
            {"axial": 1.0, "axial_damping": -1.0},
            "`compliance.axial_damping` of joint `J` must not be",
        ),
        ("revolute", False, {"radial": {"positions": [-1, 1], "forces": [-1, 1]}}, "begin with the position 0 and"),
        ("revolute", False, {"axial": {"positions": [-1, 1], "forces": [-1, 2]}}, "or pass from a negative position"),
        ("revolute", False, {"axial": {"positions": [0, 1], "forces": [0, -1]}}, "forces` that do not decrease"),
        ("revolute", False, {"axial": {"positions": [0, 1]}}, "a table with `positions` and `forces`"),
        ("revolute", False, {"axial": {"positions": [0, 1], "forces": [0, 1, 2]}}, "as many `forces` as `positions`"),
        ("prismatic", True, {"roll": 1.0}, "must spring no rotation because the joint is prismatic and cut"),
    ],
)
def test_what_does_not_fit_is_refused(refused, kind, cut, compliance, message):
    with refused(message):
        joint(kind, cut, **compliance)


def test_another_object_is_refused(refused):
    with refused("`compliance` of joint `J` must be a Compliance, but was 3"):
        Joint("J", "a", "b", compliance=3)


def test_in_a_study_file(tmp_path, refused):
    path = tmp_path / "study.toml"
    path.write_text(FULL.replace('name = "A"\n', f'name = "A"\n{COMPLIANCE}', 1), encoding="utf-8")
    study = load_study(path)
    springs = {spring.name: spring for spring in study.mechanism.joint("A").springs}
    assert springs["radial"].stiffness == 1e8 and springs["tilt"].damping == 0.1
    assert springs["axial"].forces == (-6000.0, -2000.0, 0.0, 2000.0, 6000.0)
    text = _compliance_text(study.mechanism)
    assert "Joint A is compliant: radial 1e+08 N/m, axial a table, tilt 10000 N m/rad with 0.1 N m s/rad." in text
    path.write_text(FULL.replace('name = "A"\n', 'name = "A"\ncompliance = { radal = 1 }\n', 1), encoding="utf-8")
    with refused("compliance must have known keys only, but has `radal`", "radial"):
        load_study(path)


class TestRankAndMobility:
    def test_a_rigid_loop_without_compliance_is_refused_with_this_fix(self):
        with pytest.raises(InputError, match="5 closure equations have rank 2.* give joints of each loop a compliance"):
            discretise(four_bar(None, redundant_reactions="refuse"))

    def test_sprung_directions_count_as_coordinates(self):
        structure = describe(discretise(compliant_four_bar(rfes=None)))
        assert (structure.coordinates, structure.constraints, structure.rank, structure.mobility) == (18, 0, 0, 18)
        assert (structure.rigid_coordinates, structure.rigid_rank, structure.rigid_mobility) == (3, 2, 1)
        assert not structure.redundant and structure.idle == ()

    def test_one_compliant_joint_makes_the_reactions_of_a_planar_loop_unique(self):
        """Of the five closure equations three are redundant: axial, and two tilts."""
        enough = Compliance(axial=1.0, tilt=1.0)
        assert describe(discretise(compliant_four_bar(cut=enough, tree=None, rfes=None))).constraints == 2
        mechanism = four_bar(None)
        joints = [Joint(j.name, j.parent, j.child, j.position, angle=j.angle, cut=j.cut,
                        compliance=enough if j.name == "B" else None) for j in mechanism.joints]  # fmt: skip
        structure = describe(discretise(Mechanism(mechanism.links, joints, driven_joint="A")))
        assert (structure.constraints, structure.rank, structure.mobility) == (5, 5, 1)
        assert structure.rigid_mobility == 1

    def test_too_little_compliance_leaves_loads_across_the_plane_open(self):
        mechanism = compliant_four_bar(cut=Compliance(axial=1.0), tree=None, rfes=None)
        with pytest.raises(InputError, match="4 closure equations have rank 2"):
            discretise(replace(mechanism, redundant_reactions="refuse"))
        assert "in the plane of the rigid loops are unique" in describe(discretise(mechanism)).reactions

    def test_the_start_is_that_of_the_ideal_mechanism(self):
        sprung, ideal = discretise(compliant_four_bar(rfes=None)), discretise(four_bar(2))
        at = [k for own in sprung.topology.own_positions for k in own]
        np.testing.assert_allclose(np.asarray(sprung.start_joints)[at], ideal.start_joints, atol=1e-12)
        np.testing.assert_array_equal(np.delete(np.asarray(sprung.start_joints), at), 0.0)


def test_a_spring_beside_a_compliance_acts_on_the_own_coordinate():
    from rfem_jax import JointSpring

    links = [Link("a", 0.1, Rectangle(0.01, 0.01), STEEL, rigid=True)]
    made = Joint("J", "base", "a", angle=0.2, compliance=Compliance(radial=1.0))
    model = discretise(Mechanism(links, [made], forces=[JointSpring("s", "J", stiffness=1.0)]))
    assert (model.forces["s"].coordinate, model.forces["s"].place) == (2, 2)
    np.testing.assert_array_equal(model.start_joints, [0.0, 0.0, 0.2])
