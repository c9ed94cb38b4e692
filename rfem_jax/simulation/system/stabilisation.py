"""Baumgarte's gains of a method (theory (5.7)).

Place in the pipeline: methods -> **stabilisation** -> stepping, stability.

J. Baumgarte, Comput. Methods Appl. Mech. Eng. 1 (1972) 1-16: a closure error Phi decays by
Phi'' + 2 rate Phi' + rate^2 Phi = 0, critically damped.
"""

from rfem_jax.description.methods import Method
from rfem_jax.mechanics.model.inputs import Stabilisation
from rfem_jax.mechanics.model.model import Model, length_scale

STABILISATION = 0.02  # rate times step
ADAPTIVE_STABILISATION_RATE = 1e3  # 1/s


def stabilisation_of(model: Model, method: Method) -> Stabilisation:
    """Gains of a method: rate = stabilisation / step [1/s]; a fixed rate for methods with adaptive steps."""
    share = STABILISATION if method.stabilisation is None else method.stabilisation
    rate = share / STABILISATION * ADAPTIVE_STABILISATION_RATE
    if method.step is not None:
        rate = share / method.step
    return Stabilisation(2.0 * rate, rate**2, length_scale(model))
