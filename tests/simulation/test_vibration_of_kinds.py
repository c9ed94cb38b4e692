"""Modes and largest stable steps of mechanisms with joints of all kinds, against the linearised equations of motion."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

from rfem_jax import InputError, RungeKutta4, Simulation, State, assembly_errors, check_step, discretise, simulate
from rfem_jax.mechanics.dynamics.dynamics import accelerations
from rfem_jax.mechanics.dynamics.loads import static_state
from rfem_jax.mechanics.model.inputs import DriveInput, Stabilisation
from rfem_jax.mechanics.model.orientations import moved
from rfem_jax.mechanics.model.with_errors import apply_errors
from rfem_jax.simulation.vibrations.vibration import Vibration
from tests.mechanisms import chain_of_kinds, chain_with_balls, loop_cut_by, two_cuts_of_different_kinds


@eqx.filter_jit
def linearised(model):
    """d q_ddot / d (q, q_dot) (n, 2 n) at the start, at rest: nothing of `vibration` is used."""
    actual, start = apply_errors(model, assembly_errors(model)), model.start_coordinates()
    rest = static_state(model.topology, start).velocity
    flat, unravel = ravel_pytree((rest, rest))
    gains = Stabilisation(jnp.zeros(()), jnp.zeros(()), jnp.max(model.length))

    def rate(flat):
        change, velocity = unravel(flat)
        state = State(moved(model.topology, start, change), velocity)
        return ravel_pytree(accelerations(actual, state, DriveInput(), gains).coordinates)[0]

    return jax.jacfwd(rate)(flat)


@pytest.mark.long
@pytest.mark.parametrize("make", [chain_of_kinds, chain_with_balls, two_cuts_of_different_kinds],
                         ids=lambda make: make.__name__)  # fmt: skip
def test_eigenvalues_are_those_of_the_equations_of_motion(make):
    model = eqx.tree_at(lambda m: m.gravity, discretise(make()), jnp.zeros(3))
    jacobian = np.asarray(linearised(model))
    n = len(jacobian)
    expected = np.linalg.eigvals(np.vstack([np.eye(n, 2 * n, n), jacobian]))
    got = Vibration(model).modes(np.asarray(model.start_joints)).eigenvalues()
    assert len(got) == len(expected) - 2 * model.topology.n_constraints
    got, expected = (x[np.abs(x) > 100.0] for x in (got, expected))
    assert len(got) >= len(expected) > 10
    for one in expected:
        assert np.abs(got - one).min() < 1e-7 * np.abs(one)


@pytest.mark.slow
def test_a_step_beyond_the_stable_one_is_refused_and_diverges():
    model = discretise(loop_cut_by("prismatic"))
    limit = check_step(model, RungeKutta4(step=1e-7))
    with pytest.raises(InputError, match="`step` must be at most"):
        check_step(model, RungeKutta4(step=1.05 * limit))

    def status(step):
        return int(simulate(Simulation(model, drive=None, duration=400 * step, method=RungeKutta4(step=step))).status)

    assert status(0.9 * limit) == 0
    assert status(1.2 * limit) != 0
