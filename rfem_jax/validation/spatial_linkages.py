"""Spatial linkages: spherical, universal, prismatic, cylindrical and fixed joints, rigid and flexible links.

Place in the pipeline: a benchmark of `catalogue`; letters are the joints in order: R revolute, S spherical,
U universal, P prismatic, C cylindrical. Reference values: `references/spatial_linkages.json`.

A joint whose parent and child are exchanged here has the same resultants as the reference's.
"""

from collections.abc import Callable

import numpy as np

from rfem_jax.description import Joint, Link, Material, Mechanism, MomentRamp, Rectangle, RungeKutta4
from rfem_jax.mechanics.model.discretisation import discretise
from rfem_jax.simulation import Run, Simulation, simulate
from rfem_jax.validation.joint_cases import Shares, checked
from rfem_jax.validation.lines import Line, Outcome, Progress, absolute
from rfem_jax.validation.reference_values import read_reference
from rfem_jax.validation.rigid_links import (
    Axes,
    angles_of,
    body,
    one_turn,
    rate_of,
    start_at_rate,
    start_without_spin,
    turn_x,
    turn_y,
    turn_z,
)

REFERENCE = read_reference("spatial_linkages")
RIGID = Shares(rms=1e-6, instant=1e-6, motion=1e-7)
EXACT = Shares(rms=1e-7, instant=1e-6, motion=1e-7)
RATE = 25.0  # rad/s, of the crank of RSSR
DOWN = (0.0, 0.0, -9.81)


class SpatialFourBar:
    """The closed start of a spatial four-bar A-B-C-D whose hinge D is tilted: axes of the links in global axes."""

    START, D, TILTS = -np.pi / 6.0, (0.22, 0.1, 0.03), (np.radians(25.0), np.radians(40.0))
    CRANK, COUPLER, ROCKER = 0.08, 0.26, 0.2

    def __init__(self):
        seat = turn_z(self.TILTS[1]) @ turn_x(self.TILTS[0])
        self.crank = turn_y(self.START)
        b = self.crank @ [self.CRANK, 0, 0]
        u = seat.T @ (b - np.array(self.D))
        k = (u @ u + self.ROCKER**2 - self.COUPLER**2) / (2.0 * self.ROCKER)
        self.angle = float(np.arctan2(-u[2], u[0]) - np.arccos(k / np.hypot(u[0], u[2])))
        self.rocker = seat @ turn_y(self.angle)
        x = (np.array(self.D) + self.rocker @ [self.ROCKER, 0, 0] - b) / self.COUPLER
        z = np.cross(x, self.rocker[:, 1])
        z /= np.linalg.norm(z)
        self.coupler = np.stack([x, np.cross(z, x), z], axis=1)

    def joints(self, *others: Joint) -> tuple[Joint, ...]:
        """A and D, and others."""
        tilts = (self.TILTS[0], 0.0, self.TILTS[1])
        rocker = Joint("D", "base", "rocker", position=self.D, orientation=tilts, angle=self.angle)
        return Joint("A", "base", "crank", angle=self.START), rocker, *others

    def links(self, coupler: Link | None = None) -> tuple[Link, ...]:
        """Crank, coupler (None: rigid) and rocker."""
        rigid = body("coupler", self.COUPLER, 0.3, (0.12, 0, 0), (2e-5, 1.9e-3, 1.9e-3))
        return (
            body("crank", self.CRANK, 0.25, (0.03, 0.004, 0.002), (5e-5, 2.2e-4, 2e-4)),
            coupler or rigid,
            body("rocker", self.ROCKER, 0.35, (0.09, -0.005, 0.003), (8e-5, 1.4e-3, 1.35e-3)),
        )

    def ball_at_b(self) -> Joint:
        """The spherical joint of the tree between crank and coupler."""
        return Joint("B", "crank", "coupler", kind="spherical", start=angles_of(self.crank.T @ self.coupler))


