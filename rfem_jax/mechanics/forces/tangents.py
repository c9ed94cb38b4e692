"""Tangents of all forces at one instant, which the iteration matrices of implicit steps and of statics are made of.

Place in the pipeline: joint_forces, friction, element_loads, cut_joints -> **tangents** -> newton, implicit methods,
statics.
"""

from typing import NamedTuple

from jaxtyping import Array, Float

from rfem_jax.mechanics.algebra.vectors import Scalar
from rfem_jax.mechanics.forces.element_loads import ElementTangents, element_tangents, with_couplings
from rfem_jax.mechanics.forces.friction import FrictionTangent
from rfem_jax.mechanics.forces.joint_forces import CutForces, coupling_tangents, law_tangent
from rfem_jax.mechanics.kinematics.cut_joints import Closure, spring_row_tangent
from rfem_jax.mechanics.kinematics.motion import Motion
from rfem_jax.mechanics.laws.frame_forces import Time
from rfem_jax.mechanics.model.model import State
from rfem_jax.mechanics.model.with_errors import ModelWithErrors

NO_FRICTION = FrictionTangent({}, {})


class ForceTangents(NamedTuple):
    """Minus the derivatives of forces with respect to accelerations, as far as a mechanism has such forces.

    joints: of springs, laws and friction by joint coordinate; elements: of force elements and couplings; rows: of
    springs of cut joints, from `spring_row_tangent`; cuts: of friction in cut joints.
    """

    joints: dict[int, Float[Array, ""]]
    elements: ElementTangents | None
    rows: Float[Array, " multipliers"] | None
    cuts: CutForces


NO_FORCES = ForceTangents({}, None, None, {})


def force_tangents(
    actual: ModelWithErrors,
    state: State,
    motion: Motion,
    cuts: Closure | None,
    time: Time | None,
    scale: Scalar,
    factors: tuple[Scalar, Scalar],
    friction: FrictionTangent = NO_FRICTION,
) -> ForceTangents:
    """Tangents of all forces for the derivatives (`factors`) of position [s^2] and rate [s] by accelerations; `time`:
    None for the start; `scale` [m] as in `closure`; `friction` as of `friction_tangent`, of which the state alone does
    not tell the loads."""
    joints = law_tangent(actual, state, *factors)
    for k, value in friction.tree.items():
        joints[k] = joints[k] + value if k in joints else value
    elements = with_couplings(
        element_tangents(actual, motion, time, *factors), coupling_tangents(actual, state, *factors)
    )
    return ForceTangents(joints, elements, spring_row_tangent(actual, cuts, scale, *factors), friction.cuts)
