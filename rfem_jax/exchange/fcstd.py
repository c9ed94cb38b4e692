"""Assemblies of FreeCAD 1.0 and later (`.FCStd`) as layouts, without their masses.

Place in the pipeline: **fcstd** -> layout.

The file is a zip; `Document.xml` in it has all objects and their properties (FreeCAD's sources: `src/App/Document.cpp`,
`PropertyLinks.cpp`, `PropertyGeo.cpp`). A joint of an assembly is an object with a `JointType`; `Reference1` and
`Reference2` are paths to what it joins, `Placement1` and `Placement2` its frames there, offsets included
(`src/Mod/Assembly/JointObject.py`): z is the axis of a hinge and the direction of a slide. Their places in space are
those of all objects along the path, one after the other. What is grounded is the base. Lengths are mm, quaternions
have the scalar last. Shapes stand in other files of the zip; densities nowhere.
"""

import io
import zipfile
from collections.abc import Iterable
from dataclasses import dataclass
from xml.etree import ElementTree as Xml

import numpy as np

from rfem_jax.description.basics.errors import InputError
from rfem_jax.exchange.layout import BASE, Body, Connection, Layout, coordinates_of, motion_frame
from rfem_jax.exchange.rigid_frames import Frame, at_origin, rotation_about, rotation_of_quaternion
from rfem_jax.exchange.urdf import numbers
from rfem_jax.exchange.xml_trees import LARGEST, read_tree

SIGNATURE = b"PK\x03\x04"  # of a zip
_DOCUMENT = "Document.xml"
_ASSEMBLY, _GROUP, _LINK = "Assembly::AssemblyObject", "Assembly::JointGroup", "App::Link"
KINDS = {"Fixed": "fixed", "Revolute": "revolute", "Cylindrical": "cylindrical", "Slider": "prismatic",
         "Ball": "spherical"}  # fmt: skip
_WORDS = (*KINDS, "Distance", "Parallel", "Perpendicular", "Angle", "RackPinion", "Screw", "Gears", "Belt")
_OF_BODIES = ("Body", "CoordinateSystem", "Plane", "Line", "Point")  # what has a place in a path, of PartDesign
_STILL = ("App::Origin", "App::LocalCoordinateSystem", "App::Plane", "App::Line", "App::Point")
_TO_HINGE = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])  # columns: our x, y, z in theirs
_TO_SLIDE = _TO_HINGE @ _TO_HINGE
_OPEN = 1e-4  # rad, or share of the mechanism's size, by which a joint of a solved assembly may be open


@dataclass(frozen=True)
class _Document:
    """Types of all objects and their properties, by names."""

    types: dict[str, str]
    properties: dict[str, dict[str, Xml.Element]]

    def element(self, name: str, key: str) -> Xml.Element | None:
        """The first element in a property, None where there is no such property."""
        found = self.properties.get(name, {}).get(key)
        return None if found is None else next(iter(found), None)

    def value(self, name: str, key: str, usual: str = "") -> str:
        """The attribute `value` of a property."""
        found = self.element(name, key)
        return usual if found is None else found.get("value", usual)

    def label(self, name: str) -> str:
        """What the user calls an object."""
        return self.value(name, "Label") or name

    def members(self, name: str) -> list[str]:
        """The objects in a group."""
        found = self.element(name, "Group")
        return [] if found is None else [one.get("value", "") for one in found]

    def placement(self, name: str, key: str = "Placement") -> Frame:
        """A placement in metres; none is the origin. Raises InputError."""
        found = self.element(name, key)
        if found is None:
            return at_origin()
        where = f"The {key} of `{self.label(name)}`"
        values = [
            float(numbers(found.get(one), 1, (0.0,), where)[0]) for one in ("Px", "Py", "Pz", "Q3", "Q0", "Q1", "Q2")
        ]
        if not np.linalg.norm(values[3:]) > 1e-9:
            raise InputError(f"{where} must have a rotation, but its quaternion is zero; save the file again.")
        return Frame(rotation_of_quaternion(np.array(values[3:])), 1e-3 * np.array(values[:3]))


def read_fcstd(content: bytes, title: str) -> Layout:
    """The layout of the bytes of a file; no body has a mass. Raises InputError."""
    document = _document(content)
    assembly = _assembly(document)
    joints, grounded, remarks = _joints_of(document, assembly)
    source = _Source(document, assembly, grounded)
    found = [one for name in joints if (one := _joint(source, name, remarks)) is not None]
    poses = source.poses
    if BASE not in {end for one in found for end in (one.parent, one.child)}:
        raise InputError(
            "The assembly must have a joint with a grounded part, which is the base, but has none; toggle "
            "'grounded' of a part in FreeCAD."
        )
    _require_closed(found, poses)
    idle = [document.label(name) for name in _parts(document, assembly) if name not in (*source.moving, *grounded)]
    if idle:
        remarks.append(f"Parts without joints: {', '.join(idle)}.")
    remarks.append(
        "Masses: the file has shapes and no densities; fill in mass, centre and inertia of each link, or let the macro "
        "of the guide write a table with them."
    )
    nothing = np.zeros(3), np.zeros((3, 3))
    bodies = tuple(Body(name, pose, 0.0, *nothing) for name, pose in poses.items())
    return Layout(document.label(assembly) or title, bodies, tuple(found), remarks=tuple(remarks))


