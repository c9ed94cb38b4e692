"""Simulations by kernels beside the same ones left to XLA: methods, joint kinds, forces, friction, contact."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rfem_jax import (
    Explicit,
    Leapfrog,
    MomentRamp,
    RungeKutta4,
    Simulation,
    assembly_errors,
    discretise,
    simulate,
)
from rfem_jax.kernels import is_available, left_to_xla, registry
from rfem_jax.mechanics.dynamics.loads import static_state
from tests.mechanisms import arm, four_bar
from tests.simulation.test_mixed_derivatives import MIXED, exact_arm, guide_that_rubs

pytestmark = [pytest.mark.slow, pytest.mark.skipif(not is_available(), reason="llvmlite is not installed")]


def both_ways(simulated, monkeypatch):
    """Leaves of a run by kernels, and by XLA alone."""
    names, announce = [], registry.announce
    monkeypatch.setattr(registry, "announce", lambda name, *others: (names.append(name), announce(name, *others)))
    by_kernels = jax.jit(lambda: simulated())()
    assert names
    names.clear()
    with left_to_xla():
        by_xla = jax.jit(lambda: simulated())()
    assert not names
    return by_kernels, by_xla


def assert_alike(one, other, accuracy):
    assert int(one.status) == int(other.status)
    for name in ("rms_force", "rms_moment", "max_force", "max_moment"):
        loads, same = (np.array(list(getattr(run.metrics, name).values())) for run in (one, other))
        assert np.isfinite(loads).all() and loads.max() > 0.0
        np.testing.assert_allclose(loads, same, rtol=accuracy, atol=accuracy * loads.max())


LONG = (guide_that_rubs, exact_arm)


@pytest.mark.parametrize(
    "made",
    [pytest.param(made, marks=pytest.mark.long if made in LONG else pytest.mark.exhaustive) for made in MIXED],
    ids=lambda made: made.__name__,
)
def test_mechanisms(made, monkeypatch):
    mixed = made()
    model = discretise(mixed.mechanism, elements=mixed.elements)
    duration = mixed.steps * mixed.method.step
    at_rest = static_state(model.topology, model.start_coordinates()) if mixed.released else None

    def simulated():
        return simulate(
            Simulation(
                model, drive=mixed.drive, duration=duration, method=mixed.method, save_every=duration, start=at_rest
            )
        )

    assert_alike(*both_ways(simulated, monkeypatch), 1e-8)


METHODS = {
    "rk4": RungeKutta4(step=1e-5),
    "leapfrog": Leapfrog(step=5e-6),
    "midpoint": Explicit("midpoint", step=1e-5),
    "dopri5": Explicit("dopri5", rtol=1e-7, atol=1e-9),
}


@pytest.mark.parametrize(
    "method", [pytest.param(one, marks=[pytest.mark.long] if one in ("rk4", "dopri5") else []) for one in METHODS]
)
def test_methods(method, monkeypatch):
    """Explicit ones: mechanisms above are by the implicit one.  As they have one right-hand side, one method has a loop
    of flexible links."""
    model = discretise(four_bar(2) if method == "rk4" else arm())
    tilted = assembly_errors(model, {"D.delta_x" if method == "rk4" else "A.delta_x": jnp.asarray(5e-3)})

    def simulated():
        return simulate(
            Simulation(model, drive=MomentRamp("A", 1.5, 2e-4), duration=1e-3, method=METHODS[method], save_every=2e-4),
            tilted,
        )

    assert_alike(*both_ways(simulated, monkeypatch), 1e-6 if method == "dopri5" else 1e-9)
