"""A layout as MJCF.

Place in the pipeline: layout -> **mjcf_writer** -> a file that MuJoCo and `mjcf_reader` read.

Bodies stand where they are at the start, which is `qpos0`; joints count from the same zero as ours (`ref`). Frames of
all joints, with errors, are sites. A cut hinge is two `connect` constraints along its axis, a ball one, a fixed joint a
`weld`, all of sites, so that the errors of a loop stay in it; MuJoCo holds them by soft constraints.
"""

from xml.etree import ElementTree as Xml

import numpy as np

from rfem_jax.description.basics.errors import InputError
from rfem_jax.exchange.layout import BASE, Body, Connection, Layout, motion_frame
from rfem_jax.exchange.mjcf_reader import BORE, LENGTH, SEAT
from rfem_jax.exchange.rigid_frames import Frame, quaternion_of
from rfem_jax.exchange.xml_trees import numbers_text

_CLOSING = ("revolute", "spherical", "fixed")
_STIFF = "0.0004 1"  # solref: time constant [s], at least twice the step, and damping ratio of the soft constraints
_STEP = "0.0002"  # s


def mjcf_text(layout: Layout, source: str) -> tuple[str, tuple[str, ...]]:
    """The file, and sentences on what it does not hold. Raises InputError for joints that MJCF cannot have."""
    left = (*layout.remarks, *left_out(layout))
    root = Xml.Element("mujoco", model=layout.title)
    for sentence in (f"{source}; SI units, radians", *(f"not in this file: {one}" for one in left)):
        root.append(Xml.Comment(f" {sentence.replace('--', '- -')} "))
    Xml.SubElement(root, "compiler", angle="radian", inertiafromgeom="false")
    Xml.SubElement(root, "option", gravity=numbers_text(layout.gravity), timestep=_STEP, integrator="implicitfast")
    custom = Xml.SubElement(root, "custom")
    for body in layout.bodies:
        Xml.SubElement(custom, "numeric", name=LENGTH + body.name, data=numbers_text([body.length or 0.0]))
    world = Xml.SubElement(root, "worldbody")
    elements = {BASE: world}
    for body in _by_depth(layout):
        carrying = next(one for one in layout.joints if one.child == body.name and not one.cut)
        elements[body.name] = _body(layout, elements[carrying.parent], body, carrying)
    for joint in layout.joints:
        for side, frame, ending in ((joint.parent, joint.seat, SEAT), (joint.child, joint.bore, BORE)):
            _site(elements[side], joint.name + ending, frame)
    _closures(layout, root, elements)
    if layout.pulls:
        tendons = Xml.SubElement(root, "tendon")
        for one in layout.pulls:
            sites = [f"{one.name}.{n}" for n in range(2)]
            for name, body, point in zip(sites, one.bodies, one.points):
                _site(elements[body], name, Frame(np.eye(3), point))
            rest = one.free_length - (one.preload / one.stiffness if one.stiffness else 0.0)
            numbers = {"stiffness": one.stiffness, "damping": one.damping, "springlength": rest}
            attributes = {"name": one.name} | {key: numbers_text([value]) for key, value in numbers.items()}
            spatial = Xml.SubElement(tendons, "spatial", attributes)
            for name in sites:
                Xml.SubElement(spatial, "site", site=name)
    Xml.indent(root)
    return Xml.tostring(root, encoding="unicode") + "\n", left


def left_out(layout: Layout) -> list[str]:
    found = [f"The preload of the damper {one.name}." for one in layout.pulls if one.preload and not one.stiffness]
    for joint in layout.joints:
        if joint.kind in ("spherical", "free") and joint.springs:
            found.append(f"The springs of joint {joint.name}, of the kind {joint.kind}.")
        motions = [one.motion for one in joint.springs]
        found += [f"A second spring at {joint.name}." for one in set(motions) if motions.count(one) > 1]
    return found


def _by_depth(layout: Layout) -> list[Body]:
    """Bodies with those that carry them before."""
    parents = {joint.child: joint.parent for joint in layout.joints if not joint.cut}
    found, known = [], {BASE}
    while len(found) < len(layout.bodies):
        level = [one for one in layout.bodies if one.name not in known and parents[one.name] in known]
        found += level
        known |= {one.name for one in level}
    return found


