"""The articulated-body algorithm on the reduced tree, for the applied loads and unit multipliers at once.

Place in the pipeline: reduced_tree, slender_chains -> **tree_recursion** -> closing_multipliers, dynamics.

Theory (4.4) to (4.10); R. Featherstone, Rigid Body Dynamics Algorithms (2008), ch. 7.  Columns of loads and of
accelerations are spatial vectors at the points of the islands: the first belongs to the applied loads, the others to
the multipliers of the cut joints.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from rfem_jax.mechanics.algebra import vectors
from rfem_jax.mechanics.algebra.vectors import apply, dot, product
from rfem_jax.mechanics.dynamics.reduced_tree import InterfaceTree, branching_rfes, wrench_at
from rfem_jax.mechanics.dynamics.slender_chains import Chain, Eliminated, inboard, on_interface, outboard
from rfem_jax.mechanics.kinematics.cut_joints import Closure, unit_columns
from rfem_jax.mechanics.model.inputs import DriveInput
from rfem_jax.mechanics.model.topology import BASE, Topology


def load_columns(
    topology: Topology, cuts: Closure | None, tree: InterfaceTree, in_cuts: dict[int, Array]
) -> dict[int, Array]:
    """Columns (6, K) of loads on the bodies of the reduced tree: the applied loads, then, in islands that a
    cut joint acts on, unit multipliers; on interfaces of slender links those of cut joints alone, with `in_cuts`."""
    sides = topology.parents[topology.n_links :] + topology.children[topology.n_links :]
    closed = {topology.island_of(node) for node in sides if node != BASE}
    closed |= {topology.island_of(topology.link_of_freedom[k]) for k in joint_columns(topology, cuts)}
    loads = {}
    for i, node in enumerate((*range(topology.n_links), *branching_rfes(topology))):
        loads[node] = tree.load[:, None, i]
        if cuts is not None and topology.island_of(node) in closed:
            unit = unit_columns(topology, cuts, node, tree.point[:, i])
            loads[node] = jnp.concatenate([loads[node], unit], axis=1)
    for node in (topology.n_links + k for k in topology.interfaces if topology.is_slender(topology.n_links + k)):
        point = tree.point[:, topology.link_of(node)]
        load = wrench_at(in_cuts[node], point) if node in in_cuts else jnp.zeros(6)
        loads[node] = load[:, None]
        if cuts is not None and topology.island_of(node) in closed:
            loads[node] = jnp.concatenate([loads[node], unit_columns(topology, cuts, node, point)], axis=1)
    return loads


def joint_columns(topology: Topology, cuts: Closure | None) -> dict[int, Float[Array, " columns"]]:
    """By joint coordinate that an ideal coupling acts along: its load of every column, which are the applied loads and
    unit multipliers."""
    if cuts is None or cuts.couplings is None:
        return {}
    along = cuts.couplings.along
    before = jnp.zeros(1 + topology.n_constraints - along.shape[1])
    return {k: jnp.concatenate([before, along[k]]) for k in topology.coupled}


def articulated_bodies(
    topology: Topology,
    tree: InterfaceTree,
    chains: dict[int, Chain],
    loads: dict[int, Array],
    drive: DriveInput,
    forces: dict[int, Array],
    along: dict[int, Array],
) -> tuple[dict[int, Array], list[Array], dict[int, tuple[Eliminated, Array]]]:
    """Featherstone's articulated-body algorithm for K columns of loads at once: accelerations (6, K) of the
    bodies and (K,) of the joint coordinates, and of chains what remains of them with accelerations (m, 6, K) of their
    rfes; `forces`: along joint coordinates; `along`: as of `joint_columns`.

    The coordinates of a joint are eliminated one after another, as if bodies without mass were between them, which
    is the Cholesky factorisation of the joint's own matrix (theory (4.10)).
    """
    with jax.named_scope("articulated_bodies"):
        columns = tree.inertia.shape[2]
        inertias = {node: tree.inertia[:, :, i] for i, node in enumerate(loads) if i < columns}
        loads, steps, accelerations, remaining = dict(loads), {}, {}, {}
        for l in reversed(range(topology.n_links)):
            node, inertia, load = topology.parents[l], inertias[l], loads[l]
            # Bias accelerations and drives belong to the applied loads, not to the unit multipliers.
            first = jnp.asarray(np.eye(1, load.shape[1])[0])
            if l in chains:
                remaining[l], more, passed = inboard(chains[l], inertias, loads, first)
                inertia, load = inertia + more, load + passed
            for k in reversed(topology.coordinates[l]):
                axis, bias = tree.axis[:, k], tree.bias[:, k]
                if k in drive.motions:
                    acceleration = drive.motions[k][2]
                    given = vectors.scaled(acceleration, axis) + bias
                    steps[k] = (axis, given[:, None] * first[None], acceleration[None] * first, None)
                    load = load - apply(inertia, given)[:, None] * first[None]
                    continue
                u = apply(inertia, axis)
                by_inertia = u / dot(axis, u)[None]
                torque = dot(axis[:, None], load)
                force = forces.get(k)
                if force is not None:
                    torque = torque + force[None] * first
                if k in along:
                    torque = torque + along[k]
                steps[k] = (axis, bias[:, None] * first[None], torque / dot(axis, u)[None], by_inertia)
                inertia = inertia - u[:, None] * by_inertia[None]
                load = load - apply(inertia, bias)[:, None] * first[None] - by_inertia[:, None] * torque[None]
            if node != BASE:
                inertias[node] = inertias[node] + inertia if node in inertias else inertia
                loads[node] = loads[node] + load
        for node in branching_rfes(topology):
            inverse = vectors.invert_positive(inertias[node])
            accelerations[node] = product(inverse, loads[node])
        return _outward(topology, chains, remaining, loads, steps, accelerations)


def _outward(
    topology: Topology,
    chains: dict[int, Chain],
    remaining: dict[int, Eliminated],
    loads: dict[int, Array],
    steps: dict[int, tuple[Array, Array, Array, Array | None]],
    accelerations: dict[int, Array],
) -> tuple[dict[int, Array], list[Array], dict[int, tuple[Eliminated, Array]]]:
    """The results of `articulated_bodies` from the base to the tips, from what the sweep to the base left;
    `accelerations`: of bodies that nothing holds."""
    rates, swept = [], {}
    for l in range(topology.n_links):
        acceleration = accelerations.get(topology.parents[l])
        for k in topology.coordinates[l]:
            axis, given, rate, by_inertia = steps[k]
            acceleration = given if acceleration is None else given + acceleration
            if by_inertia is not None:
                rate = rate - dot(by_inertia[:, None], acceleration)
                acceleration = acceleration + axis[:, None] * rate[None]
            rates.append(rate)
        accelerations[l] = jnp.zeros_like(loads[l]) if acceleration is None else acceleration
        if l in chains:
            first = jnp.asarray(np.eye(1, loads[l].shape[1])[0])
            swept[l] = remaining[l], outboard(chains[l], remaining[l], accelerations[l], first)
            for node, place in chains[l].interfaces.items():
                accelerations[node] = on_interface(chains[l], place, swept[l][1])
    return accelerations, rates, swept
