"""Baumgarte's gains of a method (theory (5.7)).

Place in the pipeline: methods -> **stabilisation** -> stepping, stability.
"""

from rfem_jax.description.methods import Method
from rfem_jax.mechanics.inputs import Stabilisation
from rfem_jax.mechanics.model import Model
from rfem_jax.mechanics.statics import length_scale

STABILISATION = 0.02
ADAPTIVE_STABILISATION_RATE = 1e3


def stabilisation_of(model: Model, method: Method) -> Stabilisation:
    """Baumgarte's gains of a method, tied to its step: rate = stabilisation / step, critically
    damped; adaptive methods use a fixed rate."""
    share = STABILISATION if method.stabilisation is None else method.stabilisation
    rate = share / STABILISATION * ADAPTIVE_STABILISATION_RATE
    if method.step is not None:
        rate = share / method.step
    return Stabilisation(2.0 * rate, rate**2, length_scale(model))
