"""Vibration of the perfect mechanism about a position of rest: squared frequencies and damping.

Place in the pipeline: vibration_matrices -> **vibration** -> stability.

All bodies (rfes) have six velocities each, in the axes of their link; joints are constraints on these
(theory (11.5)):

    M w'' + C w' + K w + G^T lambda = 0,     G w = 0.

M is block diagonal, K and C are those of the springs between neighbouring rfes, the same in every position; only G
depends on the joint coordinates.  With M = L L^T and the orthogonal projection P onto the null space of G L^-T the
modes are those of P L^-1 K L^-T P.  All of them are found for small mechanisms; for large ones the stiffest, by
Lanczos' method with sparse matrices (ARPACK), in memory proportional to the number of rfes.

The stiffness due to gravity and to the forces at rest is neglected beside that of the springs.  For a mechanism of
rigid links, which has no other, the accelerations are differentiated by central differences.  Springs, dampers and laws
of joints, their friction, and springs between points enter with their derivatives at the position, as far as these do
not drive the motion.
"""

from collections.abc import Sequence
from functools import cached_property, partial
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Complex, Float, Inexact
from scipy import sparse
from scipy.sparse.linalg import LinearOperator, eigsh

from rfem_jax.description.basics.joint_kinds import JointKind
from rfem_jax.mechanics.laws.couplings import CouplingLaw
from rfem_jax.mechanics.laws.frame_forces import START, FrameForce, Pose
from rfem_jax.mechanics.laws.friction_laws import Friction
from rfem_jax.mechanics.laws.joint_laws import JointLaw, law_derivatives
from rfem_jax.mechanics.laws.joint_springs import CompliantSpring, diagonal_tangent
from rfem_jax.mechanics.model.model import Model
from rfem_jax.mechanics.model.nominal_geometry import (
    NominalGeometry,
    Placed,
    cross_matrix,
    geometry_of,
    moved,
    node_place,
    offset,
    place,
)
from rfem_jax.mechanics.model.topology import BASE
from rfem_jax.simulation.vibrations.vibration_matrices import (
    deformation_rates,
    mass_matrices,
    nominal_constants,
    null_space_projection,
    spring_matrices,
    unit_rows,
)

MOST_BODIES = 40  # of a mechanism all of whose modes are found
RANK_TOLERANCE = 1e-9  # of singular values of rows of length one, relative to the largest
STIFFEST_TOLERANCE = 1e-6  # of the largest squared frequency, relative
SAMPLES = 400  # frequencies that stand for the modes below the stiffest one
DIFFERENCE = 1e-5  # rad


# The nodes on both sides of a joint with their signs, and the row (6,) that gives a rate from the twist over the joint.
Reader = tuple[tuple[tuple[int, float], ...], np.ndarray]


class Modes(NamedTuple):
    """Equations y'' + damping y' + squares y = 0 of modal coordinates: squares [rad^2/s^2], complex if forces at rest
    are not conservative; damping [1/s], a matrix where it couples the modes."""

    squares: Inexact[np.ndarray, " modes"]
    damping: Float[np.ndarray, " modes"] | Float[np.ndarray, "modes modes"]

    def eigenvalues(self) -> Complex[np.ndarray, " eigenvalues"]:
        """All eigenvalues [rad/s], two a mode."""
        if self.damping.ndim == 2:
            n = len(self.squares)
            lower = np.hstack([-np.diag(self.squares), -self.damping])
            return np.linalg.eigvals(np.vstack([np.eye(n, 2 * n, n), lower]))
        half = 0.5 * self.damping
        first = -half - np.sqrt(half**2 - self.squares + 0j)
        # The small root of an overdamped mode from the product of both roots: a difference would lose digits.
        second = np.where(first == 0.0, 0.0, self.squares / np.where(first == 0.0, 1.0, first))
        return np.concatenate([first, second])