def _body(layout: Layout, parent: Xml.Element, body: Body, joint: Connection) -> Xml.Element:
    pose = body.pose.seen_from(layout.pose(joint.parent))
    element = Xml.SubElement(
        parent, "body", name=body.name, pos=numbers_text(pose.position), quat=numbers_text(quaternion_of(pose.rotation))
    )
    moments, axes = np.linalg.eigh(body.inertia)
    axes[:, 2] *= np.sign(np.linalg.det(axes))
    if body.mass <= 0.0:
        raise InputError(
            f"Link `{body.name}` must have a mass for MuJoCo, which moves no body without one, but has none."
        )
    Xml.SubElement(
        element,
        "inertial",
        pos=numbers_text(body.centre),
        quat=numbers_text(quaternion_of(axes)),
        mass=numbers_text([body.mass]),
        diaginertia=numbers_text(moments),
    )
    for number, (kind, axis, value, motion) in enumerate(_motions(joint)):
        name = joint.name if number == 0 else f"{joint.name}.{number + 1}"
        if kind == "free":
            Xml.SubElement(element, "freejoint", name=name)
            continue
        item = Xml.SubElement(element, "joint", name=name, type=kind, pos=numbers_text(joint.bore.position))
        if kind == "ball":
            continue
        item.set("axis", numbers_text(joint.bore.rotation @ axis))
        item.set("ref", numbers_text([value]))
        for spring in [one for one in joint.springs if one.motion == motion][:1]:
            rest = spring.rest + (spring.preload / spring.stiffness if spring.stiffness else 0.0)
            for key, number in (("stiffness", spring.stiffness), ("damping", spring.damping), ("springref", rest)):
                item.set(key, numbers_text([number]))
    return element


def _motions(joint: Connection) -> list[tuple[str, np.ndarray, float, str]]:
    """Kind of MuJoCo, axis in the frame on the child at the start, coordinate, our motion, of each of its joints."""
    axes, start = np.eye(3), joint.start
    if joint.kind == "fixed":
        return []
    if joint.kind == "spherical":
        return [("ball", axes[0], 0.0, "R")]
    if joint.kind == "free":
        on_parent = [("slide", axis, 0.0, f"T_{'xyz'[i]}") for i, axis in enumerate(axes)]
        return [("free", axes[0], 0.0, "")] if joint.parent == BASE else [*on_parent, ("ball", axes[0], 0.0, "R")]
    if joint.kind == "universal":
        first = motion_frame("universal", start).rotation.T @ axes[1]
        return [("hinge", first, start[0], "R_y"), ("hinge", axes[2], start[1], "R_z")]
    if joint.kind == "planar":
        turn = motion_frame("planar", start).rotation.T
        slides = [("slide", turn @ axes[2 * k], start[k], f"T_{'xz'[k]}") for k in range(2)]
        return [*slides, ("hinge", axes[1], start[2], "R_y")]
    kinds = {"revolute": [("hinge", 1, "R_y")], "prismatic": [("slide", 0, "T_x")],
             "cylindrical": [("hinge", 1, "R_y"), ("slide", 1, "T_y")]}  # fmt: skip
    return [(kind, axes[axis], start[k], motion) for k, (kind, axis, motion) in enumerate(kinds[joint.kind])]


def _closures(layout: Layout, root: Xml.Element, elements: dict[str, Xml.Element]) -> None:
    cut = [joint for joint in layout.joints if joint.cut]
    equality = Xml.SubElement(root, "equality") if cut or layout.ratios else root
    apart = max((body.length or 0.0 for body in layout.bodies), default=0.0) or 0.1
    for joint in cut:
        if joint.kind not in _CLOSING:
            raise InputError(
                f"Joint `{joint.name}` must be a hinge, a ball or fixed to close a loop in MJCF, but is {joint.kind}; "
                "cut another joint of the loop."
            )
        tag = "weld" if joint.kind == "fixed" else "connect"
        both = {"site1": joint.name + SEAT, "site2": joint.name + BORE}
        Xml.SubElement(equality, tag, {"name": joint.name, **both, "solref": _STIFF})
        if joint.kind == "revolute":
            along = Frame(np.eye(3), np.array([0.0, apart, 0.0]))
            for side, frame, ending in ((joint.parent, joint.seat, SEAT), (joint.child, joint.bore, BORE)):
                _site(elements[side], f"{joint.name}{ending}2", frame.then(along))
            second = {key: f"{name}2" for key, name in both.items()}
            Xml.SubElement(equality, tag, {"name": f"{joint.name}.2", **second, "solref": _STIFF})
    for one in layout.ratios:
        start = {joint.name: joint.start for joint in layout.joints}
        a, b = (start[name][0] for name in one.joints)
        first = one.offset + one.ratio * a - b
        Xml.SubElement(
            equality, "joint", name=one.name, joint1=one.joints[1], joint2=one.joints[0],
            polycoef=numbers_text([first, one.ratio, 0.0, 0.0, 0.0]), solref=_STIFF,
        )  # fmt: skip


def _site(element: Xml.Element, name: str, frame: Frame) -> None:
    position, turn = numbers_text(frame.position), numbers_text(quaternion_of(frame.rotation))
    Xml.SubElement(element, "site", name=name, pos=position, quat=turn)
