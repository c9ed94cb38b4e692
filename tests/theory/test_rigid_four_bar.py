"""A rigid four-bar against its closed-form kinetics, wherever its loop is cut.

Motion: Lagrange's equation of the crank angle. Loads: planar Newton-Euler equations of the three
bodies. Parallel axes make the out-of-plane reactions redundant; the minimum-norm ones are zero.
"""

import equinox as eqx
import jax
import numpy as np
import pytest

from rfem_jax import MomentRamp, PrescribedRate, RungeKutta4, Simulation, assemble, assembly_errors, simulate

MOMENT, RISE, DURATION = 1.5, 0.1, 0.14
CUTS = ("C", "B", "D")
RATE, RISE_TIME, TURNING = 20.0, 0.1, 0.25


@pytest.fixture(scope="module", params=CUTS)
def released(request, four_bar):
    """The cut, and the run from rest under the moment ramp."""
    model = four_bar(request.param)
    run = simulate(
        Simulation(
            model,
            drive=MomentRamp("A", MOMENT, RISE),
            duration=DURATION,
            method=RungeKutta4(step=1e-4),
            save_every=0.01,
        )
    )
    return request.param, jax.tree.map(np.asarray, run)


@pytest.fixture(scope="module")
def exact_motion(exact_four_bar, released):
    times = released[1].times

    def moment(t, piece):
        return MOMENT * t / RISE if piece == 0 else 0.0

    return exact_four_bar.motion(moment, (RISE, DURATION), times), moment


def wrapped(angle):
    return np.angle(np.exp(1j * np.asarray(angle)))


@pytest.mark.long
def test_motion_follows_lagranges_equation(released, exact_motion, exact_four_bar):
    cut, run = released
    (crank, rate), _ = exact_motion
    assert run.status == 0 and crank[-1] - crank[0] > 1.0
    np.testing.assert_allclose(run.motion.angle, crank, atol=1e-8)
    np.testing.assert_allclose(run.motion.rate, rate, atol=1e-6)
    angles = np.array([exact_four_bar.angles(a) for a in crank])
    relative = {
        "C": {"B": angles[:, 1] - angles[:, 0], "D": angles[:, 2]},
        "B": {"D": angles[:, 2], "C": angles[:, 1] + np.pi - angles[:, 2]},
        "D": {"B": angles[:, 1] - angles[:, 0], "C": angles[:, 2] + np.pi - angles[:, 1]},
    }[cut]
    for joint, expected in relative.items():
        np.testing.assert_allclose(wrapped(run.motion.angles[joint] - expected), 0.0, atol=1e-8)


def test_joint_forces_are_those_of_newton_and_euler(released, exact_motion, exact_four_bar, four_bar_loads):
    cut, run = released
    (crank, rate), moment = exact_motion
    largest = np.abs(run.loads["A"].force).max()
    assert largest > 50.0
    for i, t in enumerate(run.times):
        # The moment has jumped at the saved time that is the end of the ramp's step.
        applied = moment(t, 0 if t < RISE + 1e-9 else 1)
        acceleration = exact_four_bar.crank_acceleration(crank[i], rate[i], applied)
        forces, needed = four_bar_loads(cut, crank[i], rate[i], acceleration)
        np.testing.assert_allclose(needed, applied, atol=1e-9)  # the two theories agree
        for joint, force in forces.items():
            np.testing.assert_allclose(run.loads[joint].force[i, [0, 2]], force, atol=2e-6 * largest)


def test_nothing_happens_out_of_the_plane(released):
    _, run = released
    largest = np.abs(run.loads["A"].force).max()
    for load in run.loads.values():
        assert np.abs(load.force[:, 1]).max() < 1e-10 * largest
        assert np.abs(load.moment).max() < 1e-10 * largest
    assert run.checks.hinge_moment_error < 1e-10 and run.checks.momentum_balance_error < 1e-9


def test_energy_and_closure(released):
    _, run = released
    assert run.checks.energy_balance_error < 1e-7 and run.checks.closure_drift < 1e-9
    work = np.max(run.energy.work)
    assert work > 0.5  # J, so the balance is about something


def test_static_start_holds_the_crank(released, exact_four_bar, four_bar_loads):
    cut, run = released
    forces, moment = four_bar_loads(cut, -np.pi / 2.0, 0.0, 0.0)
    for joint, force in forces.items():
        np.testing.assert_allclose(run.preload[joint].force[[0, 2]], force, atol=1e-8)
    np.testing.assert_allclose(run.preload["A"].moment, [0.0, moment, 0.0], atol=1e-9)


