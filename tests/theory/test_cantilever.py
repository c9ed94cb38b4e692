"""A flexible link on a held joint against beam theory in the form that m segments give it.

Load: gravity on point masses of a link that weighs nothing itself, so small that terms of second
order in the deflection vanish. With constant shear force F the sdes at x_e = (e + 1/2) L/m give, as
sums over midpoints, FL^3/(3EI) (1 - 1/(4 m^2)) at the tip and every other result exactly.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rfem_jax import (
    GivenSection,
    Joint,
    Link,
    Mechanism,
    PointMass,
    PrescribedRate,
    assemble,
    assembly_errors,
    discretise,
)
from rfem_jax.simulation.vibrations.stability import eigenvalues
from rfem_jax.validation.reference_values import read_reference

LENGTH, TIP_MASS, OFFSET, HELD = 0.8, 1.3, 0.05, 0.7
EA, GA_Y, GA_Z, GJ, EI_Y, EI_Z = 3.0e7, 9.0e4, 6.0e4, 150.0, 400.0, 900.0
LOAD = 1e-4  # N; deflections of 1e-7 m
SEGMENTS = (4, 5, 20)


def weightless_section():
    return GivenSection(EA, GA_Y, GA_Z, GJ, EI_Y, EI_Z, 1e-12, 2e-16, 1e-16, 1e-16)


def rotation_y(angle):
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])


def tip_of(elastic, length, m):
    """Displacement and rotation of the link's end from the last rfe, whose middle is L/(4m) before
    it; (6, m) coordinates, small angles."""
    u, phi = elastic[:3, -1], elastic[3:, -1]
    return u + np.cross(phi, [length / (4.0 * m), 0.0, 0.0]), phi


@pytest.fixture(scope="module", params=SEGMENTS)
def loaded(request):
    """m, and the clamped link assembled under loads of all kinds."""
    m = request.param
    masses = [
        PointMass(TIP_MASS, LENGTH),
        PointMass(TIP_MASS, 0.5 * LENGTH + 0.01),
        PointMass(TIP_MASS, (LENGTH, OFFSET, 0.0)),
    ]
    link = Link("beam", LENGTH, weightless_section(), rfes=m + 1, point_masses=masses)
    model = discretise(Mechanism([link], [Joint("A", "base", "beam", position=(0.3, -0.2, 0.1))]))

    @eqx.filter_jit
    @eqx.filter_vmap(in_axes=(None, 0, 0, 0))
    def assembled(model, masses, gravity, length_error):
        model = eqx.tree_at(lambda x: (x.point_mass, x.gravity), model, (masses, gravity))
        return assemble(model, assembly_errors(model, {"beam.length": length_error}), {"A": HELD})

    cases = {
        "axial": ([1, 0, 0], [1, 0, 0], 0.0),
        "out_of_plane": ([1, 0, 0], [0, 1, 0], 0.0),
        "in_plane": ([1, 0, 0], [0, 0, 1], 0.0),
        "middle": ([0, 1, 0], [0, 0, 1], 0.0),
        "outrigger": ([0, 0, 1], [0, 0, 1], 0.0),
        "longer": ([1, 0, 0], [0, 0, 1], 0.05),
    }
    weights, directions, errors = (np.array(part, float) for part in zip(*cases.values()))
    directions = directions @ rotation_y(HELD).T * (LOAD / TIP_MASS)
    results = assembled(model, jnp.asarray(weights * TIP_MASS), directions, jnp.asarray(errors))
    assert (np.asarray(results.status) == 0).all()
    return m, {name: jax.tree.map(lambda x: np.asarray(x)[i], results) for i, name in enumerate(cases)}


@pytest.mark.long
def test_axial_load_stretches_by_FL_over_EA(loaded):
    m, results = loaded
    u, phi = tip_of(results["axial"].state.position.elastic, LENGTH, m)
    np.testing.assert_allclose(u[0], LOAD * LENGTH / EA, rtol=1e-8)
    assert np.abs(u[1:]).max() < 1e-8 * u[0] and np.abs(phi).max() < 1e-8 * u[0]


@pytest.mark.parametrize(
    "plane, axis, about, sign, bending, shear",
    [("in_plane", 2, 1, -1.0, EI_Y, GA_Z), ("out_of_plane", 1, 2, 1.0, EI_Z, GA_Y)],
)
def test_tip_load_bends_by_the_discrete_beam_formula(loaded, plane, axis, about, sign, bending, shear):
    m, results = loaded
    u, phi = tip_of(results[plane].state.position.elastic, LENGTH, m)
    flexure = LOAD * LENGTH**3 / (3.0 * bending) * (1.0 - 1.0 / (4.0 * m**2))
    np.testing.assert_allclose(u[axis], flexure + LOAD * LENGTH / shear, rtol=1e-6)
    np.testing.assert_allclose(phi[about], sign * LOAD * LENGTH**2 / (2.0 * bending), rtol=1e-6)
    assert abs(phi[0]) < 1e-6 * abs(phi[about])


def test_load_between_the_ends_bends_by_the_sum_over_its_own_segments(loaded):
    """A mass on an inner rfe: beyond it the link is straight."""
    m, results = loaded
    where = 0.5 * LENGTH + 0.01
    sdes = (np.arange(m) + 0.5) * LENGTH / m
    held_by = sdes[np.minimum(np.floor(where / LENGTH * m + 0.5), m) > np.arange(m)]
    slopes = LOAD * (where - held_by) * LENGTH / (m * EI_Y)
    drop = np.sum(slopes * (LENGTH - held_by)) + LOAD * LENGTH / (m * GA_Z) * len(held_by)
    u, phi = tip_of(results["middle"].state.position.elastic, LENGTH, m)
    np.testing.assert_allclose(u[2], drop, rtol=1e-6)
    np.testing.assert_allclose(phi[1], -np.sum(slopes), rtol=1e-6)


def test_outrigger_twists_by_TL_over_GJ(loaded):
    m, results = loaded
    u, phi = tip_of(results["outrigger"].state.position.elastic, LENGTH, m)
    np.testing.assert_allclose(phi[0], LOAD * OFFSET * LENGTH / GJ, rtol=1e-6)
    flexure = LOAD * LENGTH**3 / (3.0 * EI_Y) * (1.0 - 1.0 / (4.0 * m**2))
    np.testing.assert_allclose(u[2], flexure + LOAD * LENGTH / GA_Z, rtol=1e-6)


def test_length_error_stretches_all_segments(loaded):
    m, results = loaded
    longer = LENGTH + 0.05
    u, phi = tip_of(results["longer"].state.position.elastic, longer, m)
    flexure = LOAD * longer**3 / (3.0 * EI_Y) * (1.0 - 1.0 / (4.0 * m**2))
    np.testing.assert_allclose(u[2], flexure + LOAD * longer / GA_Z, rtol=1e-6)
    np.testing.assert_allclose(phi[1], -LOAD * longer**2 / (2.0 * EI_Y), rtol=1e-6)


def test_clamp_carries_the_load_and_its_moment(loaded):
    _, results = loaded
    for name, force, moment in [
        ("axial", [-LOAD, 0, 0], [0, 0, 0]),
        ("out_of_plane", [0, -LOAD, 0], [0, 0, -LOAD * LENGTH]),
        ("in_plane", [0, 0, -LOAD], [0, LOAD * LENGTH, 0]),
        ("outrigger", [0, 0, -LOAD], [-LOAD * OFFSET, LOAD * LENGTH, 0]),
    ]:
        preload = results[name].preload["A"]
        np.testing.assert_allclose(preload.force, force, atol=1e-6 * LOAD)
        np.testing.assert_allclose(preload.moment, moment, atol=1e-6 * LOAD)


# Natural frequencies. Unit cantilever: EI = rho A = L = 1.
REFERENCE = read_reference("cantilever")
EULER_BERNOULLI = np.array(REFERENCE["roots"]) ** 2
BENDING_TABLE = {int(m): row for m, row in REFERENCE["bending"].items()}
SLENDER_Y, SLENDER_Z = 1.0 / (12.0 * 20.0**2), 1.0 / (12.0 * 10.0**2)  # I / (A L^2)
SHEAR_TABLE = {int(m): row for m, row in REFERENCE["bending_with_shear"].items()}


def chain_frequencies(m, shear_compliance=0.0, rotary=0.0):
    """Frequencies over Euler-Bernoulli's of rods hinged by springs in m segments, by its own
    flexibility: W = stiffness^-1 from the virtual work of unit loads, then 1/omega^2 = eig(W M)."""
    sdes = (np.arange(m) + 0.5) / m
    edges = np.concatenate([sdes, [1.0]])
    middle, extent = 0.5 * (edges[1:] + edges[:-1]), np.diff(edges)
    before = sdes[None, :] < middle[:, None]
    bending = np.where(before, middle[:, None] - sdes[None, :], 0.0)  # moment of a unit force
    couple = before.astype(float)  # moment of a unit couple
    loads = np.vstack([bending, couple])
    shear = np.vstack([before.astype(float), np.zeros_like(couple)])
    flexibility = (loads @ loads.T + shear_compliance * shear @ shear.T) / m
    mass = np.concatenate([extent, extent**3 / 12.0 + rotary * extent])
    root = np.sqrt(mass)
    values = np.linalg.eigvalsh(root[:, None] * flexibility * root[None, :])
    return 1.0 / np.sqrt(values[::-1][:3]) / EULER_BERNOULLI


def bent_frequencies(m, section_y, section_z):
    """Lowest frequencies of the library's clamped link over Euler-Bernoulli's, by plane (EI_y 1,
    EI_z 4: twice the frequencies)."""
    (shear_z, rotary_y), (shear_y, rotary_z) = section_y, section_z
    axial, torsion, rotary_x = 1e7, 1e3, rotary_y + rotary_z
    section = GivenSection(axial, shear_y, shear_z, torsion, 1.0, 4.0, 1.0, rotary_x, rotary_y, rotary_z)
    link = Link("beam", 1.0, section, rfes=m + 1)
    mechanism = Mechanism([link], [Joint("A", "base", "beam", angle=0.3)], driven_joint="A")
    values = eigenvalues(discretise(mechanism), PrescribedRate("A", 1.0))
    assert np.abs(values.real).max() < 1e-6 * np.abs(values).max()  # no damping
    return np.sort(values.imag[values.imag > 1.0])


def nearest(values, expected):
    return values[np.abs(values[:, None] - expected[None, :]).argmin(axis=0)]


@pytest.mark.parametrize("m", BENDING_TABLE)
def test_chain_of_the_test_itself_meets_the_bending_table(m):
    np.testing.assert_allclose(chain_frequencies(m), BENDING_TABLE[m], atol=6e-6)


@pytest.mark.parametrize("m", SHEAR_TABLE)
def test_chain_of_the_test_itself_meets_the_shear_table(m):
    np.testing.assert_allclose(chain_frequencies(m, SLENDER_Y * 2.6 * 1.2, SLENDER_Y), SHEAR_TABLE[m], atol=6e-6)


@pytest.mark.parametrize("m", [4, 20])
def test_frequencies_in_bending_only(m):
    """Shear so stiff and sections so small that they lower the frequencies by 8e-6 at most.

    Not less: rounding is 1e-16 of the highest frequency, which rises with the stiffness of shear."""
    values = bent_frequencies(m, (4e7, 1e-8), (4e7, 1e-8))
    expected = EULER_BERNOULLI * np.array(BENDING_TABLE[m])
    for plane, compliance in ((1.0, 2.5e-8), (2.0, 1e-7)):
        exact = plane * EULER_BERNOULLI * chain_frequencies(m, compliance, 1e-8)
        np.testing.assert_allclose(nearest(values, exact), exact, rtol=3e-6)
        np.testing.assert_allclose(nearest(values, plane * expected), plane * expected, rtol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("m", [4, 20])
def test_frequencies_with_shear_and_rotary_inertia(m):
    """nu = 0.3, shear factor 1.2; L/h = 20 in the plane of motion, 10 out of it."""
    ratio = 1.0 / (2.6 * 1.2)  # GA / kappa over EA
    shear_z, shear_y = ratio / SLENDER_Y, 4.0 * ratio / SLENDER_Z
    values = bent_frequencies(m, (shear_z, SLENDER_Y), (shear_y, SLENDER_Z))
    in_plane = chain_frequencies(m, 1.0 / shear_z, SLENDER_Y) * EULER_BERNOULLI
    out_of_plane = 2.0 * chain_frequencies(m, 4.0 / shear_y, SLENDER_Z) * EULER_BERNOULLI
    np.testing.assert_allclose(nearest(values, in_plane), in_plane, rtol=1e-6)
    np.testing.assert_allclose(nearest(values, out_of_plane), out_of_plane, rtol=1e-6)
    if m in SHEAR_TABLE:
        expected = EULER_BERNOULLI * np.array(SHEAR_TABLE[m])
        np.testing.assert_allclose(nearest(values, expected), expected, rtol=6e-6)
