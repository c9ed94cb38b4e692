"""Loads in all joints.

Place in the pipeline: dynamics -> **loads** -> simulation (metrics, Run).

A joint's load is the force and the moment that the parent side exerts on the child link, about the
joint's centre on the child, in the hinge frame H (in L at a cut joint), in N and N m (theory (8.1) to (8.3)).  A
drive that is a given moment or force, or a law of the joint's position and rate, is an external load and not part of
it; a spring in the joint and the moment or force that enforces a prescribed motion are.

They are computed in two ways, and every run checks them by the balance of momentum: `chain_loads` is the
recursive Newton-Euler algorithm over all rfes from the tips to the base; `joint_loads` uses the equations
of motion of the rfes 0 alone, whose elastic wrenches the accelerations needed anyway.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from rfem_jax.mechanics.algebra import vectors
from rfem_jax.mechanics.algebra.vectors import apply, apply_transposed, cross, dot, scaled
from rfem_jax.mechanics.dynamics.dynamics import Accelerations, link_axes
from rfem_jax.mechanics.elements.deformed_bodies import DeformationLoads, deformation_loads
from rfem_jax.mechanics.forces.element_loads import FrameLoads
from rfem_jax.mechanics.forces.friction import joint_wrenches
from rfem_jax.mechanics.forces.joint_forces import (
    CutForces,
    LawForces,
    hinge_moments,
    outside_forces,
)
from rfem_jax.mechanics.kinematics.cut_joints import Closure, columns
from rfem_jax.mechanics.kinematics.motion import Motion, spread, total
from rfem_jax.mechanics.kinematics.self_stress import least_reactions, redundancy
from rfem_jax.mechanics.laws.clearances import clearance_name
from rfem_jax.mechanics.model.inputs import DriveInput
from rfem_jax.mechanics.model.model import Coordinates, State
from rfem_jax.mechanics.model.topology import BASE, Topology
from rfem_jax.mechanics.model.with_errors import ModelWithErrors


class JointLoads(NamedTuple):
    """Force [N] and moment [N m] of all joints in their hinge frames."""

    force: Float[Array, "3 joints"]
    moment: Float[Array, "3 joints"]


@runtime_checkable
class Placed(Protocol):
    """Motion, closure and forces of the elements at an instant."""

    @property
    def motion(self) -> Motion: ...
    @property
    def closure(self) -> Closure | None: ...
    @property
    def frame_loads(self) -> FrameLoads | None: ...


@runtime_checkable
class Solved(Placed, Protocol):
    """Solution of one instant, or of a mechanism at rest: `Placed` with the multipliers [N] and the forces of laws."""

    @property
    def multipliers(self) -> Float[Array, " constraints"]: ...
    @property
    def laws(self) -> LawForces | None: ...


class Resting(NamedTuple):
    """A mechanism at rest, as `chain_loads` reads it."""

    motion: Motion
    closure: Closure | None
    multipliers: Float[Array, " constraints"]
    laws: LawForces | None
    frame_loads: FrameLoads | None = None


def joint_loads(actual: ModelWithErrors, result: Accelerations, drive: DriveInput) -> JointLoads:
    """Loads of all joints by the equations of motion of the rfes 0 (theory (8.4)); where redundant reactions are to be
    least, by `chain_loads`."""
    if actual.topology.minimum_norm:
        return chain_loads(actual, result, result.angular, result.linear, drive)[0]
    with jax.named_scope("joint_loads"):
        topology, tree, cuts = actual.topology, result.interface_tree, result.closure
        n, rows = topology.n_links, _rows(topology)
        net = apply(tree.inertia[:, :, :n], result.spatial) - tree.load[:, :n]
        wrenches: dict[int, Array] = {}
        for l in reversed(range(n)):
            # W_l = I_l A_l - p_l + W_j of joints with parent l - W_c of cut joints with child l (theory (8.4)).
            wrench, point = net[:, l], tree.point[:, l]
            if l in result.chain_wrenches:
                wrench = wrench + result.chain_wrenches[l]
            for j in range(l + 1, n):
                if topology.parents[j] == l:
                    wrench = wrench + wrenches[j]
            for i, j in enumerate(topology.cuts):
                if cuts is not None and topology.parents[j] == l:
                    unit = cuts.wrenches(i, "parent", point)
                    wrench = wrench + apply(unit, result.multipliers[rows[i]])
                if cuts is not None and topology.children[j] == l:
                    unit = cuts.wrenches(i, "child", point)
                    wrench = wrench - apply(unit, result.multipliers[rows[i]])
            wrenches[l] = wrench
        links = jnp.stack([wrenches[l] for l in range(n)], axis=1)
        hinges = result.motion.hinges
        moment = links[:3] - cross(hinges.point - tree.point[:, :n], links[3:])
        return _hinge_frame_loads(topology, result, links[3:], moment, drive)


def chain_loads(
    actual: ModelWithErrors,
    result: Solved,
    angular: Float[Array, "3 nodes"],
    linear: Float[Array, "3 nodes"],
    drive: DriveInput,
) -> tuple[JointLoads, Float[Array, "6"]]:
    """Loads of all joints by the recursive Newton-Euler algorithm over all rfes, for accelerations of the
    nodes in link axes, and the wrench at the origin that the base exerts."""
    result, wrenches = moving_wrenches(actual, result, angular, linear)
    return loads_of_wrenches(actual.topology, result, wrenches, drive), base_wrench(actual.topology, wrenches)


def moving_wrenches(
    actual: ModelWithErrors, result: Solved, angular: Float[Array, "3 nodes"], linear: Float[Array, "3 nodes"]
) -> tuple[Any, list[Float[Array, "6"]]]:
    """The wrenches of `chain_wrenches` for accelerations of the nodes in link axes, and what they follow from, both
    with the least of redundant reactions."""
    with jax.named_scope("chain_loads"):
        inertial = loads_beyond_elements(inertial_loads(actual, result.motion, angular, linear), result.frame_loads)
        at_cuts = None if result.laws is None else result.laws.cuts
        wrenches = chain_wrenches(actual, result.motion, result.closure, result.multipliers, inertial, at_cuts)
        return with_least_reactions(actual, result, wrenches)


def with_least_reactions(
    actual: ModelWithErrors, result: Any, wrenches: list[Float[Array, "6"]]
) -> tuple[Any, list[Float[Array, "6"]]]:
    """What was solved (`Solved`), and the wrenches of all joints, with multipliers for which redundant reactions are
    least, of models that ask for it."""
    cuts, hinges = result.closure, result.motion.hinges
    left_open = redundancy(actual.topology, result.motion, cuts)
    if left_open is None:
        return result, wrenches
    revolute = np.array([actual.topology.kinds[j] == "revolute" for j in actual.topology.cuts])
    points = jnp.concatenate([hinges.point, jnp.where(revolute, cuts.centre, cuts.right_centre)], axis=1)
    assert actual.reaction_length is not None, "models that ask for least reactions have one"
    change, wrenches = least_reactions(left_open, points, wrenches, actual.reaction_length)
    return result._replace(multipliers=result.multipliers + change), wrenches


def loads_of_wrenches(
    topology: Topology, result: Solved, wrenches: Sequence[Float[Array, "6"]], drive: DriveInput
) -> JointLoads:
    """Loads of all joints from the wrenches at the global origin of `chain_wrenches`."""
    links = jnp.stack(wrenches[: topology.n_links], axis=1)
    moment = links[:3] - cross(result.motion.hinges.point, links[3:])
    return _hinge_frame_loads(topology, result, links[3:], moment, drive)


def _hinge_frame_loads(
    topology: Topology, result: Solved, force: Array, moment: Array, drive: DriveInput
) -> JointLoads:
    """Loads of all joints in hinge frames from the forces and moments (3, L) of the tree joints about their
    centres, in global axes; those of cut joints from the multipliers."""
    rotation = result.motion.hinges.rotation
    for k, outside in outside_forces(topology, drive, result.laws):
        force, moment = _subtract_outside_forces(topology, result.motion, k, outside, force, moment)
    force, moment = apply_transposed(rotation, force), apply_transposed(rotation, moment)
    # The drive's moment M e_y is not part of the hinge's load (theory (8.2)).
    external = hinge_moments(topology, drive)
    if external is not None:
        moment = jnp.stack([moment[0], moment[1] - external, moment[2]])
    cuts = result.closure
    if cuts is not None and cuts.groups:
        of_groups = [group.loads(rows) for group, rows in zip(cuts.groups, cuts.by_group(result.multipliers))]
        on_right, couple = (columns(cuts.groups, part) for part in zip(*of_groups))
        force = jnp.concatenate([force, apply_transposed(cuts.rotation, on_right)], axis=1)
        moment = jnp.concatenate([moment, apply_transposed(cuts.rotation, couple)], axis=1)
    at_cuts = None if result.laws is None else result.laws.cuts
    joint = _with_cut_forces(topology, JointLoads(force, moment), at_cuts)
    if not topology.clearances:
        return joint
    return jax.tree.map(jnp.add, joint, contact_loads(topology, result))


def contact_loads(topology: Topology, result: Placed) -> JointLoads:
    """Part of the contacts in the loads of joints with clearance: forces, and moments about the child's point; zero at
    all other joints."""
    joints, n = len(topology.joints), topology.n_links
    sums = [jnp.zeros((3, joints)), jnp.zeros((3, joints))]
    for j in topology.clearances:
        assert result.frame_loads is not None, "contacts are force elements"
        exerted = result.frame_loads.exerted[clearance_name(topology.joints[j])]
        here = jnp.asarray(np.arange(joints) == j, float)[None]
        if j < n:
            axes = result.motion.hinges.rotation[:, :, j]
        else:
            assert result.closure is not None, "a cut joint has a closure"
            axes = result.closure.rotation[:, :, j - n]
        parts = exerted.force, exerted.moment
        sums = [sum + apply_transposed(axes, part)[:, None] * here for sum, part in zip(sums, parts)]
    return JointLoads(*sums)


def _with_cut_forces(topology: Topology, joint: JointLoads, at_cuts: CutForces | None) -> JointLoads:
    """Loads with the forces in cut joints, which are already in the axes of L."""
    parts = [*joint]
    for (at, component), value in (at_cuts or {}).items():
        here = np.zeros(joint.force.shape, bool)
        here[component % 3, topology.n_links + at] = True
        side = component // 3
        parts[side] = jnp.where(here, parts[side] + value[None, None], parts[side])
    return JointLoads(*parts)


def _subtract_outside_forces(
    topology: Topology, motion: Motion, k: int, outside: Array, force: Array, moment: Array
) -> tuple[Array, Array]:
    """Forces and moments (3, L) of the tree joints less what acts from outside along a joint coordinate."""
    axis = motion.axis
    here = np.arange(topology.n_links) == topology.link_of_freedom[k]
    along = jnp.where(here[None], (axis[3:, k] if topology.slides[k] else axis[:3, k])[:, None] * outside, 0.0)
    return (force - along, moment) if topology.slides[k] else (force, moment - along)


def load_along(topology: Topology, motion: Motion, joint: JointLoads, k: int) -> Float[Array, ""]:
    """The component of a joint's load along one of its coordinates: moment [N m] or force [N]."""
    l = topology.link_of_freedom[k]
    if topology.about_hinge(k):
        return joint.moment[1, l]
    axis, part = (motion.axis[3:, k], joint.force) if topology.slides[k] else (motion.axis[:3, k], joint.moment)
    return dot(axis, apply(motion.hinges.rotation[:, :, l], part[:, l]))


