"""Newmark's formulas of the generalised-alpha method: what a step makes of accelerations.

Place in the pipeline: equations, orientations -> **newmark_formulas** -> generalised_alpha, stepping.

J. Chung, G. M. Hulbert, J. Appl. Mech. 60 (1993) 371-375; for constraints at the level of positions M. Arnold,
O. Bruels, Multibody Syst. Dyn. 18 (2007) 185-202; theory (7.1) to (7.7):

    q1 = q0 + h v0 + h^2 ((1/2 - beta) a0 + beta a1),     v1 = v0 + h ((1 - gamma) a0 + gamma a1)
    (1 - alpha_m) a1 + alpha_m a0 = (1 - alpha_f) v1' + alpha_f v0'

with coefficients from the spectral radius at infinite frequency; quaternions turn by the change of q as a rotation
vector (O. Bruels, A. Cardona, M. Arnold, Mech. Mach. Theory 48 (2012) 121-137).  v' are the accelerations of the
motion, a the auxiliary ones of the method.
"""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rfem_jax.mechanics.implicit.residual import Evaluation
from rfem_jax.mechanics.model.inputs import DriveInput, impose
from rfem_jax.mechanics.model.model import Coordinates, State
from rfem_jax.mechanics.model.orientations import moved
from rfem_jax.mechanics.model.topology import Topology
from rfem_jax.simulation.solvers.implicit_step import Memory
from rfem_jax.simulation.system.equations import Trajectory

LIKE = 2.0  # a step of up to so many times the length of the one before goes on with its memory


class NewmarkFormulas(NamedTuple):
    """The formulas by their coefficients."""

    alpha_m: float
    alpha_f: float
    beta: float
    gamma: float

    @classmethod
    def of_radius(cls, radius: float) -> "NewmarkFormulas":
        """With the coefficients of a spectral radius at infinite frequency (theory (7.3))."""
        alpha_m, alpha_f = (2.0 * radius - 1.0) / (radius + 1.0), radius / (radius + 1.0)
        gamma = 0.5 + alpha_f - alpha_m
        return cls(alpha_m, alpha_f, 0.25 * (gamma + 0.5) ** 2, gamma)

    def factors(self, h: Float[Array, ""]) -> tuple[Float[Array, ""], Float[Array, ""]]:
        """Derivatives of q1 [s^2] and v1 [s] with respect to v1' for a step of length h [s]."""
        share = (1.0 - self.alpha_f) / (1.0 - self.alpha_m)
        return self.beta * h**2 * share, self.gamma * h * share

    def at_new_length(
        self, trajectory: Trajectory, memory: Memory, before: Float[Array, ""], h: Float[Array, ""]
    ) -> tuple[Trajectory, Memory]:
        """State and memory at the start of a step of length h [s] after one of length `before` [s].

        Over steps of one length the method's own accelerations a, which lag behind v', add up to the impulse of v'
        (theory, after (7.5)); where the length changes, the velocity takes what would be missing, and where it changes
        much, the lag, which belongs to the other length, is forgotten.
        """
        unlike = (h > LIKE * before) | (before > LIKE * h)

        def impulse(velocity, auxiliary, present):
            missing = (before - jnp.where(unlike, 0.0, h)) * (auxiliary - present)
            return velocity + (0.5 - self.alpha_f) * missing

        present = memory.accelerations
        velocity = jax.tree.map(impulse, trajectory.velocity, memory.auxiliary, present)
        auxiliary = jax.tree.map(lambda a, b: jnp.where(unlike, b, a), memory.auxiliary, present)
        earlier = memory.earlier
        if earlier is not None:
            share = jnp.where(unlike, 0.0, h / jnp.where(unlike, 1.0, before))
            earlier = present.joints - share * (present.joints - earlier)
        memory = memory._replace(auxiliary=auxiliary, earlier=earlier)
        return dataclasses.replace(trajectory, velocity=velocity), memory

    def end_of_step(
        self,
        h: Float[Array, ""],
        trajectory: Trajectory,
        memory: Memory,
        accelerations: Coordinates,
        topology: Topology,
        drive: DriveInput,
    ) -> tuple[State, Coordinates]:
        """(q1, v1) from v1' of the end of a step of length h [s], with the prescribed motion imposed, and a1."""
        moving = h > 0.0

        def auxiliary(new, old, a):  # a1 of theory (7.2); in a step of length zero a1 = v1'
            mixed = (1.0 - self.alpha_f) * new + self.alpha_f * old - self.alpha_m * a
            return jnp.where(moving, mixed / (1.0 - self.alpha_m), new)

        a0 = memory.auxiliary
        a1 = jax.tree.map(auxiliary, accelerations, memory.accelerations, a0)
        # q1 and v1 of theory (7.1).
        change = jax.tree.map(
            lambda v, a, b: h * (v + h * ((0.5 - self.beta) * a + self.beta * b)), trajectory.velocity, a0, a1
        )
        position = moved(topology, trajectory.position, change)
        velocity = jax.tree.map(
            lambda v, a, b: v + h * ((1.0 - self.gamma) * a + self.gamma * b),
            trajectory.velocity,
            a0,
            a1,
        )
        return impose(topology, State(position, velocity), drive), a1

    def closing_as_acceleration(self, evaluation: Evaluation, h: Float[Array, ""]) -> Evaluation:
        """The evaluation with its closure error [m] as the acceleration [m/s^2] that removes it within the step."""
        moving, (q_factor, _) = h > 0.0, self.factors(h)
        unit = jnp.where(moving, q_factor, 1.0)
        if evaluation.closure is not None and (sprung := evaluation.closure.sprung_rows):
            unit = jnp.where(np.array(sprung), 1.0, unit)
        by_step = evaluation.closing / unit
        return evaluation._replace(closing=jnp.where(moving, by_step, evaluation.closing_acceleration))

    def keeping_shape(
        self, h: Float[Array, ""], velocity: Float[Array, "6 rfes"], memory: Memory
    ) -> Float[Array, "6 rfes"]:
        """Accelerations v1' of elastic coordinates, whose velocity v0 is given, with which q1 = q0 (theory (7.6))."""
        moving = h > 0.0
        step = jnp.where(moving, h, 1.0)
        old, a0 = memory.accelerations.elastic, memory.auxiliary.elastic
        a1 = -(velocity / step + (0.5 - self.beta) * a0) / self.beta
        mixed = (1.0 - self.alpha_m) * a1 + self.alpha_m * a0 - self.alpha_f * old
        return jnp.where(moving, mixed / (1.0 - self.alpha_f), old)