def _document(content: bytes) -> _Document:
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            if archive.getinfo(_DOCUMENT).file_size > LARGEST:
                raise InputError(f"`{_DOCUMENT}` in the file must be below {LARGEST / 1e6:g} MB, but is larger.")
            text = archive.read(_DOCUMENT).decode("utf-8")
    except InputError:
        raise
    except Exception as problem:  # of zipfile, zlib and the decoder, which raise several kinds
        reason = " ".join(str(problem).split())[:100]
        raise InputError(
            f"The file must be FreeCAD's, a zip with `{_DOCUMENT}`, but is not ({reason}); save it again."
        ) from None
    root = read_tree(text)
    types = {one.get("name", ""): one.get("type", "") for one in root.iterfind("Objects/Object")}
    properties = {
        one.get("name", ""): {each.get("name", ""): each for each in one.iterfind("Properties/Property")}
        for one in root.iterfind("ObjectData/Object")
    }
    return _Document(types, properties)


def _assembly(document: _Document) -> str:
    """The assembly that is in no other."""
    every = [name for name, kind in document.types.items() if kind == _ASSEMBLY]
    inside = {member for name in every for member in document.members(name)}
    outer = [name for name in every if name not in inside]
    if len(outer) != 1:
        raise InputError(
            f"The file must have one assembly (of FreeCAD's workbench Assembly, 1.0 or later), but has {len(outer)}; "
            "save one alone."
        )
    return outer[0]


def _parts(document: _Document, assembly: str) -> list[str]:
    """The parts in an assembly, and in its groups."""
    found, left = [], list(document.members(assembly))
    for name in left:  # which grows
        kind = document.types.get(name, "")
        if kind == "App::DocumentObjectGroup" or _is_array(document, name):
            left += [one for one in document.members(name) if one not in left]
        elif kind.startswith(
            ("App::Part", "App::Link", "Part::", "PartDesign::Body", "Assembly::AssemblyLink", _ASSEMBLY)
        ):
            found.append(name)
    return found


def _is_array(document: _Document, name: str) -> bool:
    count = document.value(name, "ElementCount", "0")
    return document.types.get(name) == _LINK and count.isdigit() and int(count) > 0


def _joints_of(document: _Document, assembly: str) -> tuple[list[str], set[str], list[str]]:
    """Joints of an assembly, its grounded parts, sentences on joints that do not count."""
    groups = [name for name in document.members(assembly) if document.types.get(name) == _GROUP]
    members = [one for group in groups for one in document.members(group)]
    grounded, joints, remarks = set(), [], []
    for name in members:
        ground, on = document.element(name, "ObjectToGround"), document.value(name, "Activated", "true")
        if ground is not None:
            grounded.add(ground.get("value") or ground.get("name", ""))
        elif "JointType" not in document.properties.get(name, {}):
            continue
        elif on != "true" or document.value(name, "Suppressed", "false") == "true":
            remarks.append(f"The joint {document.label(name)}, which is not active.")
        else:
            joints.append(name)
    return joints, grounded, remarks


