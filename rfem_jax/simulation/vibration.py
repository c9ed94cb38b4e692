"""Vibration of the perfect mechanism about a position of rest: squared frequencies and damping.

Place in the pipeline: model -> **vibration** -> stability.

All bodies (rfes) have six velocities of their own, in the axes of their link; joints are constraints on these
(theory (11.5)):

    M w'' + C w' + K w + G^T lambda = 0,     G w = 0.

M is block diagonal, K and C are those of the springs between neighbours, the same in every position; only G
turns with the joint angles.  With M = L L^T and the orthogonal projection P onto the null space of G L^-T the
modes are those of P L^-1 K L^-T P.  All of them are found for small mechanisms; for large ones the stiffest, by
Lanczos' method with sparse matrices, in memory proportional to the number of rfes.

What gravity and the forces at rest add to K is left out, next to nothing against springs; a mechanism of rigid
links has nothing else, and its accelerations are differentiated by central differences.
"""

from typing import NamedTuple

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import LinearOperator, eigsh, splu

from rfem_jax.compilation.program import Program
from rfem_jax.mechanics.cut_joints import RANK_TOLERANCE
from rfem_jax.mechanics.model import BASE, Model
from rfem_jax.mechanics.nominal_geometry import (
    NominalGeometry,
    Placed,
    cross_matrix,
    geometry_of,
    place,
)
from rfem_jax.mechanics.realisation import assembly_errors, realise

MOST_BODIES = 40  # of which all modes are found
STIFFEST_TOLERANCE = 1e-6
SAMPLES = 400  # of the modes below the stiffest one
DIFFERENCE = 1e-5  # rad
SMALLEST_INERTIA = 1e-15  # of a body, over its mass times the square of the longest link
RIDGE = 1e-13


class Modes(NamedTuple):
    """Equations y'' + damping y' + squares y = 0 of modal coordinates: squares (n,) [rad^2/s^2], complex if
    forces at rest are not conservative; damping (n,) or, where the modes are coupled by it, (n, n) [1/s]."""

    squares: np.ndarray
    damping: np.ndarray

    def eigenvalues(self) -> np.ndarray:
        """All eigenvalues (2 n,) [rad/s]."""
        if self.damping.ndim == 2:
            n = len(self.squares)
            lower = np.hstack([-np.diag(self.squares), -self.damping])
            return np.linalg.eigvals(np.vstack([np.eye(n, 2 * n, n), lower]))
        half = 0.5 * self.damping
        first = -half - np.sqrt(half**2 - self.squares + 0j)
        # The small root of a strongly damped mode by the product of both, not by their difference.
        second = np.where(first == 0.0, 0.0, self.squares / np.where(first == 0.0, 1.0, first))
        return np.concatenate([first, second])


