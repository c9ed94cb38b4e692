"""What a study specifies, in words and tables: the text of the command `check`.

Place in the pipeline: after `rfem_jax.mechanics.describe`. Lengths m, masses kg; angles in degrees
and errors in degrees and millimetres, as users write them.
"""

import math
import re
from dataclasses import fields
from typing import Any

import numpy as np

from rfem_jax.description.basics.joint_kinds import KINDS
from rfem_jax.description.drives.driven_motions import AnyDrive
from rfem_jax.description.drives.numbers_by_name import drive_number_names, drive_number_unit, drive_number_value
from rfem_jax.description.mechanism.couplings import Coupling
from rfem_jax.description.mechanism.distributed_forces import DistributedForce
from rfem_jax.description.mechanism.forces import Force, JointForce, JointForceTable, JointFriction
from rfem_jax.description.mechanism.joints import Joint
from rfem_jax.description.mechanism.mechanism import EQUILIBRIUM, Mechanism
from rfem_jax.description.mechanism.point_forces import AtPoint, PointLoad
from rfem_jax.description.mechanism.polygons import PolygonSection
from rfem_jax.description.mechanism.reduced_bodies import ReducedBody
from rfem_jax.description.mechanism.section_bases import OwnStiffness
from rfem_jax.description.mechanism.sections import Section
from rfem_jax.description.parameters.deviations import deviation_unit
from rfem_jax.description.parameters.parameters import parameters_of
from rfem_jax.description.parameters.parts import parts_of
from rfem_jax.description.study_file.study import Case, Study
from rfem_jax.description.tolerances.error_catalogue import as_specified
from rfem_jax.mechanics.model.assembly_modes import loop_modes, start_values_text
from rfem_jax.mechanics.model.planar_loops import opening
from rfem_jax.report.contents.annotations import Model, StartHeld, Structure
from rfem_jax.report.contents.tables import format_table, title_text
from rfem_jax.text_layout import wrap_lines


def format_error(name: str, value: float, unit: str) -> str:
    """One deviation as users write it, "D.delta_x = 0.5 deg"; `unit` is its SI unit."""
    specified, factor = as_specified(unit)
    return f"{name} = {factor * value:.6g} {specified}".removesuffix(" 1")


def design_text(study: Study) -> str:
    """What the design of a study sets, and between which bounds numbers may change; "" without one."""
    names, drives = parameters_of(study.mechanism), drive_number_names(study.drives, study.drive_labels)
    rows = []
    for name, value in study.design.items():
        unit = drive_number_unit(name) if name in drives else names[name].unit
        before = float(drive_number_value(study.drives[drives[name][0]])) if name in drives else None
        if before is None:
            before = names[name].value_in(parts_of(study.mechanism))
        new = " to ".join(f"{end:.6g}" for end in value) if isinstance(value, tuple) else f"{value:.6g}"
        rows.append([name, new, f"{before:.6g}", unit])
    return f"Design\n{format_table(['parameter', 'value', 'before', 'unit'], rows)}" if rows else ""


def _errors_text(mechanism: Mechanism, case: Case) -> str:
    errors = [format_error(name, value, deviation_unit(mechanism, name)) for name, value in case.errors.items()]
    return "; ".join(errors) or "none"


def section_text(section: Section) -> str:
    """Shape of a section with its dimensions in mm."""
    shape = type(section).__name__
    if isinstance(section, OwnStiffness):
        return "given stiffnesses"
    if isinstance(section, PolygonSection):
        return f"polygon of {len(section.points)} corners, area {1e6 * section.area:.6g} mm^2"
    sizes = [
        f"{field.name.replace('_', ' ')} {1e3 * getattr(section, field.name):.6g} mm"
        for field in fields(section)
        if not field.name.startswith("shear_factor") and field.name != "name"
    ]
    words = re.sub(r"(?<=[a-z])(?=[A-Z])", " ", shape).lower() if shape != "ISection" else "I section"
    return ", ".join([words, *sizes])


def link_rows(mechanism: Mechanism) -> list[list[str]]:
    """One row per link: name, length, mass with point masses, rfes, section."""
    rows = []
    for link in mechanism.links:
        rfes = "rigid" if link.elements == 1 else "-" if link.reduced else str(link.elements)
        points = str(len(link.point_masses) or "-")
        shape = "rigid body" if link.section is None else section_text(link.section)
        if isinstance(link.body, ReducedBody):
            shape = f"reduced body, {len(link.body.interfaces)} interfaces, {link.body.modes} modes"
        if link.stations:
            shape = " to ".join(dict.fromkeys(section_text(section) for section in link.sections))
        if link.axis:
            shape += f"; axis through {len(link.axis) + 1} points"
        if link.form_errors:
            shape += f"; camber at {len(link.camber)} places" if link.camber else "; may be bowed"
        if link.slender:
            shape += "; neither stretches nor shears"
        rows.append([link.name, f"{link.length:.6g}", f"{link.mass:.6g}", rfes, points, shape])
    return rows


