"""Mathematical functions of kernels against mpmath, in units in the last place."""

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest

from rfem_jax.kernels import is_available, kernel

pytestmark = pytest.mark.skipif(not is_available(), reason="llvmlite is not installed")

RANDOM = np.random.default_rng(0)
ANGLES = np.concatenate(
    [
        RANDOM.uniform(-4, 4, 100),
        RANDOM.uniform(-1e6, 1e6, 100),
        10.0 ** RANDOM.uniform(-300, 20, 100),
        np.arange(1, 60_000, 997) * np.pi / 2,  # where a result is nearly zero
        [1e22, 6381956970095103.0 * 2.0**-3],  # large
    ]
)
POWERS = np.concatenate(
    [RANDOM.uniform(-708, 709.7, 200), RANDOM.uniform(-1, 1, 100), 10.0 ** RANDOM.uniform(-300, 0, 50)]
)
NUMBERS = np.concatenate(
    [10.0 ** RANDOM.uniform(-307, 308, 200), RANDOM.uniform(0.5, 2, 200), 1 + RANDOM.uniform(-1e-8, 1e-8, 100)]
)
FUNCTIONS = {
    "sin": (jnp.sin, mpmath.sin, ANGLES), "cos": (jnp.cos, mpmath.cos, ANGLES), "exp": (jnp.exp, mpmath.exp, POWERS),
    "log": (jnp.log, mpmath.log, NUMBERS), "tan": (jnp.tan, mpmath.tan, ANGLES[:300]),
    "tanh": (jnp.tanh, mpmath.tanh, POWERS / 10), "atan": (jnp.arctan, mpmath.atan, ANGLES[:300]),
    "asin": (jnp.arcsin, mpmath.asin, RANDOM.uniform(-1, 1, 200)),
    "acos": (jnp.arccos, mpmath.acos, RANDOM.uniform(-1, 1, 200)),
}  # fmt: skip
SPECIAL = jnp.array([0.0, -0.0, jnp.inf, -jnp.inf, jnp.nan, -1.0, 800.0, -800.0])


@pytest.mark.parametrize("name", FUNCTIONS)
def test_within_two_units_in_the_last_place(name):
    function, exact, places = FUNCTIONS[name]
    found = np.asarray(jax.vmap(kernel(function, selection="fast"))(jnp.asarray(places)))
    with mpmath.workprec(1200):
        wanted = [exact(mpmath.mpf(float(x))) for x in places]
        errors = [abs(mpmath.mpf(float(a)) - b) / np.spacing(abs(float(b))) for a, b in zip(found, wanted, strict=True)]
    assert max(errors) < 2.0


@pytest.mark.parametrize("name", ["sin", "cos", "exp", "log", "tanh", "atan"])
def test_special_values_are_those_of_numpy(name):
    found = jax.vmap(kernel(FUNCTIONS[name][0], selection="fast"))(SPECIAL)
    with np.errstate(all="ignore"):
        wanted = getattr(np, {"atan": "arctan"}.get(name, name))(np.asarray(SPECIAL))
    np.testing.assert_allclose(found, wanted, rtol=1e-15)
    np.testing.assert_array_equal(np.signbit(found[:2]), np.signbit(wanted[:2]))
