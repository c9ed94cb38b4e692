"""Joint loads in the dense equations of motion: what those of the recursive formulation are tested against.

Place in the pipeline: reference.formulation -> **reference.loads** -> reference.friction; slow, for tests.

The load of a joint of the tree follows from the rate of momentum of all bodies outboard of it, summed from the
transforms of `reference.formulation`, that of a cut joint from the derivatives of the closure equations by rigid
displacements of its bodies.  Redundant reactions are those of least norm over all joints (theory (5.19)).
"""

import jax
import jax.numpy as jnp
from jax import Array
from jax.flatten_util import ravel_pytree
from jaxtyping import Float

from rfem_jax.mechanics.algebra.vectors import Scalar, cross
from rfem_jax.mechanics.laws.friction_laws import Friction
from rfem_jax.mechanics.model.inputs import DriveInput, Stabilisation
from rfem_jax.mechanics.model.model import Coordinates, State
from rfem_jax.mechanics.model.topology import BASE, Topology
from rfem_jax.mechanics.model.with_errors import ModelWithErrors
from rfem_jax.mechanics.reference.formulation import open_multipliers, pseudo_inertias, reference_accelerations
from rfem_jax.mechanics.reference.node_transforms import joint_frames, joint_rows, transforms
from rfem_jax.mechanics.reference.work_of_elements import element_wrenches


def reference_reactions(
    actual: ModelWithErrors, state: State, drive: DriveInput, stabilisation: Stabilisation
) -> tuple[Coordinates, Float[Array, "6 joints"]]:
    """Second derivatives of the coordinates, and force [N] and moment [N m] of all joints, about the child's point and
    in its axes; of redundant reactions the least. Without friction."""
    accelerations, multipliers = reference_accelerations(actual, state, drive, stabilisation)
    still, unravel = ravel_pytree(jax.tree.map(jnp.zeros_like, state.velocity))
    frames = transforms(actual, state.position, unravel(still))
    length = jnp.ones(()) if actual.reaction_length is None else actual.reaction_length

    def loads_of(multipliers):
        wrenches = reference_wrenches(actual, state, drive, accelerations, multipliers, stabilisation.scale)
        parts = []
        for j, wrench in enumerate(wrenches):
            right = joint_frames(actual, frames, j)[1]
            moment = wrench[:3] - cross(right[:3, 3], wrench[3:])
            parts.append(jnp.concatenate([right[:3, :3].T @ wrench[3:], right[:3, :3].T @ moment / length]))
        return jnp.concatenate(parts)

    if actual.topology.minimum_norm:
        onto = open_multipliers(actual, state, stabilisation.scale)
        among = jax.jacfwd(loads_of)(multipliers) @ onto
        multipliers = multipliers - onto @ jnp.linalg.pinv(among, rtol=1e-9) @ loads_of(multipliers)
    loads = loads_of(multipliers).reshape(-1, 6).T
    return accelerations, jnp.concatenate([loads[:3], loads[3:] * length])