def joint_rows(study: Study) -> list[list[str]]:
    """One row per joint: name, kind, parent, child, start, what is special about it."""
    driven = [drive.joint for drive in study.drives]
    rows = []
    for joint in study.mechanism.joints:
        words = ("cut", joint.cut), ("driven", joint.name in driven), ("compliant", joint.compliance is not None)
        words += (("clearance", joint.clearance is not None),)
        marks = [word for word, holds in words if holds]
        start = "-" if joint.cut else _start_text(joint)
        rows.append([joint.name, joint.kind, joint.parent, joint.child, start, ", ".join(marks) or "-"])
    return rows


def _start_text(joint: Joint) -> str:
    """Start of all coordinates of a joint of the tree, angles in degrees."""
    freedoms = KINDS[joint.kind].freedoms
    values = zip(joint.start_values, freedoms, strict=True)
    return ", ".join(f"{math.degrees(x):.6g} deg" if one.rotation else f"{x:.6g} m" for x, one in values) or "-"


def _compliance_text(mechanism: Mechanism) -> str:
    """A line for every compliant joint: its sprung directions with their stiffnesses and dampings."""
    lines = []
    for joint in mechanism.joints:
        parts = []
        for spring in joint.springs:
            per = "N m/rad" if spring.rotation else "N/m"
            size = f"{spring.stiffness:g} {per}" if spring.positions is None else "a table"
            damping = f" with {spring.damping:g} {per.replace('/', ' s/')}" if spring.damping else ""
            parts.append(f"{spring.name} {size}{damping}")
        if parts:
            lines.append(f"Joint {joint.name} is compliant: {', '.join(parts)}.\n")
    return "".join(lines)


def _clearance_text(mechanism: Mechanism) -> str:
    """A line for every joint with clearance: its play and the law of its contacts."""
    lines = []
    for joint in mechanism.joints:
        if (play := joint.clearance) is None:
            continue
        parts = [f"{name} {1e3 * getattr(play, name):.6g} mm" for name in ("radial", "axial", "length")]
        parts.append(f"stiffness {play.stiffness:g} N/m^{play.exponent:g}")
        losses = {"chi": (play.damping, " s/m"), "restitution": (play.restitution, ""), "friction": (play.friction, "")}
        parts += [f"{name} {value:g}{unit}" for name, (value, unit) in losses.items() if value is not None]
        lines.append(f"Joint {joint.name} has clearance, pin on its {play.pin}: {', '.join(parts)}.\n")
    return "".join(lines)


def _forces_text(mechanism: Mechanism) -> str:
    """A line for every force: its kind in words, where it acts, its scalar numbers."""
    lines = []
    for force in mechanism.forces:
        numbers = [
            f"{name.replace('_', ' ')} {value:g}" for name, value in vars(force).items() if isinstance(value, float)
        ]
        if isinstance(force, JointFriction):
            numbers.append(f"law {force.law}")
        if isinstance(force, JointForceTable):
            columns: dict[str, Any] = {"positions": force.positions, "forces": force.forces}
            numbers = [f"{len(force.positions)} rows"]
            numbers += [f"{name} {values[0]:g} to {values[-1]:g}" for name, values in columns.items()]
        size = f" (SI: {', '.join(numbers)})" if numbers else ""
        if isinstance(force, Coupling):
            lines.append(_coupling_text(force, size))
            continue
        where = f"on joint {force.joint}, {force.motion}" if isinstance(force, JointForce) else _points_text(force)
        lines.append(f"Force {force.name}: {_words(force)} {where}{size}.\n")
    return "".join(lines)


def _coupling_text(coupling: Coupling, size: str) -> str:
    assert coupling.motions is not None, "a mechanism names the motions"
    ends = " and ".join(f"{joint}, {motion}" for joint, motion in zip(coupling.joints, coupling.motions))
    kind = "ratio" if coupling.positions is None else f"table of {len(coupling.positions)} rows"
    ideal = "ideal, " if coupling.ideal else ""
    return f"Coupling {coupling.name}: of joints {ends}, {ideal}by a {kind}{size}.\n"


