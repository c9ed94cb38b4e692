"""Statics, motion and joint loads of a linkage by Exudyn, in the conventions of rfem_jax.

    Linkage -> equilibrium (driven joint held) -> run (generalised-alpha, in pieces between the
    drive's jumps) -> Histories -> RMS loads

The start is Exudyn's own static equilibrium; a prescribed angle that moves at once starts with the
derivative of that equilibrium along the angle.  Every jump of the drive ends one integration, and
the next one starts with accelerations and multipliers computed anew.  Loads come from the
multipliers of the joints.

Units: SI, rad; times of the solver by the clock and of the CPU (this thread).
"""

import itertools
import time
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from exudyn_joints import axis_of, idle_moment, joined, loads_of, rows_of
from exudyn_models import BACK, Settings, build, exu, linkage

from rfem_jax.description.basics.joint_kinds import KINDS
from rfem_jax.description.drives.rotations import GivenDrive
from rfem_jax.mechanics.model.errors import AssemblyErrors
from rfem_jax.mechanics.model.model import Model

ANGLE_DIFFERENCE = 1e-4  # rad, for the quasi-static start velocities


class Histories(NamedTuple):
    """Motion and loads at the ends of steps; a jump of the drive's moment has two rows.

    times (T,) [s]; angle, rate (T,) of the driven motion [rad or m, and per s]; force, moment: joint ->
    (T, 3) in the hinge frame (the parent side on the child, about the hinge's centre; a given drive
    moment excluded) [N, N m]; place (T, 3): position of the tracked joint [m], else zero; angles, displacements:
    joint -> (T,) of joints with one rotation [rad], and of those with translations [m], (T, k) with k > 1.
    """

    times: np.ndarray
    angle: np.ndarray
    rate: np.ndarray
    force: dict
    moment: dict
    place: np.ndarray
    angles: dict
    displacements: dict


class Result(NamedTuple):
    """histories, rms: {"force": {joint: N}, "moment": {joint: N m}}, preload: joint -> (force,
    moment) at rest (holding moment included), seconds of the time integration alone, by the clock
    and of the CPU."""

    histories: Histories
    rms: dict
    preload: dict
    seconds: float
    cpu: float


def _silent_settings(settings: Settings):
    s = exu.SimulationSettings()
    s.solution.file.write = False
    s.parallel.numberOfThreads = 1
    s.linearSolver.solverType = exu.LinearSolverType.EigenSparse if settings.sparse else exu.LinearSolverType.EXUdense
    s.staticSolver.verboseMode = 0
    s.timeIntegration.verboseMode = 0
    return s


def _force_noise(link) -> float:
    """Force [N] that rounding of a metre makes in the stiffest element: no residual is smaller."""
    return 4e-16 * max((np.max(element[4]) for element in link.elements), default=0.0)


def poses_of(system):
    """Rotations (n, 3, 3) and centres (n, 3) of all bodies now."""

    def output(what):
        return np.array([system.mbs.GetObjectOutputBody(b, what, [0.0, 0.0, 0.0]) for b in system.bodies])

    rotations = output(exu.OutputVariableType.RotationMatrix).reshape(-1, 3, 3)
    return rotations, output(exu.OutputVariableType.Position)


def equilibrium(link, settings: Settings, turned: float = 0.0, poses=None):
    """Exudyn's static equilibrium with the driven joint held at `turned` from its start angle.

    **Returns:** poses of the bodies, and joint -> (force, moment) with the holding moment.
    """
    held = None if link.driven is None else lambda t: turned
    system = build(link, settings._replace(nodes="euler_parameters"), poses, angle=held, resting=True)
    s = _silent_settings(settings)
    s.staticSolver.newton.relativeTolerance = 1e-9
    s.staticSolver.newton.absoluteTolerance = max(1e-7, _force_noise(link))
    s.staticSolver.newton.maxIterations = 50
    s.staticSolver.adaptiveStep = False
    system.mbs.SolveStatic(s)
    holding = _holding(system, link.motion, lambda x: np.asarray(system.mbs.GetSensorValues(x))[None])
    preload = {}
    for j, joint in enumerate(link.joints):
        rows = rows_of(system.sensors[joint.name], lambda x: np.atleast_1d(system.mbs.GetSensorValues(x))[None])
        force, moment, _ = loads_of(joint, rows, -1.0)
        if j == link.driven:
            _add_holding(link, joint, -holding, force, moment)
        for _, axis, sensor in (one for one in system.idle if one[0] == joint.name):
            multiplier = -float(system.mbs.GetSensorValues(sensor)[axis])
            moment += idle_moment(joint, rows, axis, multiplier)
        preload[joint.name] = (force[0], moment[0])
    return poses_of(system), {name: preload[name] for name in link.order}


