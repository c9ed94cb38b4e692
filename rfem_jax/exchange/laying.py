"""Names, a tree with cut joints, and frames of links and joints, where a file has none of ours.

Place in the pipeline: a reader's layout -> **laying** -> study_writer.

A link's frame begins at the joint that carries it, and x points to its farthest other joint, so that links of planar
mechanisms get no orientations and can become flexible by a section in the place of their body. A joint's x is as near
as it can be to that of its link, so that an angle is that between two links.
"""

import re
from collections.abc import Iterable
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from rfem_jax.description.basics.errors import InputError
from rfem_jax.exchange.inertias import sound
from rfem_jax.exchange.layout import BASE, Body, Connection, Layout, coordinates_of, motion_frame
from rfem_jax.exchange.rigid_frames import Frame, at_origin, axes_from, rotation_about

_NEAR = 1e-9  # share of the mechanism's size below which two places are one
_ROUNDING = 1e-12  # rad
_SWAP = np.array([[-1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 1.0, 0.0]])  # y for z, as a universal joint from behind
_TURNED = {
    "revolute": rotation_about(0, np.pi), "cylindrical": rotation_about(0, np.pi),
    "prismatic": rotation_about(2, np.pi), "universal": _SWAP,
}  # fmt: skip
_AXIS = {"revolute": 1, "cylindrical": 1, "prismatic": 0}  # of kinds whose frames may be turned about one


def finished(layout: Layout) -> Layout:
    """A reader's layout as a study has it: plain names, a tree with cut joints, frames. Raises InputError."""
    if not layout.bodies:
        raise InputError("The file must have at least one body that moves, but has none; there is nothing to import.")
    layout = _as_tree(_with_plain_names(layout))
    return sound(layout if layout.framed else _framed(layout), _size(layout))


def _with_plain_names(layout: Layout) -> Layout:
    """Names of letters, digits, "_" and "-", each once among bodies and once among joints and what acts on these."""
    bodies = _plain((body.name for body in layout.bodies), "link", {BASE})
    forces = (one.name for one in (*layout.pulls, *layout.ratios))
    joints = _plain((joint.name for joint in layout.joints), "joint", set())
    acting = _plain(forces, "force", set())
    of = {**bodies, BASE: BASE}
    changed = [
        f"`{old}` is called `{new}`" for names in (bodies, joints, acting) for old, new in names.items() if old != new
    ]
    if changed:
        layout = layout.remarked(f"Names have letters, digits, _ and - only, each once: {', '.join(changed)}.")
    return replace(
        layout,
        bodies=tuple(replace(body, name=bodies[body.name]) for body in layout.bodies),
        joints=tuple(
            replace(one, name=joints[one.name], parent=of[one.parent], child=of[one.child]) for one in layout.joints
        ),
        pulls=tuple(
            replace(one, name=acting[one.name], bodies=(of[one.bodies[0]], of[one.bodies[1]])) for one in layout.pulls
        ),
        ratios=tuple(
            replace(one, name=acting[one.name], joints=(joints[one.joints[0]], joints[one.joints[1]]))
            for one in layout.ratios
        ),
    )


def _plain(names: Iterable[str], word: str, reserved: set[str]) -> dict[str, str]:
    """{name: a plain one}, each once, for names that are each once."""
    found, taken = {}, set(reserved)
    for name in names:
        plain = re.sub(r"[^A-Za-z0-9_-]", "_", name)[:60]
        plain = plain if any(letter.isalnum() for letter in plain) else word
        unique, n = plain, 2
        while unique in taken:
            unique, n = f"{plain}_{n}", n + 1
        found[name] = unique
        taken.add(unique)
    return found


