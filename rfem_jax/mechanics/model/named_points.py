"""Points of a model that have names already: centres of joints, as "B", and ends of links, as "coupler.end".

Place in the pipeline: building, and problems whose metrics name such points -> **named_points** -> Model.

Source: theory (8.17).
"""

from collections.abc import Iterable
from dataclasses import replace

import jax.numpy as jnp

from rfem_jax.description.mechanism.points import END, START, NamedPoint, link_end
from rfem_jax.mechanics.model.model import CarriedPoint, Model
from rfem_jax.mechanics.model.topology import BASE, Topology


def with_named_points(model: Model, names: Iterable[str]) -> Model:
    """The model with centres of joints and ends of links among its points; its source stays as it is."""
    found = {name: _carried(model, name) for name in names}
    return replace(model, points=(model.points or {}) | found) if found else model


def following(model: Model, names: Iterable[str]) -> Model:
    """The model with those of `names` among its points that are of joints or ends of links; others are left out."""
    known, topology = named_points_of(model.topology), model.topology
    added = [name for name in dict.fromkeys(names) if name in known and name not in (model.points or {})]
    model = with_named_points(model, added)
    if not added or model.source is None:
        return model
    links = [topology.links[topology.link_of(_carried(model, name).node)] for name in added]
    blueprint = model.source.blueprint
    points = (*blueprint.parts.points, *map(NamedPoint, added, links))
    blueprint = replace(blueprint, parts=replace(blueprint.parts, points=points))
    return replace(model, source=replace(model.source, blueprint=blueprint))


def named_points_of(topology: Topology) -> tuple[str, ...]:
    """The names of the centres of joints and of the ends of links."""
    return (*(f"{link}.{end}" for link in topology.links for end in (START, END)), *topology.joints)


def _carried(model: Model, name: str) -> CarriedPoint:
    topology, end, zero = model.topology, link_end(name), jnp.zeros(())
    if end is None:
        j = topology.joints.index(name)
        return CarriedPoint(topology.children[j], BASE, model.child_position[:, j], j)
    link, far = topology.links.index(end[0]), end[1]
    first, last = topology.ranges[link]
    if link in topology.curved and model.form is not None:
        if not far:
            return CarriedPoint(link, BASE, jnp.zeros(3))
        curve, node = model.form.curves[link], topology.end_of(link)
        return CarriedPoint(node, BASE, jnp.asarray(curve.end - model.form.middles.position[:, node]))
    if not far or first == last:
        return CarriedPoint(link, BASE, jnp.stack([model.length[link] if far else zero, zero, zero]))
    beyond = (1.0 - topology.fractions(link)[1][-1]) * model.length[link]
    return CarriedPoint(topology.n_links + last - 1, BASE, jnp.stack([beyond, zero, zero]))
