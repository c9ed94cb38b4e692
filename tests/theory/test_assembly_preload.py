"""Assembly preload of the study four-bar against statics by hand: the unit load method.

Out of plane, crank held, the loop is one beam B-C-D clamped to the hinges of B and D, which are
free about the global Y axis only.  Cut at C it has three redundants: the force F along the hinge
and the moments M_X, M_Z that the coupler exerts on the rocker.  Beam theory (bending, torsion,
shear) gives the flexibility of either part at C by integrals over its length, and the error gives
the gap at C:

    (f_coupler + f_rocker) (F, M_X, M_Z) = gap,   f = integral S^T diag(1/GJ, 1/EI, 1/GA) S ds

Two Gauss points integrate exactly; the midpoint rule with m points is what m spring-damping
elements amount to.  Nothing of the library enters; the study file's numbers are typed in again.
"""

import dataclasses
import importlib
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rfem_jax import assemble, assembly_errors, discretise, load_study
from rfem_jax.mechanics.dynamics.loads import static_state
from rfem_jax.mechanics.model.with_errors import apply_errors
from rfem_jax.mechanics.statics.assembly import named, static_loads
from rfem_jax.mechanics.statics.settling import equilibrium

STUDIES = Path(__file__).parents[2] / "studies"
COUPLER, ROCKER, SIDE = 0.30, 0.30, 0.01
YOUNG, SHEAR = 210e9, 210e9 / 2.6
EI = YOUNG * SIDE**4 / 12.0
GJ = SHEAR * SIDE**4 * (1.0 / 3.0 - 0.21 * (1.0 - 1.0 / 12.0))
GA = SHEAR * SIDE**2 / 1.2

# X, Z of the joints at the start; B above A, C from the two circles about B and D.
A, B, D = np.array([0.0, 0.0]), np.array([0.0, 0.12]), np.array([0.30, 0.0])
_HALF = (D - B) / 2.0
_UP = np.array([0.12, 0.30]) / np.hypot(0.12, 0.30)
C = B + _HALF + np.sqrt(COUPLER**2 - _HALF @ _HALF) * _UP
CRANK_AXIS, COUPLER_AXIS, ROCKER_AXIS = (
    (end - start) / np.hypot(*(end - start)) for start, end in ((A, B), (B, C), (D, C))
)
ERRORS = (
    "D.delta_x",
    "D.delta_z",
    "D.d_y",
    "B.delta_x",
    "B.child.delta_z",
    "C.delta_z",
    "C.child.delta_x",
    "C.child.d_y",
    "coupler.twist",
    "rocker.twist",
)
IN_PLANE = ("D.d_x", "C.d_z", "coupler.length", "rocker.length")


def moved(wrench, start, end):
    """(F, M_X, M_Z) at `end`, taken about `start`: M + (end - start) x F."""
    force, moment = wrench[0], wrench[1:]
    arm = end - start
    return np.array([force, moment[0] - arm[1] * force, moment[1] + arm[0] * force])


def flexibility(start, end, points, weights):
    """(u_Y, turn about X, about Z) of `end` for unit (F, M_X, M_Z) there, `start` clamped."""
    along = (end - start) / np.hypot(*(end - start))
    across = np.array([-along[1], along[0]])
    total = np.zeros((3, 3))
    for point, weight in zip(points, weights):
        here = start + point * (end - start)
        inside = np.stack([moved(unit, here, end) for unit in np.eye(3)], axis=1)
        stress = np.stack([along @ inside[1:], across @ inside[1:], inside[0]])
        part = stress.T @ np.diag([1.0 / GJ, 1.0 / EI, 1.0 / GA]) @ stress
        total += weight * np.hypot(*(end - start)) * part
    return total


def gap(name):
    """(u_Y, turn about X, about Z) at C of the coupler's end minus the rocker's, for a unit error.

    Errors are in the axes of the base (D), crank (B) and the link that they sit on.
    """
    joint, kind = name.split(".")[0], name.split(".")[-1]
    if kind == "twist":
        return np.array([0.0, *(COUPLER_AXIS if joint == "coupler" else -ROCKER_AXIS)])
    side = {"D": 1.0, "B": -1.0, "C": -1.0}[joint]
    place = {"D": D, "B": B, "C": C}[joint]
    x_axis = {"D": np.array([1.0, 0.0]), "B": CRANK_AXIS, "C": COUPLER_AXIS}[joint]
    if "child" in name:
        x_axis = {"B": COUPLER_AXIS, "C": ROCKER_AXIS}[joint]
        side = {"B": 1.0, "C": 1.0}[joint]
    if kind == "d_y":
        return -side * np.array([1.0, 0.0, 0.0])
    turn = x_axis if kind == "delta_x" else np.array([-x_axis[1], x_axis[0]])
    arm = C - place
    return -side * np.array([turn[1] * arm[0] - turn[0] * arm[1], *turn])


def by_hand(name, points, weights):
    """Preload (joints A B C D; force and moment; hinge frame x y z) per unit error."""
    f = sum(flexibility(start, C, points, weights) for start in (B, D))
    on_rocker = np.linalg.solve(f, gap(name))
    at = {
        "A": (moved(on_rocker, A, C), CRANK_AXIS),
        "B": (moved(on_rocker, B, C), COUPLER_AXIS),
        "C": (on_rocker, COUPLER_AXIS),
        "D": (-moved(on_rocker, D, C), ROCKER_AXIS),
    }
    loads = []
    for (force, *moment), x_axis in at.values():
        z_axis = np.array([-x_axis[1], x_axis[0]])
        loads.append([[0.0, force, 0.0], [x_axis @ moment, 0.0, z_axis @ moment]])
    return np.array(loads)


