"""Bennett's linkage: four skew hinges, mobile only because of its proportions, so that three closure equations of five
are redundant.

Place in the pipeline: a benchmark of `catalogue`.

Opposite links are equal: lengths a, b and twists (angles between the hinges of a link) with a / sin(alpha) =
b / sin(beta); then tan(theta_1 / 2) tan(theta_2 / 2) = sin((beta + alpha) / 2) / sin((beta - alpha) / 2). The drive's
moment is the derivative of the energy along the crank angle, from the closed form alone; it is unique, where loads
across the hinges are those of minimum norm. Source: G. T. Bennett, Engineering 76 (1903) 777-778.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rfem_jax.description import Joint, Link, Mechanism, PointMass, PrescribedRate, RungeKutta4
from rfem_jax.mechanics.model.discretisation import describe, discretise
from rfem_jax.simulation import Run, Simulation, simulate
from rfem_jax.validation.lines import Line, Outcome, Progress, absolute, same
from rfem_jax.validation.rigid_links import MASSLESS

A, ALPHA, BETA = 0.2, np.radians(35.0), np.radians(75.0)
B = A * float(np.sin(BETA) / np.sin(ALPHA))
RATIO = float(np.sin((BETA + ALPHA) / 2.0) / np.sin((BETA - ALPHA) / 2.0))
START, RATE, DURATION = np.radians(50.0), 4.0, 1.2  # rad, rad/s, s
GRAVITY = (0.5, -2.0, -9.5)
MASSES = ((0.3, 0.2, 0.02), (0.2, 0.7, -0.03))  # kg; share of the length; m off the link along z, of every link
SOURCE = "closed form (Bennett 1903)"


def follower(crank):
    """theta_2 of theta_1 [rad], in (0, 2 pi)."""
    return 2.0 * jnp.arctan2(RATIO * jnp.cos(crank / 2.0), jnp.sin(crank / 2.0))


def _link(name: str, length: float, sign: float) -> Link:
    points = tuple(PointMass(m, (sign * share * length, 0.0, off)) for m, share, off in MASSES)
    return Link(name, length, MASSLESS, rigid=True, point_masses=points)


def mechanism() -> Mechanism:
    """Base and coupler of length b, crank and rocker of length a; the rocker's far end is at -a on its x axis."""
    links = _link("crank", A, 1.0), _link("coupler", B, 1.0), _link("rocker", A, -1.0)
    second = float(follower(START))
    joints = (
        Joint("A", "base", "crank", angle=START),
        Joint("B", "crank", "coupler", orientation=(ALPHA, 0.0, 0.0), angle=second),
        Joint("D", "base", "rocker", position=(-B, 0.0, 0.0), orientation=(-BETA, 0.0, 0.0), angle=second),
        Joint("C", "coupler", "rocker", cut=True, orientation=(BETA, 0.0, 0.0), child_position=(-A, 0.0, 0.0),
              child_orientation=(-ALPHA, 0.0, 0.0)),
    )  # fmt: skip
    return Mechanism(links, joints, gravity=GRAVITY, driven_joint="A", redundant_reactions="minimum_norm")


def _rotation(axis: int, angle):
    c, s, one, none = jnp.cos(angle), jnp.sin(angle), jnp.ones_like(angle), jnp.zeros_like(angle)
    about_x = jnp.array([[one, none, none], [none, c, -s], [none, s, c]])
    about_y = jnp.array([[c, none, s], [none, one, none], [-s, none, c]])
    return about_x if axis == 0 else about_y


def points(crank):
    """Places (6, 3) [m] of all point masses at a crank angle, from the closed form."""
    second, alpha, beta = follower(crank), jnp.asarray(ALPHA), jnp.asarray(BETA)
    first = _rotation(1, crank)
    coupler = first @ _rotation(0, alpha) @ _rotation(1, second)
    rocker = _rotation(0, -beta) @ _rotation(1, second)
    b, d = first @ jnp.array([A, 0.0, 0.0]), jnp.array([-B, 0.0, 0.0])
    links = ((jnp.zeros(3), first, A), (b, coupler, B), (d, rocker, -A))
    return jnp.stack(
        [at + axes @ jnp.array([share * reach, 0.0, off]) for at, axes, reach in links for _, share, off in MASSES]
    )


def drive_moment(crank: Float[Array, ""]) -> Float[Array, ""]:
    """Moment [N m] that turns the crank at the constant rate: derivative of the energy along its angle."""
    masses = jnp.array([m for m, _, _ in MASSES] * 3)

    def energy(angle):
        velocity = RATE * jax.jvp(points, (angle,), (jnp.ones_like(angle),))[1]
        kinetic = 0.5 * jnp.sum(masses * jnp.sum(velocity**2, axis=1))
        return kinetic - jnp.sum(masses * (points(angle) @ jnp.array(GRAVITY)))

    return jax.grad(energy)(crank)


def simulated() -> Run:
    """The crank turns at a constant rate."""
    return simulate(
        Simulation(
            discretise(mechanism()),
            drive=PrescribedRate("A", RATE),
            duration=DURATION,
            method=RungeKutta4(step=1e-3),
            save_every=0.04,
        )
    )


def validate(full: bool, progress: Progress) -> Outcome:
    """Mobility, angles and drive moment."""
    del full
    structure = describe(discretise(mechanism()))
    found = f"mobility {structure.mobility}, rank {structure.rank} of {structure.constraints}"
    group = "Bennett linkage"
    lines: list[Line] = [same(group, "closure", found, "mobility 1, rank 2 of 5", SOURCE)]
    run = simulated()
    crank = jnp.asarray(run.motion.angle)
    for joint in "BD":
        off = np.asarray(run.motion.angles[joint]) - np.asarray(follower(crank))
        off = np.abs(off - 2.0 * np.pi * np.round(off / (2.0 * np.pi))).max()
        lines.append(absolute(group, f"angle of {joint}, largest difference", off, 0.0, 1e-8, SOURCE, "rad"))
    known, ours = np.asarray(jax.jit(jax.vmap(drive_moment))(crank)), np.asarray(run.motion.drive_moment)
    at = int(np.argmax(np.abs(ours - known)))
    allowed = 1e-7 * float(np.abs(known).max())
    name = f"drive moment at {float(run.times[at]):.3g} s"
    lines.append(absolute(group, name, ours[at], known[at], allowed, "derivative of the energy, closed form", "N m"))
    progress(1.0)
    return Outcome(lines)
