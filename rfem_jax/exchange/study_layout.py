"""A study as a layout: rigid links at their start, with the errors of one of its cases.

Place in the pipeline: `load_study` -> **study_layout** -> frame_table, urdf_writer, mjcf_writer.

Flexible links count as rigid ones of the same mass; masses, inertias and frames with errors are those of the equations
of motion (`apply_errors`). With errors the loops are closed again, so that the start is a position of the mechanism.
"""

from dataclasses import replace

import equinox as eqx
import numpy as np
from jaxtyping import Float

from rfem_jax.description.basics.joint_kinds import KINDS
from rfem_jax.description.mechanism.couplings import Coupling
from rfem_jax.description.mechanism.forces import Force, JointSpring
from rfem_jax.description.mechanism.links import GRADIENTS
from rfem_jax.description.mechanism.mechanism import EQUILIBRIUM, Mechanism
from rfem_jax.description.mechanism.point_forces import PointSpring
from rfem_jax.description.study_file.study import Study
from rfem_jax.exchange.layout import Along, Body, Connection, Layout, Pull, Ratio
from rfem_jax.exchange.rigid_frames import Frame, angles_of, rotation_of_quaternion
from rfem_jax.mechanics.model.model import Model
from rfem_jax.mechanics.model.nominal_geometry import (
    NominalGeometry,
    closure_jacobian,
    gaps,
    geometry_of,
    joint_units,
    moved,
    place,
    shortest,
)
from rfem_jax.mechanics.model.with_errors import ModelWithErrors, apply_errors
from rfem_jax.mechanics.statics.designs import designed, model_of_study

OPEN = 1e-9  # residual of the loops, lengths over the longest link, up to which they count as closed
_ITERATIONS = 30
_applied = eqx.filter_jit(apply_errors)


def layout_of(study: Study, case: str | None = None) -> Layout:
    """The layout of a study with the errors of a case (None: perfect).

    **Raises:** `InputError` for a case that there is not, and for a mechanism that cannot be built with rigid links.
    """
    errors = {} if case is None else study.case(case).errors
    rigid, remarks = with_rigid_links(study.mechanism)
    model = model_of_study(replace(study, mechanism=rigid, statics=None))
    made = designed(model, None, errors)
    actual = _applied(made.model, made.errors)
    geometry = _with_errors(geometry_of(made.model), actual)
    start, gap = _closed(geometry, made.model)
    if gap > OPEN:
        remarks.append(
            f"With rigid links and these errors the loops stay open by {gap * geometry.scale:.2g} m (or {gap:.2g} rad)"
        )
    if study.start == EQUILIBRIUM:
        remarks.append("The start in static equilibrium: bodies stand at the start values of the joints")
    if study.drives:
        names = ", ".join(study.drive_labels)
        remarks.append(f"The drive of {names}: files hold a mechanism, not what moves it")
    lengths = np.asarray(made.model.length + made.errors.length)
    found = _layout(study, made.model, actual, geometry, start, lengths)
    return replace(found, remarks=tuple(f"{one}." for one in remarks))


def with_rigid_links(mechanism: Mechanism) -> tuple[Mechanism, list[str]]:
    """The mechanism of rigid links and ideal joints with the springs that a layout has, and what it leaves out."""
    remarks = []
    bending = [link.name for link in mechanism.links if link.flexible]
    if bending:
        remarks.append(f"The flexibility of {', '.join(bending)}: they are rigid there, with the same mass")
    for words, field in (("compliance", "compliance"), ("clearance", "clearance")):
        if names := [joint.name for joint in mechanism.joints if getattr(joint, field) is not None]:
            remarks.append(f"The {words} of {', '.join(names)}: the joints are ideal there")
    if rated := [joint.name for joint in mechanism.joints if any(rate for rate in joint.start_rates)]:
        remarks.append(f"The initial rates of {', '.join(rated)}")
    kept, left = [], []
    for force in mechanism.forces:
        (kept if isinstance(force, JointSpring | PointSpring) else left).append(force)
    remarks += [f"The {_words(force)} {force.name}" for force in left if not _is_ratio(force, mechanism)]
    # Ideal couplings close the start with the mechanism, as cut joints do.
    kept += [force for force in left if isinstance(force, Coupling) and force.ideal]
    links = [replace(link, rigid=True, **dict.fromkeys(GRADIENTS)) for link in mechanism.links]
    joints = [replace(joint, compliance=None, clearance=None) for joint in mechanism.joints]
    return replace(mechanism, links=links, joints=joints, forces=kept), remarks


def _is_ratio(force: Force, mechanism: Mechanism) -> bool:
    """Whether a force is an ideal coupling by a ratio, of two joints with one motion each."""
    if not isinstance(force, Coupling) or not force.ideal or force.positions is not None or force.eccentricity:
        return False
    kinds = [KINDS[mechanism.joint(name).kind] for name in force.joints]
    return force.joints[0] != force.joints[1] and all(len(kind.freedoms) == 1 for kind in kinds)


def _words(force: Force) -> str:
    name = type(force).__name__
    return "".join(f" {letter.lower()}" if letter.isupper() else letter for letter in name).strip()


