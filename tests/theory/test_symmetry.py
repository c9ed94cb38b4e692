"""What symmetry says of the flexible four-bar: planar stays planar, the frame of the description
does not matter, and mirrored errors give mirrored loads (theory (9.1), (9.2))."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rfem_jax import Coordinates, State, assembly_errors
from rfem_jax.mechanics.dynamics.dynamics import accelerations
from rfem_jax.mechanics.model.inputs import DriveInput, Stabilisation
from rfem_jax.mechanics.model.with_errors import apply_errors


@pytest.fixture
def runs(flexible_four_bar_runs):
    return flexible_four_bar_runs[1]


def test_motion_is_fast_and_loads_come_from_errors(runs):
    """Otherwise the tests below would say little."""
    assert runs["errors"].motion.rate_end > 15.0
    for joint in "ABCD":
        assert runs["errors"].metrics.rms_moment[joint] > 0.1
        assert runs["errors"].metrics.max_axial_force[joint] > 1.0


def test_planar_mechanism_stays_planar(runs):
    run = runs["perfect"]
    largest = max(np.abs(load.force).max() for load in run.loads.values())
    for joint in "ABCD":
        for load in (run.loads[joint], run.preload[joint]):
            assert np.abs(load.force[..., 1]).max() < 1e-11 * largest
            assert np.abs(load.moment[..., [0, 2]]).max() < 1e-11 * largest
    for line in run.motion.centre_lines.values():
        assert np.abs(line[..., 1]).max() < 1e-14


@pytest.mark.long
def test_planar_state_has_planar_accelerations(flexible_four_bar_runs):
    """Any planar state, closed or not."""
    model, _ = flexible_four_bar_runs
    key = iter(jax.random.split(jax.random.key(3), 4))
    planar = jnp.array([1.0, 0.0, 1.0, 0.0, 1.0, 0.0])[:, None]
    rfes, links = model.topology.n_rfes, model.topology.n_links
    position = Coordinates(
        model.start_joints + 0.3 * jax.random.normal(next(key), (links,)),
        planar * 1e-3 * jax.random.normal(next(key), (6, rfes)),
    )
    velocity = Coordinates(
        20.0 * jax.random.normal(next(key), (links,)),
        planar * jax.random.normal(next(key), (6, rfes)),
    )
    zero = jnp.zeros(())

    @eqx.filter_jit
    def at(model, state):
        drive, none = DriveInput({model.topology.driven_coordinate: zero + 3.0}), Stabilisation(zero, zero, zero + 0.3)
        return accelerations(apply_errors(model, assembly_errors(model)), state, drive, none)

    result = at(model, State(position, velocity))
    elastic = np.abs(np.asarray(result.coordinates.elastic))
    assert elastic[[0, 2, 4]].min() > 1.0
    assert elastic[[1, 3, 5]].max() < 1e-11 * elastic.max()
    # Five multipliers: force x, y, z, and the two axis equations.
    multipliers = np.abs(np.asarray(result.multipliers))
    assert multipliers[[1, 3, 4]].max() < 1e-11 * multipliers.max()


def test_rotated_and_shifted_mechanism_has_the_same_loads(runs):
    still, moved = runs["errors"], runs["moved"]
    for joint in "ABCD":
        for kind in ("loads", "preload"):
            for one, other in zip(getattr(still, kind)[joint], getattr(moved, kind)[joint]):
                np.testing.assert_allclose(one, other, atol=1e-7 * np.abs(one).max())
    np.testing.assert_allclose(still.motion.angle, moved.motion.angle, atol=1e-10)
    np.testing.assert_allclose(still.energy.total, moved.energy.total, atol=1e-9)


def test_mirrored_errors_give_mirrored_loads(runs):
    """(x, z) of the force and y of the moment stay, the others change sign; so every resultant and
    every metric stays."""
    one, other = runs["errors"], runs["mirrored"]
    mirror = np.array([1.0, -1.0, 1.0])
    for joint in "ABCD":
        for kind in ("loads", "preload"):
            a, b = getattr(one, kind)[joint], getattr(other, kind)[joint]
            np.testing.assert_allclose(a.force, mirror * b.force, atol=1e-8 * np.abs(a.force).max())
            np.testing.assert_allclose(a.moment, -mirror * b.moment, atol=1e-8 * np.abs(a.moment).max())
    for metric in ("rms_force", "rms_moment", "max_axial_force", "max_normal_force"):
        for joint in "ABCD":
            a, b = (getattr(run.metrics, metric)[joint] for run in (one, other))
            np.testing.assert_allclose(a, b, rtol=1e-8)


def test_balances_hold_with_errors(runs):
    """The stabilisation has next to nothing to do if the constraints are complete."""
    for run in runs.values():
        assert run.checks.closure_drift < 1e-10 and run.checks.closure_drift_angle < 1e-11
        assert run.checks.stabilisation_share < 2e-8
        assert run.checks.momentum_balance_error < 1e-12 and run.checks.hinge_moment_error < 1e-10
        assert run.checks.energy_balance_error < 2e-6
