"""Forces per length along links.

Place in the pipeline: description.distributed_forces, point_laws -> **line_loads** -> model, element_loads,
section_loads.

Every rfe is rigid: its part of the load does the same work as a force at the rfe's reference point and a moment about
it, the integrals of theory (3.25), which are exact. A piece of an rfe is loaded likewise, which section loads need.
"""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

from rfem_jax.description.mechanism.distributed_forces import DistributedForce
from rfem_jax.description.mechanism.links import Link
from rfem_jax.mechanics.algebra.vectors import outer, scaled
from rfem_jax.mechanics.laws.frame_forces import Time
from rfem_jax.mechanics.laws.point_laws import TimeVector, time_vector


class LinePieces(NamedTuple):
    """A load on n pieces of a link: force [N]; lever [N m], the integral of the force times its distance from a
    reference along the axis; extent, middle [m] of the loaded part of each piece."""

    force: Float[Array, "3 n"]
    lever: Float[Array, "3 n"]
    extent: Float[Array, " n"]
    middle: Float[Array, " n"]


class LineLoad(eqx.Module):
    """A force per length along a link.

    first, last: as functions of time [N/m] at begin and end, linear in between (last None: first all along); begin, end
    [m]: along the undeformed link; turning: whether it turns with the rfes, or is in global axes.
    """

    link: int = eqx.field(static=True)
    first: TimeVector
    last: TimeVector | None
    begin: Float[Array, ""]
    end: Float[Array, ""]
    turning: bool = eqx.field(static=True)

    def at(self, time: Time) -> Float[Array, "3 2"]:
        """The load at its begin and at its end [N/m] at an instant."""
        first = self.first.at(time)
        return jnp.stack([first, first if self.last is None else self.last.at(time)], axis=1)

    def over(
        self,
        load: Float[Array, "3 2"],
        start: Float[Array, " n"],
        stop: Float[Array, " n"],
        about: Float[Array, " n"],
    ) -> LinePieces:
        """A load as of `at` on the pieces of the link from `start` to `stop` [m], with levers from the places `about`;
        the opposite where `stop` is smaller."""
        low, high = (jnp.minimum(jnp.maximum(x, self.begin), self.end) for x in (start, stop))
        extent, middle = high - low, 0.5 * (low + high)
        slope = (load[:, 1] - load[:, 0]) / (self.end - self.begin)[None]
        force = scaled(extent, load[:, :1] + outer(slope, middle - self.begin))
        return LinePieces(
            force=force,
            lever=scaled(middle - about, force) + outer(slope, extent**3 / 12.0),
            extent=extent,
            middle=middle,
        )


def line_load(force: DistributedForce, index: int, link: Link) -> LineLoad:
    """The load of a description on a link and its index in the model."""
    begin, end = (jnp.asarray(x, jnp.float64) for x in force.along(link))
    last = None if force.end_load is None else time_vector(force, force.end_load)
    return LineLoad(index, time_vector(force, force.load), last, begin, end, force.axes == "link")
