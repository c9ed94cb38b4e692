"""Matrices of all nodes of a perfect mechanism as free bodies, from which its vibration follows.

Place in the pipeline: model, with_errors -> **vibration_matrices** -> vibration.

Velocities w are six of every node (rfe) in the axes of its link: angular, then linear.
"""

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

from rfem_jax.compilation.program import Program
from rfem_jax.mechanics.model.errors import assembly_errors
from rfem_jax.mechanics.model.model import Model
from rfem_jax.mechanics.model.nominal_geometry import cross_matrix
from rfem_jax.mechanics.model.superelements import Superelement
from rfem_jax.mechanics.model.topology import Topology
from rfem_jax.mechanics.model.with_errors import apply_errors

SMALLEST_INERTIA = 1e-15  # of a body, over its mass times the square of the longest link
RIDGE = 1e-13  # added to a matrix with unit diagonal that may be singular


@partial(Program, nameless=True)
def _nominal(model: Model):
    return apply_errors(model, assembly_errors(model))


class NodeConstants(NamedTuple):
    """Constants of `ModelWithErrors` for zero errors: mass (n,), centre (n, 3), inertia (n, 3, 3) of all nodes; rest,
    damping, lever (N,) to the sde on the left, and stiffness (6, N) of the N free rfes; with forms rest and lever are
    vectors (N, 3), and the stiffness a matrix (6, 6, N); bodies: superelements by their links."""

    mass: np.ndarray
    centre: np.ndarray
    inertia: np.ndarray
    rest: np.ndarray
    stiffness: np.ndarray
    damping: np.ndarray
    lever: np.ndarray
    bodies: dict[int, Superelement]


def nominal_constants(model: Model) -> NodeConstants:
    """Constants of the nodes, whatever forces are given at them."""
    made, topology = _nominal(_bare(model)), model.topology
    found = jax.tree.map(np.asarray, made.superelements or ())
    bodies = {one.link: element for one, element in zip(topology.reduced, found, strict=True)}
    damping = np.array(made.damping)
    for l, element in bodies.items():
        damping[slice(*topology.ranges[l])] = element.damping
    return NodeConstants(
        mass=np.asarray(made.mass),
        centre=np.asarray(made.centre).T,
        inertia=np.moveaxis(np.asarray(made.inertia), 2, 0),
        rest=np.asarray(made.rest).T,
        stiffness=np.asarray(made.stiffness),
        damping=damping,
        lever=np.asarray(made.lever_right).T,
        bodies=bodies,
    )


def _bare(model: Model) -> Model:
    """The model without its source and without force elements that have no tangent: the program does not read them, and
    thousands of them would be its arguments."""
    kept = {name: element for name, element in (model.frame_forces or {}).items() if element.components}
    return dataclasses.replace(model, source=None, frame_forces=kept or None, line_loads=None)


def mass_matrices(
    constants: NodeConstants, topology: Topology, scale: float
) -> tuple[sparse.csr_matrix, sparse.csr_matrix]:
    """M, block diagonal by node, or by superelement, and L^-T."""
    n = len(constants.mass)
    mass = np.zeros((n, 6, 6))
    shift = constants.mass[:, None, None] * cross_matrix(constants.centre)
    least = SMALLEST_INERTIA * constants.mass * scale**2
    mass[:, :3, :3] = constants.inertia - shift @ cross_matrix(constants.centre) + least[:, None, None] * np.eye(3)
    mass[:, :3, 3:] = shift
    mass[:, 3:, :3] = -shift
    mass[:, 3:, 3:] = constants.mass[:, None, None] * np.eye(3)
    if not constants.bodies:
        root = np.linalg.inv(np.linalg.cholesky(mass)).swapaxes(1, 2)
        return _block_diagonal(mass), _block_diagonal(root)
    blocks, alone = [], set(range(n))
    for l, element in constants.bodies.items():
        nodes = [l, *(topology.n_links + k for k in range(*topology.ranges[l]))]
        alone -= set(nodes)
        blocks.append((nodes, _superelement_mass(element, mass[nodes], constants.rest[slice(*topology.ranges[l])])))
    blocks += [([node], mass[node]) for node in alone]
    roots = [(nodes, np.linalg.inv(np.linalg.cholesky(block)).T) for nodes, block in blocks]
    return _at_nodes(blocks, n), _at_nodes(roots, n)


