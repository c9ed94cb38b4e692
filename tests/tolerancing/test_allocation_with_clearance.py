"""Tolerances of a clearance and of a tilt, allocated together: static contact, the closed form of theory (15.10)."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rfem_jax import FunctionProblem, Reciprocal, allocate, assemble, deviations
from rfem_jax.validation.clearances import HARD, HERTZ, PLAY, shaft

TILT, RADIAL = "D.delta_x", "D.clearance.radial"
LENGTH = float(np.asarray(HARD.length))


@pytest.mark.long
def test_a_tilt_and_the_clearance_that_bears_it_are_allocated_together():
    """The worst shaft has the largest tilt in the tightest bush, and its ends are pressed in by
    LENGTH / 2 sin(tilt) - PLAY + radial."""
    model = shaft()

    def moment(errors):
        made = assemble(model, deviations(model, dict(errors)))
        return {"D.moment_square": jnp.sum(made.preload["D"].moment ** 2)}, made.status

    tilt, radial = 2e-2, 3e-5
    pressed = 0.5 * LENGTH * np.sin(tilt) - PLAY + radial
    limit = (LENGTH * HERTZ * pressed**1.5 * np.cos(tilt)) ** 2
    # At the optimum costs fall by tolerances as the penetration grows by them.
    costs = {TILT: Reciprocal(0.5 * LENGTH * np.cos(tilt) * tilt**2), RADIAL: Reciprocal(radial**2)}
    problem = FunctionProblem(moment, (TILT, RADIAL), "D.moment_square", error_units={RADIAL: "m"})
    bounds = {TILT: (1e-3, 6e-2), RADIAL: (1e-6, 9e-5)}
    result = allocate(problem, {"D.moment_square": limit}, costs, bounds, key=jax.random.key(1), starts={"corners": 4})
    assert result.status == "ok" and result.cost == pytest.approx(0.5 * LENGTH * tilt + radial, rel=1e-3)
    assert result.tolerances[TILT] == pytest.approx(tilt, rel=1e-2)
    assert result.tolerances[RADIAL] == pytest.approx(radial, rel=3e-2)
    assert 0.0 <= result.limits[0].predicted_margin < 0.02 * limit
