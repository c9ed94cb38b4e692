"""Modes at rest against the linearised equations of motion of the mechanism as one dense matrix."""

import dataclasses
import tracemalloc

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

from rfem_jax import (
    Coordinates,
    InputError,
    Joint,
    Mechanism,
    MomentRamp,
    PointForce,
    PrescribedRate,
    RungeKutta4,
    Simulation,
    State,
    assembly_errors,
    check_step,
    discretise,
    largest_stable_step,
    simulate,
)
from rfem_jax.description.methods import named_method
from rfem_jax.mechanics.dynamics.dynamics import accelerations
from rfem_jax.mechanics.model.inputs import DriveInput, Stabilisation
from rfem_jax.mechanics.model.with_errors import apply_errors
from rfem_jax.simulation.stages.stepping import stabilisation_of
from rfem_jax.simulation.vibrations import stability, vibration, vibration_matrices
from rfem_jax.simulation.vibrations.vibration import Modes, Vibration
from tests.mechanisms import four_bar, link


@eqx.filter_jit
def _accelerations_linearised(model, angles, stabilisation):
    """d q_ddot / d (q, q_dot) (n, 2 n) at rest, undeformed: nothing of `vibration` is used."""
    actual = apply_errors(model, assembly_errors(model))
    position = Coordinates(angles, jnp.zeros((6, model.topology.n_rfes)))
    flat, unravel = ravel_pytree(State(position, jax.tree.map(jnp.zeros_like, position)))

    def rate(flat):
        result = accelerations(actual, unravel(flat), DriveInput(), stabilisation)
        return ravel_pytree(result.coordinates)[0]

    return jax.jacfwd(rate)(flat)


def _jacobian(model, angles, stabilisation=None):
    if stabilisation is None:
        stabilisation = Stabilisation(jnp.zeros(()), jnp.zeros(()), jnp.max(model.length))
    stabilisation = jax.tree.map(jnp.asarray, stabilisation)
    return np.asarray(_accelerations_linearised(model, jnp.asarray(angles), stabilisation))


def _dense_eigenvalues(jacobian):
    n = len(jacobian)
    return np.linalg.eigvals(np.vstack([np.eye(n, 2 * n, n), jacobian]))


def _dense_growth(method, jacobian):
    """Largest amplification of a step of the whole linear system."""
    h, n = method.step, len(jacobian)
    if method.name == "rk4":
        z = h * _dense_eigenvalues(jacobian)
        return np.abs(1.0 + z * (1.0 + z / 2.0 * (1.0 + z / 3.0 * (1.0 + z / 4.0)))).max()
    one, none = np.eye(n), np.zeros((n, n))
    half = np.hstack([one, 0.5 * h * one, none])
    predicted = np.hstack([none, one, 0.5 * h * one])
    acceleration = jacobian[:, :n] @ half + jacobian[:, n:] @ predicted
    velocity = np.hstack([none, one, none]) + h * acceleration
    matrix = np.vstack([half + 0.5 * h * velocity, velocity, acceleration])
    return np.abs(np.linalg.eigvals(matrix)).max()


@pytest.fixture(scope="module")
def models():
    """The four-bar with the same damping in both flexible links, and with a softer, more damped coupler."""
    model = discretise(four_bar(3))
    softer = model.section.stiffness.at[:, 1].mul(0.02), model.section.damping.at[1].mul(300.0)
    coupled = eqx.tree_at(lambda m: (m.section.stiffness, m.section.damping), model, softer)
    return {"alike": model, "coupled": coupled}


@pytest.mark.long
@pytest.mark.parametrize("name", ["alike", "coupled"])
def test_eigenvalues_are_those_of_the_equations_of_motion(models, name):
    """But for the zeros of the two coordinates of every closure equation; without gravity, which adds 1e-6."""
    model = eqx.tree_at(lambda m: m.gravity, models[name], jnp.zeros(3))
    angles = stability._poses(model)[3]
    modes = Vibration(model).modes(angles)
    assert modes.damping.ndim == (2 if name == "coupled" else 1)
    got = np.sort_complex(modes.eigenvalues())
    expected = np.sort_complex(_dense_eigenvalues(_jacobian(model, angles)))
    assert len(got) == len(expected) - 10
    got, expected = (x[np.abs(x) > 100.0] for x in (got, expected))
    assert len(got) >= len(expected) > 30
    for one in expected:
        assert np.abs(got - one).min() < 1e-8 * np.abs(one)


