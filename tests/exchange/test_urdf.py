"""URDF: written from studies and read back; files of others; wrong files."""

from dataclasses import replace
from xml.etree import ElementTree as Xml

import numpy as np
import pytest

from rfem_jax import InputError, Joint, Link, Mechanism, RigidBody, describe, discretise, load_study
from rfem_jax.description import Study
from rfem_jax.exchange.files import read_layout
from rfem_jax.exchange.study_layout import layout_of
from rfem_jax.exchange.study_writer import study_text
from rfem_jax.exchange.urdf_writer import urdf_text

from .machines import bar, same_places, study


def arm():
    """Five bodies on joints of all kinds that URDF knows, at their zeros."""
    joints = (
        Joint("A", "base", "one", position=(0.1, 0.2, 0.3), orientation=(0.1, 0.2, 0.3)),
        Joint("S", "one", "two", kind="prismatic", orientation=(0.0, 0.0, 0.4)),
        Joint("F", "two", "three", kind="fixed", child_position=(0.01, 0.0, 0.0), child_orientation=(0.0, 0.5, 0.0)),
        Joint("B", "three", "four", orientation=(0.3, 0.0, 0.0), child_position=(0.0, 0.02, 0.0)),
        Joint("K", "base", "loose", kind="free", position=(1.0, 0.0, 0.0)),
    )
    skew = RigidBody(1.0, (0.01, 0.02, 0.03), ((0.08, 0.002, 0.001), (0.002, 0.06, 0.0), (0.001, 0.0, 0.07)))
    links = (*(bar(name, 0.2, 0.1) for name in ("one", "two", "three", "four")), Link("loose", 0.1, body=skew))
    return Study("arm", Mechanism(links, joints), duration=1.0)


def written(text, folder, name="machine.urdf"):
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def as_study(layout, folder):
    path = written(study_text(layout, "a test", "again.toml"), folder, "again.toml")
    return load_study(path)


def test_round_trip(tmp_path):
    layout = layout_of(arm())
    text, left = urdf_text(layout, "a test")
    assert left == ("Gravity, 0.0 0.0 -9.81 m/s^2: URDF has none.",)
    again, kind = read_layout(written(text, tmp_path))
    assert kind == "URDF" and again.remarks == ("The limits of S.",)
    found = as_study(again, tmp_path)
    assert describe(discretise(found.mechanism)).rigid_mobility == 3 + 6
    assert same_places(layout, layout_of(found))


def test_loops_and_starts_are_told():
    text, left = urdf_text(layout_of(study("four_bar")), "a test")
    said = " ".join(left)
    assert "close loops, of which URDF knows none: C" in said and "springs in joints: D" in said
    assert "Start values of joints" in said
    assert all(f"not in this file: {one}" in text for one in left)
    assert [one.get("name") for one in Xml.fromstring(text).iter("joint")] == ["A", "B", "D"]
    with pytest.raises(InputError, match="must be of a kind that URDF knows"):
        urdf_text(layout_of(study("stewart")), "a test")


FOREIGN = """<?xml version="1.0"?>
<robot name="gripper">
  <material name="grey"/>
  <link name="world"/>
  <link name="stand"><visual/><inertial><mass value="2"/><inertia ixx="0.1" iyy="0.1" izz="0.1"/></inertial></link>
  <joint name="foot" type="fixed"><parent link="world"/><child link="stand"/><origin xyz="0 0 1" rpy="0 0 1.5"/></joint>
  <link name="left finger"><inertial><origin xyz="0 0 0.1" rpy="0.1 0 0"/><mass value="0.2"/>
    <inertia ixx="1e-3" iyy="1e-3" izz="2e-4" ixy="1e-5"/></inertial></link>
  <joint name="left" type="revolute"><parent link="stand"/><child link="left finger"/><origin xyz="0.1 0 0.2"/>
    <axis xyz="0 0 2"/><limit lower="-1" upper="1" effort="1" velocity="1"/>
    <dynamics damping="0.1" friction="0.2"/></joint>
  <link name="right"><inertial><mass value="0.2"/><inertia ixx="1e-3" iyy="1e-3" izz="2e-4"/></inertial></link>
  <joint name="right" type="continuous"><parent link="stand"/><child link="right"/><origin xyz="-0.1 0 0.2"/>
    <axis xyz="0 0 1"/><mimic joint="left" multiplier="-1" offset="0.3"/></joint>
  <link name="tool"/>
  <joint name="tip" type="fixed"><parent link="right"/><child link="tool"/><origin xyz="0 0 0.3"/></joint>
  <link name="pad"><inertial><mass value="0.01"/><inertia ixx="0" iyy="0" izz="0"/></inertial></link>
  <joint name="slide" type="prismatic"><parent link="tool"/><child link="pad"/><axis xyz="0 1 0"/>
    <limit effort="1" velocity="1"/></joint>
  <transmission/>
</robot>"""


