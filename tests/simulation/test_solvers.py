"""Integration methods: the scan over steps against diffrax's own loop, maxima, adaptive steps."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rfem_jax import (
    Explicit,
    GeneralisedAlpha,
    InputError,
    Leapfrog,
    MomentFunction,
    Simulation,
    assembly_errors,
    simulate,
)
from rfem_jax.description.methods import named_method
from rfem_jax.simulation import LeapfrogSolver
from rfem_jax.simulation.solvers.catalogue import observed_solver
from rfem_jax.simulation.stages import integration
from rfem_jax.simulation.stages.stepping import TERMS, Integration
from rfem_jax.simulation.system.driving import active_drives
from rfem_jax.simulation.system.equations import (
    Conditions,
    safe_sqrt,
    start_trajectory,
)
from rfem_jax.simulation.system.stabilisation import stabilisation_of
from rfem_jax.simulation.system.time_grid import divide_time

ERRORS = {"D.delta_x": 4e-3, "D.d_y": 2e-4}


def in_one_interval(model, drive, method):
    """Conditions, start and carry of a mechanism with errors."""
    prepared = integration.prepare(model, assembly_errors(model, ERRORS), drive, None)
    drives, gains = active_drives(model, drive), stabilisation_of(model, method)
    conditions = Conditions(prepared.actual, drives, jnp.asarray(0, jnp.int32), gains)
    y = (start_trajectory(model, prepared.state), jnp.zeros((4, 4)))
    return prepared, conditions, y


@pytest.mark.long
@pytest.mark.parametrize("name", ["rk4", "generalised_alpha"])
def test_loop_over_steps_is_diffrax_s_own_loop(small, name):
    """One interval by `advance` and by diffeqsolve with the same solver and steps."""
    model, method = small.model, named_method(name, step={"rk4": 2e-5}.get(name, 2.5e-4))
    prepared, conditions, y = in_one_interval(model, small.drive, method)
    solution = jax.jit(
        lambda y: (
            diffrax.diffeqsolve(
                TERMS,
                observed_solver(method),
                t0=0.0,
                t1=1e-3,
                dt0=method.step,
                y0=y,
                args=conditions,
            ).ys
        )
    )(y)
    grid, steps = divide_time(1e-3, method.step, 1e-3, ())
    whole = Integration(model, small.drive, grid, method, steps)
    carry = integration.start_carry(whole, prepared)
    carry, _ = jax.jit(lambda carry: integration.advance(whole, prepared.actual, carry))(carry)
    ours, theirs = jax.tree.leaves(carry.trajectory), jax.tree.leaves(solution[0])
    # Newton's method stops at its tolerance, 1e-8.
    atol = 1e-11 if name == "rk4" else 1e-7
    for one, other in zip(ours, theirs):
        scale = np.abs(other[-1]).max() + 1e-300
        np.testing.assert_allclose(one / scale, other[-1] / scale, rtol=0, atol=atol)
    assert np.all(np.asarray(solution[1][-1]) <= np.asarray(carry.peaks) * (1 + 1e-6))


@pytest.mark.long
def test_a_failure_of_newton_s_method_is_the_result_of_diffeqsolve(small):
    """One Newton increment is not enough for a long step whose iteration matrix has links far too soft."""
    method = GeneralisedAlpha(step=5e-3, corrections=1)
    _, conditions, y = in_one_interval(small.model, small.drive, method)
    solver = observed_solver(method)
    operators = jax.tree.map(lambda x: 0.1 * x[0], solver.operators(conditions.actual, jnp.asarray([method.step])))
    conditions = eqx.tree_at(lambda c: c.operators, conditions, operators, is_leaf=lambda x: x is None)
    result = jax.jit(
        lambda y: (
            diffrax.diffeqsolve(
                TERMS,
                solver,
                t0=0.0,
                t1=1e-2,
                dt0=method.step,
                y0=y,
                args=conditions,
                throw=False,
            ).result
        )
    )(y)
    assert result == diffrax.RESULTS.nonlinear_max_steps_reached


@pytest.mark.slow
def test_peaks_are_the_maxima_of_a_fine_history(small):
    """Running maxima without a history against the saved history at every step."""
    settings = {**small.settings, "save_every": 2e-5}
    run = jax.jit(lambda values: simulate(Simulation(small.model, **settings), assembly_errors(small.model, values)))(
        ERRORS
    )
    coarse = small.run(ERRORS)
    for name, load in run.loads.items():
        force = np.asarray(load.force)
        normal = np.hypot(force[:, 0], force[:, 2]).max()
        axial = np.abs(force[:, 1]).max()
        np.testing.assert_allclose(coarse.metrics.max_normal_force[name], normal, rtol=1e-9)
        np.testing.assert_allclose(coarse.metrics.max_axial_force[name], axial, rtol=1e-9)
        for what, vectors in (("force", force), ("moment", np.asarray(load.moment))):
            largest = np.linalg.norm(vectors, axis=1).max()
            np.testing.assert_allclose(getattr(coarse.metrics, f"max_{what}")[name], largest, rtol=1e-9, atol=1e-12)


def test_mean_squares_are_those_of_a_fine_history(small):
    run = small.run(ERRORS)
    fine = jax.jit(
        lambda values: simulate(
            Simulation(small.model, **{**small.settings, "save_every": 2e-5}), assembly_errors(small.model, values)
        )
    )(ERRORS)
    times = np.asarray(fine.times)[1:]
    for name in "ABCD":
        square = np.sum(np.asarray(fine.loads[name].moment) ** 2, axis=1)[1:]
        # Trapezoidal rule, in two parts: the loads jump with the moment.
        jump = int(np.argmin(np.abs(times - 0.01)))
        integral = np.trapezoid(square[: jump + 1], times[: jump + 1])
        integral += np.trapezoid(square[jump + 1 :], times[jump + 1 :])
        integral += (times[jump + 1] - times[jump]) * square[jump + 1] + times[0] * square[0]
        np.testing.assert_allclose(run.metrics.mean_square_moment[name], integral / 0.02, rtol=2e-4)


@pytest.mark.slow
@pytest.mark.parametrize(
    "method",
    [Leapfrog(step=4e-6), Explicit("dopri5", rtol=1e-8, atol=1e-10)],
    ids=lambda m: m.name,
)
def test_other_methods_agree_with_runge_kutta(small, method):
    settings = {**small.settings, "method": method}
    run = simulate(Simulation(small.model, **settings), assembly_errors(small.model, ERRORS))
    exact = small.run(ERRORS)
    assert int(run.status) == 0
    np.testing.assert_allclose(run.motion.angle[-1], exact.motion.angle[-1], rtol=1e-5)
    np.testing.assert_allclose(np.asarray(run.times), np.asarray(exact.times), atol=1e-15)
    for name in "ABCD":
        for kind in ("rms_force", "rms_moment", "max_normal_force"):
            np.testing.assert_allclose(getattr(run.metrics, kind)[name], getattr(exact.metrics, kind)[name], rtol=3e-4)
    # Loads at saved times are those of steps' ends, not interpolated.
    np.testing.assert_allclose(run.loads["A"].force[-1], exact.loads["A"].force[-1], rtol=2e-3, atol=2e-3)


@pytest.mark.slow
def test_leapfrog_needs_a_velocity_of_second_order():
    """On x'' = -k x - c x' the method is of order 2; its order would drop to 1 if the damping read
    a lagging velocity."""

    from rfem_jax import Coordinates

    class Y(eqx.Module):
        position: Coordinates
        velocity: Coordinates
        integrals: jax.Array

    def field(t, y, args):
        a = Coordinates(-9.0 * y.position.joints - 1.2 * y.velocity.joints, jnp.zeros((6, 0)))
        return Y(y.velocity, a, jnp.zeros(()))

    start = Coordinates(jnp.ones(1), jnp.zeros((6, 0)))
    y0 = Y(start, jax.tree.map(jnp.zeros_like, start), jnp.zeros(()))
    decay, w = 0.6, np.sqrt(9.0 - 0.36)
    exact = np.exp(-decay) * (np.cos(w) + decay / w * np.sin(w))
    errors = []
    for steps in (50, 100, 200):
        sol = diffrax.diffeqsolve(
            diffrax.ODETerm(field),
            LeapfrogSolver(),
            0.0,
            1.0,
            1.0 / steps,
            y0,
        )
        errors.append(abs(float(sol.ys.position.joints[-1, 0]) - exact))
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    np.testing.assert_allclose(orders, 2.0, atol=0.1)


def test_time_grid():
    grid, steps = divide_time(0.5, 1e-5, 1e-3, (0.1,))
    assert steps == 100 and len(grid.starts) == 501 and grid.lengths[0] == 0.0
    np.testing.assert_allclose(np.cumsum(grid.lengths)[-1], 0.5, rtol=1e-14)
    ends = grid.starts + grid.lengths
    at = int(np.argmin(np.abs(ends - 0.1)))
    assert abs(ends[at] - 0.1) < 1e-15
    assert set(grid.phases[: at + 1]) == {0} and set(grid.phases[at + 1 :]) == {1}
    # A jump between saved times becomes an end of its own; steps never exceed the wanted one.
    grid, steps = divide_time(0.01, 3e-5, 1e-3, (0.00455,))
    ends = grid.starts + grid.lengths
    assert np.any(np.abs(ends - 0.00455) < 1e-15)
    assert np.all(grid.lengths / steps <= 3e-5)
    with pytest.raises(InputError, match="`duration` must be positive"):
        divide_time(-1.0, 1e-5, None, ())


@pytest.mark.long
def test_adaptive_methods_do_not_integrate_where_no_time_passes(small):
    """The first saved time is the start: an interval of length zero."""
    seen = []

    def moment(t, phase):
        jax.debug.callback(lambda t: seen.append(float(t)), t)
        return 1.5 + 0.0 * t

    run = simulate(
        Simulation(
            small.model,
            drive=MomentFunction("A", moment),
            duration=2e-4,
            save_every=1e-4,
            method=Explicit("dopri5", rtol=1e-6, atol=1e-8),
        )
    )
    jax.block_until_ready(run.times)
    jax.effects_barrier()
    assert int(run.status) == 0
    assert 2e-4 <= max(seen) <= 2.5e-4


def test_the_square_root_has_derivative_zero_at_zero_only():
    values, derivatives = jax.vmap(jax.value_and_grad(safe_sqrt))(jnp.asarray([0.0, 4.0, np.nan]))
    np.testing.assert_array_equal(values, [0.0, 2.0, np.nan])
    np.testing.assert_array_equal(derivatives[:2], [0.0, 0.25])
