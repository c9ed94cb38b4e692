"""Joints with clearance at rest: pins pressed into their bushes, preload of a four-bar over clearances.

Place in the pipeline: impacts -> a benchmark of `catalogue`. Reference values: `references/clearances.json`; those of
pins at rest are closed forms.

A body hangs on a pin, or stands on the thrust face of one; a rigid shaft on an ideal hinge has a second, tilted bush,
in which it is free up to a tilt of 2 c / l; a flexible four-bar has errors and play at one joint. What moves is in
`impacts`.

A pin that nothing presses is held by a weak spring, whose force shows in what is compared with zero.
"""

import dataclasses

import jax.numpy as jnp
import numpy as np

from rfem_jax.description import Clearance, Joint, Mechanism
from rfem_jax.mechanics.forces.bush_contacts import ContactState
from rfem_jax.mechanics.model.discretisation import discretise
from rfem_jax.mechanics.model.errors import assembly_errors
from rfem_jax.mechanics.model.model import Model
from rfem_jax.mechanics.statics.assembly import Assembled, assemble
from rfem_jax.mechanics.statics.designs import design
from rfem_jax.validation import impacts
from rfem_jax.validation.impacts import CLOSED_FORM, REFERENCE
from rfem_jax.validation.lines import Line, Outcome, Progress, absolute, relative, same
from rfem_jax.validation.nonideal_joints import ANGLES, bars
from rfem_jax.validation.rigid_links import body, turn_y

PLAY, THRUST = 1e-4, 2e7  # m, N/m: radial clearance, axial stiffness of the joints at rest
SOFT = Clearance(radial=PLAY, length=0.02, stiffness=5e7, exponent=1, axial_stiffness=THRUST)  # of the four-bar
HERTZ, EXPONENT = 4e9, 1.5
HARD = Clearance(radial=PLAY, length=0.02, stiffness=HERTZ, exponent=EXPONENT, axial_stiffness=THRUST)
WEIGHT = 2.0 * 9.81  # N, of the bodies at rest
ARM = 0.01  # m, from the middle of a pin to its ends
TILTS = (0.0095, 0.0105, 0.02)  # rad, of the shaft's bush; it is free up to 0.01
TILT = float(np.radians(0.5))  # of the four-bar's bush
MISALIGNMENTS = {
    "axial": {"D.d_y": 5e-4},
    "tilt_x": {"D.delta_x": TILT},
    "tilt_z": {"D.delta_z": TILT},
    "all": {"D.delta_x": TILT, "D.delta_z": TILT, "D.d_y": 5e-4},
}
SHARE, LEAST, FLOATING = 1e-8, (1e-8, 1e-9), (1e-6, 3e-7)  # of a load; N, N m; the same where a pin floats


def hung(clearance: Clearance, turned: bool = False) -> Model:
    """A body that hangs by its mass centre on a clearance alone, its bush along y, or along the vertical."""
    joint = Joint("D", "base", "body", orientation=(np.pi / 2, 0, 0) if turned else (0, 0, 0), clearance=clearance)
    link = body("body", 0.1, 2.0, (0, 0, 0), (0.01, 0.01, 0.01))
    return discretise(Mechanism((link,), (joint,), driven_joint="D"))


def shaft(cut: bool = False) -> Model:
    """A rigid shaft on an ideal hinge, and in a bush that may be tilted against it; `cut`: opened at the bush instead
    of the hinge."""
    ideal, bush, at_origin = ("A", "base", "shaft"), ("D", "base", "shaft"), (0.0, 0.0, 0.0)
    if cut:
        joints = [Joint(*ideal), Joint(*bush, child_position=at_origin, position=at_origin, cut=True, clearance=HARD)]
    else:
        joints = [Joint(*bush, clearance=HARD), Joint(*ideal, child_position=at_origin, position=at_origin, cut=True)]
    link = body("shaft", 0.1, 2.0, (0, 0, 0), (0.01, 0.01, 0.01))
    return discretise(Mechanism((link,), tuple(joints), gravity=(0.0, 0.0, 0.0), driven_joint=joints[0].name))


