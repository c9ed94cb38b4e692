"""What scripts for Exudyn do: find the equilibrium of a mechanism, move it, tell the loads.

Place in the pipeline: third part of the program of scripts for Exudyn: exudyn_system, exudyn_loads ->
**exudyn_program**; in a script MECHANISM is its numbers.
"""

# pyright: reportMissingImports=false
import argparse
import csv
import time
import warnings
from typing import NamedTuple

import exudyn as exu
import numpy as np

from rfem_jax.exchange.exudyn_loads import BACK, add_holding, idle_moment, loads_of, rms_loads
from rfem_jax.exchange.exudyn_system import DEFAULT, NODES, Output, Settings, Start, build, start_of

MECHANISM: dict = globals().get("MECHANISM", {})
STEPS = 2000  # of the whole duration, where no step is given
ANGLE_DIFFERENCE = 1e-4  # rad, m: for velocities of a motion through equilibria


class Histories(NamedTuple):
    """Motion and loads at the ends of steps; a jump of the drive has two rows.

    times (T,) [s]; angle, rate (T,) of the driven motion [rad or m, and per s]; force, moment: joint -> (T, 3) in the
    hinge frame (the parent side on the child, about the hinge's centre; a given drive excluded) [N, N m]; places: point
    or joint -> (T, 3) in global axes [m]; angles, displacements: joint -> (T,) of joints with one rotation [rad], and
    of those with translations [m], (T, k) with k > 1.
    """

    times: np.ndarray
    angle: np.ndarray
    rate: np.ndarray
    force: dict[str, np.ndarray]
    moment: dict[str, np.ndarray]
    places: dict[str, np.ndarray]
    angles: dict[str, np.ndarray]
    displacements: dict[str, np.ndarray]


class Result(NamedTuple):
    """histories; rms: {"force": {joint: N}, "moment": {joint: N m}}; seconds of the time integration alone, by the
    clock and of the processor."""

    histories: Histories
    rms: dict[str, dict[str, float]]
    seconds: float
    cpu: float


def _silent_settings(settings):
    s = exu.SimulationSettings()
    s.solution.file.write = False
    s.parallel.numberOfThreads = 1
    s.linearSolver.solverType = exu.LinearSolverType.EigenSparse if settings.sparse else exu.LinearSolverType.EXUdense
    s.staticSolver.verboseMode = 0
    s.timeIntegration.verboseMode = 0
    return s


def _force_noise(mechanism) -> float:
    """Force [N] that rounding of a metre makes in the stiffest element: no residual is smaller."""
    return 4e-16 * max((max(one["stiffness"]) for one in mechanism["elements"]), default=0.0)


def equilibrium(mechanism, settings=DEFAULT, start=None, turned=0.0):
    """Exudyn's static equilibrium with the driven motion held at `turned` [rad, m] from its start.

    **Returns:** a `Start` at rest, and joint -> (force, moment) with what holds the driven motion.
    """
    start = start_of(mechanism) if start is None else start
    hold = None if mechanism["driven"] is None else lambda t: turned
    system = build(
        mechanism, settings._replace(nodes="euler_parameters"), start.resting, hold, resting=True
    )  # fmt: skip
    s = _silent_settings(settings)
    s.staticSolver.newton.relativeTolerance = 1e-9
    s.staticSolver.newton.absoluteTolerance = max(1e-7, _force_noise(mechanism))
    s.staticSolver.newton.maxIterations = 50
    s.staticSolver.adaptiveStep = False
    system.mbs.SolveStatic(s)

    def read(sensor):
        return np.atleast_1d(system.mbs.GetSensorValues(sensor))[None]

    preload = {}
    for one in mechanism["joints"]:
        rows = {name: read(sensor) for name, sensor in system.sensors[one["name"]].items()}
        # The static solver's multipliers have the opposite sign of the dynamic one's.
        force, moment, _ = loads_of(one, rows, -1.0)
        if system.hold is not None and one["name"] == mechanism["driven"]["joint"]:
            add_holding(mechanism["driven"], -read(system.hold), force, moment)
        for _, axis, sensor in (turn for turn in system.idle if turn[0] == one["name"]):
            moment += idle_moment(one, rows, axis, -read(sensor)[0, axis])
        preload[one["name"]] = (force[0], moment[0])
    return _start_now(system), {name: preload[name] for name in mechanism["order"]}


def _start_now(system) -> Start:
    def output(what):
        return np.array([system.mbs.GetObjectOutputBody(body, what, [0.0, 0.0, 0.0]) for body in system.bodies])

    still = np.zeros((len(system.bodies), 3))
    return Start(output(Output.RotationMatrix).reshape(-1, 3, 3), output(Output.Position), still, still)


def passing(mechanism, settings, start) -> Start:
    """A static start with the velocities of a motion through equilibria at the drive's first rate: central difference
    of two static solutions."""
    d, rate = ANGLE_DIFFERENCE, mechanism["pieces"][0]["values"][0][1]
    (after, _), (before, _) = (equilibrium(mechanism, settings, start, turned) for turned in (d, -d))
    spin = np.einsum("nij,nkj->nik", (after.rotation - before.rotation) / (2.0 * d), start.rotation)
    angular = np.stack([spin[:, 2, 1], spin[:, 0, 2], spin[:, 1, 0]], axis=1)
    return start._replace(angular=rate * angular, velocity=rate * (after.centre - before.centre) / (2.0 * d))


