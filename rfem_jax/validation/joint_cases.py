"""Runs of mechanisms with joints of several kinds against reference values of their loads and motions.

Place in the pipeline: serves `slider_cranks` and `spatial_linkages`. The reference's quantities are by case: RMS loads
and preload by joint; loads of base joints in the axes of the seat, angles and displacements by time and joint.
"""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from rfem_jax.mechanics.statics.assembly import Load
from rfem_jax.simulation import Run
from rfem_jax.validation.lines import Line, absolute, relative
from rfem_jax.validation.reference_values import Reference
from rfem_jax.validation.rigid_links import turn_y


@dataclass(frozen=True)
class Shares:
    """Allowed differences: of RMS loads, of the preload, of loads at instants (share of the RMS load), of angles and
    displacements (rad, m)."""

    rms: float
    instant: float
    motion: float
    preload: float = 1e-8


def checked(
    reference: Reference, case: str, group: str, run: Run, allowed: Shares, duration: float | None = None
) -> list[Line]:
    """All lines that the reference has of a case; group: their heading; duration [s] of RMS loads (None: the run's)."""
    lines: list[Line] = []
    metrics = run.metrics if duration is None else run.window(0.0, duration)
    for quantity, values in (("force", metrics.rms_force), ("moment", metrics.rms_moment)):
        found = {joint: float(value) for joint, value in values.items()}
        lines += _by_joint(reference, f"rms_{quantity}", case, group, f"RMS {quantity}", found, allowed.rms)
    lines += preload_lines(reference, case, group, run.preload, allowed.preload)
    for quantity in ("force", "moment"):
        lines += _at_instants(reference, quantity, case, group, run, allowed.instant)
    for name, coordinates in (("angle", run.motion.angles), ("slide", run.motion.displacements)):
        lines += _motion(reference, name, case, group, run, coordinates, allowed.motion)
    return lines


def preload_lines(reference: Reference, case: str, group: str, preload: Mapping[str, Load], share: float) -> list[Line]:
    """Resultants of the loads at rest."""
    lines: list[Line] = []
    for quantity in ("force", "moment"):
        found = {joint: float(np.linalg.norm(getattr(load, quantity))) for joint, load in preload.items()}
        lines += _by_joint(reference, f"preload_{quantity}", case, group, f"preload {quantity}", found, share)
    return lines


def _by_joint(
    reference: Reference, key: str, case: str, group: str, title: str, found: Mapping[str, float], share: float
) -> list[Line]:
    if key not in reference.quantities or case not in reference[key]:
        return []
    known, unit = reference[key][case], reference.quantities[key].unit
    largest = max(known.values())
    lines = []
    for joint, value in known.items():
        # What vanishes, or nearly, is compared with the largest.
        line = relative if value > 1e-2 * largest else absolute
        allowed = share if value > 1e-2 * largest else share * largest
        lines.append(line(group, f"{title} {joint}", found[joint], value, allowed, reference.label, unit))
    return lines


def _at_instants(reference: Reference, quantity: str, case: str, group: str, run: Run, share: float) -> list[Line]:
    """Of all instants and components of a joint's load the one that is farthest off, within a share of the joint's RMS
    load (or of a tenth of the component, or of a hundredth of the largest RMS load)."""
    key, found = f"seat_{quantity}", []
    unit, scales = reference.quantities[key].unit, reference[f"rms_{quantity}"][case]
    for time, i, known in _instants(reference, key, case, run):
        for joint, values in known.items():
            scale = max(scales[joint], 1e-2 * max(scales.values()))
            for axis, value, given in zip("xyz", in_seat(run, joint, quantity, i), values):
                allowed = share * max(scale, 0.1 * abs(given))
                name = f"{quantity} {axis} of {joint} at {time} s"
                line = absolute(group, name, value, given, allowed, reference.label, unit)
                found.append((joint, line))
    return _worst(found)


def _motion(
    reference: Reference, name: str, case: str, group: str, run: Run, coordinates: Mapping[str, Any], allowed: float
) -> list[Line]:
    """Of all instants the one where an angle, up to whole turns, or a displacement is farthest off."""
    found = []
    for time, i, known in _instants(reference, name, case, run):
        for joint, given in known.items():
            value, unit = float(np.asarray(coordinates[joint])[i]), reference.quantities[name].unit
            if unit == "rad":
                value -= 2.0 * np.pi * np.round((value - given) / (2.0 * np.pi))
            title = f"{name} of {joint} at {time} s"
            line = absolute(group, title, value, given, allowed, reference.label, unit)
            found.append((joint, line))
    return _worst(found)


def _worst(found: list[tuple[str, Line]]) -> list[Line]:
    """Of each joint the line whose difference is the largest, in units of what is allowed."""
    worst: dict[str, Line] = {}
    for joint, line in found:
        if joint not in worst or _strain(line) > _strain(worst[joint]):
            worst[joint] = line
    return list(worst.values())


def _strain(line: Line) -> float:
    return abs(line.difference) / line.allowed if math.isfinite(line.difference) else math.inf


def in_seat(run: Run, joint: str, quantity: str, i: int) -> Float[np.ndarray, "3"]:
    """The load of a revolute, cylindrical or prismatic joint at a saved time in the axes of its seat."""
    load = np.asarray(getattr(run.loads[joint], quantity))[i]
    return turn_y(float(np.asarray(run.motion.angles[joint])[i])) @ load if joint in run.motion.angles else load


def _instants(reference: Reference, key: str, case: str, run: Run) -> Iterator[tuple[str, int, dict[str, Any]]]:
    """Times of the reference in words, their indices among the saved times, and the values there."""
    times = np.asarray(run.times)
    for named, values in reference.quantities[key].values.get(case, {}).items() if key in reference.quantities else ():
        i = int(np.argmin(np.abs(times - float(named))))
        if abs(times[i] - float(named)) > 1e-9:
            raise ValueError(f"The run of {case} has no saved time {named} s.")
        yield f"{float(named):.4g}", i, values
