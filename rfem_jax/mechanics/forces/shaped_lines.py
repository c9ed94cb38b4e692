"""Loads along links with forms, on parts of their rfes.

Place in the pipeline: model.form, laws.line_loads -> **shaped_lines** -> element_loads, section_loads.

A load per length q(s) = q_0 + q_1 (s - s_0) on a rigid part does the work of a force at the rfe's reference point and
of a moment about it; the integrals of the arms to the curve, alone and times s - s_0, do not depend on the load.
Source: theory (3.25), with arms to the curve.
"""

import itertools

import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from rfem_jax.mechanics.algebra.vectors import apply, cross, outer, scaled
from rfem_jax.mechanics.laws.line_loads import LineLoad
from rfem_jax.mechanics.model.form import NODES, WEIGHTS, ActualForm


def shaped_line(
    form: ActualForm,
    line: LineLoad,
    load: Float[Array, "3 2"],
    piece: tuple[Float[Array, " n"], Float[Array, " n"]],
    rests: Float[Array, "3 n"],
    rotation: Float[Array, "3 3 n"],
) -> tuple[Float[Array, "3 n"], Float[Array, "3 n"], tuple[Float[Array, " n"], Float[Array, "3 n"]]]:
    """Force [N] and moment [N m] about the reference points `rests` of rfes with these rotations, of a load as of
    `LineLoad.at`, on the parts of a link between two lengths [m] along it, in the axes that the rotations lead to; and
    what is loaded: its extent [m], and the integral of the arms [m^2] in these axes."""
    low, high = (jnp.minimum(jnp.maximum(x, line.begin), line.end) for x in piece)
    slope = (load[:, 1] - load[:, 0]) / (line.end - line.begin)[None]
    edges = form.lines.curves[line.link].edges * form.errors.scale[line.link]
    n = rests.shape[1]
    arms, moments, extent = jnp.zeros((3, n)), jnp.zeros((3, n)), high - low
    for first, last in itertools.pairwise(edges):
        start, stop = (jnp.minimum(jnp.maximum(x, first), last) for x in (low, high))
        for node, weight in zip(NODES, WEIGHTS):
            s = 0.5 * (start + stop) + 0.5 * (stop - start) * node
            arm = scaled(0.5 * weight * (stop - start), form.at(line.link, s).position - rests)
            arms, moments = arms + arm, moments + scaled(s - line.begin, arm)
    force = scaled(extent, load[:, :1] + outer(slope, 0.5 * (low + high) - line.begin))
    both = jnp.stack([load[:, 0], slope], axis=1)[:, :, None] * np.ones((1, 1, n))
    levers = apply(rotation[:, :, None], jnp.stack([arms, moments], axis=1))
    if line.turning:
        force, both = apply(rotation, force), apply(rotation[:, :, None], both)
    return force, jnp.sum(cross(levers, both), axis=1), (extent, levers[:, 0])
