"""Assemblies of FreeCAD: files with the structure of its own, written here; what is left out; wrong files.

The machines are those of `machines`, as FreeCAD would have them: bodies in parts, links to parts, the assembly itself
turned and moved, frames of joints anywhere about their axes.
"""

import re
import sys
import zipfile
from pathlib import Path
from types import SimpleNamespace
from xml.sax.saxutils import quoteattr

import numpy as np
import pytest

from rfem_jax import InputError, describe, discretise, load_study
from rfem_jax.exchange.files import read_layout
from rfem_jax.exchange.layout import BASE
from rfem_jax.exchange.rigid_frames import Frame, at_origin, quaternion_of, rotation_about, rotation_from
from rfem_jax.exchange.study_layout import layout_of
from rfem_jax.exchange.study_writer import study_text
from rfem_jax.report.command_line import main

from .machines import MOBILITY, inertia_of, study

MACRO = Path(__file__).parents[2] / "docs" / "guides" / "freecad_frames.py"
WORDS = {
    "revolute": "Revolute",
    "prismatic": "Slider",
    "spherical": "Ball",
    "cylindrical": "Cylindrical",
    "fixed": "Fixed",
}
TYPES = ("Fixed", "Revolute", "Cylindrical", "Slider", "Ball", "Distance")
PLACE = Frame(rotation_from(np.array([0.3, -0.2, 0.5])), np.array([0.1, 0.2, -0.05]))  # of the assembly
INNER = Frame(rotation_about(2, 0.7), np.array([0.01, 0.0, 0.02]))  # of a body in its part


def placement(key, frame):
    w, x, y, z = quaternion_of(frame.rotation)
    (px, py, pz) = 1e3 * frame.position
    values = {"Px": px, "Py": py, "Pz": pz, "Q0": x, "Q1": y, "Q2": z, "Q3": w}
    text = " ".join(f'{name}="{float(value)!r}"' for name, value in values.items())
    return f'<Property name="{key}" type="App::PropertyPlacement"><PropertyPlacement {text}/></Property>'


def text_property(key, kind, tag, value):
    return f'<Property name="{key}" type="App::Property{kind}"><{tag} value={quoteattr(value)}/></Property>'


def group(names):
    links = "".join(f'<Link value="{name}"/>' for name in names)
    links = f'<LinkList count="{len(names)}">{links}</LinkList>'
    return f'<Property name="Group" type="App::PropertyLinkList">{links}</Property>'


def reference(number, path):
    subs = "".join(f'<Sub value="{path}.{element}"/>' for element in ("Edge1", "Vertex2"))
    return (
        f'<Property name="Reference{number}" type="App::PropertyXLinkSubHidden">'
        f'<XLink file="" stamp="" name="Assembly" count="2">{subs}</XLink></Property>'
    )


def joint_properties(label, kind, paths, frames):
    enums = "".join(f'<Enum value="{one}"/>' for one in TYPES)
    number = TYPES.index(WORDS.get(kind, "Distance"))
    return (
        text_property("Label", "String", "String", label)
        + f'<Property name="JointType" type="App::PropertyEnumeration"><Integer value="{number}" CustomEnum="true"/>'
        f'<CustomEnumList count="{len(TYPES)}">{enums}</CustomEnumList></Property>'
        + reference(1, paths[0]) + reference(2, paths[1])
        + placement("Placement1", frames[0]) + placement("Placement2", frames[1])
        + text_property("Activated", "Bool", "Bool", "true")
    )  # fmt: skip