class _Schedule:
    """Values of a drive at the ends of steps: Exudyn's implicit methods ask at no other time."""

    def __init__(self):
        self.start, self.step, self.values = 0.0, 1.0, [0.0]

    def set(self, start, step, values):
        self.start, self.step, self.values = start, step, [float(v) for v in values]

    def __call__(self, t):
        return self.values[int((t - self.start) / self.step + 0.5)]


def drive_values(piece, times):
    """Values (T,) of a drive at times within a piece, of fifth degree between its rows of (value, first, second
    derivative)."""
    rows = np.array(piece["values"], float)
    h = (piece["end"] - piece["begin"]) / (len(rows) - 1)
    place = (np.asarray(times) - piece["begin"]) / h
    i = np.clip(np.floor(place + 1e-9).astype(int), 0, len(rows) - 2)
    s, scaled = place - i, rows * [1.0, h, h * h]
    (p, v, a), (q, w, b) = scaled[i].T, scaled[i + 1].T
    d, v_d, a_d = q - p - v - 0.5 * a, w - v - a, b - a
    return p + s * (v + s * (0.5 * a + s * (
        10.0 * d - 4.0 * v_d + 0.5 * a_d + s * (-15.0 * d + 7.0 * v_d - a_d + s * (6.0 * d - 3.0 * v_d + 0.5 * a_d))
    )))  # fmt: skip


def move(mechanism, step=None, settings=DEFAULT, start=None, track=(), window=None) -> Result:
    """The motion from an equilibrium at rest, which a prescribed motion passes, or from the mechanism's start (None).

    **Arguments:** `step` [s], shortened so that the drive's jumps and the end are ends of steps (None: `STEPS` in
    all); `track`: points and joints whose places are recorded; `window` [s] of the RMS loads (None: all).

    **Raises:** exudyn's `SolverError` where Newton's method fails.
    """
    schedule, prescribed, pieces = _Schedule(), mechanism["drive"] == "motion", mechanism["pieces"]
    start = passing(mechanism, settings, start) if prescribed and start is not None else start
    hold, push = (schedule if mechanism["drive"] == kind else None for kind in ("motion", "force"))
    system = build(mechanism, settings, start, hold, push, track)
    step = pieces[-1]["end"] / STEPS if step is None else step
    s = _silent_settings(settings)
    t = s.timeIntegration
    t.generalizedAlpha.spectralRadius = settings.spectral_radius
    t.generalizedAlpha.computeInitialAccelerations = True
    t.newton.useModifiedNewton = settings.modified
    t.newton.modifiedNewtonJacUpdatePerStep = settings.new_jacobian
    t.newton.relativeTolerance = settings.relative
    t.newton.absoluteTolerance = max(settings.absolute, _force_noise(mechanism))
    t.adaptiveStep = False
    seconds, cpu, parts = 0.0, 0.0, []
    for piece in pieces:
        begin, end = piece["begin"], piece["end"]
        steps = max(1, round((end - begin) / step))
        values = drive_values(piece, np.linspace(begin, end, steps + 1)) if mechanism["drive"] else np.zeros(steps + 1)
        schedule.set(begin, (end - begin) / steps, values)
        for load in system.loads if not values.any() else ():  # zero throughout: no call
            system.mbs.SetLoadParameter(load, "loadVectorUserFunction", 0)
            system.mbs.SetLoadParameter(load, "loadVector", [0.0, 0.0, 0.0])
        t.startTime, t.endTime, t.numberOfSteps = begin, end, steps
        s.solution.sensors.writePeriod = 0.999 * (end - begin) / steps
        before, before_cpu = time.perf_counter(), time.thread_time()
        system.mbs.SolveDynamic(s, updateInitialValues=True)
        seconds += time.perf_counter() - before
        cpu += time.thread_time() - before_cpu
        # Accelerations at the start are those of a motion whose own is zero then.
        parts.append(_recorded(system, known=not prescribed or piece["values"][0][2] == 0.0))
    histories = _histories(mechanism, parts)
    return Result(histories, rms_loads(histories, window), seconds, cpu)


def _recorded(system, known):
    """{(joint or None, what): rows} of one piece. known: whether the multipliers of its first row are right; if not it
    gets those of the first step."""

    def rows(sensor):
        return np.array(system.mbs.GetSensorStoredData(sensor))

    found = {(name, what): rows(one)[:, 1:] for name, of in system.sensors.items() for what, one in of.items()}
    first = next(iter(system.sensors.values()))["force"]
    found[None, "times"] = rows(first)[:, 0]
    named = {"hold": system.hold, "rate": system.rate, **{f"place {name}": one for name, one in system.places.items()}}
    found |= {(None, what): rows(one)[:, 1:] for what, one in named.items() if one is not None}
    if not known:
        for (_, what), values in found.items():
            if what in ("force", "couples", "hold"):
                values[0] = values[1]
    return found


