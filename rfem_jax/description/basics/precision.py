"""Everything is computed in double precision: the one place that refuses single precision.

Place in the pipeline: the first thing that happens wherever arrays are made or a simulation starts.
"""

import jax

from rfem_jax.description.basics.errors import WrongSetting


def require_float64() -> None:
    """Raise WrongSetting, an InputError, if JAX works in single precision."""
    if not jax.config.jax_enable_x64:  # pyright: ignore[reportAttributeAccessIssue]  # JAX adds it at run time
        raise WrongSetting(
            "Argument `jax_enable_x64` must be True, but JAX computes in single precision; put "
            'jax.config.update("jax_enable_x64", True) before the first array.'
        )
