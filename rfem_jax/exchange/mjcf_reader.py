"""MJCF as a layout, read by the package `mujoco` itself: its defaults, units, meshes and inertias are MuJoCo's affair.

Place in the pipeline: **mjcf_reader** -> layout. Needs the extra `mujoco`.

The position is that of `qpos0`. Bodies that cannot move belong to the base. `connect` constraints are ball joints, two
of them between the same bodies a hinge through both anchors, `weld` ones are fixed joints, all cut. Files that
`mjcf_writer` wrote have sites with the frames of their joints, which are taken.
"""

from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from rfem_jax.description.basics.errors import InputError
from rfem_jax.exchange.layout import BASE, Along, Body, Connection, Layout, Pull, Ratio, coordinates_of, motion_frame
from rfem_jax.exchange.rigid_frames import Frame, at_origin, axes_from, rotation_about, rotation_of_quaternion

SEAT, BORE, LENGTH = ".seat", ".bore", "length."  # names that the writer adds to those of joints and bodies
_PERPENDICULAR = 1e-6
_NEAR = 1e-6  # m, between axes and anchors that count as one


@dataclass
class _Source:
    """A compiled model with names and poses of its bodies; `base`: those that cannot move."""

    module: Any
    model: Any
    poses: list[Frame]
    base: set[int]
    remarks: list[str] = field(default_factory=list)

    def name(self, kind: str, number: int) -> str:
        found = self.module.mj_id2name(self.model, getattr(self.module.mjtObj, f"mjOBJ_{kind}"), number)
        return found or f"{kind.lower()}{number}"

    def body(self, number: int) -> str:
        return BASE if number in self.base else self.name("BODY", number)

    def pose(self, number: int) -> Frame:
        """Of a body as the layout has it."""
        return at_origin() if number in self.base else self.poses[number]

    def site(self, number: int) -> tuple[int, Frame]:
        """The body of a site, and its frame on that."""
        frame = Frame(rotation_of_quaternion(self.model.site_quat[number]), np.array(self.model.site_pos[number]))
        return int(self.model.site_bodyid[number]), frame

    def named_site(self, name: str) -> Frame | None:
        """The frame of a site in global axes, if there is one of this name."""
        number = self.module.mj_name2id(self.model, self.module.mjtObj.mjOBJ_SITE, name)
        if number < 0:
            return None
        body, frame = self.site(number)
        return self.poses[body].then(frame)


def read_mjcf(path: Path) -> Layout:
    """The layout of an MJCF file. Raises InputError, also where `mujoco` is not installed."""
    try:
        mujoco = import_module("mujoco")
    except ImportError:
        raise InputError(
            "The package mujoco must be there to read MJCF, but cannot be imported; install it with "
            '`pip install "rfem_jax[mujoco]"`.'
        ) from None
    model, warnings = _compiled(mujoco, path)
    source = _Source(mujoco, model, _poses(model), _static(model), warnings)
    if any(source.name("BODY", i) == BASE for i in range(1, model.nbody) if i not in source.base):
        raise InputError("No body of the file may be called `base`, which names what stands still; rename it.")
    bodies = tuple(_body(source, i) for i in range(1, model.nbody) if i not in source.base)
    joints = [_joint(source, i) for i in range(1, model.nbody) if i not in source.base]
    joints += _closures(source)
    framed = all(source.named_site(one.name + SEAT) for one in joints) and all(one.length for one in bodies)
    gravity = np.array(model.opt.gravity)
    if model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_GRAVITY:
        gravity = np.zeros(3)
    found = Layout(path.stem, bodies, tuple(joints), gravity, _pulls(source), _ratios(source), framed=framed)
    return found.remarked(*source.remarks, *_left_out(source))


def _compiled(mujoco: Any, path: Path) -> tuple[Any, list[str]]:
    """The model of a file, and what MuJoCo warns of, which it would write into a file of its own. Raises InputError."""
    warnings: list[str] = []
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda text: warnings.append(f"MuJoCo warns: {' '.join(str(text).split())[:200]}"))
    try:
        return mujoco.MjModel.from_xml_path(str(path)), warnings
    except Exception as problem:  # of its parser and its compiler, which raise several kinds
        reason = " ".join(str(problem).split())[:200]
        raise InputError(f"MuJoCo must be able to compile the file, but says: {reason}; correct it.") from None
    finally:
        mujoco.set_mju_user_warning(before)