def rssr(coupler: Link | None = None) -> Mechanism:
    """Two spherical joints: the coupler may spin about its axis."""
    bar = SpatialFourBar()
    ball = Joint("C", "coupler", "rocker", kind="spherical", cut=True)
    return Mechanism(bar.links(coupler), bar.joints(bar.ball_at_b(), ball), driven_joint="A")


def rsur() -> Mechanism:
    """A universal joint on the rocker, in the tree; rigid."""
    bar = SpatialFourBar()
    between = bar.rocker.T @ bar.coupler
    angles = np.arctan2(between[0, 2], between[2, 2]), np.arctan2(between[1, 0], between[1, 1])
    universal = Joint("C", "rocker", "coupler", kind="universal", child_position=(bar.COUPLER, 0, 0), start=angles)
    ball = Joint("B", "crank", "coupler", kind="spherical", cut=True, child_position=(0, 0, 0))
    return Mechanism(bar.links(), bar.joints(universal, ball), driven_joint="A")


def rsur_flexible(rfes: int = 5) -> Mechanism:
    """The same with a flexible coupler; the universal joint is cut, its axes z of the coupler and y of the rocker."""
    bar = SpatialFourBar()
    steel = Material("steel", youngs_modulus=210e9, density=7850.0, poisson_ratio=0.3, damping=1e-5)
    coupler = Link("coupler", bar.COUPLER, Rectangle(0.006, 0.009), steel, rfes=rfes)
    quarter = (np.pi / 2, 0.0, 0.0)
    universal = Joint("C", "coupler", "rocker", kind="universal", cut=True, orientation=quarter,
                      child_orientation=quarter)  # fmt: skip
    joints = bar.joints(bar.ball_at_b(), universal)
    return Mechanism(bar.links(coupler), joints, driven_joint="A", elements="geometrically_exact")


def rsup(cross: str) -> Mechanism:
    """A spatial slider-crank; the axis of the universal joint's cross in the slider is its "x" or its "y", the one in
    the rod is normal to this axis and to the rod."""
    seat, radius, rod = turn_z(-np.pi / 2.0), 0.08, 0.3
    above, crank_pin = (0.0, 0.1, 0.12), np.array([0.0, 0.1, 0.2])
    start = float(np.sqrt(rod**2 - crank_pin @ crank_pin))
    along = (np.array([start, 0.0, 0.0]) - crank_pin) / rod
    in_slider = np.eye(3)["xyz".index(cross)]

    def axes(y: Axes) -> Axes:
        """x: the rod; z: normal to it and to y."""
        z = np.cross(along, y) / np.linalg.norm(np.cross(along, y))
        return np.stack([along, np.cross(z, along), z], axis=1)

    frame = axes(np.array([0.0, 1.0, 0.0]))
    z = axes(in_slider)[:, 2]
    of_joint = np.stack([np.cross(in_slider, z), in_slider, z], axis=1)
    links = (
        body("crank", radius, 0.12, (0.04, 0, 0), (1e-5, 1e-4, 1e-4)),
        body("slider", 0.05, 2.0, (0, 0, 0), (1e-4, 1e-4, 1e-4)),
        body("rod", rod, 0.5, (0.15, 0, 0), (4e-4, 4e-3, 4e-3)),
    )
    joints = (
        Joint("A", "base", "crank", position=above, orientation=angles_of(seat), angle=-np.pi / 2.0),
        Joint("G", "base", "slider", kind="prismatic", displacement=start),
        Joint("C", "slider", "rod", kind="universal", position=(0, 0, 0), orientation=angles_of(of_joint),
              child_position=(rod, 0, 0), child_orientation=angles_of(frame.T @ of_joint)),
        Joint("B", "crank", "rod", kind="spherical", cut=True, child_position=(0, 0, 0)),
    )  # fmt: skip
    return Mechanism(links, joints, gravity=DOWN, driven_joint="A")


