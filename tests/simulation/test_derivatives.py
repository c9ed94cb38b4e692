"""Derivatives through assembly, the drive's jump and the whole motion: forward = reverse = differences.

The study's four-bar for 0.12 s on one discretisation, all kinds of errors on all sides of all joints,
all metrics.  Differences are the sixth-order combination of central differences at three distances
(Richardson's extrapolation).  Their error is rounding, 1e-14 of mean squares and 3e-13 of peaks: 1e-7 of a derivative
at steps small enough for an extrapolation error below 1e-7.
"""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rfem_jax import (
    Explicit,
    GeneralisedAlpha,
    MomentRamp,
    Problem,
    Simulation,
    assembly_errors,
    discretise,
    simulate,
)
from tests.mechanisms import arm, four_bar

pytestmark = pytest.mark.slow

KINDS = ("delta_x", "delta_z", "d_x", "d_y", "d_z")
# Every kind on the seat and on the bore, every joint on both sides, and all of joint D's seat.
NAMES = (
    *(f"D.{kind}" for kind in KINDS),
    "A.delta_x", "B.d_y", "C.d_z", "A.child.d_x", "B.child.delta_z",
    *(f"C.child.{kind}" for kind in KINDS),
    "D.child.d_y", "B.pin_tilt_x", "C.pin_tilt_z",
    "crank.length", "coupler.length", "rocker.twist",
)  # fmt: skip
ANGLES = ("delta_x", "delta_z", "pin_tilt_x", "pin_tilt_z", "twist")
IS_ANGLE = np.array([name.split(".")[-1] in ANGLES for name in NAMES])
TYPICAL = np.where(IS_ANGLE, np.radians(0.1), 1e-4)
POINT = (
    TYPICAL
    * np.random.default_rng(4).uniform(0.3, 1.0, len(NAMES))
    * np.where(np.arange(len(NAMES)) % 2 == 0, 1.0, -1.0)
)
STEPS = 0.015 * TYPICAL
# At zero error derivatives are small, and so is the extrapolation's error: five times the step for a fifth of the
# rounding.
STEPS_AT_ZERO = 0.075 * TYPICAL
METRICS = tuple(
    f"{joint}.{kind}"
    for joint in "ABCD"
    for kind in (
        "mean_square_force", "mean_square_moment", "rms_force", "rms_moment", "peak_force",
        "peak_moment", "preload_force_square", "preload_moment_square",
    )
) + ("angle_error", "end_energy")  # fmt: skip
# Newton's method converges to rounding: differences are those of the exact solution, as the derivatives are.
METHOD = GeneralisedAlpha(step=3e-3, corrections=9, tolerance=1e-14)


def stacked(problem, names=NAMES):
    """The metrics as a vector function of a vector of errors."""

    def function(point):
        values, _ = problem(dict(zip(names, point)))
        return jnp.stack([values[m.name] for m in problem.metrics])

    return function


def central_differences(function, point, steps):
    """Jacobian (metrics, errors) by differences of order 6, in one batched call."""
    distances = (-3, -2, -1, 1, 2, 3)
    shifts = np.concatenate([k * np.diag(steps) for k in distances])
    out = np.asarray(function(jnp.asarray(point + shifts))).reshape(6, len(point), -1)
    weights = np.array([-1.0, 9.0, -45.0, 45.0, -9.0, 1.0]) / 60.0
    return (np.tensordot(weights, out, axes=1) / steps[:, None]).T


@pytest.fixture(scope="module")
def problem():
    return Problem(
        Simulation(
            discretise(four_bar(3)), drive=MomentRamp("A", 1.5, 0.06), duration=0.12, method=METHOD, save_every=2e-2
        ),
        METRICS,
    )


@pytest.fixture(scope="module")
def values(problem):
    return jax.jit(jax.vmap(stacked(problem)))


@pytest.fixture(scope="module")
def forward(problem):
    return jax.jit(jax.jacfwd(stacked(problem)))


@pytest.fixture(scope="module")
def jacobian(forward):
    return np.asarray(forward(jnp.asarray(POINT)))


def influence(jacobian):
    """Scale (metrics, errors): derivatives times typical errors, at least a hundredth of the largest of the metric."""
    change = np.abs(jacobian) * TYPICAL
    return np.maximum(change, 1e-2 * change.max(axis=1, keepdims=True))


def test_forward_mode_equals_differences(values, jacobian):
    differences = central_differences(values, POINT, STEPS)
    assert np.all(np.isfinite(jacobian))
    gap = np.abs(jacobian - differences) * TYPICAL / influence(jacobian)
    metric, error = np.unravel_index(gap.argmax(), gap.shape)
    assert gap.max() < 1e-6, f"{METRICS[metric]} by {NAMES[error]}"


