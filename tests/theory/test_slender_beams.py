"""Static assembly of slender beams: EA L^2/EI from 1e3 to 1e8, where the forces of stretching dwarf
those of bending (a 1 m bar of 10 mm x 10 mm has 1.2e5, a blade of 1 mm 1.2e7).

References: the linear chain of m segments in closed form; the planar exact chain of rigid segments,
solved here with scipy from the equilibrium of its parts; the elastica by elliptic integrals.
"""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import root

from rfem_jax import (
    STATUS,
    GivenSection,
    Joint,
    Link,
    Mechanism,
    PointMass,
    assemble,
    assembly_errors,
    discretise,
    natural_frequencies,
)
from rfem_jax.mechanics.model.model import Sections
from rfem_jax.validation.reference_values import read_reference

M = 10  # segments
RATIOS = np.array([1e3, 1e5, 1e7, 1e8])  # EA L^2/EI
SDES = (np.arange(M) + 0.5) / M


def clamped(place, elements):
    """A beam along X with EI = L = 1, loaded by the weight of 1 kg on its last rfe."""
    section = GivenSection(1e4, 1e4, 1e4, 0.8, 1.0, 1.0, 1e-12, 2e-16, 1e-16, 1e-16)
    beam = Link("beam", 1.0, section, rfes=M + 1, point_masses=[PointMass(1.0, place)])
    return discretise(Mechanism([beam], [Joint("A", "base", "beam")]), elements=elements)


@eqx.filter_jit
@eqx.filter_vmap(in_axes=(None, 0, 0))
def bent(model, ratio, load):
    """Coordinates, their derivatives with the load, status and clamp's load; EA = GA = ratio."""
    stiffness = model.section.stiffness.at[:3].set(ratio)
    model = eqx.tree_at(lambda x: x.section.stiffness, model, stiffness)

    def under(load):
        loaded = eqx.tree_at(lambda x: x.gravity, model, load * jnp.array([0.0, 0.0, -1.0]))
        out = assemble(loaded, assembly_errors(loaded), {"A": 0.0})
        return out.state.position.elastic, (out.status, out.preload["A"])

    elastic, derivative, (status, clamp) = jax.jvp(under, (load,), (1.0,), has_aux=True)
    return elastic, derivative, status, clamp


def solve(place, elements, loads):
    """Results of `bent` for all ratios and loads, and both as columns."""
    ratios, loads = (x.ravel() for x in np.meshgrid(RATIOS, loads))
    model = clamped(place, elements)
    results = bent(model, jnp.asarray(ratios), jnp.asarray(loads))
    return ratios, loads, jax.tree.map(np.asarray, results)


@pytest.mark.slow
def test_linear_elements_meet_the_closed_form():
    """The load sits in the middle of the last rfe, where it is linear in the coordinates."""
    place = 1.0 - 0.25 / M
    ratios, loads, (elastic, derivative, status, clamp) = solve(place, "linear", [1e-6, 0.01, 1.5])
    assert (status == 0).all()
    sag = loads * (np.sum((place - SDES) ** 2) / M + 1.0 / ratios)
    # The least deflections are 3e-7 of the length: a few roundings of a position are more than 1e-9 of that.
    np.testing.assert_allclose(elastic[:, 2, -1], -sag, rtol=1e-9, atol=1e-15)
    np.testing.assert_allclose(elastic[:, 4, -1], loads * np.sum(place - SDES) / M, rtol=1e-9, atol=1e-15)
    # One linear solve, without refinement by further iterations.
    error = np.abs(derivative * loads[:, None, None] - elastic).max(axis=(1, 2))
    assert (error < 1e-10 + 1e-15 * ratios).all()
    np.testing.assert_allclose(clamp.force[:, 2], loads, rtol=1e-9)
    # The clamp's arm is that of the deformed beam, which the linear form does not shorten.
    np.testing.assert_allclose(clamp.moment[:, 1], -place * loads, rtol=1e-9)


