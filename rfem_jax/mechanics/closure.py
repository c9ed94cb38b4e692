"""Cut joints: the five constraint equations of each, complete to the acceleration.

Place in the pipeline: kinematics -> **closure** -> dynamics, statics, reference formulation.

Equation (18): the joint centres of the left side L and the right side P coincide (three equations,
global axes), and the hinge axis y_L is perpendicular to x_P and z_P (two equations, times a length
so that all five are in metres and the multipliers in newtons).  Equation (19) is complete:
gamma = -(Phi_q)_dot q_dot.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from rfem_jax.mechanics import algebra
from rfem_jax.mechanics.algebra import cross, dot
from rfem_jax.mechanics.kinematics import Motion, side_frame
from rfem_jax.mechanics.realisation import Realisation


class Closure(NamedTuple):
    """The constraints of one cut joint at one instant.

    residual, rate (5,): Phi and its rate; bias (5,): (Phi_q)_dot q_dot; couples (3, 2): moments on P
    of the last two unit multipliers (the first three are forces at the centre of P; on L all act
    in the opposite sense, at the centre of L); rotation, centre: the hinge frame L; right_centre: the
    joint's centre on P; alignment: y_L . y_P (must be near +1, not -1).
    """

    residual: Array
    rate: Array
    bias: Array
    couples: Array
    rotation: Array
    centre: Array
    right_centre: Array
    alignment: Array

    def wrenches(self, side: str, point: Array) -> Array:
        """Wrenches (6, 5) at `point` of unit multipliers on P ("child"; on L their negative)."""
        arm = (self.right_centre if side == "child" else self.centre) - point
        forces = jnp.asarray(algebra.IDENTITY).reshape((3, 3) + (1,) * (arm.ndim - 1))
        forces = jnp.broadcast_to(forces, self.rotation.shape)
        moment = jnp.concatenate([algebra.cross_matrix(arm), self.couples], axis=1)
        force = jnp.concatenate([forces, 0.0 * self.couples], axis=1)
        return jnp.concatenate([moment, force])


def closures(realised: Realisation, motion: Motion, scale: Array) -> tuple[Closure, ...]:
    """Constraints of every cut joint; `scale` [m] multiplies the two axis equations."""
    with jax.named_scope("closure"):
        return tuple(_closure(realised, motion, cut, scale) for cut in realised.topology.cuts)


def _closure(realised: Realisation, motion: Motion, cut: int, scale: Array) -> Closure:
    left, left_centre, left_velocity = side_frame(realised, motion, cut, "parent")
    right, right_centre, right_velocity = side_frame(realised, motion, cut, "child")
    y, x, z = left[:, 1], right[:, 0], right[:, 2]
    w_left, w_right = left_velocity[:3], right_velocity[:3]
    v_left = left_velocity[3:] + cross(w_left, left_centre)
    v_right = right_velocity[3:] + cross(w_right, right_centre)
    couples = scale * jnp.stack([cross(x, y), cross(z, y)], axis=1)
    relative = w_right - w_left

    def axis_bias(direction):
        """Second derivative of y_L . direction_P without the accelerations."""
        y_rate, d_rate = cross(w_left, y), cross(w_right, direction)
        return (
            dot(cross(w_left, y_rate), direction)
            + 2.0 * dot(y_rate, d_rate)
            + dot(y, cross(w_right, d_rate))
        )

    return Closure(
        residual=jnp.concatenate(
            [right_centre - left_centre, scale * jnp.stack([dot(y, x), dot(y, z)])]
        ),
        rate=jnp.concatenate([v_right - v_left, algebra.apply_transposed(couples, relative)]),
        bias=jnp.concatenate(
            [
                cross(w_right, v_right) - cross(w_left, v_left),
                scale * jnp.stack([axis_bias(x), axis_bias(z)]),
            ]
        ),
        couples=couples,
        rotation=left,
        centre=left_centre,
        right_centre=right_centre,
        alignment=dot(y, right[:, 1]),
    )
