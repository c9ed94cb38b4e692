"""What is compared with Exudyn beside the main study: studies, and small mechanisms with joints of all other kinds.

Place in the pipeline: **exudyn_cases** -> exudyn_studies.  Units: SI, rad.
"""

from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from rfem_jax import Joint, Link, Material, Mechanism, MomentRamp, Rectangle, load_study
from rfem_jax.description import JointFriction, JointSpring, PointSpring
from rfem_jax.validation import nonideal_joints, spatial_linkages
from rfem_jax.validation.rigid_links import angles_of, body, turn_x, turn_y, turn_z

STUDIES = Path(__file__).parents[1] / "studies"
DOWN = (0.0, 0.0, -9.81)


class Case(NamedTuple):
    """What is compared: title; mechanism; errors by name; drive; duration [s]; steps of a saved interval, ours and
    Exudyn's shortest; largest differences of positions [rad, m], and of forces and moments over the largest; saved
    intervals, of which the drive's jumps must be ends: Exudyn's steps begin anew there."""

    title: str
    mechanism: Mechanism
    errors: dict
    drive: object
    duration: float
    steps: tuple[int, int]
    limits: tuple[float, float]
    saved: int = 50


def of_study(name: str, case: str, steps: tuple[int, int], limits: tuple[float, float], saved: int = 50) -> Case:
    """A case of a study in `studies`."""
    study = load_study(STUDIES / name / "study.toml")
    errors = {one.name: one.errors for one in study.cases}[case]
    return Case(f"{name}, {case}", study.mechanism, errors, study.drive, study.duration, steps, limits, saved)


def studies() -> list[Case]:
    """The studies that are compared, also by time."""
    return [
        of_study("four_bar", "P5", (400, 400), (1e-5, 1e-3)),
        of_study("slider_crank", "guide_tilted", (200, 200), (1e-6, 3e-4)),
        of_study("spatial_linkage", "coupler_ball_aside", (200, 200), (1e-5, 1e-3)),
        of_study("six_bar_press", "guide_tilted", (400, 400), (1e-5, 1e-3), saved=55),
    ]


def other_kinds() -> list[Case]:
    """Mechanisms whose joints, springs and friction are of the kinds that the studies do not have."""
    ramp = MomentRamp("A", 1.2, 0.05)
    tilt = {"C.delta_z": 5e-3, "D.delta_x": 2e-3, "D.child.delta_z": 2e-3}
    aside = {"D.delta_x": 2e-3, "F.d_y": 1e-3, "F.child.delta_y": 1e-2}
    slanted = {"P.delta_x": 3e-3, "P.d_y": 1e-3, "P.child.delta_z": 5e-3, "C.d_z": 1e-3}
    askew = {"F.delta_x": 2e-3, "F.d_y": 2e-4, "F.child.delta_z": 3e-3, "D.delta_z": 2e-3}
    turned = {"A.delta_x": 5e-3, "A.child.d_z": 1e-3}
    slow, strong = MomentRamp("A", 0.3, 0.05), MomentRamp("A", 1.5, 0.1)
    bent = nonideal_joints.TILTED
    return [
        Case("R-S-U-R, flexible, U cut", spatial_linkages.rsur_flexible(3), tilt, ramp, 0.1, (400, 400), (1e-5, 1e-3)),
        Case("R-S-R-C and a bracket", spatial_linkages.rsrc(), aside, ramp, 0.1, (100, 100), (1e-5, 1e-3)),
        Case("R-S-U-R, rigid, S cut", spatial_linkages.rsur(), tilt, ramp, 0.1, (100, 100), (1e-5, 1e-3)),
        Case("plate on a table, planar", plate(False), slanted, slow, 0.1, (100, 100), (1e-5, 1e-3)),
        Case("plate on a table, free, planar cut", plate(True), slanted, slow, 0.1, (100, 100), (1e-5, 1e-3)),
        Case("motor on springs, free", motor(), turned, slow, 0.1, (100, 100), (1e-5, 1e-3)),
        Case("four-bar with a weld, fixed cut", welded(), askew, ramp, 0.1, (400, 400), (1e-5, 1e-3)),
        Case("four-bar, constant friction", with_friction(), bent, strong, 0.2, (400, 400), (1e-5, 1e-3)),
        Case("four-bar, friction by loads", by_load(), bent, strong, 0.2, (400, 400), (1e-5, 1e-3)),
    ]  # fmt: skip


