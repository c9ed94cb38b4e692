"""The plain table: joints and bodies of a mechanism with their frames, as spreadsheets and CAD programs write it.

Place in the pipeline: **frame_table** -> layout, and back.

A row is a joint, a body, or gravity (`kind`). All places and directions are in global axes, with the mechanism where it
starts; names of columns end with their units.

kind "body": the mass and its `centre`; the inertia about the centre in global axes, `xy` being minus the integral of
x y; the link's frame by its origin `x`, `y`, `z`, the direction `axis` along it and `across` for its y, all of these
from the joints where they are left out.
kinds of joints: parent, child; centre `x`, `y`, `z`, direction of the `axis` (of a hinge, of a slide, normal of a
plane; y of all others) and `across` (x of the frame, y of that of a slide); the same with `child_` of the frame on the
child, where it is another, as a hinge has turned or a loop is open. `cut` closes a loop.
kind "gravity": `axis` in m/s^2.
"""

import csv
import io
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from rfem_jax.description.basics.errors import InputError, suggestion
from rfem_jax.description.basics.joint_kinds import KINDS, OTHER_WORDS
from rfem_jax.exchange.layout import BASE, Body, Connection, Layout, coordinates_of
from rfem_jax.exchange.rigid_frames import Frame, axes_from

_BODY, _GRAVITY = "body", "gravity"
_WORDS = ("name", "kind", "parent", "child", "cut")
_PLACES = ("x", "y", "z", "child_x", "child_y", "child_z", "centre_x", "centre_y", "centre_z", "length")
_DIRECTIONS = tuple(
    f"{side}{which}_{axis}" for side in ("", "child_") for which in ("axis", "across") for axis in "xyz"
)
_MOMENTS = ("xx", "yy", "zz", "xy", "xz", "yz")
_UNITS = {
    **{key: {"m": 1.0, "mm": 0.001, "cm": 0.01, "in": 0.0254} for key in _PLACES},
    "mass": {"kg": 1.0, "g": 1e-3},
    **{key: {"kgm2": 1.0, "kgmm2": 1e-06, "gmm2": 1e-09} for key in _MOMENTS},
}
COLUMNS = (
    "name", "kind", "parent", "child", "cut", "x_m", "y_m", "z_m", *_DIRECTIONS[:6], "child_x_m", "child_y_m",
    "child_z_m", *_DIRECTIONS[6:], "length_m", "mass_kg", "centre_x_m", "centre_y_m", "centre_z_m",
    *(f"{one}_kgm2" for one in _MOMENTS),
)  # fmt: skip


def table_text(layout: Layout, source: str) -> tuple[str, tuple[str, ...]]:
    """The table of a layout as CSV, with comments above it on what it does not hold, and these sentences."""
    file, left = io.StringIO(), (*layout.remarks, *_left_out(layout))
    file.write(f"# Frames of {source}; global axes, at the start\n")
    file.writelines(f"# not in this table: {remark}\n" for remark in left)
    writer = csv.DictWriter(file, COLUMNS, lineterminator="\n", restval="")
    writer.writeheader()
    writer.writerow({"name": _GRAVITY, "kind": _GRAVITY} | _named("axis_{}", layout.gravity))
    for body in layout.bodies:
        writer.writerow(_body_row(body))
    for joint in layout.joints:
        writer.writerow(_joint_row(layout, joint))
    return file.getvalue(), left


def _left_out(layout: Layout) -> list[str]:
    springs = [joint.name for joint in layout.joints if joint.springs]
    found = [f"The springs in {', '.join(springs)}."] if springs else []
    found += [f"The spring {one.name} between points." for one in layout.pulls]
    return found + [f"The coupling {one.name}." for one in layout.ratios]


def _named(pattern: str, values: Float[np.ndarray, "3"]) -> dict[str, str]:
    return {pattern.format(axis): _number(value) for axis, value in zip("xyz", values, strict=True)}


def _number(value: float) -> str:
    return repr(0.0 if abs(value) < 1e-16 else float(value))


def _body_row(body: Body) -> dict[str, str]:
    r = body.pose.rotation
    inertia = r @ body.inertia @ r.T
    moments = {f"{'xyz'[i]}{'xyz'[j]}_kgm2": _number(inertia[i, j]) for i in range(3) for j in range(i, 3)}
    return (
        {"name": body.name, "kind": _BODY, "mass_kg": _number(body.mass), "length_m": _number(body.length or 0.0)}
        | _named("{}_m", body.pose.position)
        | _named("axis_{}", r[:, 0])
        | _named("across_{}", r[:, 1])
        | _named("centre_{}_m", body.pose.position + r @ body.centre)
        | moments
    )


def _joint_row(layout: Layout, joint: Connection) -> dict[str, str]:
    row = {"name": joint.name, "kind": joint.kind, "parent": joint.parent, "child": joint.child}
    row["cut"] = "yes" if joint.cut else ""
    first, second = _places(joint.kind)
    for prefix, side in zip(("", "child_"), layout.sides(joint)):
        row |= _named(prefix + "{}_m", side.position)
        row |= _named(prefix + "axis_{}", side.rotation[:, first])
        row |= _named(prefix + "across_{}", side.rotation[:, second])
    return row


