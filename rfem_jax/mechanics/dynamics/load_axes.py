"""Joint loads in other axes than those of the joints: of the links on both sides, or global ones.

Place in the pipeline: kinematics, loads -> **load axes** -> simulation.

A load stays what the parent exerts on the child about the joint's centre; its components change. Source: theory (8.26).
"""

import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from rfem_jax.mechanics.algebra.vectors import apply, apply_transposed
from rfem_jax.mechanics.dynamics.loads import JointLoads
from rfem_jax.mechanics.kinematics.cut_joints import Closure
from rfem_jax.mechanics.kinematics.motion import Motion, all_frames
from rfem_jax.mechanics.model.topology import BASE, Topology

# What they are in words, as meanings of quantities have them.
AXES = {
    "joint": "frame H",
    "parent": "axes of the parent",
    "child": "axes of the child",
    "global": "global axes",
}


def turned_loads(topology: Topology, motion: Motion, cuts: Closure | None, joint: JointLoads, axes: str) -> JointLoads:
    """Loads of all joints, given in the joints' frames, in `axes`, a name of `AXES`. Those of a flexible link are the
    axes of the rigid finite element that the joint is on; those of the base are global."""
    if axes == "joint":
        return joint
    own = motion.hinges.rotation
    if cuts is not None:
        own = jnp.concatenate([own, cuts.rotation], axis=2)
    force, moment = apply(own, joint.force), apply(own, joint.moment)
    if axes == "global":
        return JointLoads(force, moment)
    rotation = _of_nodes(topology, motion, topology.parents if axes == "parent" else topology.children)
    return JointLoads(apply_transposed(rotation, force), apply_transposed(rotation, moment))


def _of_nodes(topology: Topology, motion: Motion, nodes: tuple[int, ...]) -> Float[Array, "3 3 joints"]:
    """Rotations of nodes, the base among them, in global axes."""
    of_all = all_frames(topology, motion)[0]
    of_base = jnp.asarray(np.eye(3))
    return jnp.stack([of_base if node == BASE else of_all[:, :, node] for node in nodes], axis=2)