def chain_wrenches(
    actual: ModelWithErrors,
    motion: Motion,
    cuts: Closure | None,
    multipliers: Float[Array, " constraints"],
    inertial: tuple[Float[Array, "3 nodes"], Float[Array, "3 nodes"]],
    at_cuts: CutForces | None = None,
) -> list[Float[Array, "6"]]:
    """Wrenches at the global origin that the parent side of every joint exerts on the child, drives and laws
    included; `inertial` from `inertial_loads`, less what force elements exert; `at_cuts`: forces in cut joints."""
    topology = actual.topology
    n = topology.n_links
    force, moment = inertial
    arms = cross(motion.relative.position, force[:, n:])
    link_force = force[:, :n] + total(topology, force[:, n:])
    link_moment = moment[:, :n] + total(topology, moment[:, n:] + arms)
    of_links = vectors.wrench_at_origin(
        apply(motion.links.rotation, link_moment),
        apply(motion.links.rotation, link_force),
        motion.links.point,
    )
    wrenches = dict(zip(topology.cuts, cut_wrenches(topology, cuts, multipliers, at_cuts)))
    # W_l = W^I of its rfes + W_j of joints with parent l - W_c of cut joints with child l (theory (8.1)).
    for l in reversed(range(n)):
        wrench = of_links[:, l]
        for j in [*range(l + 1, n), *topology.cuts]:
            if topology.parents[j] != BASE and topology.link_of(topology.parents[j]) == l:
                wrench = wrench + wrenches[j]
        for j in topology.cuts:
            if topology.link_of(topology.children[j]) == l:
                wrench = wrench - wrenches[j]
        wrenches[l] = wrench
    return [wrenches[j] for j in range(len(topology.joints))]


