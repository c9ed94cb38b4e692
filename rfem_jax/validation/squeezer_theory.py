"""Andrews' squeezing mechanism by Lagrange's equations of the first kind, from its points in the plane alone.

Place in the pipeline: serves `andrews_squeezer`. Energies and constraints are functions of the seven angles; JAX
differentiates them, and a dense system gives the accelerations and multipliers of a given state.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

Angles = Float[Array, "7"]  # beta, theta, gamma, phi, delta, omega, epsilon [rad]
Points = Float[Array, "points 2"]

BASES = {"K1": (0.0, 0.0), "K3": (-0.03635, 0.03273), "K5": (-0.06934, -0.00227), "K7": (-0.06934, -0.00227)}  # m
CARRIERS = {"K2": ("K1", (0.007, 0.0)), "K4": ("K5", (0.04, 0.0)), "K6": ("K7", (0.0, -0.04))}  # m
CENTRES = {
    "K1": (0.00092, 0.0), "K2": (-0.0115, 0.0), "K3": (0.01043, -0.01874), "K4": (0.0, 0.01421 - 0.02),
    "K5": (0.02308, 0.00916), "K6": (0.02 - 0.01421, 0.0), "K7": (-0.00449, -0.01228),
}  # fmt: skip # m, of mass, in the bodies' axes
ENDS = {"K2": (-0.028, 0.0), "K3": (0.0, -0.035), "K4": (0.0, -0.02), "K6": (0.02, 0.0)}  # m: P on these bodies
MASSES = (0.04325, 0.00365, 0.02373, 0.00706, 0.0705, 0.00706, 0.05498)  # kg
INERTIAS = (2.194e-6, 4.41e-7, 5.255e-6, 5.667e-7, 1.169e-5, 5.667e-7, 1.912e-5)  # kg m^2
SPRING = ((0.02, -0.018), (0.014, 0.072), 4530.0, 0.07785)  # point of K3, of the base [m]; N/m; length [m]
MOMENT = 0.033  # N m on K1


def _turned(angles: Angles) -> dict[str, Float[Array, ""]]:
    """Angle of every body in the plane [rad]."""
    beta, theta, gamma, phi, delta, omega, epsilon = angles
    turned = (beta, beta + theta, gamma, delta + phi, delta, epsilon + omega, epsilon)
    return {f"K{number}": angle for number, angle in enumerate(turned, 1)}


def _point(angles: Angles, body: str, point: tuple[float, float]) -> Float[Array, "2"]:
    """Place of a point of a body [m]."""
    turned = _turned(angles)[body]
    c, s = jnp.cos(turned), jnp.sin(turned)
    origin = _point(angles, *CARRIERS[body]) if body in CARRIERS else jnp.asarray(BASES[body])
    return origin + jnp.stack([c * point[0] - s * point[1], s * point[0] + c * point[1]])


def _kinetic(angles: Angles, rates: Angles) -> Float[Array, ""]:
    def places(angles):
        centres = jnp.stack([_point(angles, body, point) for body, point in CENTRES.items()])
        return centres, jnp.stack(list(_turned(angles).values()))

    _, (velocities, turning) = jax.jvp(places, (angles,), (rates,))
    return 0.5 * jnp.asarray(MASSES) @ jnp.sum(velocities**2, axis=1) + 0.5 * jnp.asarray(INERTIAS) @ turning**2


def _potential(angles: Angles) -> Float[Array, ""]:
    point, fixed, stiffness, free_length = SPRING
    length = jnp.linalg.norm(_point(angles, "K3", point) - jnp.asarray(fixed))
    return 0.5 * stiffness * (length - free_length) ** 2 - MOMENT * angles[0]


def _constraints(angles: Angles) -> Float[Array, "6"]:
    """What P on K2 is off P on K3, K4 and K6 [m]."""
    on = {body: _point(angles, body, point) for body, point in ENDS.items()}
    return jnp.concatenate([on["K2"] - on[body] for body in ("K3", "K4", "K6")])


def accelerations_and_forces(
    angles: Float[np.ndarray, "7"], rates: Float[np.ndarray, "7"]
) -> tuple[Float[np.ndarray, "7"], Float[np.ndarray, "3 2"]]:
    """Accelerations [rad/s^2], and forces on K3, K4 and K6 in P [N], of a closed state."""
    q, v = jnp.asarray(angles), jnp.asarray(rates)
    mass = jax.hessian(_kinetic, argnums=1)(q, v)
    momentum_rate = jax.jvp(lambda q: jax.grad(_kinetic, argnums=1)(q, v), (q,), (v,))[1]
    force = jax.grad(_kinetic)(q, v) - momentum_rate - jax.grad(_potential)(q)
    jacobian = jax.jacobian(_constraints)(q)
    bias = jax.jvp(lambda q: jax.jvp(_constraints, (q,), (v,))[1], (q,), (v,))[1]
    system = np.block([[np.asarray(mass), np.asarray(jacobian).T], [np.asarray(jacobian), np.zeros((6, 6))]])
    solved = np.linalg.solve(system, np.concatenate([force, -bias]))
    return solved[:7], solved[7:].reshape(3, 2)
