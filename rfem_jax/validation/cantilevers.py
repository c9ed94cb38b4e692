"""A clamped beam under small loads: deflection at the tip and natural frequencies.

Place in the pipeline: a benchmark of `catalogue`; `bend` serves `large_deflections` too.

A link on a held joint is clamped; a tip load is the weight of a point mass at the end of a link
that weighs next to nothing. So a load is a direction of gravity, and all beams with one number of
segments m share one compiled program. Link axes: x along the beam, y and z across it.

References are those of m segments, which the rigid finite element method must meet to rounding: tip deflection
F L^3 / (3 E I) (1 - 1 / (4 m^2)) + F L / GA, tip slope F L^2 / (2 E I), and the frequencies of rods hinged by springs
at the midpoints over those of an Euler-Bernoulli beam (theory (11.1), (11.2); `references/cantilever.json`).
"""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from rfem_jax.compilation.program import Program
from rfem_jax.description import (
    GivenSection,
    Joint,
    Link,
    Mechanism,
    PointMass,
    PrescribedRate,
)
from rfem_jax.mechanics.dynamics.centre_lines import link_ends
from rfem_jax.mechanics.kinematics.motion import motion_of
from rfem_jax.mechanics.model.discretisation import discretise
from rfem_jax.mechanics.model.errors import assembly_errors
from rfem_jax.mechanics.model.model import Model
from rfem_jax.mechanics.model.with_errors import apply_errors
from rfem_jax.mechanics.statics.assembly import assemble
from rfem_jax.simulation.vibrations.stability import eigenvalues
from rfem_jax.validation.lines import Line, Outcome, Progress, relative
from rfem_jax.validation.reference_values import read_reference

Stiffnesses = tuple[float, float, float, float, float, float]
STATICS_SOURCE = "closed form, m midpoints"
REFERENCE = read_reference("cantilever")
FREQUENCY_SOURCE = REFERENCE.label
ROOTS = np.array(REFERENCE["roots"])  # beta L of the Euler-Bernoulli beam
# Frequencies of modes 1 to 3 over those of Euler and Bernoulli, by number of segments m.
BENDING, SHEAR = ({int(m): row for m, row in REFERENCE[name].items()} for name in ("bending", "bending_with_shear"))
SLENDERNESS = 1.0 / (12.0 * 20.0**2)  # I / (A L^2) of the beam with shear
QUICK = (4, 20)


class Bent(NamedTuple):
    """Displacement of the tip [m] and rotation of the last rfe; NaN without an equilibrium."""

    tip: Float[np.ndarray, "3"]
    rotation: Float[np.ndarray, "3 3"]


def clamped_beam(length: float, stiffnesses: Stiffnesses, segments: int, elements: str) -> Model:
    """A link with 1 kg at its end on a joint that is to be held.

    Args: length [m]; stiffnesses EA, GA_y, GA_z [N], GJ, EI_y, EI_z [N m^2]; segments m; elements:
        form of the spring-damping elements.
    """
    section = GivenSection(*stiffnesses, 1e-9, 2e-13, 1e-13, 1e-13)
    tip_mass = PointMass(1.0, (length, 0.0, 0.0))
    link = Link("beam", length, section, rfes=segments + 1, point_masses=(tip_mass,))
    mechanism = Mechanism((link,), (Joint("A", "base", "beam"),), gravity=(0.0, 0.0, 0.0))
    return discretise(mechanism, elements=elements)


def bend(model: Model, force: Sequence[float]) -> Bent:
    """The clamped beam under a tip force (x, y, z) [N]."""
    tip, rotation, status = map(np.asarray, _bend(model, jnp.asarray(force, jnp.float64)))
    missing = 0.0 if status == 0 else np.nan
    return Bent(tip + missing, rotation + missing)


@Program
def _bend(model: Model, force):
    model = eqx.tree_at(lambda m: m.gravity, model, force)
    errors = assembly_errors(model)
    result = assemble(model, errors, {"A": jnp.zeros(())})
    actual = apply_errors(model, errors)
    end, rotation = link_ends(actual, motion_of(actual, result.state))
    straight = jnp.zeros(3).at[0].set(model.length[0])
    return end[:, 0] - straight, rotation[:, :, 0], result.status


def frequencies(segments: int, shear_stiffness: float, rotary: float) -> Float[np.ndarray, "3"]:
    """Lowest three frequencies of a clamped link with E I = rho A = L = 1 over those of Euler and Bernoulli, in the
    plane of motion (the modes of all other stiffnesses lie above).

    Args: segments m; shear_stiffness G A_z, with the shear factor; rotary rho I_y.
    """
    section = GivenSection(1e7, 1e9, shear_stiffness, 1e4, 1.0, 1e4, 1.0, rotary + 1e-9, rotary, 1e-9)
    link = Link("beam", 1.0, section, rfes=segments + 1)
    mechanism = Mechanism((link,), (Joint("A", "base", "beam"),), driven_joint="A")
    values = np.imag(eigenvalues(discretise(mechanism), PrescribedRate("A", 1.0)))
    return np.sort(values[values > 0.0])[:3] / ROOTS**2


def validate(full: bool, progress: Progress) -> Outcome:
    """Small loads and frequencies; with `full` all numbers of segments of the tables."""
    lines: list[Line] = []
    bending = [m for m in BENDING if full or m in QUICK]
    shear = [m for m in SHEAR if full or m in QUICK]
    work = [(m, _small_load_lines) for m in QUICK]
    work += [(m, _bending_lines) for m in bending] + [(m, _shear_lines) for m in shear]
    for number, (m, checked) in enumerate(work):
        lines += checked(m)
        progress((number + 1) / len(work))
    return Outcome(lines)


def _small_load_lines(m: int) -> list[Line]:
    length, ei, ga, force = 0.8, 400.0, 6.0e4, 1e-4
    group = "Cantilever, small tip load"
    lines = []
    for name, shear in (("bending only", 1e12), ("with shear", ga)):
        model = clamped_beam(length, (3e12, 1e12, shear, 1e5, ei, ei), m, "linear")
        bent = bend(model, [0.0, 0.0, force])
        flexure = force * length**3 / (3.0 * ei) * (1.0 - 1.0 / (4.0 * m**2))
        lines.append(
            relative(group, f"m = {m}, tip deflection, {name}", bent.tip[2],
                     flexure + force * length / shear, 1e-6, STATICS_SOURCE, "m")
        )  # fmt: skip
    angle = np.arcsin(bent.rotation[2, 0])
    known = force * length**2 / (2.0 * ei)
    lines.append(relative(group, f"m = {m}, tip slope", angle, known, 1e-6, STATICS_SOURCE, "rad"))
    return lines


def _bending_lines(m: int) -> list[Line]:
    got = frequencies(m, 1e8, 1e-10)
    return _mode_lines("Cantilever, frequencies in bending", m, got, BENDING[m])


def _shear_lines(m: int) -> list[Line]:
    got = frequencies(m, 1.0 / (2.6 * 1.2 * SLENDERNESS), SLENDERNESS)
    return _mode_lines("Cantilever, frequencies with shear", m, got, SHEAR[m])


def _mode_lines(group: str, m: int, got, table) -> list[Line]:
    # The table has six digits.
    return [
        relative(group, f"m = {m}, mode {k + 1} / Euler-Bernoulli", got[k], table[k], 1e-5,
                 FREQUENCY_SOURCE)
        for k in range(3)
    ]  # fmt: skip