def chain(ratio, load):
    """Sag, retreat, rotation of the last rfe's middle: rigid segments, joined by springs that see the
    load in the axes midway between their faces and its moment about the middle of their gap."""
    edges = np.concatenate([[0.0], SDES, [1.0]])
    extent = np.diff(edges)

    def place(rotations, force):
        angles = np.concatenate([[0.0], np.cumsum(rotations)])
        point, middles = np.array([extent[0], 0.0]), []
        for e in range(M):
            midway = angles[e] + 0.5 * rotations[e]
            t, n = np.array([[np.cos(midway), np.sin(midway)], [-np.sin(midway), np.cos(midway)]])
            gap = force / (M * ratio) * (t[1] * t + n[1] * n)
            middles.append(point + 0.5 * gap)
            along = np.array([np.cos(angles[e + 1]), np.sin(angles[e + 1])])
            point = point + gap + extent[e + 1] * along
        return point, np.array(middles), along

    def residual(rotations, force):
        end, middles, _ = place(rotations, force)
        return rotations - force * (end - middles)[:, 0] / M

    rotations = np.zeros(M)
    for share in np.linspace(0.25, 1.0, 4):
        rotations = root(residual, rotations, args=(share * load,), tol=1e-14).x
    assert np.abs(residual(rotations, load)).max() < 1e-12
    end, _, along = place(rotations, load)
    middle = end - 0.5 * extent[-1] * along
    return np.array([middle[1], 1.0 - 0.25 / M - middle[0], np.sum(rotations)]), end


@pytest.mark.long
def test_exact_elements_meet_the_exact_chain_and_the_elastica():
    loads = [0.01, 1.0, 5.0]
    ratios, loads, (elastic, derivative, status, clamp) = solve(1.0, "geometrically_exact", loads)
    assert (status == 0).all()

    def seen(part):
        return np.stack([-part[:, 2, -1], -part[:, 0, -1], part[:, 4, -1]], axis=1)

    pairs = [chain(*case) for case in zip(ratios, loads)]
    expected, tips = (np.stack(part) for part in zip(*pairs))
    np.testing.assert_allclose(seen(elastic), expected, rtol=1e-8, atol=1e-12)
    step = 1e-4
    differences = np.stack(
        [
            (chain(k, p * (1.0 + step))[0] - chain(k, p * (1.0 - step))[0]) / (2.0 * step * p)
            for k, p in zip(ratios, loads)
        ]
    )
    np.testing.assert_allclose(seen(derivative), differences, rtol=2e-7, atol=1e-8)
    np.testing.assert_allclose(clamp.force[:, 2], loads, rtol=1e-9)
    np.testing.assert_allclose(clamp.moment[:, 1], -loads * tips[:, 0], rtol=1e-8)
    # The elastica, an inextensible beam.
    elastica = read_reference("elastica")
    for load in (1.0, 5.0):
        row = elastica["load"].index(load)
        known = [elastica[name][row] for name in ("deflection", "shortening", "tip_angle")]
        at = (loads == load) & (ratios >= 1e5)
        found = np.column_stack([tips[at, 1], 1.0 - tips[at, 0], seen(elastic)[at, 2]])
        np.testing.assert_allclose(found, [known] * at.sum(), rtol=0, atol=5e-3)


def blade(thickness, width=0.01):
    """Sections of one link, a steel blade, thin in the plane of motion."""
    young, shear, density = 210e9, 210e9 / 2.6, 7850.0
    area = width * thickness
    about_y, about_z = width * thickness**3 / 12.0, thickness * width**3 / 12.0
    torsion = width * thickness**3 / 3.0
    stiffness = [young * area, shear * area / 1.2, shear * area / 1.2, shear * torsion]
    inertia = [about_y + about_z, about_y, about_z]
    bending = [young * about_y, young * about_z]
    return Sections(
        stiffness=jnp.array([*stiffness, *bending])[:, None],
        line_density=jnp.array([density * area]),
        rotary=jnp.array([density * x for x in inertia])[:, None],
        damping=jnp.zeros(1),
    )


STEP = 1e-5  # of errors, in differences
# thickness [m], share of gravity, D.delta_x [rad], D.d_x [m], coupler.length [m]
CASES = np.array(
    [
        [1e-3, 1.0, 0.0, 0.0, 0.0],
        [1e-3, 1.0, 0.02, 5e-4, -3e-4],
        [1e-3, 1.0, 0.02 + STEP, 5e-4, -3e-4],
        [1e-3, 1.0, 0.02 - STEP, 5e-4, -3e-4],
        [1e-4, 0.0, 1e-3, 1e-4, 2e-4],
        [1e-4, 0.0, 1e-3 + STEP, 1e-4, 2e-4],
        [1e-4, 0.0, 1e-3 - STEP, 1e-4, 2e-4],
        [1e-3, 1.0, 0.0, 0.0, 1.0],  # no link bends that far
    ]
)


