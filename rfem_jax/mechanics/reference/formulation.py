"""The equations of motion as the paper writes them, dense: what the recursive formulation is tested against.

Place in the pipeline: an alternative to `dynamics`; same inputs, same results, slow.

Theory (3.2): A_jk = sum tr(dB/dq_j H dB/dq_k^T), h_j = sum tr(dB/dq_j H (d2B/dt2 at qdd = 0)^T) with
the transforms B(q) of all rfes differentiated automatically, and theory (3.3), (3.4) as one dense
augmented system.  Nothing of the recursion is used: transforms, constraints, theory (5.1), and the second
derivatives of both are formed independently, by 4 x 4 matrices and automatic differentiation.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.flatten_util import ravel_pytree
from jaxtyping import Float

from rfem_jax.mechanics.algebra.vectors import Scalar, pseudo_inverse
from rfem_jax.mechanics.elements import elasticity
from rfem_jax.mechanics.model.inputs import DriveInput, Stabilisation
from rfem_jax.mechanics.model.model import Coordinates, State
from rfem_jax.mechanics.model.topology import Topology
from rfem_jax.mechanics.model.with_errors import ModelWithErrors
from rfem_jax.mechanics.reference.face_deflections import exact_deflections
from rfem_jax.mechanics.reference.node_transforms import changed, constraints, slender_place, transforms
from rfem_jax.mechanics.reference.work_of_elements import element_forces
from rfem_jax.mechanics.reference.work_of_joints import joint_coordinate_forces

OPEN = 1e-7  # of singular values: of combinations of closure equations that say nothing


def _work(actual: ModelWithErrors, strain: Array) -> Array:
    """Sum over the sdes of a strain times its stress."""
    if actual.topology.shaped:
        return jnp.einsum("ak,abk,bk->k", strain, actual.stiffness, strain)
    return actual.stiffness * strain**2


def reference_accelerations(
    actual: ModelWithErrors,
    state: State,
    drive: DriveInput,
    stabilisation: Stabilisation,
    applied: Float[Array, " coordinates"] | None = None,
) -> tuple[Coordinates, Float[Array, " constraints"]]:
    """Second derivatives of the coordinates, and multipliers [N] without those of springs, from the dense system;
    `applied`: more forces, flat."""
    topology = actual.topology
    qd, unravel = ravel_pytree(state.velocity)
    # Changes from the present position are coordinates of which there are as many as rates.
    q = jnp.zeros_like(qd)
    pseudo_inertia = pseudo_inertias(actual)

    # Jitted: traced once for all derivatives.
    @jax.jit
    def matrices(q):
        return jnp.stack(transforms(actual, state.position, unravel(q)))

    def rate(q):
        return jax.jvp(matrices, (q,), (qd,))[1]

    derivatives = jax.jacfwd(matrices)(q)
    bias = jax.jvp(rate, (q,), (qd,))[1]
    mass = jnp.einsum("nabi,nbc,nacj->ij", derivatives, pseudo_inertia, derivatives) + _without_effect(topology)
    inertial = jnp.einsum("nabi,nbc,nac->i", derivatives, pseudo_inertia, bias)

    def potential(frames, q):
        weights = jnp.einsum("nabc,nc->nab", frames[:, :3, None, :], pseudo_inertia[:, :, 3])
        of_gravity = -jnp.sum(weights[:, :, 0] @ actual.gravity)
        if topology.exact:
            stretch = exact_deflections(actual, frames)
            return of_gravity + 0.5 * jnp.sum(_work(actual, stretch))
        return of_gravity + elasticity.elastic_energy(actual, changed(topology, state.position, unravel(q)))

    def rayleigh(qd):
        """Rayleigh's dissipation function: half the power that the dampers dissipate."""
        if topology.exact:
            frame_rates = jnp.einsum("nabi,i->nab", derivatives, qd)
            faces = partial(exact_deflections, actual)
            rate = jax.jvp(faces, (matrices(q),), (frame_rates,))[1]
            return 0.5 * jnp.sum(_work(actual, jnp.sqrt(actual.damping)[None] * rate))
        return 0.5 * elasticity.dissipated_power(actual, State(state.position, unravel(qd)))

    by_frames, directly = jax.grad(potential, (0, 1))(matrices(q), q)
    force = -inertial - jnp.einsum("nab,nabi->i", by_frames, derivatives) - directly - jax.grad(rayleigh)(qd)
    force = force + joint_coordinate_forces(actual, state, drive, unravel) + (0.0 if applied is None else applied)
    force = force + element_forces(actual, drive, matrices(q), derivatives, qd)

    phi = jax.jit(lambda q: constraints(actual, state.position, stabilisation.scale, unravel(q)))

    def phi_rate(q):
        return jax.jvp(phi, (q,), (qd,))[1]

    jacobian = jax.jacfwd(phi)(q)
    gamma = -jax.jvp(phi_rate, (q,), (qd,))[1]
    gamma = gamma - stabilisation.velocity_gain * phi_rate(q) - stabilisation.position_gain * phi(q)
    found, multipliers = _solve_augmented(mass, jacobian, force, gamma, drive, topology.minimum_norm)
    return _displaced(actual, state, unravel(found)), multipliers[: topology.n_constraints - sum(topology.sprung_rows)]


