"""SDF as a layout, with its closed loops.

Place in the pipeline: **sdf** -> layout.

One model, in a world or alone, without nested or included ones; the world is the base.
Poses are relative to the model, to a link, to a joint or to a frame, as the file says; all joints are at zero.
"""

from collections import Counter
from dataclasses import dataclass, field, replace
from xml.etree import ElementTree as Xml

import numpy as np
from jaxtyping import Float

from rfem_jax.description.basics.errors import InputError, suggestion
from rfem_jax.exchange.layout import BASE, Along, Body, Connection, Layout, coordinates_of
from rfem_jax.exchange.rigid_frames import PARALLEL, Frame, at_origin, axes_from, rotation_from
from rfem_jax.exchange.urdf import numbers

KINDS = {
    "revolute": "revolute", "continuous": "revolute", "prismatic": "prismatic", "ball": "spherical",
    "universal": "universal", "revolute2": "universal", "fixed": "fixed",
}  # fmt: skip
_WORLD = ("world", "__world__")
_KNOWN = {
    "model": {"link", "joint", "frame", "pose", "static", "plugin"},
    "link": {"pose", "inertial", "visual", "collision"},
    "joint": {"pose", "parent", "child", "axis", "axis2"},
}


@dataclass
class _Source:
    """A model: its links, joints and frames by names, and places found, in the axes of the world."""

    root: Xml.Element
    links: dict[str, Xml.Element]
    joints: dict[str, Xml.Element]
    frames: dict[str, Xml.Element]
    places: dict[str, Frame] = field(default_factory=dict)
    asked: list[str] = field(default_factory=list)

    def place(self, name: str) -> Frame:
        """Where a link, a joint, a frame, the model or the world stands. Raises InputError."""
        if name in _WORLD or name == "":
            return at_origin()
        if name not in self.places:
            if name in self.asked:
                raise InputError(
                    f"The pose of `{name}` must be relative to another than itself, but is not; correct it."
                )
            self.asked.append(name)
            self.places[name] = self._found(name)
            self.asked.pop()
        return self.places[name]

    def _found(self, name: str) -> Frame:
        if name == "__model__":
            return _pose(self.root, "the model")[0]
        for elements, usual in ((self.links, ""), (self.joints, "child"), (self.frames, "attached_to")):
            if name not in elements:
                continue
            element = elements[name]
            frame, relative = _pose(element, f"`{name}`")
            reference = element.findtext("child") if usual == "child" else element.get(usual) if usual else None
            return self.place((relative or reference or "__model__").strip()).then(frame)
        known = [*self.links, *self.joints, *self.frames]
        raise InputError(
            f"The file must have what its poses are relative to, but not `{name}`; {suggestion(name, known)}"
        )

    def link(self, text: str | None, side: str, joint: str) -> str:
        """The link, or the base, that a parent or child means, by its own name or that of a frame on it."""
        name, seen = (text or "").strip(), set()
        while name in self.frames and name not in seen:
            seen.add(name)
            name = (self.frames[name].get("attached_to") or "").strip()
        if name in _WORLD:
            return BASE
        if name not in self.links:
            raise InputError(
                f"The {side} of joint `{joint}` must be a link of the file or world, but is {name!r}; "
                f"{suggestion(name, self.links)}"
            )
        return name


def read_sdf(root: Xml.Element, title: str) -> Layout:
    """The layout of the first element <sdf>. Raises InputError."""
    worlds = [root, *root.findall("world")]
    models = [model for world in worlds for model in world.findall("model")]
    included = any(element.tag == "include" for element in root.iter())
    nested = any(model.find("model") is not None for model in models)
    if len(models) != 1 or included or nested:
        what = "includes others" if included else f"has {len(models)}" if not nested else "has models in models"
        raise InputError(f"The file must have one model that is complete, but {what}; write it into one.")
    model = models[0]
    found = {tag: _named(model, tag) for tag in ("link", "joint", "frame")}
    source = _Source(model, found["link"], found["joint"], found["frame"])
    remarks = _remarks(source)
    if (model.findtext("static") or "").strip() in ("true", "1"):
        raise InputError("The model must move, but is static; there is nothing to import.")
    gravity = numbers(root.findtext("world/gravity"), 3, (0.0, 0.0, -9.8), "gravity")
    bodies = tuple(_body(source, name) for name in source.links)
    layout = Layout(model.get("name") or title, bodies, (), gravity, remarks=tuple(remarks))
    return replace(layout, joints=tuple(_joint(source, layout, name) for name in source.joints))


def _named(model: Xml.Element, tag: str) -> dict[str, Xml.Element]:
    found: dict[str, Xml.Element] = {}
    for element in model.findall(tag):
        name = element.get("name", "")
        if not name or name in found or name in (*_WORLD, BASE):
            raise InputError(
                f"Every {tag} of the file must have a name of its own other than world and base, but one has {name!r}; "
                "rename it."
            )
        found[name] = element
    return found


def _pose(element: Xml.Element, of: str) -> tuple[Frame, str]:
    """The pose of an element, and to what it is relative, "" where it does not say."""
    pose = element.find("pose")
    if pose is None:
        return at_origin(), ""
    values = numbers(pose.text or "0 0 0 0 0 0", 6, (0.0,) * 6, f"The pose of {of}")
    angles = np.radians(values[3:]) if pose.get("degrees") in ("true", "1") else values[3:]
    return Frame(rotation_from(angles), values[:3]), pose.get("relative_to", "")


