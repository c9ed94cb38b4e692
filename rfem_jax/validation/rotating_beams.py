"""Beams rotated by a hub: spin-up (Simo and Vu-Quoc) and slewing (Wu and Haug).

Place in the pipeline: a benchmark of `catalogue`; both beams are a batch of one compiled program.

Sources: J. C. Simo, L. Vu-Quoc, J. Appl. Mech. 53 (1986) 855-863; S. C. Wu, E. J. Haug, Int. J.
Numer. Methods Eng. 26 (1988) 2211-2226; lag by T. R. Kane, R. R. Ryan, A. K. Banerjee (1987), see
`rotating_beam_theory`; steady extension omega^2 rho A L^3 / (3 E A) in closed form.

The published value of the largest lag is in `references/rotating_beams.json`.  Not published, and without influence on
a planar motion: torsion (G J = E I of the slewing beam here: the published 6.047e5 N m^2 would only limit the step),
out-of-plane bending; of the slewing beam also G A = E A / (2.6 * 1.2) and rho I = rho A * E I / E A.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from rfem_jax.compilation.program import Program
from rfem_jax.description import GivenSection, Joint, Link, Mechanism, PrescribedSpinUp, RungeKutta4
from rfem_jax.mechanics.model.discretisation import discretise
from rfem_jax.simulation import STATUS, Run, Simulation, one_of, simulate
from rfem_jax.validation.lines import Curve, Line, Outcome, Picture, Progress, absolute, relative, same
from rfem_jax.validation.reference_values import read_reference
from rfem_jax.validation.rotating_beam_theory import tip_lag

SEGMENTS = 8
RISE, DURATION, STEADY = 15.0, 20.0, 16.0  # s; averages of the steady motion are from STEADY on
STEP = 2.5e-4  # s
EXTENSION_SHARE = 0.01  # m = 8 segments: 1 / (8 m^2) = 0.2 %
LAG_SHARE = 0.02  # linear theory: the largest angle of the beams is 0.1 rad
PUBLISHED = read_reference("rotating_beams")


@dataclass(frozen=True)
class Beam:
    """L [m], EA, GA [N], EI [N m^2], rho A [kg/m], rho I [kg m], rate of the hub [rad/s]."""

    name: str
    source: str
    length: float
    axial: float
    shear: float
    bending: float
    line_density: float
    rotary: float
    rate: float

    def mechanism(self) -> Mechanism:
        """The beam on its hub."""
        section = GivenSection(
            self.axial, self.shear, self.shear, self.bending, self.bending, self.bending,
            self.line_density, 2.0 * self.rotary, self.rotary, self.rotary,
        )  # fmt: skip
        link = Link("beam", self.length, section, rfes=SEGMENTS + 1)
        return Mechanism((link,), (Joint("A", "base", "beam"),), gravity=(0.0, 0.0, 0.0), driven_joint="A")

    def extension(self) -> float:
        """Steady extension [m]."""
        return self.rate**2 * self.line_density * self.length**3 / (3.0 * self.axial)

    def lag(self, times: Float[np.ndarray, " times"]) -> Float[np.ndarray, " times"]:
        """Lag of the tip [m] by linear theory with geometric stiffening."""

        def rate(t):
            x = min(t / RISE, 1.0)
            share = x - np.sin(2.0 * np.pi * x) / (2.0 * np.pi)
            return self.rate * share, self.rate * (1.0 - np.cos(2.0 * np.pi * x)) / RISE

        return tip_lag(self.length, self.bending, self.line_density, rate, times)


BEAMS = (
    Beam("Spin-up beam", PUBLISHED.label, 10.0, 2.8e7, 1e7, 1.4e4, 1.2, 6e-4, 6.0),
    Beam(
        "Slewing beam", "Wu, Haug 1988", 8.0, 5.03e6, 5.03e6 / (2.6 * 1.2), 566.6, 0.2019,
        0.2019 * 566.6 / 5.03e6, 4.0,
    ),
)  # fmt: skip


def simulate_beams(beams: Sequence[Beam], elements: str) -> list[Run]:
    """Runs (NumPy arrays) of beams with one form of elements, as one batch."""
    models = [discretise(beam.mechanism(), elements=elements) for beam in beams]
    drives = [PrescribedSpinUp("A", beam.rate, RISE) for beam in beams]
    batch = jax.tree.map(lambda *leaves: jnp.stack(leaves), *zip(models, drives, strict=True))
    runs = _simulate(*batch)
    return [one_of(runs, i) for i in range(len(beams))]


@Program
@eqx.filter_vmap
def _simulate(model, drive):
    method = RungeKutta4(step=STEP)
    return simulate(Simulation(model, drive=drive, duration=DURATION, method=method, save_every=0.02))


def tip_in_hub_frame(run: Run) -> tuple[Float[np.ndarray, " times"], Float[np.ndarray, " times"]]:
    """Of the tip: distance along the x axis of the rotating hub, and lag across it [m]."""
    x, z = run.motion.ends["beam"][:, 0], run.motion.ends["beam"][:, 2]
    c, s = np.cos(run.motion.angle), np.sin(run.motion.angle)
    return c * x - s * z, s * x + c * z


def validate(full: bool, progress: Progress) -> Outcome:
    """Both beams with geometrically exact elements, the first with linear ones."""
    del full
    lines: list[Line] = []
    pictures: list[Picture] = []
    for beam, run in zip(BEAMS, simulate_beams(BEAMS, "geometrically_exact"), strict=True):
        theory, lag = beam.lag(run.times), tip_in_hub_frame(run)[1]
        lines += exact_lines(beam, run, theory)
        pictures.append(Picture(
            beam.name.lower().replace(" ", "_").replace("-", "_"), f"{beam.name}: lag of the tip",
            "t, s", "m",
            (Curve("geometrically exact, m = 8", run.times, lag),
             Curve("theory with stiffening", run.times[::25], theory[::25], True)),
        ))  # fmt: skip
    progress(0.7)
    lines.append(linear_line(BEAMS[0], simulate_beams(BEAMS[:1], "linear")[0]))
    return Outcome(lines, pictures)


def exact_lines(beam: Beam, run: Run, theory: Float[np.ndarray, " times"]) -> list[Line]:
    """Status, steady extension, lags; `theory`: lag [m] at the run's times."""
    along, lag = tip_in_hub_frame(run)
    steady = run.times >= STEADY
    group = f"{beam.name}, geometrically exact"
    # Remaining vibrations shorten the beam in proportion to the squared lag: extrapolate to no lag.
    columns = np.stack([np.ones(np.sum(steady)), lag[steady] ** 2], axis=1)
    (straight, _), *_ = np.linalg.lstsq(columns, along[steady] - beam.length)
    lines = [
        same(group, "status of the run", STATUS[int(run.status)].name, "ok", "-"),
        relative(group, "steady extension", straight, beam.extension(), EXTENSION_SHARE,
                 "closed form", "m"),
        absolute(group, "mean steady lag over L", np.mean(lag[steady]) / beam.length, 0.0, 1e-4,
                 "closed form"),
        relative(group, "largest lag of the tip", lag.max(), theory.max(), LAG_SHARE,
                 "Kane, Ryan, Banerjee 1987", "m"),
    ]  # fmt: skip
    if beam is BEAMS[0]:
        # Read off a plot with one digit: 0.55 to 0.65 m.
        lines.append(absolute(group, "largest lag of the tip, published", lag.max(), PUBLISHED["largest_lag"], 0.05,
                              beam.source + ", plot", "m"))  # fmt: skip
    return lines


def linear_line(beam: Beam, run: Run) -> Line:
    """Without geometric stiffening the motion must diverge: 6 rad/s is above the first frequency."""
    _, lag = tip_in_hub_frame(run)
    lost = run.status != 0 or not np.all(np.abs(lag) < beam.length)
    found = "diverges" if lost else f"largest lag {np.abs(lag).max():.3g} m"
    return same(f"{beam.name}, linear", "motion after spin-up", found, "diverges", beam.source)
