"""URDF as a layout.

Place in the pipeline: **urdf** -> layout.

The root link is the base. A link stands in the frame of the joint that carries it; all joints are at zero. URDF has no
loops. Parts without mass that are fixed on a link belong to it.
"""

from collections import Counter
from dataclasses import replace
from xml.etree import ElementTree as Xml

import numpy as np
from jaxtyping import Float

from rfem_jax.description.basics.errors import InputError, suggestion
from rfem_jax.exchange.layout import BASE, Along, Body, Connection, Layout, Ratio, coordinates_of
from rfem_jax.exchange.rigid_frames import Frame, at_origin, axes_from, rotation_from

KINDS = {
    "revolute": "revolute", "continuous": "revolute", "prismatic": "prismatic", "fixed": "fixed",
    "floating": "free", "planar": "planar",
}  # fmt: skip
_KNOWN = {
    "robot": {"link", "joint"},
    "link": {"inertial", "visual", "collision"},
    "joint": {"origin", "parent", "child", "axis", "dynamics", "limit", "mimic"},
}


def read_urdf(root: Xml.Element, title: str) -> Layout:
    """The layout of a robot. Raises InputError."""
    links, joints = _named(root, "link"), _named(root, "joint")
    carrying: dict[str, Xml.Element] = {}
    for name, joint in joints.items():
        for side in ("parent", "child"):
            end = _end(joint, side, name)
            if end not in links:
                raise InputError(
                    f"The {side} of joint `{name}` must be a link of the file, but is `{end}`; {suggestion(end, links)}"
                )
        child = _end(joint, "child", name)
        if child in carrying:
            raise InputError(f"Link `{child}` must be the child of one joint, as URDF has no loops, but is of two.")
        carrying[child] = joint
    roots = [name for name in links if name not in carrying]
    if len(roots) != 1:
        raise InputError(f"The file must have one link that is no child, but has {len(roots)}; it would be the base.")
    poses, order = _poses(roots[0], links, joints)
    remarks = _remarks(root, links, joints, roots[0])
    bodies = tuple(_body(name, links[name], poses[name]) for name in order[1:])
    found = Layout(root.get("name") or title, bodies, (), remarks=tuple(remarks))
    made = tuple(_joint(found, name, joint, roots[0]) for name, joint in joints.items())
    return _without_fixed_parts(replace(found, joints=made, ratios=_ratios(joints)))


def _named(root: Xml.Element, tag: str) -> dict[str, Xml.Element]:
    found: dict[str, Xml.Element] = {}
    for element in root.findall(tag):
        name = element.get("name", "")
        if not name or name in found or (name == BASE and tag == "joint"):
            raise InputError(f"Every {tag} of the file must have a name of its own, but one has {name!r}; rename it.")
        found[name] = element
    return found


def _end(joint: Xml.Element, side: str, name: str) -> str:
    element = joint.find(side)
    if element is None or not element.get("link"):
        raise InputError(f"Joint `{name}` must have a {side}, but has none; add <{side} link=.../>.")
    return str(element.get("link"))


def numbers(text: str | None, count: int, usual: tuple[float, ...], where: str) -> Float[np.ndarray, " count"]:
    """Numbers of an attribute or a text; those that are `usual` where there is none. Raises InputError."""
    if text is None:
        return np.array(usual)
    try:
        found = np.array([float(word) for word in text.split()])
    except ValueError:
        found = np.zeros(0)
    if len(found) != count or not np.all(np.abs(found) < 1e100):
        raise InputError(f"{where} must be {count} finite number{'s' * (count > 1)}, but is {text[:60]!r}; correct it.")
    return found


def _origin(element: Xml.Element | None, where: str) -> Frame:
    origin = None if element is None else element.find("origin")
    if origin is None:
        return at_origin()
    zeros = (0.0, 0.0, 0.0)
    angles = numbers(origin.get("rpy"), 3, zeros, f"The origin's rpy of {where}")
    return Frame(rotation_from(angles), numbers(origin.get("xyz"), 3, zeros, f"The origin's xyz of {where}"))


def _poses(
    root: str, links: dict[str, Xml.Element], joints: dict[str, Xml.Element]
) -> tuple[dict[str, Frame], list[str]]:
    """Poses by names, and these names by depth. Raises InputError where a ring of links hangs on nothing."""
    poses, order = {root: at_origin()}, [root]
    children: dict[str, list[tuple[str, str]]] = {}
    for name, joint in joints.items():
        children.setdefault(_end(joint, "parent", name), []).append((name, _end(joint, "child", name)))
    for parent in order:  # which grows
        for name, child in children.get(parent, []):
            poses[child] = poses[parent].then(_origin(joints[name], f"joint `{name}`"))
            order.append(child)
    if len(order) < len(links):
        lost = next(name for name in links if name not in poses)
        raise InputError(f"Link `{lost}` must hang on the root `{root}`, but hangs on itself; correct its joints.")
    return poses, order


def _body(name: str, link: Xml.Element, pose: Frame) -> Body:
    inertial = link.find("inertial")
    if inertial is None:
        return Body(name, pose, 0.0, np.zeros(3), np.zeros((3, 3)))
    frame, where = _origin(inertial, f"link `{name}`"), f"of link `{name}`"
    mass, inertia = inertial.find("mass"), inertial.find("inertia")
    value = 0.0 if mass is None else float(numbers(mass.get("value"), 1, (0.0,), f"The mass {where}")[0])
    tensor = np.zeros((3, 3))
    for i in range(3):
        for j in range(i, 3):
            key = f"i{'xyz'[i]}{'xyz'[j]}"
            given = None if inertia is None else inertia.get(key)
            tensor[i, j] = tensor[j, i] = numbers(given, 1, (0.0,), f"The {key} {where}")[0]
    return Body(name, pose, value, frame.position, frame.rotation @ tensor @ frame.rotation.T)


