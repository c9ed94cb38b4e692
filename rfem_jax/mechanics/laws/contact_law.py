"""The law of one contact: what it pushes with as it is pressed in, and its friction.

Place in the pipeline: algebra -> **contact_law** -> clearances.

A contact that is pressed in by delta > 0, which grows at the rate delta', pushes with

    N = K delta^n max(0, 1 + chi delta')

(K. H. Hunt, F. R. E. Crossley, J. Appl. Mech. 42 (1975) 440-445); chi is given, or follows from the coefficient of
restitution and the speed at which the contact began (H. M. Lankarani, P. E. Nikravesh, J. Mech. Des. 112 (1990)
369-376).  Theory (15.3), (15.4), (15.8).
"""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

# Distances are sqrt(e^2 + ROUNDING^2) [m]: smooth where the axes meet, and without effect on any clearance.
ROUNDING = 1e-12
SLOW = 1e-4  # of a squared speed over that of the smooth sign, below which tanh(x) / x is a power series


class Push(NamedTuple):
    """Normal forces [N] of contacts, and the elastic part of them."""

    normal: Float[Array, "*contacts"]
    elastic: Float[Array, "*contacts"]


class ContactLaw(eqx.Module):
    """Stiffness K [N/m^n] and exponent n of contacts that are alike."""

    stiffness: Float[Array, ""]
    exponent: float = eqx.field(static=True)

    def push(
        self,
        depth: Float[Array, "*contacts"],
        rate: Float[Array, "*contacts"],
        chi: Float[Array, "*contacts"] | None,
    ) -> Push:
        """At a penetration `depth` [m], below zero where the contact is open, that grows at a `rate` [m/s]; chi [s/m]
        (None: nothing is lost)."""
        closed, elastic = depth > 0.0, self._power(depth, self.exponent) * self.stiffness
        if chi is None:
            return Push(elastic, elastic)
        pushing = closed & (chi * rate > -1.0)
        return Push(jnp.where(pushing, elastic * (1.0 + chi * rate), 0.0), elastic)

    def energy(self, depth: Float[Array, "*contacts"]) -> Float[Array, "*contacts"]:
        """Energy [J] that is stored at a penetration [m]."""
        return self.stiffness / (self.exponent + 1.0) * self._power(depth, self.exponent + 1.0)

    @staticmethod
    def _power(depth: Float[Array, "*contacts"], exponent: float) -> Float[Array, "*contacts"]:
        closed = depth > 0.0
        return jnp.where(closed, jnp.where(closed, depth, 1.0) ** exponent, 0.0)


def distance(e: Float[Array, "*k"], axis: int | None = None) -> Float[Array, "..."]:
    """Length [m] of vectors along an axis (None: absolute values), smooth at zero."""
    square = e**2 if axis is None else jnp.sum(e**2, axis=axis)
    return jnp.sqrt(square + ROUNDING**2)


def chi_of_restitution(
    restitution: Float[Array, ""], approach: Float[Array, "*contacts"], slowest: Float[Array, ""]
) -> Float[Array, "*contacts"]:
    """chi [s/m] of contacts that began at speeds `approach` [m/s], at least `slowest` (theory (15.4))."""
    return 0.75 * (1.0 - restitution**2) / jnp.maximum(approach, slowest)


def sliding_share(velocity: Float[Array, " k *contacts"], speed: Float[Array, ""]) -> Float[Array, " k *contacts"]:
    """The direction of sliding velocities [m/s] (first axis) times the smooth sign tanh(v / speed), smooth at rest."""
    square = jnp.sum(velocity**2, axis=0) / speed**2
    slow = square < SLOW
    x = jnp.sqrt(jnp.where(slow, 1.0, square))
    s = jnp.where(slow, square, 0.0)
    ratio = jnp.where(slow, 1.0 - s * (1 / 3 - s * (2 / 15 - s * (17 / 315))), jnp.tanh(x) / x)
    return ratio[None] * velocity / speed