class Vibration:
    """The vibration of a model in positions given by joint angles.

    **Arguments:** `held`: whether the driven joint's angle is prescribed.
    """

    def __init__(self, model: Model, held: bool = False):
        constants = _nominal_constants(model)
        self.geometry: NominalGeometry = geometry_of(model)
        self.topology = model.topology
        self.held = held and self.topology.driven is not None
        self.gravity = np.asarray(model.gravity)
        self.mass, self.inverse_root = _masses(constants, self.geometry.scale)
        stretch = _stretch(constants, self.topology) @ self.inverse_root
        springs = constants.stiffness.T.reshape(-1)
        damping = np.repeat(constants.damping, 6)
        self.rates = np.unique(constants.damping)
        self.root, self.damping = sparse.diags(np.sqrt(springs)) @ stretch, damping
        # The springs by their damping, which most mechanisms have but one of.
        self.springs = [
            (stretch.T @ sparse.diags(np.where(damping == rate, springs, 0.0)) @ stretch).tocsr()
            for rate in self.rates
        ]
        self.before = [None] * len(self.rates)

    def modes(self, angles: np.ndarray) -> Modes:
        """The modes at joint angles (links,), links undeformed."""
        placed = place(self.geometry, angles)
        if self.topology.n_rfes == 0:
            return self._rigid(np.asarray(angles))
        constraints = self._constraints(placed) @ self.inverse_root
        if self.mass.shape[0] <= 6 * MOST_BODIES:
            return self._all(constraints.toarray())
        return self._stiffest(constraints.tocsc())

    def _all(self, constraints: np.ndarray) -> Modes:
        _, singular, rows = np.linalg.svd(_unit_rows(constraints))
        free = rows[np.sum(singular > RANK_TOLERANCE * singular[0]) :]
        # Singular values of the root of the springs: soft modes of stiff links keep their digits.
        stretch = self.root @ free.T
        missing = np.zeros((max(0, free.shape[0] - stretch.shape[0]), free.shape[0]))
        _, frequencies, vectors = np.linalg.svd(np.concatenate([stretch, missing]), full_matrices=False)
        squares = frequencies**2
        if len(self.rates) == 1:
            return Modes(squares, self.rates[0] * squares)
        stretch = stretch @ vectors.T
        return Modes(squares, stretch.T @ (self.damping[:, None] * stretch))

    def _stiffest(self, constraints) -> Modes:
        """Of the links of each damping alone, which vibrate by themselves when they do it fast: the stiffest mode,
        and others evenly below it, instead of the mechanism's own: those are not found one by one."""
        project = _projection(constraints)
        size = self.mass.shape[0]
        squares, damping = [], []
        for i, (rate, springs) in enumerate(zip(self.rates, self.springs, strict=True)):

            def felt(w, springs=springs):
                return project(springs @ project(w.reshape(-1)))

            # The stiffest mode of the position before is a good guess.
            start = np.random.default_rng(0).normal(size=size) if self.before[i] is None else self.before[i]
            operator = LinearOperator((size, size), felt, dtype=float)
            (largest,), vector = eigsh(operator, 1, v0=start, which="LA", tol=STIFFEST_TOLERANCE)
            self.before[i] = vector[:, 0]
            squares.append(largest * np.linspace(0.0, 1.0, SAMPLES) ** 2)
            damping.append(rate * squares[-1])
        return Modes(np.concatenate(squares), np.concatenate(damping))

    def _rigid(self, angles: np.ndarray) -> Modes:
        columns = []
        for shift in DIFFERENCE * np.eye(len(angles)):
            ahead, behind = self._hinge_accelerations(angles + shift), self._hinge_accelerations(angles - shift)
            columns.append((ahead - behind) / (2.0 * DIFFERENCE))
        squares = -np.linalg.eigvals(np.array(columns).T)
        return Modes(squares, np.zeros(len(squares)))

    def _hinge_accelerations(self, angles: np.ndarray) -> np.ndarray:
        """Second derivatives of the joint angles of rigid links under gravity, at rest."""
        placed = place(self.geometry, angles)
        n = self.topology.n_links
        falling = np.concatenate([np.zeros((n, 3)), placed.rotation.transpose(0, 2, 1) @ self.gravity], axis=1)
        load = self.inverse_root.T @ (self.mass @ falling.reshape(-1))
        free = _projection((self._constraints(placed) @ self.inverse_root).tocsc())(load)
        angular = np.einsum("lij,lj->li", placed.rotation, (self.inverse_root @ free).reshape(n, 6)[:, :3])
        parents = [np.zeros(3) if p == BASE else angular[p] for p in self.topology.parents[:n]]
        turning = np.sum(placed.joint_rotation[:n, :, 1] * (angular - parents), axis=1)
        turning[[l for l in range(n) if self.held and l == self.topology.driven]] = 0.0
        return turning

    def _constraints(self, placed: Placed):
        """Sparse matrix G of all joints, rows in m/s over the longest link and rad/s."""
        topology, n = self.topology, self.topology.n_links
        rows, columns, blocks = [], [], []
        count = 0
        for joint, ends in enumerate(zip(topology.parents, topology.children, strict=True)):
            turn = placed.joint_rotation[joint]
            fixed = [0, 1, 2] if self.held and joint == topology.driven else [0, 2]
            for node, sign in zip(ends, (-1.0, 1.0), strict=True):
                if node == BASE:
                    continue
                link = topology.link_of(node)
                along = self.geometry.rest[node - n] if node >= n else 0.0
                rotation = placed.rotation[link]
                arm = rotation.T @ (placed.centre[joint] - placed.origin[link]) - [along, 0.0, 0.0]
                block = np.zeros((3 + len(fixed), 6))
                block[:3, :3] = -rotation @ cross_matrix(arm) / self.geometry.scale
                block[:3, 3:] = rotation / self.geometry.scale
                block[3:, :3] = turn[:, fixed].T @ rotation
                i, j = np.indices(block.shape)
                rows.append(count + i.reshape(-1))
                columns.append(6 * node + j.reshape(-1))
                blocks.append(sign * block.reshape(-1))
            count += 3 + len(fixed)
        entries = np.concatenate(blocks), (np.concatenate(rows), np.concatenate(columns))
        return sparse.csr_matrix(entries, shape=(count, self.mass.shape[0]))


