"""Loads of joints from what Exudyn's constraints and springs measure, in our conventions and axes.

Place in the pipeline: second part of the program of scripts for Exudyn: exudyn_system -> **exudyn_loads** ->
exudyn_program.

A multiplier of a . b = 0 between an axis a of J0 and b of J1 is a moment about b x a on the child.
"""

import numpy as np

from rfem_jax.exchange.exudyn_system import CROSS, frame_of

BACK = [1, 2, 0]  # from Exudyn's axes to ours


def loads_of(joint, rows, sign=1.0):
    """Force and moment (T, 3) on the child about its point, in the hinge frame (the parent's at a cut joint), in our
    axes; and the angle (T,) about the hinge. rows: what its sensors measured, (T, n) each; sign: of the multipliers."""
    turned = _relative_rotations(joint, rows["rotation"])
    # What the constraint measures is the negative of what acts on the child.
    force, moment = -sign * rows["force"], _moment_in_seat(joint, sign * rows["couples"], turned)
    if joint["kind"] == "universal":
        force = force @ CROSS
    if joint["bushing"] is not None:
        frame = np.array(joint["bushing"]["seat"]).T @ frame_of(joint["seat"])
        force, moment = force - rows["bushing_force"] @ frame, moment - rows["bushing_moment"] @ frame
    for k, law in enumerate(joint["laws"]):
        if law["inside"]:
            (moment if law["rotation"] else force)[:, law["axis"]] -= rows[f"law {k}"][:, 0]
    if not joint["cut"]:
        force, moment = (np.einsum("tji,tj->ti", _to_hinge_frame(joint, turned), x) for x in (force, moment))
    return force[:, BACK], moment[:, BACK], np.arctan2(-turned[:, 0, 1], turned[:, 1, 1])


def idle_moment(joint, rows, axis, multiplier):
    """Moment (1, 3) on the child, in the hinge frame and our axes, of the constraint on a small rotation about an axis
    of the parent's frame: of y0 . z1, x0 . z1 or x0 . y1 = 0."""
    in_seat = np.eye(3)[axis] * multiplier * (-1.0 if axis == 1 else 1.0)
    turned = _to_hinge_frame(joint, _relative_rotations(joint, rows["rotation"]))
    return np.einsum("tji,j->ti", turned, in_seat)[:, BACK]


def add_holding(driven, measured, force, moment) -> None:
    """Add to loads (T, 3) in our axes the moment, or minus the force, that a constraint measures along the driven
    motion: a moment of x0 . y1 = 0 is along the axis, a force on the child against it."""
    axis = BACK.index(driven["axis"])
    if driven["rotation"]:
        moment[:, axis] += measured[:, driven["axis"]]
    else:
        force[:, axis] -= measured[:, driven["axis"]]


def _relative_rotations(joint, angles):
    """Rotations (T, 3, 3) from the child's frame of a joint to the parent's, from angles about x, y, z in turn."""
    (ca, cb, cc), (sa, sb, sc) = np.cos(angles.T), np.sin(angles.T)
    rotation = np.array([
        [cb * cc, -cb * sc, sb],
        [ca * sc + sa * sb * cc, ca * cc - sa * sb * sc, -sa * cb],
        [sa * sc - ca * sb * cc, sa * cc + ca * sb * sc, ca * cb],
    ]).transpose(2, 0, 1)  # fmt: skip
    return CROSS @ rotation @ CROSS if joint["kind"] == "universal" else rotation


def _moment_in_seat(joint, couples, turned):
    """Moments (T, 3) of the constraint on the child, in the parent's axes."""
    held = sum(joint["held"][3:])
    if held == 3:  # z0 . y1 = z0 . x1 = x0 . y1 = 0
        return np.stack([-couples[:, 0], couples[:, 1], couples[:, 2]], axis=1)
    if held == 2:
        in_child = np.stack([-couples[:, 1], couples[:, 0], 0.0 * couples[:, 0]], axis=1)
        return np.einsum("tij,tj->ti", turned, in_child)
    if held == 1:  # z0 . x1 = 0
        return -couples[:, 1:2] * np.cross(turned[:, :, 0], [0.0, 0.0, 1.0])
    return np.zeros((len(couples), 3))


def _to_hinge_frame(joint, turned):
    """Rotations (T, 3, 3) from the hinge frame to the parent's: all of the joint's turns, but the tilts of a compliant
    joint."""
    if joint["turns"] == 0:
        return np.broadcast_to(np.eye(3), turned.shape)
    if not joint["tilts"]:
        return turned
    angle = np.arctan2(-turned[:, 0, 1], turned[:, 1, 1])
    c, s, zero, one = np.cos(angle), np.sin(angle), np.zeros_like(angle), np.ones_like(angle)
    return np.array([[c, -s, zero], [s, c, zero], [zero, zero, one]]).transpose(2, 0, 1)


def rms_loads(histories, window=None):
    """RMS resultants over the window, trapezoidal rule: {"force": {joint: N}, "moment": {joint: N m}}."""
    t = histories.times
    low, high = (t[0], t[-1]) if window is None else window
    inside = (t >= low - 1e-9) & (t <= high + 1e-9)

    def root(vectors):
        square = np.sum(vectors[inside] ** 2, axis=1)
        return float(np.sqrt(np.sum(0.5 * (square[1:] + square[:-1]) * np.diff(t[inside])) / (high - low)))

    return {kind: {name: root(v) for name, v in getattr(histories, kind).items()} for kind in ("force", "moment")}
