"""Where a prescribed motion asks for a position at which the loops do not close.

Place in the pipeline: model, drive -> **locking** -> the status of a failed run, report.

A crank that cannot turn round locks where the loop is stretched or folded: rates and loads grow without bound before,
and a run is lost there whatever its step. The perfect rigid mechanism is followed along the prescribed motion, in NumPy
and only when it is asked for; within compiled programs nothing is computed for it, and there such a run has
diverged. What no drive prescribes moves as little as the loops allow.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Float, Int

from rfem_jax.description.drives.driven_motions import Drive
from rfem_jax.mechanics.model.discretisation import CLOSING_TOLERANCE, close_at
from rfem_jax.mechanics.model.model import Model
from rfem_jax.mechanics.model.nominal_geometry import geometry_of, joint_units
from rfem_jax.mechanics.model.status import DIVERGED, DRIFTED, NOT_CONVERGED, OUT_OF_RANGE, PAST_LIMIT, STEPS_EXHAUSTED
from rfem_jax.simulation.outcome.run import Run
from rfem_jax.simulation.system.driving import ActiveDrives, active_drives, all_jumps

SAMPLES = 1000  # of the drive over the duration
STEP = 0.05  # of the prescribed positions from pose to pose [rad, longest links]
MOST = 4000  # poses of several prescribed motions
BISECTIONS = 14
NEAR = 0.02  # of the time until the limit: a run that fails there fails because of it
FAILED_IN_MOTION = (DIVERGED, DRIFTED, NOT_CONVERGED, STEPS_EXHAUSTED, OUT_OF_RANGE)


class DriveLimit(NamedTuple):
    """The instant at which the loops stop closing: its time [s]; the first prescribed coordinate by joint, or joint and
    motion, "A" or "C.T_y"; whether it is a displacement; its position then and at the start [rad, m]."""

    time: float
    label: str
    slide: bool
    position: float
    start: float

    @property
    def text(self) -> str:
        """Time and position in a sentence's part."""
        shown = [f"{x:.5g} m" if self.slide else f"{np.degrees(x):.5g} deg" for x in (self.position, self.moved)]
        return f"after {self.time:.5g} s, with {self.label} at {shown[0]} ({shown[1]} from its start)"

    @property
    def moved(self) -> float:
        """Way from the start [rad, m]."""
        return self.position - self.start


def drive_limit(model: Model, drive: Drive, duration: float) -> DriveLimit | None:
    """The instant at which the loops of the perfect mechanism stop closing while its drives prescribe their motions for
    a duration [s]. None if the loops close throughout, or no motion is prescribed."""
    topology = model.topology
    if topology.n_constraints == 0 or drive is None:
        return None
    drives = active_drives(model, drive)
    if not drives.prescribed:
        return None
    times, asked = _prescribed_positions(model, drives, all_jumps(drive, model), duration)
    places = np.array([topology.place_of(k) for k in drives.prescribed])
    units = joint_units(geometry_of(model))[list(drives.prescribed)]
    turns = len(places) == 1 and not topology.slides[drives.prescribed[0]]
    farthest = _follow(model, drives.prescribed, places, asked, units, turns)
    if farthest is None:
        return None
    last, position = farthest
    time = _time_of(position, times, asked, last)
    k = drives.prescribed[0]
    start = float(model.start_joints[places[0]])
    return DriveLimit(time, topology.label_of(k), topology.slides[k], float(position[0]), start)


def _prescribed_positions(
    model: Model, drives: ActiveDrives, jumps: tuple[float, ...], duration: float
) -> tuple[Float[np.ndarray, " times"], Float[np.ndarray, "times prescribed"]]:
    """Times [s] and the positions [rad, m] that are asked for there."""
    times = np.linspace(0.0, float(duration), SAMPLES + 1)
    phases = np.searchsorted(np.asarray(jumps), times, side="right") if jumps else np.zeros(len(times), int)

    def at(t, phase):
        motions = drives.at(t, phase).motions
        return jnp.stack([jnp.asarray(motions[k][0], jnp.float64) for k in drives.prescribed])

    return times, np.asarray(jax.vmap(at)(jnp.asarray(times), jnp.asarray(phases, jnp.int32)))


def _follow(
    model: Model,
    held: tuple[int, ...],
    places: Int[np.ndarray, " prescribed"],
    asked: Float[np.ndarray, "times prescribed"],
    units: Float[np.ndarray, " prescribed"],
    turns: bool,
) -> tuple[int, Float[np.ndarray, " prescribed"]] | None:
    """The first time by its index before which the loops stop closing, and the positions where they do."""
    # By the sense in which one motion goes on: the farthest position of each, and the pose there.
    start = asked[0], np.asarray(model.start_joints, float)
    ends = dict.fromkeys((-1, 1), start)
    for n in _worth(asked, units, turns):
        sense = 1 if len(places) > 1 or asked[n, 0] > asked[0, 0] else -1
        here, pose = ends[sense]
        count = max(1, int(np.ceil(np.max(np.abs(asked[n] - here) / units) / STEP)))
        for target in np.linspace(here, asked[n], count + 1)[1:]:
            closed = _closed(model, held, places, pose, target)
            if closed is None:
                return n, _limit(model, held, places, (here, pose), target)
            here, pose = target, closed
        ends[sense] = here, pose
    return None