def _points_text(force: Force) -> str:
    """Where a force at points or along a link acts, and what it is if that is constant."""
    assert isinstance(force, PointLoad)
    if isinstance(force, DistributedForce):
        values = [force.load] if force.end_load is None else [force.load, force.end_load]
        sizes = [f"({', '.join(f'{x:g}' for x in value)}) N/m" for value in values if not force.changes]
        return f"along {force.link}, {' to '.join(sizes) or 'over time'} in {force.axes} axes"
    places = [f"{link} ({', '.join(f'{x:g}' for x in place)}) m" for link, place in force.ends()]
    if not isinstance(force, AtPoint):
        return f"between {' and '.join(places)}"
    value = "over time" if force.changes else f"({', '.join(f'{x:g}' for x in force.value)}) {force.unit}"
    return f"at {places[0]}, {value} in {force.axes} axes"


def _words(value: object) -> str:
    """Name of a class in words: "MomentRamp" is "moment ramp"."""
    return re.sub(r"(?<!^)(?=[A-Z])", " ", type(value).__name__).lower()


def _drives_text(study: Study) -> str:
    """A line for every drive."""
    if not study.drives:
        return "Drive: none.\n"
    named = zip(study.drives, study.drive_labels, strict=True)
    return "".join(f"Drive: {_drive_text(drive, label)}.\n" for drive, label in named)


def _drive_text(drive: AnyDrive, label: str) -> str:
    """Kind of a drive in words, its joint and motion, its scalar numbers."""
    values = {field.name: getattr(drive, field.name) for field in fields(drive)}
    numbers = [
        f"{name.replace('_', ' ')} {float(value):g}"
        for name, value in values.items()
        if isinstance(value, float) or getattr(value, "shape", None) == ()
    ]
    return f"{_words(drive)} on joint {label.replace('.', ', ')}" + (f" (SI: {', '.join(numbers)})" if numbers else "")


def _method_text(study: Study) -> str:
    options = {
        field.name: getattr(study.method, field.name)
        for field in fields(study.method)
        if field.name != "name" and getattr(study.method, field.name) is not None
    }
    words = [study.method.name, *(f"{name} = {value:g}" for name, value in options.items())]
    return ", ".join(words)


def count_lines(mechanism: Mechanism, description: Structure) -> list[str]:
    """Coordinates, constraints, rank, mobility and redundancy, a sentence each."""
    lines = [
        f"Coordinates: {description.coordinates}; constraint equations at the cut joints: "
        f"{description.constraints}, of rank {description.rank}.",
        f"Mobility: {description.mobility} with flexible links, {description.rigid_mobility} if all links "
        f"{'and joints ' if any(joint.sprung for joint in mechanism.joints) else ''}were rigid.",
    ]
    if description.rigid_mobility == 0:
        kinds = ", ".join(f"{joint.name} ({joint.kind})" for joint in mechanism.joints)
        lines.append(f"With every link rigid the joints {kinds} lock: nothing moves but by deflection.")
    for link in description.idle:
        joints = [joint for joint in mechanism.joints if link in (joint.parent, joint.child)]
        kinds = " and ".join(f"{joint.name} ({joint.kind})" for joint in joints)
        balls = len(joints) == 2 and all(KINDS[joint.kind].ball for joint in joints)
        move = f"turn about the line through {kinds}" if balls else f"move alone between {kinds}"
        lines.append(
            f"Idle freedom: link {link} can {move}, and nothing else follows; it starts as the joints' start says, "
            "and is free in the simulation."
        )
    if description.gap > 1e-9:
        lines.append(
            f"With every link rigid a cut joint stays open by {description.gap:.2g} m at the start, which flexible "
            "links take up: lengths and angles with more decimals close it better."
        )
    if not description.redundant:
        return [*lines, "No redundant constraints: all joint reactions are unique."]
    if description.reactions:
        return [*lines, wrap_lines(f"Redundant constraints. {description.reactions}")]
    lines.append("Redundant constraints: the joint reactions are not unique.")
    if mechanism.redundant_reactions == "minimum_norm":
        of = "the longest link; `reaction_length` sets another" if mechanism.reaction_length is None else "as given"
        return [
            *lines,
            "The smallest ones (minimum norm) are reported, as the study asks: the sum over all joints of force^2 + "
            f"(moment / {mechanism.norm_length:g} m)^2 is least ({of}).",
        ]
    fix = (
        "Make a link flexible, give joints a compliance, or choose redundant_reactions = "
        '"minimum_norm" in the table [mechanism].'
    )
    return [*lines, fix]