def test_a_file_of_others(tmp_path):
    layout, _ = read_layout(written(FOREIGN, tmp_path))
    said = " ".join(layout.remarks)
    for words in ("limits of left", "friction of left", "material (1), transmission (1)",
                  "tool has no mass and is fixed",
                  "`left finger` is called `left_finger`", "Link pad: a point mass"):  # fmt: skip
        assert words in said, words
    assert [one.name for one in layout.joints] == ["foot", "left", "right", "slide"]
    (ratio,) = layout.ratios
    left, right, slide = layout.joints[1:]
    # What the coupling says of angles counted from the file's zero, at which both stand.
    assert right.start[0] - ratio.ratio * left.start[0] == pytest.approx(ratio.offset - 0.3)
    turned = np.array([[np.cos(1.5), -np.sin(1.5), 0.0], [np.sin(1.5), np.cos(1.5), 0.0], [0.0, 0.0, 1.0]])
    np.testing.assert_allclose(layout.sides(slide)[0].position, turned @ [-0.1, 0.0, 0.5] + [0.0, 0.0, 1.0], atol=1e-12)
    np.testing.assert_allclose(layout.sides(slide)[0].rotation[:, 0], turned[:, 1], atol=1e-12)
    assert left.springs[0].damping == 0.1
    found = as_study(replace(layout, ratios=()), tmp_path)
    assert describe(discretise(found.mechanism)).rigid_mobility == 3
    (coupling,) = as_study(layout, tmp_path).mechanism.couplings
    assert coupling.stiffness is None and float(coupling.ratio) == -1.0


BOMB = '<!DOCTYPE robot [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;&a;">]><robot name="&b;"/>'


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (BOMB, "without a document type"),
        ('<!DOCTYPE robot SYSTEM "file:///etc/passwd"><robot/>', "without a document type"),
        ("<robot>" + "<a>" * 300 + "</a>" * 300 + "</robot>", "nested at most"),
        ("<robot/>", "must have one link that is no child"),
        ("<robot><link name='a'/></robot>", "at least one body that moves"),
        ("<robots/>", "The first element of the file must be one of"),
        ("<robot", "must be XML"),
        (FOREIGN.replace('child link="tool"', 'child link="tools"'), "must be a link of the file"),
        (FOREIGN.replace('child link="tool"', 'child link="stand"'), "is of two"),
        (FOREIGN.replace('type="continuous"', 'type="ball"'), "one of URDF's"),
        (FOREIGN.replace('xyz="0 0 2"', 'xyz="0 0 0"'), "must be a direction"),
        (FOREIGN.replace('xyz="0 0 2"', 'xyz="0 0"'), "must be 3 finite numbers"),
        (FOREIGN.replace('mass value="2"', 'mass value="nan"'), "must be 1 finite number"),
        (FOREIGN.replace('izz="0.1"', 'izz="0.5"'), "must be that of a real body"),
        (FOREIGN.replace('mimic joint="left"', 'mimic joint="foot"'), "must mimic another hinge"),
        (FOREIGN.replace('link name="tool"', 'link name="pad"'), "a name of its own"),
    ],
)
def test_what_is_wrong_is_told_in_a_sentence(text, says, tmp_path):
    with pytest.raises(InputError, match=says) as found:
        read_layout(written(text, tmp_path))
    assert len(found.value.problems) == 1
