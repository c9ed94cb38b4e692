"""Published spatial linkages: the spatial slider-crank of the IFToMM library, Fourbar1 of the Modelica library.

Place in the pipeline: a benchmark of `catalogue`. Reference values: `references/published_linkages.json`.

The slider-crank exists in variants: here, as in the published solution, the cross of the universal joint turns in the
slider about the sliding direction, and the rod's inertia about its own axis is the small one. Fourbar1 has three
hinges for its spherical joint and two for its universal joint, between which nothing has mass.
"""

import numpy as np

from rfem_jax.description import Joint, Mechanism, Method
from rfem_jax.mechanics.discretisation import discretise
from rfem_jax.simulation import Run, simulate
from rfem_jax.validation.lines import Curve, Line, Outcome, Picture, Progress, absolute, relative
from rfem_jax.validation.reference_values import read_reference
from rfem_jax.validation.rigid_links import along, angles_of, cylinder, rate_of, start_at_rate, turn_z
from rfem_jax.validation.spatial_linkages import run_rsup

REFERENCE = read_reference("published_linkages")
SLIDER = 1e-4  # m
ANGLE, RATE_SHARE = 5e-5, 1e-4  # shares: Dymola integrated with a relative tolerance of 1e-6 a step
CRANK, SLIDER_ARM, ROD = (0.0, 0.5, 0.1), (0.0, 0.2, 0.0), (-1.0, 0.3, 0.1)  # m
DIAMETER, DENSITY, RATE = 0.05, 7700.0, 5.235987755983  # m, kg/m^3, rad/s
STANDARD_GRAVITY = (0.0, -9.80665, 0.0)


def fourbar() -> Mechanism:
    """A crank that turns about the global x, a rod between a ball on it and a universal joint, a slider along x."""
    axes = {"crank": along(CRANK), "arm": along(SLIDER_ARM), "rod": along(ROD)}
    vectors = {"crank": CRANK, "arm": SLIDER_ARM, "rod": ROD}
    links = tuple(cylinder(name, float(np.linalg.norm(vector)), DIAMETER, DENSITY) for name, vector in vectors.items())
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
    return Mechanism(links, joints, gravity=STANDARD_GRAVITY, driven_joint="A")


def run_fourbar() -> Run:
    """Five seconds, released at a rate of the crank."""
    model = discretise(fourbar())
    return simulate(model, drive=None, duration=5.0, method=Method("rk4", step=1e-3), save_every=0.1,
                    start=start_at_rate(model, rate_of(RATE)))  # fmt: skip


def _at(run: Run, named: str) -> int:
    return int(np.argmin(np.abs(np.asarray(run.times) - float(named))))


def slider_crank_lines(run: Run) -> list[Line]:
    """Place of the slider."""
    quantity, slide = REFERENCE.quantities["slider"], np.asarray(run.displacements["G"])
    return [
        absolute("IFToMM spatial slider-crank", f"slider at {named} s", slide[_at(run, named)], known, SLIDER,
                 quantity.label, "m")
        for named, known in quantity.values.items()
    ]  # fmt: skip


def fourbar_lines(run: Run) -> list[Line]:
    """Angle and rate of the crank."""
    lines = []
    for key, values, share in (("angle", run.angle, ANGLE), ("rate", run.rate, RATE_SHARE)):
        quantity = REFERENCE.quantities[f"fourbar_{key}"]
        for named, known in quantity.values.items():
            name, value = f"{key} of j1 at {named} s", np.asarray(values)[_at(run, named)]
            lines.append(relative("Modelica Fourbar1", name, value, known, share, quantity.label, quantity.unit))
    return lines


def validate(full: bool, progress: Progress) -> Outcome:
    """Five seconds of both."""
    del full
    run = run_rsup("x")
    lines = slider_crank_lines(run)
    quantity = REFERENCE.quantities["slider"]
    times = np.array([float(named) for named in quantity.values])
    curves = (
        Curve("ours", np.asarray(run.times), np.asarray(run.displacements["G"])),
        Curve(quantity.label, times, np.array(list(quantity.values.values())), True),
    )
    progress(0.5)
    lines += fourbar_lines(run_fourbar())
    progress(1.0)
    picture = Picture("spatial_slider_crank", "IFToMM spatial slider-crank: slider", "t, s", "m", curves)
    return Outcome(lines, [picture])
