"""The study of a rocker from a mesh: its finite elements against beams and closed forms, its body against them."""

import csv
import importlib
import sys

import numpy as np
import pytest
from scipy.linalg import eigh
from scipy.sparse.linalg import eigsh, spsolve

from rfem_jax import Interface, craig_bampton, load_body
from tests.programs.conftest import ROOT

pytestmark = pytest.mark.slow
FOLDER = ROOT / "studies" / "rocker_from_mesh"
MODULES = ("rocker_shape", "rocker_mesh", "make_rocker")


@pytest.fixture(scope="module")
def modules():
    """The shape, and where scikit-fem is installed the mesh and the program."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(FOLDER))
        yield lambda name: importlib.import_module(name)
    for name in (*MODULES, "rocker_picture"):
        sys.modules.pop(name, None)


@pytest.fixture(scope="module")
def quick(modules):
    """The program's modules, and the coarse mesh."""
    pytest.importorskip("skfem")
    shape, mesh, make = (modules(name) for name in MODULES)
    divisions = shape.QUICK
    return make, mesh, mesh.solid(mesh.thickened(shape.blocks(divisions), divisions.thick, shape.THICKNESS))


def arc(centre, radius, first, last):
    """A curve over [0, 1], and its derivative, by angles."""
    turn = last - first
    return lambda s: (
        (centre[0] + radius * np.cos(first + turn * s), centre[1] + radius * np.sin(first + turn * s)),
        (-radius * turn * np.sin(first + turn * s), radius * turn * np.cos(first + turn * s)),
    )


def upper_outline(eye):
    """Curves of the upper half of an eye at the origin, from behind to where its fillet meets the shank, and that
    point; the fillet touches the eye and the straight side from outside."""
    lean = np.arctan(eye.slope)
    off, reach = eye.height * np.cos(lean) + eye.fillet, eye.outside + eye.fillet
    along = np.sqrt(reach**2 - off**2)
    centre = along * np.cos(lean) - off * np.sin(lean), along * np.sin(lean) + off * np.cos(lean)
    touches, foot = np.arctan2(centre[1], centre[0]), lean - 0.5 * np.pi
    meets = centre[0] + eye.fillet * np.cos(foot), centre[1] + eye.fillet * np.sin(foot)
    around = arc((0.0, 0.0), eye.outside, np.pi, touches)
    return [around, arc(centre, eye.fillet, touches - np.pi, foot)], meets


def outline_integrals(shape):
    """Integrals of 1, x, x^2 and z^2 over the part, by those along its upper outline, 2 z f(x) dx, less its bores."""
    nodes, weights = np.polynomial.legendre.leggauss(40)
    s, total, ends = 0.5 * (nodes + 1.0), np.zeros(4), []

    def add(x, z, dx):
        total[:] += [0.5 * (weights * one * dx).sum() for one in (2 * z, 2 * z * x, 2 * z * x**2, 2 * z**3 / 3)]

    for eye, mirrored in ((shape.D, False), (shape.C, True)):
        curves, meets = upper_outline(eye)
        for curve in curves:
            (x, z), (dx, _) = curve(s)
            add(shape.LENGTH - x if mirrored else x, z, dx)  # both signs of dx change
        ends.append((shape.LENGTH - meets[0] if mirrored else meets[0], meets[1]))
        area, middle = np.pi * eye.bore**2, shape.LENGTH if mirrored else 0.0
        own = area * eye.bore**2 / 4.0
        total -= [area, area * middle, area * middle**2 + own, own]
    (x0, z0), (x1, z1) = ends
    add(x0 + (x1 - x0) * s, z0 + (z1 - z0) * s, x1 - x0)
    return total


