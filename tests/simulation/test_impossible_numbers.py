"""Errors and deviations of numbers that cannot be: lengths and sections without a size, tilts of many turns."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rfem_jax import (
    STATUS,
    GeneralisedAlpha,
    InputError,
    Joint,
    JointSpring,
    Link,
    Material,
    Mechanism,
    Normal,
    Problem,
    Rectangle,
    Simulation,
    Tolerances,
    assemble,
    deviations,
    discretise,
    monte_carlo,
    simulate,
)
from rfem_jax.mechanics.model.status import DESIGN_OUT_OF_RANGE, OK

METHOD = GeneralisedAlpha(step=1e-3)
STEEL = Material("steel", 2.1e11, 7850.0, poisson_ratio=0.3)


@pytest.fixture(scope="module")
def model():
    """A bar on a hinge with a spring."""
    bar = Link("bar", 0.3, Rectangle(0.01, 0.02, name="flat"), STEEL, rfes=2)
    spring = JointSpring("spring", "A", stiffness=40.0)
    return discretise(Mechanism([bar], [Joint("A", "base", "bar")], forces=[spring]))


def run(model, errors):
    return simulate(Simulation(model, drive=None, duration=2e-3, method=METHOD, save_every=1e-3), errors)


IMPOSSIBLE = {
    "bar.length": -0.3,
    "A.delta_x": 1e10,
    "bar.twist": -7.0,
    "flat.width": -0.01,
    "steel.density": -8e3,
    "spring.stiffness": -50.0,
}


@pytest.mark.long
@pytest.mark.parametrize("name", ["bar.length", "A.delta_x", "flat.width", "spring.stiffness"])
def test_samples_of_a_batch(model, name):
    """They have a status, and their neighbours are what they are alone."""
    values = jnp.array([0.0, IMPOSSIBLE[name], 1e-3, -1e-4])
    batch = jax.jit(jax.vmap(lambda value: run(model, deviations(model, {name: value}))))
    runs = batch(values)
    assert np.asarray(runs.status).tolist() == [OK, DESIGN_OUT_OF_RANGE, OK, OK]
    assert "is impossible" in STATUS[DESIGN_OUT_OF_RANGE].message
    forces = np.asarray(runs.metrics.rms_force["A"])
    assert np.all(np.isfinite(forces))
    np.testing.assert_allclose(forces[1], forces[0], rtol=1e-12)  # the nominal mechanism instead
    good = batch(values.at[1].set(0.0))
    for one, other in zip(jax.tree.leaves(runs.loads), jax.tree.leaves(good.loads), strict=True):
        np.testing.assert_array_equal(np.asarray(one)[[0, 2, 3]], np.asarray(other)[[0, 2, 3]])


@pytest.mark.parametrize("name, value", IMPOSSIBLE.items())
def test_concrete_numbers_are_refused(model, name, value):
    errors = deviations(model, {name: value})
    for computed in (lambda: run(model, errors), lambda: assemble(model, errors)):
        with pytest.raises(InputError, match=rf"`errors` must .*`{name.split('.')[0]}.*; .*\.$") as refused:
            computed()
        assert len(refused.value.problems) == 1


def test_samples_that_fail_are_counted(model):
    """Of a length that is scattered by as much as it is."""
    problem = Problem(Simulation(model, drive=None, duration=2e-3, method=METHOD, save_every=1e-3), "A.rms_force")
    result = monte_carlo(problem, Tolerances({"bar.length": Normal(0.6)}), 32, jax.random.key(1), batch=32)
    failed = result.errors[:, 0] <= -0.3
    assert 0 < failed.sum() < 16
    assert result.failures == {"design_out_of_range": failed.sum()}
    assert np.isfinite(result.statistics["A.rms_force"].mean.value)
