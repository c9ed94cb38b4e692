"""Which joint coordinates drives act on: those of the model's driven joints, and no others; and the jumps of drives and
of forces.

Place in the pipeline: model, drives -> **driving** -> equations, integration, stability.
"""

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, Int

from rfem_jax.description.basics.errors import InputError, suggestion
from rfem_jax.description.drives.driven_motions import (
    AnyDrive,
    Drive,
    driven_motion,
    each_drive,
    merged,
    motion_label,
    own_breakpoints,
)
from rfem_jax.description.drives.numbers_by_name import (
    drive_number_names,
    drive_number_value,
    drives_with,
    each_drive_number,
)
from rfem_jax.description.drives.rotations import GivenDrive, PrescribedDrive, Time
from rfem_jax.mechanics.laws.frame_forces import Time as Instant
from rfem_jax.mechanics.laws.point_laws import breakpoints_of, changing, rows_of
from rfem_jax.mechanics.model.inputs import DriveInput
from rfem_jax.mechanics.model.model import Model
from rfem_jax.mechanics.model.topology import Topology
from rfem_jax.mechanics.statics.designs import Design


class ActiveDrives(eqx.Module):
    """The drives of a model, with what they need of it.

    drives; starts: start of each prescribed coordinate [rad, m], from which its motion counts, None for given forces;
    coordinates: joint coordinates that they act on; breakpoints: which of all breakpoints are each drive's own, None
    where all are; jumps: all breakpoints [s] where forces are functions of time, else None.
    """

    drives: tuple[AnyDrive, ...]
    starts: tuple[Float[Array, ""] | None, ...]
    coordinates: tuple[int, ...] = eqx.field(static=True)
    breakpoints: tuple[tuple[int, ...] | None, ...] = eqx.field(static=True)
    jumps: tuple[float, ...] | None = eqx.field(static=True, default=None)

    @property
    def prescribed(self) -> tuple[int, ...]:
        """Joint coordinates whose motion is prescribed."""
        each = zip(self.coordinates, self.drives, strict=True)
        return tuple(k for k, drive in each if isinstance(drive, PrescribedDrive))

    def at(self, t: Time, phase: Int[Array, ""]) -> DriveInput:
        """Forces and prescribed motions at the time t [s], after `phase` of all breakpoints."""
        forces, motions = {}, {}
        for k, drive, start, own in zip(self.coordinates, self.drives, self.starts, self.breakpoints, strict=True):
            # Comparisons, no table: gathers are slow in compiled loops.
            passed = phase if own is None else sum((phase > i).astype(jnp.int32) for i in own) + 0 * phase
            if isinstance(drive, GivenDrive):
                forces[k] = drive.force_at(t, passed)
            elif start is not None:
                change, rate, acceleration = drive.motion_at(t, passed)  # counted from the start of the coordinate
                motions[k] = start + change, rate, acceleration
        time = None if self.jumps is None else Instant(jnp.asarray(t), jnp.asarray((-1.0, *self.jumps))[phase])
        return DriveInput(forces, motions, time)


def active_drives(model: Model, drive: Drive) -> ActiveDrives:
    """The drives with the joint coordinates of the model that they act on."""
    topology, drives = model.topology, each_drive(drive)
    coordinates = tuple(_coordinate(topology, one) for one in drives)
    starts = [
        _start_of(model, topology.place_of(k)) if isinstance(one, PrescribedDrive) else None
        for k, one in zip(coordinates, drives, strict=True)
    ]
    every = all_jumps(drive, model)
    mixed = len(drives) > 1 or bool(breakpoints_of(model.vectors_of_time))
    own = tuple(own_breakpoints(one, every) for one in drives) if mixed else (None,) * len(drives)
    jumps = every if changing(model.vectors_of_time) else None
    return ActiveDrives(drives, tuple(starts), coordinates, own, jumps)


def _start_of(model: Model, place: int) -> Float[Array, ""]:
    """A joint coordinate of the start; of NumPy where it is known, since JAX would compile the look at it."""
    joints = model.start_joints
    return joints[place] if isinstance(joints, Tracer) else jnp.asarray(np.asarray(joints)[place], jnp.float64)


def all_jumps(drive: Drive, model: Model | None) -> tuple[float, ...]:
    """Times [s] > 0 at which a drive or a force of the model jumps, increasing."""
    of_forces = () if model is None else breakpoints_of(model.vectors_of_time)
    return merged([*of_forces, *(time for one in each_drive(drive) for time in one.breakpoints())])


def all_step_ends(drive: Drive, model: Model | None, interval: float) -> tuple[float, ...]:
    """Times [s] that are ends of steps in intervals of a length [s], beside the jumps: rows of tables over time, and
    places within a short rise."""
    of_forces = () if model is None else rows_of(model.vectors_of_time)
    return merged([*of_forces, *(time for one in each_drive(drive) for time in one.step_ends(interval))])


def prescribed_coordinates(topology: Topology, drive: Drive) -> tuple[int, ...]:
    """Joint coordinates whose motion is prescribed."""
    return tuple(_coordinate(topology, one) for one in each_drive(drive) if isinstance(one, PrescribedDrive))


def _coordinate(topology: Topology, drive: AnyDrive) -> int:
    """The joint coordinate that a drive acts on."""
    joint = topology.joints.index(drive.joint)
    return topology.coordinates[joint][topology.kind(joint).motions.index(driven_motion(drive, topology.kinds[joint]))]


