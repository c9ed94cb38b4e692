"""Matrices of all nodes of a perfect mechanism as free bodies, from which its vibration follows.

Place in the pipeline: model, with_errors -> **vibration_matrices** -> vibration.

Velocities w are six of every node (rfe) in the axes of its link: angular, then linear.
"""

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

from rfem_jax.compilation.program import Program
from rfem_jax.mechanics.model.errors import assembly_errors
from rfem_jax.mechanics.model.model import Model, Topology
from rfem_jax.mechanics.model.nominal_geometry import cross_matrix
from rfem_jax.mechanics.model.with_errors import apply_errors

SMALLEST_INERTIA = 1e-15  # of a body, over its mass times the square of the longest link
RIDGE = 1e-13  # added to a matrix with unit diagonal that may be singular


@partial(Program, nameless=True)
def _nominal(model: Model):
    return apply_errors(model, assembly_errors(model))


class NodeConstants(NamedTuple):
    """Constants of `ModelWithErrors` for zero errors: mass (n,), centre (n, 3), inertia (n, 3, 3) of all nodes; rest,
    damping, lever (N,) to the sde on the left, and stiffness (6, N) of the N free rfes; with forms rest and lever are
    vectors (N, 3), and the stiffness a matrix (6, 6, N)."""

    mass: np.ndarray
    centre: np.ndarray
    inertia: np.ndarray
    rest: np.ndarray
    stiffness: np.ndarray
    damping: np.ndarray
    lever: np.ndarray


def nominal_constants(model: Model) -> NodeConstants:
    """Constants of the nodes, whatever forces are given at them."""
    made = _nominal(_bare(model))
    return NodeConstants(
        mass=np.asarray(made.mass),
        centre=np.asarray(made.centre).T,
        inertia=np.moveaxis(np.asarray(made.inertia), 2, 0),
        rest=np.asarray(made.rest).T,
        stiffness=np.asarray(made.stiffness),
        damping=np.asarray(made.damping),
        lever=np.asarray(made.lever_right).T,
    )


def _bare(model: Model) -> Model:
    """The model without its source and without force elements that have no tangent: the program does not read them, and
    thousands of them would be its arguments."""
    kept = {name: element for name, element in (model.frame_forces or {}).items() if element.components}
    return dataclasses.replace(model, source=None, frame_forces=kept or None, line_loads=None)


def mass_matrices(constants: NodeConstants, scale: float) -> tuple[sparse.csr_matrix, sparse.csr_matrix]:
    """M, block diagonal by node, and L^-T."""
    n = len(constants.mass)
    mass = np.zeros((n, 6, 6))
    shift = constants.mass[:, None, None] * cross_matrix(constants.centre)
    least = SMALLEST_INERTIA * constants.mass * scale**2
    mass[:, :3, :3] = constants.inertia - shift @ cross_matrix(constants.centre) + least[:, None, None] * np.eye(3)
    mass[:, :3, 3:] = shift
    mass[:, 3:, :3] = -shift
    mass[:, 3:, 3:] = constants.mass[:, None, None] * np.eye(3)
    root = np.linalg.inv(np.linalg.cholesky(mass)).swapaxes(1, 2)
    return _block_diagonal(mass), _block_diagonal(root)


def _block_diagonal(blocks: np.ndarray) -> sparse.csr_matrix:
    n = len(blocks)
    return sparse.csr_matrix(sparse.bsr_matrix((blocks, np.arange(n), np.arange(n + 1)), shape=(6 * n, 6 * n)))


def deformation_rates(constants: NodeConstants, topology: Topology) -> sparse.csr_matrix:
    """Matrix (6 N, 6 n) that gives the deformation rates (du, dphi) of all sdes from the nodes' velocities."""
    n, count = topology.n_links, topology.n_rfes
    left = np.arange(n - 1, n + count - 1)
    first = [a for a, b in topology.ranges if b > a]
    left[first] = topology.link_of_rfe[first]
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


def spring_matrices(constants: NodeConstants) -> tuple[Any, Any]:
    """Stiffness K (6 N, 6 N) of all springs, and R with R^T R = K, sparse."""
    if constants.stiffness.ndim == 2:
        springs = constants.stiffness.T.reshape(-1)
        return sparse.diags(springs), sparse.diags(np.sqrt(springs))
    blocks = np.moveaxis(constants.stiffness, 2, 0)
    return _block_diagonal(blocks), _block_diagonal(np.linalg.cholesky(blocks).swapaxes(1, 2))


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
