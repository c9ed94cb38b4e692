"""Steps end at the rows of tables over time, so that a pulse shorter than a step is not passed over."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rfem_jax import (
    Automatic,
    Explicit,
    GeneralisedAlpha,
    Joint,
    Mechanism,
    MomentFunction,
    MomentTable,
    PointMoment,
    PrescribedSpinUp,
    PrescribedTable,
    RungeKutta4,
    Simulation,
    choose_method,
    discretise,
    simulate,
)
from rfem_jax.simulation.system.time_grid import divide_time, of_any_step
from tests.mechanisms import link

TIMES, MOMENTS = (0.0, 0.02, 0.0202, 0.0204, 1.0), (0.0, 0.0, 40.0, 0.0, 0.0)
IMPULSE, DURATION, SAVE = 8e-3, 0.05, 5e-3  # N m s, s
LONG = GeneralisedAlpha(step=5e-3)
ARM = (0.0, 0.0, 0.0)


@pytest.fixture(scope="module")
def bar():
    """A rigid bar on a hinge, without weight."""
    joint = Joint("A", "base", "bar")
    return discretise(Mechanism([link("bar", 0.3)], [joint], driven_joint="A", gravity=ARM))


def inertia():
    """About the hinge [kg m^2]: of a bar of square section."""
    mass = 7850.0 * 0.01**2 * 0.3
    return mass * (0.3**2 / 3.0 + 0.01**2 / 12.0)


def run_of(model, drive, method, **more):
    settings = {"duration": DURATION, "save_every": SAVE, **more}
    return simulate(Simulation(model, drive=drive, method=method, **settings))


def test_rows_divide_intervals_into_parts():
    rows = (0.0, 0.01, 0.0201, 0.0202, 0.0303, 1.0)
    grid, steps = divide_time(0.05, 1e-3, 1e-2, (0.025,), restarting=True, rows=rows)
    assert steps == 10  # in the longest part
    # Saved times and restarts are those of a grid without rows.
    plain, _ = divide_time(0.05, 1e-3, 1e-2, (0.025,), restarting=True)
    for name in ("starts", "lengths", "phases", "restarts"):
        np.testing.assert_array_equal(getattr(grid, name), getattr(plain, name))
    assert grid.parts is not None
    np.testing.assert_allclose(grid.parts.lengths.sum(axis=1), grid.lengths, rtol=0, atol=1e-15)
    np.testing.assert_allclose(grid.distinct[grid.parts.kinds], grid.parts.lengths, rtol=0, atol=1e-13)
    ends = grid.starts[:, None] + np.cumsum(grid.parts.lengths, axis=1)
    for row in rows[1:-1]:
        assert np.abs(ends - row).min() < 1e-15
    # Pieces of a grid have the parts of their intervals, and none of length zero behind the end.
    last = grid.piece(4, 6)
    assert last.parts is not None and last.parts.lengths.shape == (6, 3)
    np.testing.assert_allclose(last.parts.lengths.sum(axis=1), last.lengths, rtol=0, atol=1e-15)
    assert not last.parts.lengths[-1].any() and not last.distinct[last.parts.kinds[-1]].any()
    # Rows at the ends of intervals divide nothing.
    assert divide_time(0.05, 1e-3, 1e-2, (), rows=(0.0, 0.02, 0.05, 0.07))[0].parts is None


def test_steps_between_rows_are_not_more_than_all_others():
    few, _ = divide_time(0.05, 5e-3, 5e-3, (), rows=(0.0201, 0.0202))
    assert few.steps_per_row == 4 and few.total_steps(1) <= 2 * 13
    assert divide_time(0.05, 1e-3, 5e-3, (), rows=(0.0201, 0.0202))[0].steps_per_row == 8
    dense = tuple(np.linspace(0.0, 0.05, 2001))
    many, steps = divide_time(0.05, 5e-3, 5e-3, (), rows=dense)
    assert many.steps_per_row == 1 and steps == 1 and many.total_steps(steps) == 2001
    assert divide_time(0.05, 5e-3, 5e-3, (), rows=dense, per_row=3)[0].total_steps(1) == 6001
    shared = of_any_step(LONG, few, 1)[1].parts
    assert shared is not None and shared.most is None


@pytest.mark.long
@pytest.mark.parametrize(
    "method",
    [
        LONG,
        GeneralisedAlpha(step=5e-3, steps_per_row=1),
        GeneralisedAlpha(step=7e-4, spectral_radius=0.2, steps_per_row=1),
        RungeKutta4(step=5e-3),
        Explicit("dopri5", rtol=1e-9, atol=1e-12),
        Automatic(),
    ],
    ids=lambda method: f"{method.name} {method.step} {getattr(method, 'steps_per_row', '')}",
)
def test_a_pulse_within_a_step_gives_its_impulse(bar, method):
    drive = MomentTable("A", TIMES, MOMENTS)
    method = choose_method(bar, method, drive, DURATION, save_every=SAVE)
    run = run_of(bar, drive, method)
    assert len(run.times) == 11  # rows are no saved times
    np.testing.assert_allclose(run.motion.rate[-1], IMPULSE / inertia(), rtol=1e-9)
    if method.name == "rk4" or getattr(method, "steps_per_row", 1) != 1:
        assert int(run.status) == 0 and float(run.checks.energy_balance_error) < 5e-3


@pytest.mark.slow
@pytest.mark.parametrize("jump", [False, True])
def test_an_uneven_pulse_gives_its_impulse(bar, jump):
    """Rows of any distances, one of them a jump: impulse by the trapezoidal rule, exact for straight lines."""
    times = [0.0, 0.0071, 0.0072, 0.00745, 0.0121, 0.0122, 0.0122 if jump else 0.0124, 0.0131, 0.05]
    moments = [0.0, 0.0, 30.0, -4.0, 1.0, 25.0, -20.0, 0.0, 0.0]
    drive = MomentTable("A", times, moments)
    run = run_of(bar, drive, GeneralisedAlpha(step=2e-3, steps_per_row=1))
    wanted = np.trapezoid(moments, times) / inertia()
    np.testing.assert_allclose(run.motion.rate[-1], wanted, rtol=1e-9)


@pytest.mark.long
def test_a_moment_at_a_point_and_a_prescribed_motion():
    """Tables of forces and of prescribed motions are seen as well: a bump that is over within a step."""
    joint = Joint("A", "base", "bar")
    rows = [[0.0, moment, 0.0] for moment in MOMENTS]
    pulse = PointMoment("pulse", "bar", 0.1, rows, times=TIMES)
    model = discretise(Mechanism([link("bar", 0.3)], [joint], forces=[pulse], driven_joint="A", gravity=ARM))
    run = run_of(model, None, LONG)
    np.testing.assert_allclose(run.motion.rate[-1], IMPULSE / inertia(), rtol=1e-9)

    there = (0.0, 0.0201, 0.0202, 0.0203, 0.0204, 0.0205, 0.05)
    bump = PrescribedTable("A", there, (0.0, 0.0, 1e-5, 2e-5, 1e-5, 0.0, 0.0))
    settings = {"drive": bump, "method": LONG}
    seen = float(run_of(model, **settings).metrics.max_normal_force["A"])
    fine = float(run_of(model, drive=bump, method=GeneralisedAlpha(step=2e-6)).metrics.max_normal_force["A"])
    assert seen == pytest.approx(fine, rel=0.02) and fine > 10.0


@pytest.mark.slow
def test_a_rise_within_a_step_is_seen(bar):
    """The acceleration of a spin-up vanishes at both of its ends."""
    drive = PrescribedSpinUp("A", 30.0, 1e-3)
    found = [run_of(bar, drive, GeneralisedAlpha(step=step)).metrics.mean_square_force["A"] for step in (5e-3, 5e-6)]
    np.testing.assert_allclose(*found, rtol=0.05)


@pytest.mark.slow
def test_steps_of_many_lengths_stay_smooth(bar):
    """A smooth moment in rows of irregular distances, each a step: as accurate as with even ones, and accelerations do
    not oscillate from step to step."""
    rng = np.random.default_rng(3)
    times = np.concatenate([[0.0], np.sort(rng.uniform(0.0, DURATION, 200)), [DURATION]])
    table = MomentTable("A", tuple(times), tuple(np.sin(120.0 * times)))
    run = run_of(bar, table, LONG)
    smooth = MomentFunction("A", lambda t, phase: jnp.sin(120.0 * t))
    wanted = run_of(bar, smooth, RungeKutta4(step=1e-4))
    np.testing.assert_allclose(
        run.motion.rate, wanted.motion.rate, rtol=0, atol=2e-3 * float(np.abs(wanted.motion.rate).max())
    )
    np.testing.assert_allclose(
        run.motion.angle, wanted.motion.angle, rtol=0, atol=2e-3 * float(np.abs(wanted.motion.angle).max())
    )
    scale = float(np.abs(wanted.loads["A"].force).max())
    np.testing.assert_allclose(run.loads["A"].force, wanted.loads["A"].force, rtol=0, atol=2e-3 * scale)


@pytest.mark.long
def test_derivatives_by_the_numbers_of_a_table(bar):
    """In both modes, where steps have different lengths; and new numbers are no new program."""
    traced = []

    def rate(moments):
        traced.append(None)
        return run_of(bar, MomentTable("A", TIMES, moments), LONG).motion.rate[-1]

    compiled = jax.jit(rate)
    for factor in (1.0, 2.0):
        moments = factor * jnp.asarray(MOMENTS)
        np.testing.assert_allclose(compiled(moments), factor * IMPULSE / inertia(), rtol=1e-9)
    assert len(traced) == 1
    moments = jnp.asarray(MOMENTS)
    wanted = [0.5 * (0.0202 - 0.0), 0.5 * (0.0204 - 0.02), 0.5 * (DURATION - 0.0202)]
    for derivative in (jax.jacfwd(rate), jax.jacrev(rate)):
        np.testing.assert_allclose(jax.jit(derivative)(moments)[1:3] * inertia(), wanted[:2], rtol=1e-6)
    samples = jax.jit(jax.vmap(rate))(jnp.outer(jnp.asarray([1.0, -0.5]), moments))
    np.testing.assert_allclose(samples, np.array([1.0, -0.5]) * IMPULSE / inertia(), rtol=1e-9)
