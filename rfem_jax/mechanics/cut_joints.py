"""Cut joints: the five constraint equations of each, complete to the acceleration.

Place in the pipeline: kinematics -> **cut_joints** -> dynamics, newton, statics.

Theory (5.1): the joint centres of the left side L and the right side P coincide (three equations,
global axes), and the hinge axis y_L is perpendicular to x_P and z_P (two equations, times a length
so that all five are in metres and the multipliers in newtons).  Theory (5.3) is complete:
gamma = -(Phi_q)_dot q_dot.  All C cut joints are one array axis.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from rfem_jax.mechanics import algebra
from rfem_jax.mechanics.algebra import apply, apply_transposed, cross, dot, product
from rfem_jax.mechanics.kinematics import Motion, node_frames
from rfem_jax.mechanics.model import BASE, Topology
from rfem_jax.mechanics.realisation import Realisation

RANK_TOLERANCE = 1e-9  # of singular values, relative to the largest


class Closure(NamedTuple):
    """The constraints of all cut joints at one instant.

    residual, rate, bias (5, C): Phi, its rate and (Phi_q)_dot q_dot; couples (3, 2, C): moments on P
    of the last two unit multipliers (the first three are forces at the centre of P; on L all act
    in the opposite sense, at the centre of L); rotation, centre: the hinge frames L; right_centre:
    the joint's centre on P; alignment (C,): y_L . y_P (must be near +1, not -1); angle (C,): from L
    to P about the hinge.
    """

    residual: Array
    rate: Array
    bias: Array
    couples: Array
    rotation: Array
    centre: Array
    right_centre: Array
    alignment: Array
    angle: Array

    def wrenches(self, cut: int, side: str, point: Array) -> Array:
        """Wrenches (6, 5) at `point` of unit multipliers on P ("child"; on L their negative)."""
        centre = self.right_centre if side == "child" else self.centre
        arm = centre[:, cut] - point
        forces = jnp.asarray(np.hstack([algebra.IDENTITY, np.zeros((3, 2))]))
        moments = jnp.concatenate([algebra.cross_matrix(arm), self.couples[:, :, cut]], axis=1)
        return jnp.concatenate([moments, forces])


def closure(realised: Realisation, now: Motion, scale: Array) -> Closure | None:
    """Constraints of all cut joints (None without any); `scale` [m] multiplies the two axis
    equations."""
    topology = realised.topology
    if topology.n_cuts == 0:
        return None
    with jax.named_scope("closure"):
        n = topology.n_links
        nodes = topology.parents[n:] + topology.children[n:]
        frames = node_frames(topology, now, nodes)
        turn = jnp.concatenate(
            [realised.seat_rotation[:, :, n:], realised.bore_rotation[:, :, n:]], axis=2
        )
        shift = jnp.concatenate(
            [realised.seat_position[:, n:], realised.bore_position[:, n:]], axis=1
        )
        rotation = product(frames.rotation, turn)
        centre = frames.point + apply(frames.rotation, shift)
        spin = frames.velocity[:3]
        velocity = frames.velocity[3:] + cross(spin, centre)
        # Acceleration of the centres and of the axes that is not due to the accelerations.
        axis_rate = cross(spin[:, None], rotation)
        centre_bias, axis_bias = cross(spin, velocity), cross(spin[:, None], axis_rate)
        c = topology.n_cuts
        y, y_rate, y_bias = rotation[:, 1, :c], axis_rate[:, 1, :c], axis_bias[:, 1, :c]
        # Columns x and z of P, of their rates and of their biases.
        ends, end_rates, end_biases = (
            jnp.stack([part[:, 0, c:], part[:, 2, c:]], axis=1)
            for part in (rotation, axis_rate, axis_bias)
        )
        bend = dot(y[:, None], ends)
        bend_rate = dot(y_rate[:, None], ends) + dot(y[:, None], end_rates)
        bend_bias = (
            dot(y_bias[:, None], ends)
            + 2.0 * dot(y_rate[:, None], end_rates)
            + dot(y[:, None], end_biases)
        )
        x = apply_transposed(rotation[:, :, :c], rotation[:, 0, c:])
        return Closure(
            residual=jnp.concatenate([centre[:, c:] - centre[:, :c], scale * bend]),
            rate=jnp.concatenate([velocity[:, c:] - velocity[:, :c], scale * bend_rate]),
            bias=jnp.concatenate([centre_bias[:, c:] - centre_bias[:, :c], scale * bend_bias]),
            couples=scale * cross(ends, y[:, None]),
            rotation=rotation[:, :, :c],
            centre=centre[:, :c],
            right_centre=centre[:, c:],
            alignment=dot(y, rotation[:, 1, c:]),
            angle=jnp.arctan2(-x[2], x[0]),
        )


def assembly_modes(realised: Realisation, now: Motion, cuts: Closure) -> Array:
    """On which side every cut joint closes its loop (C,): +1, -1, or 0 at the fold itself (theory (5.13)).

    The sign of y_L . (left arm x right arm); an arm reaches from the joint that carries the link on
    that side (the datum for the base) to the cut joint.  A planar four-bar has two closed positions
    for one crank angle; at a fold, where the arms are parallel, it may go over from one to the other.
    """
    topology = realised.topology

    def carried_at(node: int) -> Array:
        return realised.datum if node == BASE else now.hinges.point[:, topology.link_of(node)]

    n = topology.n_links
    left = jnp.stack([carried_at(node) for node in topology.parents[n:]], axis=1)
    right = jnp.stack([carried_at(node) for node in topology.children[n:]], axis=1)
    normal = cross(cuts.centre - left, cuts.centre - right)
    return jnp.sign(dot(cuts.rotation[:, 1], normal))


def unit_columns(topology: Topology, cuts: Closure, node: int, point: Array) -> Array:
    """Wrenches (6, 5 C) on one node of unit multipliers of all cut joints."""
    columns = []
    for i, j in enumerate(topology.cuts):
        unit = jnp.zeros((6, 5) + point.shape[1:])
        if node == topology.children[j]:
            unit = unit + cuts.wrenches(i, "child", point)
        if node == topology.parents[j]:
            unit = unit - cuts.wrenches(i, "parent", point)
        columns.append(unit)
    return jnp.concatenate(columns, axis=1)


def invert_closure(topology: Topology, matrix: Array) -> Array:
    """Inverse of the matrix (5 C, 5 C) of the multipliers, or the one of least norm."""
    if not topology.minimum_norm:
        return algebra.invert_positive(matrix)
    last = jnp.moveaxis(matrix, (0, 1), (-2, -1))
    inverse = jnp.linalg.pinv(last, rtol=RANK_TOLERANCE, hermitian=True)
    return jnp.moveaxis(inverse, (-2, -1), (0, 1))