def _poses(model: Any) -> list[Frame]:
    poses = [at_origin()]
    for i in range(1, model.nbody):
        local = Frame(rotation_of_quaternion(model.body_quat[i]), np.array(model.body_pos[i]))
        poses.append(poses[model.body_parentid[i]].then(local))
    return poses


def _static(model: Any) -> set[int]:
    found = {0}
    for i in range(1, model.nbody):
        if model.body_jntnum[i] == 0 and int(model.body_parentid[i]) in found:
            found.add(i)
    return found


def _body(source: _Source, i: int) -> Body:
    model, name = source.model, source.name("BODY", i)
    axes = rotation_of_quaternion(model.body_iquat[i])
    number = source.module.mj_name2id(model, source.module.mjtObj.mjOBJ_NUMERIC, LENGTH + name)
    length = float(model.numeric_data[model.numeric_adr[number]]) if number >= 0 else None
    inertia = (axes * model.body_inertia[i]) @ axes.T
    return Body(name, source.poses[i], float(model.body_mass[i]), np.array(model.body_ipos[i]), inertia, length)


def _joint(source: _Source, i: int) -> Connection:
    """What carries a body: all joints of it together."""
    model, mjt = source.model, source.module.mjtJoint
    first, count = int(model.body_jntadr[i]), int(model.body_jntnum[i])
    numbers = list(range(first, first + count))
    words = {mjt.mjJNT_HINGE: "h", mjt.mjJNT_SLIDE: "s", mjt.mjJNT_BALL: "b", mjt.mjJNT_FREE: "f"}
    kinds = "".join(words[mjt(model.jnt_type[j])] for j in numbers)
    name = source.name("JOINT", first) if count else f"{source.name('BODY', i)}_fixed"
    kind, bore, start, order = _kind(source, name, kinds, numbers)
    pose, parent = source.poses[i], int(model.body_parentid[i])
    right = source.named_site(name + BORE) or pose.then(bore)
    left = source.named_site(name + SEAT) or right.then(motion_frame(kind, start).inverse())
    if kind in ("spherical", "free", "planar", "fixed") or source.named_site(name + SEAT):
        start = start if kind in ("revolute", "prismatic") else coordinates_of(kind, right.seen_from(left))
    springs = tuple(_spring(source, j, motion) for j, motion in zip(numbers, order) if motion)
    if not order and any(model.jnt_stiffness[j] or model.dof_damping[model.jnt_dofadr[j]] for j in numbers):
        source.remarks.append(f"The springs and dampers of joint {name}, of the kind {kind}.")
    return Connection(
        name,
        kind,
        source.body(parent),
        source.body(i),
        left.seen_from(source.pose(parent)),
        right.seen_from(pose),
        start=start,
        springs=tuple(one for one in springs if one is not None),
    )


def _kind(
    source: _Source, name: str, kinds: str, numbers: list[int]
) -> tuple[str, Frame, tuple[float, ...], tuple[str, ...]]:
    """Kind; frame on the child; coordinates; the motion of each joint of MuJoCo, () where these have none."""
    model = source.model
    axes = [np.array(model.jnt_axis[j]) for j in numbers]
    anchors = [np.array(model.jnt_pos[j]) for j in numbers]
    values = [float(model.qpos0[model.jnt_qposadr[j]]) for j in numbers]

    def at(axis: np.ndarray, near: np.ndarray, places: tuple[int, int], anchor: np.ndarray) -> Frame:
        return Frame(axes_from(axis, near, places).rotation, anchor)

    x, y = np.eye(3)[:2]
    if kinds == "":
        return "fixed", at_origin(), (), ()
    if kinds == "h":
        return "revolute", at(axes[0], x, (1, 0), anchors[0]), (values[0],), ("R_y",)
    if kinds == "s":
        return "prismatic", at(axes[0], y, (0, 1), anchors[0]), (values[0],), ("T_x",)
    if kinds == "b":
        return "spherical", Frame(np.eye(3), anchors[0]), (0.0,) * 3, ()
    if kinds in ("f", "sssb"):
        return "free", at_origin(), (0.0,) * 6, ()
    if kinds in ("hs", "sh") and axes[0] @ axes[1] > 1.0 - _PERPENDICULAR:
        turn, shift = (0, 1) if kinds == "hs" else (1, 0)
        order = tuple("R_y" if k == turn else "T_y" for k in range(2))
        return "cylindrical", at(axes[turn], x, (1, 0), anchors[turn]), (values[turn], values[shift]), order
    square = all(abs(axes[a] @ axes[b]) < _PERPENDICULAR for a in range(len(axes)) for b in range(a))
    if kinds == "hh" and square and np.linalg.norm(anchors[0] - anchors[1]) < _NEAR:
        found = at(axes[1], axes[0], (2, 1), anchors[1])
        return "universal", found.then(Frame(rotation_about(2, values[1]), np.zeros(3))), (*values,), ("R_y", "R_z")
    if kinds == "ssh" and square:
        return "planar", at(axes[2], axes[0], (1, 0), anchors[2]), (0.0,) * 3, ()
    words = {"h": "hinge", "s": "slide", "b": "ball", "f": "free"}
    listed = ", ".join(words[one] for one in kinds)
    raise InputError(
        f"The joints of one body must be those of a kind that a study has, but `{name}` and those beside it are "
        f"{listed}; put a body with a small mass between them."
    )