def _joint(layout: Layout, name: str, joint: Xml.Element, root: str) -> Connection:
    word = joint.get("type", "")
    if word not in KINDS:
        raise InputError(
            f"The type of joint `{name}` must be one of URDF's, but is {word!r}; {suggestion(word, KINDS)}"
        )
    kind, element = KINDS[word], joint.find("axis")
    axis = numbers(None if element is None else element.get("xyz"), 3, (1.0, 0.0, 0.0), f"The axis of joint `{name}`")
    if not np.linalg.norm(axis) > 1e-9:
        raise InputError(f"The axis of joint `{name}` must be a direction, but is zero; give one.")
    places = (0, 1) if kind == "prismatic" else (1, 0)
    bore = at_origin() if kind in ("fixed", "free") else axes_from(axis, np.eye(3)[places[1]], places)
    parent, child = _end(joint, "parent", name), _end(joint, "child", name)
    parent = BASE if parent == root else parent
    right = layout.pose(child).then(bore)
    left = at_origin() if kind == "free" else right
    start = coordinates_of(kind, right.seen_from(left))
    springs = _dampers(joint, name, kind)
    return Connection(
        name, kind, parent, child, left.seen_from(layout.pose(parent)), bore, start=start, springs=springs
    )


def _dampers(joint: Xml.Element, name: str, kind: str) -> tuple[Along, ...]:
    dynamics = joint.find("dynamics")
    if dynamics is None or kind not in ("revolute", "prismatic"):
        return ()
    damping = float(numbers(dynamics.get("damping"), 1, (0.0,), f"The damping of joint `{name}`")[0])
    if damping < 0.0:
        raise InputError(f"The damping of joint `{name}` must not be negative, but is {damping:g}; correct it.")
    return (Along("R_y" if kind == "revolute" else "T_x", damping=damping),) if damping else ()


def _ratios(joints: dict[str, Xml.Element]) -> tuple[Ratio, ...]:
    found = []
    for name, joint in joints.items():
        mimic = joint.find("mimic")
        if mimic is None:
            continue
        other = mimic.get("joint", "")
        both = [joints[one].get("type") for one in (name, other) if one in joints]
        if len(both) < 2 or name == other or any(one not in ("revolute", "continuous", "prismatic") for one in both):
            raise InputError(f"Joint `{name}` must mimic another hinge or slide of the file, but has {other!r}.")
        ratio = float(numbers(mimic.get("multiplier"), 1, (1.0,), f"The multiplier of `{name}`")[0])
        offset = float(numbers(mimic.get("offset"), 1, (0.0,), f"The offset of `{name}`")[0])
        found.append(Ratio(f"{name}_mimic", (other, name), ratio, offset))
    return tuple(found)


def _remarks(root: Xml.Element, links: dict[str, Xml.Element], joints: dict[str, Xml.Element], base: str) -> list[str]:
    found = []
    if links[base].find("inertial") is not None:
        found.append(f"The mass of {base}, which is the base and stands still.")
    limited = [name for name, joint in joints.items() if joint.find("limit") is not None and _has_ends(joint)]
    rubbing = [
        name for name, joint in joints.items()
        if (dynamics := joint.find("dynamics")) is not None and dynamics.get("friction", "0").strip("0. ")
    ]  # fmt: skip
    sliding = [name for name, joint in joints.items() if joint.get("type") in ("floating", "planar")
               and joint.find("dynamics") is not None]  # fmt: skip
    for words, names in (("limits", limited), ("friction", rubbing), ("dynamics", sliding)):
        if names:
            found.append(f"The {words} of {', '.join(names)}.")
    unknown = Counter(
        child.tag
        for tag, elements in (("robot", [root]), ("link", links.values()), ("joint", joints.values()))
        for element in elements
        for child in element
        if child.tag not in _KNOWN[tag]
    )
    if unknown:
        found.append(f"Other elements: {', '.join(f'{tag} ({count})' for tag, count in unknown.items())}.")
    return found


def _has_ends(joint: Xml.Element) -> bool:
    limit = joint.find("limit")
    return joint.get("type") != "continuous" and limit is not None and bool(limit.get("lower") or limit.get("upper"))


def _without_fixed_parts(layout: Layout) -> Layout:
    """Bodies without mass that are fixed on another become a part of that, with all joints on them."""
    while True:
        massless = {body.name for body in layout.bodies if body.mass == 0.0}
        fixed = next((one for one in layout.joints if one.kind == "fixed" and one.child in massless), None)
        if fixed is None:
            return layout
        part = layout.pose(fixed.child).seen_from(layout.pose(fixed.parent))
        joints = tuple(
            replace(one, parent=fixed.parent, seat=part.then(one.seat)) if one.parent == fixed.child else one
            for one in layout.joints
            if one is not fixed
        )
        bodies = tuple(body for body in layout.bodies if body.name != fixed.child)
        layout = replace(layout, bodies=bodies, joints=joints).remarked(
            f"{fixed.child} has no mass and is fixed on {fixed.parent}: a part of it."
        )
