"""A clamped rod under a tip force by the exact rod equations: an independent value.

Place in the pipeline: a reference of `large_deflections`; it shares nothing with the rigid finite
element method.

Rod with stretching, shear, torsion and bending, large rotations; n = F the constant force, M(s) the
moment, R(s) the section's rotation (3, 3), r(s) its position:

    r' = R (e_x + C_n^-1 R^T n),   R' = R hat(C_m^-1 R^T M),   M' = -r' x n,   M(L) = 0.

The unknown moment at the clamp is found by shooting, with the force increased in steps. Source: S. S.
Antman, "Nonlinear Problems of Elasticity", 2nd ed. (2005), ch. 8.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from scipy.integrate import solve_ivp
from scipy.optimize import root

LOAD_STEPS = 5


def tip_displacement(length: float, stiffnesses: Sequence[float], force: Sequence[float]) -> Float[np.ndarray, "3"]:
    """Displacement of the tip [m] in the clamp's axes (x along the rod).

    Args: length [m]; stiffnesses EA, GA_y, GA_z [N], GJ, EI_y, EI_z [N m^2]; force (3,) [N].
    Raises: RuntimeError if shooting finds no solution.
    """
    along, about = np.array(stiffnesses[:3]), np.array(stiffnesses[3:])
    full_force = np.asarray(force, float)
    clamp, before = np.zeros(3), np.zeros(3)
    for step in range(1, LOAD_STEPS + 1):
        load = full_force * step / LOAD_STEPS
        # Linear extrapolation from the moments of the last two loads; at the first, that of the straight rod.
        guess = 2.0 * clamp - before if step > 1 else np.cross([length, 0.0, 0.0], load)
        found = root(lambda m: _end(length, along, about, load, m)[12:], guess, tol=1e-11)
        if np.abs(found.fun).max() > 1e-9 * max(np.abs(found.x).max(), 1e-300):
            raise RuntimeError("The rod equations were not solved; more load steps are needed.")
        before, clamp = clamp, found.x
    return _end(length, along, about, full_force, clamp)[:3] - [length, 0.0, 0.0]


def _end(length, along, about, force, clamp) -> np.ndarray:
    """(r, R by rows, M) at the tip for a moment at the clamp."""

    def derivative(s, state):
        del s
        rotation, moment = state[3:12].reshape(3, 3), state[12:]
        strain = np.array([1.0, 0.0, 0.0]) + rotation.T @ force / along
        x, y, z = rotation.T @ moment / about
        curvature = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
        tangent = rotation @ strain
        return np.concatenate([tangent, (rotation @ curvature).ravel(), -np.cross(tangent, force)])

    start = np.concatenate([np.zeros(3), np.eye(3).ravel(), clamp])
    return solve_ivp(derivative, (0.0, length), start, method="DOP853", rtol=1e-10, atol=1e-13).y[:, -1]
