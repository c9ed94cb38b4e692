"""A layout as a study file with comments.

Place in the pipeline: a reader's layout, completed by `laying` -> **study_writer** -> the user's study file.
"""

import json
from collections.abc import Iterable

import numpy as np

from rfem_jax.description.basics.joint_kinds import KINDS
from rfem_jax.description.study_file.schema import LINE
from rfem_jax.exchange.layout import BASE, Along, Body, Connection, Layout, Pull, Ratio
from rfem_jax.exchange.rigid_frames import angles_of
from rfem_jax.text_layout import wrap_lines

_COLUMNS = 114  # of comments, without their marks
_NOTHING = 1e-13  # below which a number is rounding


def study_text(layout: Layout, source: str, name: str) -> str:
    """The study of a layout.

    **Arguments:** `source`: what it was made of, in a word or two; `name`: of the study's file.
    """
    parts = [
        *_head(layout, source, name),
        *("\n".join(_link(body)) for body in layout.bodies),
        "# Each link is the child of one joint, which places it; `cut = true` closes a loop.",
        *("\n".join(_joint(joint, layout)) for joint in layout.joints),
        *("\n".join(_spring(joint, one, n)) for joint in layout.joints for n, one in enumerate(joint.springs)),
        *("\n".join(_pull(one)) for one in layout.pulls),
        *("\n".join(_ratio(one)) for one in layout.ratios),
        *_tail(layout),
    ]
    return "\n\n".join(part for part in parts if part) + "\n"


def _comment(text: str) -> str:
    """Lines of a comment; what may not stand in one is left out."""
    printable = "".join(letter if letter.isprintable() else "?" for letter in text)
    return "\n".join(f"# {line}" for line in wrap_lines(printable, width=_COLUMNS).splitlines())


def _head(layout: Layout, source: str, name: str) -> list[str]:
    lines = [
        LINE,
        _comment(f"Imported from {source}. What is understood, and all loads:"),
        f"#\n#     rfem-jax check {_comment(name)[2:]}\n#     rfem-jax run {_comment(name)[2:]} --out results\n#",
    ]
    if layout.remarks:
        lines += [_comment("Not taken over as it is there, or changed:"), "#"]
        lines += [_item(remark) for remark in layout.remarks]
        lines += ["#"]
    else:
        lines += ["# Everything that moves was taken over.", "#"]
    lines += [
        "# All links are rigid: exchange `body` for `section` and `material` (`rfem-jax keys links`) to make one bend.",
        "# SI units and radians; strings have their unit with them.",
    ]
    gravity = f"[mechanism]\ngravity = {_numbers(layout.gravity)}"
    return ["\n".join(lines), f"title = {_string(layout.title)}", gravity]


def _item(remark: str) -> str:
    first, *rest = _comment(remark).splitlines()
    return "\n".join([f"# - {first[2:]}", *(f"#   {line[2:]}" for line in rest)])


def _link(body: Body) -> list[str]:
    tensor = np.where(np.abs(body.inertia) < 1e-12 * np.abs(body.inertia).max(), 0.0, body.inertia)
    diagonal = not np.any(tensor - np.diag(np.diag(tensor)))
    if diagonal:
        inertia = _numbers(np.diag(tensor))
    else:
        upper = np.triu(tensor)
        inertia = f"[{', '.join(map(_numbers, upper + upper.T - np.diag(np.diag(upper))))}]"
    return [
        "[[mechanism.links]]",
        f"name = {_string(body.name)}",
        f"length = {_number(body.length or 0.1)}",
        "[mechanism.links.body]",
        f"mass = {_number(body.mass)}",
        f"centre = {_numbers(body.centre)}",
        f"inertia = {inertia}",
    ]


def _joint(joint: Connection, layout: Layout) -> list[str]:
    lines = ["[[mechanism.joints]]", f"name = {_string(joint.name)}"]
    if joint.kind != "revolute":
        lines.append(f'kind = "{joint.kind}"')
    lines += [f"parent = {_string(joint.parent)}", f"child = {_string(joint.child)}"]
    if joint.cut:
        lines.append("cut = true")
    lengths = {body.name: body.length or 0.1 for body in layout.bodies}
    end = np.zeros(3) if joint.parent == BASE else np.array([lengths[joint.parent], 0.0, 0.0])
    child_end = np.array([lengths[joint.child], 0.0, 0.0]) if joint.cut else np.zeros(3)
    for field, frame, usual in (("", joint.seat, end), ("child_", joint.bore, child_end)):
        if not np.allclose(frame.position, usual, rtol=0.0, atol=_NOTHING):
            lines.append(f"{field}position = {_numbers(frame.position)}")
        angles = angles_of(frame.rotation)
        if np.abs(angles).max() > _NOTHING:
            lines.append(f"{field}orientation = {_numbers(angles)}")
    if joint.start and np.abs(joint.start).max() > _NOTHING:
        lines += _start(joint)
    return lines


