"""Planar four-bars whose coupler draws a line nearly straight: Hoecken's, over ranges of its crank.

Place in the pipeline: a benchmark of `catalogue`. Reference values: `references/straight_lines.json`, a published table
of dimensions, strokes, speeds and errors. The crank is the unit of length.
"""

import numpy as np
from jaxtyping import Float

from rfem_jax.description import Joint, Mechanism, Point
from rfem_jax.mechanics.model.discretisation import discretise
from rfem_jax.simulation.outcome.run import PointPath
from rfem_jax.simulation.rest.statics import inverse_dynamics
from rfem_jax.validation.lines import Line, Outcome, Progress, absolute
from rfem_jax.validation.reference_values import read_reference
from rfem_jax.validation.rigid_links import body

REFERENCE = read_reference("straight_lines")
STEP = 2.0  # deg, of the places of the crank: that of the table
PLACES = np.radians(np.arange(-90.0, 91.0, STEP))  # of all ranges, so that one program serves all
DIMENSION = 0.0125  # the table rounds multiples of it to three decimals
TITLES = {"straightness": "least deviation", "velocity": "least spread of the speed"}


def four_bar(
    lengths: tuple[float, float, float], ground: float, point: tuple[float, float], crank: float, side: float = 1.0
) -> Mechanism:
    """Crank, coupler and rocker of these lengths, with the point P of the coupler at `point` along and across it.

    `ground`: distance of the base hinges along x; `crank`: its angle about y [rad]; `side`: of the line from its pin to
    the second base hinge on which the loop is closed, 1 above (z) and -1 below.
    """
    pin, other = lengths[0] * np.array([np.cos(crank), -np.sin(crank)]), np.array([ground, 0.0])
    apart = other - pin
    distance = np.hypot(*apart)
    along = (distance**2 + lengths[1] ** 2 - lengths[2] ** 2) / (2.0 * distance)
    across = side * np.sqrt(lengths[1] ** 2 - along**2)
    end = pin + (along * apart + across * np.array([-apart[1], apart[0]])) / distance
    coupler, rocker = (-np.arctan2(*(end - at)[::-1]) for at in (pin, other))
    links = tuple(
        body(name, length, 1.0, (0.5 * length, 0.0, 0.0), (0.01, 0.01, 0.01))
        for name, length in zip(("crank", "coupler", "rocker"), lengths, strict=True)
    )
    joints = (
        Joint("A", "base", "crank", angle=crank),
        Joint("B", "crank", "coupler", angle=coupler - crank),
        Joint("D", "base", "rocker", position=(ground, 0.0, 0.0), angle=rocker),
        Joint("C", "coupler", "rocker", cut=True),
    )
    return Mechanism(links, joints, driven_joint="A", points=(Point("P", "coupler", (point[0], 0.0, point[1])),))


def hoecken(ground: float, coupler: float) -> Mechanism:
    """Coupler and rocker of one length, P as far beyond the rocker's joint, the crank away from the second hinge."""
    return four_bar((1.0, coupler, coupler), ground, (2.0 * coupler, 0.0), np.pi)


def path_of(mechanism: Mechanism, angles: Float[np.ndarray, " places"]) -> PointPath:
    """Path of P where the crank is at these angles [rad] and turns at 1 rad/s."""
    return inverse_dynamics(discretise(mechanism), {"A": angles}, {"A": 1.0}).points["P"]


def shape(path: PointPath, span: float) -> dict[str, float]:
    """Stroke, speed in the middle, range across the line over the stroke and range of the speed over its mean [%]; of
    a range of the crank [deg] in the middle of the path."""
    half = round(0.5 * span / STEP)
    middle = len(PLACES) // 2
    part = slice(middle - half, middle + half + 1)
    place, speed = np.asarray(path.position)[part], np.asarray(path.velocity)[part, 0]
    stroke = float(np.ptp(place[:, 0]))
    return {
        "stroke": stroke,
        "rate": abs(float(speed[half])),
        "deviation": 100.0 * float(np.ptp(place[:, 2])) / stroke,
        "spread": 100.0 * float(np.ptp(speed) / abs(np.mean(speed))),
    }


def last_digit(quantity: str, table: str, value: float) -> float:
    """The last digit that the table prints of a value."""
    if quantity == "deviation" and value < 1e-3:
        return 1e-5
    return 1e-2 if (quantity, table) == ("spread", "straightness") else 1e-3


def lines_of(table: str, number: int) -> list[Line]:
    """One linkage of one of the tables."""
    span, ground, rounded = (REFERENCE[name][table][number] for name in ("range", "ground", "coupler"))
    coupler = DIMENSION * round(rounded / DIMENSION)
    found, lines = shape(path_of(hoecken(ground, coupler), np.pi + PLACES), span), []
    for name, value in found.items():
        known, unit = REFERENCE[name][table][number], REFERENCE.quantities[name].unit.removeprefix("1")
        allowed = 0.6 * last_digit(name, table, known)
        group = f"Hoecken's linkage, {TITLES[table]}"
        lines.append(absolute(group, f"{name} over {span:g} deg", value, known, allowed, REFERENCE.label, unit))
    return lines


def validate(full: bool, progress: Progress) -> Outcome:
    """Eighteen linkages."""
    del full
    lines, counts = [], {table: len(REFERENCE["range"][table]) for table in TITLES}
    for table, count in counts.items():
        for number in range(count):
            lines += lines_of(table, number)
            progress(len(lines) / (4.0 * sum(counts.values())))
    return Outcome(lines)
