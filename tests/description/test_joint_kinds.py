"""The table of joint kinds: what follows from a list of free motions; starts and refusals of joints."""

import math

import pytest

from rfem_jax import Joint, Mechanism
from rfem_jax.description.basics.joint_kinds import KINDS, JointKind, joint_errors
from rfem_jax.description.parameters.deviations import require_deviation

from .test_mechanism import beam

ALL = {"delta_x", "delta_y", "delta_z", "d_x", "d_y", "d_z"}
TABLE = {  # kind: coordinates, axis of the loads, errors on the parent, errors on the child
    "revolute": (1, 1, ALL - {"delta_y"}, ALL - {"delta_y"}),
    "prismatic": (1, 0, ALL - {"d_x"}, ALL - {"d_x"}),
    "cylindrical": (2, 1, {"d_x", "d_z", "delta_x", "delta_z"}, {"d_x", "d_z", "delta_x", "delta_z"}),
    "universal": (2, None, ALL - {"delta_y"}, ALL - {"delta_z"}),
    "spherical": (3, None, {"d_x", "d_y", "d_z"}, {"d_x", "d_y", "d_z"}),
    "planar": (3, 1, {"d_y", "delta_x", "delta_z"}, {"d_y", "delta_x", "delta_z"}),
    "fixed": (0, None, ALL, ALL),
    "free": (6, None, set(), set()),
}


@pytest.mark.parametrize("name", KINDS)
def test_errors_axis_and_number_of_coordinates_follow_from_the_motions(name):
    kind = KINDS[name]
    found = len(kind.freedoms), kind.axis, set(kind.errors(child=False)), set(kind.errors(child=True))
    assert found == TABLE[name]
    rows = (3 if kind.coincident else len(kind.across)) + len(kind.perpendicular)
    assert rows == kind.constraints == 6 - len(kind.freedoms)


def test_a_ninth_kind_is_a_row():
    """A screw's list of motions without its pitch: about and along z."""
    kind = JointKind("ninth", ("R_z", "T_z"))
    assert (kind.axis, kind.across, kind.perpendicular) == (2, (0, 1), ((2, 0), (2, 1)))
    assert kind.errors(child=True) == ("delta_x", "delta_y", "d_x", "d_y")


def test_only_revolute_joints_have_crooked_pins():
    pins = {name: [error for error in joint_errors(kind) if "pin" in error] for name, kind in KINDS.items()}
    assert pins.pop("revolute") == ["pin_tilt_x", "pin_tilt_z"]
    assert not any(pins.values())


def test_names_and_units_of_a_mechanism_follow_the_kinds():
    joints = [
        Joint("A", "base", "crank"),
        Joint("G", "base", "rocker", kind="prismatic"),
        Joint("U", "crank", "rocker", cut=True, kind="universal"),
    ]
    mechanism = Mechanism([beam("crank"), beam("rocker")], joints)
    assert mechanism.error_unit("G.delta_y") == "rad" and mechanism.error_unit("G.child.d_y") == "m"
    assert "U.child.delta_y" in mechanism.error_names and "U.child.delta_z" not in mechanism.error_names
    assert not {"G.d_x", "A.delta_y", "G.pin_tilt_x"} & set(mechanism.error_names)


@pytest.mark.parametrize(
    ("name", "pieces"),
    [
        ("G.d_x", ("the free motions of a prismatic joint make it good", "leave it out")),
        ("U.child.delta_z", ("the free motions of a universal joint make it good",)),
        ("G.pin_tilt_x", ("only revolute joints have crooked pins", "prismatic")),
        ("A.delta_w", ("did you mean `A.delta_",)),
        ("H.delta_x", ("did you mean `",)),
    ],
)
def test_errors_that_a_kind_does_not_have_are_explained(refused, name, pieces):
    joints = [
        Joint("A", "base", "crank"),
        Joint("G", "base", "rocker", kind="prismatic"),
        Joint("U", "crank", "rocker", cut=True, kind="universal"),
    ]
    mechanism = Mechanism([beam("crank"), beam("rocker")], joints)
    for require in (mechanism.require_error, lambda name: require_deviation(mechanism, name)):
        with refused(f"`{name}`", *pieces):
            require(name)


