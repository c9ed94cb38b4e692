"""The equations of motion as a vector field, with diffrax's own loop, events and saved times."""

import dataclasses

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rfem_jax import Explicit, Simulation, State, assembly_errors, equations_of_motion, simulate
from rfem_jax.simulation.system.equations import at_instant

TILTED = {"D.delta_x": 2e-3, "D.d_y": 1e-4}
TOLERANCES = {"rtol": 1e-9, "atol": 1e-11}


@pytest.fixture(scope="module")
def simulation(small):
    settings = {**small.settings, "method": Explicit("dopri8", **TOLERANCES)}
    return Simulation(small.model, **settings)


def solved(motion, end, **settings):
    controller = diffrax.PIDController(**TOLERANCES, jump_ts=jnp.asarray(motion.jumps))
    return diffrax.diffeqsolve(
        diffrax.ODETerm(motion), diffrax.Dopri8(scan_kind="bounded"), 0.0, end, 1e-6, motion.start,
        stepsize_controller=controller, max_steps=20_000, **settings,
    )  # fmt: skip


@pytest.mark.long
def test_diffrax_finds_the_motion_and_loads_of_simulate(simulation):
    run = simulate(simulation, assembly_errors(simulation.model, TILTED))
    motion = equations_of_motion(simulation, assembly_errors(simulation.model, TILTED))
    assert motion.jumps == (0.01,) and int(motion.status) == 0
    solution = solved(motion, 0.02, saveat=diffrax.SaveAt(ts=run.times))
    np.testing.assert_allclose(solution.ys.position.joints[:, 0], run.motion.angle, rtol=0, atol=1e-9)
    at_all_times = eqx.filter_jit(jax.vmap(lambda t, y: (motion.loads(t, y)["D"].force, motion.energy(y))))
    forces, energies = at_all_times(solution.ts, solution.ys)
    np.testing.assert_allclose(forces, run.loads["D"].force, rtol=0, atol=1e-5 * np.abs(forces).max())
    np.testing.assert_allclose(motion.preload["D"].force, run.preload["D"].force, rtol=1e-9)
    np.testing.assert_allclose(energies, run.energy.total, rtol=1e-7)
    kept = energies - solution.ys.integrals.work + solution.ys.integrals.dissipation
    np.testing.assert_allclose(kept, kept[0], rtol=0, atol=1e-8)


@pytest.mark.long
def test_an_event_ends_it(simulation):
    motion = equations_of_motion(simulation)
    aim = motion.start.position.joints[0] + 1e-3
    event = diffrax.Event(lambda t, y, args, **_: y.position.joints[0] - aim, optx_root_find())
    solution = solved(motion, 0.02, event=event)
    assert solution.event_mask
    np.testing.assert_allclose(solution.ys.position.joints[0, 0], aim, rtol=0, atol=1e-8)


def optx_root_find():
    import optimistix

    return optimistix.Newton(1e-10, 1e-10)


@pytest.mark.long
def test_its_derivatives_are_those_of_differences(simulation):
    def end(tilt):
        motion = equations_of_motion(simulation, assembly_errors(simulation.model, {"D.delta_x": tilt}))
        solution = diffrax.diffeqsolve(
            diffrax.ODETerm(motion), diffrax.Tsit5(scan_kind="bounded"), 0.0, 2e-3, 2e-5, motion.start, max_steps=200
        )
        return solution.ys.integrals.moment_square[0, -1]

    slope = jax.jit(jax.grad(end))(2e-3)
    change = (jax.jit(end)(2e-3 + 1e-6) - jax.jit(end)(2e-3 - 1e-6)) / 2e-6
    np.testing.assert_allclose(slope, change, rtol=1e-6)


@pytest.mark.long
def test_the_field_is_that_of_the_equations_before_and_after_a_jump(simulation):
    motion = equations_of_motion(simulation)

    @eqx.filter_jit
    def both(t, phase):
        conditions = dataclasses.replace(motion._conditions(t), phase=phase)
        return motion(t, motion.start), at_instant(t, motion.start, conditions)[2].coordinates

    for t, phase in ((0.00999, 0), (0.01, 1), (0.015, 1)):
        rate, wanted = both(jnp.asarray(t), jnp.asarray(phase, jnp.int32))
        np.testing.assert_allclose(rate.velocity.joints, wanted.joints, rtol=1e-9, atol=1e-9)
    batch = jax.jit(jax.vmap(lambda tilt: equations_of_motion(
        simulation, assembly_errors(simulation.model, {"D.delta_x": tilt})).preload["D"].moment
    ))(jnp.array([0.0, 1e-3]))  # fmt: skip
    assert batch.shape == (2, 3) and np.abs(batch[1] - batch[0]).max() > 0.1


def test_a_start_that_the_caller_gives(simulation):
    state = equations_of_motion(simulation).start
    moving = State(state.position, jax.tree.map(lambda x: x + 0.1, state.velocity))
    motion = equations_of_motion(dataclasses.replace(simulation, start=moving))
    np.testing.assert_array_equal(motion.start.velocity.joints, moving.velocity.joints)
    assert np.isnan(motion.preload["A"].force).all()
