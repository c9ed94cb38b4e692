"""Geometrically exact elements on clamped beams against large-deflection theory and published values.

Load: the weight of a point mass at the tip of a link that weighs nothing itself.  Sources: elastica
by elliptic integrals (table for P L^2/EI; bending only); thick cantilever after Nachbagauer et al.
2011, 2013 (Exudyn's geometricallyExactBeamTest); Princeton beam, ANSYS beam values after Obrezkov et
al. 2022; and the equations of the continuous rod (Reissner, Simo), solved here by shooting.

All problems share two compiled programs, m = 10 and m = 20 segments.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import root

from rfem_jax import (
    STATUS,
    GivenSection,
    Joint,
    Link,
    Mechanism,
    PointMass,
    PrescribedRate,
    RungeKutta4,
    Simulation,
    assemble,
    assembly_errors,
    discretise,
    simulate,
)
from rfem_jax.mechanics.dynamics.loads import static_state
from rfem_jax.mechanics.model.status import OK, UNSTABLE
from rfem_jax.validation.reference_values import read_reference

SEGMENTS = (10, 20)
LOADS = 5  # of every batch
SLENDER = (1.0, (1e7, 1e7, 1e7, 1.0, 1.0, 1.0))  # length; EA, GA_y, GA_z, GJ, EI_y, EI_z


def clamped(m, length, stiffness, elements):
    """A beam along X, its tip loaded by the weight of 1 kg."""
    section = GivenSection(*stiffness, 1e-12, 2e-16, 1e-16, 1e-16)
    beam = Link("beam", length, section, rfes=m + 1, point_masses=[PointMass(1.0, length)])
    return discretise(Mechanism([beam], [Joint("A", "base", "beam")]), elements=elements)


@eqx.filter_jit
@eqx.filter_vmap(in_axes=(None, 0))
def bent(model, force):
    """Coordinates, status and clamp's load under a force at the tip, and the derivatives of the coordinates
    with its share."""

    def under(share):
        loaded = eqx.tree_at(lambda x: x.gravity, model, share * force)
        out = assemble(loaded, assembly_errors(loaded), {"A": 0.0})
        return out.state.position.elastic, (out.status, out.preload["A"])

    elastic, derivative, (status, clamp) = jax.jvp(under, (1.0,), (1.0,), has_aux=True)
    return elastic, derivative, status, clamp


def solve(m, length, stiffness, forces, elements="geometrically_exact"):
    """Tip's displacement (loads, 3) and angles (loads, 3), and all that `bent` returns."""
    forces = np.concatenate([forces, np.zeros((LOADS - len(forces), 3))])
    results = jax.tree.map(np.asarray, bent(clamped(m, length, stiffness, elements), jnp.asarray(forces)))
    elastic = results[0]
    u, (_, phi_y, phi_z) = elastic[:, :3, -1], elastic[:, 3:, -1].T
    along = np.stack([np.cos(phi_y) * np.cos(phi_z), np.sin(phi_z), -np.sin(phi_y) * np.cos(phi_z)])
    tip = u + length / (4.0 * m) * (along.T - [1.0, 0.0, 0.0])
    return tip, elastic[:, 3:, -1], results


def pair(length, stiffness, forces, codes: int | list[int] = OK):
    """Tip displacements and angles (2, loads, 6) of both discretisations, whose equilibria have the status `codes`."""
    values = []
    for m in SEGMENTS:
        tip, phi, (_, _, status, clamp) = solve(m, length, stiffness, forces)
        n = len(forces)
        assert (status[:n] == codes).all() and (status[n:] == OK).all()
        # The clamp balances the load at the deformed tip.
        arm = tip[:n] + [length, 0.0, 0.0]
        moment = np.cross(arm, forces)
        largest_force, largest_moment = np.abs(forces).max(), np.abs(moment).max()
        np.testing.assert_allclose(clamp.force[:n], -forces, atol=1e-7 * largest_force)
        np.testing.assert_allclose(clamp.moment[:n], -moment, atol=1e-6 * largest_moment)
        values.append(np.concatenate([tip, phi], axis=1)[:n])
    return np.stack(values)


def extrapolated(values):
    """Limit of a second-order discretisation."""
    return values[1] + (values[1] - values[0]) / 3.0


ELASTICA = np.stack(
    [read_reference("elastica")[name] for name in ("load", "deflection", "shortening", "tip_angle")], axis=1
)


