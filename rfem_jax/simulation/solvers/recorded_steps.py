"""A step-size controller that repeats steps found before.

Place in the pipeline: **recorded_steps** -> stepping.

diffrax's reverse mode recomputes parts of the loop over steps in another compiled program.  For a stiff mechanism
the error estimates of two programs differ by rounding, hence so would the steps, and the recomputed parts would not
be those of the forward pass.
"""

from collections.abc import Callable

import diffrax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PyTree

from rfem_jax.simulation.system.equations import Scalar


class RecordedSteps(diffrax.AbstractStepSizeController[Int[Array, ""], None]):
    """Every step ends at the next of `ends` [s], increasing, padded with infinity."""

    ends: Float[Array, " steps"]

    def wrap(self, direction: Scalar) -> "RecordedSteps":
        del direction
        return self

    def init(
        self,
        terms: PyTree,
        t0: Scalar,
        t1: Scalar,
        y0: PyTree,
        dt0: Scalar | None,
        args: PyTree,
        func: Callable,
        error_order: Scalar | None,
    ) -> tuple[Scalar, Int[Array, ""]]:
        """End of the first step, and the index of that of the next."""
        del terms, t0, y0, dt0, args, func, error_order
        return jnp.minimum(self.ends[0], t1), jnp.asarray(1, jnp.int32)

    def adapt_step_size(
        self,
        t0: Scalar,
        t1: Scalar,
        y0: PyTree,
        y1_candidate: PyTree,
        args: PyTree,
        y_error: PyTree,
        error_order: Scalar,
        controller_state: Int[Array, ""],
    ) -> tuple[bool, Scalar, Scalar, bool, Int[Array, ""], diffrax.RESULTS]:
        """Accept the step from t0 to t1, and end the next at the time recorded for it."""
        del t0, y0, y1_candidate, args, y_error, error_order
        last = len(self.ends) - 1
        end = self.ends[jnp.minimum(controller_state, last)]
        return True, t1, end, False, controller_state + 1, diffrax.RESULTS.successful
