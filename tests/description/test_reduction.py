"""Craig-Bampton reduction of a lattice of springs, against its full matrices, by other ways."""

import numpy as np
import pytest
from scipy.linalg import eigh, null_space
from scipy.sparse import csr_array

from rfem_jax import Interface, craig_bampton


@pytest.fixture(scope="module")
def lattice():
    """Mass, stiffness, places of 20 nodes and the nodes of both ends of a bar of springs."""
    nodes = np.array([[x, y, z] for x in range(5) for y in (0.0, 1.0) for z in (0.0, 1.0)], dtype=float)
    nodes += 0.1 * np.random.default_rng(1).normal(size=nodes.shape)
    stiffness = np.zeros((60, 60))
    for i in range(20):
        for j in range(i):
            apart = nodes[i] - nodes[j]
            length = np.linalg.norm(apart)
            if length < 1.9:
                row = np.zeros(60)
                row[3 * i : 3 * i + 3], row[3 * j : 3 * j + 3] = apart / length, -apart / length
                stiffness += 1e6 * np.outer(row, row)
    mass = np.diag(np.repeat(np.random.default_rng(2).uniform(0.5, 1.5, 20), 3))
    return mass, stiffness, nodes, ([0, 1, 2, 3], [16, 17, 18, 19])


def reduced(lattice, coupling="averaged", modes=8, **settings):
    mass, stiffness, nodes, ends = lattice
    interfaces = [Interface(tuple(nodes[end].mean(axis=0) + [0.0, 0.1, 0.0]), end, coupling) for end in ends]
    return craig_bampton(csr_array(mass), csr_array(stiffness), nodes, interfaces, modes, **settings)


def of_frames(lattice, body):
    """Displacements of the nodes of both ends by those of the frames that move with them, (24, 12)."""
    _, _, nodes, ends = lattice
    origin = nodes[ends[0]].mean(axis=0) + [0.0, 0.1, 0.0]
    moved = np.zeros((24, 12))
    for k, end in enumerate(ends):
        for i, node in enumerate(end):
            x, y, z = nodes[node] - origin - np.asarray(body.interfaces)[k]
            block = np.hstack([np.eye(3), [[0, z, -y], [-z, 0, x], [y, -x, 0]]])
            moved[12 * k + 3 * i : 12 * k + 3 * i + 3, 6 * k : 6 * k + 6] = block
    return moved


@pytest.mark.parametrize("coupling", ["averaged", "rigid"])
def test_loads_at_interfaces_displace_them_as_those_of_the_mesh(lattice, coupling):
    """Forces of frames are spread evenly over averaged nodes; rigid ones are eliminated."""
    _, stiffness, _, ends = lattice
    body = reduced(lattice, coupling, modes=3)
    moved, own = of_frames(lattice, body), [3 * node + axis for end in ends for node in end for axis in range(3)]
    free = [row for row in range(60) if row not in own]
    loads = null_space(body.rigid_motions[:12].T)  # six that balance
    if coupling == "averaged":
        spread = np.zeros((60, 12))
        spread[own] = moved @ np.linalg.inv(moved.T @ moved)
        energies = loads.T @ spread.T @ np.linalg.pinv(stiffness, 1e-9) @ spread @ loads
    else:
        basis = np.zeros((60, 48))
        basis[free, :36] = np.eye(36)[:, : len(free)]
        basis[own, 36:] = moved
        padded = np.vstack([np.zeros((36, 6)), loads])
        energies = padded.T @ np.linalg.pinv(basis.T @ stiffness @ basis, 1e-9) @ padded
    found = loads.T @ np.linalg.pinv(np.asarray(body.stiffness)[:12, :12], 1e-9) @ loads
    np.testing.assert_allclose(found, energies, rtol=1e-7, atol=1e-9 * np.abs(energies).max())


def test_frequencies_fall_to_those_of_the_mesh(lattice):
    mass, stiffness, _, _ = lattice
    full = np.sqrt(eigh(stiffness, mass, eigvals_only=True)[6:12])
    errors = []
    for modes in (0, 4, 12, 24):
        body = reduced(lattice, modes=modes)
        values = eigh(np.asarray(body.stiffness), np.asarray(body.mass), eigvals_only=True)
        assert np.abs(values[:6]).max() < 1e-6 * values[6]
        errors.append(np.sqrt(values[6:12]) / full - 1.0)
    assert (np.array(errors) > -1e-9).all() and (np.diff(errors, axis=0) < 1e-12).all()
    assert errors[0][0] > 0.01 and errors[2][0] < 2e-3 and errors[3].max() < 5e-3, errors


def test_modes_move_no_interface_and_have_unit_mass(lattice):
    body = reduced(lattice, damping=1e-4)
    np.testing.assert_allclose(np.asarray(body.mass)[12:, 12:], np.eye(8), atol=1e-9)
    own = np.asarray(body.stiffness)[12:, 12:]
    np.testing.assert_allclose(own, np.diag(np.diag(own)), atol=1e-9 * own.max())
    np.testing.assert_allclose(np.asarray(body.stiffness)[:12, 12:], 0.0, atol=1e-9 * own.max())
    assert (np.diff(np.diag(own)) >= 0.0).all() and body.damping == 1e-4
    assert body == reduced(lattice, damping=1e-4)  # made again, with the same signs


