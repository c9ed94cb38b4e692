"""Derivatives through assembly and simulation: forward = reverse = central differences.

All kinds of errors, over the drive's jump; on the same discretisation, so that only rounding and
the differences' own error remain.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from rfem_jax import Problem

NAMES = (
    "D.delta_x",
    "D.delta_z",
    "D.d_x",
    "D.d_y",
    "C.child.delta_x",
    "C.pin_tilt_z",
    "coupler.length",
    "rocker.twist",
)
POINT = np.array([4e-3, -3e-3, 2e-5, 3e-4, 3e-3, -4e-3, 3e-5, 5e-3])
STEPS = np.array([2e-5, 2e-5, 5e-5, 2e-6, 2e-5, 2e-5, 5e-5, 2e-5])
TYPICAL = np.array([1e-3 if n.split(".")[1] in ("d_x", "d_y", "length") else np.radians(1.0)
                    for n in NAMES])


@pytest.fixture(scope="module")
def values(small):
    metrics = [f"{joint}.{kind}" for joint in "AC" for kind in
               ("mean_square_force", "mean_square_moment")]
    problem = Problem(
        small.model, small.drive, small.settings["duration"], metrics, small.settings["method"],
        small.settings["save_every"],
    )

    def stacked(point):
        out, _ = problem(dict(zip(NAMES, point)))
        return jnp.stack([out[name] for name in metrics])

    return jax.jit(jax.vmap(stacked)), jax.jit(jax.jacfwd(stacked)), jax.jit(jax.jacrev(stacked))


@pytest.fixture(scope="module")
def differences(values):
    """Central differences (metrics, errors) of fourth order, at the point and at zero error."""
    function = values[0]

    def at(point):
        shifts = np.concatenate([k * np.diag(STEPS) for k in (-2, -1, 1, 2)])
        out = np.asarray(function(jnp.asarray(point + shifts))).reshape(4, len(NAMES), -1)
        return ((out[0] - 8 * out[1] + 8 * out[2] - out[3]) / (12 * STEPS[:, None])).T

    return {"errors": at(POINT), "zero": at(0 * POINT)}


@pytest.fixture(scope="module")
def hessian_scale(values):
    """Largest change (metrics, errors) of a gradient by a typical error: second differences."""
    function = values[0]
    typical = TYPICAL
    shifts = np.concatenate([k * np.diag(0.1 * typical) for k in (-1, 0, 1)])
    out = np.asarray(function(jnp.asarray(shifts))).reshape(3, len(NAMES), -1)
    return np.abs((out[0] - 2 * out[1] + out[2]) / (0.1 * typical[:, None]) ** 2).T * typical


@pytest.mark.parametrize("mode", [1, 2], ids=["forward", "reverse"])
def test_away_from_zero(values, differences, mode):
    slope = np.asarray(values[mode](jnp.asarray(POINT)))
    scale = np.abs(differences["errors"])
    # An error that hardly matters is compared on the scale of the metric's change by 1 deg, 1 mm.
    typical = TYPICAL
    change = np.abs(slope * typical).max(axis=1, keepdims=True) / typical
    assert np.all(np.isfinite(slope))
    np.testing.assert_array_less(
        np.abs(slope - differences["errors"]), 1e-6 * np.maximum(scale, 1e-3 * change)
    )


@pytest.mark.parametrize("mode", [1, 2], ids=["forward", "reverse"])
def test_at_zero_error(values, differences, hessian_scale, mode):
    slope = np.asarray(values[mode](jnp.zeros(len(NAMES))))
    assert np.all(np.isfinite(slope))
    scale = np.maximum(np.abs(differences["zero"]), hessian_scale)
    np.testing.assert_array_less(np.abs(slope - differences["zero"]), 1e-6 * scale + 1e-12)
    out_of_plane = [i for i, name in enumerate(NAMES) if name in ("D.delta_x", "D.delta_z", "D.d_y")]
    in_plane = NAMES.index("D.d_x")
    forces = slope[[0, 2]]
    assert np.all(np.abs(forces[:, out_of_plane]) < 1e-6 * hessian_scale[[0, 2]][:, out_of_plane])
    assert np.all(np.abs(forces[:, in_plane]) > 1.0)


def test_forward_and_reverse_agree(values):
    forward, reverse = (np.asarray(values[mode](jnp.asarray(POINT))) for mode in (1, 2))
    np.testing.assert_allclose(forward, reverse, rtol=1e-9)