@pytest.mark.long
def test_elastica_is_met_with_second_order():
    forces = np.outer(ELASTICA[:, 0], [0.0, 0.0, -1.0])
    values = pair(*SLENDER, forces)
    found = np.stack([-values[..., 2], -values[..., 0], values[..., 4]], axis=-1)
    expected = ELASTICA[:, 1:]
    coarse, fine = found - expected
    assert np.abs(fine).max() < 1.1e-3
    large = np.abs(fine) > 2e-4  # well above the table's last digit
    np.testing.assert_allclose(coarse[large] / fine[large], 4.0, rtol=0.03)
    np.testing.assert_allclose(extrapolated(found), expected, rtol=0, atol=1.2e-5)


def section_of_rectangle(young, poisson, height, width, shear, torsion):
    """Stiffnesses with `height` along z: EA, GA_y, GA_z, GJ, EI_y, EI_z."""
    area, shear_modulus = height * width, 0.5 * young / (1.0 + poisson)
    about_y, about_z = width * height**3 / 12.0, height * width**3 / 12.0
    twist = shear_modulus * torsion * (about_y + about_z)
    effective = shear * shear_modulus * area
    return (young * area, effective, effective, twist, young * about_y, young * about_z)


@pytest.mark.long
def test_thick_cantilever():
    """Both loads: 62.5 kN (sag FL^3/3EI + FL/k_s GA) and a thousand times as much, which the bar on edge carries in the
    plane only: from 4.013 sqrt(EI_z GJ) / L^2 on, 27 MN here, it tips over sideways."""
    shear = 10.0 * 1.3 / (12.0 + 11.0 * 0.3)
    stiffness = section_of_rectangle(2.07e11, 0.3, 0.5, 0.1, shear, 1.0)
    reference = read_reference("thick_cantilever")
    assert 4.013 * np.sqrt(stiffness[5] * stiffness[3]) / 2.0**2 < 0.5 * reference["force"][1]
    values = pair(2.0, stiffness, np.outer(reference["force"], [0.0, 0.0, 1.0]), [OK, UNSTABLE])
    expected = np.array([*reference["deflection"], -reference["shortening"][1]])
    found = np.stack([values[:, 0, 2], values[:, 1, 2], values[:, 1, 0]], axis=1)
    coarse, fine = found / expected - 1.0
    assert np.abs(fine).max() < 7e-4
    np.testing.assert_allclose(coarse / fine, 4.0, rtol=0.08)
    np.testing.assert_allclose(extrapolated(found), expected, rtol=8e-6)


PRINCETON = (0.508, section_of_rectangle(71.7e9, 0.31, 3.2024e-3, 12.3777e-3, 5.0 / 6.0, 0.198))
TABLE = read_reference("princeton_beam")
LOADED = (("8.896", 30.0), ("13.345", 30.0), ("8.896", 60.0), ("13.345", 60.0), ("13.345", 90.0))  # force, angle
ANSYS = np.array(  # force, angle from the stiff direction, chordwise, flapwise displacement
    [
        [float(force), angle, *(TABLE[name][force][TABLE["angle"].index(angle)] for name in ("chordwise", "flapwise"))]
        for force, angle in LOADED
    ]
)


@pytest.mark.slow
def test_princeton_beam():
    """The continuous rod is met in the limit; ANSYS's chordwise values are those of a rod to 3.5 %
    only, its flapwise ones to 0.4 %."""
    angles = np.radians(ANSYS[:, 1])
    forces = ANSYS[:, :1] * np.stack([0.0 * angles, np.cos(angles), np.sin(angles)], axis=1)
    values = pair(*PRINCETON, forces)
    rod = np.stack([rod_tip(*PRINCETON, force) for force in forces])
    np.testing.assert_allclose(extrapolated(values)[:, :3], rod, rtol=0, atol=3e-6)
    assert np.abs(values[1, :, :3] - rod).max() < 2e-4
    np.testing.assert_allclose(values[1, :, 1], ANSYS[:, 2], rtol=0.035, atol=1e-9)
    np.testing.assert_allclose(values[1, :, 2], ANSYS[:, 3], rtol=0.004)