def document_of(layout):
    """Document.xml of a layout: every second body in a part, the others links to shapes that lie in another file."""
    objects = [("Assembly", "Assembly::AssemblyObject"), ("Joints", "Assembly::JointGroup"), ("Frame", "Part::Box")]
    data, paths, inner = {}, {BASE: "Frame"}, {BASE: at_origin()}
    poses = {BASE: Frame(np.eye(3), np.array([0.0, 0.3, 0.0]))}
    data["Frame"] = placement("Placement", poses[BASE])
    for n, body in enumerate(layout.bodies):
        name, poses[body.name] = f"Thing{n}", body.pose
        data[name] = text_property("Label", "String", "String", body.name)
        if n % 2 == 0:
            objects += [(name, "App::Part"), (f"Body{n}", "PartDesign::Body"), (f"Pad{n}", "PartDesign::Pad")]
            data[name] += placement("Placement", body.pose) + group([f"Body{n}"])
            data[f"Body{n}"], data[f"Pad{n}"] = placement("Placement", INNER), placement("Placement", INNER)
            paths[body.name], inner[body.name] = f"{name}.Body{n}.Pad{n}", INNER
        else:
            objects.append((name, "App::Link"))
            data[name] += placement("LinkPlacement", body.pose)
            data[name] += (
                '<Property name="LinkedObject" type="App::PropertyXLink"><XLink file="x.FCStd" name="B"/></Property>'
            )
            paths[body.name], inner[body.name] = name, at_origin()
    joints = []
    for n, joint in enumerate(one for one in layout.joints if one.kind != "free"):
        turn = rotation_about(1, 0.5 * np.pi) if joint.kind == "prismatic" else rotation_about(0, -0.5 * np.pi)
        frames = []
        for end, side in zip((joint.parent, joint.child), layout.sides(joint), strict=True):
            about = rotation_about(2, 0.4 * (n + 1))  # FreeCAD's own x is that of an edge
            if n % 2 and end == joint.child and joint.kind == "revolute":
                about = rotation_about(0, np.pi) @ about  # axes against each other, which FreeCAD allows
            if joint.kind == "prismatic":
                about = np.eye(3)
            place = Frame(side.rotation @ turn @ about, side.position)
            frames.append(place.seen_from(poses[end].then(inner[end])))
        objects.append((f"Joint{n}", "App::FeaturePython"))
        data[f"Joint{n}"] = joint_properties(joint.name, joint.kind, (paths[joint.parent], paths[joint.child]), frames)
        joints.append(f"Joint{n}")
    objects.append(("Ground", "App::FeaturePython"))
    data["Ground"] = text_property("ObjectToGround", "Link", "Link", "Frame")
    data["Joints"] = group([*joints, "Ground"])
    things = [f"Thing{n}" for n in range(len(layout.bodies))]
    data["Assembly"] = placement("Placement", PLACE) + group(["Joints", "Frame", *things])
    listed = "".join(f'<Object type="{kind}" name="{name}" id="{n}"/>' for n, (name, kind) in enumerate(objects))
    filled = "".join(
        f'<Object name="{name}"><Properties Count="1">{text}</Properties></Object>' for name, text in data.items()
    )
    return (
        '<?xml version="1.0" encoding="utf-8"?><Document SchemaVersion="4" ProgramVersion="1.0" FileVersion="1">'
        f"<Objects Count='{len(objects)}'>{listed}</Objects>"
        f"<ObjectData Count='{len(data)}'>{filled}</ObjectData></Document>"
    )


def written(text, folder):
    return zipped(folder / "machine.FCStd", text)


def zipped(path, text):
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("Document.xml", text)
        archive.writestr("PartShape.brp", "CASCADE Topology V1")
    return path


@pytest.mark.parametrize("name", ["four_bar", "slider_crank", "double_wishbone"])
def test_machines(name, tmp_path):
    """Places of all joints, their axes, the mobility; the assembly stands somewhere in space."""
    layout = layout_of(study(name))
    again, kind = read_layout(written(document_of(layout), tmp_path))
    assert kind == "FreeCAD" and {one.name for one in again.bodies} == {one.name for one in layout.bodies}
    toml = tmp_path / "again.toml"
    toml.write_text(study_text(again, "a test", toml.name), encoding="utf-8")
    found = describe(discretise(load_study(toml).mechanism))
    assert found.rigid_mobility == MOBILITY[name] and found.gap < 1e-9
    others = {one.name: one for one in again.joints}
    for joint in layout.joints:
        other = others[joint.name]
        assert other.kind == joint.kind
        mine = sorted((PLACE.then(side) for side in layout.sides(joint)), key=lambda one: tuple(one.position.round(9)))
        theirs = sorted(again.sides(other), key=lambda one: tuple(one.position.round(9)))
        for one, two in zip(mine, theirs, strict=True):
            axis = 0 if joint.kind == "prismatic" else 1
            np.testing.assert_allclose(two.position, one.position, atol=1e-9)
            if joint.kind != "spherical":
                np.testing.assert_allclose(np.abs(two.rotation[:, axis] @ one.rotation[:, axis]), 1.0, atol=1e-9)


