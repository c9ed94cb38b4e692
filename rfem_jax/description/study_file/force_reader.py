"""From the tables of a study file to joints and forces.

Place in the pipeline: `study_reader` calls it with one table of [[mechanism.joints]], [[mechanism.springs]] or
[[mechanism.forces]].

The keys are the names of the arguments of Joint, JointSpring, PointForce, ...; a force's "kind" chooses its class. What
acts in a joint may stand in the joint's own table, too, as `stiffness`, `damping`, `spring` and `friction`; a spring or
a force on a link says by its other keys what it is. All of this is translated here, and nowhere else.
"""

from typing import Any

from rfem_jax.description.basics.errors import ABSENT, InputError, Problems, located, require_choice
from rfem_jax.description.basics.tables import (
    build,
    build_of_kind,
    checked_table,
    keys_of,
    keys_of_all,
    keys_of_kind,
    read_table,
)
from rfem_jax.description.mechanism.bearings import Bearing
from rfem_jax.description.mechanism.clearance import Clearance
from rfem_jax.description.mechanism.compliance import Compliance, TablesByDirection
from rfem_jax.description.mechanism.distributed_forces import DistributedForce
from rfem_jax.description.mechanism.forces import Force, JointForce, JointForceTable, JointFriction, JointSpring
from rfem_jax.description.mechanism.joints import Joint
from rfem_jax.description.mechanism.point_forces import AXES, PointForce, PointMoment, PointSpring, PointSpringTable

FORCES = {
    "joint_spring": JointSpring,
    "joint_table": JointForceTable,
    "friction": JointFriction,
    "point_spring": PointSpring,
    "point_spring_table": PointSpringTable,
    "point_force": PointForce,
    "point_moment": PointMoment,
    "distributed_force": DistributedForce,
}
SPRINGS = ("point_spring", "point_spring_table", "joint_spring")  # kinds of [[mechanism.springs]]
# Kinds that need not be said, by a key that says it.
ON_LINKS = {"force": "point_force", "moment": "point_moment", "load": "distributed_force"}
FUNCTION_KEYS = ("breakpoints",)  # of functions, which a file cannot hold
IN_JOINTS = {"spring": JointSpring, "friction": JointFriction}  # tables of a joint, which is their `joint`
OF_ITS_JOINT = ("name", "joint")
TABLES_OF_JOINTS = {"compliance": Compliance, "bearing": Bearing, "clearance": Clearance}
JOINT_KEYS = ("stiffness", "damping", *IN_JOINTS)  # beside the arguments of Joint


def read_joint(table: object, place: str) -> tuple[Joint, list[JointForce]]:
    """Return the joint of a table [[mechanism.joints]] and the forces that stand in it."""
    problems = Problems()
    required, optional = keys_of(Joint)
    settings = checked_table(table, place, required, (*optional, *JOINT_KEYS), problems)
    of_joint = {key: settings.pop(key) for key in JOINT_KEYS if key in settings}
    for key, kind in TABLES_OF_JOINTS.items():
        if key in settings:
            settings[key] = problems.attempt(read_table, kind, settings[key], f"{place} {key}")
    if not {"stiffness", "damping"}.isdisjoint(of_joint):
        settings["compliance"] = problems.attempt(_by_direction, of_joint, "compliance" in settings, place)
    forces: list[JointForce] = []
    for key in IN_JOINTS:
        with problems.noted():
            forces += _forces_in_joint(of_joint.get(key, []), key, settings["name"], place)
    return build(Joint, settings, place, problems), forces


def _by_direction(of_joint: dict[str, Any], has_compliance: bool, place: str) -> TablesByDirection:
    """The compliance of the tables `stiffness` and `damping`."""
    if has_compliance:
        raise InputError(
            f"{place} must have either `compliance` or `stiffness` and `damping`, but has both; remove one of the two."
        )
    if "stiffness" not in of_joint:
        raise InputError(
            f"{place} must have `stiffness` beside `damping`, but it is missing; give the stiffness in the same "
            "directions (of a free motion the damping stands in `spring`)."
        )
    problems, tables = Problems(), []
    for key in ("stiffness", "damping"):
        with problems.noted():
            if isinstance(of_joint.get(key, {}), int | float | str):
                raise InputError(
                    f"{place} {key} must be a table of directions that the joint holds, but was {of_joint[key]!r}; "
                    f"write {key} = {{ radial = ... }}, or, along a free motion, spring = {{ {key} = ... }}."
                )
            given, known = of_joint.get(key, {}), TablesByDirection.keys()
            tables.append(checked_table(given, f"{place} {key}", (), known, problems))
    problems.refuse()
    return TablesByDirection.of(*tables)