def test_starts_of_the_kinds():
    def start(kind, **values):
        return Joint("J", "base", "crank", kind=kind, **values).start_values

    assert start("revolute", angle="90 deg") == (math.pi / 2,)
    assert start("prismatic", displacement="3 mm") == (0.003,)
    assert start("cylindrical", angle=1, displacement=2) == (1.0, 2.0)
    assert start("universal", start=["90 deg", 1]) == (math.pi / 2, 1.0)
    assert start("planar", start=["1 cm", 0.2, "180 deg"]) == (0.01, 0.2, math.pi)
    assert start("fixed") == ()
    assert start("free", start=[1, 2, 3, 0.1, 0.2, 0.3]) == (1.0, 2.0, 3.0, 0.1, 0.2, 0.3)
    assert start("planar") == (0.0, 0.0, 0.0)
    assert start("cylindrical") == (0.0, 0.0)


@pytest.mark.parametrize(
    ("values", "pieces"),
    [
        ({"kind": "prismatik"}, ("`kind`", "did you mean `prismatic`")),
        ({"kind": "Slider"}, ("`kind`", "'Slider'; write 'prismatic'")),
        ({"kind": "ball"}, ("`kind`", "write 'spherical'")),
        ({"kind": "prismatic", "angle": 1.0}, ("`angle`", "prismatic", "`displacement`")),
        ({"kind": "revolute", "displacement": 1.0}, ("`displacement`", "revolute", "`angle`")),
        ({"kind": "cylindrical", "start": [0, 0]}, ("`start`", "`angle` and `displacement`")),
        ({"kind": "universal", "angle": 0.1}, ("`angle`", "universal", "`start`")),
        ({"kind": "universal", "start": [1]}, ("`start`", "2 numbers", "[1]")),
        ({"kind": "planar", "start": [0, 0, "1 mm"]}, ("`start`", "entry 3", "length")),
        ({"kind": "fixed", "angle": 0.1}, ("`angle`", "fixed", "no coordinate")),
        ({"kind": "prismatic", "displacement": 0.1, "cut": True}, ("`displacement`", "cut", "closing the loop")),
        ({"kind": "free", "cut": True}, ("`kind`", "leave the joint out")),
    ],
)
def test_wrong_kinds_and_starts_are_refused(refused, values, pieces):
    with refused(*pieces):
        Joint("J", "base", "crank", **values)


def test_free_motions_about_or_along_one_axis_are_driven(refused):
    def driven(kind, names):
        joint = Joint("J", "base", "crank", kind=kind)
        return Mechanism([beam("crank")], [joint], driven_joint=names).driven_motions

    assert driven("prismatic", "J") == (("J", "T_x"),)
    assert driven("planar", ["J.R_y", "J.T_z"]) == (("J", "R_y"), ("J", "T_z"))
    assert driven("free", "J.T_y") == (("J", "T_y"),)
    for kind, names, pieces in (
        ("cylindrical", "J", ("`driven_joint`", "cylindrical", 'write "J.R_y" or "J.T_y"')),
        ("cylindrical", "J.T_x", ("`motion`", "T_x")),
        ("planar", ["J.R_y", "J.R_y"], ("`driven_joint`", "R_y of joint `J` twice")),
        ("spherical", "J", ("turns about any axis", "a universal joint")),
        ("free", "J.R", ("turns about any axis", "another motion")),
        ("fixed", "J", ("must have a free motion", "fixed")),
        ("revolute", 3, ("`driven_joint`", "a list of names")),
    ):
        with refused(*pieces):
            driven(kind, names)
