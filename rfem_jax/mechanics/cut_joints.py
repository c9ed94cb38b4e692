"""Cut joints: the five constraint equations of each, with their first and second derivatives by time.

Place in the pipeline: kinematics -> **cut_joints** -> dynamics, residual, newton, statics.

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
from jaxtyping import Float

from rfem_jax.mechanics import algebra
from rfem_jax.mechanics.algebra import Scalar, apply, apply_transposed, cross, dot, product
from rfem_jax.mechanics.kinematics import Motion, node_frames
from rfem_jax.mechanics.model import BASE, Topology
from rfem_jax.mechanics.model_with_errors import ModelWithErrors

RANK_TOLERANCE = 1e-9  # of singular values, relative to the largest


class Closure(NamedTuple):
    """The constraints of all cut joints at one instant.

    residual, rate, bias (5, C): Phi [m], its rate and (Phi_q)_dot q_dot; couples (3, 2, C) [m]: moments on
    P of the last two unit multipliers (the first three are forces at the centre of P; on L all act in the
    opposite sense, at the centre of L); rotation, centre: the hinge frames L; right_centre: the joint's
    centre on P; alignment (C,): y_L . y_P (must be near +1, not -1); angle (C,) [rad]: from L to P about
    the hinge.
    """

    residual: Float[Array, "5 cuts"]
    rate: Float[Array, "5 cuts"]
    bias: Float[Array, "5 cuts"]
    couples: Float[Array, "3 2 cuts"]
    rotation: Float[Array, "3 3 cuts"]
    centre: Float[Array, "3 cuts"]
    right_centre: Float[Array, "3 cuts"]
    alignment: Float[Array, " cuts"]
    angle: Float[Array, " cuts"]

    def wrenches(self, cut: int, side: str, point: Float[Array, "3"]) -> Float[Array, "6 5"]:
        """Wrenches at `point` of unit multipliers of one cut joint as they act on P (`side` "child"), or on L
        ("parent") with the opposite sign."""
        centre = self.right_centre if side == "child" else self.centre
        arm = centre[:, cut] - point
        forces = jnp.asarray(np.hstack([algebra.IDENTITY, np.zeros((3, 2))]))
        moments = jnp.concatenate([algebra.cross_matrix(arm), self.couples[:, :, cut]], axis=1)
        return jnp.concatenate([moments, forces])


def closure(actual: ModelWithErrors, motion: Motion, scale: Scalar) -> Closure | None:
    """Constraints of all cut joints (None without any); `scale` [m] multiplies the two axis
    equations."""
    topology = actual.topology
    if topology.n_cuts == 0:
        return None
    with jax.named_scope("closure"):
        n = topology.n_links
        nodes = topology.parents[n:] + topology.children[n:]
        frames = node_frames(topology, motion, nodes)
        in_node = jnp.concatenate([actual.seat_rotation[:, :, n:], actual.bore_rotation[:, :, n:]], axis=2)
        offset = jnp.concatenate([actual.seat_position[:, n:], actual.bore_position[:, n:]], axis=1)
        rotation = product(frames.rotation, in_node)
        centre = frames.point + apply(frames.rotation, offset)
        spin = frames.velocity[:3]
        velocity = frames.velocity[3:] + cross(spin, centre)
        # Second derivatives of the centres and of the axes for q_ddot = 0.
        axis_rate = cross(spin[:, None], rotation)
        centre_bias, axis_bias = cross(spin, velocity), cross(spin[:, None], axis_rate)
        c = topology.n_cuts
        y, y_rate, y_bias = rotation[:, 1, :c], axis_rate[:, 1, :c], axis_bias[:, 1, :c]
        # Columns x and z of P, of their rates and of their biases.
        ends, end_rates, end_biases = (
            jnp.stack([part[:, 0, c:], part[:, 2, c:]], axis=1) for part in (rotation, axis_rate, axis_bias)
        )
        bend = dot(y[:, None], ends)
        bend_rate = dot(y_rate[:, None], ends) + dot(y[:, None], end_rates)
        bend_bias = dot(y_bias[:, None], ends) + 2.0 * dot(y_rate[:, None], end_rates) + dot(y[:, None], end_biases)
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


def assembly_modes(actual: ModelWithErrors, motion: Motion, cuts: Closure) -> Float[Array, " cuts"]:
    """On which side every cut joint closes its loop: +1, -1, or 0 at the change point itself (theory (5.13)).

    The sign of y_L . (left arm x right arm); an arm reaches from the tree joint of the link on that side
    (the datum for the base) to the cut joint.  A planar four-bar has two assembly modes for one crank
    angle; at a change point, where the arms are parallel, it may pass from one to the other.
    """
    topology = actual.topology

    def hinge_of(node: int) -> Array:
        return actual.datum if node == BASE else motion.hinges.point[:, topology.link_of(node)]

    n = topology.n_links
    left = jnp.stack([hinge_of(node) for node in topology.parents[n:]], axis=1)
    right = jnp.stack([hinge_of(node) for node in topology.children[n:]], axis=1)
    normal = cross(cuts.centre - left, cuts.centre - right)
    return jnp.sign(dot(cuts.rotation[:, 1], normal))


def unit_columns(
    topology: Topology, cuts: Closure, node: int, point: Float[Array, "3"]
) -> Float[Array, "6 multipliers"]:
    """Wrenches at `point` on one node of unit multipliers of all cut joints: columns of Phi_q^T."""
    columns = []
    for i, j in enumerate(topology.cuts):
        unit = jnp.zeros((6, 5) + point.shape[1:])
        if node == topology.children[j]:
            unit = unit + cuts.wrenches(i, "child", point)
        if node == topology.parents[j]:
            unit = unit - cuts.wrenches(i, "parent", point)
        columns.append(unit)
    return jnp.concatenate(columns, axis=1)


def invert_closure(
    topology: Topology, matrix: Float[Array, "multipliers multipliers"]
) -> Float[Array, "multipliers multipliers"]:
    """Inverse of the multipliers' matrix Phi_q M^-1 Phi_q^T, or its pseudo-inverse where redundant reactions
    are to have the least norm."""
    if not topology.minimum_norm:
        return algebra.invert_positive(matrix)
    last = jnp.moveaxis(matrix, (0, 1), (-2, -1))
    inverse = jnp.linalg.pinv(last, rtol=RANK_TOLERANCE, hermitian=True)
    return jnp.moveaxis(inverse, (-2, -1), (0, 1))