def cut_wrenches(
    topology: Topology,
    cuts: Closure | None,
    multipliers: Float[Array, " constraints"],
    at_cuts: CutForces | None = None,
) -> list[Float[Array, "6"]]:
    """Wrenches at the global origin that the parent sides of the cut joints exert on the children."""
    if cuts is None or not cuts.groups:
        return []
    origin = jnp.zeros_like(cuts.centre[:, 0])
    units = [cuts.wrenches(i, "child", origin) for i in range(topology.n_cuts)]
    wrenches = [apply(unit, multipliers[rows]) for unit, rows in zip(units, _rows(topology))]
    more = joint_wrenches(topology, cuts, at_cuts)
    return [wrench + more[j] if j in more else wrench for j, wrench in zip(topology.cuts, wrenches)]


def base_wrench(topology: Topology, wrenches: Sequence[Float[Array, "6"]]) -> Float[Array, "6"]:
    """Wrench at the global origin that the base exerts, from those of all joints."""
    return jnp.asarray(sum(w for w, parent in zip(wrenches, topology.parents) if parent == BASE))


def _rows(topology: Topology) -> list[slice]:
    """Rows of the multipliers of every cut joint."""
    return [slice(rows.start, rows.stop) for rows in topology.constraints]


def inertial_loads(
    actual: ModelWithErrors,
    motion: Motion,
    angular: Float[Array, "3 nodes"],
    linear: Float[Array, "3 nodes"],
    accelerations: Coordinates | None = None,
) -> tuple[Float[Array, "3 nodes"], Float[Array, "3 nodes"]]:
    """Rate of momentum minus weight of every node: force [N] and moment [N m] at its reference point, in link
    axes, for accelerations likewise; `accelerations`: second derivatives of the coordinates, of which superelements
    need theirs, None at rest."""
    topology = actual.topology
    spin, gravity = link_axes(actual, motion)
    more = None
    if actual.superelements is not None:
        more = superelement_loads(actual, motion, angular, linear, accelerations)
    spin = jnp.concatenate([spin, spread(topology, spin) + motion.relative.angular], axis=1)
    gravity = jnp.concatenate([gravity, spread(topology, gravity)], axis=1)
    identity = jnp.broadcast_to(jnp.asarray(vectors.IDENTITY)[:, :, None], (3, 3, topology.n_links))
    rotation = jnp.concatenate([identity, motion.relative.rotation], axis=2)
    centre = apply(rotation, actual.centre)
    of_centre = linear + cross(angular, centre) + cross(spin, cross(spin, centre))
    force = scaled(actual.mass, of_centre - gravity)
    body_spin, body_angular = apply_transposed(rotation, spin), apply_transposed(rotation, angular)
    inertia = actual.inertia
    rate = apply(inertia, body_angular) + cross(body_spin, apply(inertia, body_spin))
    moment = apply(rotation, rate) + cross(centre, force)
    if more is None:
        return force, moment
    n = topology.n_links
    return (
        jnp.concatenate([force[:, :n] + more.force, force[:, n:]], axis=1),
        jnp.concatenate([moment[:, :n] + more.moment, moment[:, n:]], axis=1),
    )