def _forces_in_joint(given: object, key: str, joint: Any, place: str) -> list[JointForce]:
    """The springs or the friction of a joint: one table, or a list of them for several free motions."""
    if given is ABSENT or joint is ABSENT:
        raise InputError()  # told elsewhere
    entries = given if isinstance(given, list) else [given]
    kind, found, problems = IN_JOINTS[key], [], Problems()
    for entry in entries:
        with problems.noted():
            found.append(_force_in_joint(kind, entry, joint, f"{place} {key}", f"{joint}_{key}", len(entries) > 1))
    problems.refuse()
    return found


def _force_in_joint(
    kind: type[JointForce], entry: object, joint: str, place: str, name: str, several: bool
) -> JointForce:
    problems = Problems()
    required, optional = keys_of(kind, omit=OF_ITS_JOINT)
    needed = ("motion",) if several else ()
    left = [one for one in optional if one not in needed]
    settings = checked_table(entry, place, (*required, *needed), left, problems)
    motion = settings.get("motion")
    if several and isinstance(motion, str):
        name = f"{name}_{motion}"
    return build(kind, {**settings, "name": name, "joint": joint}, place, problems)


def read_spring(table: object, place: str) -> Force:
    """Return the spring of a table [[mechanism.springs]]: between two points, or along a motion of a `joint`."""
    problems = Problems()
    known = keys_of_all((FORCES[kind] for kind in SPRINGS), omit=FUNCTION_KEYS)
    content = checked_table(table, place, (), known, problems)
    kind = "joint_spring" if "joint" in content else "point_spring_table" if "lengths" in content else "point_spring"
    settings = keys_of_kind(content, f"{place} {spring_place(kind)}", *keys_of(FORCES[kind]), problems)
    return build(FORCES[kind], settings, place, problems)


def read_force(table: object, place: str) -> Force:
    """Return the force of a table [[mechanism.forces]]."""
    problems = Problems()
    known = [*keys_of_all(FORCES.values(), omit=FUNCTION_KEYS), "frame"]
    on_link = next((kind for key, kind in ON_LINKS.items() if isinstance(table, dict) and key in table), None)
    needed = () if on_link and isinstance(table, dict) and "kind" not in table else ("kind",)
    said = table.get("kind", on_link) if isinstance(table, dict) else None
    if isinstance(said, str) and said in FORCES and isinstance(table, dict):
        # The nearest key of this kind is meant; keys of others are told by name below.
        required, optional = force_keys(said)
        known = [key for key in known if key in table or key in (*required, *optional)]
    content = checked_table(table, place, needed, [*known, "kind"], problems)
    kind = content.setdefault("kind", on_link)
    if kind in ON_LINKS.values() and "frame" in content:
        with problems.noted():
            _frame_as_axes(content, place)
    return build_of_kind(content, "kind", FORCES, force_keys, place, problems)


def force_keys(kind: str) -> tuple[list[str], list[str]]:
    """The required and the optional keys of [[mechanism.forces]] of a kind."""
    required, optional = keys_of(FORCES[kind], omit=FUNCTION_KEYS)
    if kind in ON_LINKS.values():
        return required, ["kind", *optional, "frame"]
    return ["kind", *required], optional


def spring_place(kind: str) -> str:
    """Where a spring of [[mechanism.springs]] of a kind is, in words."""
    return {"joint_spring": "at a joint", "point_spring_table": "between points, with a table"}.get(
        kind, "between points"
    )


def _frame_as_axes(content: dict[str, Any], place: str) -> None:
    """`frame` is another name of `axes`."""
    frame, both = content.pop("frame"), "axes" in content
    content["axes"] = ABSENT
    with located(place):
        content["axes"] = require_choice(frame, AXES, "frame")
    if both:
        raise InputError(f"{place} must have either `frame` or `axes`, but has both; remove one of the two.")
