"""Reactions that the equations of motion leave open, and the least of them.

Place in the pipeline: kinematics, cut_joints -> **self_stress** -> dynamics, newton, statics, loads.

In rigid loops some multipliers do no work on any motion of the tree: they load joints against each other, and whatever
of them is added, the mechanism moves alike (states of self-stress).  Which these are is a question of geometry: they
are the null space of the work that unit multipliers do along every coordinate (theory (5.9)), lengths over the longest
link, so that neither masses nor loads decide it.  Of all reactions that the motion admits those are taken whose sum of
squares over all joints, tree joints and cut ones alike, is least (theory (5.18), (5.19)).

Only models that ask for it (`Topology.minimum_norm`) compute any of this.

Symbols: c multipliers, J joints; wrenches at the global origin.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from rfem_jax.mechanics.algebra.vectors import cross, invert_positive, pseudo_inverse
from rfem_jax.mechanics.kinematics.cut_joints import Closure
from rfem_jax.mechanics.kinematics.motion import Motion
from rfem_jax.mechanics.model.nominal_geometry import SMALLEST_SINGULAR_VALUE
from rfem_jax.mechanics.model.topology import Topology


class Redundancy(NamedTuple):
    """wrenches: in all joints, of unit multipliers that nothing else loads; open (c, c): projector onto the multipliers
    that do no work."""

    wrenches: list[Float[Array, "6 multipliers"]]
    open: Float[Array, "multipliers multipliers"]

    def closed(self) -> Float[Array, "multipliers multipliers"]:
        """Projector onto the multipliers that the motion determines."""
        return jnp.eye(self.open.shape[0]) - self.open

    def inverse(self, matrix: Float[Array, "multipliers multipliers"]) -> Float[Array, "multipliers multipliers"]:
        """Inverse of a positive semidefinite matrix, as Phi_q M^-1 Phi_q^T, on the multipliers that the motion
        determines, zero on the others."""
        onto, size = self.closed(), jnp.trace(matrix) / matrix.shape[0]
        size = jnp.where(size > 0.0, size, 1.0)
        return invert_positive(onto @ matrix @ onto + size * self.open) - self.open / size

    def among(self, rows: np.ndarray) -> "Redundancy":
        """The redundancy of some of the multipliers; the others are those of springs."""
        return self._replace(open=self.open[np.ix_(rows, rows)])

    def beside(self, more: int) -> "Redundancy":
        """The redundancy with further multipliers, which the motion determines."""
        return self._replace(open=jnp.pad(self.open, ((0, more), (0, more)))) if more else self


def inverse_closure(
    matrix: Float[Array, "multipliers multipliers"], left_open: Redundancy | None
) -> Float[Array, "multipliers multipliers"]:
    """Inverse of the multipliers' matrix Phi_q M^-1 Phi_q^T, on those alone that the motion determines."""
    return invert_positive(matrix) if left_open is None else left_open.inverse(matrix)


def redundancy(topology: Topology, motion: Motion, cuts: Closure | None) -> Redundancy | None:
    """Redundant reactions at one position of a model that asks for the least ones; None for other models."""
    if cuts is None or cuts.scale is None:
        return None
    with jax.named_scope("redundancy"):
        wrenches = _unit_wrenches(topology, cuts)
        work = _work(topology, motion, wrenches, cuts, cuts.scale)
        unit = jnp.eye(work.shape[1])
        onto = pseudo_inverse(work, SMALLEST_SINGULAR_VALUE) @ work
        found = unit - 0.5 * (onto + onto.T)
        # Near a dead centre rounding of it would count, beside large multipliers: a projector is its own square.
        return Redundancy(wrenches, found @ found @ (3.0 * unit - 2.0 * found))


