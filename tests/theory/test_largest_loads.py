"""The largest resultant loads of a run, of joints of every kind: a closed form, fine histories, derivatives.

A pulse that lasts a tenth of the run is what a p-norm over time hides: it stays a fifth below the maximum.
"""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from rfem_jax import (
    GeneralisedAlpha,
    Joint,
    Mechanism,
    PointForce,
    Problem,
    RungeKutta4,
    Simulation,
    assembly_errors,
    discretise,
    simulate,
)
from rfem_jax.mechanics.dynamics.loads import static_state
from tests.derivatives import check_derivatives
from tests.mechanisms import chain_of_kinds, link

LENGTH, MASS, G = 0.3, 7850.0 * 0.01**2 * 0.3, 9.81
PULSE, DURATION = 300.0, 0.1
HELD = RungeKutta4(step=1e-3)
TIMES = (0.0, 0.03, 0.035, 0.04, DURATION)


def pulse(link, height):
    """A force in the middle of the run, downwards at the end of a link."""
    return PointForce("pulse", link, LENGTH, force=[(0, 0, -height * (i == 2)) for i in range(5)], times=TIMES)


def clamped_bar():
    """A rigid bar along x that is fixed to the base."""
    joint = Joint("W", "base", "bar", kind="fixed")
    return Mechanism([link("bar", LENGTH)], [joint], forces=[pulse("bar", PULSE)])


@pytest.fixture(scope="module")
def clamp():
    kinds = ("max_force", "max_moment", "peak_force", "peak_moment")
    return Problem(
        Simulation(discretise(clamped_bar()), drive=None, duration=DURATION, method=HELD, save_every=1e-3),
        [f"W.{kind}" for kind in kinds],
    )


@pytest.mark.slow
def test_the_largest_loads_of_a_clamp_are_those_at_the_top_of_a_pulse(clamp):
    values, status = clamp({})
    force, moment = PULSE + MASS * G, (PULSE + 0.5 * MASS * G) * LENGTH
    assert int(status) == 0
    assert float(values["W.max_force"]) == pytest.approx(force, rel=1e-12)
    assert float(values["W.max_moment"]) == pytest.approx(moment, rel=1e-12)
    # What is called a peak is not it: (mean of the 16th powers)^(1/16).
    assert float(values["W.peak_force"]) < 0.85 * force and float(values["W.peak_moment"]) < 0.85 * moment


@pytest.mark.long
def test_derivatives_of_a_maximum_are_those_of_its_instant(clamp):
    """A longer bar of the same section is heavier, and its weight reaches farther; the pulse stays where it is."""

    def largest(length):
        values, _ = clamp({"bar.length": length})
        return jnp.stack([values["W.max_force"], values["W.max_moment"]])

    found = check_derivatives(largest, 0.0, 1e-4, reverse=1e-10, differences=1e-6)
    assert abs(float(found.forward[1])) > 0.1


KINDS_WITHOUT_AXIS = "U", "F"


@pytest.mark.slow
@pytest.mark.parametrize("method", [RungeKutta4(step=1e-4), GeneralisedAlpha(step=1e-4, steps_per_row=2)])
def test_largest_loads_of_all_kinds_are_those_of_every_step(method):
    """Joints of all kinds, fixed and universal ones too, which have no axis; saved seldom and at every step."""
    chain = chain_of_kinds()
    links = [dataclasses.replace(one, rfes=1) for one in chain.links]
    model = discretise(dataclasses.replace(chain, links=links, forces=[pulse_at_tip()]))
    errors = assembly_errors(model, {"A.delta_x": 0.01, "F.d_x": 1e-3})
    start = static_state(model.topology, model.start_coordinates())
    settings = {"drive": None, "duration": 2e-3, "method": method, "start": start}
    seldom = simulate(Simulation(model, save_every=1e-3, **settings), errors)
    often = simulate(Simulation(model, save_every=method.step, **settings), errors)
    for name, load in often.loads.items():
        for what in ("force", "moment"):
            largest = np.linalg.norm(np.asarray(getattr(load, what)), axis=1).max()
            found = float(getattr(seldom.metrics, f"max_{what}")[name])
            assert found == pytest.approx(largest, rel=1e-6), (name, what)
    assert np.all(np.isnan([float(seldom.metrics.max_normal_force[name]) for name in KINDS_WITHOUT_AXIS]))


def pulse_at_tip():
    """A force for half a millisecond, between the two saved times."""
    return PointForce("pulse", "f", 0.1, force=[(0, 0, -400.0 * (i == 2)) for i in range(5)],
                      times=(0.0, 2e-4, 4e-4, 6e-4, 2e-3))  # fmt: skip