@pytest.mark.long
@pytest.mark.parametrize("name", ["alike", "coupled"])
@pytest.mark.parametrize("method", ["rk4", "leapfrog"])
def test_limit_is_that_of_the_whole_linear_system(models, name, method):
    """Stable in all positions just below, unstable in one of them just above; Baumgarte's terms included, gravity
    not, for which some positions are unstable in truth."""
    model = eqx.tree_at(lambda m: m.gravity, models[name], jnp.zeros(3))
    limit = largest_stable_step(model, named_method(method, step=1e-6))

    def growth(share):
        trial = named_method(method, step=share * limit)
        gains = stabilisation_of(model, trial)
        return max(_dense_growth(trial, _jacobian(model, a, gains)) for a in stability._poses(model))

    assert growth(0.999) < 1.0 + 5e-6
    assert growth(1.003) > 1.0 + 1e-4


def test_closure_errors_count_when_the_step_cannot_follow_them(models):
    """Baumgarte's gains beyond the stability of the method: no step helps, they grow as it shrinks."""
    strong = RungeKutta4(step=1e-6, stabilisation=3.0)
    assert largest_stable_step(models["alike"], strong) == 0.0
    with pytest.raises(InputError, match="reduce `stabilisation`"):
        check_step(models["alike"], strong)


@pytest.mark.parametrize("held", [False, True])
def test_stiffest_mode_alone_finds_the_same_limit(models, held, monkeypatch):
    drive = PrescribedRate("A", 1.0) if held else None
    for name, tolerance in (("alike", 2e-3), ("coupled", 0.02)):
        method = RungeKutta4(step=1e-6)
        with monkeypatch.context() as patch:
            patch.setattr(vibration, "MOST_BODIES", 0)
            got = largest_stable_step(models[name], method, drive)
        expected = largest_stable_step(models[name], method, drive)
        assert (1.0 - tolerance) * expected <= got <= 1.002 * expected


@pytest.mark.long
def test_memory_is_linear_in_the_rfes():
    peaks = []
    for rfes in (100, 200):
        model = discretise(four_bar(rfes))
        tracemalloc.start()
        largest_stable_step(model, RungeKutta4(step=1e-9))
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 2.5 * peaks[0]
    assert peaks[1] < 50e6


def test_rigid_links_swing_under_gravity():
    """A bar hinged at its end: phi'' = 3 g / (2 L) cos phi, but for its thickness; small about hanging."""
    mechanism = Mechanism([link("bar", 0.5)], [Joint("A", "base", "bar", angle=np.pi / 2)], driven_joint="A")
    model = discretise(mechanism)
    modes = Vibration(model).modes(np.array([np.pi / 2]))
    thick = 1.0 + (0.01 / 0.5) ** 2 / 4.0  # I = m (L^2 / 3 + h^2 / 12)
    np.testing.assert_allclose(modes.squares, 1.5 * 9.81 / 0.5 / thick, rtol=1e-6)
    upright = Vibration(model).modes(np.array([-np.pi / 2])).eigenvalues()
    assert upright.real.max() > 1.0


def test_overdamped_modes_keep_their_slow_root():
    modes = Modes(np.array([1.0]), np.array([1e9]))
    np.testing.assert_allclose(np.sort(modes.eigenvalues().real), [-1e9, -1e-9], rtol=1e-12)


@pytest.mark.long
def test_rigid_chain_by_an_implicit_method():
    """No free rfe at all; the angle after a short fall by two methods."""
    mechanism = Mechanism(
        [link("upper", 0.2), link("lower", 0.2)],
        [Joint("A", "base", "upper", angle=0.3), Joint("B", "upper", "lower", angle=0.2)],
        driven_joint="A",
    )
    model, drive = discretise(mechanism), MomentRamp("A", 0.1, 0.05)
    settings = {"drive": drive, "duration": 0.1, "save_every": 0.1}
    runs = [
        simulate(Simulation(model, method=named_method(name, step=1e-3), **settings))
        for name in ("generalised_alpha", "rk4")
    ]
    assert [int(run.status) for run in runs] == [0, 0]
    assert abs(float(runs[1].motion.angle[-1]) - 0.3) > 1e-3
    np.testing.assert_allclose(runs[0].motion.angle[-1], runs[1].motion.angle[-1], atol=1e-4)


def test_given_forces_are_no_arguments_of_the_program_of_the_masses(monkeypatch):
    """Ten thousand of them would be traced and compiled for nothing."""
    plain = four_bar(3)
    loaded = dataclasses.replace(
        plain, forces=[PointForce(f"push{i}", "coupler", 0.1, force=(0, 0, i)) for i in range(9)]
    )
    seen = []

    def counted(model):
        seen.append(len(jax.tree.leaves(model)))
        return apply_errors(model, assembly_errors(model))

    monkeypatch.setattr(vibration_matrices, "_nominal", counted)
    constants = [vibration_matrices.nominal_constants(discretise(one)) for one in (plain, loaded)]
    assert seen[0] == seen[1]
    np.testing.assert_array_equal(constants[0].mass, constants[1].mass)
