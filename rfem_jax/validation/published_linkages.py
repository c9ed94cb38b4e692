"""Published linkages: the spatial slider-crank of the IFToMM library, four loops of the Modelica library.

Place in the pipeline: a benchmark of `catalogue`. Reference values: `references/published_linkages.json`.

The slider-crank exists in variants: here, as in the published solution, the cross of the universal joint turns in the
slider about the sliding direction, and the rod's inertia about its own axis is the small one. Fourbar1 has three
hinges for its spherical joint and two for its universal joint, between which nothing has mass; Fourbar2 is the same
with a rod without mass. Engine1a is a planar slider-crank with a flywheel; its planar loop has here a spherical crank
pin and a cylindrical wrist pin; EngineV6 has six of these (`v6_engine`).
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from rfem_jax.description import Joint, Link, Mechanism, PointMass, RungeKutta4
from rfem_jax.mechanics.model.discretisation import discretise
from rfem_jax.simulation import Run, Simulation, simulate
from rfem_jax.validation import v6_engine
from rfem_jax.validation.lines import Curve, Line, Outcome, Picture, Progress, absolute, relative
from rfem_jax.validation.reference_values import read_reference
from rfem_jax.validation.rigid_links import MASSLESS, along, angles_of, cylinder, rate_of, start_at_rate, turn_y, turn_z
from rfem_jax.validation.spatial_linkages import run_rsup

REFERENCE = read_reference("published_linkages")
SLIDER = 1e-4  # m
ANGLE, RATE = 5e-5, 2e-4  # shares: Dymola integrated with a relative tolerance of 1e-6 a step
LIGHT = 1e-8  # share of its density that is left of a rod without mass
CRANK, SLIDER_ARM, ROD = (0.0, 0.5, 0.1), (0.0, 0.2, 0.0), (-1.0, 0.3, 0.1)  # m
DIAMETER, DENSITY, GRAVITY = 0.05, 7700.0, 9.80665  # m, kg/m^3, m/s^2


def fourbar(rod_density: float) -> Mechanism:
    """A crank that turns about the global x, a rod [kg/m^3] between a ball on it and a universal joint, a slider along
    x."""
    axes = {"crank": along(CRANK), "arm": along(SLIDER_ARM), "rod": along(ROD)}
    vectors = {"crank": CRANK, "arm": SLIDER_ARM, "rod": ROD}
    links = tuple(
        cylinder(name, float(np.linalg.norm(vector)), DIAMETER, rod_density if name == "rod" else DENSITY)
        for name, vector in vectors.items()
    )
    about_x = turn_z(-np.pi / 2.0)

    def on_child(name, seat):
        """The joint's axes on a link, in the link's own, where they are `seat` in global ones at the start."""
        return angles_of(axes[name].T @ seat)

    fixed = np.eye(3)
    joints = (
        Joint("A", "base", "crank", orientation=angles_of(about_x), child_orientation=on_child("crank", about_x)),
        Joint("G", "base", "arm", kind="prismatic", position=(1.2, 0.0, 0.0), displacement=-0.2,
              child_orientation=on_child("arm", fixed)),
        Joint("C", "arm", "rod", kind="universal", orientation=on_child("arm", fixed),
              child_orientation=on_child("rod", fixed)),
        Joint("B", "crank", "rod", kind="spherical", cut=True),
    )  # fmt: skip
    return Mechanism(links, joints, gravity=(0.0, -GRAVITY, 0.0), driven_joint="A")


def _box(length: float, width: float, height: float, x: float) -> PointMass:
    """A box whose mass centre is at x [m] on the link's axis; only its inertia about y counts."""
    mass = DENSITY * length * width * height
    inertia = mass * (length**2 + height**2) / 12.0
    return PointMass(mass, (x, 0.0, 0.0), (inertia, inertia, inertia))


def _shaft(diameter: float, x: float) -> PointMass:
    """A cylinder across the plane at x [m], 0.1 m long."""
    mass = DENSITY * np.pi * diameter**2 / 4.0 * 0.1
    inertia = mass * diameter**2 / 8.0
    return PointMass(mass, (x, 0.0, 0.0), (inertia, inertia, inertia))


