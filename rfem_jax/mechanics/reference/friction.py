"""Friction in the dense equations of motion: what friction in the recursive formulation is tested against.

Place in the pipeline: reference.loads -> **reference.friction**; slow, for tests.

As normal loads (`reference.loads`) depend on the friction, the two are found by turns.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import Array
from jax.flatten_util import ravel_pytree
from jaxtyping import Float

from rfem_jax.mechanics.algebra.vectors import Scalar, cross
from rfem_jax.mechanics.laws.friction_laws import Friction
from rfem_jax.mechanics.model.inputs import DriveInput, Stabilisation
from rfem_jax.mechanics.model.model import Coordinates, State
from rfem_jax.mechanics.model.with_errors import ModelWithErrors
from rfem_jax.mechanics.reference.formulation import reference_accelerations
from rfem_jax.mechanics.reference.loads import component_of, reference_wrenches
from rfem_jax.mechanics.reference.node_transforms import joint_frames, transforms

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
            found.append(component_of(rate[i], at[i], law.component))
    return jnp.stack(found)


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
    still, unravel = ravel_pytree(jax.tree.map(jnp.zeros_like, state.velocity))
    frames = transforms(actual, state.position, unravel(still))
    wrenches = reference_wrenches(actual, state, drive, accelerations, multipliers, scale, friction)
    found = []
    for _, law in sorted((actual.friction or {}).items()):
        if law.load is None:
            found.append(jnp.zeros(()))
            continue
        left, right = joint_frames(actual, frames, law.joint)
        moment, force = wrenches[law.joint][:3], wrenches[law.joint][3:]
        moment = moment - cross(right[:3, 3], force)
        found.append(law.load.size(force, moment, left[:3, law.axis]))
    return jnp.stack(found)
