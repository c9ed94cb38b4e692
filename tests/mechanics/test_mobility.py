"""Rank, mobility, idle freedoms and wrong branches of loops with joints of all kinds."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rfem_jax import InputError, Joint, JointSpring, Mechanism, describe, discretise
from rfem_jax.report.contents.overview import count_lines
from tests.mechanisms import link, loop_cut_by


def slider_crank(wrist="revolute", **settings):
    """A planar slider-crank of rigid links, cut at the wrist pin."""
    joints = [
        Joint("A", "base", "crank", angle=0.3),
        Joint("B", "crank", "rod", angle=-0.4),
        Joint("G", "base", "piston", kind="prismatic", displacement=0.26),
        Joint("C", "rod", "piston", cut=True, kind=wrist, child_position=(0, 0, 0)),
    ]
    links = [link("crank", 0.06), link("rod", 0.2, settings.pop("rfes", None)), link("piston", 0.05)]
    return Mechanism(links, joints, driven_joint="A", **settings)


def triangle():
    """Two rods on the base that meet: nothing can move."""
    joints = [
        Joint("A", "base", "a", angle=-np.pi / 3.0),
        Joint("D", "base", "b", position=(0.3, 0, 0), angle=-2.0 * np.pi / 3.0),
        Joint("C", "a", "b", cut=True),
    ]
    return Mechanism([link("a", 0.3), link("b", 0.3)], joints)


def test_a_planar_slider_crank_has_three_redundant_rows():
    structure = describe(discretise(slider_crank(redundant_reactions="minimum_norm")))
    assert (structure.constraints, structure.rank, structure.mobility) == (5, 2, 1)
    with pytest.raises(InputError, match=r"slides are statically indeterminate. Make one link of each loop flexible"):
        discretise(slider_crank(redundant_reactions="refuse"))
    flexible = describe(discretise(slider_crank(rfes=2)))
    assert (flexible.rank, flexible.redundant, flexible.rigid_mobility) == (5, False, 1)


def test_the_slide_closes_where_geometry_says():
    model = discretise(slider_crank(rfes=2))
    slide = model.start_joints[model.topology.coordinates[model.link_names.index("piston")][0]]
    expected = 0.06 * np.cos(0.3) + np.sqrt(0.2**2 - (0.06 * np.sin(0.3)) ** 2)
    np.testing.assert_allclose(slide, expected, rtol=0, atol=1e-14)


# Free motions of the cut joint in the plane of the loop: its two hinges alone are one too few to follow.
@pytest.mark.parametrize(
    ("kind", "rank", "mobility"),
    [
        ("revolute", 2, 0), ("prismatic", 2, 0), ("cylindrical", 2, 0), ("universal", 2, 0), ("spherical", 2, 0),
        ("planar", 0, 2), ("fixed", 2, 0),
    ],
)  # fmt: skip
def test_rank_and_mobility_with_rigid_links(kind, rank, mobility):
    structure = describe(discretise(loop_cut_by(kind)))
    assert (structure.rigid_rank, structure.rigid_mobility) == (rank, mobility)
    assert structure.constraints == 6 - {"revolute": 1, "prismatic": 1, "cylindrical": 2, "universal": 2,
                                         "spherical": 3, "planar": 3, "fixed": 0}[kind]  # fmt: skip
    assert structure.rank == structure.constraints


def test_joints_that_lock_are_named():
    mechanism = loop_cut_by("universal")
    text = " ".join(count_lines(mechanism, describe(discretise(mechanism))))
    assert "A (revolute), D (revolute), C (universal) lock" in text
    with pytest.raises(InputError, match=r"slides are statically indeterminate.*joints lock \(mobility 0\)\."):
        discretise(dataclasses.replace(triangle(), redundant_reactions="refuse"))
    text = " ".join(" ".join(count_lines(triangle(), describe(discretise(triangle())))).split())
    assert "lock" in text and "Loads in the plane of the rigid loops are unique" in text
    with pytest.raises(InputError, match=r'"minimum_norm" in the table \[mechanism\].*of least norm.$'):
        discretise(slider_crank(redundant_reactions="refuse"))
    mechanism = loop_cut_by("planar")
    assert "lock" not in " ".join(count_lines(mechanism, describe(discretise(mechanism))))


def test_a_link_that_can_move_alone_is_named():
    """The slider-crank with a second pair of coaxial bearings on the crank's end: the sleeve between them may turn."""
    base = slider_crank(wrist="spherical")
    joints = [
        *base.joints,
        Joint("S", "crank", "sleeve", position=(0.03, 0, 0)),
        Joint("T", "crank", "sleeve", cut=True, kind="cylindrical", position=(0.03, 0.02, 0), child_position=(0, 0, 0)),
    ]
    mechanism = Mechanism([*base.links, link("sleeve", 0.02)], joints, driven_joint="A",
                          redundant_reactions="minimum_norm")  # fmt: skip
    structure = describe(discretise(mechanism))
    assert structure.idle == ("sleeve",) and structure.mobility == 2
    text = " ".join(count_lines(mechanism, structure))
    assert "link sleeve can move alone between S (revolute) and T (cylindrical)" in text
    assert describe(discretise(slider_crank(rfes=2))).idle == ()