def _histories(mechanism, parts) -> Histories:
    rows = {key: np.concatenate([part[key] for part in parts]) for key in parts[0]}
    times, driven = rows[None, "times"], mechanism["driven"]
    force, moment, angles, displacements, angle = {}, {}, {}, {}, 0.0 * times
    for one in mechanism["joints"]:
        name = one["name"]
        own = {what: values for (joint, what), values in rows.items() if joint == name}
        force[name], moment[name], turned = loads_of(one, own)
        if one["turns"] == 1:
            angles[name] = np.unwrap(turned)
        if one["shifts"] and "shift" in own:
            displacements[name] = own["shift"][:, one["shifts"] if len(one["shifts"]) > 1 else one["shifts"][0]]
        if driven is None or name != driven["joint"]:
            continue
        if (None, "hold") in rows:
            add_holding(driven, rows[None, "hold"], force[name], moment[name])
        if driven["rotation"]:
            turned = np.unwrap(turned)
            angle = turned + 2.0 * np.pi * np.round((driven["start"] - turned[0]) / (2.0 * np.pi))
        else:
            angle = own["shift"][:, driven["axis"]]
    rate = rows[None, "rate"][:, driven["axis"]] if driven and (None, "rate") in rows else 0.0 * times
    places = {what[6:]: values[:, BACK] for (_, what), values in rows.items() if what.startswith("place ")}
    force, moment = ({name: values[name] for name in mechanism["order"]} for values in (force, moment))
    return Histories(times, angle, rate, force, moment, places, angles, displacements)


def table_of(histories):
    """Column names with units, and rows: time, driven motion, places, and loads of all joints in hinge frames."""
    columns = {"time_s": histories.times, "driven": histories.angle, "driven_rate": histories.rate}
    for name, values in histories.places.items():
        columns |= {f"{name}_{axis}_m": values[:, k] for k, axis in enumerate("xyz")}
    for kind, unit in (("force", "N"), ("moment", "Nm")):
        for name, values in getattr(histories, kind).items():
            columns |= {f"{name}_{kind}_{axis}_{unit}": values[:, k] for k, axis in enumerate("xyz")}
    return list(columns), np.stack(list(columns.values()), axis=1)


def main(arguments=None):
    """Move the mechanism and print the RMS loads."""
    parser = argparse.ArgumentParser(description="Move the mechanism by Exudyn and print the RMS loads of its joints.")
    parser.add_argument("--step", type=float, help=f"s (default: {STEPS} steps in all)")
    parser.add_argument("--statics", action="store_true", help="start in the equilibrium that Exudyn finds")
    parser.add_argument("--nodes", choices=tuple(NODES), default=DEFAULT.nodes, help="what describes rotations")
    parser.add_argument("--radius", type=float, default=DEFAULT.spectral_radius, help="spectral radius")
    parser.add_argument("--newton", choices=("modified", "fresh", "full"), default="modified",
                        help="Jacobians: when it converges slowly, in every step, in every iteration")  # fmt: skip
    parser.add_argument("--tolerance", type=float, default=DEFAULT.relative, help="of Newton's method, relative")
    parser.add_argument("--dense", action="store_true", help="dense matrices")
    parser.add_argument("--tait-bryan", action="store_true", help="Exudyn's default form of connectors")
    parser.add_argument("--track", nargs="+", metavar="NAME", choices=tuple(MECHANISM["places"]), default=(),
                        help="points and joints whose places are recorded, too: %(choices)s")  # fmt: skip
    parser.add_argument("--csv", metavar="FILE", help="write places and loads at the ends of all steps")
    given = parser.parse_args(arguments)
    if given.step is not None and not given.step > 0.0:
        parser.error(f"argument --step must be greater than 0, but is {given.step:g}")
    warnings.filterwarnings("ignore", category=DeprecationWarning)  # of names that later versions have otherwise
    settings = Settings(given.radius, given.nodes, given.newton != "full", given.newton == "fresh", not given.dense,
                        given.tolerance, intrinsic=not given.tait_bryan)  # fmt: skip
    start = None
    if given.statics:
        if MECHANISM["no_statics"]:
            parser.error(MECHANISM["no_statics"])
        start, _ = equilibrium(MECHANISM, settings)
    result = move(MECHANISM, given.step, settings, start, tuple(dict.fromkeys((*MECHANISM["tracked"], *given.track))))
    force, moment = result.rms["force"], result.rms["moment"]
    width = max(12, *(len(name) for name in force))
    print(f"{'joint':{width}}{'RMS force, N':>18}{'RMS moment, N m':>18}")
    for name, value in force.items():
        print(f"{name:{width}}{value:18.9g}{moment[name]:18.9g}")
    if given.csv:
        names, rows = table_of(result.histories)
        with open(given.csv, "w", encoding="utf-8", newline="") as file:
            writer = csv.writer(file)
            writer.writerow(names)
            writer.writerows(rows.tolist())


if __name__ == "__main__":
    main()