def gauss():
    half = 0.5 / np.sqrt(3.0)
    return (0.5 - half, 0.5 + half), (0.5, 0.5)


def midpoints(m):
    return (np.arange(m) + 0.5) / m, np.full(m, 1.0 / m)


def study_mechanism():
    """The main study's mechanism without gravity, which the hand calculation leaves out."""
    mechanism = load_study(STUDIES / "four_bar" / "study.toml").mechanism
    return dataclasses.replace(mechanism, gravity=(0.0, 0.0, 0.0))


def preload_per_unit_error(m, names):
    """Derivatives at zero error (names, joints A B C D, 2, 3), per rad or m."""
    model = discretise(study_mechanism(), rfes=m + 1)

    def preload(values):
        assembled = assemble(model, assembly_errors(model, dict(zip(names, values))))
        return jnp.stack([jnp.stack(assembled.preload[joint]) for joint in "ABCD"])

    return np.moveaxis(np.asarray(jax.jit(jax.jacfwd(preload))(jnp.zeros(len(names)))), -1, 0)


@pytest.fixture(scope="module")
def computed():
    return {m: preload_per_unit_error(m, (*ERRORS, *IN_PLANE)) for m in (4, 8)}


@pytest.mark.long
@pytest.mark.parametrize("m", [4, 8])
def test_preload_is_the_unit_load_method_with_a_point_an_element(computed, m):
    for name, found in zip(ERRORS, computed[m]):
        expected = by_hand(name, *midpoints(m))
        size = np.abs(expected).max(axis=(0, 2))[None, :, None]
        np.testing.assert_allclose(found / size, expected / size, atol=1e-7, err_msg=name)


def test_preload_converges_to_beam_theory_with_second_order(computed):
    for i, name in enumerate(ERRORS):
        expected = by_hand(name, *gauss())
        size = np.abs(expected).max(axis=(0, 2))[None, :, None]
        coarse, fine = (np.abs((computed[m][i] - expected) / size).max() for m in (4, 8))
        assert 1e-4 < coarse < 0.05, name
        assert coarse / fine == pytest.approx(4.0, rel=0.05), name


def test_in_plane_errors_stress_nothing(computed):
    """With the crank held the planar loop is a triangle of hinges: statically determinate."""
    one_degree = np.abs(computed[4][0]).max(axis=(0, 1, 2)) * np.pi / 180.0
    assert np.abs(computed[4][len(ERRORS) :]).max() * 1e-3 < 1e-7 * one_degree


@pytest.fixture(scope="module")
def study_script():
    """The study as a module; it stands beside its pictures, not in the package."""
    folder = str(STUDIES / "assembly_preload")
    sys.path.insert(0, folder)
    try:
        yield importlib.import_module("study")
    finally:
        sys.path.remove(folder)
        for name in ("study", "preload_figures"):
            sys.modules.pop(name, None)


def test_derivative_along_a_revolution(study_script):
    angles = 0.4 + 2.0 * np.pi * np.arange(24) / 24
    values = np.stack([np.sin(3.0 * angles), 2.0 + np.cos(angles)], axis=1)
    expected = np.stack([3.0 * np.cos(3.0 * angles), -np.sin(angles)], axis=1)
    np.testing.assert_allclose(study_script.derivative_along_revolution(values, angles), expected, atol=1e-12)


@pytest.mark.long
def test_crooked_pins_follow_from_seat_and_bore(study_script):
    """The derivatives added for crooked pins are those of the library's own pins, kept in place while
    the crank turns; at the start they stress nothing."""
    model = discretise(study_mechanism(), rfes=3)
    start = float(model.start_joints[0])
    poses = study_script.poses_over_revolution(model, [start, start + 0.7, start + 1.4])
    names = tuple(name for name in model.topology.error_names if "pin_tilt" not in name)
    values = np.asarray(study_script.derivatives(model, names, poses))
    more, values = study_script.with_crooked_pins(model, names, values)
    pins = [i for i, name in enumerate(more) if "pin_tilt" in name]
    assert len(pins) == 8
    largest = np.abs(values).max(axis=(0, 1, 3, 4))[:, None, None]
    assert (np.abs(values[0][..., pins]) < 1e-8 * largest).all()

    def preload(tilt):
        actual = apply_errors(model, assembly_errors(model, {"C.pin_tilt_x": tilt}))
        guess = dataclasses.replace(model, start_joints=poses.start_joints[2], cut_angles=poses.cut_angles[2])
        position, multipliers, _ = equilibrium(guess, actual, {0: poses.start_joints[2][0]})
        loads = named(guess, static_loads(guess, actual, static_state(model.topology, position), multipliers))
        return jnp.stack([jnp.stack(loads[name]) for name in sorted(model.joint_names)])

    found = np.asarray(jax.jit(jax.jacfwd(preload))(0.0))
    expected = values[2][..., more.index("C.pin_tilt_x")]
    assert np.abs(expected).max() > 1.0
    np.testing.assert_allclose(found, expected, atol=1e-7 * np.abs(expected).max())
