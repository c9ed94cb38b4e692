"""How the time of a simulation grows: with rfes, links, batch, and errors in a gradient; pictures.

    sweep -> Points (size, processor seconds) -> table and log-log picture with a line of slope one

Generalised-alpha, steps of 2.5 ms, all samples of a batch with errors of their own.  Links: a row
of parallelograms, each outboard of the rocker of the one before (a coupler, a rocker, a cut
joint more), driven at the first crank.  Gradients: of the mean-square moments of all joints
(forward mode) or of one (reverse), over the time of one simulation in the same batch.
"""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from speed_timing import STUDY, sample_errors, simulation, timed

from rfem_jax import (
    GeneralisedAlpha,
    Joint,
    Link,
    Material,
    Mechanism,
    MomentRamp,
    Problem,
    Rectangle,
    Simulation,
    discretise,
)

METHOD = GeneralisedAlpha(step=2.5e-3, tolerance=1e-3)
BATCH, SHORT, TRIAL = 8, 0.1, 5e-3  # samples; s simulated by the row of parallelograms, and in a trial
SWEEP_NAMES = ("rfes", "links", "batch", "errors")
FIRST = ("D.delta_x", "D.delta_z", "D.d_y")


class Points(NamedTuple):
    """One curve: name, sizes, processor milliseconds (a ratio in gradients), compilation [s]."""

    name: str
    sizes: list[int]
    values: list[float]
    compilation: list[float]


class Sweep(NamedTuple):
    """What a sweep varies and measures: label and unit of the axes, function of the sizes and of whether it is a trial,
    its sizes, fewer of them for a quick run, and one for a trial."""

    label: str
    unit: str
    measure: Callable
    sizes: tuple[int, ...]
    quick: tuple[int, ...]
    trial: tuple[int, ...]


def draw(out: Path, trial: bool, quick: bool, names=SWEEP_NAMES) -> None:
    """The named sweeps, printed and drawn to `out`/scaling.png; a trial simulates 5 ms, gradients of a pendulum."""
    all_sweeps = {
        "rfes": Sweep("rfes in a link", "ms a sample", over_rfes, (3, 5, 9, 17, 33, 65), (3, 9, 33), (2,)),
        "links": Sweep("links", "ms a sample", over_links, (1, 2, 3, 4, 6), (1, 2, 3), (1,)),
        "batch": Sweep(
            "samples in the batch",
            "ms the batch",
            over_batch,
            (1, 2, 4, 8, 16, 32, 64, 128),
            (1, 8, 64),
            (2,),
        ),
        "errors": Sweep("errors in a gradient", "times one simulation", over_errors, (1, 3, 10, 30), (3, 30), (1,)),
    }
    drawn = []
    for name in names:
        sweep = all_sweeps[name]
        curves = sweep.measure(sweep.trial if trial else sweep.quick if quick else sweep.sizes, trial)
        for curve in curves:
            print(f"\n{sweep.label}, {curve.name}: {sweep.unit} (CPU), compilation s")
            for size, value, compiling in zip(curve.sizes, curve.values, curve.compilation):
                print(f"  {size:>5}{value:>12.2f}{compiling:>10.1f}", flush=True)
        drawn.append((sweep, curves))
    _picture(drawn, out / "scaling.png")


def over_rfes(counts, trial: bool) -> list[Points]:
    """The study's four-bar with more and more rfes in both flexible links."""
    rows = []
    for count in counts:
        model = discretise(STUDY.mechanism, rfes=count)
        run = jax.vmap(simulation(model, METHOD, duration=TRIAL if trial else STUDY.duration))
        rows.append(timed(run, sample_errors("P5", BATCH), repeats=3))
    return [_points("four-bar", counts, rows, BATCH)]


def row_of_parallelograms(cells: int, rfes: int = 3) -> Mechanism:
    """2 `cells` + 1 links and `cells` loops with one degree of freedom; length 0.3 m each."""
    steel = Material("steel", youngs_modulus=210e9, density=7850.0, poisson_ratio=0.3, damping=1e-5)
    bar, leaning = Rectangle(0.01, 0.01), np.radians(-100.0)
    links = [Link("crank", 0.3, bar, steel, rigid=True)]
    joints = [Joint("crank_pivot", "base", "crank", position=(0, 0, 0), angle=leaning)]
    cuts = []
    before = "crank"
    for i in range(1, cells + 1):
        coupler, rocker = f"coupler_{i}", f"rocker_{i}"
        links += [Link(name, 0.3, bar, steel, rfes=rfes) for name in (coupler, rocker)]
        joints.append(Joint(f"{coupler}_hinge", before, coupler, angle=-leaning))
        at = (0.3 * i, 0, 0)
        joints.append(Joint(f"{rocker}_pivot", "base", rocker, position=at, angle=leaning))
        cuts.append(Joint(f"{rocker}_hinge", coupler, rocker, cut=True))
        before = rocker
    return Mechanism(links, [*joints, *cuts], driven_joint="crank_pivot")