def engine() -> Mechanism:
    """Crankshaft with a flywheel of 1 kg m^2, rod and piston; the library's axes x, y, z are here y, z, x."""
    flywheel = PointMass(1e-9, (0.0, 0.0, 0.0), (1.0, 1.0, 1.0))
    web = _box(0.1, 0.02, 0.05, 0.05)
    parts: Sequence[tuple[str, float, tuple[PointMass, ...]]] = (
        ("crank", 0.1, (flywheel, _shaft(0.05, 0.0), web, web, _shaft(0.03, 0.1))),
        ("piston", 0.1, (_shaft(0.1, 0.0),)),  # it does not turn, and the line of its mass centre is the guide's
        ("rod", 0.2, (_box(0.2, 0.02, 0.06, 0.1),)),
    )
    links = tuple(Link(name, length, MASSLESS, rigid=True, point_masses=points) for name, length, points in parts)
    up = angles_of(turn_y(-np.pi / 2.0))
    joints = (
        Joint("A", "base", "crank", angle=-np.pi / 2.0),
        Joint("G", "base", "piston", kind="prismatic", orientation=up, displacement=0.3),
        Joint("C", "piston", "rod", kind="cylindrical", position=(0, 0, 0), child_position=(0.2, 0, 0)),
        Joint("B", "crank", "rod", kind="spherical", cut=True, child_position=(0, 0, 0)),
    )
    return Mechanism(links, joints, gravity=(0.0, 0.0, -GRAVITY), driven_joint="A")


class Loop(NamedTuple):
    """A model of the library: what makes the mechanism, what is compared, rate of the driven joint at the start
    [rad/s], duration and step [s]."""

    make: Callable[[], Mechanism]
    compared: str
    rate: float
    duration: float = 5.0
    step: float = 1e-3


MODELICA = {
    "Fourbar1": Loop(lambda: fourbar(DENSITY), "angle of j1", 5.235987755983),
    "Fourbar2": Loop(lambda: fourbar(LIGHT * DENSITY), "angle of j1", 5.235987755983),
    "Engine1a": Loop(engine, "angle of the crankshaft", 10.0),
    "EngineV6": Loop(
        v6_engine.mechanism, "angle of the crankshaft", v6_engine.RATE, v6_engine.DURATION, v6_engine.STEP
    ),
}


def run_modelica(name: str) -> Run:
    """Released at a rate of the driven joint."""
    loop = MODELICA[name]
    model = discretise(loop.make())
    return simulate(
        Simulation(
            model,
            drive=None,
            duration=loop.duration,
            method=RungeKutta4(step=loop.step),
            save_every=min(0.1, loop.duration),
            start=start_at_rate(model, rate_of(loop.rate)),
        )
    )


def _at(run: Run, named: str) -> int:
    return int(np.argmin(np.abs(np.asarray(run.times) - float(named))))


def slider_crank_lines(run: Run) -> list[Line]:
    """Place of the slider."""
    quantity, slide = REFERENCE.quantities["slider"], np.asarray(run.motion.displacements["G"])
    return [
        absolute("IFToMM spatial slider-crank", f"slider at {named} s", slide[_at(run, named)], known, SLIDER,
                 quantity.label, "m")
        for named, known in quantity.values.items()
    ]  # fmt: skip


def modelica_lines(name: str, run: Run) -> list[Line]:
    """Angle turned and rate of the driven joint."""
    lines, turned = [], np.asarray(run.motion.angle) - float(run.motion.angle[0])
    for key, values, share in (("angle", turned, ANGLE), ("rate", np.asarray(run.motion.rate), RATE)):
        quantity = REFERENCE.quantities[f"modelica_{key}"]
        for named, known in quantity.values.get(name, {}).items():
            title = f"{MODELICA[name].compared.replace('angle', key)} at {named} s"
            value = values[_at(run, named)]
            lines.append(relative(f"Modelica {name}", title, value, known, share, quantity.label, quantity.unit))
    return lines


def validate(full: bool, progress: Progress) -> Outcome:
    """Five seconds of each, one of the engine of six cylinders."""
    del full
    run = run_rsup("x")
    lines = slider_crank_lines(run)
    quantity = REFERENCE.quantities["slider"]
    times = np.array([float(named) for named in quantity.values])
    curves = (
        Curve("ours", np.asarray(run.times), np.asarray(run.motion.displacements["G"])),
        Curve(quantity.label, times, np.array(list(quantity.values.values())), True),
    )
    progress(0.25)
    for number, name in enumerate(MODELICA):
        lines += modelica_lines(name, run_modelica(name))
        progress(0.25 + 0.75 * (number + 1) / len(MODELICA))
    picture = Picture("spatial_slider_crank", "IFToMM spatial slider-crank: slider", "t, s", "m", curves)
    return Outcome(lines, [picture])
