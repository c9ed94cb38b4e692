"""Steps of an implicit method that follow contact.

Place in the pipeline: generalised_alpha, bush_contacts -> **contact_steps** -> stepping.

An impact in a joint with clearance lasts microseconds, a pin that stays pressed moves as slowly as its mechanism.  A
step of the method is kept where it follows the contacts, and divided where it does not:

    step of length h --> error <= 1 --> kept; the next one is twice as long where the error is far below
                    '--> error > 1  --> tried again in quarters

All lengths are h / 2^k, of which the condensed links are formed once, and places within the step are whole multiples of
the shortest, so that the last one ends exactly where the step does.  Source: theory (15.14).
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PyTree

from rfem_jax.mechanics.forces.bush_contacts import pins_of
from rfem_jax.mechanics.forces.element_loads import element_pose
from rfem_jax.mechanics.kinematics.motion import motion_of
from rfem_jax.mechanics.model.model import State
from rfem_jax.mechanics.model.topology import BASE
from rfem_jax.mechanics.model.with_errors import ModelWithErrors
from rfem_jax.simulation.solvers.implicit_step import Following, Memory
from rfem_jax.simulation.system.equations import Scalar, Trajectory

HALVINGS = 14  # of a step, down to a length that no contact needs
# Of parts of one step; then all are taken, to the end of the run, which has the status "steps_exhausted".
MOST_TRIALS = 4096
SMOOTH = 0.1  # share of an acceleration by which that of a later instant may differ, as far as it is smooth
GROWTH = 0.2  # error from below which the next step may be twice as long, whose error is four times as large
# Over the tolerance, so that all vanishes with it: the share of a contact's force that inertia takes, below which the
# contact only follows the mechanism; the share of the largest force so far of contacts that need not be followed.
SLAVED, SMALL = 2.5, 0.5
SOLVED, SOLVED_BY = 1e-3, 8  # residual over the largest force so far; halvings that are worth trying for it


class PinDepths(NamedTuple):
    """Depths [m] of all contacts of a mechanism, below zero where a contact is open, and their rates [m/s]."""

    depth: Float[Array, " contacts"]
    rate: Float[Array, " contacts"]


class PinLaws(NamedTuple):
    """Laws of all contacts: stiffness K [N/m^n], exponent n, and reduced mass [kg] of both links."""

    stiffness: Float[Array, " contacts"]
    exponent: Float[Array, " contacts"]
    mass: Float[Array, " contacts"]


class _Reached(NamedTuple):
    """At a place within a step: state and memory of the solver, contacts, and how they were followed so far."""

    state: Any
    memory: Memory
    contacts: PinDepths
    following: Following


class _Progress(NamedTuple):
    """Within a step: place, in units of the shortest part, and halvings of the next part; what is reached there; trials
    so far."""

    place: Int[Array, ""]
    halvings: Int[Array, ""]
    reached: _Reached
    trials: Int[Array, ""]


def part_lengths(lengths: Float[Array, " lengths"]) -> Float[Array, "lengths halvings"]:
    """Lengths [s] of the parts that steps of several lengths [s] may be divided into."""
    return lengths[:, None] * 0.5 ** np.arange(HALVINGS + 1)[None]


def depths_of_pins(actual: ModelWithErrors, trajectory: Trajectory) -> PinDepths:
    """The contacts at one instant, without derivatives."""
    actual, trajectory = jax.lax.stop_gradient((actual, trajectory))
    motion = motion_of(actual, State(trajectory.position, trajectory.velocity))
    found = [pin.contacts(element_pose(actual.topology, motion, pin)) for pin in pins_of(actual).values()]
    return PinDepths(*(jnp.concatenate([getattr(one, name) for one in found]) for name in ("depth", "rate")))


def error_of_step(
    h: Float[Array, ""],
    before: PinDepths,
    after: PinDepths,
    laws: PinLaws,
    largest: Float[Array, ""],
    tolerance: float,
) -> Float[Array, ""]:
    """How badly a step of length h [s] follows the contacts, at most 1 where well enough (theory (15.14)).

    What a closed contact changes of its rate within the step, times h, is compared with the depth: with a vibration of
    angular frequency w that is (w h)^2.  It does not matter where the inertia of the bodies takes little of the force,
    as in a pin that stays pressed and follows its mechanism, and where the force is a small share of the `largest` [N]
    so far.
    """
    depth = jnp.maximum(before.depth, after.depth)
    least = (SMALL * tolerance * largest / laws.stiffness + 1e-300) ** (1.0 / laws.exponent)
    change, depth = jnp.abs(after.rate - before.rate), jnp.maximum(depth, least)
    force = laws.stiffness * depth**laws.exponent
    moving = h > 0.0
    inertial = laws.mass * change / jnp.where(moving, h, 1.0) / (SLAVED * force)
    error = jnp.minimum(h * change / depth, inertial) / tolerance
    return jnp.max(jnp.where(moving & ((before.depth > 0.0) | (after.depth > 0.0)), error, 0.0))


def changes_between(before: PinDepths, after: PinDepths) -> Float[Array, ""]:
    """Number of contacts that have closed or opened between two instants."""
    return jnp.sum((before.depth > 0.0) != (after.depth > 0.0)).astype(jnp.float64)


def laws_of_pins(actual: ModelWithErrors) -> PinLaws:
    """The laws of all contacts, without derivatives."""
    actual, found = jax.lax.stop_gradient(actual), []
    for pin in pins_of(actual).values():
        mass = _reduced_mass(actual, (pin.parent.node, pin.child.node))
        for law, count in ((pin.ends, 2), (pin.stop, 1)):
            found += [(law.stiffness, jnp.asarray(law.exponent), mass)] * count
    return PinLaws(*(jnp.stack(one) for one in zip(*found)))


def _reduced_mass(actual: ModelWithErrors, nodes: tuple[int, int]) -> Float[Array, ""]:
    """The reduced mass [kg] of the links of two nodes, which the base has no part in; of links without mass that of the
    mechanism."""
    topology, inverse = actual.topology, jnp.zeros(())
    owners = np.array([topology.link_of(node) for node in range(topology.n_links + topology.n_rfes)])
    for node in nodes:
        if node != BASE:
            own = jnp.sum(jnp.where(owners == topology.link_of(node), actual.mass, 0.0))
            inverse = inverse + 1.0 / jnp.where(own > 0.0, own, jnp.sum(actual.mass))
    return 1.0 / inverse


def for_length(memory: Memory, length: Float[Array, ""], before: Float[Array, ""]) -> Memory:
    """The memory for a part of another length [s] than the one before, zero at the start.

    The method's own accelerations a are those of another instant than v', away by a share of the length; they move with
    it, but not further than `SMOOTH` allows: the vibrations of stiff links would grow (theory (15.15)).
    """
    ratio = jnp.where(before > 0.0, length / jnp.where(before > 0.0, before, 1.0), 1.0)

    def moved_on(auxiliary, present):
        away, bound = auxiliary - present, SMOOTH * jnp.abs(present)
        # By cases, as minima and maxima halve derivatives where both sides vanish: out of plane without errors.
        within = jnp.where(ratio * jnp.abs(away) <= bound, ratio * away, jnp.sign(away) * bound)
        longer = jnp.where(jnp.abs(away) >= bound, away, within)
        return present + jnp.where(ratio <= 1.0, ratio * away, longer)

    auxiliary = jax.tree.map(moved_on, memory.auxiliary, memory.accelerations)
    return memory._replace(auxiliary=auxiliary)


def follow_contacts(
    step: Callable[[Scalar, Scalar, Any, Memory, PyTree], tuple[Any, Memory, diffrax.RESULTS]],
    actual: ModelWithErrors,
    start: Scalar,
    h: Float[Array, ""],
    state: Any,
    memory: Memory,
    operators: PyTree,
    tolerance: float,
) -> tuple[Any, Memory]:
    """State and memory of an implicit method at the end of a step of length h [s] in as many parts as contacts need.

    **Arguments:** `step`: from (start, end, state, memory, operators) of a part to its (state, memory, result);
    `operators`: of the lengths of `part_lengths`, the first axis; `tolerance`: of `error_of_step`.
    """
    units, laws = 2**HALVINGS, laws_of_pins(actual)

    def going_on(now: _Progress):
        return now.place < units

    def advance(now: _Progress):
        part, before = jnp.right_shift(units, now.halvings), now.reached
        ends = now.place, now.place + part
        t0, t1 = (start + h * place.astype(h.dtype) / units for place in ends)
        own, length = jax.tree.map(lambda x: x[now.halvings], operators), h * part.astype(h.dtype) / units
        memory = for_length(before.memory, length, before.following.length)
        state, memory, result = step(t0, t1, before.state, memory, own)
        contacts = depths_of_pins(actual, state[0])
        exhausted = before.following.exhausted | (now.trials >= MOST_TRIALS)
        largest = jnp.sqrt(jnp.max(jax.lax.stop_gradient(state[1])))
        error = error_of_step(length, before.contacts, contacts, laws, largest, tolerance)
        close = (memory.residual <= SOLVED * largest) | (now.halvings >= SOLVED_BY)
        solved = result == diffrax.RESULTS.successful
        kept = ((error <= 1.0) & solved & close) | (now.halvings == HALVINGS) | exhausted
        changes = before.following.changes + changes_between(before.contacts, contacts)
        following = Following(changes, exhausted, length)
        after = _Reached(state, memory, contacts, following)
        place = jnp.where(kept, ends[1], ends[0])
        # Twice the length must divide the place, so that the parts end where the step does.
        longer = ((error < GROWTH) | exhausted) & (jnp.bitwise_and(place, part) == 0)
        fewer = jnp.maximum(now.halvings - longer.astype(jnp.int32), 0)
        halvings = jnp.where(kept, fewer, jnp.minimum(now.halvings + 2, HALVINGS))
        reached = jax.tree.map(lambda a, b: jnp.where(kept, a, b), after, before)
        return _Progress(place, halvings, reached, now.trials + 1)

    assert memory.following is not None  # of a method that follows
    none, alone = jnp.zeros((), jnp.int32), memory._replace(following=None)
    reached = _Reached(state, alone, depths_of_pins(actual, state[0]), memory.following)
    end = jax.lax.while_loop(going_on, advance, _Progress(none, none, reached, none)).reached
    return end.state, end.memory._replace(following=end.following)