def start_text(start: StartHeld) -> str:
    """What the start of a simulation holds, and what is released then, in a sentence."""
    driven, undriven = (", ".join(names) for names in (start.driven, start.undriven))
    held = f"; held: {driven}, by drives" if driven else ""
    if start.kind == EQUILIBRIUM:
        return f"Start: static equilibrium of all that no drive holds{held}."
    if not undriven:
        return f"Start: as given{held}; flexible links settle, and no other freedom is left."
    rate = f"with the initial rates of {', '.join(start.rates)}" if start.rates else "from rest"
    return (
        f"Start: as given{held}; {undriven} {'are' if len(start.undriven) > 1 else 'is'} held at the start value "
        f"while flexible links settle, then released {rate}."
    )


def closed_text(model: Model) -> str:
    """How the loops are closed at the start: start values of all joints, and modes of loops of four joints."""
    topology = getattr(model, "topology", None)
    if topology is None or topology.n_cuts == 0:
        return ""
    values = start_values_text(topology, np.asarray(model.start_joints))
    modes = [f"{name} {mode}" for name, mode in loop_modes(model).items()]
    return wrap_lines(f"Loops are closed with {values}" + (f" ({', '.join(modes)})." if modes else "."))


def opening_text(study: Study, model: Model) -> str:
    """Which errors of cases and tolerances open planar loops of rigid links across their plane; nothing where none
    does."""
    topology = getattr(model, "topology", None)
    if topology is None or not topology.across:
        return ""
    parameters = {} if model.source is None else model.source.blueprint.names
    tolerances = {} if study.tolerances is None else study.tolerances.half_widths()
    places = {f"case {case.name}": case.errors for case in study.cases} | {"[tolerances]": tolerances}
    lines = []
    for place, values in places.items():
        changed = [name for name, value in values.items() if value != 0.0]
        full = {name: name for name in changed if name in topology.error_names}
        full |= {parameters[name].full: name for name in changed if name not in full and name in parameters}
        if opened := [f"`{full[one]}`" for one in opening(model, [*full])]:
            lines.append(f"{', '.join(opened)} of {place}")
    if not lines:
        return ""
    return wrap_lines(
        f"Across the plane of the rigid loops nothing gives: {'; '.join(lines)} cannot be assembled. Make one link of "
        "the loop flexible, or let one of its joints give (a compliance or a clearance)."
    )


def _simulation_lines(study: Study, description: Structure) -> list[str]:
    """How a simulation starts, how long it is and by which method."""
    if study.duration is None:
        return []
    save = "by default" if study.save_every is None else f"every {study.save_every:g} s"
    return [
        wrap_lines(start_text(description.start)),
        f"Simulation: {study.duration:g} s with {_method_text(study)}; saved {save}.",
    ]


def _statics_text(study: Study) -> str:
    """What [statics] asks for."""
    statics = study.statics
    if statics is None:
        return "At rest: `rfem-jax statics` computes its loads." if study.duration is None else ""
    motion = (*statics.positions, *statics.rates, *statics.accelerations)
    tables = (statics.positions, statics.rates, statics.accelerations)
    count = max((len(values) for table in tables for values in table.values()), default=1)
    held = ", ".join(dict.fromkeys((*motion, *statics.hold))) or "all that is free, as it starts"
    places = f"{count} position{'s' * (count > 1)}"
    state = "in this motion" if statics.moves else "at rest"
    return f"Statics: held {held}, at {places}; all tasks are of the mechanism {state}."


def study_text(study: Study, description: Structure) -> str:
    """Everything the command `check` prints, but the stable step.

    Arguments: study as loaded; description from `rfem_jax.mechanics.describe(model)`.
    """
    mechanism = study.mechanism
    link_header = ["link", "length, m", "mass, kg", "rfes", "point masses", "section"]
    joint_header = ["joint", "kind", "parent", "child", "start", "remarks"]
    cases = [[case.name, _errors_text(mechanism, case)] for case in study.cases]
    gravity = ", ".join(f"{value:g}" for value in mechanism.gravity)
    plane = ["Plane: x and y, hinges turn about z."] if mechanism.plane == "xy" else []
    return "\n\n".join(
        [
            title_text(study),
            format_table(link_header, link_rows(mechanism), words=(0, 5)),
            format_table(joint_header, joint_rows(study), words=(0, 1, 2, 3, 5)),
            "\n".join([*count_lines(mechanism, description), f"Gravity: {gravity} m/s^2.", *plane]),
            f"{_compliance_text(mechanism)}{_clearance_text(mechanism)}{_forces_text(mechanism)}{_drives_text(study)}"
            + "\n".join(filter(None, [*_simulation_lines(study, description), wrap_lines(_statics_text(study))])),
            format_table(["case", "assembly errors"], cases, words=(0, 1)),
        ]
    )