def _as_tree(layout: Layout) -> Layout:
    """Every body reached from the base by one path of joints, in the order of the file where it can be; all others of
    its joints cut; bodies that nothing joins to the base free."""
    reached, tree = {BASE}, []
    left = [joint for joint in layout.joints if not joint.cut]
    bodies = [body.name for body in layout.bodies]
    added: list[str] = []
    while len(reached) <= len(bodies):
        forward = next((one for one in left if one.parent in reached and one.child not in reached), None)
        backward = next((one for one in left if one.child in reached and one.parent not in reached), None)
        if forward is not None or backward is not None:
            one = forward or backward
            assert one is not None
            left.remove(one)
            joint = one if forward else _reversed(one)
        else:
            name = next(name for name in bodies if name not in reached)
            joint, added = _free(layout, name), [*added, name]
        reached.add(joint.child)
        tree.append(joint)
    if added:
        words = "is" if len(added) == 1 else "are"
        layout = layout.remarked(f"Nothing joins {', '.join(added)} to the base: {words} free to move there.")
    cut = [replace(one, cut=True, start=()) for one in left if one.kind != "free"]
    cut += [replace(one, start=()) for one in layout.joints if one.cut]
    order = {joint.name: n for n, joint in enumerate(layout.joints)}
    found = [*tree, *map(_away_from_base, cut)]
    return replace(layout, joints=tuple(sorted(found, key=lambda one: order.get(one.name, len(order)))))


def _free(layout: Layout, name: str) -> Connection:
    """A free joint of a body that has none."""
    pose, names = layout.pose(name), {joint.name for joint in layout.joints}
    called = f"{name}_free"
    while called in names:
        called += "_"
    return Connection(called, "free", BASE, name, at_origin(), at_origin(), start=coordinates_of("free", pose))


def _away_from_base(joint: Connection) -> Connection:
    """The base is no child."""
    return _reversed(joint) if joint.child == BASE else joint


def _reversed(joint: Connection) -> Connection:
    """The same joint with parent and child exchanged; coordinates keep their signs where the kind has one of each."""
    turn = Frame(_TURNED.get(joint.kind, np.eye(3)), np.zeros(3))
    seat, bore = joint.bore.then(turn), joint.seat.then(turn)
    start = joint.start
    if joint.start and joint.kind not in ("revolute", "prismatic", "cylindrical"):
        apart = turn.inverse().then(motion_frame(joint.kind, joint.start).inverse()).then(turn)
        start = coordinates_of(joint.kind, apart)
    springs = joint.springs
    if joint.kind == "universal":
        springs = tuple(
            replace(one, motion={"R_y": "R_z", "R_z": "R_y"}[one.motion], rest=-one.rest, preload=-one.preload)
            for one in springs
        )
    return replace(joint, parent=joint.child, child=joint.parent, seat=seat, bore=bore, start=start, springs=springs)


def _framed(layout: Layout) -> Layout:
    """Frames of links and joints by what the module says."""
    size = _size(layout)
    frames = {body.name: _link_frame(layout, body, size) for body in layout.bodies}
    bodies = tuple(_moved(body, frames[body.name][0], frames[body.name][1]) for body in layout.bodies)
    moved = {body.name: body.pose for body in bodies} | {BASE: at_origin()}
    joints, shifts = [], {}
    for joint in layout.joints:
        left, right = layout.sides(joint)
        joints.append(
            replace(joint, seat=left.seen_from(moved[joint.parent]), bore=right.seen_from(moved[joint.child]))
        )
    for i, joint in enumerate(joints):
        joints[i], shifts[joint.name] = _with_near_axes(joint)
    pulls = tuple(
        replace(one, points=tuple(
            moved[name].inverse().then(layout.pose(name)).then(Frame(np.eye(3), point)).position
            for name, point in zip(one.bodies, one.points)
        ))
        for one in layout.pulls
    )  # fmt: skip
    ratios = tuple(
        replace(one, offset=one.offset + shifts[one.joints[1]] - one.ratio * shifts[one.joints[0]])
        for one in layout.ratios
    )
    return replace(layout, bodies=bodies, joints=tuple(joints), pulls=pulls, ratios=ratios, framed=True)


def _size(layout: Layout) -> float:
    """The size of the mechanism [m]: the largest distance of a joint or a centre of mass from the mean of all."""
    places = [side.position for joint in layout.joints for side in layout.sides(joint)]
    places += [body.pose.position + body.pose.rotation @ body.centre for body in layout.bodies]
    away = np.array(places) - np.mean(places, axis=0)
    return float(np.linalg.norm(away, axis=1).max())