def _with_errors(geometry: NominalGeometry, actual: ModelWithErrors) -> NominalGeometry:
    return geometry._replace(
        seat_rotation=np.moveaxis(np.asarray(actual.seat_rotation), 2, 0),
        seat_position=np.asarray(actual.seat_position).T,
        bore_rotation=np.moveaxis(np.asarray(actual.bore_rotation), 2, 0),
        bore_position=np.asarray(actual.bore_position).T,
    )


def _closed(geometry: NominalGeometry, model: Model) -> tuple[Float[np.ndarray, " numbers"], float]:
    """Joint coordinates near the start with which the loops are closed as well as they can be, those that a simulation
    holds at its start being held; and the largest residual."""
    topology = model.topology
    held = [*topology.held, *topology.undriven]
    units = joint_units(geometry)
    free = np.setdiff1d(np.arange(topology.n_freedoms), held)
    found = np.asarray(model.start_joints)
    for _ in range(_ITERATIONS):
        placed = place(geometry, found)
        residual = gaps(geometry, placed).residual
        if np.abs(residual).max(initial=0.0) < 1e-3 * OPEN:
            break
        change = np.zeros(topology.n_freedoms)
        columns = closure_jacobian(geometry, placed)[:, free]
        change[free] = -shortest(columns, residual, 1e-8) * units[free]
        found = moved(topology, found, change)
    return found, float(np.abs(gaps(geometry, place(geometry, found)).residual).max(initial=0.0))


def _layout(
    study: Study,
    model: Model,
    actual: ModelWithErrors,
    geometry: NominalGeometry,
    start: Float[np.ndarray, " numbers"],
    lengths: Float[np.ndarray, " links"],
) -> Layout:
    topology, placed = model.topology, place(geometry, start)
    names = topology.links
    mass, centre, inertia = (np.asarray(one) for one in (actual.mass, actual.centre, actual.inertia))
    bodies = {
        name: Body(
            name,
            Frame(placed.rotation[l], placed.origin[l]),
            float(mass[l]),
            centre[:, l],
            inertia[:, :, l],
            float(lengths[l]),
        )
        for l, name in enumerate(names)
    }
    springs = _springs_of(study.mechanism)
    joints = {}
    for j, name in enumerate(topology.joints):
        joint, cut = study.mechanism.joint(name), j >= topology.n_links
        values = () if cut else _values(joint.kind, start[topology.positions[j].start : topology.positions[j].stop])
        seat = Frame(geometry.seat_rotation[j], geometry.seat_position[j])
        bore = Frame(geometry.bore_rotation[j], geometry.bore_position[j])
        joints[name] = Connection(
            name, joint.kind, joint.parent, joint.child, seat, bore, cut, values, springs.get(name, ())
        )
    return Layout(
        title=study.title,
        bodies=tuple(bodies[link.name] for link in study.mechanism.links),
        joints=tuple(joints[joint.name] for joint in study.mechanism.joints),
        gravity=np.asarray(model.gravity),
        pulls=tuple(map(_pull, (one for one in study.mechanism.forces if isinstance(one, PointSpring)))),
        ratios=_ratios(study.mechanism, {name: joint.start for name, joint in joints.items()}),
        framed=True,
    )


def _values(kind: str, numbers: Float[np.ndarray, " k"]) -> tuple[float, ...]:
    """Start values of a joint, with three angles in the place of a quaternion."""
    plain = len(KINDS[kind].freedoms) - 3 * KINDS[kind].ball
    values = [float(x) for x in numbers[:plain]]
    if KINDS[kind].ball:
        values += [float(x) for x in angles_of(rotation_of_quaternion(np.asarray(numbers[plain:])))]
    return tuple(values)


def _springs_of(mechanism: Mechanism) -> dict[str, tuple[Along, ...]]:
    """Springs along motions by the names of the joints."""
    found: dict[str, tuple[Along, ...]] = {}
    for force in mechanism.forces:
        if isinstance(force, JointSpring):
            numbers = (float(np.asarray(x)) for x in (force.stiffness, force.damping, force.rest, force.preload))
            found[force.joint] = (*found.get(force.joint, ()), Along(str(force.motion), *numbers))
    return found


def _ratios(mechanism: Mechanism, starts: dict[str, tuple[float, ...]]) -> tuple[Ratio, ...]:
    """Ideal couplings by a ratio; an offset that is left out is that of the start."""
    found = []
    for one in mechanism.forces:
        if not isinstance(one, Coupling) or not _is_ratio(one, mechanism):
            continue
        ratio = float(np.asarray(one.ratio))
        a, b = (starts[name][0] for name in one.joints)
        shift = ratio * float(np.asarray(one.pitch_error))
        offset = b - ratio * a if one.offset is None else float(np.asarray(one.offset)) + shift
        found.append(Ratio(one.name, one.joints, ratio, offset))
    return tuple(found)


def _pull(one: PointSpring) -> Pull:
    numbers = (float(getattr(one, name)) for name in ("stiffness", "damping", "free_length", "preload"))
    first, second = (np.asarray(point, dtype=float) for point in one.points)
    return Pull(one.name, one.links, (first, second), *numbers)