def over_links(cells, trial: bool) -> list[Points]:
    """Rows of parallelograms."""
    sizes, rows, duration = [], [], TRIAL if trial else SHORT
    for count in cells:
        model = discretise(row_of_parallelograms(count))
        batch = {"crank_pivot.delta_x": 1e-3 * jnp.linspace(1, 0.2, BATCH)}
        run = jax.vmap(simulation(model, METHOD, MomentRamp("crank_pivot", 1.5, 0.05), duration))
        rows.append(timed(run, batch, repeats=3))
        sizes.append(len(model.topology.elements))
    return [_points(f"row of parallelograms, {duration:g} s", sizes, rows, BATCH)]


def over_batch(counts, trial: bool) -> list[Points]:
    """The study's four-bar, more and more samples."""
    model = discretise(STUDY.mechanism)
    run = jax.vmap(simulation(model, METHOD, duration=TRIAL if trial else STUDY.duration))
    rows = [timed(run, sample_errors("P5", count), repeats=3) for count in counts]
    return [_points("four-bar", counts, rows, 1)]


def pendulum() -> tuple[Mechanism, MomentRamp]:
    """A driven flexible link, whose derivatives compile in seconds, and its drive."""
    steel = Material("steel", youngs_modulus=210e9, density=7850.0, poisson_ratio=0.3, damping=1e-5)
    bar = Link("bar", 0.3, Rectangle(0.01, 0.01), steel, rfes=2)
    return Mechanism((bar,), (Joint("A", "base", "bar"),), driven_joint="A"), MomentRamp("A", 1.5, 0.05)


def over_errors(counts, trial: bool) -> list[Points]:
    """Derivatives with respect to more and more errors, over one simulation."""
    mechanism, drive = pendulum() if trial else (STUDY.mechanism, STUDY.drive)
    model, duration = discretise(mechanism), TRIAL if trial else STUDY.duration
    metrics = tuple(f"{joint}.mean_square_moment" for joint in sorted(model.joint_names))
    problem = Problem(
        Simulation(model, drive=drive, duration=duration, method=METHOD, save_every=min(25e-3, duration)), metrics
    )
    first = tuple(name for name in FIRST if name in problem.error_names)
    others = [n for n in problem.error_names if "pin" not in n and n not in FIRST]
    curves = {"forward": [], "reverse": []}
    base = None
    for count in counts:
        names = (*first, *others)[:count]

        def values(point, names=names):
            return problem(dict(zip(names, point)))[0]

        def one(point, values=values):
            return values(point)[metrics[0]]

        points = 1e-4 * jnp.linspace(0.5, 1.5, BATCH)[:, None] * jnp.ones((1, count))
        if base is None:
            base = timed(jax.vmap(values), points, repeats=3)
        for mode, function in (("forward", jax.jacfwd(values)), ("reverse", jax.grad(one))):
            curves[mode].append(timed(jax.vmap(function), points, repeats=3))
    return [
        Points(mode, list(counts), [row.cpu / base.cpu for row in rows], [row.compilation for row in rows])
        for mode, rows in curves.items()
    ]


def _points(name, sizes, rows, batch: int) -> Points:
    milliseconds = [1e3 * row.cpu / batch for row in rows]
    return Points(name, list(sizes), milliseconds, [row.compilation for row in rows])


def _picture(drawn, path: Path) -> None:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot
    from matplotlib.ticker import LogLocator, NullFormatter

    figure, axes = pyplot.subplots(1, len(drawn), figsize=(4.2 * len(drawn), 3.6), layout="constrained", squeeze=False)
    for axis, (sweep, curves) in zip(axes.flat, drawn):
        for curve in curves:
            axis.loglog(curve.sizes, curve.values, "o-", label=curve.name)
        ends = np.array([curves[0].sizes[0], curves[0].sizes[-1]])
        line = curves[0].values[0] * ends / ends[0]
        axis.loglog(ends, line, "--", color="0.6", label="proportional")
        axis.set(xlabel=sweep.label, ylabel=f"CPU, {sweep.unit}")
        axis.set_xticks(curves[0].sizes, [f"{x:g}" for x in curves[0].sizes])
        axis.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axis.yaxis.set_major_formatter("{x:g}")
        for part in (axis.xaxis, axis.yaxis):
            part.set_minor_formatter(NullFormatter())
        axis.legend(fontsize="small")
    figure.savefig(path, dpi=150)
    pyplot.close(figure)