def _holding(system, motion: str, read):
    """What the constraint on the driven motion measures, (T,); zero without one."""
    return read(system.hold_sensor)[:, axis_of(motion)] if system.hold_sensor is not None else 0.0


def _add_holding(link, joint, holding, force, moment) -> None:
    """Add to loads (T, 3) in our axes the moment, or minus the force, that a constraint measures along the driven
    motion: a moment of x0 . y1 = 0 is along the axis, a force on the child against it."""
    axis = "xyz".index(link.motion[2])
    if link.motion[0] == "R":
        moment[:, axis] += holding
    else:
        force[:, axis] -= holding


class _Schedule:
    """Values of a drive at the ends of steps: Exudyn's implicit methods ask at no other time."""

    def __init__(self):
        self.start, self.step, self.values = 0.0, 1.0, [0.0]

    def set(self, start, step, values):
        self.start, self.step, self.values = start, step, [float(v) for v in values]

    def __call__(self, t):
        return self.values[int((t - self.start) / self.step + 0.5)]


def simulate(
    model: Model,
    errors: AssemblyErrors,
    drive,
    duration: float,
    step: float,
    settings: Settings = Settings(),
    window: tuple[float, float] | None = None,
    track: str | None = None,
) -> Result:
    """Static equilibrium with the driven joint held, then motion, all by Exudyn.

    **Arguments:** `drive`: a moment or a prescribed angle of the driven joint, or None; `step` [s]
    (shortened so that the drive's jumps and the end are ends of steps); `window` [s] of the RMS
    loads (None: the whole duration); `track`: name of a joint whose position is recorded.

    **Raises:** exudyn's `SolverError` where Newton's method fails.
    """
    link = linkage(model, errors)
    start = equilibrium(link, settings)
    return run(link, drive, duration, step, settings, window, start=start, track=track)


def run(link, drive, duration, step, settings=Settings(), window=None, *, start, track=None) -> Result:
    """`simulate` from a static start that is known already: (poses, preload)."""
    poses, preload = start
    schedule = _Schedule()
    velocities = None
    given_moment = isinstance(drive, GivenDrive)
    if drive is not None and not given_moment:
        rate = float(drive.motion_at(jnp.zeros(()), 0)[1])
        velocities = quasi_static_velocities(link, settings, poses, rate)
    system = build(
        link,
        settings,
        poses,
        velocities,
        angle=None if drive is None or given_moment else schedule,
        moment=schedule if given_moment else None,
        track=track,
    )
    s = _silent_settings(settings)
    t = s.timeIntegration
    t.generalizedAlpha.spectralRadius = settings.spectral_radius
    t.generalizedAlpha.computeInitialAccelerations = velocities is None
    t.newton.useModifiedNewton = settings.modified
    t.newton.modifiedNewtonJacUpdatePerStep = settings.new_jacobian
    t.newton.relativeTolerance = settings.relative
    t.newton.absoluteTolerance = max(settings.absolute, _force_noise(link))
    t.adaptiveStep = False
    jumps = [] if drive is None else [b for b in drive.breakpoints() if b < duration]
    edges = [0.0, *jumps, duration]
    seconds, cpu, parts = 0.0, 0.0, []
    for phase, (begin, end) in enumerate(itertools.pairwise(edges)):
        steps = max(1, round((end - begin) / step))
        _plan(schedule, system, drive, begin, end, steps, phase)
        t.startTime, t.endTime, t.numberOfSteps = begin, end, steps
        s.solution.sensors.writePeriod = 0.999 * (end - begin) / steps
        before, before_cpu = time.perf_counter(), time.thread_time()
        system.mbs.SolveDynamic(s, updateInitialValues=True)
        seconds += time.perf_counter() - before
        cpu += time.thread_time() - before_cpu
        parts.append(_recorded(link, system, known=velocities is None))
    histories = _joined(link, parts)
    return Result(histories, rms_loads(histories, window), preload, seconds, cpu)


