"""Whether the loads that friction depends on are unique where reactions are redundant.

Place in the pipeline: nominal_geometry, friction_laws -> **normal_loads** -> discretisation.

Reactions that keep each other in balance, which the equations of motion do not tell, are the null space of the
transposed Jacobian of the closure equations.  Friction needs that none of them presses its joint: in a planar linkage
of hinges all are forces along the axes and moments across them, so that friction may depend on the resultant across the
axis, but not on a bearing's length.
"""

import numpy as np
from jaxtyping import Float

from rfem_jax.description.basics.errors import InputError
from rfem_jax.mechanics.laws.friction_laws import Friction
from rfem_jax.mechanics.model.model import Model
from rfem_jax.mechanics.model.nominal_geometry import (
    NominalGeometry,
    Placed,
    closure_jacobian,
    closure_rows,
    geometry_of,
    null_space,
    place,
)
from rfem_jax.mechanics.model.topology import Topology

UNIQUE = 1e-7  # share of a reaction across an axis that counts as none


def require_unique_normal_loads(model: Model) -> None:
    """Raise InputError for friction that depends on a load that is not unique at the start."""
    loaded = {name: law for name, law in (model.friction or {}).items() if law.load is not None}
    if not loaded or model.topology.n_cuts == 0:
        return
    geometry = geometry_of(model)
    placed = place(geometry, np.asarray(model.start_joints))
    multipliers = null_space(closure_jacobian(geometry, placed, rigid=False).T)
    forces, moments = joint_wrenches(geometry, placed, multipliers)
    for force, moment in zip(np.moveaxis(forces, 2, 0), np.moveaxis(moments, 2, 0), strict=True):
        for name, law in loaded.items():
            if _pressing(placed, law, force[law.joint], moment[law.joint]) > UNIQUE:
                also = ", leave out `length`" if law.load is not None and law.load.length is not None else ""
                raise InputError(
                    f"Argument `coefficient` of force `{name}` must multiply a normal load that is unique, but "
                    f"reactions in joint `{model.topology.joints[law.joint]}` are redundant; make a link of the loop "
                    f"flexible{also}, or give the friction as `constant`."
                )


def joint_wrenches(
    geometry: NominalGeometry, placed: Placed, multipliers: Float[np.ndarray, "multipliers k"]
) -> tuple[Float[np.ndarray, "joints 3 k"], Float[np.ndarray, "joints 3 k"]]:
    """Forces, and moments about the joints' centres on the child over the longest link, that columns of multipliers
    alone exert in all joints."""
    topology, stop = geometry.topology, 0
    wrenches = np.zeros((len(topology.joints), 6, multipliers.shape[1]))
    sides = closure_rows(geometry, placed, rigid=False)
    for joint, (left, right) in zip(topology.cuts, sides, strict=True):
        start, stop = stop, stop + len(left)
        for node, on_side in ((topology.parents[joint], left), (topology.children[joint], right)):
            wrench = on_side.T @ multipliers[start:stop]
            if node == topology.children[joint]:
                wrenches[joint] += wrench
            for l in range(topology.n_links):
                if _is_outboard(topology, node, l):
                    wrenches[l] -= wrench
    moment = wrenches[:, :3] - np.cross(placed.child_centre[:, :, None], wrenches[:, 3:], axis=1)
    # Rows of forces are over the scale, those of moments are not.
    return wrenches[:, 3:] * geometry.scale, moment


def _pressing(placed: Placed, law: Friction, force: np.ndarray, moment: np.ndarray) -> float:
    """Largest part of redundant reactions that presses a joint, a force over the norm of the reactions."""
    axis = placed.joint_rotation[law.joint][:, law.axis]
    across = [force - axis * (axis @ force)]
    if law.load is not None and law.load.length is not None:
        across.append(np.cross(moment, axis))
    return max(float(np.linalg.norm(part)) for part in across)


def _is_outboard(topology: Topology, node: int, link: int) -> bool:
    """Whether a node is on a link or outboard of it."""
    return any(owner == link for _, owner in topology.to_base(node))