@eqx.filter_jit
@eqx.filter_vmap(in_axes=(None, 0, 0))
def put_together(model, section, case):
    """Axial preload of C, its derivative with D.delta_x, status and all preload forces."""
    known = replace(model.section, edges=())
    sections = jax.tree.map(lambda old, new: old.at[..., 1:].set(new), known, section)
    model = eqx.tree_at(lambda m: (m.section, m.gravity), model, (sections, case[1] * model.gravity))

    def preload(tilt):
        errors = {"D.delta_x": tilt, "D.d_x": case[3], "coupler.length": case[4]}
        out = assemble(model, assembly_errors(model, errors))
        forces = jnp.stack([load.force for load in out.preload.values()])
        return out.preload["C"].force[1], (out.status, forces)

    (value, (status, forces)), derivative = jax.value_and_grad(preload, has_aux=True)(case[2])
    return value, derivative, status, forces


@pytest.fixture(scope="module")
def blades(four_bar):
    """Results of `put_together` by form of the elements; coupler and rocker are blades."""
    sections = jax.tree.map(lambda *x: jnp.stack(x), *[blade(thickness) for thickness in CASES[:, 0]])
    results = {}
    for elements in ("linear", "geometrically_exact"):
        model = four_bar("C", rigid="crank", rfes=4, elements=elements)
        assert model.topology.links[0] == "crank"
        out = put_together(model, sections, jnp.asarray(CASES))
        results[elements] = jax.tree.map(np.asarray, out)
    return results


@pytest.mark.long
@pytest.mark.parametrize("elements", ["linear", "geometrically_exact"])
def test_four_bar_of_blades_assembles(blades, elements):
    """EA L^2/EI of the rocker: 1.2e6 and 1.2e8.  Its preload has its derivative."""
    value, derivative, status, _ = blades[elements]
    assert (status[:4] == 0).all()
    # Blades of 0.1 mm buckle sideways (the next test): of linear elements nobody knows.
    assert (status[4:7] == (15 if elements == "geometrically_exact" else 0)).all()
    assert abs(value[0]) < 1e-9 * abs(value[1])  # a planar mechanism
    for one, above, below in ((1, 2, 3), (4, 5, 6)):
        difference = (value[above] - value[below]) / (2.0 * STEP)
        assert abs(difference) > 0.1 * abs(value[one] / CASES[one, 2])
        np.testing.assert_allclose(derivative[one], difference, rtol=2e-6)


@pytest.mark.long
def test_thin_blades_have_left_their_equilibrium(four_bar):
    """The equations of motion, another formulation than that of statics, have growing modes about the equilibrium of
    the thin blades, and none about that of the thick ones."""
    model = four_bar("C", rigid="crank", rfes=4, elements="geometrically_exact")
    for case, unstable in ((CASES[1], False), (CASES[4], True)):
        known = replace(model.section, edges=())
        sections = jax.tree.map(lambda old, new: old.at[..., 1:].set(new), known, blade(case[0]))
        made = eqx.tree_at(lambda m: (m.section, m.gravity), model, (sections, case[1] * model.gravity))
        errors = {"D.delta_x": case[2], "D.d_x": case[3], "coupler.length": case[4]}
        squares = natural_frequencies(made, errors, count=2).square
        assert (np.asarray(squares) < 0.0).any() == unstable


@pytest.mark.long
def test_both_forms_give_the_same_preload_of_blades(blades):
    linear, exact = (blades[name][3] for name in ("linear", "geometrically_exact"))
    for case in (0, 1, 4):
        largest = np.abs(exact[case]).max()
        np.testing.assert_allclose(linear[case], exact[case], rtol=0, atol=0.03 * largest)


@pytest.mark.long
def test_what_cannot_be_put_together_says_so(blades, four_bar):
    """Links far too long for linear elements (rounding decides whether Newton's method comes to rest
    somewhere beyond their range, or nowhere); a rigid loop that an error opens sideways, whose least-squares
    steps come to rest all the same."""
    assert STATUS[blades["linear"][2][7]].name in ("not_assembled", "out_of_range")
    rigid = four_bar("C")

    @jax.jit
    @jax.vmap
    def status(offset):
        return assemble(rigid, assembly_errors(rigid, {"D.d_y": offset})).status

    names = [STATUS[code].name for code in np.asarray(status(jnp.array([0.0, 1e-8, 1e-3])))]
    assert names == ["ok", "cannot_close", "cannot_close"]