def _link_frame(layout: Layout, body: Body, size: float) -> tuple[Frame, float]:
    """A frame in global axes and a length [m] of a link."""
    carrying = next(joint for joint in layout.joints if joint.child == body.name and not joint.cut)
    origin = layout.sides(carrying)[1].position if carrying.kind != "free" else body.pose.position
    others = [layout.sides(one)[0] for one in layout.joints if one.parent == body.name]
    others += [layout.sides(one)[1] for one in layout.joints if one.child == body.name and one is not carrying]
    away = max((side.position - origin for side in others), key=np.linalg.norm, default=np.zeros(3))
    length, centre = float(np.linalg.norm(away)), body.pose.position + body.pose.rotation @ body.centre - origin
    if length <= _NEAR * size:
        away, length = centre, 2.0 * float(np.linalg.norm(centre))
    if length <= _NEAR * size:
        away, length = body.pose.rotation[:, 0], _own_size(body)
    near = next((axis for axis in _axes_at(layout, body.name) if _across(axis, away)), None)
    if near is None:
        columns = (body.pose.rotation[:, i] for i in (1, 2, 0))
        near = next(axis for axis in columns if _across(axis, away))
    return Frame(axes_from(away, near, (0, 1)).rotation, origin), length


def _axes_at(layout: Layout, name: str) -> list[Float[np.ndarray, "3"]]:
    """Axes of hinges at a link in global axes, that of the joint that carries it first."""
    kinds = ("revolute", "cylindrical", "universal", "planar")
    joints = [one for one in layout.joints if name in (one.parent, one.child) and one.kind in kinds]
    joints.sort(key=lambda one: (one.child != name, one.cut))
    return [layout.sides(one)[0].rotation[:, 1] for one in joints]


def _across(axis: np.ndarray, away: np.ndarray) -> bool:
    return float(np.linalg.norm(np.cross(axis, away))) > 0.1 * float(np.linalg.norm(away))


def _own_size(body: Body) -> float:
    """A length [m] of a body of which only its inertia tells the size: that of a cube."""
    if body.mass > 0.0 and np.trace(body.inertia) > 0.0:
        return float(np.sqrt(2.0 * np.trace(body.inertia) / body.mass))
    return 0.1


def _moved(body: Body, pose: Frame, length: float) -> Body:
    """A body in another frame of its own."""
    turn = pose.rotation.T @ body.pose.rotation
    centre = pose.rotation.T @ (body.pose.then(Frame(np.eye(3), body.centre)).position - pose.position)
    return replace(body, pose=pose, centre=centre, inertia=turn @ body.inertia @ turn.T, length=length)


def _with_near_axes(joint: Connection) -> tuple[Connection, float]:
    """A joint whose frames are turned about its axis to axes near those of its links, and by how much its angle [rad]
    is larger then."""
    axis = _AXIS.get(joint.kind)
    if axis is None:
        return joint, 0.0
    turns = [_turn_to_link(side, axis) for side in (joint.seat, joint.bore)]
    if joint.kind == "prismatic":
        turns[1] = turns[0]
    seat, bore = (
        side.then(Frame(rotation_about(axis, turn), np.zeros(3))) for side, turn in zip((joint.seat, joint.bore), turns)
    )
    shift = turns[1] - turns[0] if joint.kind != "prismatic" else 0.0
    start = joint.start
    if start and joint.kind != "prismatic":
        # Angles between links are told from -180 to 180 deg: the file counts from its own zero.
        whole = 2.0 * np.pi * np.round((start[0] + shift) / (2.0 * np.pi)) if abs(start[0]) <= np.pi else 0.0
        shift -= whole
        start = (start[0] + shift, *start[1:])
    springs = tuple(replace(one, rest=one.rest + shift) if one.motion[0] == "R" else one for one in joint.springs)
    return replace(joint, seat=seat, bore=bore, start=start, springs=springs), float(shift)


def _turn_to_link(side: Frame, axis: int) -> float:
    """Angle [rad] about the axis of a joint's frame on a link to the frame that is as near as possible to the link's:
    of hinges by x, of slides by y, or by z where the joint's axis is along that."""
    preferred = 0 if axis == 1 else 1
    along = side.rotation[:, axis]
    near = preferred if np.linalg.norm(np.cross(along, np.eye(3)[preferred])) > 0.1 else 2
    apart = side.rotation.T @ axes_from(along, np.eye(3)[near], (axis, near)).rotation
    i, j = (axis + 1) % 3, (axis + 2) % 3
    turn = float(np.arctan2(apart[j, i], apart[i, i]))
    return turn if abs(turn) > _ROUNDING else 0.0
