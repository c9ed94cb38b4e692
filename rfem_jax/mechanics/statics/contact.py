"""The static equilibrium of pins in their bushes: held in the middle first, then released until contacts carry.

Place in the pipeline: search, bush_contacts -> **contact** -> assembly.

Where a contact is open it has no stiffness, and where it closes its stiffness jumps by orders of magnitude, so that
Newton's method from the closed mechanism does not converge.  The weak spring that centres every pin (theory (15.7)) is
made as stiff as a bearing first: the equilibrium is then that of a compliant mechanism.  It is released by powers of
ten down to its own stiffness; contacts close on the way, each step starting from the equilibrium before.  A step on
which Newton's method does not converge is halved, any other is followed by one twice as long.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Float

from rfem_jax.mechanics.bush_contacts import pins_of
from rfem_jax.mechanics.model_with_errors import ModelWithErrors
from rfem_jax.mechanics.statics.search import Equations, load_steps, newton

STIFF = 1e3  # of the spring that holds pins in the middle, over a force and a length of the mechanism
ITERATIONS_OF_A_RELEASE, MOST_RELEASES = 40, 200
FIRST_RELEASE, SMALLEST_RELEASE = np.log(10.0), 1e-4  # of the logarithm of the stiffness


def _centred(actual: ModelWithErrors, centring: list[Array]) -> ModelWithErrors:
    """The mechanism with springs of other stiffnesses [N/m] that centre its pins."""
    return eqx.tree_at(lambda a: [pin.centring for pin in pins_of(a).values()], actual, centring)


def search_contact(
    equations: Equations,
    starts: tuple[Float[Array, " n"], Float[Array, " n"]],
    perfect: tuple[ModelWithErrors, Any],
    loaded: tuple[ModelWithErrors, Any],
    stiffness: Float[Array, ""],
) -> tuple[Float[Array, " n"], Bool[Array, ""]]:
    """Unknowns under load and whether they were found; `starts`: undeformed, without and with the held angles;
    `perfect` and `loaded`: args of the equations; `stiffness` [N/m] of the mechanism."""
    actual, angles = loaded
    own = [jnp.log(pin.centring) for pin in pins_of(actual).values()]
    stiff = [jnp.maximum(jnp.log(STIFF * stiffness), log) for log in own]

    def at(share):
        """Arguments with pins released by a share of the logarithm of the stiffness."""
        return _centred(actual, [jnp.exp(a + share * (b - a)) for a, b in zip(stiff, own)]), angles

    (undeformed, guess), held = starts, at(jnp.zeros(()))
    if actual.topology.exact:
        unloaded = _centred(perfect[0], [pin.centring for pin in pins_of(held[0]).values()]), perfect[1]
        unknowns, found = load_steps(equations, undeformed, unloaded, held)
    else:
        unknowns, found = newton(equations, guess, held, ITERATIONS_OF_A_RELEASE)
    decades = jnp.max(jnp.stack(stiff) - jnp.stack(own))
    return _release(equations, unknowns, found, at, decades)


def _release(
    equations: Equations, start: Array, found: Array, at: Any, decades: Array
) -> tuple[Float[Array, " n"], Bool[Array, ""]]:
    """Unknowns after the release, and whether it came to its end; `decades`: of the logarithm."""

    def going_on(carry):
        _, reached, step, count = carry
        return (reached < 1.0) & (step > SMALLEST_RELEASE) & (count < MOST_RELEASES)

    def advance(carry):
        unknowns, reached, step, count = carry
        share = jnp.minimum(reached + step / jnp.maximum(decades, FIRST_RELEASE), 1.0)
        new, converged = newton(equations, unknowns, at(share), ITERATIONS_OF_A_RELEASE)
        return (
            jnp.where(converged, new, unknowns),
            jnp.where(converged, share, reached),
            jnp.where(converged, 2.0 * step, 0.5 * step),
            count + 1,
        )

    first = jnp.where(found, FIRST_RELEASE, 0.0)
    carry = (start, jnp.zeros(()), first, jnp.zeros((), jnp.int32))
    unknowns, reached, _, _ = jax.lax.while_loop(going_on, advance, carry)
    return unknowns, reached >= 1.0
