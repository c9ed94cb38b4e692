"""Which joint coordinates stand for the freedoms that no drive holds: those at which a simulation starts as given.

Place in the pipeline: nominal_geometry -> **start_freedoms** -> discretisation.

With all links and joints rigid the closure equations Phi leave a mechanism the motions of the null space N of their
Jacobian (theory (6.9)). Coordinates whose rows of N are independent determine its configuration. Those of drives come
first, then those of initial rates and of idle freedoms; the others are chosen one after another, each the first in the
order of the description that moves at least `SHARE` as much as the one that moves most, when those chosen before stand
still: the choice does not depend on names, and is never ill-conditioned where it can be a good one. Springs on free
motions of joints, and between points, hold nothing here; directions that a joint's kind holds and that are sprung or
have play are no freedoms, but settle.
"""

from collections.abc import Iterable

import numpy as np
from jaxtyping import Bool, Float

from rfem_jax.description.basics.errors import InputError
from rfem_jax.mechanics.model.model import Model
from rfem_jax.mechanics.model.nominal_geometry import closure_jacobian, geometry_of, null_space, place
from rfem_jax.mechanics.model.topology import Topology

SHARE = 0.2
DEPENDENT = 1e-6  # a motion of one of size one


def with_start_freedoms(model: Model, rates: dict[int, str]) -> Topology:
    """The topology with the coordinates for the freedoms that no drive holds, and those whose initial rates count.

    **Arguments:** `rates`: coordinate -> name of the argument, as "`rate` of joint `A`", of the initial rates given.

    **Raises:** `InputError` for an initial rate of a coordinate that follows from others.
    """
    topology = model.topology
    motions = _motions(model)
    rated, undriven = [], []
    for k in topology.held:
        motions = _hold_coordinate(motions, k)
        if k in rates:
            rated.append(k)
    for k in (k for k in rates if k not in rated):
        if not np.linalg.norm(motions[k]) > DEPENDENT:
            raise _dependent(topology, rates[k], (*topology.held, *undriven))
        motions = _hold_coordinate(motions, k)
        undriven.append(k)
        rated.append(k)
    idle = []
    for k in topology.idle:
        # Where a rate is given of the same freedom, its coordinate stands for it.
        same = [one for one in undriven if topology.link_of_freedom[one] == topology.link_of_freedom[k]]
        if np.linalg.norm(motions[k]) > DEPENDENT or not same:
            motions = _hold_coordinate(motions, k)
            undriven.append(k)
            same = [k]
        idle.append(same[0])
    order = _file_order(topology)
    while (sizes := np.linalg.norm(motions, axis=1)).max(initial=0.0) > DEPENDENT:
        k = next(k for k in order if sizes[k] >= SHARE * sizes[order].max())
        motions = _hold_coordinate(motions, k)
        undriven.append(k)
    return topology._replace(undriven=tuple(undriven), rated=tuple(sorted(rated)), idle=tuple(idle))


def _motions(model: Model) -> Float[np.ndarray, "freedoms motions"]:
    """Orthonormal motions of the rigid mechanism at its start, by all coordinates of the tree joints: radians, or
    lengths over the longest link."""
    topology, geometry = model.topology, geometry_of(model)
    own = _own(topology)
    jacobian = closure_jacobian(geometry, place(geometry, np.asarray(model.start_joints)))[:, np.flatnonzero(own)]
    found = np.zeros((topology.n_freedoms, int(own.sum())))
    found[own] = np.eye(int(own.sum()))
    return found @ null_space(jacobian)


def _own(topology: Topology) -> Bool[np.ndarray, " freedoms"]:
    """For every coordinate whether it is a joint's own, and not that of a spring."""
    own = np.ones(topology.n_freedoms, dtype=bool)
    own[list(topology.sprung_coordinates)] = False
    return own


def _hold_coordinate(motions: Float[np.ndarray, "freedoms motions"], k: int) -> Float[np.ndarray, "freedoms motions"]:
    """Motions that remain possible when a coordinate is held."""
    size = np.linalg.norm(motions[k])
    if not size > 0.0:
        return motions
    direction = motions[k] / size
    return motions - np.outer(motions @ direction, direction)


def _file_order(topology: Topology) -> list[int]:
    """The coordinates of the tree joints that are no springs, in the order of the description."""
    tree = topology.joints[: topology.n_links]
    joints = [tree.index(name) for name in topology.joint_order if name in tree]
    return [k for joint in joints for k in topology.own_coordinates[joint]]


def _dependent(topology: Topology, argument: str, chosen: Iterable[int]) -> InputError:
    others = [topology.label_of(k) for k in chosen]
    reason, fix = "is of a joint that cannot move so at its start", "leave it out."
    if others:
        reason = f"follows from {', '.join(f'`{one}`' for one in others)}"
        fix = "leave it out, or give the rate of a joint that it follows from."
    return InputError(f"Argument {argument} must be of a motion that can be chosen, but {reason}; {fix}")