def test_what_is_not_in_the_file_is_told(tmp_path, capsys):
    """Masses, of all; kinds of joints that a study has not; joints that are off; limits; parts without joints."""
    text = document_of(layout_of(study("four_bar")))
    off = text_property("Activated", "Bool", "Bool", "false")
    limit = text_property("EnableAngleMax", "Bool", "Bool", "true")
    first = text.index('<Object name="Joint0">')
    text = text[:first] + text[first:].replace('<Property name="Activated"', limit + '<Property name="Activated"', 1)
    last = text.index('<Object name="Joint3">')
    text = text[:last] + text[last:].replace(text_property("Activated", "Bool", "Bool", "true"), off, 1)
    path = written(text, tmp_path)
    assert main(["import", str(path), "-o", str(tmp_path / "x.toml")]) == 0
    said = capsys.readouterr().out
    for words in ("The joint C, which is not active", "limits of angle of A", "Masses: the file has shapes"):
        assert words in said, words
    assert main(["check", str(tmp_path / "x.toml")]) == 0
    assert "Links without mass (crank, rocker, coupler)" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ('type="Assembly::AssemblyObject"', 'type="App::Part"', "must have one assembly"),
        ('name="ObjectToGround"', 'name="Object"', "a joint with a grounded part"),
        ('<Integer value="1"', '<Integer value="77"', "must have one of 6 types"),
        ('name="Reference1"', 'name="Part1"', "as FreeCAD 1.0 and later write it"),
        ('value="Thing1.Edge1"', 'value="Thing1.Body.Face1"', "must join objects of the file itself"),
        ('Pz="', 'Pz="x', "must be 1 finite number"),
        (
            '="Placement1" type="App::PropertyPlacement"><PropertyPlacement Px="',
            "\\g<0>9",
            "solve the assembly in FreeCAD",
        ),
        ("<?xml", "<!DOCTYPE a><?xml", "without a document type"),
    ],
)
def test_what_is_wrong_is_told_in_a_sentence(old, new, says, tmp_path):
    text = document_of(layout_of(study("four_bar")))
    changed = re.sub(re.escape(old), new, text, count=1)
    assert changed != text
    with pytest.raises(InputError, match=says) as found:
        read_layout(written(changed, tmp_path))
    assert len(found.value.problems) == 1


def test_zips_that_are_none_of_freecad(tmp_path):
    path = tmp_path / "x.FCStd"
    for content in (b"PK\x03\x04", b"PK\x03\x04" + bytes(100)):
        path.write_bytes(content)
        with pytest.raises(InputError, match="must be FreeCAD's"):
            read_layout(path)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("other.xml", "<a/>")
    with pytest.raises(InputError, match="must be FreeCAD's"):
        read_layout(path)


class FakePlacement:
    """What the macro asks of FreeCAD's placements; lengths in mm."""

    def __init__(self, frame):
        self.frame, self.Base, self.Rotation = frame, 1e3 * frame.position, self

    def multVec(self, vector):
        return self.frame.rotation @ vector

    def multiply(self, other):
        return FakePlacement(self.frame.then(other.frame))