def require_masses(model: Model) -> None:
    """Raise InputError for links without mass, whose accelerations no equation tells."""
    names = ", ".join(f"`{model.topology.links[l]}`" for l in model.topology.massless)
    if names:
        raise InputError(
            f"Argument `mass` of the body of {names} must be greater than 0 in a motion, but is 0: without mass only "
            "positions at rest can be computed (`turn`, `assemble`); give a small mass and inertia."
        )


def require_driven(model: Model, drive: Drive) -> None:
    """Check that the model can move, and that drives act on its driven joints, each on a motion of its own.

    **Raises:** `InputError` if the model has no driven joint, or others, and for prescribed motions that the joints do
    not let be independent; of links without mass.
    """
    require_masses(model)
    drives = each_drive(drive)
    for one in drives:
        _require_joint(model, one)
    labels = [_label(model.topology, one) for one in drives]
    for one, label in zip(drives, labels, strict=True):
        if labels.count(label) > 1:
            raise InputError(
                f"Argument `drive` must have one drive for each motion of a joint, but has several for `{label}`; add "
                "them up in one."
            )
        if label not in model.topology.drive_labels:
            raise _other_joint(model, one, labels)
        coordinate = model.topology.drives[model.topology.drive_labels.index(label)]
        if isinstance(one, PrescribedDrive) and model.topology.tilted(coordinate) is not None:
            raise InputError(
                "Argument `drive` must not prescribe the angle of a joint whose tilt is sprung or has play, but "
                f"prescribes that of `{one.joint}`; leave its tilt rigid, drive another joint, or give a moment."
            )
        if isinstance(one, PrescribedDrive) and coordinate in model.topology.rated:
            raise InputError(
                f"Argument `drive` must not prescribe a motion with an initial rate, but prescribes that of `{label}`; "
                "leave out the rate of the joint, which the drive sets."
            )
    _require_independent(model.topology, drives)


def _label(topology: Topology, drive: AnyDrive) -> str:
    kind = topology.kinds[topology.joints.index(drive.joint)]
    return motion_label(drive.joint, kind, driven_motion(drive, kind))


def drive_of_design(model: Model, drive: Drive, design: Design | None) -> Drive:
    """The drives with the numbers of a design, if there is one.

    **Raises:** `InputError` for numbers that they do not have.
    """
    return drives_with(*_labelled(model, drive), design.drives) if design is not None and design.drives else drive


def drive_numbers(model: Model, drive: Drive, design: Design | None) -> dict[str, Array | float]:
    """Numbers of the drives [their units] as the design, or else the description, has them, by one name each."""
    drives, labels = _labelled(model, drive)
    names = drive_number_names(drives, labels)
    given = {} if design is None else design.drives
    set_to = {names[name][0]: value for name, value in given.items() if name in names}
    each = each_drive_number(drives, labels)
    return {name: set_to[i] if i in set_to else drive_number_value(drives[i]) for name, i in each.items()}


def design_with(model: Model, drive: Drive, design: Design | None, numbers: dict[str, Array]) -> Design:
    """The design with other numbers [their units] of the drives."""
    if design is None:
        return Design({}, numbers)
    names = drive_number_names(*_labelled(model, drive))
    replaced = {names[name] for name in numbers}
    kept = {name: value for name, value in design.drives.items() if names.get(name) not in replaced}
    return Design(design.values, {**kept, **numbers})


def _labelled(model: Model, drive: Drive) -> tuple[tuple[AnyDrive, ...], list[str]]:
    """The drives, and the names of the free motions that they act on."""
    drives = each_drive(drive)
    return drives, [_label(model.topology, one) for one in drives]


def _require_joint(model: Model, drive: AnyDrive) -> None:
    tree = model.topology.joints[: model.topology.n_links]
    if drive.joint not in tree:
        cut = drive.joint in model.topology.joints
        raise InputError(
            f"Argument `drive` must act on a joint of the tree, but acts on `{drive.joint}`"
            + (", which is cut; cut another joint of the loop." if cut else f"; {suggestion(drive.joint, tree)}")
        )


def _other_joint(model: Model, drive: AnyDrive, labels: Sequence[str]) -> InputError:
    known = [f"`{label}`" for label in model.topology.drive_labels]
    driven = "no joint of the model is driven" if not known else f"that is {' and '.join(known)}"
    wanted = labels[0] if len(labels) == 1 else list(labels)
    return InputError(
        f"Argument `drive` must act on the model's driven joint, but acts on `{drive.joint}` and {driven}; the model "
        f"is assembled with this joint held, so describe it by Mechanism(..., driven_joint={wanted!r})."
    )


def _require_independent(topology: Topology, drives: Sequence[AnyDrive]) -> None:
    """Prescribed motions come first among the driven ones as far as they depend on each other."""
    prescribed = prescribed_coordinates(topology, drives)
    labels = dict(zip(topology.drives, topology.drive_labels, strict=True))
    for k in prescribed:
        if k in topology.blocked:
            raise InputError(
                f"Argument `drive` must prescribe motions that can be independent, but that of `{labels[k]}` follows "
                "from those of other driven joints; prescribe one less."
            )
        before = topology.drives[: topology.drives.index(k)]
        first = [labels[i] for i in before if i not in prescribed and i not in topology.dependent]
        if k in topology.dependent and first:
            raise InputError(
                f"Argument `driven_joint` must name prescribed motions first, but `{labels[k]}` stands behind "
                f"`{first[0]}`, which is held with it at assembly; put `{labels[k]}` before it."
            )