def reference_wrenches(
    actual: ModelWithErrors,
    state: State,
    drive: DriveInput,
    accelerations: Coordinates,
    multipliers: Float[Array, " constraints"],
    scale: Scalar,
    friction: Float[Array, " frictions"] | None = None,
) -> list[Float[Array, "6"]]:
    """Wrenches at the global origin that the parents of all joints exert on the children; `friction`: forces of all
    frictions, in the order of their names."""
    topology = actual.topology
    qdd, unravel = ravel_pytree(accelerations)
    qd, _ = ravel_pytree(state.velocity)
    still = jnp.zeros_like(qd)

    def matrices(q):
        return jnp.stack(transforms(actual, state.position, unravel(q)))

    def rate(q):
        return jax.jvp(matrices, (q,), (qd,))[1]

    frames = list(matrices(still))
    of_nodes = jax.jvp(matrices, (still,), (qdd,))[1] + jax.jvp(rate, (still,), (qd,))[1]
    of_nodes = of_nodes.at[:, :3, 3].add(-actual.gravity)
    change = jnp.einsum("nab,nbc,ndc->nad", of_nodes, pseudo_inertias(actual), jnp.stack(frames))
    laws = sorted((actual.friction or {}).items())
    forces = jnp.zeros(len(laws)) if friction is None else friction
    on_nodes = _cut_wrenches(actual, frames, multipliers, laws, forces, scale)
    others = [(node, w) for (_, node), w in on_nodes.items()]
    others += element_wrenches(actual, drive, jnp.stack(frames), rate(still))
    found = []
    for joint in range(topology.n_links):
        outboard = _outboard(topology, joint)
        total = jnp.sum(jnp.stack([change[k] for k in outboard]), axis=0)
        moment = jnp.stack([total[2, 1] - total[1, 2], total[0, 2] - total[2, 0], total[1, 0] - total[0, 1]])
        wrench = jnp.concatenate([moment, total[:3, 3]])
        found.append(wrench - sum((w for node, w in others if node in outboard), start=jnp.zeros(6)))
    return [*found, *(on_nodes[joint, topology.children[joint]] for joint in topology.cuts)]


def component_of(rate: Array, relative: Array, component: int) -> Array:
    """Rate of a displacement (component 0 to 2) or of a rotation (3 to 5) of a relative frame, about its parent's
    axes."""
    if component < 3:
        return rate[component, 3]
    i, j = (component - 3 + 2) % 3, (component - 3 + 1) % 3
    return (rate[:3, :3] @ relative[:3, :3].T)[i, j]


def _outboard(topology: Topology, link: int) -> list[int]:
    """Nodes of a link and of all links outboard of it."""
    links = [link]
    for l in range(link + 1, topology.n_links):
        parent = topology.parents[l]
        if parent != BASE and topology.link_of(parent) in links:
            links.append(l)
    return [k for k in range(topology.n_links + topology.n_rfes) if topology.link_of(k) in links]


def _displaced(frame: Array, twist: Array) -> Array:
    """A transform after a small rotation and displacement (6,) about the global origin."""
    x, y, z, u, v, w = twist
    zero = jnp.zeros(())
    rows = [[zero, -z, y, u], [z, zero, -x, v], [-y, x, zero, w], [zero, zero, zero, zero]]
    return frame + jnp.stack([jnp.stack(row) for row in rows]) @ frame


def _cut_wrenches(
    actual: ModelWithErrors,
    frames: list[Array],
    multipliers: Array,
    laws: list[tuple[str, Friction]],
    friction: Array,
    scale: Scalar,
) -> dict[tuple[int, int], Array]:
    """Wrenches (6,) at the global origin of multipliers and friction in the cut joints, by (joint, node)."""
    topology, wrenches = actual.topology, {}
    for joint, rows in zip(topology.cuts, topology.constraints, strict=True):
        frictions = [(law.component, friction[i]) for i, (_, law) in enumerate(laws) if law.joint == joint]

        def work(twist, moved, joint=joint, rows=rows, frictions=frictions):
            """Work [J] of all forces, held constant, over a small displacement of one node."""
            now = {node: frames[node] for node in {topology.parents[joint], topology.children[joint]} - {BASE}}
            left, right = joint_frames(actual, now, joint)
            at_rest = jnp.linalg.inv(left) @ right
            now[moved] = _displaced(now[moved], twist)
            left, right = joint_frames(actual, now, joint)
            relative = jnp.linalg.inv(left) @ right
            done = joint_rows(topology.kind(joint), left, right, scale) @ multipliers[rows.start : rows.stop]
            for component, force in frictions:
                done = done + force * component_of(relative - at_rest, at_rest, component)
            return done

        for node in {topology.parents[joint], topology.children[joint]} - {BASE}:
            wrenches[joint, node] = jax.grad(work)(jnp.zeros(6), node)
    return wrenches
