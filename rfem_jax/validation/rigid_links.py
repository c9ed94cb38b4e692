"""Rigid links of given inertia, their frames, and starts at a rate.

Place in the pipeline: serves the benchmarks of joints of other kinds than revolute.
"""

from collections.abc import Callable, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rfem_jax.compilation.program import Program
from rfem_jax.description import (
    GivenSection,
    Joint,
    JointForceTable,
    Link,
    Mechanism,
    PrescribedRate,
    RigidBody,
    RungeKutta4,
)
from rfem_jax.mechanics.kinematics.motion import motion_of
from rfem_jax.mechanics.model.discretisation import discretise
from rfem_jax.mechanics.model.errors import assembly_errors
from rfem_jax.mechanics.model.model import Coordinates, Model, State
from rfem_jax.mechanics.model.with_errors import apply_errors
from rfem_jax.mechanics.statics.assembly import held_angles
from rfem_jax.mechanics.statics.settling import moving_equilibrium
from rfem_jax.simulation import Run, Simulation, simulate

# The section of a link whose mass is that of bodies on it: next to nothing.
MASSLESS = GivenSection(1e6, 1e6, 1e6, 1e2, 1e2, 1e2, 1e-9, 1e-15, 1e-15, 1e-15)

Axes = Float[np.ndarray, "3 3"]


def body(name: str, length: float, mass: float, centre: Sequence[float], inertia: Sequence[float]) -> Link:
    """A rigid link of given mass [kg], mass centre [m] and principal inertia [kg m^2] in its axes."""
    return Link(name, length, body=RigidBody(mass, _three(centre), _three(inertia)))


def cylinder(name: str, length: float, diameter: float, density: float) -> Link:
    """A rigid cylinder along x [m, m, kg/m^3]."""
    mass, radius = density * np.pi * diameter**2 / 4.0 * length, diameter / 2.0
    across = mass * (length**2 + 3.0 * radius**2) / 12.0
    return body(name, length, mass, (length / 2.0, 0.0, 0.0), (mass * radius**2 / 2.0, across, across))


def slider_crank(guide: Joint, forces: tuple[JointForceTable, ...] = ()) -> Mechanism:
    """Crank, rod and piston with its guide; spherical crank pin and cylindrical wrist pin leave no redundant rows."""
    links = (
        body("crank", 0.06, 0.4, (0.02, 0, 0.003), (1.5e-4, 3e-4, 2.5e-4)),
        body("piston", 0.05, 0.5, (0.012, 0, 0.006), (3e-4, 4e-4, 3.5e-4)),
        body("rod", 0.2, 0.35, (0.07, 0, 0.004), (1e-4, 1.6e-3, 1.55e-3)),
    )
    joints = (
        Joint("A", "base", "crank"),
        guide,
        Joint("C", "piston", "rod", kind="cylindrical", position=(0, 0, 0), child_position=(0.2, 0, 0)),
        Joint("B", "crank", "rod", kind="spherical", cut=True, child_position=(0, 0, 0)),
    )
    return Mechanism(links, joints, driven_joint="A", forces=forces)


def one_turn(mechanism: Mechanism, rate: float, steps: int, start: Callable[[Model], Any] = lambda model: None) -> Run:
    """One turn of A at a constant rate [rad/s], of which 40 times are saved."""
    model, period = discretise(mechanism), 2.0 * np.pi / rate
    return simulate(
        Simulation(
            model,
            drive=PrescribedRate("A", rate),
            duration=period,
            method=RungeKutta4(step=period / steps),
            save_every=period / 40,
            start=start(model),
        )
    )


def _three(values: Sequence[float]) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in values)
    return x, y, z


def turn_x(angle: float) -> Axes:
    """Rotation about x."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])


def turn_y(angle: float) -> Axes:
    """Rotation about y."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])


def turn_z(angle: float) -> Axes:
    """Rotation about z."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def along(direction: Sequence[float]) -> Axes:
    """Axes as columns: x along a direction, y and z any."""
    x = np.array(direction) / np.linalg.norm(direction)
    z = np.cross(x, np.eye(3)[np.argmin(np.abs(x))])
    z /= np.linalg.norm(z)
    return np.stack([x, np.cross(z, x), z], axis=1)


def angles_of(axes: Axes) -> tuple[float, float, float]:
    """Angles about x, y, z [rad] of R = R_z R_y R_x."""
    y = -np.arcsin(np.clip(axes[2, 0], -1.0, 1.0))
    if np.hypot(axes[0, 0], axes[1, 0]) < 1e-9:  # x of the axes is along z: only a sum of two angles is defined
        return 0.0, float(y), float(np.arctan2(-axes[0, 1], axes[1, 1]))
    return (
        float(np.arctan2(axes[2, 1], axes[2, 2])),
        float(y),
        float(np.arctan2(axes[1, 0], axes[0, 0])),
    )


@Program
def start_at_rate(model: Model, rate: Float[Array, ""]) -> State:
    """The nominal closed start, the driven joint turning at a rate [rad/s]."""
    actual, held = apply_errors(model, assembly_errors(model)), held_angles(model, None)
    return moving_equilibrium(model, actual, held, dict.fromkeys(model.topology.drives[:1], rate))[0]


@Program
def start_without_spin(model: Model, rate: Float[Array, ""]) -> State:
    """As `start_at_rate`, without angular velocity about their x axes of the links that may spin idly."""
    topology, actual, held = model.topology, apply_errors(model, assembly_errors(model)), held_angles(model, None)
    state = moving_equilibrium(model, actual, held, dict.fromkeys(model.topology.drives[:1], rate))[0]
    now, joints = motion_of(actual, state), state.velocity.joints
    for l in sorted({topology.link_of_freedom[k] for k in topology.idle}):
        axis = now.links.rotation[:, 0, l]
        spin = now.links.velocity[:3, l] @ axis
        of_parent = now.links.rotation[:, :, topology.parents[l]]
        at = topology.coordinates[l]
        joints = joints.at[at.start : at.stop].add(-spin * (of_parent.T @ axis))
    return State(state.position, Coordinates(joints, state.velocity.elastic))


def rate_of(value: float) -> Float[Array, ""]:
    """A rate [rad/s] as an input of a program."""
    return jnp.asarray(value, jnp.float64)