def test_reverse_mode_equals_forward_mode(problem, jacobian):
    """The gradient of a sum of all metrics, each weighted so that it counts; by XLA, which has compiled wrong programs
    of loops in reverse mode, where the Jacobian is NumPy's."""
    weights = np.random.default_rng(7).uniform(0.5, 1.0, len(METRICS))
    weights = weights / (np.abs(jacobian) * TYPICAL).max(axis=1)
    function = stacked(problem)
    reverse = jax.jit(jax.grad(lambda x: jnp.asarray(weights) @ function(x)))(jnp.asarray(POINT))
    expected = weights @ jacobian
    scale = np.abs(expected * TYPICAL).max()
    np.testing.assert_allclose(np.asarray(reverse) * TYPICAL, expected * TYPICAL, rtol=1e-8, atol=1e-10 * scale)


def test_at_zero_error(values, forward):
    """What vanishes by symmetry is compared relative to the Hessian times a typical error."""
    smooth = [i for i, m in enumerate(METRICS) if not ("moment" in m and "square" not in m)]
    zero = np.zeros(len(NAMES))
    found = np.asarray(forward(jnp.asarray(zero)))[smooth]
    # Twice the same points: as many as `central_differences` has, for one compiled program.
    points = np.concatenate([s * np.diag(STEPS_AT_ZERO) for s in (-1, 0, 1, -1, 0, 1)])
    out = np.asarray(values(jnp.asarray(points))).reshape(6, len(NAMES), -1)
    hessian = np.abs((out[0] - 2 * out[1] + out[2]) / STEPS_AT_ZERO[:, None] ** 2).T[smooth] * TYPICAL
    differences = central_differences(values, zero, STEPS_AT_ZERO)[smooth] * TYPICAL
    found, hessian = found * TYPICAL, hessian * TYPICAL
    assert np.all(np.isfinite(found))
    scale = np.maximum(np.abs(differences), hessian)
    scale = np.maximum(scale, 1e-3 * scale.max(axis=1, keepdims=True))
    assert np.all(np.abs(found - differences) <= 1e-6 * scale)
    in_plane = np.array([n.split(".")[-1] in ("d_x", "d_z", "length") for n in NAMES])
    assert np.all(np.abs(found) <= 1e-6 * scale, where=~in_plane[None])
    force = [METRICS[i] for i in smooth].index("D.mean_square_force")
    assert np.abs(found[force, NAMES.index("D.d_x")]) > 1e-4


FEW = ("A.delta_x", "A.child.delta_z", "arm.length")
FEW_POINT = np.array([6e-3, -4e-3, 2e-4])


@pytest.mark.long
def test_geometrically_exact_elements():
    """Three errors of different kinds, by all three ways, all compiled."""
    model = discretise(arm(3), elements="geometrically_exact")
    problem = Problem(
        Simulation(model, drive=MomentRamp("A", 1.5, 0.06), duration=0.12, method=METHOD, save_every=2e-2),
        ("A.mean_square_force", "A.mean_square_moment"),
    )
    function, point = stacked(problem, FEW), jnp.asarray(FEW_POINT)
    forward = np.asarray(jax.jit(jax.jacfwd(function))(point))
    reverse = np.asarray(jax.jit(jax.grad(lambda x: function(x)[1]))(point))
    steps = 0.05 * np.abs(FEW_POINT)
    differences = central_differences(jax.jit(jax.vmap(function)), FEW_POINT, steps)
    np.testing.assert_allclose(forward, differences, rtol=1e-6)
    np.testing.assert_allclose(reverse, forward[1], rtol=1e-9)


@pytest.mark.long
def test_adaptive_method_in_both_modes():
    """dopri8 with diffrax's adjoints, over the drive's jump."""
    model, drive = discretise(arm(2)), MomentRamp("A", 1.5, 5e-4)
    method = Explicit("dopri8", rtol=1e-9, atol=1e-10)

    def moment(point, adjoint=None):
        run = simulate(
            Simulation(model, drive=drive, duration=1e-3, method=method, save_every=5e-4),
            assembly_errors(model, dict(zip(FEW, point))),
            adjoint=adjoint,
        )
        return run.metrics.mean_square_moment["A"]

    checkpointed = diffrax.RecursiveCheckpointAdjoint(checkpoints=20)
    point = jnp.asarray(FEW_POINT)
    forward = jax.jit(jax.jacfwd(moment))(point)
    reverse = jax.jit(jax.grad(lambda x: moment(x, checkpointed)))(point)
    np.testing.assert_allclose(np.asarray(reverse), np.asarray(forward), rtol=1e-9)
    # Neighbours take other steps: differences carry the error of the steps, divided by their distance.
    differences = central_differences(jax.jit(jax.vmap(moment)), FEW_POINT, 0.05 * FEW_POINT)
    np.testing.assert_allclose(np.asarray(forward)[None], differences, rtol=1e-5)
