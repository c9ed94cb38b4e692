"""Curved links: deflections of a quarter ring and frequencies of a ring, against closed forms.

Place in the pipeline: a benchmark of `catalogue`.

The quarter ring is clamped at one end and loaded at the other: its deflections, shear and stretch included, follow from
Castigliano's theorem. Of a free ring, the modes with n waves around it that are symmetric to two of its diameters are
those of a quarter of it between two slides (in its plane) or two hinges along its radii (out of it). References are of
the limit of many segments; values are extrapolated to it from two numbers m of segments, by the square of these.

Source of the frequencies: S. Timoshenko, D. H. Young, W. Weaver, Vibration Problems in Engineering, 4th ed. (1974);
rings without stretch, shear and rotary inertia.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from rfem_jax.compilation.program import Program
from rfem_jax.description import AxisPoint, GivenSection, Joint, Link, Mechanism, PointMass
from rfem_jax.mechanics.dynamics.centre_lines import link_ends
from rfem_jax.mechanics.kinematics.motion import motion_of
from rfem_jax.mechanics.model.discretisation import discretise
from rfem_jax.mechanics.model.errors import assembly_errors
from rfem_jax.mechanics.model.model import Model
from rfem_jax.mechanics.model.with_errors import apply_errors
from rfem_jax.mechanics.statics.assembly import assemble
from rfem_jax.simulation.vibrations.modes import natural_frequencies
from rfem_jax.validation.lines import Line, Outcome, Progress, relative

RADIUS, FORCE = 0.3, 1e-4  # m, N
AXIAL, SHEAR_Y, SHEAR_Z, TORSION, IN_PLANE, ACROSS = 2e5, 5e4, 4e4, 90.0, 120.0, 150.0  # N, N m^2
SEGMENTS, FINE = (4, 8), (8, 16)
DEFLECTIONS, FREQUENCIES, LIMITS = 0.03, 5e-3, 5e-4  # shares by which m = 4, m = 8 and extrapolated values may be off
# Of a slender ring: the square of its radius over that of gyration, and stiffness in directions that are not looked at.
# More would cost digits of the frequencies.
SLENDER, ASIDE = 1e5, 1e3
WAVES = (2, 4)
STATICS_SOURCE, MODES_SOURCE = "closed form, Castigliano", "Timoshenko, Young, Weaver 1974"


def validate(full: bool, progress: Progress) -> Outcome:
    """Deflections, then frequencies in and out of the plane, with `full` those of the limit, too."""
    lines = _deflection_lines()
    progress(0.4)
    for number, in_plane in enumerate((True, False)):
        lines += _frequency_lines(in_plane, full)
        progress(0.7 + 0.3 * number)
    return Outcome(lines)


def quarter(section: GivenSection, segments: int, **more) -> Link:
    """A quarter of a ring from the origin along x, which turns to z."""
    half = 0.25 * np.pi
    through = RADIUS * np.sin(half), 0.0, RADIUS * (1.0 - np.cos(half))
    return Link("ring", section=section, axis=(AxisPoint((RADIUS, 0.0, RADIUS), through=through),), rfes=segments + 1,
                **more)  # fmt: skip


def deflections(segments: int) -> Float[np.ndarray, "3 3"]:
    """Displacements (x, y, z) [m] of the end, columns, by unit forces [N] along x, y and z."""
    section = GivenSection(AXIAL, SHEAR_Y, SHEAR_Z, TORSION, IN_PLANE, ACROSS, 1e-9, 2e-13, 1e-13, 1e-13)
    load = PointMass(1.0, (RADIUS, 0.0, RADIUS))
    model = discretise(Mechanism((quarter(section, segments, point_masses=(load,)),), (Joint("A", "base", "ring"),),
                                 gravity=(0.0, 0.0, 0.0)))  # fmt: skip
    ends = np.asarray(_ends(model, jnp.concatenate([jnp.zeros((1, 3)), FORCE * jnp.eye(3)])))
    return (ends[1:] - ends[0]).T / FORCE


@Program
def _ends(model: Model, forces: Float[jax.Array, "n 3"]) -> Float[jax.Array, "n 3"]:
    def end(force):
        loaded = eqx.tree_at(lambda m: m.gravity, model, force)
        errors = assembly_errors(loaded)
        result = assemble(loaded, errors, {"A": jnp.zeros(())})
        actual = apply_errors(loaded, errors)
        places, _ = link_ends(actual, motion_of(actual, result.state))
        return jnp.where(result.status == 0, places[:, 0], jnp.nan)

    return jax.vmap(end)(forces)


def _deflection_lines() -> list[Line]:
    r, direct = RADIUS, 0.25 * np.pi * RADIUS * (1.0 / AXIAL + 1.0 / SHEAR_Z)
    bend = r**3 / IN_PLANE
    across = r**3 * (0.25 * np.pi / ACROSS + (0.75 * np.pi - 2.0) / TORSION) + 0.5 * np.pi * r / SHEAR_Y
    known = {
        "along its begin, by the force along it": (0, 0, 0.25 * np.pi * bend + direct),
        "along its end, by the force along it": (2, 2, (0.75 * np.pi - 2.0) * bend + direct),
        "along its end, by the force along its begin": (2, 0, -0.5 * bend + 0.5 * r * (1.0 / AXIAL - 1.0 / SHEAR_Z)),
        "out of its plane": (1, 1, across),
    }
    coarse, fine = (deflections(m) for m in SEGMENTS)
    limit, lines, group = fine + (fine - coarse) / 3.0, [], "Quarter ring, deflection"
    few, both = f"m = {SEGMENTS[0]}", f"extrapolated from m = {SEGMENTS[0]}, {SEGMENTS[1]}"
    for words, (row, column, value) in known.items():
        for which, found, share in ((few, coarse, DEFLECTIONS), (both, limit, LIMITS)):
            name = f"{which}, {words}"
            lines.append(relative(group, name, found[row, column], value, share, STATICS_SOURCE, "m/N"))
    return lines


def frequencies(segments: int, in_plane: bool) -> Float[np.ndarray, " waves"]:
    """Frequencies [rad/s] of the symmetric modes of a ring with the density 1 kg/m, in its plane or out of it."""
    stiff, shear, rotary = ASIDE * IN_PLANE, SLENDER * IN_PLANE / RADIUS**2, RADIUS**2 / SLENDER
    stiffness = (stiff, IN_PLANE, stiff) if in_plane else (TORSION, stiff, ACROSS)
    section = GivenSection(shear, shear, shear, *stiffness, 1.0, 2.0 * rotary, rotary, rotary)
    right = 0.5 * np.pi
    kind = "prismatic" if in_plane else "revolute"
    turns = ((0.0, -right, 0.0), (0.0, 0.0, 0.0)) if in_plane else ((right, 0.0, 0.0), (0.0, 0.0, -right))
    joints = (
        Joint("A", "base", "ring", kind=kind, orientation=turns[0], child_orientation=turns[0]),
        Joint("B", "base", "ring", kind=kind, orientation=turns[1], child_orientation=turns[1], cut=True,
              position=(RADIUS, 0.0, RADIUS)),
    )  # fmt: skip
    model = discretise(Mechanism((quarter(section, segments),), joints, gravity=(0.0, 0.0, 0.0)))
    found = natural_frequencies(model, count=len(WAVES))
    return 2.0 * np.pi * np.asarray(found.frequency) + (0.0 if int(found.status) == 0 else np.nan)


def _frequency_lines(in_plane: bool, full: bool) -> list[Line]:
    coarse = frequencies(FINE[0], in_plane)
    checked = {f"m = {FINE[0]}": (coarse, FREQUENCIES)}
    if full:
        fine = frequencies(FINE[1], in_plane)
        checked[f"extrapolated from m = {FINE[0]}, {FINE[1]}"] = fine + (fine - coarse) / 3.0, LIMITS
    stiffness, more = (IN_PLANE, 1.0) if in_plane else (ACROSS, ACROSS / TORSION)
    group = f"Ring, frequencies {'in' if in_plane else 'out of'} its plane"
    lines = []
    for k, n in enumerate(WAVES):
        known = np.sqrt(stiffness / RADIUS**4 * n**2 * (n**2 - 1.0) ** 2 / (n**2 + more))
        for which, (found, share) in checked.items():
            lines.append(relative(group, f"{which}, {n} waves", found[k], known, share, MODES_SOURCE, "rad/s"))
    return lines
