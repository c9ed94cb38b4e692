"""The planar four-bar A-B-C-D in closed form, and the same mechanism built in several ways.

Angles about +y from X: a point at angle phi and distance r lies at r (cos phi, -sin phi) in X, Z.
"""

from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from rfem_jax import (
    Joint,
    Link,
    Material,
    Mechanism,
    MomentRamp,
    Rectangle,
    RungeKutta4,
    Simulation,
    assembly_errors,
    discretise,
    simulate,
)

CRANK, COUPLER, ROCKER, GROUND = 0.12, 0.30, 0.32, 0.28
HEIGHT, DENSITY = 0.01, 7850.0
GRAVITY = np.array([0.0, -9.81])
START = -np.pi / 2.0


def radial(angle):
    return np.array([np.cos(angle), -np.sin(angle)])


def tangential(angle):
    return np.array([-np.sin(angle), -np.cos(angle)])


def about_y(arm, force):
    """y component of arm x force, both in X, Z."""
    return arm[1] * force[0] - arm[0] * force[1]


@dataclass(frozen=True)
class ExactFourBar:
    """Three uniform rods and the ground."""

    lengths = np.array([CRANK, COUPLER, ROCKER])
    line_density = DENSITY * HEIGHT**2
    rotary = DENSITY * HEIGHT**4 / 12.0  # kg m

    @property
    def masses(self):
        return self.line_density * self.lengths

    @property
    def inertias(self):
        return self.masses * self.lengths**2 / 12.0 + self.rotary * self.lengths

    def angles(self, crank):
        """Angles of crank, coupler (B to C) and rocker (D to C), C above the line from B to D."""
        b, d = CRANK * radial(crank), np.array([GROUND, 0.0])
        across = d - b
        distance = np.hypot(*across)
        along = (distance**2 + COUPLER**2 - ROCKER**2) / (2.0 * distance)
        up = np.array([-across[1], across[0]]) / distance
        c = b + along * across / distance + np.sqrt(COUPLER**2 - along**2) * up
        return np.array(
            [
                crank,
                np.arctan2(-(c - b)[1], (c - b)[0]),
                np.arctan2(-(c - d)[1], (c - d)[0]),
            ]
        )

    def rates(self, angles, rate):
        """Angular velocities from the loop's velocity equation."""
        t = [length * tangential(a) for length, a in zip(self.lengths, angles)]
        others = np.linalg.solve(np.stack([t[1], -t[2]], axis=1), -t[0] * rate)
        return np.array([rate, *others])

    def accelerations(self, angles, rates, acceleration):
        """Angular accelerations from the loop's acceleration equation."""
        t = [length * tangential(a) for length, a in zip(self.lengths, angles)]
        e = [length * radial(a) * w**2 for length, a, w in zip(self.lengths, angles, rates)]
        right = -t[0] * acceleration + e[0] + e[1] - e[2]
        return np.array([acceleration, *np.linalg.solve(np.stack([t[1], -t[2]], axis=1), right)])

    def centres(self, angles, rates, accelerations):
        """Velocities and accelerations of the three centres of mass."""
        v = [length * w * tangential(a) for length, a, w in zip(self.lengths, angles, rates)]
        acc = [
            length * (turn * tangential(a) - w**2 * radial(a))
            for length, a, w, turn in zip(self.lengths, angles, rates, accelerations)
        ]
        return tuple(np.array([parts[0] / 2.0, parts[0] + parts[1] / 2.0, parts[2] / 2.0]) for parts in (v, acc))

    def crank_acceleration(self, crank, rate, moment):
        """Lagrange's equation of one coordinate: J phi'' + J'/2 phi'^2 = M - dV/dphi."""
        angles = self.angles(crank)
        unit = self.rates(angles, 1.0)
        curve = self.accelerations(angles, unit, 0.0)
        v, dv = self.centres(angles, unit, curve)
        inertia = np.sum(self.masses * np.sum(v * v, axis=1) + self.inertias * unit**2)
        half_derivative = np.sum(self.masses * np.sum(v * dv, axis=1) + self.inertias * unit * curve)
        gravity = np.sum(self.masses * (v @ GRAVITY))
        return (moment + gravity - half_derivative * rate**2) / inertia

    def motion(self, moment, pieces, times):
        """Crank angle and rate (2, times) from rest; `pieces` are the ends of the smooth pieces."""

        def field(t, y, piece):
            return [y[1], self.crank_acceleration(y[0], y[1], moment(t, piece))]

        out, state, begin = np.empty((2, len(times))), [START, 0.0], 0.0
        for piece, end in enumerate(pieces):
            solution = solve_ivp(
                field,
                (begin, end),
                state,
                method="DOP853",
                args=(piece,),
                dense_output=True,
                rtol=1e-11,
                atol=1e-12,
            )
            inside = (times >= begin) & (times <= end)
            out[:, inside] = solution.sol(times[inside])
            begin, state = end, solution.y[:, -1]
        return out

    def forces(self, crank, rate, acceleration):
        """Newton-Euler of three bodies, nine unknowns: forces in X, Z of base on crank (A), crank
        on coupler (B), coupler on rocker (C), base on rocker (D), and the moment on the crank."""
        angles = self.angles(crank)
        rates = self.rates(angles, rate)
        turns = self.accelerations(angles, rates, acceleration)
        _, acc = self.centres(angles, rates, turns)
        halves = [length / 2.0 * radial(a) for length, a in zip(self.lengths, angles)]
        # body: (joint, sign, arm from its centre of mass)
        bodies = (
            ((0, 1.0, -halves[0]), (1, -1.0, halves[0])),
            ((1, 1.0, -halves[1]), (2, -1.0, halves[1])),
            ((2, 1.0, halves[2]), (3, 1.0, -halves[2])),
        )
        matrix, right = np.zeros((9, 9)), np.zeros(9)
        for i, joints in enumerate(bodies):
            for joint, sign, arm in joints:
                for axis in range(2):
                    column, unit = 2 * joint + axis, np.eye(2)[axis]
                    matrix[3 * i + axis, column] += sign
                    matrix[3 * i + 2, column] += sign * about_y(arm, unit)
            right[3 * i : 3 * i + 2] = self.masses[i] * (acc[i] - GRAVITY)
            right[3 * i + 2] = self.inertias[i] * turns[i]
        matrix[2, 8] = 1.0
        solution = np.linalg.solve(matrix, right)
        return dict(zip("ABCD", solution[:8].reshape(4, 2))), solution[8]