@Program
def _realise_nominal(model: Model):
    return realise(model, assembly_errors(model))


class _Constants(NamedTuple):
    """Of `Realisation`, without errors: mass (n,), centre (n, 3), inertia (n, 3, 3) of all nodes; rest, damping,
    lever (N,) to the sde on the left, and stiffness (6, N)."""

    mass: np.ndarray
    centre: np.ndarray
    inertia: np.ndarray
    rest: np.ndarray
    stiffness: np.ndarray
    damping: np.ndarray
    lever: np.ndarray


def _nominal_constants(model: Model) -> _Constants:
    made = _realise_nominal(model)
    return _Constants(
        mass=np.asarray(made.mass),
        centre=np.asarray(made.centre).T,
        inertia=np.moveaxis(np.asarray(made.inertia), 2, 0),
        rest=np.asarray(made.rest),
        stiffness=np.asarray(made.stiffness),
        damping=np.asarray(made.damping),
        lever=np.asarray(made.lever_right),
    )


def _masses(constants: _Constants, scale: float):
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


def _block_diagonal(blocks: np.ndarray):
    n = len(blocks)
    return sparse.bsr_matrix((blocks, np.arange(n), np.arange(n + 1)), shape=(6 * n, 6 * n)).tocsr()


def _stretch(constants: _Constants, topology):
    """Matrix (6 N, 6 n) of the rates of all sdes' (du, dphi) by the nodes' velocities in link axes."""
    n, count = topology.n_links, topology.n_rfes
    left = np.arange(n - 1, n + count - 1)
    first = [a for a, b in topology.ranges if b > a]
    left[first] = topology.link_of_rfe[first]
    place_of = np.concatenate([np.zeros(n), constants.rest])
    sde = constants.rest + constants.lever

    def faces(node):
        blocks = np.zeros((count, 6, 6))
        arm = np.zeros((count, 3))
        arm[:, 0] = sde - place_of[node]
        blocks[:, :3, :3] = -cross_matrix(arm)
        blocks[:, :3, 3:] = blocks[:, 3:, :3] = np.eye(3)
        shape = (6 * count, 6 * (n + count))
        return sparse.bsr_matrix((blocks, node, np.arange(count + 1)), shape=shape)

    return (faces(n + np.arange(count)) - faces(left)).tocsr()


def _unit_rows(matrix: np.ndarray) -> np.ndarray:
    return matrix / np.linalg.norm(matrix, axis=1, keepdims=True)


def _projection(constraints):
    """Orthogonal projection onto the null space of a sparse matrix, whose rows may depend on each other."""
    size = np.sqrt(np.asarray(constraints.multiply(constraints).sum(axis=1)).reshape(-1))
    unit = (sparse.diags(1.0 / size) @ constraints).tocsc()
    factored = splu((unit @ unit.T + RIDGE * sparse.eye(unit.shape[0])).tocsc())

    def once(vector):
        return vector - unit.T @ factored.solve(unit @ vector)

    return lambda vector: once(once(vector))