def rod_tip(length, stiffness, force):
    """Displacement of the tip of a clamped rod under a dead force: r' = R (e_x + strain),
    R' = R curvature, m' = -r' x n; the clamp's moment is shot for."""
    stretch, bend = np.array(stiffness[:3]), np.array(stiffness[3:])

    def end(moment, force):
        def along(_, y):
            turn, moment = y[3:12].reshape(3, 3), y[12:]
            tangent = turn @ (np.eye(3)[0] + turn.T @ force / stretch)
            curvature = np.cross(np.eye(3), turn.T @ moment / bend)
            return np.concatenate([tangent, (turn @ curvature).ravel(), -np.cross(tangent, force)])

        start = np.concatenate([np.zeros(3), np.eye(3).ravel(), moment])
        out = solve_ivp(along, (0.0, length), start, method="DOP853", rtol=1e-10, atol=1e-13)
        return out.y[:, -1]

    moment = np.zeros(3)
    for share in (0.25, 0.5, 0.75, 1.0):
        moment = root(lambda m: end(m, share * force)[12:], moment, tol=1e-11).x
    last = end(moment, force)
    assert np.abs(last[12:]).max() < 1e-9 * length * np.abs(force).max()
    return last[:3] - [length, 0.0, 0.0]


def test_derivative_of_a_large_deflection():
    """By the implicit function theorem through the load steps, against differences."""
    step = 1e-4
    shares = np.array([1.0, 1.0 + step, 1.0 - step])
    _, _, (elastic, derivative, status, _) = solve(10, *SLENDER, np.outer(shares, [0.0, 4.0, -6.0]))
    assert (status == 0).all()
    differences = (elastic[1] - elastic[2]) / (2.0 * step)
    np.testing.assert_allclose(derivative[0], differences, rtol=0, atol=1e-7 * np.abs(derivative[0]).max())


SOFT = (1.0, (1e4, 1e4, 1e4, 1.0, 1.0, 1.0))


@pytest.mark.long
def test_linear_and_exact_agree_for_small_loads():
    """The sag differs with the cube of the load, the shortening (none in the linear form) with its
    square."""
    loads = np.outer([0.02, 0.04, 0.08], [0.0, -1.0, 2.0])
    linear, _, (_, _, status, _) = solve(10, *SOFT, loads, "linear")
    exact, _, _ = solve(10, *SOFT, loads)
    assert (status == 0).all()
    gap = (exact - linear)[:3]
    assert np.abs(gap[:, 1:] / linear[:3, 1:]).max() < 5e-3
    np.testing.assert_allclose(gap[1:, 1:] / gap[:-1, 1:], 8.0, rtol=0.05)
    np.testing.assert_allclose(gap[1:, 0] / gap[:-1, 0], 4.0, rtol=0.02)


def test_an_assembly_out_of_range_says_so():
    """In the linear form, beyond 60 deg; in the exact one, beyond 80 deg out of plane only."""
    down = np.outer([1.0, 10.0], [0.0, 0.0, -1.0])
    *_, status, _ = solve(10, *SOFT, down, "linear")[2]
    assert [STATUS[code].name for code in status[:2]] == ["ok", "out_of_range"]
    assert "geometrically_exact" in STATUS[status[1]].message
    sideways = np.array([[0.0, 0.0, -10.0], [0.0, 2.0, 0.0], [0.0, 10.0, 0.0]])
    *_, status, _ = solve(10, *SOFT, sideways)[2]
    assert [STATUS[code].name for code in status[:3]] == ["ok", "ok", "out_of_range"]


@pytest.mark.slow
@pytest.mark.parametrize("elements, name", [("linear", "out_of_range"), ("geometrically_exact", "ok")])
def test_a_run_out_of_range_says_so(elements, name):
    """A limp beam let go: it falls past 60 deg, within the range of the exact form alone."""
    section = GivenSection(300.0, 300.0, 300.0, 0.01, 0.01, 0.01, 0.2, 2e-5, 1e-5, 1e-5)
    beam, clamp = Link("beam", 0.5, section, rfes=4), Joint("A", "base", "beam", angle=-0.4)
    model = discretise(Mechanism([beam], [clamp], driven_joint="A", elements=elements))
    run = simulate(
        Simulation(
            model,
            drive=PrescribedRate("A", 0.0),
            duration=0.4,
            method=RungeKutta4(step=2e-4),
            save_every=0.02,
            start=static_state(model.topology, model.start_coordinates()),
        )
    )
    assert STATUS[int(run.status)].name == name
    if elements == "geometrically_exact":
        assert run.checks.energy_balance_error < 1e-5
        assert run.checks.momentum_balance_error < 1e-9