def assert_mass_of_the_shape(body, shape, rtol):
    area, first, along, across = 7850.0 * shape.THICKNESS * outline_integrals(shape)
    through = area * shape.THICKNESS**2 / 12.0
    assert body.total_mass == pytest.approx(area, rel=rtol)
    tensor = body.rigid_motions.T @ np.asarray(body.mass) @ body.rigid_motions
    moments = np.diag([across + through, along + across, along + through])
    np.testing.assert_allclose(tensor[3:, 3:], moments, rtol=rtol, atol=rtol * along)
    assert tensor[5, 1] == pytest.approx(first, rel=rtol) and abs(tensor[3, 2]) < 1e-9 * first
    about = np.asarray(body.moments) @ body.rigid_motions  # of x_a times displacement b
    assert about[0, 1, 5] == pytest.approx(along, rel=rtol) and about[0, 0, 0] == pytest.approx(first, rel=rtol)


def test_the_body_of_the_study_has_the_mass_of_the_shape(modules):
    shape, body = modules("rocker_shape"), load_body(FOLDER / "rocker.npz")
    assert_mass_of_the_shape(body, shape, 2e-5)
    np.testing.assert_allclose(body.interfaces, [[0.0, 0.0, 0.0], [shape.LENGTH, 0.0, 0.0]], atol=1e-15)
    assert (FOLDER / "rocker.npz").stat().st_size < 50_000


def test_a_coarse_mesh_nearly_has_it(quick, modules):
    make, _, solid = quick
    assert_mass_of_the_shape(make.reduced(solid, 2), modules("rocker_shape"), 5e-4)


def test_loads_at_bores_deflect_the_reduced_body_as_the_mesh(quick):
    """Energies of loads in balance, of the mesh held at three nodes, as a free body needs it."""
    make, mesh, solid = quick
    frames, ties = [], []
    for x, eye in ((0.0, make.D), (make.LENGTH, make.C)):
        nodes, areas = mesh.bore_of(solid, x, eye.bore)
        frames.append(Interface((x, 0.0, 0.0), nodes, weights=areas))
        rows = np.zeros((6, 3 * len(solid.nodes)))
        rows[:, (3 * nodes[:, None] + np.arange(3)).reshape(-1)] = frames[-1].ties(solid.nodes)[0]
        ties.append(rows)
    body = craig_bampton(solid.mass, solid.stiffness, solid.nodes, frames, 3)
    loads = np.linalg.svd(body.rigid_motions[:12].T)[2][6:].T  # of both frames, in balance
    forces = np.vstack(ties).T @ loads
    along_z = int(np.abs(solid.nodes[:, 2] - 0.0).argmax())
    held = [0, 1, 2]  # a node, and of two others what holds the rotations
    far = int(np.linalg.norm(solid.nodes - solid.nodes[0], axis=1).argmax())
    held += [3 * far + 1, 3 * far + 2, 3 * along_z + 1]
    free = np.setdiff1d(np.arange(len(forces)), held)
    moved = spsolve(solid.stiffness.tocsc()[free][:, free], forces[free])
    energies = forces[free].T @ moved
    found = loads.T @ np.linalg.pinv(np.asarray(body.stiffness)[:12, :12], 1e-11) @ loads
    np.testing.assert_allclose(found, energies, rtol=1e-4, atol=1e-6 * np.abs(energies).max())
    full = np.sort(eigsh(solid.stiffness, 12, solid.mass, sigma=make.SHIFT, return_eigenvectors=False))[6:]
    errors = []
    for modes in (3, 8, 20):
        body = craig_bampton(solid.mass, solid.stiffness, solid.nodes, frames, modes)
        own = eigh(np.asarray(body.stiffness), np.asarray(body.mass), eigvals_only=True)[6:12]
        errors.append(np.sqrt(own / full) - 1.0)
    assert (np.array(errors) > -1e-6).all() and (np.diff(errors, axis=0) < 1e-9).all()
    assert errors[1][:3].max() < 2e-3 and errors[2].max() < 5e-3, errors


LONG, DEEP, WIDE = 0.6, 0.02, 0.012


def simpson(share, elements):
    """Weights of nodes at shares of a length that is divided into elements of second order."""
    weights = np.zeros(2 * elements + 1)
    for k in range(elements):
        weights[2 * k : 2 * k + 3] += [1.0, 4.0, 1.0]
    return weights[np.rint(share * 2 * elements).astype(int)]