def _places(kind: str) -> tuple[int, int]:
    """Which axes of a joint's frame the columns `axis` and `across` are."""
    return (0, 1) if kind == "prismatic" else (1, 0)


def read_table(text: str, title: str) -> Layout:
    """The layout of a table. Raises InputError."""
    rows = _rows(text)
    bodies, joints, gravity, framed = [], [], None, []
    for number, row in rows:
        kind = row.get("kind", "").lower()
        kind = OTHER_WORDS.get(kind, kind)
        if kind == _GRAVITY:
            gravity = _required(row, "axis", number)
        elif kind == _BODY:
            body, known = _read_body(row, number)
            bodies.append(body)
            framed.append(known)
        elif kind in KINDS:
            joints.append((number, kind, row))
        else:
            known = (*KINDS, _BODY, _GRAVITY)
            raise InputError(
                f"Row {number} of the table: `kind` must be a kind of joint, {_BODY} or {_GRAVITY}, but is "
                f"{row.get('kind', '')!r}; {suggestion(kind, known)}"
            )
    _require_each_once("body", [body.name for body in bodies])
    _require_each_once("joint", [row["name"] for _, _, row in joints])
    layout = Layout(title, tuple(bodies), (), framed=bool(framed) and all(framed))
    layout = replace(layout, joints=tuple(_read_joint(layout, *one) for one in joints))
    return layout if gravity is None else replace(layout, gravity=gravity)


def _rows(text: str) -> list[tuple[int, dict[str, str]]]:
    """Number of the line and cells of every row, by names of columns."""
    numbered = [(n, line) for n, line in enumerate(text.splitlines(), 1) if line.strip() and not line.startswith("#")]
    if not numbered:
        raise InputError("The table must have a header and rows, but is empty; see `rfem-jax export --to frames`.")
    delimiter = max(",;\t", key=numbered[0][1].count)
    try:
        cells = list(csv.reader([line for _, line in numbered], delimiter=delimiter, strict=True))
    except csv.Error as error:
        raise InputError(f"The table must be CSV, but is not ({error}); save it again as CSV.") from None
    if len(cells) != len(numbered):
        raise InputError("The table must have one row a line, but a quoted cell goes over several; write it in one.")
    header = [cell.strip() for cell in cells[0]]
    for name in header:
        _require_column(name)
    twice = sorted({name for name in header if name and header.count(name) > 1})
    if twice:
        raise InputError(f"The table must have each column once, but has {twice[0]!r} twice; remove one.")
    if missing := [name for name in ("name", "kind") if name not in header]:
        raise InputError(f"The table must have a column {missing[0]!r}, but has none; add it.")
    found = []
    for (number, _), row in zip(numbered[1:], cells[1:]):
        if len(row) > len(header):
            raise InputError(
                f"Row {number} of the table must have at most {len(header)} cells, as the header, but has {len(row)}; "
                "correct it (numbers have decimal points)."
            )
        found.append((number, {name: cell.strip() for name, cell in zip(header, row)}))
    return found


def _require_column(name: str) -> None:
    base, _, unit = name.rpartition("_")
    if not name or name in (*_WORDS, *_DIRECTIONS) or unit in _UNITS.get(base, {}):
        return
    if name in _UNITS or base in _UNITS:
        bare = name if name in _UNITS else base
        units = ", ".join(f"{bare}_{unit}" for unit in _UNITS[bare])
        raise InputError(f"A column of the table must end with its unit ({units}), but one is {name!r}; rename it.")
    raise InputError(
        f"The columns of the table must be those that `rfem-jax export --to frames` writes, but one is {name!r}; "
        f"{suggestion(name, COLUMNS)}"
    )


def _value(row: Mapping[str, str], name: str, number: int) -> float | None:
    """The number of a column in SI units, whatever its unit; None where the cell is empty or the column missing."""
    columns = (
        {name: 1.0} if name in _DIRECTIONS else {f"{name}_{unit}": factor for unit, factor in _UNITS[name].items()}
    )
    given = [(column, factor) for column, factor in columns.items() if row.get(column)]
    if not given:
        return None
    if len(given) > 1:
        raise InputError(f"Row {number} of the table must have `{name}` in one unit, but has two; leave one empty.")
    column, factor = given[0]
    try:
        value = float(row[column])
    except ValueError:
        value = np.nan
    if not abs(value) < 1e100:
        raise InputError(
            f"Row {number} of the table: `{column}` must be a finite number, but is {row[column][:60]!r}; correct it."
        )
    return factor * value


def _vector(row: Mapping[str, str], pattern: str, number: int) -> Float[np.ndarray, "3"] | None:
    """Three columns; None where all are empty."""
    values = [_value(row, pattern.format(axis), number) for axis in "xyz"]
    if all(value is None for value in values):
        return None
    if any(value is None for value in values):
        raise InputError(
            f"Row {number} of the table must have all three of {', '.join(pattern.format(axis) for axis in 'xyz')}, "
            "but lacks one; fill it in."
        )
    return np.array(values, dtype=float)


