"""SDF: machines with closed loops, written here; poses relative to each other; wrong files."""

import numpy as np
import pytest

from rfem_jax import InputError, describe, discretise, load_study
from rfem_jax.exchange.files import read_layout
from rfem_jax.exchange.layout import BASE
from rfem_jax.exchange.rigid_frames import angles_of
from rfem_jax.exchange.study_layout import layout_of
from rfem_jax.exchange.study_writer import study_text

from .machines import MOBILITY, same_places, study

TYPES = {"revolute": "revolute", "prismatic": "prismatic", "spherical": "ball", "universal": "universal"}


def sdf_of(layout):
    """A layout as SDF: links in the axes of the model, joints in those of their children."""

    def pose(frame):
        return " ".join(map(repr, map(float, (*frame.position, *angles_of(frame.rotation)))))

    def moments(body):
        return "".join(f"<i{'xyz'[i]}{'xyz'[j]}>{float(body.inertia[i, j])!r}</i{'xyz'[i]}{'xyz'[j]}>"
                       for i in range(3) for j in range(i, 3))  # fmt: skip

    parts = [
        f"<link name='{body.name}'><pose>{pose(body.pose)}</pose><inertial><pose>"
        f"{' '.join(map(repr, map(float, body.centre)))} 0 0 0</pose><mass>{body.mass!r}</mass><inertia>{moments(body)}"
        "</inertia></inertial></link>"
        for body in layout.bodies
    ]
    for joint in layout.joints:
        if joint.kind == "free":
            continue
        left, right = layout.sides(joint)
        axes = {"revolute": [left.rotation[:, 1]], "prismatic": [left.rotation[:, 0]],
                "universal": [left.rotation[:, 1], right.rotation[:, 2]]}.get(joint.kind, [])  # fmt: skip
        text = "".join(
            f"<axis{n}><xyz expressed_in='__model__'>{' '.join(map(repr, map(float, axis)))}</xyz></axis{n}>"
            for n, axis in zip(("", 2), axes)
        )
        parent = "world" if joint.parent == BASE else joint.parent
        parts.append(
            f"<joint name='{joint.name}' type='{TYPES[joint.kind]}'><pose>{pose(joint.bore)}</pose>"
            f"<parent>{parent}</parent><child>{joint.child}</child>{text}</joint>"
        )
    model = f"<model name='m'>{''.join(parts)}</model>"
    return f"<sdf version='1.9'><world name='w'><gravity>0 0 -9.81</gravity>{model}</world></sdf>"


def written(text, folder):
    path = folder / "machine.sdf"
    path.write_text(text, encoding="utf-8")
    return path


@pytest.mark.parametrize("name", MOBILITY)
def test_machines_with_loops(name, tmp_path):
    """Which joint closes a loop follows from the order of the file; the bodies of the platform need no free joint."""
    layout = layout_of(study(name))
    again, kind = read_layout(written(sdf_of(layout), tmp_path))
    assert kind == "SDF" and again.remarks == ()
    toml = tmp_path / "again.toml"
    toml.write_text(study_text(again, "a test", toml.name), encoding="utf-8")
    found = load_study(toml)
    described = describe(discretise(found.mechanism))
    assert described.rigid_mobility == MOBILITY[name] and described.gap < 1e-9
    second = layout_of(found)
    if name == "stewart":  # whose platform hangs on its first leg now
        assert len(found.mechanism.cut_joints) == 5
    else:
        assert same_places(layout, second)
    for body in layout.bodies:
        np.testing.assert_allclose(
            second.body(body.name).pose.then(type(body.pose)(np.eye(3), second.body(body.name).centre)).position,
            body.pose.then(type(body.pose)(np.eye(3), body.centre)).position, atol=1e-9,
        )  # fmt: skip


FOREIGN = """<sdf version="1.8"><model name="door"><pose>1 0 0 0 0 0</pose>
<frame name="hinge line" attached_to="leaf"><pose relative_to="leaf">-0.4 0 0 0 0 0</pose></frame>
<link name="leaf"><pose>0.4 0 1 0 0 0</pose><inertial><mass>20</mass><inertia><ixx>3</ixx><iyy>1</iyy><izz>3.5</izz>
</inertia></inertial><collision name="c"/><sensor name="s"/></link>
<joint name="hinge" type="revolute"><pose relative_to="hinge line"/><parent>world</parent><child>leaf</child>
<axis><xyz>0 0 1</xyz><limit><lower>0</lower></limit><dynamics><damping>2</damping>
<spring_stiffness>5</spring_stiffness>
<spring_reference>0.3</spring_reference><friction>0.1</friction></dynamics></axis></joint>
<link name="bolt"><pose relative_to="hinge line" degrees="true">0.7 0 0 0 0 90</pose></link>
<joint name="slide" type="prismatic"><parent>leaf</parent><child>bolt</child><axis><xyz>1 0 0</xyz></axis></joint>
</model></sdf>"""


def test_a_file_of_others(tmp_path):
    layout, _ = read_layout(written(FOREIGN, tmp_path))
    said = " ".join(layout.remarks)
    for words in ("limits of hinge", "friction of hinge", "bolt without inertia", "sensor (1)"):
        assert words in said, words
    hinge, slide = layout.joints
    np.testing.assert_allclose(layout.sides(hinge)[0].position, [1.0, 0.0, 1.0], atol=1e-12)
    np.testing.assert_allclose(layout.sides(hinge)[0].rotation[:, 1], [0.0, 0.0, 1.0], atol=1e-12)
    np.testing.assert_allclose(layout.sides(slide)[0].position, [1.7, 0.0, 1.0], atol=1e-12)
    np.testing.assert_allclose(layout.sides(slide)[0].rotation[:, 0], [0.0, 1.0, 0.0], atol=1e-12)
    (spring,) = hinge.springs
    assert (spring.stiffness, spring.damping) == (5.0, 2.0)
    assert spring.rest - hinge.start[0] == pytest.approx(0.3)


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("<parent>world", "<parent>wall", "must be a link of the file or world"),
        ("<child>leaf", "<child>world", "must join two links"),
        ('type="prismatic"', 'type="screw"', "must be one that a study has"),
        ('<pose relative_to="leaf">', '<pose relative_to="hinge">', "relative to another than itself"),
        ('<pose relative_to="leaf">', '<pose relative_to="lea">', "what its poses are relative to"),
        ("<xyz>1 0 0", "<xyz>0 0 0", "must be a direction"),
        ("<xyz>1 0 0", "<xyz>1 0", "must be 3 finite numbers"),
        ("<mass>20", "<mass>-20", "must be at least 0"),
        ("0.4 0 1 0 0 0", "0.4 0 1 0 0", "must be 6 finite numbers"),
        ('<link name="bolt">', '<link name="leaf">', "a name of its own"),
        ('<link name="bolt">', '<include/><model name="m"/><link name="bolt">', "one model that is complete"),
        ("</model>", "<static>true</static></model>", "is static"),
    ],
)
def test_what_is_wrong_is_told_in_a_sentence(old, new, says, tmp_path):
    assert old in FOREIGN
    with pytest.raises(InputError, match=says) as found:
        read_layout(written(FOREIGN.replace(old, new, 1), tmp_path))
    assert len(found.value.problems) == 1
