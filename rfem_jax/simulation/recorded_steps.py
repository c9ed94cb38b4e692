"""A step-size controller that repeats steps which were found before.

Place in the pipeline: **recorded_steps** -> stepping.

Reverse mode of diffrax goes through parts of the loop over steps again, in another compiled program.  Error
estimates near the rounding of a stiff mechanism differ between two programs, and so would the steps:
the parts gone through again would not fit together.
"""

import diffrax
import jax.numpy as jnp
from jaxtyping import Array, Float


class RecordedSteps(diffrax.AbstractStepSizeController):
    """Every step ends at the next of `ends` [s], increasing, padded with infinity."""

    ends: Float[Array, " steps"]

    def wrap(self, direction):
        del direction
        return self

    def init(self, terms, t0, t1, y0, dt0, args, func, error_order):
        del terms, t0, y0, dt0, args, func, error_order
        return jnp.minimum(self.ends[0], t1), jnp.asarray(1, jnp.int32)

    def adapt_step_size(self, t0, t1, y0, y1_candidate, args, y_error, error_order, controller_state):
        del t0, y0, y1_candidate, args, y_error, error_order
        last = len(self.ends) - 1
        end = self.ends[jnp.minimum(controller_state, last)]
        return True, t1, end, False, controller_state + 1, diffrax.RESULTS.successful
