"""The equations of motion written literally: the formulation that every other one is tested against.

Place in the pipeline: beside `dynamics`; same inputs, same results, dense and slow.

Theory (3.2): A_jk = sum tr(dB/dq_j H dB/dq_k^T), h_j = sum tr(dB/dq_j H (d2B/dt2 at qdd = 0)^T) with
the transforms B(q) of all rfes differentiated automatically, and theory (3.3), (3.4) as one dense
augmented system.  Nothing of the recursion is used: transforms, constraints, theory (5.1), and the second
derivatives of both are formed here again, by 4 x 4 matrices and automatic differentiation.
"""

from functools import partial

import jax
import jax.numpy as jnp
from jax import Array
from jax.flatten_util import ravel_pytree

from rfem_jax.mechanics import elasticity
from rfem_jax.mechanics.inputs import DriveInput, Stabilisation
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
            outer = _about(2, phi_z) @ _about(1, phi_y)
            if topology.exact:
                outer = _about(1, phi_y) @ _about(2, phi_z)
            rotation = outer @ _about(0, phi_x)
            rest = jnp.array([1.0, 0.0, 0.0]) * realised.rest[k]
            relative = _transform(rotation, rest + jnp.stack([x, y, z]))
            frames[topology.n_links + k] = frames[l] @ relative
    return [frames[node] for node in range(topology.n_links + topology.n_rfes)]


def constraints(realised: Realisation, position: Coordinates, scale) -> Array:
    """Theory (5.1) for all cut joints (5 cuts,)."""
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


def exact_deflections(realised: Realisation, frames: Array) -> Array:
    """(du, theta) (6, N) of geometrically exact sdes from the transforms (nodes, 4, 4) of all nodes:
    of the two faces of every sde."""
    topology = realised.topology
    if topology.n_rfes == 0:
        return jnp.zeros((6, 0))
    left, right, left_face, right_face = [], [], [], []
    for l, (a, b) in enumerate(topology.ranges):
        for k in range(a, b):
            right.append(topology.n_links + k)
            right_face.append(_along(realised.lever_right[k]))
            # rfe 0 is its link's frame: its face is where the sde is at rest.
            left.append(l if k == a else topology.n_links + k - 1)
            at_rest = realised.rest[k] + realised.lever_right[k]
            left_face.append(_along(at_rest if k == a else realised.lever_left[k]))
    left = frames[jnp.array(left)] @ jnp.stack(left_face)
    right = frames[jnp.array(right)] @ jnp.stack(right_face)
    return jax.vmap(_deflection, out_axes=1)(left, right)


def _along(x):
    return _transform(jnp.eye(3), jnp.array([1.0, 0.0, 0.0]) * x)


def _deflection(left, right):
    """(du, theta) (6,) of two faces: the logarithm of the relative rotation by its angle, the gap in
    the frame half-way between them."""
    turn = left[:3, :3].T @ right[:3, :3]
    skew = 0.5 * (turn - turn.T)
    sine_axis = jnp.stack([skew[2, 1], skew[0, 2], skew[1, 0]])
    square = sine_axis @ sine_axis
    still = square < 1e-30
    sine = jnp.sqrt(jnp.where(still, 1.0, square))
    angle = jnp.where(still, 1.0, jnp.arctan2(sine, 0.5 * (jnp.trace(turn) - 1.0)))
    theta = sine_axis * jnp.where(still, 1.0, angle / sine)
    # Rodrigues' formula for minus half the angle.
    unit = skew / sine
    back = -jnp.sin(0.5 * angle) * unit + (1.0 - jnp.cos(0.5 * angle)) * unit @ unit
    gap = left[:3, :3].T @ (right[:3, 3] - left[:3, 3])
    return jnp.concatenate([gap + back @ gap, theta])


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
        frames = matrices(q)
        weights = jnp.einsum("nabc,nc->nab", frames[:, :3, None, :], pseudo_inertia[:, :, 3])
        fall = -jnp.sum(weights[:, :, 0] @ realised.gravity)
        if topology.exact:
            stretch = exact_deflections(realised, frames)
            return fall + 0.5 * jnp.sum(realised.stiffness * stretch**2)
        return fall + elasticity.elastic_energy(realised, unravel(q))

    def damping(qd):
        """Half the power that the dampers take out."""
        if topology.exact:
            frame_rates = jnp.einsum("nabi,i->nab", slopes, qd)
            faces = partial(exact_deflections, realised)
            rate = jax.jvp(faces, (matrices(q),), (frame_rates,))[1]
            return 0.5 * jnp.sum(realised.stiffness * realised.damping[None] * rate**2)
        now = State(state.position, unravel(qd))
        return 0.5 * elasticity.dissipated_power(realised, now)

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
    """H (nodes, 4, 4) of theory (3.1) about every node's reference point."""
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
