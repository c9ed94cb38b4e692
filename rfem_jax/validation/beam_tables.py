"""Beams under loads along them: the load that each bears and how far it then bends, beside a handbook's table.

Place in the pipeline: a benchmark of `catalogue`. Reference values: `references/beam_tables.json`, coefficients by
which the safe load of a beam on two supports under a uniform load, and its deflection, are to be multiplied.

Every load is a case of the same two beams, one on two supports and one clamped, so that two programs serve all. The
load that a beam bears is that of a given largest bending moment; the deflection is that under this load.
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from rfem_jax.description import DistributedForce, GivenSection, Joint, Link, Mechanism, Point, PointForce
from rfem_jax.mechanics.model.discretisation import discretise
from rfem_jax.mechanics.model.model import Model
from rfem_jax.mechanics.statics.designs import design
from rfem_jax.simulation.rest.statics import StaticLoads, static_loads
from rfem_jax.validation.lines import Line, Outcome, Progress, absolute
from rfem_jax.validation.reference_values import read_reference
from rfem_jax.validation.rigid_links import body

REFERENCE = read_reference("beam_tables")
LENGTH, RIGIDITY = 1.0, 1.0
LOAD = 1e-6  # N, of which the sum of all forces is; bends the beam by parts in a million
RFES = 46  # so that a section lies in the middle of the beam, 45 segments long
SUPPORTED = "Beam on two supports"
CLAMPED = "Clamped beam"
MIDDLE, LOWEST = 0.5, 0.51933  # where a beam on two supports bends most, under a load that rises to one end
# Loads per length at the ends of the left and of the right half, and at the middle, by condition; their sum is 1.
CONDITIONS: Mapping[str, Mapping[str, tuple[float, float, float, float]]] = {
    SUPPORTED: {
        "uniform": (1.0, 1.0, 1.0, 1.0),
        "rising to one end": (0.0, 1.0, 1.0, 2.0),
        "rising to the middle": (0.0, 2.0, 2.0, 0.0),
        "falling to the middle": (2.0, 0.0, 0.0, 2.0),
        "in the middle": (0.0, 0.0, 0.0, 0.0),
    },
    CLAMPED: {
        "uniform": (1.0, 1.0, 1.0, 1.0),
        "at the end": (0.0, 0.0, 0.0, 0.0),
        "rising to the clamp": (2.0, 1.0, 1.0, 0.0),
    },
}


class Borne(NamedTuple):
    """Largest bending moment [N m] and deflection [m] under loads whose sum is `LOAD`."""

    moment: float
    deflection: float

    def beside(self, uniform: "Borne") -> dict[str, float]:
        """Load borne and deflection under it, over those of a beam under a uniform load."""
        load = uniform.moment / self.moment
        return {"load": load, "deflection": load * self.deflection / uniform.deflection}


def beam(supports: str) -> Model:
    """A beam without weight that bends only, along x, with a load along each half and one at a place."""
    section = GivenSection(1e7, 1e7, 1e7, 1.0, RIGIDITY, RIGIDITY, 1e-9, 2e-13, 1e-13, 1e-13)
    links = [Link("beam", LENGTH, section, rfes=RFES)]
    joints = [Joint("A", "base", "beam", kind="fixed")]
    weight, places = LENGTH, (LENGTH,)
    if supports == SUPPORTED:
        links += [body("roller", 0.1, 1e-3, (0.0, 0.0, 0.0), (1e-6, 1e-6, 1e-6))]
        joints = [
            Joint("A", "base", "beam"),
            Joint("R", "base", "roller", kind="prismatic", position=(LENGTH, 0.0, 0.0)),
            Joint("B", "beam", "roller", cut=True, child_position=(0.0, 0.0, 0.0)),
        ]
        weight, places = MIDDLE * LENGTH, (MIDDLE * LENGTH, LOWEST * LENGTH)
    none = (0.0, 0.0, -LOAD)
    forces = (
        DistributedForce("left", "beam", none, none, end=0.5 * LENGTH),
        DistributedForce("right", "beam", none, none, begin=0.5 * LENGTH),
        PointForce("weight", "beam", weight, none),
    )
    points = tuple(Point(f"P{number}", "beam", place) for number, place in enumerate(places))
    made = Mechanism(tuple(links), tuple(joints), gravity=(0.0, 0.0, 0.0), forces=forces, points=points)
    return discretise(made, elements="linear")


def bent(model: Model, supports: str, condition: str) -> Borne:
    """The beam of these supports under a load of the table."""
    ends = CONDITIONS[supports][condition]
    names = ("left.load.z", "left.end_load.z", "right.load.z", "right.end_load.z", "weight.force.z")
    values = [-LOAD / LENGTH * one for one in ends] + [0.0 if any(ends) else -LOAD]
    found = static_loads(model, design=design(model, dict(zip(names, values, strict=True))))
    assert int(found.status[0]) == 0, f"{supports} {condition} has no equilibrium"
    return Borne(_largest_moment(found), max(-float(path.position[0, 2]) for path in found.points.values()))


def _largest_moment(found: StaticLoads) -> float:
    """Largest bending moment: at the support, or of a parabola through the largest at a section and its neighbours."""
    sections = found.recorded["beam.sections"]
    place, first = np.unique(np.round(sections.place, 9), return_index=True)
    moment = np.abs(np.asarray(sections.resultants)[0, 4, first])
    top = int(moment.argmax())
    near = slice(top - 1, top + 2)
    at_support = abs(float(found.loads["A"].moment[0, 1]))
    if at_support > 0.5 * moment[top]:
        return at_support
    curve = np.polynomial.Polynomial.fit(place[near], moment[near], 2)
    return float(curve(np.linspace(place[top - 1], place[top + 1], 101)).max())


def validate(full: bool, progress: Progress) -> Outcome:
    """Eight conditions of support and loading."""
    del full
    lines: list[Line] = []
    uniform = None
    for done, (supports, conditions) in enumerate(CONDITIONS.items(), 1):
        model = beam(supports)
        for condition in conditions:
            found = bent(model, supports, condition)
            uniform = found if uniform is None else uniform
            lines += _lines(supports, condition, found.beside(uniform))
        progress(done / len(CONDITIONS))
    return Outcome(lines)


def _lines(supports: str, condition: str, found: Mapping[str, float]) -> list[Line]:
    """The coefficients of a condition within the last printed digit; whole numbers and fractions are exact."""
    lines = []
    for quantity, value in found.items():
        known, digit = REFERENCE[quantity][supports][condition]
        name = f"load {condition}: {REFERENCE.quantities[quantity].description}"
        lines.append(absolute(supports, name, value, known, 0.6 * digit, REFERENCE.label))
    return lines
