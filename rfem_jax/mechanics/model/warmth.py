"""Parts of a mechanism at their temperatures, by which links and the base grow.

Place in the pipeline: parts -> **warmth** -> building.

A link grows as a whole by the share alpha T: its length and all places on it, not its section, whose stiffnesses and
whose mass stay. Places on the base move away from the global origin likewise. Source: theory (2.21).
"""

from dataclasses import replace
from typing import Any

from rfem_jax.description.basics.numbers import Number
from rfem_jax.description.mechanism.distributed_forces import DistributedForce
from rfem_jax.description.mechanism.forces import Force
from rfem_jax.description.mechanism.joints import Joint
from rfem_jax.description.mechanism.links import Link
from rfem_jax.description.mechanism.point_forces import AtPoint, BetweenPoints
from rfem_jax.description.mechanism.rigid_bodies import RigidBody
from rfem_jax.description.mechanism.stations import Station
from rfem_jax.description.parameters.parts import Parts, scaled

# Of a given section, per length.
Growths = dict[str, Number]


def growths(parts: Parts) -> Growths:
    """Lengths over those at assembly of the links that have a thermal expansion, and of the base."""
    warm: list[tuple[str, Any, Any]] = [(link.name, link.expansion, link.temperature) for link in parts.links]
    if parts.base is not None:
        warm.append(("base", parts.base.thermal_expansion, parts.base.temperature))
    return {name: 1.0 + expansion * temperature for name, expansion, temperature in warm if expansion is not None}


def warmed(parts: Parts) -> Parts:
    """The parts with lengths and places as they are at their temperatures."""
    found = growths(parts)
    if not found:
        return parts
    return replace(
        parts,
        links=tuple(_link(link, found[link.name]) if link.name in found else link for link in parts.links),
        joints=tuple(_joint(joint, found) for joint in parts.joints),
        forces=tuple(_force(force, found) for force in parts.forces),
        points=tuple(
            one.with_fields(position=scaled(one.place, found[one.link])) if one.link in found else one
            for one in parts.points
        ),
    )


def _link(link: Link, growth: Number) -> Link:
    changed: dict[str, Any] = {"length": link.length * growth}
    changed["point_masses"] = tuple(
        mass.with_fields(position=scaled(mass.position, growth)) for mass in link.point_masses
    )
    if isinstance(link.body, RigidBody):
        changed["body"] = link.body.with_fields(centre=scaled(link.body.centre, growth))
    elif link.material is not None:
        changed["material"] = link.material.with_fields(density=link.material.density / growth)
    elif link.section is not None:
        changed["section"] = _thinned(link.section, growth)
    changed["axis"] = tuple(
        point.with_fields(
            **{
                name: scaled(getattr(point, name), growth)
                for name in ("to", "through", "radius")
                if getattr(point, name) is not None
            }
        )
        for point in link.axis
    )
    changed["camber"] = tuple(
        point.with_fields(**{name: scaled(getattr(point, name), growth) for name in "xyz"}) for point in link.camber
    )
    changed["stations"] = tuple(_station(station, growth, link.material is None) for station in link.stations)
    return link.with_fields(**changed)


def _station(station: Station, growth: Number, given: bool) -> Station:
    """A station of a link that has grown; `given`: whether its sections state their own inertias."""
    changed: dict[str, Any] = {"x": scaled(station.x, growth)} if station.x is not None else {}
    for name in ("section", "after") if given else ():
        if getattr(station, name) is not None:
            changed[name] = _thinned(getattr(station, name), growth)
    return station.with_fields(**changed)


def _thinned(section: Any, growth: Number) -> Any:
    """A given section of a link that has grown and kept its mass."""
    return section.with_fields(**{name: getattr(section, name) / growth for name in section.inertias})


def _joint(joint: Joint, found: Growths) -> Joint:
    sides = {"position": joint.parent, "child_position": joint.child}
    places = {name: scaled(getattr(joint, name), found[owner]) for name, owner in sides.items() if owner in found}
    return joint.with_fields(**places) if places else joint


def _force(force: Force, found: Growths) -> Force:
    if isinstance(force, AtPoint) and force.link in found:
        return force.with_fields(position=scaled(force.position, found[force.link]))
    if isinstance(force, BetweenPoints):
        ends = zip(force.points, force.links, strict=True)
        return force.with_fields(points=tuple(scaled(place, found.get(link, 1.0)) for place, link in ends))
    if isinstance(force, DistributedForce) and force.link in found:
        ends = {name: getattr(force, name) for name in ("begin", "end")}
        return force.with_fields(**{name: x * found[force.link] for name, x in ends.items() if x is not None})
    return force
