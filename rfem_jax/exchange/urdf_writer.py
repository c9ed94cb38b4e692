"""A layout as URDF.

Place in the pipeline: layout -> **urdf_writer** -> a file that `urdf` reads.

A link's frame there is that of the joint that carries it, on the link; all joints are at their zero. URDF has no loops
and no start values.
"""

from xml.etree import ElementTree as Xml

import numpy as np

from rfem_jax.description.basics.errors import InputError
from rfem_jax.exchange.layout import BASE, Connection, Layout
from rfem_jax.exchange.rigid_frames import Frame, angles_of, at_origin
from rfem_jax.exchange.xml_trees import numbers_text

_TYPES = {"revolute": "continuous", "prismatic": "prismatic", "fixed": "fixed", "planar": "planar", "free": "floating"}
_FAR, _STRONG = 1e3, 1e9  # limits, which URDF wants of slides: m, and N and m/s


def urdf_text(layout: Layout, source: str) -> tuple[str, tuple[str, ...]]:
    """The file, and sentences on what it does not hold. Raises InputError for joints that URDF does not know."""
    left = (*layout.remarks, *_left_out(layout))
    root = Xml.Element("robot", name=layout.title)
    for sentence in (f"{source}; SI units, radians", *(f"not in this file: {one}" for one in left)):
        root.append(Xml.Comment(f" {sentence.replace('--', '- -')} "))
    Xml.SubElement(root, "link", name=BASE)
    frames = {BASE: at_origin()} | {joint.child: joint.bore for joint in layout.joints if not joint.cut}
    for body in layout.bodies:
        to = frames[body.name].inverse()
        inertial = Xml.SubElement(Xml.SubElement(root, "link", name=body.name), "inertial")
        centre = to.then(Frame(np.eye(3), body.centre)).position
        Xml.SubElement(inertial, "origin", xyz=numbers_text(centre), rpy="0 0 0")
        Xml.SubElement(inertial, "mass", value=numbers_text([body.mass]))
        tensor = to.rotation @ body.inertia @ to.rotation.T
        entries = {f"i{'xyz'[i]}{'xyz'[j]}": numbers_text([tensor[i, j]]) for i in range(3) for j in range(i, 3)}
        Xml.SubElement(inertial, "inertia", entries)
    for joint in layout.joints:
        if not joint.cut:
            element = _joint(root, joint, frames[joint.parent].inverse().then(joint.seat))
            for one in [one for one in layout.ratios if one.joints[1] == joint.name][:1]:
                numbers = {"multiplier": numbers_text([one.ratio]), "offset": numbers_text([one.offset])}
                Xml.SubElement(element, "mimic", {"joint": one.joints[0], **numbers})
    Xml.indent(root)
    return Xml.tostring(root, encoding="unicode") + "\n", left


def _joint(root: Xml.Element, joint: Connection, origin: Frame) -> Xml.Element:
    if joint.kind not in _TYPES:
        raise InputError(
            f"Joint `{joint.name}` must be of a kind that URDF knows ({', '.join(_TYPES)}), but is {joint.kind}; "
            "export it as MJCF."
        )
    element = Xml.SubElement(root, "joint", name=joint.name, type=_TYPES[joint.kind])
    Xml.SubElement(element, "origin", xyz=numbers_text(origin.position), rpy=numbers_text(angles_of(origin.rotation)))
    Xml.SubElement(element, "parent", link=joint.parent)
    Xml.SubElement(element, "child", link=joint.child)
    if joint.kind in ("revolute", "prismatic", "planar"):
        Xml.SubElement(element, "axis", xyz="1 0 0" if joint.kind == "prismatic" else "0 1 0")
    if joint.kind == "prismatic":
        ends = {"lower": -_FAR, "upper": _FAR, "effort": _STRONG, "velocity": _STRONG}
        Xml.SubElement(element, "limit", {key: numbers_text([value]) for key, value in ends.items()})
    damping = sum(one.damping for one in joint.springs)
    if damping and joint.kind in ("revolute", "prismatic"):
        Xml.SubElement(element, "dynamics", damping=numbers_text([damping]))
    return element


def _left_out(layout: Layout) -> list[str]:
    cut = [joint.name for joint in layout.joints if joint.cut]
    sprung = [joint.name for joint in layout.joints if any(one.stiffness or one.preload for one in joint.springs)]
    started = [joint.name for joint in layout.joints if any(joint.start)]
    followers = [one.joints[1] for one in layout.ratios]
    twice = [one.name for n, one in enumerate(layout.ratios) if one.joints[1] in followers[:n]]
    told = {
        "The couplings of joints that follow another already": twice,
        "The joints that close loops, of which URDF knows none": cut,
        "The springs in joints": sprung,
        "The springs between points": [one.name for one in layout.pulls],
        "Start values of joints, which are zero there": started,
    }
    found = [f"{words}: {', '.join(names)}." for words, names in told.items() if names]
    return [*found, f"Gravity, {numbers_text(layout.gravity)} m/s^2: URDF has none."]