def _worth(asked: Float[np.ndarray, "times prescribed"], units: Float[np.ndarray, " prescribed"], turns: bool):
    """Yield the indices of the times whose prescribed positions are worth a check: of a single motion those beyond all
    earlier ones, of an angle (`turns`) within one revolution. They are about a step apart, except where a motion turns
    back."""
    single, kept, poses = asked.shape[1] == 1, asked[0], 0
    farthest = {-1: asked[0, 0], 1: asked[0, 0]}
    for n in range(1, len(asked)):
        if not np.all(np.isfinite(asked[n])) or poses > MOST:
            return
        if single:
            sense = 1 if asked[n, 0] > asked[0, 0] else -1
            if sense * asked[n, 0] <= sense * farthest[sense]:
                continue
            goes_on = n + 1 < len(asked) and sense * asked[n + 1, 0] > sense * asked[n, 0]
            if goes_on and abs(asked[n, 0] - farthest[sense]) / units[0] < 0.5 * STEP:
                continue
            farthest[sense] = asked[n, 0]
            yield n
            if turns and farthest[1] - farthest[-1] >= 2.0 * np.pi:
                return
            continue
        way = float(np.max(np.abs(asked[n] - kept) / units))
        if way >= 0.5 * STEP or n + 1 == len(asked):
            poses += 1 + int(way / STEP)
            kept = asked[n]
            yield n


def _limit(
    model: Model,
    held: tuple[int, ...],
    places: Int[np.ndarray, " prescribed"],
    last: tuple[np.ndarray, np.ndarray],
    high: np.ndarray,
) -> Float[np.ndarray, " prescribed"]:
    """Bisection between positions that close, with their pose, and some that do not."""
    low, pose = last
    for _ in range(BISECTIONS):
        middle = 0.5 * (low + high)
        closed = _closed(model, held, places, pose, middle)
        if closed is None:
            high = middle
        else:
            low, pose = middle, closed
    return low


def _time_of(
    position: Float[np.ndarray, " prescribed"],
    times: Float[np.ndarray, " times"],
    asked: Float[np.ndarray, "times prescribed"],
    last: int,
) -> float:
    """When a position is asked for, not later than at the time of an index."""
    way = asked[last] - asked[0]
    # Of all motions along their way: where they come nearest to it last.
    share = (asked[: last + 1] - position) @ way
    below = np.flatnonzero(share[:last] <= 0.0)
    before = int(below[-1]) if len(below) else 0
    if not share[before + 1] > share[before]:
        return float(times[last])
    part = share[before] / (share[before] - share[before + 1])
    return float(times[before] + part * (times[before + 1] - times[before]))


def _closed(
    model: Model, held: tuple[int, ...], places: Int[np.ndarray, " prescribed"], pose: np.ndarray, target: np.ndarray
) -> Float[np.ndarray, " numbers"] | None:
    """The pose at other prescribed positions; None if the loops do not close there."""
    guess = np.array(pose)
    guess[places] = target
    closed, residual, alignment, _ = close_at(model, guess, held)
    if np.abs(residual).max(initial=0.0) > CLOSING_TOLERANCE or (alignment < 0.0).any():
        return None
    return closed


def with_limit(run: Run, model: Model, drive: Drive) -> Run:
    """The run, or batch of runs, with the status PAST_LIMIT where it failed in motion because the loops do not let the
    drive go on. Within a traced function numbers are unknown, and such runs keep the status "diverged"."""
    if isinstance(run.status, Tracer) or not np.isin(np.asarray(run.status), FAILED_IN_MOTION).any():
        return run
    status, times = np.asarray(run.status), np.asarray(run.times)
    limit = drive_limit(model, drive, float(times.max()))
    if limit is None:
        return run
    finite = np.isfinite(np.asarray(run.energy.total))
    reached = np.where(finite, times, 0.0).max(axis=-1) + np.diff(times).max(initial=0.0)
    there = np.isin(status, FAILED_IN_MOTION) & (reached >= (1.0 - NEAR) * limit.time)
    said = np.where(there, PAST_LIMIT, status).astype(status.dtype)
    return eqx.tree_at(lambda one: one.status, run, said if isinstance(run.status, np.ndarray) else jnp.asarray(said))
