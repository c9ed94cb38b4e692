"""Ideal couplings: their constraint equations, with first and second derivatives by time.

Place in the pipeline: laws.couplings -> **ideal_couplings** -> motion, cut_joints, whose equations they come after.

An ideal coupling keeps g = q_b - f(q_a) - offset at zero, and its load along q_b is the multiplier of this equation
(theory (16.7) to (16.9)).

Symbols: k couplings, F joint coordinates.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rfem_jax.mechanics.algebra.vectors import Scalar
from rfem_jax.mechanics.laws.couplings import CouplingLaw
from rfem_jax.mechanics.model.model import State
from rfem_jax.mechanics.model.with_errors import ModelWithErrors


class CouplingRows(NamedTuple):
    """The equations of all ideal couplings at one instant: residual g, its rate, and bias, its second derivative for
    q_ddot = 0 [rad, m, or all m]; along (F, k): derivatives by the joint coordinates, the loads of unit multipliers."""

    residual: Float[Array, " k"]
    rate: Float[Array, " k"]
    bias: Float[Array, " k"]
    along: Float[Array, "freedoms k"]

    def in_metres(self, actual: ModelWithErrors, scale: Scalar) -> "CouplingRows":
        """With the equations of angles times a length [m], as those of the axes of cut joints."""
        unit = jnp.stack([units_of(actual, law, scale) for law in ideal_laws(actual).values()])
        return CouplingRows(self.residual * unit, self.rate * unit, self.bias * unit, self.along * unit[None])


def ideal_laws(actual: ModelWithErrors) -> dict[str, CouplingLaw]:
    """The ideal couplings, in the order of their equations."""
    if actual.forces is None:
        return {}
    return {name: actual.forces.couplings[name] for name in actual.topology.ideal}


def units_of(actual: ModelWithErrors, law: CouplingLaw, scale: Scalar) -> Float[Array, ""]:
    """What a coupling's equation is multiplied by: the length where its second coordinate turns."""
    return jnp.ones(()) if actual.topology.slides[law.coordinates[1]] else jnp.asarray(scale, float)


def coupling_rows(actual: ModelWithErrors, state: State) -> CouplingRows | None:
    """The equations of ideal couplings in their own units; None without any."""
    laws = ideal_laws(actual)
    if not laws:
        return None
    rows, found = np.arange(actual.topology.n_freedoms), []
    for law in laws.values():
        first, second = (state.position.joints[k] for k in law.places)
        rate_a, rate_b = (state.velocity.joints[k] for k in law.coordinates)
        (_, slope), (_, bend) = jax.jvp(law.transmitted, (first,), (jnp.ones(()),))
        of_a, of_b = (jnp.asarray(rows == k, float) for k in law.coordinates)
        gap = law.deflection(jnp.stack([first, second]))
        found.append(CouplingRows(gap, rate_b - slope * rate_a, -bend * rate_a**2, of_b - slope * of_a))
    return CouplingRows(*(jnp.stack(part, axis=-1) for part in zip(*found)))
