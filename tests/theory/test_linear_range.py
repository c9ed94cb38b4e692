"""The estimated error of linear elements, against the elastica and beams under axial forces."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from rfem_jax import (
    GeneralisedAlpha,
    GivenSection,
    Joint,
    Link,
    Mechanism,
    PointForce,
    PointMoment,
    Problem,
    Simulation,
    Tolerances,
    Uniform,
    assemble,
    assembly_errors,
    discretise,
    monte_carlo,
    simulate,
)
from rfem_jax.mechanics.dynamics.centre_lines import link_ends
from rfem_jax.mechanics.dynamics.loads import static_state
from rfem_jax.mechanics.kinematics.motion import motion_of
from rfem_jax.mechanics.model.with_errors import apply_errors
from rfem_jax.simulation.outcome.remarks import remarks_on

# L = E I = G J = 1; without shear and stretch.
SECTION = GivenSection(1e6, 1e6, 1e6, 1.0, 1.0, 1.0, 1e-9, 1e-15, 1e-15, 1e-15)


def cantilever(*loads, elements="linear"):
    beam = Link("beam", 1.0, SECTION, rfes=17)
    joint = Joint("F", "base", "beam", kind="fixed")
    return discretise(Mechanism([beam], [joint], forces=list(loads), gravity=(0.0, 0.0, 0.0)), elements=elements)


def bent(*loads, elements="linear"):
    """Deflection of the tip along z, and the estimated error."""
    model = cantilever(*loads, elements=elements)
    errors = assembly_errors(model)
    found = assemble(model, errors)
    assert int(found.status) == 0
    return float(ends_of(model, errors, found.state.position)[2, 0]), float(found.linear_error)


@eqx.filter_jit
def ends_of(model, errors, position):
    actual = apply_errors(model, errors)
    return link_ends(actual, motion_of(actual, static_state(model.topology, position)))[0]


def at_tip(*force):
    return PointForce("tip", "beam", 1.0, force)


def elastica(load):
    """Deflection of the tip of the elastica by shooting for the curvature at the clamp."""

    def shot(curvature):
        return solve_ivp(lambda s, y: [y[1], -load * np.cos(y[0]), np.sin(y[0])], (0, 1), [0, curvature, 0],
                         rtol=1e-10, atol=1e-12).y[:, -1]  # fmt: skip

    return shot(brentq(lambda curvature: shot(curvature)[1], 0.3 * load, load))[2]


@pytest.mark.slow
@pytest.mark.parametrize("load", [0.25, 0.5, 1.0])
def test_a_force_at_the_tip(load):
    found, estimate = bent(at_tip(0.0, 0.0, load))
    continuous = found * (1.0 + 1.0 / (4.0 * 16.0**2))
    np.testing.assert_allclose(estimate, continuous / elastica(load) - 1.0, rtol=0.12)


@pytest.mark.slow
def test_a_moment_at_the_tip():
    """Its deflection errs less; but all of the way back along the beam, a third of the angle times that, is missing."""
    for moment in (0.1, 0.4):
        found, estimate = bent(PointMoment("tip", "beam", 1.0, (0.0, -moment, 0.0)))
        error = found / ((1.0 - np.cos(moment)) / moment) - 1.0
        assert error < estimate < moment / 3.0


@pytest.mark.parametrize("share", [-0.1, -0.03, 0.03, 0.1])
def test_an_axial_force(share):
    """As a share of the critical load, compression being negative."""
    force = share * np.pi**2 / 4.0
    found, estimate = bent(at_tip(force, 0.0, 1e-3))
    k = np.sqrt(abs(force))
    exact = 1e-3 * (np.tan(k) - k if share < 0.0 else k - np.tanh(k)) / k**3
    np.testing.assert_allclose(estimate, abs(found / exact - 1.0), rtol=0.1)


@pytest.mark.slow
def test_no_error():
    """Torsion and axial forces that bend nothing, exact elements."""
    assert bent(PointMoment("tip", "beam", 1.0, (0.5, 0.0, 0.0)))[1] == 0.0
    assert bent(at_tip(-1.0, 0.0, 0.0))[1] < 1e-12
    assert bent(at_tip(0.0, 0.0, 1.0), elements="geometrically_exact")[1] == 0.0


@pytest.mark.long
def test_runs_say_so():
    """Of a batch, too; a run within 2 % has no remark."""
    model = cantilever(at_tip(0.0, 0.0, 0.6))
    method = GeneralisedAlpha(step=1e-4)

    def run(share):
        weaker = jax.tree.map(lambda x: x, model)
        errors = assembly_errors(weaker, {"beam.length": share})
        return simulate(Simulation(weaker, drive=None, duration=1e-4, method=method, save_every=1e-4), errors)

    runs = jax.jit(jax.vmap(run))(jnp.array([0.0, -0.4]))
    assert np.all(np.asarray(runs.status) == 0)
    far, near = (jax.tree.map(lambda x, i=i: x[i], runs) for i in range(2))
    np.testing.assert_allclose(float(far.checks.linear_error), 0.45 * 0.3**2, rtol=0.03)
    assert "by about 4" in remarks_on(far)[0] and "geometrically_exact" in remarks_on(far)[0]
    assert remarks_on(far)[0] in far.summary()
    assert remarks_on(near) == () and "remark" not in near.summary()


@pytest.mark.long
def test_samples_are_counted():
    """Of a Monte Carlo study over the length of a cantilever, beside the metric that is asked for."""
    model = cantilever(at_tip(0.0, 0.0, 0.3))
    problem = Problem(
        Simulation(model, drive=None, duration=1e-4, method=GeneralisedAlpha(step=1e-4), save_every=1e-4),
        "F.rms_moment",
    )
    result = monte_carlo(problem, Tolerances({"beam.length": Uniform(0.4)}), 32, jax.random.key(3), batch=16)
    assert result.metrics == ("F.rms_moment",) and result.good == 32
    angles = 0.5 * 0.3 * (1.0 + result.errors[:, 0]) ** 2
    np.testing.assert_allclose(result.linear_errors, 0.45 * angles**2, rtol=0.02)
    assert 0 < result.inaccurate == np.sum(0.45 * angles**2 > 0.02) < 32
    assert f"In {result.inaccurate} of 32 good samples linear elements" in str(result)
    assert result.remark in " ".join(str(result).split())