def flexible_four_bar(clearance: Clearance = SOFT, cut: bool = False) -> Mechanism:
    """Rigid crank, flexible coupler and rocker, play at D; `cut`: opened at D instead of C, the rocker the other way
    round."""
    crank, coupler, rocker = ANGLES
    joints = [Joint("A", "base", "crank", angle=crank), Joint("B", "crank", "coupler", angle=coupler - crank)]
    if cut:
        joints += [Joint("C", "coupler", "rocker", angle=rocker + np.pi - coupler)]
        joints += [Joint("D", "base", "rocker", position=(0.3, 0.0, 0.0), cut=True, clearance=clearance)]
    else:
        joints += [Joint("D", "base", "rocker", position=(0.3, 0.0, 0.0), angle=rocker, clearance=clearance)]
        joints += [Joint("C", "coupler", "rocker", cut=True)]
    return Mechanism(bars(5), tuple(joints), driven_joint="A", elements="geometrically_exact")


def depth_at_rest() -> float:
    """How far the weight presses the ends of the pin into the bush [m]."""
    return (0.5 * WEIGHT / HERTZ) ** (1.0 / EXPONENT)


def at_bush(found: Assembled) -> ContactState:
    """The contacts of joint D."""
    assert found.contacts is not None  # a model with clearance
    return found.contacts["D"]


def _carrying(found: Assembled) -> str:
    return ", ".join(at_bush(found).carrying) or "none"


def _checked(model: Model, found: Assembled) -> Assembled:
    """**Raises:** `RuntimeError` where the mechanism could not be assembled."""
    if int(found.status):
        raise RuntimeError(f"The mechanism of {', '.join(model.topology.links)} with clearance did not assemble.")
    return found


def pressed_lines() -> list[Line]:
    """A pin pressed into its bush by the weight of its body, one without weight, and one on its thrust face."""
    group, lines, model, depth = "Pin pressed at rest", [], hung(HARD), depth_at_rest()
    found = _checked(model, assemble(model, assembly_errors(model)))
    at_d, load = at_bush(found), found.preload["D"]
    lines.append(same(group, "what carries", _carrying(found), "start, end", CLOSED_FORM))
    for n, end in enumerate(("start", "end")):
        x, z = np.asarray(at_d.eccentricity)[n]
        lines += [
            absolute(group, f"penetration, {end}", at_d.penetration[n], depth, 1e-11, CLOSED_FORM, "m"),
            relative(group, f"normal force, {end}", at_d.normal_force[n], 0.5 * WEIGHT, 1e-7, CLOSED_FORM, "N"),
            absolute(group, f"place x, {end}", x, 0.0, 1e-12, CLOSED_FORM, "m"),
            relative(group, f"place z, {end}", z, -PLAY - depth, 1e-9, CLOSED_FORM, "m"),
        ]
    sideways, moment = np.linalg.norm(load.force[:2]), np.linalg.norm(load.moment)
    lines += [
        absolute(group, "penetration, thrust face", at_d.penetration[2], 0.0, 1e-11, CLOSED_FORM, "m"),
        absolute(group, "normal force, thrust face", at_d.normal_force[2], 0.0, 1e-9, CLOSED_FORM, "N"),
        relative(group, "force", load.force[2], WEIGHT, 1e-9, CLOSED_FORM, "N"),
        absolute(group, "force sideways", sideways, 0.0, 1e-9, CLOSED_FORM, "N"),
        absolute(group, "moment", moment, 0.0, 1e-9, CLOSED_FORM, "N m"),
        absolute(group, "force of the spring that centres", np.max(at_d.centring), 0.0, 1e-6, CLOSED_FORM, "N"),
    ]
    floating = dataclasses.replace(model, gravity=jnp.zeros(3))
    found = _checked(floating, assemble(floating, assembly_errors(floating)))
    lines.append(same(group, "what carries without gravity", _carrying(found), "none", CLOSED_FORM))
    *ends, face = np.asarray(at_bush(found).penetration)
    farthest = max(ends, key=lambda end: abs(end + PLAY))
    lines.append(absolute(group, "penetration without gravity, ends", farthest, -PLAY, 1e-11, CLOSED_FORM, "m"))
    lines.append(absolute(group, "penetration without gravity, thrust face", face, 0.0, 1e-11, CLOSED_FORM, "m"))
    upright = hung(dataclasses.replace(SOFT, axial=3e-4), turned=True)
    found = _checked(upright, assemble(upright, assembly_errors(upright)))
    depth, force = at_bush(found).penetration[2], np.abs(found.preload["D"].force[1])
    lines += [
        same(group, "what carries an upright pin", _carrying(found), "axial", CLOSED_FORM),
        relative(group, "penetration, upright", depth, WEIGHT / THRUST, 1e-6, CLOSED_FORM, "m"),
        relative(group, "force, upright", force, WEIGHT, 1e-9, CLOSED_FORM, "N"),
    ]
    return lines