def _body(source: _Source, name: str) -> Body:
    inertial, pose = source.links[name].find("inertial"), source.place(name)
    if inertial is None:  # as the format has it
        return Body(name, pose, 1.0, np.zeros(3), np.eye(3))
    frame, _ = _pose(inertial, f"the inertia of `{name}`")
    mass = float(numbers(inertial.findtext("mass"), 1, (1.0,), f"The mass of `{name}`")[0])
    tensor, given = np.eye(3), inertial.find("inertia")
    for i in range(3):
        for j in range(i, 3):
            text = None if given is None else given.findtext(f"i{'xyz'[i]}{'xyz'[j]}")
            usual = (1.0 if i == j else 0.0,)
            tensor[i, j] = tensor[j, i] = numbers(text, 1, usual, f"The inertia of `{name}`")[0]
    return Body(name, pose, mass, frame.position, frame.rotation @ tensor @ frame.rotation.T)


def _joint(source: _Source, layout: Layout, name: str) -> Connection:
    element = source.joints[name]
    word = element.get("type", "")
    if word not in KINDS:
        raise InputError(
            f"The type of joint `{name}` must be one that a study has, but is {word!r}; {suggestion(word, KINDS)}"
        )
    kind, place = KINDS[word], source.place(name)
    parent, child = (source.link(element.findtext(side), side, name) for side in ("parent", "child"))
    if parent == child:
        raise InputError(f"Joint `{name}` must join two links, but both are {parent}; correct it.")
    axes = [
        _axis(source, place, element.find(tag), f"`{name}`")
        for tag in ("axis", "axis2")[: {"universal": 2, "fixed": 0, "spherical": 0}.get(kind, 1)]
    ]
    rotation = place.rotation
    if kind == "universal":
        if abs(axes[0] @ axes[1]) > PARALLEL:
            raise InputError(f"The axes of joint `{name}` must be at right angles, but are not; correct them.")
        rotation = axes_from(axes[0], axes[1], (1, 2)).rotation
    elif axes:
        places = (0, 1) if kind == "prismatic" else (1, 0)
        rotation = axes_from(axes[0], place.rotation[:, places[1]], places).rotation
    at = Frame(rotation, place.position)
    motions = {"revolute": ("R_y",), "prismatic": ("T_x",), "universal": ("R_y", "R_z")}.get(kind, ())
    springs = [
        _spring(element.find(tag), motion, name) for motion, tag in zip(motions, ("axis", "axis2"), strict=False)
    ]
    return Connection(
        name,
        kind,
        parent,
        child,
        at.seen_from(layout.pose(parent)),
        at.seen_from(layout.pose(child)),
        start=coordinates_of(kind, at_origin()),
        springs=tuple(one for one in springs if one is not None),
    )


def _axis(source: _Source, place: Frame, element: Xml.Element | None, of: str) -> Float[np.ndarray, "3"]:
    """A direction in the axes of the world."""
    xyz = None if element is None else element.find("xyz")
    axis = numbers(None if xyz is None else xyz.text or "", 3, (0.0, 0.0, 1.0), f"The axis of joint {of}")
    size = float(np.linalg.norm(axis))
    if not size > 1e-9:
        raise InputError(f"The axis of joint {of} must be a direction, but is zero; give one.")
    expressed = "" if xyz is None else xyz.get("expressed_in", "")
    old = element is not None and (element.findtext("use_parent_model_frame") or "").strip() in ("true", "1")
    frame = source.place("__model__") if old else source.place(expressed) if expressed else place
    return frame.rotation @ axis / size


def _spring(axis: Xml.Element | None, motion: str, name: str) -> Along | None:
    dynamics = None if axis is None else axis.find("dynamics")
    if dynamics is None:
        return None
    of = f"of joint `{name}`"
    found = {
        key: float(numbers(dynamics.findtext(tag), 1, (0.0,), f"The {tag} {of}")[0])
        for key, tag in (("stiffness", "spring_stiffness"), ("damping", "damping"), ("rest", "spring_reference"))
    }
    if min(found["stiffness"], found["damping"]) < 0.0:
        raise InputError(f"The spring and damper {of} must not be negative, but are; correct them.")
    return Along(motion, **found) if found["stiffness"] or found["damping"] else None


def _remarks(source: _Source) -> list[str]:
    limited, rubbing, screwed = [], [], []
    for name, joint in source.joints.items():
        axes = [axis for tag in ("axis", "axis2") for axis in joint.findall(tag)]
        if joint.get("type") != "continuous" and any(axis.find("limit") is not None for axis in axes):
            limited.append(name)
        if any((axis.findtext("dynamics/friction") or "0").strip("0. ") for axis in axes):
            rubbing.append(name)
        if joint.get("type") in ("ball", "fixed") and any(axis.find("dynamics") is not None for axis in axes):
            screwed.append(name)
    told = {"limits": limited, "friction": rubbing, "springs and dampers": screwed}
    found = [f"The {words} of {', '.join(names)}." for words, names in told.items() if names]
    bare = [name for name, link in source.links.items() if link.find("inertial") is None]
    if bare:
        found.append(f"{', '.join(bare)} without inertia: 1 kg and 1 kg m^2, as the format has it.")
    unknown = Counter(
        child.tag
        for tag, elements in (
            ("model", [source.root]),
            ("link", source.links.values()),
            ("joint", source.joints.values()),
        )
        for element in elements
        for child in element
        if child.tag not in _KNOWN[tag] or child.tag == "plugin"
    )
    if unknown:
        found.append(f"Other elements: {', '.join(f'{tag} ({count})' for tag, count in unknown.items())}.")
    return found
