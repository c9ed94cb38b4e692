"""The parts of a mechanism whose numbers make the arrays of a model, with numbers put in other numbers' places.

Place in the pipeline: mechanism -> **parts** -> parameters, and the mechanics' `model.building`.

A place in the parts is a path: names of fields, keys of tables and indices, as ("links", 0, "section", "height").
"""

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from rfem_jax.description.basics.numbers import Number
from rfem_jax.description.mechanism.compliance import SprungDirection
from rfem_jax.description.mechanism.forces import Force
from rfem_jax.description.mechanism.joints import Joint
from rfem_jax.description.mechanism.links import Link
from rfem_jax.description.mechanism.mechanism import Mechanism
from rfem_jax.description.mechanism.points import Point

Path = tuple[str | int, ...]


@dataclass(frozen=True)
class Parts:
    """Links, joints, springs of each joint, forces, gravity [m/s^2] and points, in the order of the mechanism;
    reaction_length [m]: as of the mechanism.

    Numbers may be traced: nothing here is checked, unlike in what a user makes.
    """

    links: tuple[Link, ...]
    joints: tuple[Joint, ...]
    springs: tuple[tuple[SprungDirection, ...], ...]
    forces: tuple[Force, ...]
    gravity: tuple[Number, Number, Number]
    reaction_length: float | None = None
    points: tuple[Point, ...] = ()

    def link(self, name: str) -> Link:
        """The link of a name."""
        return next(link for link in self.links if link.name == name)

    def joint(self, name: str) -> Joint:
        """The joint of a name."""
        return next(joint for joint in self.joints if joint.name == name)

    def springs_of(self, name: str) -> tuple[SprungDirection, ...]:
        """The springs of the joint of a name."""
        return self.springs[[joint.name for joint in self.joints].index(name)]


def parts_of(mechanism: Mechanism) -> Parts:
    """The parts of a mechanism, with zeros for positions that are left out at the origin of a base or a child."""
    return Parts(
        links=tuple(mechanism.links),
        joints=tuple(_with_positions(joint) for joint in mechanism.joints),
        springs=tuple(joint.springs for joint in mechanism.joints),
        forces=tuple(mechanism.forces),
        gravity=mechanism.gravity,
        reaction_length=mechanism.reaction_length,
        points=tuple(mechanism.points),
    )


def _with_positions(joint: Joint) -> Joint:
    origin = 0.0, 0.0, 0.0
    if joint.position is None and joint.parent == "base":
        joint = replace(joint, position=origin)
    if joint.child_position is None and not joint.cut:
        joint = replace(joint, child_position=origin)
    return joint


def number_at(whole: Any, path: Path) -> Any:
    """What stands at a path."""
    for step in path:
        whole = getattr(whole, str(step)) if _is_field(whole, step) else whole[step]
    return whole


def with_number(whole: Any, path: Path, value: Any) -> Any:
    """A copy of parts with something else at a path; nothing is checked."""
    return with_numbers(whole, {path: value})


def with_numbers(whole: Any, values: Mapping[Path, Any]) -> Any:
    """A copy of parts with something else at several paths, none of which is within another; nothing is checked.

    What stands around them is copied once: one by one, thousands of numbers would copy all forces thousands of times.
    """
    by_step: dict[str | int, dict[Path, Any]] = {}
    for path, value in values.items():
        by_step.setdefault(path[0], {})[path[1:]] = value
    new = {step: _changed(number_at(whole, (step,)), inside) for step, inside in by_step.items()}
    if isinstance(whole, Mapping):
        return {**whole, **new}
    if isinstance(whole, Sequence):
        return tuple(new.get(i, one) for i, one in enumerate(whole))
    other = copy.copy(whole)
    for step, value in new.items():
        object.__setattr__(other, str(step), value)
    return other


def _changed(inside: Any, values: dict[Path, Any]) -> Any:
    return values[()] if () in values else with_numbers(inside, values)


def renamed_parts(parts: Parts, names: Any) -> Parts:
    """The parts with other names, `names.of(name)`; nothing is checked."""
    links, joints, forces, points = (
        tuple(_renamed(one, fields, names) for one in things)
        for things, fields in (
            (parts.links, ("name",)),
            (parts.joints, ("name", "parent", "child")),
            (parts.forces, ("name", "joint", "link", "links")),
            (parts.points, ("name", "link", "relative_to")),
        )
    )
    links = tuple(_with_shared(link, names) for link in links)
    return replace(parts, links=links, joints=joints, forces=forces, points=points)


def _with_shared(link: Link, names: Any) -> Link:
    for kind in ("section", "material"):
        if getattr(link, kind) is not None:
            link = with_number(link, (kind,), _renamed(getattr(link, kind), ("name",), names))
    return link


def _renamed(thing: Any, fields: Sequence[str], names: Any) -> Any:
    for name in fields:
        value = getattr(thing, name, None)
        if value is not None:
            new = names.of(value) if isinstance(value, str) else tuple(map(names.of, value))
            thing = with_number(thing, (name,), new)
    return thing


def _is_field(whole: Any, step: str | int) -> bool:
    return isinstance(step, str) and not isinstance(whole, Mapping)


def scaled(values: Any, factor: Number) -> Any:
    """Numbers of nested tables times a factor."""
    if values is None or isinstance(values, (tuple, list)):
        return None if values is None else tuple(scaled(one, factor) for one in values)
    return values * factor
