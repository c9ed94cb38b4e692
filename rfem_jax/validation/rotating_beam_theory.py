"""Lag of a beam behind the hub that rotates it: linear theory with geometric stiffening.

Place in the pipeline: an independent value for `rotating_beams`; it shares nothing with the rigid
finite element method.

Euler-Bernoulli beam in the hub's frame, small deflections v(x, t) [m] transverse to the rotating x
axis, tension N = rho A Omega^2 (L^2 - x^2) / 2 of the rotation:

    rho A (v'' - Omega^2 v) - (N v_x)_x + E I v_xxxx = -rho A x Omega'

by Galerkin's method with the lowest four modes of the beam at rest, found among the polynomials
x^2 ... x^9.  Source: T. R. Kane, R. R. Ryan, A. K. Banerjee,
"Dynamics of a cantilever beam attached to a moving base", J. Guidance 10 (1987) 139-151.
"""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float
from scipy.integrate import solve_ivp
from scipy.linalg import eigh

POWERS = np.arange(2, 10)
MODES = 4


def tip_lag(
    length: float,
    bending: float,
    line_density: float,
    rate: Callable[[float], tuple[float, float]],
    times: Float[np.ndarray, " times"],
) -> Float[np.ndarray, " times"]:
    """Lag of the tip [m] at `times` [s], positive against the motion.

    Args: length [m]; bending E I [N m^2]; line_density [kg/m]; rate: t -> (Omega [rad/s],
        Omega' [rad/s^2]).
    """
    # Everything over the length: x = length * s, v = length * sum q_k s^k.
    nodes, weights = np.polynomial.legendre.leggauss(12)
    s, w = 0.5 * (nodes + 1.0), 0.5 * weights
    shape = s[None] ** POWERS[:, None]
    derivative = POWERS[:, None] * s[None] ** (POWERS[:, None] - 1)
    curvature = (POWERS * (POWERS - 1))[:, None] * s[None] ** (POWERS[:, None] - 2)
    mass = (shape * w) @ shape.T
    stiffness = bending / (line_density * length**4) * (curvature * w) @ curvature.T
    stiffening = (derivative * (w * 0.5 * (1.0 - s**2))) @ derivative.T
    # In modal coordinates mass is 1 and stiffness diagonal; the other modes are too stiff to be excited.
    squares, modes = eigh(stiffness, mass, subset_by_index=[0, MODES - 1])
    load, softening = modes.T @ (shape @ (w * s)), modes.T @ (stiffening - mass) @ modes

    def right_hand_side(t, state):
        q, q_dot = state[:MODES], state[MODES:]
        omega, acceleration = rate(t)
        force = -squares * q - omega**2 * (softening @ q) - acceleration * load
        return np.concatenate([q_dot, force])

    solution = solve_ivp(
        right_hand_side, (0.0, times[-1]), np.zeros(2 * MODES), method="DOP853", t_eval=times,
        rtol=1e-7, atol=1e-9,
    )  # fmt: skip
    return -length * modes.sum(axis=0) @ solution.y[:MODES]