def _spring(source: _Source, j: int, motion: str) -> Along | None:
    model, name = source.model, source.name("JOINT", j)
    dof, at = model.jnt_dofadr[j], model.jnt_qposadr[j]
    stiffness, damping = float(model.jnt_stiffness[j]), float(model.dof_damping[dof])
    polynomials = [getattr(model, key, None) for key in ("jnt_stiffnesspoly", "dof_dampingpoly")]
    if any(np.any(one[k]) for one, k in zip(polynomials, (j, dof)) if one is not None):
        source.remarks.append(f"What is not linear of the spring or damper of joint {name}.")
    if model.dof_armature[dof]:
        source.remarks.append(f"The armature of joint {name}.")
    if model.dof_frictionloss[dof]:
        source.remarks.append(f"The friction of joint {name} (`rfem-jax keys forces` has joint_friction).")
    if model.jnt_limited[j]:
        source.remarks.append(f"The limits of joint {name}.")
    if min(stiffness, damping) < 0.0:
        raise InputError(f"The spring and damper of joint `{name}` must not be negative, but are; correct them.")
    return Along(motion, stiffness, damping, float(model.qpos_spring[at])) if stiffness or damping else None


@dataclass
class _Ends:
    """A constraint between two bodies: name, whether a weld, bodies, frames on them."""

    name: str
    weld: bool
    bodies: tuple[int, int]
    frames: tuple[Frame, Frame]


def _closures(source: _Source) -> list[Connection]:
    """The cut joints."""
    pairs: dict[tuple[int, int], list[_Ends]] = {}
    for e in range(source.model.neq):
        ends = _ends(source, e)
        if ends is not None:
            pairs.setdefault(ends.bodies, []).append(ends)
    found = []
    for of_pair in pairs.values():
        points = [one for one in of_pair if not one.weld]
        found += [_cut(source, "fixed", one, one.frames) for one in of_pair if one.weld]
        if len(points) == 2:
            found.append(_hinge(source, points[0], points[1]))
        else:
            found += [_cut(source, "spherical", one, one.frames) for one in points]
    return found


def _hinge(source: _Source, one: _Ends, other: _Ends) -> Connection:
    """Two points held are a hinge through them."""
    frames = []
    for first, second in zip(one.frames, other.frames):
        along = second.position - first.position
        if np.linalg.norm(along) < _NEAR:
            raise InputError(
                f"The constraints `{one.name}` and `{other.name}` must hold two points, but hold one twice."
            )
        frames.append(Frame(axes_from(along, np.eye(3)[0], (1, 0)).rotation, first.position))
    return _cut(source, "revolute", one, (frames[0], frames[1]))


def _cut(source: _Source, kind: str, one: _Ends, frames: tuple[Frame, Frame]) -> Connection:
    sides = []
    for ending, body, frame in zip((SEAT, BORE), one.bodies, frames):
        placed = source.named_site(one.name + ending) or source.poses[body].then(frame)
        sides.append(placed.seen_from(source.pose(body)))
    parent, child = (source.body(body) for body in one.bodies)
    return Connection(one.name, kind, parent, child, sides[0], sides[1], cut=True)


