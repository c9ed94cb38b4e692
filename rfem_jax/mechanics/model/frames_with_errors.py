"""Where things on links with errors are, and the frames of the joints on both their sides.

Place in the pipeline: model, errors, form -> **frames_with_errors** -> masses_with_errors, carried_frames, with_errors.

A link with errors is longer, twisted and bowed; what is on it keeps its share of the length, theory (2.3) to (2.6),
(1.26), (1.32), (1.33).
"""

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float, Int

from rfem_jax.mechanics.algebra import vectors
from rfem_jax.mechanics.model.errors import AssemblyErrors
from rfem_jax.mechanics.model.form import FormErrors, Held, wave
from rfem_jax.mechanics.model.model import Model
from rfem_jax.mechanics.model.topology import BASE, Topology


def link_values(values: Float[Array, "*k links"], links: Int[np.ndarray, " n"]) -> Float[Array, "*k n"]:
    """Values of given links, by a product: the transpose of an index would be an addition at places."""
    return values @ (np.arange(values.shape[-1])[:, None] == links).astype(float)


def joint_sides(
    model: Model, errors: AssemblyErrors, form: FormErrors | None, scale: Array
) -> list[tuple[Float[Array, "3 3 joints"], Float[Array, "3 joints"]]]:
    """Frames of all joints on both sides."""
    topology = model.topology
    given = (
        (model.parent_rotation, model.parent_position, errors.seat, topology.parents, topology.parent_at_end, "seats"),
        (model.child_rotation, model.child_position, errors.bore, topology.children, topology.child_at_end, "bores"),
    )
    found = []
    for rotation, position, error, nodes, at_end, name in given:
        held: Held | None = None if model.form is None else getattr(model.form, name)
        turn = _turns(topology, errors.twist, nodes, at_end, held)
        found.append(
            _side(rotation, displaced(model, form, position, nodes, held), error, nodes, scale, turn, topology)
        )
    return found


def _side(
    rotation: Array,
    position: Array,
    error: Array,
    nodes: tuple[int, ...],
    scale: Array,
    turn: Float[Array, " joints"],
    topology: Topology,
) -> tuple[Float[Array, "3 3 joints"], Float[Array, "3 joints"]]:
    """Frames of all joints on one side: nominal frame, stretched and twisted link, error."""
    # F' of theory (2.5): x grows with the link, and frames turn with the twist.
    link = np.array([0 if node < 0 else topology.link_of(node) for node in nodes])
    on_link = np.array([node >= 0 for node in nodes])
    stretch = jnp.where(on_link, link_values(scale, link), 1.0)
    position = jnp.concatenate([position[:1] * stretch[None], position[1:]])
    rotation = vectors.product(vectors.rotation_x(turn), rotation)
    # F' E with E = [R_z(delta_z) R_y(delta_y) R_x(delta_x), (d_x, d_y, d_z)] of theory (2.3), (2.17).
    tilt = vectors.rotation_x(error[0])
    if "delta_y" in topology.error_components:
        tilt = vectors.product(vectors.rotation_y(error[5]), tilt)
    tilt = vectors.product(vectors.rotation_z(error[1]), tilt)
    return vectors.product(rotation, tilt), position + vectors.apply(rotation, error[2:5])


def _turns(
    topology: Topology, twist: Array, nodes: tuple[int, ...], at_end: tuple[bool, ...], held: Held | None
) -> Float[Array, " joints"]:
    """Angles [rad] by which the twists of links turn the frames of joints: evenly growing along links with errors of
    form (theory (1.32)), at the ends of others (2.5)."""
    link = np.array([0 if node < 0 else topology.link_of(node) for node in nodes])
    on_link = np.array([node >= 0 for node in nodes])
    part: Any = np.array(at_end, dtype=float)
    if topology.formed:
        assert held is not None, "such a model has a form"
        part = jnp.where(np.isin(link, topology.formed), held.share, part)
    return jnp.where(on_link, link_values(twist, link) * part, 0.0)


def displaced(
    model: Model,
    form: FormErrors | None,
    position: Float[Array, "3 n"],
    nodes: Sequence[int],
    held: Held | None,
) -> Float[Array, "3 n"]:
    """Places in frames of nodes with the twists, bows and cambers of their links; on links with an axis y and z as much
    longer as x becomes in what follows (theory (1.26), (1.32), (1.33))."""
    if form is None or model.form is None or held is None or not len(nodes):
        return position
    topology = model.topology
    link = np.array([0 if node == BASE else topology.link_of(node) for node in nodes])
    on_link = np.array([node != BASE for node in nodes])
    curved = np.isin(link, topology.curved) & on_link
    middles, of_nodes = model.form.middles, np.maximum(np.array(nodes), 0)
    apart = wave(jnp.asarray(held.share)) - wave(link_values(jnp.asarray(middles.share), of_nodes))
    across = link_values(form.bow, link) * apart[None]
    if middles.camber is not None and held.camber is not None:
        across = across + held.camber[:2] - link_values(jnp.asarray(middles.camber[:2]), of_nodes)
    across = jnp.where(on_link[None], across, 0.0)
    longer = jnp.where(curved, link_values(form.scale, link), 1.0)
    if topology.formed:
        turn = jnp.where(on_link, link_values(form.twist, link) * held.share, 0.0)
        position = vectors.apply(vectors.rotation_x(turn), position)
    return jnp.concatenate([position[:1], position[1:] * longer[None] + across])


def stretched(topology: Topology, node: int, position: Float[Array, "3"], scale: Array) -> Float[Array, "3"]:
    """A place on a link that became `scale` times as long."""
    return jnp.concatenate([position[:1] * scale[topology.link_of(node)], position[1:]])
