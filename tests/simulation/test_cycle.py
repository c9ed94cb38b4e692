"""The steady cycle of a turning mechanism against many revolutions one after another."""

import numpy as np
import pytest

from rfem_jax import (
    GeneralisedAlpha,
    InputError,
    Joint,
    Link,
    Material,
    Mechanism,
    MomentRamp,
    PrescribedRate,
    Rectangle,
    RungeKutta4,
    Simulation,
    design,
    discretise,
    simulate,
    steady_cycle,
)

# Soft and lightly damped: the first mode loses a fifth of its amplitude in a revolution.
SOFT = Material("soft", youngs_modulus=2e8, density=1200.0, poisson_ratio=0.3, damping=1e-3)


@pytest.fixture(scope="module")
def arm():
    link = Link("arm", 0.3, Rectangle(0.01, 0.01), SOFT, rfes=2)
    return discretise(Mechanism([link], [Joint("A", "base", "arm")], driven_joint="A"))


@pytest.mark.slow
def test_a_cycle_is_what_many_revolutions_come_to(arm):
    rate = 12.0
    period = 2 * np.pi / rate
    drive, method = PrescribedRate("A", rate), GeneralisedAlpha(step=period / 60)
    # The same rate as a number that a design sets.
    cycle = steady_cycle(
        Simulation(
            arm,
            drive=PrescribedRate("A", 5.0),
            method=method,
            save_every=period / 10,
            design=design(arm, {"drive.rate": rate}),
        ),
        tolerance=1e-9,
    )
    assert cycle.converged and cycle.residual <= 1e-9
    count = 40
    long = simulate(Simulation(arm, drive=drive, duration=count * period, method=method, save_every=period / 10))
    last = long.window((count - 1) * period, count * period)
    assert float(cycle.run.metrics.rms_force["A"]) == pytest.approx(float(last.rms_force["A"]), rel=1e-6)
    assert float(cycle.run.metrics.rms_moment["A"]) == pytest.approx(float(last.rms_moment["A"]), rel=1e-6)
    first = long.window(0.0, period)
    assert abs(float(first.rms_moment["A"]) / float(last.rms_moment["A"]) - 1) > 1e-4  # the start-up is another motion
    assert cycle.revolutions < count


def test_cycles_that_cannot_be_are_refused(arm):
    method = RungeKutta4(step=1e-5)
    for drive in (PrescribedRate("A", 1.0, rise_time=0.1), MomentRamp("A", 1.0, 0.1)):
        with pytest.raises(InputError, match="PrescribedRate without a rise time"):
            steady_cycle(Simulation(arm, drive=drive, method=method))