def build_four_bar(
    cut="C", rigid="crank coupler rocker", rfes=3, stiffness=210e9, damping=0.0, height=HEIGHT, **settings
):
    """The four-bar, its loop cut at "B", "C" or "D"; links not named in `rigid` are flexible."""
    steel = Material("steel", stiffness, DENSITY, poisson_ratio=0.3, damping=damping)
    section = Rectangle(height, height)
    links = [
        Link(name, length, section, steel, rigid=name in rigid.split(), rfes=rfes)
        for name, length in (("crank", CRANK), ("coupler", COUPLER), ("rocker", ROCKER))
    ]
    crank, coupler, rocker = ExactFourBar().angles(START)
    base = {"parent": "base", "position": (GROUND, 0.0, 0.0)}
    a = Joint("A", "base", "crank", angle=crank)
    joints = {
        "C": [
            a,
            Joint("B", "crank", "coupler", angle=coupler - crank),
            Joint("D", child="rocker", angle=rocker, **base),
            Joint("C", "coupler", "rocker", cut=True),
        ],
        "B": [  # the coupler runs from C to B
            a,
            Joint("D", child="rocker", angle=rocker, **base),
            Joint("C", "rocker", "coupler", angle=coupler + np.pi - rocker),
            Joint("B", "crank", "coupler", cut=True),
        ],
        "D": [  # the rocker runs from C to D
            a,
            Joint("B", "crank", "coupler", angle=coupler - crank),
            Joint("C", "coupler", "rocker", angle=rocker + np.pi - coupler),
            Joint("D", child="rocker", cut=True, **base),
        ],
    }[cut]
    settings = {"driven_joint": "A", "redundant_reactions": "refuse", **settings}
    if len(rigid.split()) == 3:
        settings["redundant_reactions"] = "minimum_norm"
    return discretise(Mechanism(links, joints, **settings))


def frames_of(cut):
    """Per joint: which angle (link, turned by) its hinge frame has, and the sign of its force
    relative to `ExactFourBar.forces`."""
    crank, coupler, rocker, half = (0, 0.0), (1, 0.0), (2, 0.0), np.pi
    return {
        "C": {"A": (crank, 1), "B": (coupler, 1), "C": (coupler, 1), "D": (rocker, 1)},
        "B": {"A": (crank, 1), "B": (crank, 1), "C": ((1, half), -1), "D": (rocker, 1)},
        "D": {"A": (crank, 1), "B": (coupler, 1), "C": ((2, half), 1), "D": (None, 1)},
    }[cut]


