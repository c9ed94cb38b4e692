"""The output angle of a rigid linkage revolute, spherical, spherical, revolute against its closed form, with errors of
the ball centres on all four sides.

The distance of the two balls is fixed, which is one equation for the angle psi of the rocker,
E cos(psi) + F sin(psi) = G, as Freudenstein's for the planar four-bar; Hartenberg, Denavit, Kinematic Synthesis of
Linkages (1964), chapter 12.
"""

from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rfem_jax import (
    PrescribedRate,
    RungeKutta4,
    Simulation,
    assembly_errors,
    describe,
    discretise,
    load_study,
    simulate,
)
from rfem_jax.report.contents.overview import study_text

STUDY = Path(__file__).parents[2] / "studies" / "spatial_linkage" / "study.toml"
RATE, DURATION = 10.0 * np.pi, 0.2  # one revolution
COMPONENTS = ("d_x", "d_y", "d_z")


@pytest.fixture(scope="module")
def study():
    return load_study(STUDY)


def rigid(mechanism):
    return replace(mechanism, links=[replace(link, rigid=True, rfes=1) for link in mechanism.links])


def closed_form(mechanism, crank, errors, near):
    """Angles of the rocker [rad] at angles of the crank [rad] (T,); `errors` (4, 3) m: of B on the crank and on the
    coupler, of C on the coupler and on the rocker; the root that begins at `near` [rad]."""
    length = {link.name: np.array([link.length, 0.0, 0.0]) for link in mechanism.links}
    base = mechanism.joint("D")
    seat = Rotation.from_euler("xyz", base.orientation)
    ball = Rotation.from_rotvec(np.outer(crank, [0.0, 1.0, 0.0])).apply(length["crank"] + errors[0])
    u = seat.inv().apply(ball - base.position)
    c = length["rocker"] + errors[3]
    between = length["coupler"] + errors[2] - errors[1]
    e, f = u[:, 0] * c[0] + u[:, 2] * c[2], u[:, 0] * c[2] - u[:, 2] * c[0]
    g = 0.5 * (np.sum(u**2, axis=1) + c @ c - between @ between) - u[:, 1] * c[1]
    roots = np.arctan2(f, e) + np.outer([1.0, -1.0], np.arccos(g / np.hypot(e, f)))
    first = np.angle(np.exp(1j * (roots[:, 0] - near)))
    return np.unwrap(roots[np.argmin(np.abs(first))])


@pytest.mark.long
def test_output_angle_without_and_with_errors(study):
    mechanism = rigid(study.mechanism)
    model = discretise(mechanism)
    errors = np.stack([np.zeros((4, 3)), 1e-3 * np.random.default_rng(5).normal(size=(4, 3))])
    names = [f"{side}.{one}" for side in ("B", "B.child", "C", "C.child") for one in COMPONENTS]

    def angles(values):
        run = simulate(
            Simulation(
                model,
                drive=PrescribedRate("A", RATE),
                duration=DURATION,
                method=RungeKutta4(step=1e-3),
                save_every=DURATION / 20,
            ),
            assembly_errors(model, dict(zip(names, values, strict=True))),
        )
        return run.motion.angle, run.motion.angles["D"], run.status

    crank, rocker, status = jax.jit(jax.vmap(angles))(jnp.asarray(errors.reshape(2, 12)))
    assert np.asarray(status).tolist() == [0, 0]
    near = mechanism.joint("D").angle
    expected = np.stack([closed_form(mechanism, *case, near) for case in zip(np.asarray(crank), errors, strict=True)])
    assert np.ptp(expected[0]) > 0.5 and np.abs(expected[1] - expected[0]).max() > 5e-3
    np.testing.assert_allclose(rocker - near, expected - near, rtol=0, atol=1e-7)


def test_the_spin_of_the_coupler_is_named(study):
    text = study_text(study, describe(discretise(study.mechanism)))
    assert "Idle freedom: link coupler can turn about the line through B (spherical) and C (spherical)" in text
    assert "2 if all links were rigid" in text