@pytest.fixture(scope="module")
def bar(quick):
    """A prismatic bar of solids, reduced to its ends."""
    _, mesh, _ = quick
    along, across, through = 20, 4, 3
    x, z = np.linspace(0.0, LONG, 2 * along + 1), np.linspace(-0.5 * DEEP, 0.5 * DEEP, 2 * across + 1)
    solid = mesh.solid(mesh.thickened([np.stack(np.meshgrid(x, z, indexing="ij"), axis=-1)], through, WIDE))
    frames = []
    for end in (0.0, LONG):
        nodes = np.flatnonzero(np.abs(solid.nodes[:, 0] - end) < 1e-9)
        y, z = (solid.nodes[nodes][:, 1:] / [WIDE, DEEP] + 0.5).T
        frames.append(Interface((end, 0.0, 0.0), nodes, weights=simpson(y, through) * simpson(z, across)))
    return craig_bampton(solid.mass, solid.stiffness, solid.nodes, frames, 30)


def test_a_bar_of_solids_is_a_beam(bar, quick):
    """Axial, bending in both planes and torsion of a cantilever: Timoshenko, and Saint-Venant by his series."""
    modulus, poisson, density = quick[1].STEEL
    shear, area = 0.5 * modulus / (1.0 + poisson), DEEP * WIDE
    tip = np.linalg.inv(np.asarray(bar.stiffness)[6:12, 6:12])
    odd = np.arange(1, 60, 2)
    torsion = (
        DEEP
        * WIDE**3
        / 3
        * (1 - 192 / np.pi**5 * WIDE / DEEP * np.sum(np.tanh(odd * np.pi * DEEP / WIDE / 2) / odd**5))
    )
    assert tip[0, 0] == pytest.approx(LONG / modulus / area, rel=1e-6)
    for axis, second in ((2, WIDE * DEEP**3 / 12.0), (1, DEEP * WIDE**3 / 12.0)):
        bending = LONG**3 / 3.0 / modulus / second + 1.2 * LONG / shear / area
        assert tip[axis, axis] == pytest.approx(bending, rel=2e-3)
        turned = 4 if axis == 2 else 5
        assert tip[turned, turned] == pytest.approx(LONG / modulus / second, rel=2e-3)
    assert tip[3, 3] == pytest.approx(LONG / shear / torsion, rel=1e-3)
    assert bar.total_mass == pytest.approx(density * area * LONG, rel=1e-12)
    values = eigh(np.asarray(bar.stiffness), np.asarray(bar.mass), eigvals_only=True)[6:]
    found = np.sqrt(values) / (2.0 * np.pi)
    bends = (4.730041**2, 7.853205**2)  # of a free bar: Euler and Bernoulli, below which Timoshenko stays by little
    wanted = [k / (2.0 * np.pi * LONG**2) * np.sqrt(modulus * second / (density * area))
              for second in (WIDE * DEEP**3 / 12.0, DEEP * WIDE**3 / 12.0) for k in bends]  # fmt: skip
    for frequency in wanted:
        nearest = found[np.abs(found - frequency).argmin()]
        assert 0.98 < nearest / frequency < 1.0
    stretch = np.sqrt(modulus / density) / (2.0 * LONG)
    assert np.abs(found / stretch - 1.0).min() < 5e-3
    polar = area * (DEEP**2 + WIDE**2) / 12.0
    twist = np.sqrt(shear * torsion / (density * polar)) / (2.0 * LONG)
    assert np.abs(found / twist - 1.0).min() < 1e-2