def _direction(row: Mapping[str, str], which: str, number: int) -> Float[np.ndarray, "3"] | None:
    found = _vector(row, f"{which}_{{}}", number)
    if found is not None and not np.linalg.norm(found) > 1e-9:
        raise InputError(f"Row {number} of the table: `{which}` must be a direction, but is zero; give one.")
    return found


def _required(row: Mapping[str, str], which: str, number: int) -> Float[np.ndarray, "3"]:
    found = _vector(row, f"{which}_{{}}", number)
    if found is None:
        raise InputError(
            f"Row {number} of the table must have {which}_x, {which}_y, {which}_z, but has none; add them."
        )
    return found


def _axes(row: Mapping[str, str], prefix: str, places: tuple[int, int], number: int) -> np.ndarray | None:
    """A rotation by `axis` and `across`, the latter wherever the former leaves it where it is left out."""
    axis, across = (_direction(row, f"{prefix}{which}", number) for which in ("axis", "across"))
    if axis is None:
        if across is not None:
            raise InputError(f"Row {number} of the table must have `{prefix}axis` with `{prefix}across`; add it.")
        return None
    return axes_from(axis, np.eye(3)[places[1]] if across is None else across, places).rotation


def _read_body(row: Mapping[str, str], number: int) -> tuple[Body, bool]:
    """A body, and whether the row says its frame and its length."""
    name = _name(row, number)
    mass = _value(row, "mass", number)
    if mass is None:
        raise InputError(f"Row {number} of the table must have the mass of `{name}`, but has none; add mass_kg.")
    origin, centre = _vector(row, "{}", number), _vector(row, "centre_{}", number)
    if centre is None:
        raise InputError(f"Row {number} of the table must have the centre of mass of `{name}`, but has none; add it.")
    axes, length = _axes(row, "", (0, 1), number), _value(row, "length", number)
    moments = [_value(row, one, number) or 0.0 for one in _MOMENTS]
    (xx, yy, zz, xy, xz, yz) = moments
    tensor = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    known = origin is not None and axes is not None and length is not None and length > 0.0
    pose = Frame(np.eye(3) if axes is None else axes, centre if origin is None else origin)
    turn = pose.rotation.T
    return Body(name, pose, mass, turn @ (centre - pose.position), turn @ tensor @ turn.T, length or None), known


def _read_joint(layout: Layout, number: int, kind: str, row: Mapping[str, str]) -> Connection:
    name, names = _name(row, number), [BASE, *(body.name for body in layout.bodies)]
    ends = [row.get(side, "") for side in ("parent", "child")]
    for side, end in zip(("parent", "child"), ends):
        if end not in names:
            raise InputError(
                f"Row {number} of the table: `{side}` of joint `{name}` must be a body of the table or {BASE}, but is "
                f"{end!r}; {suggestion(end, names)}"
            )
    if ends[0] == ends[1]:
        raise InputError(f"Row {number} of the table: joint `{name}` must join two bodies, but has one twice.")
    places = _places(kind)
    axes = _axes(row, "", places, number)
    if axes is None and kind in ("revolute", "prismatic", "cylindrical", "planar", "universal"):
        raise InputError(f"Row {number} of the table must have the axis of joint `{name}`, but has none; add it.")
    left = Frame(np.eye(3) if axes is None else axes, _place_of(row, number))
    child_axes, centre = _axes(row, "child_", places, number), _vector(row, "child_{}", number)
    right = Frame(left.rotation if child_axes is None else child_axes, left.position)
    right = right if centre is None else Frame(right.rotation, centre)
    cut = _flag(row.get("cut", ""), number)
    start = () if cut else coordinates_of(kind, right.seen_from(left))
    parent, child = ends
    seat, bore = left.seen_from(layout.pose(parent)), right.seen_from(layout.pose(child))
    return Connection(name, kind, parent, child, seat, bore, cut, start)


def _place_of(row: Mapping[str, str], number: int) -> Float[np.ndarray, "3"]:
    found = _vector(row, "{}", number)
    if found is None:
        raise InputError(
            f"Row {number} of the table must have the place of the joint, but has none; add x_m, y_m, z_m."
        )
    return found


def _name(row: Mapping[str, str], number: int) -> str:
    name = row.get("name", "")
    if not name or name == BASE:
        raise InputError(f"Row {number} of the table must have a name other than {BASE}, but has {name!r}; add one.")
    return name


def _flag(text: str, number: int) -> bool:
    known = {"": False, "no": False, "false": False, "0": False, "yes": True, "true": True, "1": True}
    if text.lower() not in known:
        raise InputError(f"Row {number} of the table: `cut` must be yes or no, but is {text!r}; correct it.")
    return known[text.lower()]


def _require_each_once(word: str, names: list[str]) -> None:
    twice = [name for name in names if names.count(name) > 1]
    if twice:
        raise InputError(f"Names of the table must be of one {word} each, but `{twice[0]}` is of two; rename one.")