def _ends(source: _Source, e: int) -> _Ends | None:
    """A connect or weld constraint; None with a remark for what is none, or does nothing."""
    model, module = source.model, source.module
    kind, name = module.mjtEq(model.eq_type[e]), source.name("EQUALITY", e)
    if kind == module.mjtEq.mjEQ_JOINT:
        return None
    if kind not in (module.mjtEq.mjEQ_CONNECT, module.mjtEq.mjEQ_WELD):
        source.remarks.append(f"The constraint {name}, which is no connect, weld or joint.")
        return None
    if not model.eq_active0[e]:
        source.remarks.append(f"The constraint {name}, which is not active.")
        return None
    weld = kind == module.mjtEq.mjEQ_WELD
    objects, data = (int(model.eq_obj1id[e]), int(model.eq_obj2id[e])), np.array(model.eq_data[e])
    if model.eq_objtype[e] == module.mjtObj.mjOBJ_SITE:
        (one, left), (other, right) = (source.site(number) for number in objects)
        bodies, frames = (one, other), (left, right)
    elif weld:
        turn = rotation_of_quaternion(data[6:10]) if np.any(data[6:10]) else np.eye(3)
        bodies, frames = objects, (Frame(turn, data[3:6]), Frame(np.eye(3), data[:3]))
    else:
        bodies, frames = objects, (Frame(np.eye(3), data[:3]), Frame(np.eye(3), data[3:6]))
    if source.body(bodies[0]) == source.body(bodies[1]):
        source.remarks.append(f"The constraint {name}, which joins a body to itself.")
        return None
    return _Ends(name, weld, bodies, frames)


def _ratios(source: _Source) -> tuple[Ratio, ...]:
    """Linear constraints between two joints."""
    model, module, found = source.model, source.module, []
    single = int(module.mjtJoint.mjJNT_HINGE), int(module.mjtJoint.mjJNT_SLIDE)
    for e in range(model.neq):
        if model.eq_type[e] != module.mjtEq.mjEQ_JOINT:
            continue
        name, data = source.name("EQUALITY", e), np.array(model.eq_data[e])
        second, first = int(model.eq_obj1id[e]), int(model.eq_obj2id[e])
        plain = model.eq_active0[e] and first >= 0 and data[1] and not np.any(data[2:5])
        plain = plain and all(
            model.jnt_type[j] in single and model.body_jntnum[model.jnt_bodyid[j]] == 1 for j in (first, second)
        )
        if not plain:
            source.remarks.append(f"The constraint {name} between joints, which is not linear, not active, or of one.")
            continue
        a, b = (float(model.qpos0[model.jnt_qposadr[j]]) for j in (first, second))
        names = source.name("JOINT", first), source.name("JOINT", second)
        found.append(Ratio(name, names, float(data[1]), float(b + data[0] - data[1] * a)))
    return tuple(found)


def _pulls(source: _Source) -> tuple[Pull, ...]:
    """Springs and dampers of tendons straight from one site to another."""
    model, module, found = source.model, source.module, []
    for t in range(model.ntendon):
        name, at = source.name("TENDON", t), int(model.tendon_adr[t])
        ends = range(at, at + int(model.tendon_num[t]))
        rest, numbers = np.array(model.tendon_lengthspring[t]), (model.tendon_stiffness[t], model.tendon_damping[t])
        straight = len(ends) == 2 and all(model.wrap_type[k] == module.mjtWrap.mjWRAP_SITE for k in ends)
        polynomials = [getattr(model, key, None) for key in ("tendon_stiffnesspoly", "tendon_dampingpoly")]
        linear = not any(one is not None and np.any(one[t]) for one in polynomials)
        if not (straight and linear and any(numbers) and rest[0] == rest[1]):
            source.remarks.append(f"The tendon {name}, which is no linear spring or damper between two sites.")
            continue
        sites = [source.site(int(model.wrap_objid[k])) for k in ends]
        points = [source.poses[body].then(frame).seen_from(source.pose(body)).position for body, frame in sites]
        bodies = source.body(sites[0][0]), source.body(sites[1][0])
        found.append(Pull(name, bodies, (points[0], points[1]), float(numbers[0]), float(numbers[1]), float(rest[0])))
    return tuple(found)


def _left_out(source: _Source) -> list[str]:
    """Sentences on what else moves or holds something."""
    model = source.model
    counts = {
        "The actuators": model.nu,
        "The keyframes: the start is that of qpos0": model.nkey,
        "Flexible bodies": model.nflex,
        "The compensation of gravity of bodies": int(np.count_nonzero(model.body_gravcomp)),
        "Contacts: bodies pass through each other": int(
            np.any((model.geom_contype != 0) & (model.geom_conaffinity != 0))
        )
        if model.ngeom
        else 0,
        "The medium (density, viscosity, wind)": int(
            bool(model.opt.density or model.opt.viscosity or np.any(model.opt.wind))
        ),
        "The shapes and masses of bodies that stand still": len(source.base) - 1,
    }
    return [f"{words}." for words, count in counts.items() if count]