def expected_loads(cut, crank, rate, acceleration):
    """Force (x, z) of every joint in its hinge frame, and the moment on the crank."""
    exact = ExactFourBar()
    forces, moment = exact.forces(crank, rate, acceleration)
    angles = exact.angles(crank)
    out = {}
    for joint, (link, sign) in frames_of(cut).items():
        angle = 0.0 if link is None else angles[link[0]] + link[1]
        axes = np.stack([radial(angle), -tangential(angle)[[0, 1]]])
        out[joint] = sign * axes @ forces[joint]
    return out, moment


@pytest.fixture(scope="session")
def exact_four_bar():
    return ExactFourBar()


@pytest.fixture(scope="session")
def four_bar():
    """Function: options -> model; see `build_four_bar`."""
    return build_four_bar


@pytest.fixture(scope="session")
def four_bar_loads():
    """Function: cut, crank angle, rate, acceleration -> forces in the hinge frames, moment."""
    return expected_loads


OUT_OF_PLANE = {
    "D.delta_x": 0.008,
    "D.delta_z": -0.005,
    "D.d_y": 4e-4,
    "B.child.delta_x": 0.003,
    "C.delta_z": 0.004,
    "C.child.d_y": -2e-4,
    "A.pin_tilt_x": 0.006,
    "coupler.twist": 0.007,
}
IN_PLANE = {"D.d_x": 3e-4, "B.d_z": -2e-4, "C.child.d_x": 1e-4, "rocker.length": 2e-4}
ROTATION = (0.7, -0.4, 1.9)  # about x, y, z; R_z R_y R_x
SHIFT = np.array([0.4, -1.1, 0.6])
MOMENT, RISE, DURATION = 16.0, 0.01, 0.016
STIFFER = 4.0


def rotation(x, y, z):
    (cx, cy, cz), (sx, sy, sz) = np.cos([x, y, z]), np.sin([x, y, z])
    about_x = np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
    about_y = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    about_z = np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]])
    return about_z @ about_y @ about_x


def moved(model):
    """The mechanism with its base joints and gravity rotated by ROTATION and shifted by SHIFT; relative to each
    other the base joints stay, so that the start angles still close the loops."""
    rotated = rotation(*ROTATION)
    on_base = np.array([parent == -1 for parent in model.topology.parents])
    place = np.asarray(model.parent_position)
    axes = np.asarray(model.parent_rotation)
    place = np.where(on_base, rotated @ place + SHIFT[:, None], place)
    axes = np.where(on_base, np.einsum("ij,jkn->ikn", rotated, axes), axes)
    return eqx.tree_at(
        lambda m: (m.parent_position, m.parent_rotation, m.gravity),
        model,
        (jnp.asarray(place), jnp.asarray(axes), jnp.asarray(rotated @ np.asarray(model.gravity))),
    )


def stiffened(model):
    """All stiffnesses times STIFFER, the damping time halved to keep the damping ratios."""
    stiffness, damping = STIFFER * model.section.stiffness, STIFFER**-0.5 * model.section.damping
    return eqx.tree_at(lambda m: (m.section.stiffness, m.section.damping), model, (stiffness, damping))


@pytest.fixture(scope="session")
def flexible_four_bar_runs():
    """The four-bar with flexible coupler and rocker, and its runs under a moment ramp: "perfect",
    "errors", "mirrored" errors, the same errors on the "moved" mechanism, "stiff" and perfect."""
    model = build_four_bar("C", rigid="crank", rfes=3, damping=2e-5)
    errors = {**OUT_OF_PLANE, **IN_PLANE}
    mirrored = {**{name: -value for name, value in OUT_OF_PLANE.items()}, **IN_PLANE}
    cases = {
        "perfect": (model, {}),
        "errors": (model, errors),
        "mirrored": (model, mirrored),
        "moved": (moved(model), errors),
        "stiff": (stiffened(model), {}),
    }
    batch = [(one, assembly_errors(model, values)) for one, values in cases.values()]
    batch = jax.tree.map(lambda *x: jnp.stack(x), *batch)

    def simulated(model, errors):
        return simulate(
            Simulation(
                model,
                drive=MomentRamp("A", MOMENT, RISE),
                duration=DURATION,
                method=RungeKutta4(step=1e-5),
                save_every=1e-3,
            ),
            errors,
        )

    results = eqx.filter_jit(eqx.filter_vmap(simulated))(*batch)
    assert (np.asarray(results.status) == 0).all()
    return model, {name: jax.tree.map(lambda x: np.asarray(x)[i], results) for i, name in enumerate(cases)}