def shaft_lines(model: Model) -> list[Line]:
    """A rigid shaft in a bush tilted about x and about z: no moment, then l K (l sin(tilt) / 2 - c)^n cos(tilt)."""
    group, lines = "Misaligned shaft in its bush", []
    for tilt in TILTS:
        depth = max(ARM * np.sin(tilt) - PLAY, 0.0)
        moment = 2.0 * ARM * HERTZ * depth**EXPONENT * np.cos(tilt)
        carries = "start, end" if depth else "none"
        for axis in "xz":
            found, name = assemble(model, assembly_errors(model, {f"D.delta_{axis}": tilt})), f"{tilt} rad about {axis}"
            load = _checked(model, found).preload["D"]
            line, allowed = (relative, 1e-6) if depth else (absolute, 1e-8)
            found_moment, force = np.linalg.norm(load.moment), np.linalg.norm(load.force)
            lines += [
                same(group, f"{name}: what carries", _carrying(found), carries, CLOSED_FORM),
                line(group, f"{name}: moment", found_moment, moment, allowed, CLOSED_FORM, "N m"),
                absolute(group, f"{name}: force", force, 0.0, 1e-7, CLOSED_FORM, "N"),
            ]
    return lines


def four_bar_preload(model: Model, case: str, number: int) -> Assembled:
    """The four-bar of the reference's case, held at its start angle."""
    radial, axial = (REFERENCE[f"{name}_clearance"][case][number] for name in ("radial", "axial"))
    wanted = design(model, {"D.clearance.radial": radial, "D.clearance.axial": axial})
    return _checked(model, assemble(model, assembly_errors(model, MISALIGNMENTS[case]), design=wanted))


def _least(case: str, number: int) -> tuple[float, float]:
    """What the four-bar's loads may differ by beside a share of them [N, N m]: little, unless the pin floats along its
    axis or the reference's equilibrium is worse than elsewhere."""
    residual = REFERENCE["residual"][case][number]
    if REFERENCE["seat_force"][case][number][1] == 0.0:
        return FLOATING
    return (1.1 * residual, 0.11 * residual) if residual > 10.0 * LEAST[0] else LEAST


def four_bar_lines(model: Model, case: str, number: int) -> list[Line]:
    """Of the load at D in the axes of its seat, and of the resultants at the other joints, each the value that is
    farthest off; and the moment that holds the crank."""
    found, label = four_bar_preload(model, case, number), REFERENCE.label
    j, topology = model.topology.joints.index("D"), model.topology
    on_tree = j < topology.n_links
    angle = float(found.state.position.joints[topology.own_positions[j][0]]) if on_tree else 0.0
    radial, axial = (1e6 * REFERENCE[f"{kind}_clearance"][case][number] for kind in ("radial", "axial"))
    group, name, lines = "Flexible four-bar with play", f"{case}, play {radial:.3g}, {axial:.3g} um", []
    for quantity, unit, least in zip(("force", "moment"), ("N", "N m"), _least(case, number), strict=True):
        known = np.array(REFERENCE[f"seat_{quantity}"][case][number])
        ours = turn_y(angle) @ np.asarray(getattr(found.preload["D"], quantity))
        at, allowed = int(np.argmax(np.abs(ours - known))), SHARE * float(np.linalg.norm(known)) + least
        title = f"{name}: {quantity} {'xyz'[at]} of D"
        lines.append(absolute(group, title, ours[at], known[at], allowed, label, unit))
        of_others = []
        for joint, value in REFERENCE[f"preload_{quantity}"][case][number].items():
            resultant, title = np.linalg.norm(getattr(found.preload[joint], quantity)), f"{name}: {quantity} of {joint}"
            of_others.append(absolute(group, title, resultant, value, SHARE * value + least, label, unit))
        lines.append(max(of_others, key=lambda line: abs(line.difference) / line.allowed))
    hold, given = found.preload["A"].moment[1], REFERENCE["hold_moment"][case][number]
    lines.append(relative(group, f"{name}: moment that holds the crank", hold, given, 1e-7, label, "N m"))
    return lines


def validate(full: bool, progress: Progress) -> Outcome:
    """At rest and in motion."""
    del full
    lines = pressed_lines() + shaft_lines(shaft())
    progress(0.2)
    model = discretise(flexible_four_bar())
    for case, values in REFERENCE["hold_moment"].items():
        lines += [line for number in range(len(values)) for line in four_bar_lines(model, case, number)]
    progress(0.5)
    moving, pictures = impacts.validate(lambda share: progress(0.5 + 0.5 * share))
    return Outcome(lines + moving, pictures)
