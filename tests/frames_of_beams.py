"""Finite elements of slender beams in space, and their reduction, as an independent source of reduced bodies."""

from itertools import pairwise

import numpy as np
from scipy.linalg import eigh

from rfem_jax import ReducedBody

WIDTH, MODULUS, SHEAR_MODULUS, DENSITY = 0.01, 210e9, 210e9 / 2.6, 7850.0
AREA, INERTIA, TORSION = WIDTH**2, WIDTH**4 / 12.0, 0.1406 * WIDTH**4


def element(length):
    """Stiffness and mass (12, 12) of a beam along x by Bernoulli and Euler, without rotary inertia of bending."""
    stiffness, mass = np.zeros((12, 12)), np.zeros((12, 12))

    def add(rows, k, m):
        stiffness[np.ix_(rows, rows)] += k
        mass[np.ix_(rows, rows)] += m

    pair, consistent = np.array([[1.0, -1.0], [-1.0, 1.0]]), np.array([[2.0, 1.0], [1.0, 2.0]]) / 6.0
    add([0, 6], MODULUS * AREA / length * pair, DENSITY * AREA * length * consistent)
    add([3, 9], SHEAR_MODULUS * TORSION / length * pair, DENSITY * 2.0 * INERTIA * length * consistent)
    l2 = length**2
    bending = np.array([
        [12.0, 6.0 * length, -12.0, 6.0 * length], [6.0 * length, 4.0 * l2, -6.0 * length, 2.0 * l2],
        [-12.0, -6.0 * length, 12.0, -6.0 * length], [6.0 * length, 2.0 * l2, -6.0 * length, 4.0 * l2],
    ])  # fmt: skip
    moving = np.array([
        [156.0, 22.0 * length, 54.0, -13.0 * length], [22.0 * length, 4.0 * l2, 13.0 * length, -3.0 * l2],
        [54.0, 13.0 * length, 156.0, -22.0 * length], [-13.0 * length, -3.0 * l2, -22.0 * length, 4.0 * l2],
    ])  # fmt: skip
    for rows, sign in (([1, 5, 7, 11], 1.0), ([2, 4, 8, 10], -1.0)):  # v' = phi_z, w' = -phi_y
        turn = np.diag([1.0, sign, 1.0, sign])
        add(
            rows,
            MODULUS * INERTIA / length**3 * turn @ bending @ turn,
            DENSITY * AREA * length / 420.0 * turn @ moving @ turn,
        )
    return stiffness, mass


def frame_of(points):
    """Stiffness and mass (6 n, 6 n) of beams from point to point (n, 3) in the plane xz, in global axes."""
    size = 6 * len(points)
    stiffness, mass = np.zeros((size, size)), np.zeros((size, size))
    for i, (a, b) in enumerate(pairwise(np.asarray(points, dtype=float))):
        length = np.linalg.norm(b - a)
        along = (b - a) / length
        axes = np.stack([along, [0.0, 1.0, 0.0], np.cross(along, [0.0, 1.0, 0.0])])
        turn, rows = np.kron(np.eye(4), axes), slice(6 * i, 6 * i + 12)
        for whole, part in zip((stiffness, mass), element(length), strict=True):
            whole[rows, rows] += turn.T @ part @ turn
    return stiffness, mass


def reduced(points, nodes, modes, **more):
    """The frame as a reduced body with these nodes as interfaces, and its rows by all rows of the frame."""
    stiffness, mass = frame_of(points)
    held = np.concatenate([np.arange(6 * k, 6 * k + 6) for k in nodes])
    inner = np.setdiff1d(np.arange(len(mass)), held)
    follow = -np.linalg.solve(stiffness[np.ix_(inner, inner)], stiffness[np.ix_(inner, held)])
    shapes = eigh(stiffness[np.ix_(inner, inner)], mass[np.ix_(inner, inner)])[1][:, :modes]
    rows = np.zeros((len(mass), len(held) + modes))
    rows[held, np.arange(len(held))] = 1.0
    rows[inner] = np.hstack([follow, shapes])
    places = np.asarray(points, dtype=float)[list(nodes)]
    return ReducedBody(places, rows.T @ mass @ rows, rows.T @ stiffness @ rows, **more), rows


def straight(length, parts=24):
    """Points along x."""
    return np.linspace(0.0, length, parts + 1)[:, None] * np.eye(3)[0]