def rsrc() -> Mechanism:
    """A tilted cylindrical joint that slides, and a bracket on a fixed joint."""
    crank, coupler, rocker = -np.pi / 3.0, -0.549669951459, -1.604931720920
    links = (
        body("crank", 0.08, 0.3, (0.03, 0.002, 0.002), (5e-5, 3e-4, 2.8e-4)),
        body("rocker", 0.2, 0.35, (0.09, -0.002, 0.003), (8e-5, 1.3e-3, 1.25e-3)),
        body("coupler", 0.25, 0.4, (0.11, 0.003, -0.004), (9e-5, 2.2e-3, 2.15e-3)),
        body("bracket", 0.05, 0.15, (0.02, 0.03, 0.01), (6e-5, 5e-5, 4e-5)),
    )
    joints = (
        Joint("A", "base", "crank", angle=crank),
        Joint("D", "base", "rocker", kind="cylindrical", position=(0.26, 0.015, 0),
              orientation=(np.radians(12.0), 0, np.radians(-8.0)), angle=rocker),
        Joint("C", "rocker", "coupler", child_position=(0.25, 0, 0), angle=coupler - rocker),
        Joint("F", "rocker", "bracket", kind="fixed", position=(0.12, 0, 0),
              orientation=(np.radians(30.0), 0, np.radians(20.0))),
        Joint("B", "crank", "coupler", kind="spherical", cut=True, child_position=(0, 0, 0)),
    )  # fmt: skip
    return Mechanism(links, joints, driven_joint="A")


def run_rssr() -> Run:
    """One turn at a constant rate."""
    return one_turn(rssr(), RATE, 1000, lambda model: start_without_spin(model, rate_of(RATE)))


def run_with_ramp(mechanism: Mechanism, moment: float, duration: float, step: float) -> Run:
    """From rest under a moment that grows for 50 ms and ends."""
    drive, method = MomentRamp("A", moment, 0.05), RungeKutta4(step=step)
    return simulate(Simulation(discretise(mechanism), drive=drive, duration=duration, method=method, save_every=0.05))


def run_rsup(cross: str) -> Run:
    """Five seconds, let go with the crank up at 6 rad/s."""
    model = discretise(rsup(cross))
    start, method = start_at_rate(model, rate_of(6.0)), RungeKutta4(step=5e-4)
    return simulate(Simulation(model, drive=None, duration=5.0, method=method, save_every=0.05, start=start))


def rigid_runs() -> dict[str, tuple[str, Callable[[], Run]]]:
    """Cases of the reference with rigid links: heading, and what runs them."""
    return {
        "RSSR": ("RSSR", run_rssr),
        "RSUR rigid": ("RSUR", lambda: run_with_ramp(rsur(), 1.2, 0.3, 2e-4)),
        "RSRC": ("RSRC with a bracket", lambda: run_with_ramp(rsrc(), 1.0, 0.4, 2e-4)),
        "RSUP": ("RSUP", lambda: run_rsup("y")),
    }


def rigid_lines(case: str, run: Run) -> list[Line]:
    """A case with rigid links; of RSUP also the crank angle by quadrature of the energy."""
    group = rigid_runs()[case][0]
    lines = checked(REFERENCE, case, group, run, RIGID, duration=2.0 if case == "RSUP" else None)
    quantity, times = REFERENCE.quantities["quadrature"], np.asarray(run.times)
    for named, known in quantity.values.items() if case == "RSUP" else ():
        value = np.asarray(run.motion.angle)[np.argmin(np.abs(times - float(named)))]
        name = f"crank angle at {named} s, energy"
        lines.append(absolute(group, name, value, known, 1e-7, quantity.label, "rad"))
    return lines


def validate(full: bool, progress: Progress) -> Outcome:
    """Rigid links, then the flexible coupler."""
    del full
    lines: list[Line] = []
    for number, (case, (_, run)) in enumerate(rigid_runs().items()):
        lines += rigid_lines(case, run())
        progress(0.15 * (number + 1))
    run = run_with_ramp(rsur_flexible(), 1.2, 0.3, 1e-5)
    lines += checked(REFERENCE, "RSUR flexible", "RSUR, flexible coupler", run, EXACT)
    progress(1.0)
    return Outcome(lines)