def _plan(schedule, system, drive, begin, end, steps, phase):
    """The drive's values of one phase; a moment that is zero throughout costs no call."""
    if drive is None:
        return
    times = np.linspace(begin, end, steps + 1)
    if isinstance(drive, GivenDrive):
        values = np.asarray(jax.vmap(lambda x: drive.force_at(x, phase))(jnp.asarray(times)))
        if not values.any():
            for load in system.loads:
                system.mbs.SetLoadParameter(load, "loadVectorUserFunction", 0)
                system.mbs.SetLoadParameter(load, "loadVector", [0.0, 0.0, 0.0])
    else:
        values = np.asarray(jax.vmap(lambda x: drive.motion_at(x, phase)[0])(jnp.asarray(times)))
    schedule.set(begin, (end - begin) / steps, values)


def quasi_static_velocities(link, settings, poses, rate):
    """Angular velocities and velocities (n, 3) of the centres when the driven joint passes its
    start through equilibria: central difference of two static solutions."""
    d = ANGLE_DIFFERENCE
    (r1, p1), _ = equilibrium(link, settings, d, poses)
    (r0, p0), _ = equilibrium(link, settings, -d, poses)
    spin = np.einsum("nij,nkj->nik", (r1 - r0) / (2.0 * d), poses[0])
    angular = np.stack([spin[:, 2, 1], spin[:, 0, 2], spin[:, 1, 0]], axis=1)
    return rate * angular, rate * (p1 - p0) / (2.0 * d)


def _recorded(link, system, known: bool):
    """Times and columns of one phase. known: whether its first row has multipliers; where accelerations are not
    computed at the start it has none, and gets those of the first step."""

    def rows(sensor):
        return np.array(system.mbs.GetSensorStoredData(sensor))

    loads = {name: rows_of(sensors, lambda x: rows(x)[:, 1:]) for name, sensors in system.sensors.items()}
    times = rows(next(iter(system.sensors.values())).force)[:, 0]
    axis = axis_of(link.motion)
    rate = rows(system.rate_sensor)[:, 1 + axis] if system.rate_sensor is not None else 0.0 * times
    held = rows(system.hold_sensor)[:, 1 + axis] if system.hold_sensor is not None else 0.0 * times
    no_place = np.zeros((len(times), 3))
    place = no_place if system.place_sensor is None else rows(system.place_sensor)[:, 1:]
    if not known:
        for values in (held, *(part for one in loads.values() for part in (one.force, one.couples))):
            values[0] = values[1]
    return times, loads, rate, held, place[:, BACK]


def _joined(link, parts) -> Histories:
    times, rate, held, place = (np.concatenate([p[k] for p in parts]) for k in (0, 2, 3, 4))
    force, moment, angles, displacements, driven = {}, {}, {}, {}, 0.0 * times
    for j, joint in enumerate(link.joints):
        rows = joined([part[1][joint.name] for part in parts])
        force[joint.name], moment[joint.name], turned = loads_of(joint, rows)
        kind = KINDS[joint.kind]
        if kind.angles == 1:
            angles[joint.name] = np.unwrap(turned)
        axes = [axis_of(motion) for motion in kind.motions if motion[0] == "T"]
        if axes and rows.shift is not None:
            displacements[joint.name] = rows.shift[:, axes if len(axes) > 1 else axes[0]]
        if j != link.driven:
            continue
        _add_holding(link, joint, held, force[joint.name], moment[joint.name])
        if link.motion[0] == "R":
            turned = np.unwrap(turned)
            driven = turned + 2.0 * np.pi * np.round((link.start - turned[0]) / (2.0 * np.pi))
        else:
            driven = rows.shift[:, axis_of(link.motion)]
    return Histories(
        times,
        driven,
        rate,
        {n: force[n] for n in link.order},
        {n: moment[n] for n in link.order},
        place,
        angles,
        displacements,
    )


def rms_loads(histories: Histories, window: tuple[float, float] | None = None) -> dict:
    """RMS resultants over the window, trapezoidal rule: {"force": {joint}, "moment": {joint}}."""
    t = histories.times
    low, high = (t[0], t[-1]) if window is None else window
    inside = (t >= low - 1e-9) & (t <= high + 1e-9)

    def root(vectors):
        square = np.sum(vectors[inside] ** 2, axis=1)
        return float(np.sqrt(np.trapezoid(square, t[inside]) / (high - low)))

    return {
        "force": {name: root(v) for name, v in histories.force.items()},
        "moment": {name: root(v) for name, v in histories.moment.items()},
    }