def plate(cut: bool) -> Mechanism:
    """A plate on a slanted table, pushed by a crank's rod against springs; its planar joint in the tree, with
    a spring along it, or cut and the plate free."""
    seat, place, radius, start = turn_z(np.radians(5.0)) @ turn_x(np.radians(8.0)), (0.26, 0.03, 0.02), 0.06, -1.0
    crank = turn_y(start)
    rod = np.array(place) - crank @ [radius, 0.0, 0.0]
    length = float(np.linalg.norm(rod))
    y = np.cross(seat[:, 2], rod)
    y /= np.linalg.norm(y)
    axes = np.stack([rod / length, y, np.cross(rod / length, y)], axis=1)
    links = (
        body("crank", radius, 0.3, (0.03, 0.002, 0.002), (5e-5, 3e-4, 2.8e-4)),
        body("rod", length, 0.2, (0.11, 0.001, 0.002), (2e-5, 9e-4, 9e-4)),
        body("plate", 0.1, 0.8, (0.01, 0.02, -0.02), (8e-4, 1.5e-3, 9e-4)),
    )
    tilts = angles_of(seat)
    on_table = Joint("P", "base", "plate", kind="planar", position=place, orientation=tilts, cut=cut,
                     child_position=(0, 0, 0))  # fmt: skip
    free = Joint("K", "base", "plate", kind="free", position=place, orientation=tilts)
    joints = (
        Joint("A", "base", "crank", angle=start),
        Joint("B", "crank", "rod", kind="spherical", start=angles_of(crank.T @ axes)),
        *((free, on_table) if cut else (on_table,)),
        Joint("C", "rod", "plate", kind="universal", cut=True, child_position=(0, 0, 0)),
    )
    springs = (
        PointSpring("above", ("base", "plate"), ((0.3, 0.0, 0.3), (0.05, 0.0, 0.03)), 2e3, 2.0, 0.24),
        PointSpring("beside", ("base", "plate"), ((0.5, 0.02, 0.0), (0.05, 0.01, -0.03)), 3e3, 1.0, 0.2),
    )
    along = JointSpring("along", "P", stiffness=500.0, damping=1.0, rest=0.01, preload=1.0, motion="T_x")
    forces = springs if cut else (*springs, along)
    return Mechanism(links, joints, gravity=DOWN, driven_joint="A", forces=forces, start="equilibrium")


def motor() -> Mechanism:
    """A body that only springs hold; on it a rotor with a spring that is not balanced, its axis askew."""
    links = (
        body("block", 0.1, 2.0, (0.01, 0.0, 0.02), (8e-3, 1e-2, 1.2e-2)),
        body("rotor", 0.08, 0.4, (0.04, 0.005, 0.01), (2e-4, 6e-4, 5e-4)),
    )
    joints = (
        Joint("K", "base", "block", kind="free"),
        Joint("A", "block", "rotor", position=(0.03, 0.02, 0.05), orientation=(0.2, 0.0, 0.1), angle=0.4),
    )
    ends = {
        "a": ((0.1, 0.1, -0.2), (0.1, 0.1, 0.0)),
        "b": ((-0.1, 0.1, -0.2), (-0.1, 0.1, 0.0)),
        "c": ((0.0, -0.1, -0.2), (0.0, -0.1, 0.0)),
        "d": ((0.3, 0.05, 0.0), (0.1, 0.05, 0.0)),
        "e": ((0.05, 0.3, 0.02), (0.05, 0.1, 0.02)),
        "f": ((-0.05, 0.3, 0.0), (-0.05, 0.1, 0.0)),
    }
    springs = (PointSpring(name, ("base", "block"), points, 2e4, 4.0, 0.2) for name, points in ends.items())
    coil = JointSpring("coil", "A", stiffness=0.6, damping=2e-3, rest=0.3, preload=0.05)
    return Mechanism(links, joints, gravity=DOWN, driven_joint="A", forces=(coil, *springs), start="equilibrium")


def welded() -> Mechanism:
    """A four-bar whose coupler is welded of two halves; coupler and rocker are flexible."""
    steel = Material("steel", youngs_modulus=210e9, density=7850.0, poisson_ratio=0.3, damping=1e-5)
    bar = Rectangle(0.01, 0.01)
    crank, coupler, rocker = -np.pi / 2.0, -0.62161444632, -1.75896545305
    links = (
        Link("crank", 0.12, bar, steel, rigid=True),
        *(
            Link(name, length, bar, steel, rfes=2)
            for name, length in (("left", 0.15), ("right", 0.15), ("rocker", 0.3))
        ),
    )
    joints = (
        Joint("A", "base", "crank", angle=crank),
        Joint("B", "crank", "left", angle=coupler - crank),
        Joint("D", "base", "rocker", position=(0.3, 0.0, 0.0), angle=rocker),
        Joint("C", "rocker", "right", angle=coupler + np.pi - rocker),
        Joint("F", "left", "right", kind="fixed", cut=True, child_orientation=(0.0, np.pi, 0.0)),
    )
    return Mechanism(links, joints, driven_joint="A", elements="geometrically_exact")


def by_load() -> Mechanism:
    """The flexible four-bar of the validation, whose hinges rub by their loads, with two rfes a link."""
    whole = nonideal_joints.flexible()
    return replace(whole, links=[link if link.rigid else replace(link, rfes=2) for link in whole.links])


def with_friction() -> Mechanism:
    """The same with friction that does not depend on the loads."""
    moments = zip(nonideal_joints.JOINTS, nonideal_joints.CONSTANT, strict=True)
    friction = (JointFriction(f"at_{joint}", joint, constant=moment, viscous=1e-3, sliding_rate=0.5)
                for joint, moment in moments)  # fmt: skip
    return replace(by_load(), forces=tuple(friction))