@pytest.mark.long
@pytest.mark.parametrize("rise_time", [0.0, RISE_TIME])
def test_prescribed_crank(four_bar, exact_four_bar, four_bar_loads, rise_time):
    """The angle is what was asked for, the drive's moment what Newton and Euler need for it."""
    run = simulate(
        Simulation(
            four_bar("C"),
            drive=PrescribedRate("A", RATE, rise_time),
            duration=TURNING,
            method=RungeKutta4(step=2e-4),
            save_every=0.01,
        )
    )
    t = np.asarray(run.times)
    x = t / rise_time if rise_time else np.full_like(t, 2.0)
    smooth = RATE * rise_time * (x**3 - x**4 / 2.0), RATE * (3.0 * x**2 - 2.0 * x**3)
    turned = np.where(x < 1.0, smooth[0], RATE * (t - rise_time / 2.0))
    rate = np.where(x < 1.0, smooth[1], RATE)
    rise = 6.0 * RATE * (x - x**2) / rise_time if rise_time else np.zeros_like(t)
    acceleration = np.where(x < 1.0, rise, 0.0)
    assert run.status == 0
    np.testing.assert_allclose(run.motion.angle, -np.pi / 2.0 + turned, atol=1e-12)
    np.testing.assert_allclose(run.motion.rate, rate, atol=1e-12)
    expected = [four_bar_loads("C", *state) for state in zip(-np.pi / 2.0 + turned, rate, acceleration)]
    moments = np.array([moment for _, moment in expected])
    largest = np.abs(run.loads["A"].force).max()
    np.testing.assert_allclose(run.motion.drive_moment, moments, atol=2e-6 * largest * 0.3)
    np.testing.assert_array_equal(run.motion.drive_moment, run.loads["A"].moment[:, 1])
    for joint in "ABCD":
        forces = np.array([forces[joint] for forces, _ in expected])
        np.testing.assert_allclose(run.loads[joint].force[:, np.array([0, 2])], forces, atol=2e-6 * largest)
    for joint, angle in (("B", lambda a: a[1] - a[0]), ("D", lambda a: a[2])):
        angles = [angle(exact_four_bar.angles(a)) for a in -np.pi / 2.0 + turned]
        np.testing.assert_allclose(wrapped(run.motion.angles[joint] - np.array(angles)), 0.0, atol=1e-8)
    energy = np.asarray(run.energy.total)
    np.testing.assert_allclose(run.energy.work, energy - energy[0], atol=1e-7 * np.abs(energy).max())
    assert np.ptp(energy) > 0.02  # J: work is done


RELATED = {"D.delta_x": 0.004, "D.delta_z": -0.003, "D.d_y": 3e-4, "D.d_x": 2e-4}


def _resultants(loads):
    """Loads of all joints as numbers that no choice of frame or of sign changes."""
    return np.stack(
        [
            part
            for joint in "ABCD"
            for part in (
                np.linalg.norm(loads[joint].force, axis=1),
                np.linalg.norm(loads[joint].moment, axis=1),
                np.abs(loads[joint].force[:, 1]),
            )
        ]
    )


@pytest.mark.long
def test_flexible_loop_with_errors_moves_the_same_wherever_it_is_cut(four_bar):
    """Only the coupler bends, and has the same link frame with the loop cut at C or D."""
    runs = {}
    for cut in ("C", "D"):
        model = four_bar(cut, rigid="crank rocker", rfes=3, damping=2e-5)
        runs[cut] = jax.tree.map(
            np.asarray,
            simulate(
                Simulation(
                    model,
                    drive=MomentRamp("A", MOMENT, 0.02),
                    duration=0.03,
                    method=RungeKutta4(step=2e-5),
                    save_every=1e-3,
                ),
                assembly_errors(model, RELATED),
            ),
        )
        assert runs[cut].status == 0
    one, other = (_resultants(runs[cut].loads) for cut in ("C", "D"))
    scale = one.max(axis=1, keepdims=True)
    assert (scale > 0.1).all()  # errors load every joint in every way
    assert (np.abs(one - other) < 1e-6 * scale).all()
    np.testing.assert_allclose(runs["D"].motion.angle, runs["C"].motion.angle, atol=1e-8)
    for metric in ("rms_force", "rms_moment", "max_axial_force", "max_normal_force"):
        one, other = getattr(runs["C"].metrics, metric), getattr(runs["D"].metrics, metric)
        for joint in "ABCD":
            np.testing.assert_allclose(one[joint], other[joint], rtol=1e-6)
    # Cut at B, the coupler's link frame is at its other end, which the springs, linear in the
    # deflections from it, notice in second order.
    model = four_bar("B", rigid="crank rocker", rfes=3)
    result = eqx.filter_jit(assemble)(model, assembly_errors(model, RELATED))
    assert result.status == 0
    preload = {name: jax.tree.map(lambda x: x[None], load) for name, load in result.preload.items()}
    expected = {name: jax.tree.map(lambda x: x[None], runs["C"].preload[name]) for name in "ABCD"}
    np.testing.assert_allclose(_resultants(preload), _resultants(expected), rtol=5e-3)
