"""The equations of motion written literally: the formulation that every other one is tested against.

Place in the pipeline: beside `dynamics`; same inputs, same results, dense and slow.

Equation (15): A_jk = sum tr(dB/dq_j H dB/dq_k^T), h_j = sum tr(dB/dq_j H (d2B/dt2 at qdd = 0)^T) with
the transforms B(q) of all rfes differentiated automatically, and equation (20) as one dense
augmented system.  Nothing of the recursion is used: transforms, constraints (18) and the second
derivatives of both are formed here again, by 4 x 4 matrices and automatic differentiation.
"""

import jax
import jax.numpy as jnp
from jax import Array
from jax.flatten_util import ravel_pytree

from rfem_jax.mechanics import elasticity
from rfem_jax.mechanics.dynamics import DriveInput, Stabilisation
from rfem_jax.mechanics.model import BASE, Coordinates, State
from rfem_jax.mechanics.realisation import Realisation


def _transform(rotation, position):
    top = jnp.concatenate([rotation, position[:, None]], axis=1)
    return jnp.concatenate([top, jnp.array([[0.0, 0.0, 0.0, 1.0]])])


def _about(axis: int, angle):
    c, s = jnp.cos(angle), jnp.sin(angle)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    matrix = jnp.eye(3)
    return matrix.at[i, i].set(c).at[j, j].set(c).at[i, j].set(-s).at[j, i].set(s)


def transforms(realised: Realisation, position: Coordinates) -> list[Array]:
    """Transforms (4, 4) of all nodes to the global frame, in the order of the nodes."""
    topology = realised.topology
    seat = [_transform(realised.seat_rotation[:, :, j], realised.seat_position[:, j])
            for j in range(len(topology.joints))]
    bore = [_transform(realised.bore_rotation[:, :, j], realised.bore_position[:, j])
            for j in range(len(topology.joints))]
    frames = {BASE: jnp.eye(4)}
    for l, (a, b) in enumerate(topology.ranges):
        turn = _transform(_about(1, position.angles[l]), jnp.zeros(3))
        joint = frames[topology.parents[l]] @ seat[l] @ turn
        frames[l] = joint @ jnp.linalg.inv(bore[l])
        for k in range(a, b):
            x, y, z, phi_x, phi_y, phi_z = position.elastic[:, k]
            rotation = _about(2, phi_z) @ _about(1, phi_y) @ _about(0, phi_x)
            rest = jnp.array([1.0, 0.0, 0.0]) * realised.rest[k]
            relative = _transform(rotation, rest + jnp.stack([x, y, z]))
            frames[topology.n_links + k] = frames[l] @ relative
    return [frames[node] for node in range(topology.n_links + topology.n_rfes)]


def constraints(realised: Realisation, position: Coordinates, scale) -> Array:
    """Equation (18) for all cut joints (5 cuts,)."""
    topology = realised.topology
    frames = [*transforms(realised, position), jnp.eye(4)]
    rows = []
    for j in topology.cuts:
        left = frames[topology.parents[j]] @ _transform(
            realised.seat_rotation[:, :, j], realised.seat_position[:, j]
        )
        right = frames[topology.children[j]] @ _transform(
            realised.bore_rotation[:, :, j], realised.bore_position[:, j]
        )
        y = left[:3, 1]
        rows += [
            right[:3, 3] - left[:3, 3],
            scale * jnp.stack([y @ right[:3, 0], y @ right[:3, 2]]),
        ]
    return jnp.concatenate(rows) if rows else jnp.zeros(0)


def reference_accelerations(
    realised: Realisation, state: State, drive: DriveInput, stabilisation: Stabilisation
) -> tuple[Coordinates, Array]:
    """Second derivatives of the coordinates and multipliers from the dense augmented system."""
    topology = realised.topology
    q, unravel = ravel_pytree(state.position)
    qd, _ = ravel_pytree(state.velocity)
    pseudo_inertia = _pseudo_inertia(realised)

    def matrices(q):
        return jnp.stack(transforms(realised, unravel(q)))

    def rate(q):
        return jax.jvp(matrices, (q,), (qd,))[1]

    slopes = jax.jacfwd(matrices)(q)
    bias = jax.jvp(rate, (q,), (qd,))[1]
    mass = jnp.einsum("nabi,nbc,nacj->ij", slopes, pseudo_inertia, slopes)
    inertial = jnp.einsum("nabi,nbc,nac->i", slopes, pseudo_inertia, bias)

    def potential(q):
        weights = jnp.einsum("nabc,nc->nab", matrices(q)[:, :3, None, :], pseudo_inertia[:, :, 3])
        fall = -jnp.sum(weights[:, :, 0] @ realised.gravity)
        return fall + elasticity.elastic_energy(realised, unravel(q))

    def damping(qd):
        return 0.5 * elasticity.dissipated_power(realised, unravel(qd))

    force = -inertial - jax.grad(potential)(q) - jax.grad(damping)(qd)
    driven = topology.driven
    if drive.moment is not None:
        force = force.at[driven].add(drive.moment)

    def phi(q):
        return constraints(realised, unravel(q), stabilisation.scale)

    def phi_rate(q):
        return jax.jvp(phi, (q,), (qd,))[1]

    jacobian = jax.jacfwd(phi)(q)
    gamma = -jax.jvp(phi_rate, (q,), (qd,))[1]
    gamma = gamma - stabilisation.velocity_gain * phi_rate(q)
    gamma = gamma - stabilisation.position_gain * phi(q)
    if drive.turn is not None:
        jacobian = jnp.concatenate([jacobian, jnp.eye(q.size)[driven : driven + 1]])
        gamma = jnp.concatenate([gamma, jnp.reshape(drive.turn[2], (1,))])
    n, c = q.size, gamma.size
    system = jnp.block([[mass, -jacobian.T], [jacobian, jnp.zeros((c, c))]])
    solution = jnp.linalg.solve(system, jnp.concatenate([force, gamma]))
    return unravel(solution[:n]), solution[n : n + 5 * topology.n_cuts]


def _pseudo_inertia(realised: Realisation) -> Array:
    """H (nodes, 4, 4) of equation (15) about every node's reference point."""
    identity = jnp.eye(3)
    blocks = []
    for node in range(realised.mass.size):
        m, c = realised.mass[node], realised.centre[:, node]
        central = realised.inertia[:, :, node]
        second = 0.5 * jnp.trace(central) * identity - central + m * jnp.outer(c, c)
        top = jnp.concatenate([second, (m * c)[:, None]], axis=1)
        bottom = jnp.concatenate([m * c, m[None]])[None]
        blocks.append(jnp.concatenate([top, bottom]))
    return jnp.stack(blocks)