class _Source:
    """A document with an assembly: parts that joints move, by their objects, and their poses by labels; names of joints
    that are taken."""

    def __init__(self, document: _Document, assembly: str, grounded: set[str]):
        self.document, self.assembly, self.grounded = document, assembly, grounded
        self.moving: dict[str, str] = {}
        self.poses: dict[str, Frame] = {}
        self.names: set[str] = set()

    def called(self, joint: str) -> str:
        """The label of a joint; with its name where another joint has the same."""
        label = self.document.label(joint)
        label = f"{label}_{joint}" if label in self.names else label
        self.names.add(label)
        return label

    def side(self, joint: str, number: int) -> tuple[str, Frame]:
        """The body, or the base, on one side of a joint, and the joint's frame there in global axes."""
        path, where = self._path(joint, number), f"Joint `{self.document.label(joint)}`"
        at = path.index(self.assembly) + 1
        while at < len(path) and (
            self.document.types.get(path[at]) == "App::DocumentObjectGroup" or _is_array(self.document, path[at])
        ):
            at += 1
        if at == len(path):
            return BASE, self._along(path, where).then(self.document.placement(joint, f"Placement{number}"))
        part = path[at]
        frame = self._along(path, where).then(self.document.placement(joint, f"Placement{number}"))
        if part in self.grounded or self.document.types.get(part, "").startswith(_STILL):
            return BASE, frame
        if self.document.value(part, "Rigid", "true") != "true":
            raise InputError(
                f"{where} must join rigid parts, but `{self.document.label(part)}` is a flexible sub-assembly; make it "
                "rigid, or move its joints into the outer assembly."
            )
        if part not in self.moving:
            label = self.document.label(part)
            taken = label in self.poses or label == BASE
            self.moving[part] = f"{label}_{part}" if taken else label
            self.poses[self.moving[part]] = self._along(path[: at + 1], where)
        return self.moving[part], frame

    def _path(self, joint: str, number: int) -> list[str]:
        """Names of the objects that lead to what a joint joins."""
        link = self.document.element(joint, f"Reference{number}")
        if link is None or not link.get("name"):
            raise InputError(
                f"Joint `{self.document.label(joint)}` must have a Reference{number}, as FreeCAD 1.0 and later write "
                "it, but has none; open the file there and save it again."
            )
        subs = [link.get("sub") or ""] if len(link) == 0 else [one.get("value", "") for one in link]
        found = [link.get("name", ""), *subs[0].split(".")[:-1]]
        return found if self.assembly in found else [self.assembly, *found]  # later versions begin at the part

    def _along(self, path: Iterable[str], where: str) -> Frame:
        """The place of the last object of a path: all placements one after the other."""
        document, found = self.document, at_origin()
        for name in path:
            kind = document.types.get(name)
            if kind is None:
                raise InputError(
                    f"{where} must join objects of the file itself, but `{name[:60]}` is none of it, which may "
                    "lie in a linked one; let the macro of the guide write a table."
                )
            if kind.startswith("PartDesign::") and not kind.startswith(
                tuple(f"PartDesign::{one}" for one in _OF_BODIES)
            ):
                continue  # features of a body are at its origin
            key = "Placement" if "Placement" in document.properties.get(name, {}) else "LinkPlacement"
            found = found.then(document.placement(name, key))
            if kind == _LINK and document.value(name, "LinkTransform", "false") == "true":
                linked = document.element(name, "LinkedObject")
                if linked is None or linked.get("file") or linked.get("name", "") not in document.types:
                    raise InputError(
                        f"{where} must join links to objects of the file itself where these keep their own placement, "
                        f"but `{document.label(name)}` leads elsewhere; let the macro of the guide write a table."
                    )
                found = found.then(document.placement(linked.get("name", "")))
        return found


def _joint(source: _Source, name: str, remarks: list[str]) -> Connection | None:
    """A joint; None, with a remark, for what a study has not."""
    document = source.document
    label, word = document.label(name), _word(document, name)
    if word not in KINDS:
        remarks.append(f"The joint {label} ({word}), without which parts may be free: a study has no such kind.")
        return None
    kind = KINDS[word]
    (parent, left), (child, right) = (source.side(name, number) for number in (1, 2))
    if parent == child:
        remarks.append(f"The joint {label}, which joins a part to itself.")
        return None
    if left.rotation[:, 2] @ right.rotation[:, 2] < 0.0:  # FreeCAD lets axes point against each other
        right = right.then(Frame(rotation_about(0, np.pi), np.zeros(3)))
    if child == BASE:
        (parent, left), (child, right) = (child, right), (parent, left)
    turn = Frame({"prismatic": _TO_SLIDE, "fixed": np.eye(3)}.get(kind, _TO_HINGE), np.zeros(3))
    left, right = left.then(turn), right.then(turn)
    for key, words in (("Length", "length"), ("Angle", "angle")):
        if any(document.value(name, f"Enable{key}{end}") == "true" for end in ("Min", "Max")):
            remarks.append(f"The limits of {words} of {label}.")
    poses = {BASE: at_origin(), **source.poses}
    seat, bore = left.seen_from(poses[parent]), right.seen_from(poses[child])
    called = source.called(name)
    return Connection(called, kind, parent, child, seat, bore, start=coordinates_of(kind, right.seen_from(left)))


def _word(document: _Document, name: str) -> str:
    """The kind of a joint in FreeCAD's words."""
    element = document.properties[name]["JointType"]
    words = [one.get("value", "") for one in element.iterfind("CustomEnumList/Enum")] or list(_WORDS)
    number = document.value(name, "JointType")
    if not number.isdigit() or int(number) >= len(words):
        raise InputError(
            f"Joint `{document.label(name)}` must have one of {len(words)} types, but has number {number[:20]!r}; save "
            "the file again."
        )
    return words[int(number)]


def _require_closed(joints: list[Connection], poses: dict[str, Frame]) -> None:
    """Joints hold where the parts stand, or the assembly has not been solved. Raises InputError."""
    every = {BASE: at_origin(), **poses}
    sides = [(every[one.parent].then(one.seat), every[one.child].then(one.bore)) for one in joints]
    places = np.array([side.position for both in sides for side in both])
    size = max(float(np.linalg.norm(places - places.mean(axis=0), axis=1).max()), 1e-9)
    for one, (left, right) in zip(joints, sides):
        apart = right.seen_from(left.then(motion_frame(one.kind, one.start)))
        shift, turn = float(np.linalg.norm(apart.position)), float(np.abs(apart.rotation - np.eye(3)).max())
        if shift > _OPEN * size or turn > _OPEN:
            raise InputError(
                f"The parts must stand so that their joints hold, but `{one.name}` is open by {1e3 * shift:.3g} mm or "
                f"{np.degrees(turn):.3g} deg; solve the assembly in FreeCAD and save it."
            )
