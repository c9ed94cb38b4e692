"""Second derivatives of loads of a motion, by a dimension, an error and a number of the drive together: forward over
forward = forward over reverse = differences of first derivatives, and symmetric."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rfem_jax import GeneralisedAlpha, MomentRamp, Problem, Simulation, design, discretise
from tests.evaluation import evaluated
from tests.mechanisms import arm

METHOD = GeneralisedAlpha(step=5e-3, corrections=9, tolerance=1e-14)
POINT = {"arm.section.width": 1e-3, "A.delta_x": 4e-3, "drive.moment": 0.1}
SIZES = np.array([2e-3, 1e-2, 30.0])
STEP = 2e-2  # of differences, in sizes of the numbers


@pytest.mark.long
def test_hessian_of_loads_of_a_motion():
    model = discretise(arm(2, 0.5))
    metrics = ("A.rms_moment", "A.mean_square_force")
    # The design sets one of the numbers, which deviates from there.
    wanted = design(model, {"drive.moment": 2.0})
    problem = Problem(
        Simulation(model, drive=MomentRamp("A", 1.5, 1e-2), duration=2e-2, method=METHOD, design=wanted), metrics
    )
    assert problem.nominal_value("drive.moment") == 2.0

    def loads(scaled):
        values, _ = problem(dict(zip(POINT, scaled * SIZES, strict=True)))
        return jnp.stack([values[name] for name in metrics])

    point = jnp.asarray(list(POINT.values())) / SIZES
    forward, reverse = (evaluated(jax.jacfwd(first(loads)))(point) for first in (jax.jacfwd, jax.jacrev))
    around = point[None] + jnp.concatenate([k * STEP * jnp.eye(3) for k in (-2, -1, 1, 2)])
    ends = evaluated(jax.vmap(jax.jacfwd(loads)))(around).reshape(4, 3, 2, 3)
    differences = np.moveaxis((ends[0] - 8.0 * ends[1] + 8.0 * ends[2] - ends[3]) / (12.0 * STEP), 0, 2)
    np.testing.assert_allclose(forward, differences, rtol=1e-6)
    np.testing.assert_allclose(reverse, forward, rtol=1e-8)
    np.testing.assert_allclose(forward, np.swapaxes(forward, 1, 2), rtol=1e-8)