class FakeShape:
    """A solid of the density 1000 kg/m^3 with a body's mass, centre and inertia, where its placement is."""

    def __init__(self, body):
        self.body, self.Placement = body, FakePlacement(body.pose)

    def copy(self):
        return FakeShape(self.body)

    @property
    def Solids(self):
        moments, axes = np.linalg.eigh(self.body.inertia)
        frame = self.Placement.frame
        turned = zip(("First", "Second", "Third"), (frame.rotation @ axes).T, strict=True)
        properties = {"Moments": 1e12 * moments} | {f"{name}AxisOfInertia": axis for name, axis in turned}
        centre = 1e3 * (frame.position + frame.rotation @ self.body.centre)
        return [SimpleNamespace(Volume=1e6 * self.body.mass, CenterOfMass=centre, PrincipalProperties=properties)]


def test_the_macro_writes_a_table(tmp_path, monkeypatch):
    """Run with stand-ins for FreeCAD's modules that say what FreeCAD says of the double wishbone."""
    layout = layout_of(study("double_wishbone"))
    place = FakePlacement(PLACE)
    objects = {
        body.name: SimpleNamespace(Name=body.name, Label=body.name, TypeId="App::Part") for body in layout.bodies
    }
    objects[BASE] = SimpleNamespace(Name=BASE, Label="frame", TypeId="Part::Box")
    ground = SimpleNamespace(TypeId="App::FeaturePython", ObjectToGround=objects[BASE])
    joints = []
    for joint in layout.joints:
        ends = zip((joint.parent, joint.child), layout.sides(joint), strict=True)
        turn = Frame(rotation_about(0, -0.5 * np.pi), np.zeros(3))
        one, two = ((end, FakePlacement(PLACE.then(side).then(turn))) for end, side in ends)
        joints.append(SimpleNamespace(
            TypeId="App::FeaturePython", Label=joint.name, JointType=WORDS[joint.kind], Activated=True,
            Reference1=[SimpleNamespace(Name="Assembly"), [f"{one[0]}.Edge1"]], Placement1=one[1],
            Reference2=[SimpleNamespace(Name="Assembly"), [f"{two[0]}.Edge1"]], Placement2=two[1],
        ))  # fmt: skip
    document = SimpleNamespace(FileName=str(tmp_path / "car.FCStd"), getObject=objects.get)
    assembly = SimpleNamespace(Name="Assembly", TypeId="Assembly::AssemblyObject", Placement=place, Document=document)
    document.Objects = [assembly, ground, *joints]
    solids = {body.name: FakeShape(body) for body in layout.bodies}
    fakes = {
        "FreeCAD": SimpleNamespace(ActiveDocument=document, Vector=lambda *xyz: np.array(xyz, dtype=float)),
        "Part": SimpleNamespace(getShape=lambda part: solids[part.Name]),
        "UtilsAssembly": SimpleNamespace(getJcsGlobalPlc=lambda placement, reference: placement),
    }
    for name, module in fakes.items():
        monkeypatch.setitem(sys.modules, name, module)
    text = MACRO.read_text(encoding="utf-8").replace("DENSITY = 7850.0", "DENSITY = 1000.0")
    exec(compile(text, str(MACRO), "exec"), {"__name__": "macro"})
    again, _ = read_layout(tmp_path / "car_frames.csv")
    for body in layout.bodies:
        other = again.body(body.name)
        assert other.mass == pytest.approx(body.mass)
        centre = PLACE.then(body.pose).then(Frame(np.eye(3), body.centre)).position
        np.testing.assert_allclose(other.pose.then(Frame(np.eye(3), other.centre)).position, centre, atol=1e-9)
        turn = PLACE.rotation @ body.pose.rotation
        np.testing.assert_allclose(inertia_of(other), turn @ body.inertia @ turn.T, atol=1e-9)
    for joint, other in zip(layout.joints, again.joints, strict=True):
        assert (other.name, other.kind) == (joint.name, joint.kind)
        mine, theirs = PLACE.then(layout.sides(joint)[0]), again.sides(other)[0]
        np.testing.assert_allclose(theirs.position, mine.position, atol=1e-9)
