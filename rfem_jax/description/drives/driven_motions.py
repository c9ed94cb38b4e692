"""Several drives at once, and which free motions of joints they act on.

Place in the pipeline: family, joints -> **driven_motions** -> mechanism, study, simulation.

A free motion is named as its joint where it is the only one, else as joint and motion: "A", "C.T_y".
"""

from collections.abc import Sequence

from rfem_jax.description.basics.errors import InputError, require_choice
from rfem_jax.description.basics.joint_kinds import KINDS
from rfem_jax.description.drives.family import GivenDrive, PrescribedDrive

AnyDrive = GivenDrive | PrescribedDrive
Drive = AnyDrive | Sequence[AnyDrive] | None
_ROUNDING = 1e-9  # relative, of times that are meant to be equal


def each_drive(drive: Drive) -> tuple[AnyDrive, ...]:
    """The drives of one, several or none.

    Raises:
        InputError: something else than drives is among them.
    """
    if drive is None:
        return ()
    found = []
    for one in drive if isinstance(drive, (list, tuple)) else (drive,):
        if not isinstance(one, (GivenDrive, PrescribedDrive)):
            raise InputError(
                f"Argument `drive` must be a drive, a list of drives or None, but was {one!r}; pass for example "
                '[PrescribedRate("A", 2.0), ForceRamp("G", 5.0, 0.1)].'
            )
        found.append(one)
    return tuple(found)


def all_breakpoints(drive: Drive) -> tuple[float, ...]:
    """The times [s] at which any of the drives jumps, increasing, each once."""
    return merged([time for one in each_drive(drive) for time in one.breakpoints()])


def merged(times: Sequence[float]) -> tuple[float, ...]:
    """Times [s] in their order, each once."""
    found: list[float] = []
    for time in sorted(times):
        if not found or time - found[-1] > _ROUNDING * time:
            found.append(time)
    return tuple(found)


def own_breakpoints(one: AnyDrive, every: Sequence[float]) -> tuple[int, ...]:
    """Which of all breakpoints are those of one of the drives."""
    return tuple(min(range(len(every)), key=lambda i: abs(every[i] - time)) for time in one.breakpoints())


def plain_motion(motion: str | None, kind: str, joint: str, whose: str) -> str:
    """The free motion of a joint of a kind that is meant; None: its only one.

    Args:
        motion: its name, such as "R_y" or "T_x".
        kind: a name in `KINDS`.
        joint: name of the joint, for messages.
        whose: whose argument it is, such as "force `spring`" or "the drive".
    Raises:
        InputError: the joint has no such motion, or several and none is named, or it is about any axis.
    """
    motions = KINDS[kind].motions
    if not motions:
        raise InputError(
            f"Argument `joint` of {whose} must have a free motion, but `{joint}` is {kind}; take another joint."
        )
    found = motions[0]
    if motion is None and len(motions) > 1:
        listed = ", ".join(f'"{motion}"' for motion in motions if "_" in motion)
        raise InputError(
            f"Argument `motion` of {whose} must say which motion of joint `{joint}` is meant, because it is {kind}, "
            f"but was left out; give one of {listed}."
        )
    if motion is not None:
        found = require_choice(motion, motions, f"`motion` of {whose}")
    if "_" not in found:
        raise InputError(
            f"Argument `motion` of {whose} must be about or along one axis, but `{joint}` is {kind} and turns about "
            "any axis, for which that is not offered; take another motion, or a universal joint and a hinge instead, "
            "which turn about one axis each."
        )
    return found


def motion_label(joint: str, kind: str, motion: str) -> str:
    """Name of a free motion: that of its joint where it is the only one."""
    return joint if len(KINDS[kind].motions) == 1 else f"{joint}.{motion}"


def driven_motion(drive: AnyDrive, kind: str) -> str:
    """The free motion that a drive acts on, on a joint of a kind.

    Raises:
        InputError: the joint has no such motion, or the drive is of rotations and the motion a translation, or the
            other way about.
    """
    motion = plain_motion(drive.motion, kind, drive.joint, f"the drive on `{drive.joint}`")
    rotation = motion.startswith("R")
    if drive.rotation is not None and drive.rotation != rotation:
        have = "moments and angles", "MomentRamp or PrescribedRate"
        want = "forces and displacements", "ForceRamp or PrescribedSpeed"
        have, want = (want, have) if rotation else (have, want)
        raise InputError(
            f"Argument `drive` must fit the motion {motion} of joint `{drive.joint}`, but {type(drive).__name__} is "
            f"of {have[0]}; take one of {want[0]}, such as {want[1]}."
        )
    return motion