def test_mass_and_moments_are_those_of_the_nodes(lattice):
    mass, _, nodes, ends = lattice
    body, each = reduced(lattice), np.diag(mass)[::3]
    x = nodes - nodes[ends[0]].mean(axis=0) - [0.0, 0.1, 0.0]
    assert body.total_mass == pytest.approx(each.sum(), rel=1e-12)
    of_rigid = np.asarray(body.moments) @ body.rigid_motions
    np.testing.assert_allclose(of_rigid[:, :, :3], np.einsum("p,pa,bc->abc", each, x, np.eye(3)), atol=1e-9)
    second = np.einsum("p,pa,pb->ab", each, x, x)
    np.testing.assert_allclose(of_rigid[0, 1, 5], second[0, 0])  # x y' = x (R_z x)
    np.testing.assert_allclose(of_rigid[2, 0, 4], second[2, 2])  # z x' = z (R_y z)
    np.testing.assert_allclose(of_rigid[1, 2, 3], second[1, 1])  # y z' = y (R_x y)


def test_places_of_stress_are_those_of_the_mesh(lattice):
    """A recovered row is what the displacements of a static load give."""
    _, stiffness, _, _ = lattice
    rows = np.random.default_rng(3).normal(size=(12, 60))
    rows -= (rows @ null_space(stiffness, 1e-9)) @ null_space(stiffness, 1e-9).T  # of rigid motions: none
    body = reduced(lattice, modes=2, stresses=csr_array(rows), stress_names=("one", "two"))
    load = np.zeros((14, 1))
    load[:12] = null_space(body.rigid_motions[:12].T)[:, :1]
    found = np.asarray(body.stresses) @ (np.linalg.pinv(np.asarray(body.stiffness), 1e-9) @ load)[:, 0]
    moved = of_frames(lattice, body)
    own = [3 * node + axis for end in lattice[3] for node in end for axis in range(3)]
    spread = np.zeros((60, 1))
    spread[own] = moved @ np.linalg.inv(moved.T @ moved) @ load[:12]
    expected = (rows @ np.linalg.pinv(stiffness, 1e-9) @ spread).reshape(2, 6)
    np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-9)
    assert body.stress_names == ("one", "two")


def test_weights_place_the_average(lattice):
    """A node without weight is free."""
    nodes = lattice[2]
    own = Interface((0.0, 0.0, 0.0), [0, 1, 2, 3], weights=[1.0, 1.0, 1.0, 0.0]).ties(nodes)[0]
    assert np.abs(own[:, 9:]).max() == 0.0
    other = Interface((0.0, 0.0, 0.0), [0, 1, 2]).ties(nodes)[0]
    np.testing.assert_allclose(own[:, :9], other, atol=1e-12)


END = (0.0, 0.0, 0.0)


@pytest.mark.wrong_types
@pytest.mark.parametrize(
    ("build", "pieces"),
    [
        (lambda of: Interface(END, [0, 1, 2, -3]), ("`nodes` of an interface", "from 0")),
        (lambda of: Interface(END, [0.5, 1.0]), ("`nodes` of an interface", "whole numbers")),
        (lambda of: Interface(END, [0, 1, 2], "glued"), ("`coupling` of an interface", "glued")),
        (lambda of: Interface(END, [0, 1, 2], weights=[1.0]), ("`weights` of an interface", "3 nodes")),
        (lambda of: Interface(END, [0, 1, 2], "rigid", [1.0] * 3), ("`weights` of an interface", "averaged")),
        (lambda of: craig_bampton(*of[:3], [Interface(END, [0, 1, 99])]), ("numbers of the 20 nodes", "99")),
        (lambda of: craig_bampton(*of[:3], [Interface(END, [0, 1])]), ("one line",)),
        (lambda of: craig_bampton(*of[:3], [Interface(END, [0, 1, 2]), Interface(END, [2, 3, 4])]), ("in common",)),
        (lambda of: craig_bampton(*of[:3], []), ("`interfaces`", "one or more")),
        (lambda of: craig_bampton(of[0][:9, :9], *of[1:3], [Interface(END, [0, 1, 2])]), ("`mass`", "(9, 9)")),
        (lambda of: craig_bampton(*of[:3], [Interface(END, [0, 1, 2])], modes=40), ("`modes`", "40")),
        (lambda of: craig_bampton(*of[:3], [Interface(END, [0, 1, 2])], stresses=of[0][:7]), ("`stresses`", "(7, 60)")),
        (
            lambda of: craig_bampton(of[0], np.diag([0.0] * 3 + [1.0] * 57), of[2], [Interface(END, [4, 5, 6])]),
            ("`stiffness`", "leaves some free"),
        ),
        (
            lambda of: craig_bampton(
                of[0], of[1] + 1e6 * np.eye(60), of[2], [Interface(END, [4, 5, 6]), Interface((4, 0, 0), [16, 17, 18])]
            ),
            ("`stiffness`", "rigid motions"),
        ),
    ],
)
def test_what_cannot_be_reduced_is_refused(refused, lattice, build, pieces):
    with refused(*pieces):
        build(lattice)
