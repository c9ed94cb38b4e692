"""Friction in joints of the tree and in cut joints at one instant.

Place in the pipeline: friction_laws, kinematics, cut_joints, joint_forces -> **friction** -> dynamics, residual, loads,
implicit methods.

Friction is inside its joint and part of the joint's load.  In a joint of the tree it is a force along a coordinate; at
a cut joint a wrench on the nodes of both sides, along or about an axis of L (theory (12.5)).  The normal load follows
from the joint's wrench, which the residual of the implicit method has at hand; explicit methods take friction that
does not depend on loads only.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import jax.numpy as jnp
from jax import Array
from jaxtyping import Float, Int

from rfem_jax.description.basics.errors import InputError
from rfem_jax.mechanics.algebra.vectors import Scalar, cross, dot, spatial
from rfem_jax.mechanics.forces.joint_forces import CutForces, FrictionState, LawForces
from rfem_jax.mechanics.kinematics.cut_joints import Closure
from rfem_jax.mechanics.kinematics.motion import Motion, node_frames
from rfem_jax.mechanics.laws.friction_laws import Friction
from rfem_jax.mechanics.model.model import Model, State
from rfem_jax.mechanics.model.topology import BASE, Topology
from rfem_jax.mechanics.model.with_errors import ModelWithErrors

FrictionStates = dict[str, FrictionState]


class Ahead(NamedTuple):
    """Data with which friction is evaluated at a later rate than that of the state: a time [s], accelerations of the
    joint coordinates, and spatial ones (6,) of the nodes, by node (theory (12.10))."""

    time: Scalar
    joints: Float[Array, " freedoms"]
    nodes: Mapping[int, Float[Array, "6"]]


class FrictionTangent(NamedTuple):
    """Minus the derivatives of friction with respect to the accelerations of its motion, by joint coordinate and by
    component of the load of a cut joint."""

    tree: dict[int, Float[Array, ""]]
    cuts: CutForces


def require_implicit(
    model: Model,
    method: str,
    implicit: bool,
    fix: str = "take that method, or give the friction as `constant` and `viscous`.",
) -> None:
    """Raise InputError for a method that cannot integrate the model's friction, or its reduced bodies."""
    if model.topology.reduced and not implicit:
        link = model.topology.links[model.topology.reduced[0].link]
        raise InputError(
            f'Argument `method` must be "generalised_alpha" with a reduced body (link `{link}`), whose mass matrix '
            f"couples its interfaces, but is {method!r}; take that method."
        )
    loaded = [] if model.friction is None else [name for name, law in model.friction.items() if law.load is not None]
    if loaded and not implicit:
        raise InputError(
            f'Argument `method` must be "generalised_alpha" with friction that depends on loads (`{loaded[0]}`), but '
            f"is {method!r}; {fix}"
        )


def tree_friction(
    actual: ModelWithErrors,
    state: State,
    motion: Motion,
    wrenches: Sequence[Float[Array, "6"]] | None,
    ahead: Ahead | None = None,
) -> FrictionStates:
    """Friction in the joints of the tree; `wrenches`: loads of these joints at the global origin, None before they are
    computed."""
    states: FrictionStates = {}
    for name, law in _laws(actual):
        if law.coordinate is None:
            continue
        rate = state.velocity.joints[law.coordinate]
        normal = None
        if law.load is not None and wrenches is not None:
            moment, force = wrenches[law.joint][:3], wrenches[law.joint][3:]
            about_point = moment - cross(motion.hinges.point[:, law.joint], force)
            normal = law.load.size(force, about_point, motion.hinges.rotation[:, law.axis, law.joint])
        sliding = rate if ahead is None else rate + ahead.time * ahead.joints[law.coordinate]
        states[name] = FrictionState(rate, sliding, normal, law.force(0.0, rate, normal, sliding))
    return states


def cut_friction(
    actual: ModelWithErrors,
    motion: Motion,
    cuts: Closure | None,
    multipliers: Float[Array, " constraints"] | None,
    ahead: Ahead | None = None,
) -> FrictionStates:
    """Friction in the cut joints; `multipliers` [N], None before they are computed."""
    states: FrictionStates = {}
    topology = actual.topology
    for name, law in _laws(actual):
        if law.coordinate is not None or cuts is None:
            continue
        at = law.joint - topology.n_links
        nodes = topology.parents[law.joint], topology.children[law.joint]
        velocity, unit = node_frames(topology, motion, nodes).velocity, _unit_wrench(cuts, at, law.component)
        rate = sliding = dot(unit, velocity[:, 1] - velocity[:, 0])
        if ahead is not None:
            left, right = (ahead.nodes.get(node, jnp.zeros(6)) for node in nodes)
            sliding = rate + ahead.time * dot(unit, right - left)
        normal = None
        if law.load is not None and multipliers is not None:
            group, place = cuts.place_of(at)
            by_group = zip(cuts.groups, cuts.by_group(multipliers), strict=True)
            force, moment = group.loads(next(rows for one, rows in by_group if one is group))
            normal = law.load.size(force[:, place], moment[:, place], cuts.rotation[:, law.axis, at])
        states[name] = FrictionState(rate, sliding, normal, law.force(0.0, rate, normal, sliding))
    return states


def states_in(laws: LawForces | None) -> FrictionStates:
    """The frictions among forces at joints, none without any."""
    return {} if laws is None or laws.friction is None else laws.friction