def _superelement_mass(element: Superelement, own: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Mass matrix (6 m + 6, 6 m + 6) of a superelement by velocities of its link frame and of its m free rfes, which
    stand at `places` (m, 3); `own` (m + 1, 6, 6): of what stands on each alone."""
    m = len(places)
    rates = np.zeros((6, m, m + 1, 6))  # of the coordinates, those of displacements first
    for k, place in enumerate(places):
        rates[:3, k, k + 1, 3:] = rates[3:, k, k + 1, :3] = np.eye(3)
        rates[:3, k, 0, 3:] = rates[3:, k, 0, :3] = -np.eye(3)
        rates[:3, k, 0, :3] = cross_matrix(place)
    rates = rates.reshape(6 * m, 6 * m + 6)
    mass = rates.T @ element.mass @ rates
    across = np.vstack([element.rotation, element.translation]) @ rates
    mass[:6] += across
    mass[:, :6] += across.T
    for k, block in enumerate(own):
        mass[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] += block
    return mass


def _at_nodes(blocks: list[tuple[list[int], Any]], n: int) -> sparse.csr_matrix:
    """Blocks in the rows and columns of their nodes, of n."""
    rows, columns, entries = [], [], []
    for nodes, block in blocks:
        at = (6 * np.array(nodes)[:, None] + np.arange(6)).reshape(-1)
        i, j = np.meshgrid(at, at, indexing="ij")
        rows.append(i.reshape(-1))
        columns.append(j.reshape(-1))
        entries.append(block.reshape(-1))
    places = np.concatenate(rows), np.concatenate(columns)
    return sparse.csr_matrix((np.concatenate(entries), places), shape=(6 * n, 6 * n))


def _block_diagonal(blocks: np.ndarray) -> sparse.csr_matrix:
    n = len(blocks)
    return sparse.csr_matrix(sparse.bsr_matrix((blocks, np.arange(n), np.arange(n + 1)), shape=(6 * n, 6 * n)))


def deformation_rates(constants: NodeConstants, topology: Topology) -> sparse.csr_matrix:
    """Matrix (6 N, 6 n) that gives the deformation rates (du, dphi) of all sdes from the nodes' velocities."""
    n, count = topology.n_links, topology.n_rfes
    left = np.arange(n - 1, n + count - 1)
    first = [a for a, b in topology.ranges if b > a]
    left[first] = topology.link_of_rfe[first]
    left[topology.reduced_rfes] = topology.link_of_rfe[topology.reduced_rfes]
    place_of = np.concatenate([np.zeros((n, *constants.rest.shape[1:])), constants.rest])
    sde = constants.rest + constants.lever

    def faces(node):
        blocks = np.zeros((count, 6, 6))
        arm = np.zeros((count, 3))
        arm[:, slice(3) if sde.ndim == 2 else 0] = sde - place_of[node]
        blocks[:, :3, :3] = -cross_matrix(arm)
        blocks[:, :3, 3:] = blocks[:, 3:, :3] = np.eye(3)
        shape = (6 * count, 6 * (n + count))
        return sparse.bsr_matrix((blocks, node, np.arange(count + 1)), shape=shape)

    return sparse.csr_matrix(faces(n + np.arange(count)) - faces(left))


def spring_matrices(constants: NodeConstants, topology: Topology) -> tuple[Any, Any]:
    """Stiffness K (6 N, 6 N) of all springs, and R with R^T R = K, sparse."""
    if constants.stiffness.ndim == 2:
        springs = constants.stiffness.T.reshape(-1)
        return sparse.diags(springs), sparse.diags(np.sqrt(springs))
    blocks = np.moveaxis(constants.stiffness, 2, 0)
    if not constants.bodies:
        return _block_diagonal(blocks), _block_diagonal(np.linalg.cholesky(blocks).swapaxes(1, 2))
    by_link: list[tuple[list[int], Any]] = []
    for l, (a, b) in enumerate(topology.ranges):
        if l in constants.bodies:
            by_rfe = np.arange(6 * (b - a)).reshape(6, b - a).T.reshape(-1)
            by_link.append(([*range(a, b)], constants.bodies[l].stiffness[np.ix_(by_rfe, by_rfe)]))
        else:
            by_link += [([k], blocks[k]) for k in range(a, b)]
    roots = [(rfes, np.linalg.cholesky(one).T) for rfes, one in by_link]
    return _at_nodes(by_link, len(blocks)), _at_nodes(roots, len(blocks))


def unit_rows(matrix: np.ndarray) -> np.ndarray:
    return matrix / np.linalg.norm(matrix, axis=1, keepdims=True)


def null_space_projection(constraints: sparse.csc_matrix) -> Callable[[np.ndarray], np.ndarray]:
    """Orthogonal projection onto the null space of a sparse matrix, whose rows may be linearly dependent."""
    size = np.sqrt(np.asarray(constraints.multiply(constraints).sum(axis=1)).reshape(-1))
    unit = sparse.csc_matrix(sparse.diags(1.0 / size) @ constraints)
    factored = splu(sparse.csc_matrix(unit @ unit.T + RIDGE * sparse.eye(len(size))))

    def once(vector):
        return vector - unit.T @ factored.solve(unit @ vector)

    return lambda vector: once(once(vector))