def _start(joint: Connection) -> list[str]:
    kind = KINDS[joint.kind]
    if kind.angles > 1 or kind.displacements > 1:
        return [f"start = {_numbers(joint.start)}"]
    names = ("angle" if freedom.rotation else "displacement" for freedom in kind.freedoms)
    return [f"{name} = {_number(value)}" for name, value in zip(names, joint.start, strict=True)]


def _spring(joint: Connection, one: Along, number: int) -> list[str]:
    lines = [
        "[[mechanism.forces]]",
        f"name = {_string(f'{joint.name}_spring' + (f'_{number + 1}' if number else ''))}",
        'kind = "joint_spring"',
        f"joint = {_string(joint.name)}",
    ]
    if len(KINDS[joint.kind].motions) > 1:
        lines.append(f'motion = "{one.motion}"')
    given = {"stiffness": one.stiffness, "damping": one.damping, "rest": one.rest, "preload": one.preload}
    return [*lines, *(f"{name} = {_number(value)}" for name, value in given.items() if value)]


def _pull(one: Pull) -> list[str]:
    return [
        "[[mechanism.springs]]",
        f"name = {_string(one.name)}",
        f"links = [{', '.join(map(_string, one.bodies))}]",
        f"points = [{', '.join(map(_numbers, one.points))}]",
        f"stiffness = {_number(one.stiffness)}",
        f"damping = {_number(one.damping)}",
        f"free_length = {_number(one.free_length)}",
        *([f"preload = {_number(one.preload)}"] if one.preload else []),
    ]


def _ratio(one: Ratio) -> list[str]:
    return [
        "[[mechanism.couplings]]",
        f"name = {_string(one.name)}",
        f"joints = [{', '.join(map(_string, one.joints))}]",
        f"ratio = {_number(one.ratio)}",
        f"offset = {_number(one.offset)}",
    ]


def _tail(layout: Layout) -> list[str]:
    tree = next((one for one in layout.joints if not one.cut and one.kind in ("revolute", "prismatic")), None)
    kind = {"revolute": ("prescribed_rate", 'rate = "60 rpm"'), "prismatic": ("prescribed_speed", 'speed = "0.1 m/s"')}
    driven = [] if tree is None else [
        "# What moves it (`rfem-jax keys drive`); without a drive it is let go as it stands.\n"
        f"#\n# [drive]\n# joint = {_string(tree.name)}\n"
        f'# kind = "{kind[tree.kind][0]}"\n# {kind[tree.kind][1]}'
    ]  # fmt: skip
    last = next((one for one in reversed(layout.joints) if one.kind != "free"), None)
    error = {"spherical": ("d_y", "0.1 mm"), "planar": ("d_y", "0.1 mm")}
    errors = [] if last is None else [
        "# Errors of assembly (`rfem-jax keys cases`); those that are not named are zero.\n#\n"
        '# [[cases]]\n# name = "askew"\n# errors = '
        '{{ "{}.{}" = "{}" }}'.format(last.name, *error.get(last.kind, ("delta_z", "0.1 deg")))
    ]  # fmt: skip
    simulation = '[simulation]\nduration = 1.0                      # s\nmethod = "auto"\naccuracy = 1e-3'
    return [*driven, simulation, '[[cases]]\nname = "perfect"', *errors]


def _string(text: str) -> str:
    """A basic string of TOML."""
    return json.dumps("".join(letter if letter.isprintable() else "?" for letter in text), ensure_ascii=False)


def _number(value: float) -> str:
    """A number with 15 digits, with a point so that TOML has a float."""
    value = 0.0 if abs(value) < _NOTHING * 1e-3 else float(value)
    text = f"{value:.15g}"
    return text if any(sign in text for sign in ".en") else f"{text}.0"


def _numbers(values: Iterable[float]) -> str:
    found = [float(value) for value in values]
    largest = max(map(abs, found), default=0.0)
    return f"[{', '.join(_number(value if abs(value) > 1e-15 * largest else 0.0) for value in found)}]"
