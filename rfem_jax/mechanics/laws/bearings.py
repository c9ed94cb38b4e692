"""Capacities of the bearings of a model as arrays, so that they can be differentiated by.

Place in the pipeline: description.bearings -> **bearings** -> model -> simulation.records.
"""

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from rfem_jax.description.mechanism.bearings import CAPACITIES, LIFE_EXPONENTS
from rfem_jax.description.mechanism.joints import Joint


class BearingCapacity(eqx.Module):
    """Dynamic and static capacity [N] and moment capacity [N m], None where not given; exponent of the load in the life
    as a fraction (numerator, denominator)."""

    dynamic: Float[Array, ""] | None
    static: Float[Array, ""] | None
    moment: Float[Array, ""] | None
    exponent: tuple[int, int] = eqx.field(static=True)

    @property
    def given(self) -> tuple[str, ...]:
        """Names of the capacities that are given, as in a description."""
        values = (self.dynamic, self.static, self.moment)
        return tuple(name for name, value in zip(CAPACITIES, values, strict=True) if value is not None)


def bearing_capacities(joints: Sequence[Joint]) -> dict[str, BearingCapacity]:
    """The capacities of the joints that have any, by their names."""
    found = {}
    for joint in joints:
        if joint.bearing is not None:
            values = [getattr(joint.bearing, name) for name in CAPACITIES]
            dynamic, static, moment = (None if value is None else jnp.asarray(float(value)) for value in values)
            found[joint.name] = BearingCapacity(dynamic, static, moment, LIFE_EXPONENTS[joint.bearing.rolling])
    return found