def test_a_freedom_that_is_the_only_motion_is_idle_too():
    """A rod between two spherical joints, on the base and on a link that two hinges hold."""
    links = [link("bracket", 0.1), link("rod", 0.2)]
    bracket, rod = Rotation.from_euler("xyz", (0.3, -0.5, 0.8)), Rotation.from_euler("xyz", (0.0, 0.3, -0.7))
    end = bracket.apply([0.1, 0, 0] + rod.apply([0.2, 0, 0]))
    joints = [
        Joint("F", "base", "bracket", orientation=(0.3, -0.5, 0.8)),
        Joint("G", "base", "bracket", cut=True, orientation=(0.3, -0.5, 0.8), position=bracket.apply([0.1, 0, 0])),
        Joint("S", "bracket", "rod", kind="spherical", start=(0.0, 0.3, -0.7)),
        Joint("T", "base", "rod", cut=True, kind="spherical", position=end),
    ]
    structure = describe(discretise(Mechanism(links, joints, redundant_reactions="minimum_norm")))
    assert (structure.mobility, structure.idle) == (1, ("rod",))


@pytest.mark.parametrize("kind", ["revolute", "prismatic", "cylindrical", "universal", "planar", "fixed"])
@pytest.mark.parametrize("turned", [(0.0, -np.pi / 2, np.pi), (np.pi, -np.pi / 2, 0.0)])
def test_a_child_that_is_turned_round_is_refused(kind, turned):
    """Turned by 180 deg about x or z, the frame of the child solves the equations of axes, too."""
    loop = loop_cut_by(kind)
    joints = [*loop.joints[:2], Joint("C", "left", "right", cut=True, kind=kind, child_orientation=turned)]
    with pytest.raises(InputError, match=r"(hinge axes|frames).* of joint 'C' alike, but they point in opposite"):
        discretise(Mechanism(loop.links, joints))


def test_a_joint_with_several_coordinates_cannot_be_held():
    from rfem_jax import assemble, assembly_errors

    mechanism = Mechanism([link("a", 0.1)], [Joint("C", "base", "a", kind="cylindrical")])
    model = discretise(mechanism)
    with pytest.raises(InputError, match=r"joints with one coordinate, but 'C' is cylindrical and has 2"):
        assemble(model, assembly_errors(model), hold={"C": 0.1})


def test_a_freedom_that_a_spring_holds_is_not_idle():
    """A rod that may turn about its own axis: between a hinge along it and a ball."""
    links = [link("crank", 0.1), link("rod", 0.2), link("rocker", 0.25), link("coupler", 0.2, 2)]
    joints = [
        Joint("A", "base", "crank", angle=-1.2),
        Joint("B", "crank", "rod", orientation=(0, 0, -np.pi / 2), child_orientation=(0, 0, -np.pi / 2)),
        Joint("D", "base", "rocker", position=(0.4, 0, 0), angle=-1.3),
        Joint("E", "rocker", "coupler", angle=-1.7),
        Joint("C", "rod", "coupler", kind="spherical", cut=True),
    ]

    def idle(*forces):
        structure = describe(discretise(Mechanism(links, joints, driven_joint="A", forces=list(forces))))
        return structure.idle

    assert idle() == ("rod",)
    assert idle(JointSpring("drag", "B", damping=1.0)) == ("rod",)
    assert idle(JointSpring("spring", "B", stiffness=1.0)) == ()
