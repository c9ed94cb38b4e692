"""Friction in the dense equations of motion: what friction in the recursive formulation is tested against.

Place in the pipeline: reference_formulation -> **reference_friction**; slow, for tests.

The normal loads follow from the rate of momentum of all bodies outboard of a joint, summed from the transforms of
`reference_formulation`, and from the derivatives of the closure equations by rigid displacements of its bodies.  As
they depend on the friction, the two are found by turns.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import Array
from jax.flatten_util import ravel_pytree
from jaxtyping import Float

from rfem_jax.mechanics.algebra import Scalar, cross
from rfem_jax.mechanics.friction_laws import Friction
from rfem_jax.mechanics.inputs import DriveInput, Stabilisation
from rfem_jax.mechanics.model import BASE, Coordinates, State, Topology
from rfem_jax.mechanics.model_with_errors import ModelWithErrors
from rfem_jax.mechanics.reference_formulation import (
    element_wrenches,
    joint_frames,
    joint_rows,
    pseudo_inertias,
    reference_accelerations,
    transforms,
)

Rates = Callable[[Array], Array]


def reference_with_friction(
    actual: ModelWithErrors, state: State, drive: DriveInput, stabilisation: Stabilisation, rounds: int = 60
) -> tuple[Coordinates, Float[Array, " constraints"], dict[str, Float[Array, ""]]]:
    """`reference_accelerations` with friction, whose forces [N, N m] come last; `rounds`: of friction and loads."""
    laws = sorted((actual.friction or {}).items())
    qd, unravel = ravel_pytree(state.velocity)
    rates, rows = jax.linearize(lambda qd: _rates(actual, state, unravel(qd), laws), qd)
    matrix = jax.vmap(rows, out_axes=1)(jnp.eye(qd.size))

    def forces_under(normal):
        return jnp.stack([law.force(0.0, rates[i], normal[i]) for i, (_, law) in enumerate(laws)])

    def improve(carry, _):
        friction, *_ = carry
        found = reference_accelerations(actual, state, drive, stabilisation, matrix.T @ friction)
        return (forces_under(_normal_loads(actual, state, drive, *found, friction, stabilisation.scale)), *found), None

    unsolved = jax.tree.map(jnp.zeros_like, state.velocity), jnp.zeros(actual.topology.n_constraints)
    first = (forces_under(jnp.zeros(len(laws))), *unsolved)
    (friction, found, multipliers), _ = jax.lax.scan(improve, first, length=rounds)
    return found, multipliers, {name: friction[i] for i, (name, _) in enumerate(laws)}


def _rates(actual: ModelWithErrors, state: State, velocity: Coordinates, laws: list[tuple[str, Friction]]) -> Array:
    """Rates of the motions that have friction."""
    still, unravel = ravel_pytree(jax.tree.map(jnp.zeros_like, velocity))
    along, _ = ravel_pytree(velocity)

    def relative(q):
        frames = transforms(actual, state.position, unravel(q))
        return [jnp.linalg.inv(left) @ right for left, right in (joint_frames(actual, frames, j) for j in cuts)]

    cuts = actual.topology.cuts
    at, rate = jax.jvp(relative, (still,), (along,))
    found = []
    for _, law in laws:
        if law.coordinate is not None:
            found.append(velocity.joints[law.coordinate])
        else:
            i = law.joint - actual.topology.n_links
            found.append(_component(rate[i], at[i], law.component))
    return jnp.stack(found)


def _component(rate: Array, relative: Array, component: int) -> Array:
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


def _normal_loads(
    actual: ModelWithErrors,
    state: State,
    drive: DriveInput,
    accelerations: Coordinates,
    multipliers: Array,
    friction: Array,
    scale: Scalar,
) -> Array:
    """Normal loads [N] of all frictions, zero of those that do not depend on them."""
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
    on_nodes = _cut_wrenches(actual, frames, multipliers, laws, friction, scale)
    of_elements = element_wrenches(actual, drive, jnp.stack(frames), rate(still))
    found = []
    for _, law in laws:
        left, right = joint_frames(actual, frames, law.joint)
        if law.load is None:
            found.append(jnp.zeros(()))
            continue
        if law.coordinate is None:
            wrench = on_nodes[law.joint, topology.children[law.joint]]
        else:
            outboard = _outboard(topology, law.joint)
            total = jnp.sum(jnp.stack([change[k] for k in outboard]), axis=0)
            moment = jnp.stack([total[2, 1] - total[1, 2], total[0, 2] - total[2, 0], total[1, 0] - total[0, 1]])
            wrench = jnp.concatenate([moment, total[:3, 3]])
            others = [(node, w) for (_, node), w in on_nodes.items()] + of_elements
            wrench = wrench - sum((w for node, w in others if node in outboard), start=jnp.zeros(6))
        moment = wrench[:3] - cross(right[:3, 3], wrench[3:])
        found.append(law.load.size(wrench[3:], moment, left[:3, law.axis]))
    return jnp.stack(found)


def _cut_wrenches(
    actual: ModelWithErrors,
    frames: list[Array],
    multipliers: Array,
    laws: list[tuple[str, Friction]],
    friction: Array,
    scale: Scalar,
) -> dict[tuple[int, int], Array]:
    """Wrenches (6,) at the global origin of multipliers and friction in the cut joints, by (joint, node)."""
    topology, found = actual.topology, {}
    for joint, rows in zip(topology.cuts, topology.constraints, strict=True):
        frictions = [(law.component, friction[i]) for i, (_, law) in enumerate(laws) if law.joint == joint]

        def work(twist, moved, joint=joint, rows=rows, frictions=frictions):
            """Of a small displacement of one node, all forces as they are."""
            now = {node: frames[node] for node in {topology.parents[joint], topology.children[joint]} - {BASE}}
            left, right = joint_frames(actual, now, joint)
            at_rest = jnp.linalg.inv(left) @ right
            now[moved] = _displaced(now[moved], twist)
            left, right = joint_frames(actual, now, joint)
            relative = jnp.linalg.inv(left) @ right
            done = joint_rows(topology.kind(joint), left, right, scale) @ multipliers[rows.start : rows.stop]
            for component, force in frictions:
                done = done + force * _component(relative - at_rest, at_rest, component)
            return done

        for node in {topology.parents[joint], topology.children[joint]} - {BASE}:
            found[joint, node] = jax.grad(work)(jnp.zeros(6), node)
    return found