class Vibration:
    """The vibration of a model about positions given by joint coordinates.

    **Arguments:** `held`: joint coordinates whose motion is prescribed.
    """

    def __init__(self, model: Model, held: tuple[int, ...] = ()):
        constants = nominal_constants(model)
        self.geometry: NominalGeometry = geometry_of(model)
        self.topology = model.topology
        self.held = held
        self.gravity = np.asarray(model.gravity)
        self.mass, self.inverse_root = mass_matrices(constants, self.topology, self.geometry.scale)
        self.size = 6 * len(constants.mass)
        deformed = deformation_rates(constants, self.topology)
        stretch = deformed @ self.inverse_root
        # Rates of stretching and shearing of slender links, over the longest link, which are none.
        kept = np.repeat(self.topology.slender_rfes, 6) & (np.arange(6 * self.topology.n_rfes) % 6 < 3)
        self.undeformed = deformed[np.flatnonzero(kept)] / self.geometry.scale
        springs, roots = spring_matrices(constants, self.topology)
        damping = np.repeat(constants.damping, 6)
        self.rates = np.unique(constants.damping)
        self.root, self.damping = roots @ stretch, damping
        # Stiffness matrices of the springs of each damping; most mechanisms have one.
        self.springs = [
            (stretch.T @ (sparse.diags(np.where(damping == rate, 1.0, 0.0)) @ springs) @ stretch).tocsr()
            for rate in self.rates
        ]
        self.before: list[np.ndarray | None] = [None] * len(self.rates)
        self.forces: dict[str, JointLaw | Friction] = {**(model.forces or {}), **(model.friction or {})}
        self.elements = [] if model.frame_forces is None else list(model.frame_forces.values())
        self.bearings = [] if model.springs is None else list(model.springs.values())
        elements = any(element.components for element in self.elements)
        start = jnp.asarray(model.start_joints)
        couplings = [one.starting_at(start) for one in (model.couplings or {}).values()]
        self.couplings = [one for one in couplings if one.stiffness is not None]
        self.ideal = [one for one in couplings if one.stiffness is None]
        self.sprung = bool(self.forces) or bool(self.bearings) or bool(self.couplings) or elements

    def modes(self, joints: Float[np.ndarray, " numbers"]) -> Modes:
        """The modes at a position of the joints, links undeformed."""
        placed = place(self.geometry, joints)
        if self.topology.n_rfes == 0 and not self.bearings:
            return self._rigid(np.asarray(joints))
        constraints = sparse.csr_matrix(self._constraints(placed) @ self.inverse_root)
        joint_rows, stiffness, damping = self._joint_law_rows(np.asarray(joints), placed)
        by_springs, by_dampers = (np.sqrt(x)[:, None] * joint_rows for x in (stiffness, damping))
        springs, dampers = [by_springs], [by_dampers]
        for element in self.elements:
            if element.components:
                for rows, (more, size) in zip((springs, dampers), self._principal(placed, element), strict=True):
                    rows.append(np.sqrt(size)[:, None] * more @ self.inverse_root)
        by_springs, by_dampers = np.vstack(springs), np.vstack(dampers)
        if self.size <= 6 * MOST_BODIES:
            return self._all(constraints.toarray(), by_springs, by_dampers)
        modes = self._stiffest(sparse.csc_matrix(constraints))
        if not self.sprung:
            return modes
        # Springs and dampers of joints and points as a mode of their own, as those of the links of each damping.
        project = null_space_projection(sparse.csc_matrix(constraints))
        largest = [np.linalg.norm([project(row) for row in rows], 2) ** 2 for rows in (by_springs, by_dampers)]
        return Modes(np.append(modes.squares, largest[0]), np.append(modes.damping, largest[1]))

    def _joint_law_rows(self, joints: np.ndarray, placed: Placed) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Rows (laws, 6 n) that give the rates of joint coordinates with springs, dampers or laws, and last of the
        deflections of couplings, from the velocities L^T w of all nodes, with stiffness and damping at a position, zero
        where they are negative."""
        laws = list(self.forces.values())
        readers = [self._reader(law, placed) for law in laws]
        tangents = [-np.array(law_derivatives(law, _position(law, joints), 0.0), float) for law in laws]
        for spring in self.bearings:
            readers += [self._coordinate_reader(k, placed) for k in spring.coordinates]
            readers += [self._closure_reader(k, placed) for k in spring.rows]
        tangents += self._bearing_tangents
        rows = [self._relative_rates(placed, readers)]
        for coupling in self.couplings:
            of_both = self._coordinate_rates(placed, coupling.coordinates)
            direction, tangent = self._meshing_tangents(coupling, joints)
            rows.append((direction @ of_both)[None])
            tangents.append(tangent)
        stiffness, damping = np.maximum(np.array(tangents, float).reshape(-1, 2).T, 0.0)
        return np.concatenate(rows) @ self.inverse_root, stiffness, damping

    def _meshing_tangents(self, coupling: CouplingLaw, joints: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Rates of the two coordinates in that of a coupling's deflection, and its stiffness and damping."""
        at = jnp.asarray(joints[np.array(coupling.places)]), jnp.zeros(2)
        found = [coupling.tangent(*at, *factors) for factors in ((1.0, 0.0), (0.0, 1.0))]
        return np.asarray(found[0][0]), np.array([tangent for _, tangent in found])

    @cached_property
    def _bearing_tangents(self) -> list[np.ndarray]:
        """Stiffness and damping of the coordinates, or rows [m], of the springs of compliant joints without load; the
        same at all positions."""
        return [one for spring in self.bearings for one in self._tangents(spring)]

    def _tangents(self, spring: CompliantSpring) -> list[np.ndarray]:
        zeros = jnp.zeros(len(spring.coordinates) or len(spring.rows))
        exerted = spring.along
        if spring.rows:
            exerted = partial(spring.in_rows, scale=jnp.asarray(self.geometry.scale))
        factors = ((1.0, 0.0), (0.0, 1.0))
        return list(np.array([diagonal_tangent(exerted, zeros, zeros, *pair) for pair in factors]).T)

    def _coordinate_rates(self, placed: Placed, coordinates: Sequence[int]) -> np.ndarray:
        """Rows (k, 6 n) that give the rates of joint coordinates from the velocities of all nodes."""
        return self._relative_rates(placed, [self._coordinate_reader(k, placed) for k in coordinates])

    def _relative_rates(self, placed: Placed, readers: Sequence[Reader]) -> np.ndarray:
        """Rows (k, 6 n) that give the rates of motions over joints from the velocities of all nodes."""
        rows = np.zeros((len(readers), self.size))
        for row, (sides, reader) in zip(rows, readers, strict=True):
            for node, sign in sides:
                if node == BASE:
                    continue
                rotation, point = node_place(self.geometry, placed, node)
                # Twist at the global origin of velocities in link axes at the node's point.
                row[6 * node : 6 * node + 3] += sign * (reader[:3] + np.cross(reader[3:], point)) @ rotation
                row[6 * node + 3 : 6 * node + 6] += sign * reader[3:] @ rotation
        return rows

    def _pose(self, placed: Placed, element: FrameForce) -> tuple[Pose, np.ndarray]:
        """Pose of an element's frames at rest, and rows (6, 6 n) that give the rates of its position and rotation, in
        the axes of the parent, from the velocities w of all nodes."""
        frames = []
        for end in (element.parent, element.child):
            rotation, point = node_place(self.geometry, placed, end.node)
            frames.append((rotation, point, point + rotation @ np.asarray(end.position)))
        (left, _, origin), (right, _, place) = frames
        axes = left @ np.asarray(element.parent.rotation)
        rows = np.zeros((6, self.size))
        for end, (rotation, point, _), sign in zip((element.parent, element.child), frames, (-1.0, 1.0), strict=True):
            if end.node == BASE:
                continue
            of_node, arm = rows[:, 6 * end.node : 6 * end.node + 6], rotation.T @ (place - point)
            of_node[:3, :3] -= sign * axes.T @ rotation @ cross_matrix(arm)
            of_node[:3, 3:] += sign * axes.T @ rotation
            of_node[3:, :3] += sign * axes.T @ rotation
        turned = axes.T @ right @ np.asarray(element.child.rotation)
        still = jnp.zeros(3)
        return Pose(jnp.asarray(axes.T @ (place - origin)), jnp.asarray(turned), still, still), rows

    def _principal(
        self, placed: Placed, element: FrameForce
    ) -> tuple[tuple[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]:
        """Rows (k, 6 n) that give the rates along the principal directions of an element's stiffness and of its damping
        from the velocities w, with the principal values, zero where they are negative."""
        if element.components == 0:
            nothing = np.zeros((0, self.size)), np.zeros(0)
            return nothing, nothing
        pose, rows = self._pose(placed, element)

        def principal(q_factor, v_factor):
            tangent = np.asarray(element.tangent(pose, START, q_factor, v_factor))
            values, directions = np.linalg.eigh(0.5 * (tangent + tangent.T))
            return directions.T @ rows[: len(values)], np.maximum(values, 0.0)

        return principal(1.0, 0.0), principal(0.0, 1.0)

    def _reader(self, law: JointLaw | Friction, placed: Placed) -> Reader:
        """Function that reads the rate of a law's motion."""
        if law.coordinate is not None:
            return self._coordinate_reader(law.coordinate, placed)
        assert isinstance(law, Friction), "only friction is in cut joints"
        topology = self.topology
        axis = placed.joint_rotation[law.joint][:, law.component % 3]
        reader = np.concatenate([axis, np.zeros(3)])
        if law.component < 3:
            reader = np.concatenate([np.cross(placed.child_centre[law.joint], axis), axis])
        return ((topology.parents[law.joint], -1.0), (topology.children[law.joint], 1.0)), reader

    def _coordinate_reader(self, k: int, placed: Placed) -> Reader:
        """Function that reads the rate of a joint coordinate."""
        link = self.topology.link_of_freedom[k]
        own = list(self.topology.coordinates[link])
        # The coordinate's rate of a twist over the joint that keeps its constraints.
        reader = np.linalg.pinv(placed.twists[own].T)[own.index(k)]
        return ((self.topology.parents[link], -1.0), (link, 1.0)), reader

    def _closure_reader(self, equation: int, placed: Placed) -> Reader:
        """Function that reads the rate of a closure equation [m] of a compliant cut joint."""
        topology = self.topology
        joint = next(j for j, rows in zip(topology.cuts, topology.constraints, strict=True) if equation in rows)
        kind, left = topology.kind(joint).nominal, placed.joint_rotation[joint]
        at = equation - topology.constraints[joint - topology.n_links].start
        if at < len(kind.across):
            force = left[:, kind.across[at]]
            reader = np.concatenate([np.cross(placed.child_centre[joint], force), force])
        else:
            a, b = kind.perpendicular[at - len(kind.across)]
            couple = self.geometry.scale * np.cross(placed.child_rotation[joint][:, b], left[:, a])
            reader = np.concatenate([couple, np.zeros(3)])
        return ((topology.parents[joint], -1.0), (topology.children[joint], 1.0)), reader

    def _motion_rate_row(self, law: JointLaw | Friction, placed: Placed) -> np.ndarray:
        """Row (F,) that gives the rate of a law's motion from those of the joint coordinates."""
        row = np.zeros(self.topology.n_freedoms)
        if law.coordinate is not None:
            row[law.coordinate] = 1.0
            return row
        sides, reader = self._reader(law, placed)
        for node, sign in sides:
            for _, link in self.topology.to_base(node):
                for k in self.topology.coordinates[link]:
                    row[k] += sign * reader @ placed.twists[k]
        return row

    def _all(self, constraints: np.ndarray, by_springs: np.ndarray, by_dampers: np.ndarray) -> Modes:
        _, singular, rows = np.linalg.svd(unit_rows(constraints))
        free = rows[np.sum(singular > RANK_TOLERANCE * singular.max(initial=0.0)) :]
        # Singular values of the root of the stiffness matrix: the low frequencies of stiff links keep their digits.
        stretch = self.root @ free.T
        if self.sprung:
            stretch = np.concatenate([stretch, by_springs @ free.T])
        missing = np.zeros((max(0, free.shape[0] - stretch.shape[0]), free.shape[0]))
        _, frequencies, vectors = np.linalg.svd(np.concatenate([stretch, missing]), full_matrices=False)
        squares = frequencies**2
        if len(self.rates) == 1 and not self.sprung:
            return Modes(squares, self.rates[0] * squares)
        stretch = stretch[: len(self.damping)] @ vectors.T
        damping = stretch.T @ (self.damping[:, None] * stretch)
        if self.sprung:
            across = by_dampers @ free.T @ vectors.T
            damping = damping + across.T @ across
        return Modes(squares, damping)

    def _stiffest(self, constraints: sparse.csc_matrix) -> Modes:
        """For the links of each damping, which are nearly decoupled from the others at high frequencies: the stiffest
        mode, and frequencies evenly spaced below it in place of the other modes of the mechanism."""
        project = null_space_projection(constraints)
        squares, damping = [], []
        for i, (rate, springs) in enumerate(zip(self.rates, self.springs, strict=True)):

            def projected_springs(w, springs=springs):
                return project(springs @ project(w.reshape(-1)))

            # The stiffest mode of the position before is a good start.
            start = np.random.default_rng(0).normal(size=self.size) if self.before[i] is None else self.before[i]
            # SciPy has no type stubs: types are inferred from default values.
            operator = LinearOperator((self.size, self.size), projected_springs, dtype=float)  # pyright: ignore[reportCallIssue]
            (largest,), vector = eigsh(operator, 1, v0=start, which="LA", tol=STIFFEST_TOLERANCE)  # pyright: ignore[reportArgumentType]
            self.before[i] = vector[:, 0]
            squares.append(largest * np.linspace(0.0, 1.0, SAMPLES) ** 2)
            damping.append(rate * squares[-1])
        return Modes(np.concatenate(squares), np.concatenate(damping))

    def _rigid(self, joints: np.ndarray) -> Modes:
        columns = []
        for shift in DIFFERENCE * np.eye(self.topology.n_freedoms):
            ahead, behind = (self._joint_accelerations(moved(self.topology, joints, s)) for s in (shift, -shift))
            columns.append((ahead - behind) / (2.0 * DIFFERENCE))
        if not self.sprung:
            squares = -np.linalg.eigvals(np.array(columns).T)
            return Modes(squares, np.zeros(len(squares)))
        squares, vectors = np.linalg.eig(-np.array(columns).T)
        by_rate = np.zeros((self.topology.n_freedoms, self.topology.n_freedoms))
        placed = place(self.geometry, joints)
        unloaded = self._joint_accelerations(joints, np.zeros(self.size))
        rows, _, dampings = self._joint_law_rows(joints, placed)
        by_joints = [self._motion_rate_row(law, placed) for law in self.forces.values()]
        for coupling in self.couplings:
            of_both = np.eye(self.topology.n_freedoms)[list(coupling.coordinates)]
            by_joints.append(self._meshing_tangents(coupling, joints)[0] @ of_both)
        for of_joints, row, damping in zip(by_joints, rows, dampings, strict=True):
            response = self._joint_accelerations(joints, row) - unloaded
            by_rate += np.outer(damping * response, of_joints)
        velocities = self._unit_velocities(placed)
        for element in self.elements:
            for row, damping in zip(*self._principal(placed, element)[1], strict=True):
                loaded = self._joint_accelerations(joints, row @ self.inverse_root)
                by_rate += damping * np.outer(loaded - unloaded, row @ velocities)
        return Modes(squares, np.linalg.solve(vectors, by_rate @ vectors))

    def _unit_velocities(self, placed: Placed) -> np.ndarray:
        """Velocities w (6 n, F) of rigid links at unit rates of the joint coordinates."""
        velocities = np.zeros((self.topology.n_links, 6, self.topology.n_freedoms))
        twists = np.zeros_like(velocities)
        for l, coordinates in enumerate(self.topology.coordinates):
            if self.topology.parents[l] != BASE:
                twists[l] = twists[self.topology.parents[l]]
            twists[l][:, list(coordinates)] += placed.twists[list(coordinates)].T
            rotation, origin = placed.rotation[l], placed.origin[l]
            velocities[l, :3] = rotation.T @ twists[l, :3]
            velocities[l, 3:] = rotation.T @ (twists[l, 3:] - cross_matrix(origin) @ twists[l, :3])
        return velocities.reshape(self.size, -1)

    def _spring_load(self, joints: np.ndarray, placed: Placed) -> np.ndarray:
        """Load (6 n,) of springs and laws at a position of rest, as `inverse_root` transforms it."""
        zero = jnp.zeros(())
        forces = [float(law.force(jnp.asarray(_position(law, joints)), zero)) for law in self.forces.values()]
        for coupling in self.couplings:
            mesh = coupling.meshing(jnp.asarray(joints[np.array(coupling.places)]), jnp.zeros(2))
            forces.append(float(mesh.loads[1]))
        load = np.array(forces) @ self._joint_law_rows(joints, placed)[0] if forces else np.zeros(self.size)
        for element in self.elements:
            pose, rows = self._pose(placed, element)
            load = load + np.concatenate(element.wrench(pose, START)) @ rows @ self.inverse_root
        return load

    def _joint_accelerations(self, joints: np.ndarray, springs: np.ndarray | None = None) -> np.ndarray:
        """Second derivatives of the joint coordinates of rigid links under gravity, at rest; `springs`: load of springs
        and laws, None for theirs at the position."""
        placed, topology = place(self.geometry, joints), self.topology
        n = topology.n_links
        falling = np.concatenate([np.zeros((n, 3)), placed.rotation.transpose(0, 2, 1) @ self.gravity], axis=1)
        load = self.inverse_root.T @ (self.mass @ falling.reshape(-1))
        if self.forces or self.elements or self.couplings:
            load = load + (self._spring_load(joints, placed) if springs is None else springs)
        free = null_space_projection(sparse.csc_matrix(self._constraints(placed) @ self.inverse_root))(load)
        in_link = (self.inverse_root @ free).reshape(n, 2, 3)
        angular, linear = np.moveaxis(np.einsum("lij,lkj->lki", placed.rotation, in_link), 1, 0)
        twists = np.concatenate([angular, linear + np.cross(placed.origin, angular)], axis=1)
        accelerations = np.zeros(topology.n_freedoms)
        for l, coordinates in enumerate(topology.coordinates):
            over_joint = twists[l] - (0.0 if topology.parents[l] == BASE else twists[topology.parents[l]])
            axes = placed.twists[list(coordinates)]
            accelerations[list(coordinates)] = np.linalg.lstsq(axes.T, over_joint, rcond=None)[0]
        accelerations[list(self.held)] = 0.0
        return accelerations

    def _constraints(self, placed: Placed) -> sparse.csr_matrix:
        """Sparse matrix G of all joints; rows: velocities over the longest link, and angular velocities."""
        topology = self.topology
        hinges = [topology.link_of_freedom[k] for k in self.held if topology.about_hinge(k)]
        rows, columns, blocks = [], [], []
        count = 0
        for joint, ends in enumerate(zip(topology.parents, topology.children, strict=True)):
            kind, joint_axes = topology.kind(joint), placed.joint_rotation[joint]
            fixed = _fixed_directions(kind, joint_axes, placed.child_rotation[joint])
            if joint in hinges:
                fixed = joint_axes.T
            centre = placed.centre[joint] if kind.coincident else placed.child_centre[joint]
            across = np.eye(3) if kind.coincident else joint_axes[:, kind.across].T
            for node, sign in zip(ends, (-1.0, 1.0), strict=True):
                if node == BASE:
                    continue
                link = topology.link_of(node)
                rotation = placed.rotation[link]
                arm = rotation.T @ (centre - placed.origin[link]) - offset(self.geometry, np.eye(3), node)
                block = np.zeros((len(across) + len(fixed), 6))
                block[: len(across), :3] = -across @ rotation @ cross_matrix(arm) / self.geometry.scale
                block[: len(across), 3:] = across @ rotation / self.geometry.scale
                block[len(across) :, :3] = fixed @ rotation
                i, j = np.indices(block.shape)
                rows.append(count + i.reshape(-1))
                columns.append(6 * node + j.reshape(-1))
                blocks.append(sign * block.reshape(-1))
            count += len(across) + len(fixed)
        entries = np.concatenate(blocks), (np.concatenate(rows), np.concatenate(columns))
        matrix = sparse.csr_matrix(entries, shape=(count, self.size))
        others = [k for k in self.held if not topology.about_hinge(k)]
        more = [self._coordinate_rates(placed, others)] if others else []
        if self.topology.slender:
            more.append(self.undeformed)
        for law in self.ideal:
            slope = float(law.transmitted(jnp.asarray(placed.joints[law.places[0]]))[1])
            more.append(np.array([[-slope, 1.0]]) @ self._coordinate_rates(placed, law.coordinates))
        if not more:
            return matrix
        return sparse.csr_matrix(sparse.vstack([matrix, *(sparse.csr_matrix(rows) for rows in more)]))


def _position(law: JointLaw | Friction, joints: np.ndarray) -> float:
    """Position of a law's joint; friction in a cut joint depends on none."""
    return 0.0 if law.place is None else joints[law.place]


def _fixed_directions(kind: JointKind, left: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Directions (k, 3) about which a joint lets nothing turn, from its axes on the parent and on the child."""
    turns = [freedom.axis for freedom in kind.freedoms if freedom.rotation]
    if len(turns) == 2:
        return np.cross(left[:, turns[0]], right[:, turns[1]])[None]
    return left[:, [axis for axis in range(3) if axis not in turns]].T
