"""The accuracy of a derivative is known: the derivative of the residual says how far it is from solving the
differentiated equations."""

import dataclasses

import jax
import numpy as np
import pytest

from rfem_jax import GeneralisedAlpha, MomentRamp, Simulation, assembly_errors, derivative_residual, simulate
from rfem_jax.simulation.outcome.run import RESIDUAL_LIMIT
from rfem_jax.simulation.solvers import implicit_step

ALONG = {"D.delta_x": 2e-3, "D.d_y": 5e-4, "B.child.delta_z": 1e-3, "coupler.length": 3e-4}


def change_of_run(model, tolerance):
    """Derivative of a run with respect to a common factor of the errors; every step is saved."""
    method = GeneralisedAlpha(step=2.5e-3, tolerance=tolerance, corrections=12)

    def run(share):
        errors = assembly_errors(model, {name: share * size for name, size in ALONG.items()})
        return simulate(
            Simulation(model, drive=MomentRamp("A", 1.5, 0.02), duration=0.05, method=method, save_every=2.5e-3), errors
        )

    return jax.jit(lambda share: jax.jvp(run, (share,), (1.0,))[1])(1.0)


def forces(change):
    return np.stack([np.asarray(load.force) for load in change.loads.values()])


def test_checks_judge_numbers_and_have_no_derivatives_but_the_residual(small):
    checks = change_of_run(small.model, 1e-3).checks
    assert np.abs(checks.equation_residual).max() > 0.0
    others = dataclasses.replace(checks, equation_residual=np.zeros(1))
    assert all(not np.any(np.asarray(x)) for x in jax.tree.leaves(others))


@pytest.mark.long
def test_it_bounds_the_error_of_a_derivative(small):
    exact, found = (change_of_run(small.model, tolerance) for tolerance in (1e-11, 1e-3))
    assert derivative_residual(exact) < 1e-10
    reference = forces(exact)
    error = np.abs(forces(found) - reference).max() / np.abs(reference).max()
    assert 1e-6 < error < derivative_residual(found) < RESIDUAL_LIMIT


@pytest.mark.long
def test_a_derivative_that_has_not_converged_is_seen(small, monkeypatch):
    """The run is as it should be, but its derivative has only half of every Newton increment."""
    whole = implicit_step.increment_and_wrenches

    def half(*args):
        return jax.tree.map(lambda x: 0.5 * x, whole(*args))

    monkeypatch.setattr(implicit_step, "increment_and_wrenches", half)
    # Another tolerance than above, so that the step is traced again.
    assert derivative_residual(change_of_run(small.model, 2e-3)) > RESIDUAL_LIMIT