def least_reactions(
    found: Redundancy,
    points: Float[Array, "3 joints"],
    wrenches: Sequence[Float[Array, "6"]],
    length: Float[Array, ""],
) -> tuple[Float[Array, " multipliers"], list[Float[Array, "6"]]]:
    """Change of the multipliers [N], and the wrenches of all joints after it, for which the sum over all joints of the
    squares of force and of moment over `length` [m] is least (theory (5.19)).

    **Arguments:** `points`: about which the moments of the joints are; `wrenches`: of all joints, of the multipliers.
    """
    with jax.named_scope("least_reactions"):
        unit = _weighed(jnp.stack(found.wrenches, axis=1), points, length)  # (6 J, c)
        now = _weighed(jnp.stack(wrenches, axis=1)[..., None], points, length)[:, 0]
        among = unit @ found.open
        # The open multipliers alone are loads of the cut joints, so that this matrix is positive definite.
        square, size = among.T @ among, jnp.sum(unit**2) / unit.shape[1]
        change = -found.open @ invert_positive(square + size * found.closed()) @ (among.T @ now)
        return change, [one + by_unit @ change for one, by_unit in zip(wrenches, found.wrenches, strict=True)]


def _weighed(wrenches: Float[Array, "6 joints k"], points: Array, length: Array) -> Float[Array, "n k"]:
    """Forces, and moments about the joints' points over a length, of all joints."""
    force = wrenches[3:]
    moment = wrenches[:3] - cross(points[..., None], force)
    return jnp.concatenate([force, moment / length]).reshape(-1, wrenches.shape[2])


def _unit_wrenches(topology: Topology, cuts: Closure) -> list[Array]:
    """Wrenches (6, c) at the global origin that the parent sides of all joints exert on the children, by unit
    multipliers alone."""
    n, wrenches = topology.n_links, {}
    for i, j in enumerate(topology.cuts):
        rows = topology.constraints[i]
        onto = np.eye(topology.n_constraints)[rows.start : rows.stop]
        wrenches[j] = cuts.wrenches(i, "child", jnp.zeros(3)) @ onto
    for l in reversed(range(n)):
        nodes = [node for node in range(n + topology.n_rfes) if topology.link_of(node) == l]
        wrenches[l] = _passed_on(topology, wrenches, nodes)
    return [wrenches[j] for j in range(len(topology.joints))]


def _passed_on(topology: Topology, wrenches: Mapping[int, Array], nodes: Sequence[int]) -> Array:
    """Wrenches (6, constraints) of unit multipliers that bodies pass on to their inboard joint, from their other
    joints, cut ones included."""
    total = jnp.zeros((6, topology.n_constraints))
    for j, wrench in wrenches.items():
        if topology.parents[j] in nodes:
            total = total + wrench
        if j >= topology.n_links and topology.children[j] in nodes:
            total = total - wrench
    return total


def _work(
    topology: Topology, motion: Motion, wrenches: Sequence[Array], cuts: Closure, scale: Array
) -> Float[Array, "rows c"]:
    """Work of unit multipliers along every coordinate of the tree joints and of the free rfes that carry joints, angles
    over the longest link; the laws of springs are no constraints and have rows of their own."""
    units = jnp.where(np.array(topology.slides, dtype=bool), 1.0, 1.0 / scale)
    along = [motion.axis[:, k] @ wrenches[l] for k, l in enumerate(topology.link_of_freedom)]
    if (couplings := cuts.couplings) is not None:
        before = jnp.zeros(topology.n_constraints - len(topology.ideal))
        along = [work - jnp.concatenate([before, load]) for work, load in zip(along, couplings.along, strict=True)]
    rows = [units[k] * work[None] for k, work in enumerate(along)]
    for i, rfe in enumerate(topology.interfaces):
        there = _passed_on(topology, dict(enumerate(wrenches)), [topology.n_links + rfe])
        about = there[:3] - cross(motion.interfaces.point[:, i, None], there[3:])
        rows += [about / scale, there[3:]]
    sprung = np.flatnonzero(np.array(topology.sprung_rows, dtype=bool))
    return jnp.concatenate([*rows, jnp.asarray(np.eye(topology.n_constraints)[sprung])])