def _solve_augmented(
    mass: Array, jacobian: Array, force: Array, gamma: Array, drive: DriveInput, least: bool
) -> tuple[Array, Array]:
    """Accelerations and multipliers [N], those of prescribed motions last; `least`: where these are not unique, of
    least norm."""
    for k, (_, _, acceleration) in drive.motions.items():
        jacobian = jnp.concatenate([jacobian, jnp.eye(force.size)[k : k + 1]])
        gamma = jnp.concatenate([gamma, jnp.reshape(acceleration, (1,))])
    n, c = force.size, gamma.size
    corner = jnp.zeros((c, c))
    if least:
        corner = _open_rows(jacobian)
        gamma = gamma - corner @ gamma
    system = jnp.block([[mass, -jacobian.T], [jacobian, corner]])
    solution = jnp.linalg.solve(system, jnp.concatenate([force, gamma]))
    return solution[:n], solution[n:]


def _displaced(actual: ModelWithErrors, state: State, accelerations: Coordinates) -> Coordinates:
    """Second derivatives of the coordinates with those of displacements in slender links."""
    if not actual.topology.slender:
        return accelerations

    def place(values: Array) -> Array:
        at = Coordinates(state.position.joints, values)
        slender = np.flatnonzero(actual.topology.slender_rfes)
        return values.at[:3, slender].set(jnp.stack([slender_place(actual, at, k) for k in slender.tolist()], axis=1))

    values, rates = state.position.elastic, state.velocity.elastic
    bias = jax.jvp(lambda values: jax.jvp(place, (values,), (rates,))[1], (values,), (rates,))[1]
    return Coordinates(accelerations.joints, jax.jvp(place, (values,), (accelerations.elastic,))[1] + bias)


def _without_effect(topology: Topology) -> Float[Array, "n n"]:
    """Unit masses of displacements in slender links, which are no coordinates and stay without forces."""
    displacements = np.concatenate([np.tile(topology.slender_rfes, (3, 1)), np.zeros((3, topology.n_rfes))])
    return jnp.diag(ravel_pytree(Coordinates(jnp.zeros(topology.n_freedoms), jnp.asarray(displacements)))[0])


def open_multipliers(actual: ModelWithErrors, state: State, scale: Scalar) -> Float[Array, "constraints constraints"]:
    """Projector onto the multipliers that do no work on any motion of the tree."""
    still, unravel = ravel_pytree(jax.tree.map(jnp.zeros_like, state.velocity))
    return _open_rows(jax.jacfwd(lambda q: constraints(actual, state.position, scale, unravel(q)))(still))


def _open_rows(jacobian: Array) -> Array:
    """Projector onto combinations of rows that vanish."""
    return jnp.eye(jacobian.shape[0]) - jacobian @ pseudo_inverse(jacobian, OPEN)


def pseudo_inertias(actual: ModelWithErrors) -> Array:
    """H (nodes, 4, 4) of theory (3.1) about every node's reference point."""
    identity = jnp.eye(3)
    blocks = []
    for node in range(actual.mass.size):
        m, c = actual.mass[node], actual.centre[:, node]
        central = actual.inertia[:, :, node]
        second = 0.5 * jnp.trace(central) * identity - central + m * jnp.outer(c, c)
        top = jnp.concatenate([second, (m * c)[:, None]], axis=1)
        bottom = jnp.concatenate([m * c, m[None]])[None]
        blocks.append(jnp.concatenate([top, bottom]))
    return jnp.stack(blocks)
