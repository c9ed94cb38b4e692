"""Fixed steps that resolve the stiffest mode: order 4 of rk4, order 2 of leapfrog, in motion,
loads, metrics and energy balance.

A soft, damped, driven link on a tilted hinge: damping, gyroscopic and drive terms all matter.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rfem_jax import (
    Coordinates,
    GivenSection,
    Joint,
    Link,
    Mechanism,
    MomentFunction,
    Simulation,
    State,
    discretise,
    simulate,
)
from rfem_jax.description.methods import named_method
from rfem_jax.simulation.vibrations.stability import eigenvalues

STEPS = (2e-3, 1e-3, 5e-4)
ORDERS = {"rk4": 4, "leapfrog": 2}


@pytest.fixture(scope="module")
def model():
    section = GivenSection(1.5e3, 8e2, 8e2, 20.0, 12.0, 18.0, 1.0, 0.05, 0.02, 0.03, damping=4e-3)
    link = Link("beam", 1.0, section, rfes=3)
    joint = Joint("A", "base", "beam", orientation=(0.7, 0.0, 0.2))
    return discretise(Mechanism([link], [joint], gravity=(0.0, 0.0, -3.0), driven_joint="A"))


def test_largest_step_resolves_the_stiffest_mode_and_damping_matters(model):
    values = eigenvalues(model)
    assert np.abs(values).max() * STEPS[0] < 0.4
    swinging = values[np.abs(values.imag) > 1.0]
    assert (-swinging.real / np.abs(swinging)).max() > 0.05


@pytest.fixture(scope="module", params=ORDERS)
def runs(request, model):
    """Order, and the runs with every step."""
    drive = MomentFunction("A", lambda t, phase: 4.0 * jnp.sin(12.0 * t))
    elastic = jnp.zeros((6, model.topology.n_rfes))
    start = State(Coordinates(jnp.array([0.4]), elastic), Coordinates(jnp.array([3.0]), elastic))

    def simulated(step):
        return simulate(
            Simulation(
                model,
                drive=drive,
                duration=0.4,
                method=named_method(request.param, step=step),
                save_every=0.1,
                start=start,
            )
        )

    return ORDERS[request.param], [jax.tree.map(np.asarray, simulated(step)) for step in STEPS]


def quantities(run):
    return {
        "angle": run.motion.angle,
        "rate": run.motion.rate,
        "force": run.loads["A"].force,
        "moment": run.loads["A"].moment,
        "mean square force": run.metrics.mean_square_force["A"],
        "mean square moment": run.metrics.mean_square_moment["A"],
        "work": run.energy.work,
        "dissipation": run.energy.dissipation,
    }


@pytest.mark.long
def test_halving_the_step_divides_the_error_by_two_to_the_order(runs):
    order, (coarse, middle, fine) = (runs[0], map(quantities, runs[1]))
    for name in coarse:
        first = np.abs(coarse[name] - middle[name]).max()
        second = np.abs(middle[name] - fine[name]).max()
        assert second > 1e-12 * np.abs(fine[name]).max(), name  # above rounding
        assert abs(np.log2(first / second) - order) < 0.35, (name, np.log2(first / second))


def test_energy_balance_falls_with_the_order(runs):
    order, results = runs
    errors = [run.checks.energy_balance_error for run in results]
    assert np.log2(errors[0] / errors[1]) > order - 0.35
    assert np.log2(errors[1] / errors[2]) > order - 0.35
    assert results[0].energy.dissipation[-1] > 0.01 * np.abs(results[0].energy.total).max()