def with_friction(actual: ModelWithErrors, laws: LawForces | None, states: FrictionStates) -> LawForces | None:
    """The forces at joints with those of friction."""
    if not states:
        return laws
    zero = jnp.zeros(())
    laws = LawForces({}, {}, zero, zero) if laws is None else laws
    inside, dissipated = dict(laws.inside), laws.dissipated
    for name, law in _laws(actual):
        force, k = states[name].force, law.coordinate
        dissipated = dissipated - force * states[name].rate
        if k is not None:
            inside[k] = inside[k] + force if k in inside else force
    return laws._replace(inside=inside, dissipated=dissipated, cuts=cut_forces(actual, states), friction=states)


def cut_forces(actual: ModelWithErrors, states: FrictionStates) -> CutForces:
    """Forces of friction in cut joints, as `LawForces.cuts`."""
    forces: CutForces = {}
    for name, law in _laws(actual):
        if law.coordinate is None and name in states:
            key = _key(actual.topology, law)
            forces[key] = forces[key] + states[name].force if key in forces else states[name].force
    return forces


def losses(laws: LawForces | None) -> Float[Array, " frictions"] | None:
    """Power [W] that every friction dissipates, in the order of their names; None without any."""
    states = sorted(states_in(laws).items())
    return jnp.stack([-one.force * one.rate for _, one in states]) if states else None


def node_wrenches(topology: Topology, cuts: Closure | None, forces: CutForces | None) -> dict[int, Float[Array, "6"]]:
    """Wrenches at the global origin of forces in cut joints on the nodes of their sides, but the base."""
    wrenches: dict[int, Array] = {}
    for j, wrench in joint_wrenches(topology, cuts, forces).items():
        for node, sign in ((topology.parents[j], -1.0), (topology.children[j], 1.0)):
            if node != BASE:
                wrenches[node] = wrenches[node] + sign * wrench if node in wrenches else sign * wrench
    return wrenches


def joint_wrenches(topology: Topology, cuts: Closure | None, forces: CutForces | None) -> dict[int, Float[Array, "6"]]:
    """Wrenches at the global origin of forces in cut joints on their children, by joint."""
    wrenches: dict[int, Array] = {}
    if cuts is None or forces is None:
        return wrenches
    for (at, component), force in forces.items():
        joint, wrench = at + topology.n_links, _unit_wrench(cuts, at, component) * force[None]
        wrenches[joint] = wrenches[joint] + wrench if joint in wrenches else wrench
    return wrenches


class FrictionLine(NamedTuple):
    """Straight line in the place of a friction law within one increment: the force [N, N m] at a rate [m/s, rad/s], and
    minus its slope; needed: the friction at this rate that would balance the other forces of the increment before."""

    rate: Float[Array, ""]
    force: Float[Array, ""]
    slope: Float[Array, ""]
    needed: Float[Array, ""]


def friction_lines(
    actual: ModelWithErrors,
    states: FrictionStates,
    before: dict[str, FrictionLine] | None = None,
    count: int | Int[Array, ""] = 0,
) -> dict[str, FrictionLine]:
    """Lines for the increment of number `count` from 0 (theory (12.9)): the chord from rest first, then that to where
    the law meets what is needed, which two increments before tell as a function of the rate."""
    lines = {}
    for name, law in _laws(actual):
        rate, normal, force = states[name].sliding, states[name].normal, states[name].force
        slope, needed = law.secant(rate, normal), force
        if before is not None:
            last = before[name]
            change = rate - last.rate
            needed = last.force - last.slope * change
            gain = jnp.where(change == 0.0, 0.0, (needed - last.needed) / jnp.where(change == 0.0, 1.0, change))
            gain = jnp.where(count > 1, jnp.maximum(gain, 0.0), 0.0)
            slope = jnp.where(count > 0, law.chord(rate, normal, needed, gain), slope)
        lines[name] = FrictionLine(rate, force, slope, needed)
    return lines


def friction_tangent(
    actual: ModelWithErrors, states: FrictionStates, v_factor: Scalar, lines: dict[str, FrictionLine] | None = None
) -> FrictionTangent:
    """Tangents of friction under its present normal load for the given derivative of the rate [s], at least zero; of
    `lines` instead, where these are given."""
    tangent = FrictionTangent({}, {})
    for name, law in _laws(actual):
        state = states[name]
        derivative = jnp.maximum(law.tangent(state.sliding, state.normal), 0.0) if lines is None else lines[name].slope
        value = derivative * v_factor
        if (k := law.coordinate) is not None:
            tangent.tree[k] = tangent.tree[k] + value if k in tangent.tree else value
        else:
            key = _key(actual.topology, law)
            tangent.cuts[key] = tangent.cuts[key] + value if key in tangent.cuts else value
    return tangent


def _laws(actual: ModelWithErrors) -> Sequence[tuple[str, Friction]]:
    laws: Mapping[str, Friction] = {} if actual.friction is None else actual.friction
    # Dictionaries come back from transformations in the order of their keys.
    return sorted(laws.items())


def _key(topology: Topology, law: Friction) -> tuple[int, int]:
    return law.joint - topology.n_links, law.component


def _unit_wrench(cuts: Closure, at: int, component: int) -> Float[Array, "6"]:
    """Wrench at the global origin of a unit force along an axis of L (component 0 to 2) at the centre of P, or of a
    unit moment about one (3 to 5)."""
    axis = cuts.rotation[:, component % 3, at]
    if component >= 3:
        return spatial(axis, jnp.zeros_like(axis))
    return spatial(cross(cuts.right_centre[:, at], axis), axis)
