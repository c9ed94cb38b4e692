"""Rotations and frames in NumPy, as files of other programs write them.

Place in the pipeline: **rigid_frames** -> layout, and all readers and writers.

Frames as in theory (2.1); angles are those of R = R_z R_y R_x, quaternions have the scalar first. SI units, rad.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

_GIMBAL = 1e-9  # of the cosine of the middle angle, below which only a sum of two angles is defined
PARALLEL = 1e-6  # sine of the angle between two directions that count as one


class Frame(NamedTuple):
    """A rotation (3, 3) and an origin (3,) [m] relative to another frame."""

    rotation: Float[np.ndarray, "3 3"]
    position: Float[np.ndarray, "3"]

    def then(self, inner: "Frame") -> "Frame":
        """The frame that `inner` is in this one."""
        return Frame(self.rotation @ inner.rotation, self.position + self.rotation @ inner.position)

    def inverse(self) -> "Frame":
        """The other frame relative to this one."""
        return Frame(self.rotation.T, -self.rotation.T @ self.position)

    def seen_from(self, other: "Frame") -> "Frame":
        """This frame relative to another one, both given in the same axes."""
        return other.inverse().then(self)


def at_origin() -> Frame:
    """The frame that is its reference."""
    return Frame(np.eye(3), np.zeros(3))


def rotation_about(axis: int, angle: float) -> Float[np.ndarray, "3 3"]:
    """Rotation about x, y or z (0, 1, 2) by an angle [rad]."""
    c, s = np.cos(angle), np.sin(angle)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    matrix = np.eye(3)
    matrix[i, i] = matrix[j, j] = c
    matrix[i, j], matrix[j, i] = -s, s
    return matrix


def rotation_from(angles: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """R_z R_y R_x of three angles [rad] about x, y, z."""
    x, y, z = angles
    return rotation_about(2, z) @ rotation_about(1, y) @ rotation_about(0, x)


def angles_of(rotation: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3"]:
    """Angles [rad] about x, y, z of a rotation R_z R_y R_x."""
    along = np.hypot(rotation[0, 0], rotation[1, 0])
    y = np.arctan2(-rotation[2, 0], along)
    if along < _GIMBAL:
        return np.array([0.0, y, np.arctan2(-rotation[0, 1], rotation[1, 1])])
    return np.array([
        np.arctan2(rotation[2, 1], rotation[2, 2]), y, np.arctan2(rotation[1, 0], rotation[0, 0]),
    ])  # fmt: skip


def rotation_of_quaternion(q: Float[np.ndarray, "4"]) -> Float[np.ndarray, "3 3"]:
    """Rotation of a quaternion (scalar first) of any length but zero."""
    w, x, y, z = q / np.linalg.norm(q)
    return np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ])  # fmt: skip


def quaternion_of(rotation: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "4"]:
    """Quaternion (scalar first, >= 0) of a rotation."""
    # The eigenvector of the largest eigenvalue: exact to rounding for every rotation.
    r = rotation
    matrix = np.array([
        [r[0, 0] + r[1, 1] + r[2, 2], r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]],
        [r[2, 1] - r[1, 2], r[0, 0] - r[1, 1] - r[2, 2], r[0, 1] + r[1, 0], r[0, 2] + r[2, 0]],
        [r[0, 2] - r[2, 0], r[0, 1] + r[1, 0], r[1, 1] - r[0, 0] - r[2, 2], r[1, 2] + r[2, 1]],
        [r[1, 0] - r[0, 1], r[0, 2] + r[2, 0], r[1, 2] + r[2, 1], r[2, 2] - r[0, 0] - r[1, 1]],
    ])  # fmt: skip
    q = np.linalg.eigh(matrix)[1][:, -1]
    return -q if q[0] < 0.0 else q


def axes_from(first: Float[np.ndarray, "3"], near: Float[np.ndarray, "3"], places: tuple[int, int]) -> Frame:
    """The right-handed axes of which number places[0] is along `first`, and number places[1] as near to `near` as it
    can be; where both are parallel, near to any other direction. At the origin."""
    one = first / np.linalg.norm(first)
    across = near - (near @ one) * one
    if np.linalg.norm(across) < PARALLEL * np.linalg.norm(near):
        other = np.eye(3)[np.argmin(np.abs(one))]
        across = other - (other @ one) * one
    rotation = np.empty((3, 3))
    i, j = places
    rotation[:, i], rotation[:, j] = one, across / np.linalg.norm(across)
    third = np.cross(rotation[:, i], rotation[:, j])
    rotation[:, 3 - i - j] = third if (j - i) % 3 == 1 else -third
    return Frame(rotation, np.zeros(3))