def test_stresses_of_a_bent_bar(quick):
    """Recovered at the middle of a cantilever: M z / I."""
    _, mesh, _ = quick
    x, z = np.linspace(0.0, 0.2, 17), np.linspace(-0.5 * DEEP, 0.5 * DEEP, 5)
    solid = mesh.solid(mesh.thickened([np.stack(np.meshgrid(x, z, indexing="ij"), axis=-1)], 1, WIDE))
    ends = [np.flatnonzero(np.abs(solid.nodes[:, 0] - end) < 1e-9) for end in (0.0, 0.2)]
    frames = [Interface((end, 0.0, 0.0), nodes) for end, nodes in zip((0.0, 0.2), ends)]
    rows = mesh.stress_rows(solid)
    body = craig_bampton(solid.mass, solid.stiffness, solid.nodes, frames, 0, stresses=rows)
    tip = np.linalg.inv(np.asarray(body.stiffness)[6:12, 6:12])
    middle = int(np.linalg.norm(solid.nodes - [0.1, 0.0, 0.5 * DEEP], axis=1).argmin())
    for load, wanted in ((2, -0.1 * 0.5 * DEEP / (WIDE * DEEP**3 / 12.0)), (0, 1.0 / (WIDE * DEEP))):
        found = np.asarray(body.stresses)[middle, :, 6:12] @ tip[:, load]
        assert found[0] == pytest.approx(wanted, rel=5e-3)
        np.testing.assert_allclose(found[1:], 0.0, atol=2e-2 * abs(wanted))


def test_stresses_of_even_strain_are_exact(quick):
    """On the rocker's distorted elements, too: all displacements that are linear in the place, by Hooke's law."""
    _, mesh, solid = quick
    modulus, poisson, _ = mesh.STEEL
    slope = 1e-4 * np.random.default_rng(4).normal(size=(3, 3))
    strain = 0.5 * (slope + slope.T)
    stress = modulus / (1.0 + poisson) * (strain + poisson / (1.0 - 2.0 * poisson) * np.trace(strain) * np.eye(3))
    found = (mesh.stress_rows(solid) @ (solid.nodes @ slope.T).reshape(-1)).reshape(-1, 6)
    wanted = [stress[0, 0], stress[1, 1], stress[2, 2], stress[0, 1], stress[1, 2], stress[2, 0]]
    np.testing.assert_allclose(found, np.tile(wanted, (len(found), 1)), rtol=1e-9, atol=1e-3)
    moved = (solid.nodes @ slope.T).reshape(-1)
    volume = solid.basis.dx.sum()
    assert moved @ (solid.stiffness @ moved) == pytest.approx(volume * np.tensordot(stress, strain), rel=1e-10)


def test_the_program(run_program, tmp_path):
    pytest.importorskip("skfem")
    said = run_program("studies/rocker_from_mesh/make_rocker.py", "--quick", "--out", tmp_path)
    assert "The body is in" in said
    assert {path.name for path in tmp_path.iterdir()} == {"rocker.npz", "rocker.csv", "rocker.png"}
    body = load_body(tmp_path / "rocker.npz")
    assert body.modes == 10 and len(body.stress_names) >= 4 and float(body.damping) == 1e-5
    with open(tmp_path / "rocker.csv", newline="", encoding="utf-8") as file:
        rows = {row["quantity"]: row for row in csv.DictReader(file)}
    for k in range(1, 7):
        row = rows[f"frequency {k}, Hz"]
        assert 1.0 - 1e-6 < float(row["reduced"]) / float(row["mesh"]) < 1.02
    for name in ("bent, m/N", "bent_sideways, m/N", "twisted, rad/(N m)", "turned_sideways, rad/(N m)"):
        assert float(rows[name]["reduced"]) == pytest.approx(float(rows[name]["beam"]), rel=0.15)


@pytest.mark.long
def test_the_body_of_the_study_is_what_the_program_makes(run_program, tmp_path):
    pytest.importorskip("skfem")
    run_program("studies/rocker_from_mesh/make_rocker.py", "--out", tmp_path)
    made, kept = load_body(tmp_path / "rocker.npz"), load_body(FOLDER / "rocker.npz")
    assert made.stress_names == kept.stress_names
    for name in ("interfaces", "mass", "stiffness", "moments", "stresses"):
        found, wanted = np.asarray(getattr(made, name)), np.asarray(getattr(kept, name))
        np.testing.assert_allclose(np.abs(found), np.abs(wanted), rtol=1e-5, atol=1e-7 * np.abs(wanted).max())
