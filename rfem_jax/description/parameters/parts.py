"""The parts of a mechanism whose numbers make the arrays of a model, with numbers put in other numbers' places.

Place in the pipeline: mechanism -> **parts** -> parameters, and the mechanics' `model.building`.

A place in the parts is a path: names of fields and indices, as ("links", 0, "section", "height").
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import equinox as eqx

from rfem_jax.description.basics.numbers import Number, NumberTree
from rfem_jax.description.mechanism.bases import Base
from rfem_jax.description.mechanism.compliance import SprungDirection
from rfem_jax.description.mechanism.forces import Force
from rfem_jax.description.mechanism.joints import Joint
from rfem_jax.description.mechanism.links import GRADIENTS, Link
from rfem_jax.description.mechanism.mechanism import Mechanism
from rfem_jax.description.mechanism.points import Point

Path = tuple[str | int, ...]


@dataclass(frozen=True)
class Parts(NumberTree):
    """Links, joints, springs of each joint, forces, gravity [m/s^2] and points, in the order of the mechanism;
    reaction_length [m], shaking_point [m], base and plane: as of the mechanism.

    Numbers may be traced: nothing here is checked, unlike in what a user makes.
    """

    links: tuple[Link, ...]
    joints: tuple[Joint, ...]
    springs: tuple[tuple[SprungDirection, ...], ...]
    forces: tuple[Force, ...]
    gravity: tuple[Number, Number, Number]
    reaction_length: float | None = None
    points: tuple[Point, ...] = ()
    shaking_point: tuple[float, float, float] | None = None
    base: Base | None = None
    plane: str = "xz"

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
    """The parts of a mechanism, with zeros for positions that are left out at the origin of a base or a child, and for
    temperatures, and gradients of these, of links that grow and bend with them."""
    return Parts(
        links=tuple(_with_temperature(link) for link in mechanism.links),
        joints=tuple(_with_positions(joint) for joint in mechanism.joints),
        springs=tuple(joint.springs for joint in mechanism.joints),
        forces=tuple(mechanism.forces),
        gravity=mechanism.gravity,
        reaction_length=mechanism.reaction_length,
        points=tuple(mechanism.points),
        shaking_point=mechanism.shaking_point,
        base=mechanism.base,
        plane=mechanism.plane,
    )


def _with_temperature(link: Link) -> Link:
    if link.expansion is None:
        return link
    names = ("temperature", *(GRADIENTS if link.flexible else ()))
    return link.with_fields(**{name: 0.0 for name in names if getattr(link, name) is None})


def _with_positions(joint: Joint) -> Joint:
    origin = 0.0, 0.0, 0.0
    if joint.position is None and joint.parent == "base":
        joint = replace(joint, position=origin)
    if joint.child_position is None and not joint.cut:
        joint = replace(joint, child_position=origin)
    return joint


def measured(parts: Parts) -> Parts:
    """The parts with the lengths of links with an axis as they follow from it."""
    if not any(link.course for link in parts.links):
        return parts
    links = (link.with_fields(length=link.curve.length) if link.course else link for link in parts.links)
    return replace(parts, links=tuple(links))


def number_at(whole: Any, path: Path) -> Any:
    """What stands at a path."""
    for step in path:
        whole = getattr(whole, step) if isinstance(step, str) else whole[step]
    return whole


def with_numbers(whole: Any, values: Mapping[Path, Any]) -> Any:
    """A copy of parts with other numbers, or tables, at several paths; nothing is checked."""
    return eqx.tree_at(lambda tree: [number_at(tree, path) for path in values], whole, list(values.values()))


def renamed_parts(parts: Parts, names: Any) -> Parts:
    """The parts with other names, `names.of(name)`; nothing is checked."""
    links, joints, forces, points = (
        tuple(_renamed(one, fields, names) for one in things)
        for things, fields in (
            (parts.links, ("name",)),
            (parts.joints, ("name", "parent", "child")),
            (parts.forces, ("name", "joint", "joints", "link", "links")),
            (parts.points, ("name", "link", "relative_to")),
        )
    )
    links = tuple(_with_shared(link, names) for link in links)
    return replace(parts, links=links, joints=joints, forces=forces, points=points)


def _with_shared(link: Link, names: Any) -> Link:
    def of(thing: Any, kinds: Sequence[str]) -> Any:
        shared = {kind: getattr(thing, kind) for kind in kinds}
        return thing.with_fields(**{kind: one and _renamed(one, ("name",), names) for kind, one in shared.items()})

    stations = tuple(of(station, ("section", "after")) for station in link.stations)
    return of(link, ("section", "material")).with_fields(stations=stations)


def _renamed(thing: Any, fields: Sequence[str], names: Any) -> Any:
    given = {name: getattr(thing, name, None) for name in fields}
    changed = {
        name: names.of(value) if isinstance(value, str) else tuple(map(names.of, value))
        for name, value in given.items()
        if value is not None
    }
    return thing.with_fields(**changed)


def scaled(values: Any, factor: Number) -> Any:
    """Numbers of nested tables times a factor."""
    if values is None or isinstance(values, (tuple, list)):
        return None if values is None else tuple(scaled(one, factor) for one in values)
    return values * factor
