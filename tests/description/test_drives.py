"""Drives: values, derivatives, jumps by phase, JAX's transformations, refusals."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rfem_jax import (
    MomentFunction,
    MomentRamp,
    MomentTable,
    PrescribedFunction,
    PrescribedRate,
    PrescribedSpinUp,
    PrescribedTable,
)
from tests.derivatives import check_derivatives

RAMP = MomentRamp("A", 1.5, 0.1)
TABLE = MomentTable("A", [0.0, 0.2, 0.2, 0.3, 0.6], [1.0, 2.0, -1.0, 0.0, 3.0])
WAVE = MomentFunction("A", lambda t, phase: jnp.where(phase == 0, jnp.cos(t), -t), (0.5,))
SLOW = PrescribedRate("A", 2.0, 0.4)
STEADY = PrescribedRate("A", "60 rpm")
KNOTS = np.linspace(0.0, 1.0, 9)
SPLINE = PrescribedTable("A", KNOTS, np.sin(3 * KNOTS) * KNOTS)
SWING = PrescribedFunction("A", lambda t: 0.4 * (1 - jnp.cos(3 * t)))


def spin_up(t, phase):
    """Simo and Vu-Quoc 1986, shortened to 1.5 s."""
    rising = 2.0 * (t**2 / 2 + (1.5 / (2 * jnp.pi)) ** 2 * (jnp.cos(2 * jnp.pi * t / 1.5) - 1))
    return jnp.where(phase == 0, rising, 3.0 * t - 2.25)


SPIN = PrescribedFunction("A", spin_up, breakpoints=["1500 ms"])
SPIN_UP = PrescribedSpinUp("A", 3.0, "1500 ms")
MOMENTS = [RAMP, TABLE, WAVE]
PRESCRIBED = [SLOW, STEADY, SPLINE, SWING, SPIN, SPIN_UP]


def phase_at(drive, t):
    return sum(t >= end for end in drive.breakpoints())


def test_spin_up_is_the_law_of_the_benchmark():
    for t in (0.0, 0.3, 0.8, 1.4999, 1.5, 2.7):
        phase = phase_at(SPIN_UP, t)
        expected = SPIN.motion_at(t, phase)
        np.testing.assert_allclose(SPIN_UP.motion_at(t, phase), expected, rtol=1e-12, atol=1e-14)


def test_ramp_is_equation_21():
    assert RAMP.breakpoints() == (0.1,)
    assert float(RAMP.moment_at(0.0, 0)) == 0.0
    assert float(RAMP.moment_at(0.04, 0)) == pytest.approx(0.6, rel=1e-15)
    assert float(RAMP.moment_at(0.3, 1)) == 0.0
    assert float(MomentRamp("A", "1500 Nmm", "100 ms").moment_at(0.1, 0)) == 1.5


def test_a_jump_takes_the_side_of_its_phase_and_not_of_the_time():
    """At the jump, and a rounding error on the wrong side of it, the piece is that of the phase."""
    for t in (np.nextafter(0.1, 0), 0.1, np.nextafter(0.1, 1)):
        assert float(RAMP.moment_at(t, 0)) == pytest.approx(1.5, rel=1e-14)
        assert float(RAMP.moment_at(t, 1)) == 0.0
    for t in (np.nextafter(0.2, 0), 0.2, np.nextafter(0.2, 1)):
        assert float(TABLE.moment_at(t, 0)) == pytest.approx(2.0, rel=1e-14)
        assert float(TABLE.moment_at(t, 1)) == pytest.approx(-1.0, rel=1e-14)
    for t in (np.nextafter(0.6, 0), 0.6, np.nextafter(0.6, 1)):
        assert float(TABLE.moment_at(t, 1)) == pytest.approx(3.0, rel=1e-14)
        assert float(TABLE.moment_at(t, 2)) == 0.0


def test_table_is_linear_between_its_points():
    assert TABLE.breakpoints() == (0.2, 0.6)
    times = np.array([0.0, 0.05, 0.15, 0.25, 0.3, 0.45, 0.59, 0.7])
    found = [float(TABLE.moment_at(t, phase_at(TABLE, t))) for t in times]
    first = np.interp(times, [0.0, 0.2], [1.0, 2.0])
    second = np.interp(times, [0.2, 0.3, 0.6], [-1.0, 0.0, 3.0])
    expected = np.where(times < 0.2, first, np.where(times < 0.6, second, 0.0))
    np.testing.assert_allclose(found, expected, rtol=1e-14, atol=1e-15)


def test_moment_function_is_called_with_time_and_phase():
    assert WAVE.breakpoints() == (0.5,)
    assert float(WAVE.moment_at(0.5, 0)) == pytest.approx(np.cos(0.5))
    assert float(WAVE.moment_at(0.5, 1)) == -0.5


def test_prescribed_rate_rises_smoothly_and_stays():
    assert SLOW.breakpoints() == (0.4,) and STEADY.breakpoints() == ()
    np.testing.assert_allclose(SLOW.motion_at(0.0, 0), (0.0, 0.0, 0.0), atol=1e-300)
    for phase in (0, 1):  # angle, rate and acceleration are continuous where the rise ends
        np.testing.assert_allclose(SLOW.motion_at(0.4, phase), (0.4, 2.0, 0.0), rtol=1e-14, atol=1e-14)
    np.testing.assert_allclose(SLOW.motion_at(1.4, 1), (2.4, 2.0, 0.0), rtol=1e-14)
    x = 0.1 / 0.4
    assert float(SLOW.motion_at(0.1, 0)[1]) == pytest.approx(2 * (3 * x**2 - 2 * x**3), rel=1e-14)
    turned = np.array(STEADY.motion_at(0.25, 0))
    np.testing.assert_allclose(turned, (np.pi / 2, 2 * np.pi, 0.0), rtol=1e-14)


def test_spline_passes_its_points_and_is_smooth():
    for t, angle in zip(KNOTS, np.sin(3 * KNOTS) * KNOTS):
        assert float(SPLINE.motion_at(t, 0)[0]) == pytest.approx(angle, abs=1e-15)
    for t in KNOTS[1:-1]:
        before, after = SPLINE.motion_at(t - 1e-12, 0), SPLINE.motion_at(t + 1e-12, 0)
        np.testing.assert_allclose(before, after, rtol=1e-9, atol=1e-9)
    exact = np.sin(3 * 0.3) * 0.3
    assert float(SPLINE.motion_at(0.3, 0)[0]) == pytest.approx(exact, abs=1e-3)
    line = PrescribedTable("A", [0.0, "500 ms"], [0, "90 deg"])
    np.testing.assert_allclose(line.motion_at(0.25, 0), (np.pi / 4, np.pi, 0.0), atol=1e-14)


def test_prescribed_function_has_its_exact_derivatives():
    t = 0.7
    exact = 0.4 * (1 - np.cos(3 * t)), 1.2 * np.sin(3 * t), 3.6 * np.cos(3 * t)
    np.testing.assert_allclose(SWING.motion_at(t, 0), exact, rtol=1e-14)
    np.testing.assert_allclose(SPIN.motion_at(2.0, 1), (3.75, 3.0, 0.0), rtol=1e-14)
    np.testing.assert_allclose(SPIN.motion_at(1.5, 0), SPIN.motion_at(1.5, 1), rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("drive", PRESCRIBED, ids=lambda drive: type(drive).__name__)
@pytest.mark.parametrize("t", [0.05, 0.21, 0.37, 0.55, 0.81])
def test_rate_and_acceleration_are_the_differences_of_the_angle(drive, t):
    step, phase = 1e-5, phase_at(drive, t)
    (a, ra, _), (_, r, acc), (b, rb, _) = (drive.motion_at(t + s, phase) for s in (-step, 0.0, step))
    np.testing.assert_allclose(r, (b - a) / (2 * step), rtol=1e-7, atol=1e-8)
    np.testing.assert_allclose(acc, (rb - ra) / (2 * step), rtol=1e-7, atol=1e-7)


@pytest.mark.slow
@pytest.mark.parametrize("drive", MOMENTS + PRESCRIBED, ids=lambda drive: type(drive).__name__)
def test_drives_work_under_all_transformations(drive):
    """jit with drive, time and phase traced; vmap over times; forward and reverse derivatives."""

    def value(drive, t, phase):
        return drive.moment_at(t, phase) if hasattr(drive, "moment_at") else drive.motion_at(t, phase)[0]

    t, phase = jnp.asarray(0.35), jnp.asarray(phase_at(drive, 0.35), jnp.int32)
    plain = value(drive, 0.35, int(phase))
    assert plain.dtype == jnp.float64 and plain.shape == ()
    np.testing.assert_allclose(jax.jit(value)(drive, t, phase), plain, rtol=1e-14)

    times = jnp.linspace(0.0, 0.9, 7)
    phases = jnp.asarray([phase_at(drive, float(t)) for t in times], jnp.int32)
    batch = jax.vmap(value, (None, 0, 0))(drive, times, phases)
    single = [value(drive, float(t), int(p)) for t, p in zip(times, phases)]
    np.testing.assert_allclose(batch, jnp.stack(single), rtol=1e-13, atol=1e-15)

    check_derivatives(lambda t: value(drive, t, phase), 0.35, 1e-6, reverse=1e-13, differences=1e-7)


def test_all_numeric_leaves_are_double_precision_arrays():
    for drive in MOMENTS + PRESCRIBED:
        leaves = jax.tree.leaves(drive)
        assert all(isinstance(leaf, jax.Array) and leaf.dtype == jnp.float64 for leaf in leaves)
    assert len(jax.tree.leaves(RAMP)) == len(jax.tree.leaves(TABLE)) == 1


def test_values_are_differentiable_and_new_ones_do_not_compile_anew():
    @eqx.filter_jit
    @eqx.debug.assert_max_traces(max_traces=1)
    def moment(drive, t):
        return drive.moment_at(t, 0)

    for peak in (1.5, 2.5):
        found = float(moment(MomentRamp("A", peak, 0.1), jnp.asarray(0.05)))
        assert found == pytest.approx(peak / 2)
    derivative = jax.grad(lambda peak: MomentRamp("A", peak, 0.1).moment_at(0.05, 0))(2.0)
    assert float(derivative) == pytest.approx(0.5)
    weights = jax.grad(lambda m: MomentTable("A", [0, 1], m).moment_at(0.25, 0))(jnp.ones(2))
    np.testing.assert_allclose(weights, [0.75, 0.25])
    angle = jax.grad(lambda rate: PrescribedRate("A", rate, 0.4).motion_at(0.4, 1)[0])(2.0)
    assert float(angle) == pytest.approx(0.2)


def test_a_function_may_be_a_module_with_parameters():
    class Sine(eqx.Module):
        amplitude: jax.Array

        def __call__(self, t, phase):
            return self.amplitude * jnp.sin(t)

    drive = MomentFunction("A", Sine(jnp.asarray(2.0)))
    derivative = jax.grad(lambda drive: drive.moment_at(0.5, 0))(drive)
    assert float(derivative.function.amplitude) == pytest.approx(np.sin(0.5))


def test_single_precision_is_refused_with_the_line_to_paste(refused):
    with jax.enable_x64(False):
        for build in (
            lambda: MomentRamp("A", 1.5, 0.1),
            lambda: MomentTable("A", [0, 1], [1, 1]),
            lambda: MomentFunction("A", lambda t, phase: t),
            lambda: PrescribedRate("A", 1.0),
            lambda: PrescribedTable("A", [0, 1], [0, 1]),
            lambda: PrescribedFunction("A", lambda t: t),
        ):
            with refused('jax.config.update("jax_enable_x64", True)'):
                build()


@pytest.mark.parametrize(
    ("build", "pieces"),
    [
        (lambda: MomentRamp("A.x", 1.5, 0.1), ("`joint` of the drive",)),
        (lambda: MomentRamp("A", "1.5 N", 0.1), ("`moment`", "a force")),
        (lambda: MomentRamp("A", 1.5, 0.0), ("`rise_time`", "greater than 0")),
        (lambda: MomentRamp("A", 1.5, "1 m"), ("`rise_time`", "a length")),
        (lambda: jax.grad(lambda m: MomentRamp("A", m, 1.0).moment[0])(jnp.ones(2)), ("scalar",)),
        (lambda: MomentTable("A", [0.1, 0.2], [1, 1]), ("`times`", "first 0")),
        (lambda: MomentTable("A", [0.0], [1]), ("`times`", "at least two")),
        (lambda: MomentTable("A", [0, 2, 1], [1, 1, 1]), ("`times`", "1.0 follows 2.0")),
        (lambda: MomentTable("A", [0, 1, 1, 1, 2], [1] * 5), ("`times`", "only once")),
        (lambda: MomentTable("A", [0, 0, 1], [1] * 3), ("`times`", "neither the first")),
        (lambda: MomentTable("A", [0, 1, 1], [1] * 3), ("`times`", "nor the last")),
        (lambda: MomentTable("A", [0, 1], [1, 1, 1]), ("`moments`", "has 3")),
        (lambda: MomentTable("A", [0, 1], [1, "1 deg"]), ("`moments` (entry 2)", "an angle")),
        (lambda: MomentFunction("A", 3.0), ("`function`",)),
        (lambda: MomentFunction("A", lambda t: t), ("`function`", "(t, phase)", "TypeError")),
        (lambda: MomentFunction("A", lambda t, phase: 1.5), ("`function`", "scalar")),
        (lambda: MomentFunction("A", lambda t, p: jnp.ones(2)), ("`function`", "scalar")),
        (lambda: MomentFunction("A", lambda t, p: t, (0.0,)), ("`breakpoints`", "above 0")),
        (lambda: MomentFunction("A", lambda t, p: t, (2, 1)), ("`breakpoints`", "increasing")),
        (lambda: MomentFunction("A", lambda t, p: t, 1.0), ("`breakpoints`", "list")),
        (lambda: PrescribedRate("A", "1 m/s"), ("`rate`",)),
        (lambda: PrescribedRate("A", 1.0, -0.1), ("`rise_time`", "negative")),
        (lambda: PrescribedTable("A", [0, 1, 1], [0, 1, 1]), ("`times`", "increasing")),
        (lambda: PrescribedTable("A", [0, 1], [0.1, 1]), ("`angles`", "0.1")),
        (lambda: PrescribedTable("A", [0, 1], [0]), ("`angles`", "has 1")),
        (lambda: PrescribedTable("A", [0, 1], [0, "1 m"]), ("`angles` (entry 2)", "a length")),
        (lambda: PrescribedFunction("A", lambda t: t + 1), ("`function`", "0 at t = 0", "1.0")),
        (lambda: PrescribedFunction("A", lambda t, p: t), ("`function`", "(t)")),
        (lambda: PrescribedFunction("A", lambda t: t, (1.0,)), ("`function`", "(t, phase)")),
    ],
)
def test_bad_drives_are_refused(refused, build, pieces):
    with refused(*pieces):
        build()