def superelement_loads(
    actual: ModelWithErrors,
    motion: Motion,
    angular: Float[Array, "3 nodes"],
    linear: Float[Array, "3 nodes"],
    accelerations: Coordinates | None = None,
) -> DeformationLoads:
    """What the deformation of superelements adds to `inertial_loads`, and their generalised loads."""
    n, (spin, gravity) = actual.topology.n_links, link_axes(actual, motion)
    elastic = None if accelerations is None else accelerations.elastic
    return deformation_loads(actual, motion.relative, spin, angular[:, :n], linear[:, :n] - gravity, elastic)


def loads_beyond_elements(
    inertial: tuple[Float[Array, "3 nodes"], Float[Array, "3 nodes"]], at_nodes: FrameLoads | None
) -> tuple[Float[Array, "3 nodes"], Float[Array, "3 nodes"]]:
    """Inertial loads of the nodes without the part that force elements exert: joints and the springs of links carry
    it."""
    if at_nodes is None:
        return inertial
    return inertial[0] - at_nodes.force, inertial[1] - at_nodes.moment


def static_state(topology: Topology, position: Coordinates) -> State:
    """A state at rest."""
    rates = jax.tree.map(jnp.zeros_like, position)
    if topology.balls:
        rates = Coordinates(jnp.zeros(topology.n_freedoms), rates.elastic)
    return State(position, rates)
