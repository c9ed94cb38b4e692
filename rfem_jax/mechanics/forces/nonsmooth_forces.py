"""Forces that change much within a step: friction, contacts, flanks of couplings with play.

Place in the pipeline: friction, bush_contacts, joint_forces -> **nonsmooth_forces** -> implicit methods.

A method of integration asks here what such forces need of it, and does not ask which of them a mechanism has: whether
its iteration matrix is to be formed anew, what they remember from step to step, which lines replace them within an
increment, what they lose.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array
from jaxtyping import Float, Int

from rfem_jax.mechanics.algebra.vectors import Scalar
from rfem_jax.mechanics.forces import bush_contacts, friction
from rfem_jax.mechanics.forces.element_loads import FrameLoads
from rfem_jax.mechanics.forces.friction import FrictionLine, FrictionTangent
from rfem_jax.mechanics.forces.joint_forces import LawForces
from rfem_jax.mechanics.kinematics.motion import motion_of
from rfem_jax.mechanics.laws.clearances import ContactMemory
from rfem_jax.mechanics.model.model import Model, State
from rfem_jax.mechanics.model.topology import Topology
from rfem_jax.mechanics.model.with_errors import ModelWithErrors

SecantLines = dict[str, FrictionLine]


class ForceMemory(NamedTuple):
    """What forces remember from step to step.

    contacts: with restitution, how they began (theory (15.6)), None without any; begun: 1 after a step, 0 before, None
    where no force depends on the coming motion.
    """

    contacts: dict[str, ContactMemory] | None = None
    begun: Float[Array, ""] | None = None


class Losses(NamedTuple):
    """Power [W] that every friction, by its name, and the contacts of every joint with clearance dissipate; None
    without any."""

    friction: Float[Array, " frictions"] | None
    contacts: Float[Array, " clearances"] | None


def change_within_steps(actual: ModelWithErrors) -> bool:
    """Whether a mechanism has forces whose tangents change much within a step."""
    couplings = {} if actual.forces is None else actual.forces.couplings
    flanks = any(one.gap is not None for one in couplings.values())
    return actual.friction is not None or bool(actual.topology.clearances) or flanks


def may_be_only_loads(model: Model | ModelWithErrors) -> bool:
    """Whether moments within joints may be all the loads that they carry, as of friction; of other mechanisms forces
    tell how large loads are."""
    return model.friction is not None


def depend_on_coming_motion(model: Model | ModelWithErrors) -> bool:
    """Whether forces at rest depend on how the motion begins, as friction does."""
    return model.friction is not None


def first_memory(actual: ModelWithErrors, state: State) -> ForceMemory:
    """The memory before the first step."""
    contacts = None
    if bush_contacts.remembers(actual):
        contacts = bush_contacts.contact_memory(actual, motion_of(actual, state))
    return ForceMemory(contacts, jnp.zeros(()) if depend_on_coming_motion(actual) else None)


def remembered(actual: ModelWithErrors, state: State, before: ForceMemory) -> tuple[ModelWithErrors, ForceMemory]:
    """At the start of a step: the mechanism whose contacts began as they did, and the memory of it."""
    if before.contacts is None:
        return actual, before
    contacts = bush_contacts.contact_memory(actual, motion_of(actual, state), before.contacts)
    return bush_contacts.with_memory(actual, contacts), before._replace(contacts=contacts)


def with_memory(actual: ModelWithErrors, memory: ForceMemory) -> ModelWithErrors:
    """The mechanism whose forces are as the memory says."""
    return actual if memory.contacts is None else bush_contacts.with_memory(actual, memory.contacts)


def after_step(memory: ForceMemory) -> ForceMemory:
    """The memory after a step."""
    return memory if memory.begun is None else memory._replace(begun=jnp.ones_like(memory.begun))


def delay(memory: ForceMemory, ahead: Scalar | None, h: Float[Array, ""]) -> Float[Array, ""] | None:
    """Time [s] by which friction is taken later, in steps of length zero but the first one, which tells the loads at
    the start (theory (12.10)); None without friction. `ahead` [s]: the longest step; `h` [s]: length of this one."""
    if ahead is None or memory.begun is None:
        return None
    return jnp.where(h > 0.0, 0.0, memory.begun * ahead)


def secant_lines(
    actual: ModelWithErrors,
    laws: LawForces | None,
    before: SecantLines | None = None,
    count: int | Int[Array, ""] = 0,
) -> SecantLines:
    """Lines in the place of forces at joints, for the increment of number `count` from 0 (`friction_lines`)."""
    return friction.friction_lines(actual, friction.states_in(laws), before, count)


def tangent(
    actual: ModelWithErrors, laws: LawForces | None, v_factor: Scalar, lines: SecantLines | None
) -> FrictionTangent:
    """Tangents of the forces at joints whose loads the state alone does not tell, for the derivative of the rate [s];
    of `lines` instead, where these are given (`friction_tangent`)."""
    return friction.friction_tangent(actual, friction.states_in(laws), v_factor, lines)


def losses(topology: Topology, laws: LawForces | None, at_nodes: FrameLoads | None) -> Losses:
    """What forces at joints and elements at nodes dissipate."""
    return Losses(friction.losses(laws), bush_contacts.contact_losses(topology, at_nodes))
