"""What a mechanism exerts on its base at one instant: shaking force and shaking moment.

Place in the pipeline: loads, force elements -> **base loads** -> simulation.

Source: theory (8.27).
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

from rfem_jax.mechanics.algebra.vectors import cross, wrench_at_origin
from rfem_jax.mechanics.forces.element_loads import FrameLoads
from rfem_jax.mechanics.laws.point_laws import GivenLoad
from rfem_jax.mechanics.model.model import Model
from rfem_jax.mechanics.model.topology import BASE
from rfem_jax.mechanics.model.with_errors import ModelWithErrors


class ShakingLoad(NamedTuple):
    """Force [N] of a mechanism on its base, and its moment [N m] about the point (3,) [m], in global axes."""

    force: Float[Array, "*times 3"]
    moment: Float[Array, "*times 3"]
    point: Float[Array, "*times 3"]


def shaking_load(
    model: Model, actual: ModelWithErrors, base: Float[Array, "6"], at_nodes: FrameLoads | None
) -> ShakingLoad:
    """The resultant of all that acts on the base, about the model's point; `base`: wrench at the global origin that
    the base exerts by its joints; `at_nodes`: what the elements exert.

    A given force or moment comes from elsewhere than the base, and does not act on it.
    """
    wrench, elements = -base, {} if actual.frame_forces is None else actual.frame_forces.elements
    for name, element in elements.items():
        if isinstance(element, GivenLoad):
            continue
        assert at_nodes is not None, "a mechanism with elements has their loads"
        exerted = at_nodes.exerted[name]
        for end, sign in ((element.child, 1.0), (element.parent, -1.0)):
            if end.node == BASE:
                wrench = wrench + sign * wrench_at_origin(exerted.moment, exerted.force, exerted.place)
    point = jnp.zeros(3) if model.shaking_point is None else model.shaking_point
    return ShakingLoad(wrench[3:], wrench[:3] - cross(point, wrench[3:]), point)
