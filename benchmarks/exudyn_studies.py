"""Studies with joints of all kinds, springs, friction and forces: Exudyn against ours, accuracy and time.

Accuracy: positions of the joints, forces and moments of all joints in hinge frames, ours with geometrically exact
elements and converged, against Exudyn's at two steps.  The first fifth of the duration is left out: where a motion
starts at once, both need that time to forget how.

Time, with the elements of the study: the longest step with which RMS loads over the whole duration, by each one's own
converged result, are within an accuracy (and those with the next shorter step), at it the median processor time of one
run on one thread; of Exudyn the fastest settings of `variants`.  Ours is the whole run with its static start, Exudyn's
the solver alone.
"""

import itertools
import statistics
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from exudyn_cases import Case, other_kinds, studies
from exudyn_engine import drive_pieces, exu, exudyn_numbers
from exudyn_speed import FULL, variants
from speed_timing import run_once

from rfem_jax import STATUS, GeneralisedAlpha, Simulation, assemble, assembly_errors, discretise, simulate
from rfem_jax.exchange.exudyn_program import Settings, equilibrium, move
from rfem_jax.exchange.exudyn_program import rms_loads as rms_loads_of
from rfem_jax.mechanics.model.errors import AssemblyErrors
from rfem_jax.simulation.accuracy import loads_of_trials
from rfem_jax.simulation.solvers.generalised_alpha import ACCURACY_OF_TOLERANCE
from rfem_jax.simulation.stages.integration import grid_for, prepare_batch
from rfem_jax.simulation.stages.stepping import Integration

SETTLED = 0.2  # share of the duration that is left out
ACCURACY = 1e-3  # of RMS loads, for times
BATCH = 16
SEARCHED = 0.4  # of the saved intervals, in which steps are searched
COUNTS = (1, 2, 3, 4, 5, 6, 8, 10, 12, 16, 20, 25, 32, 40, 50, 64)  # steps of an interval
SPHERICAL = Settings()  # links turn about any axis


def compare_studies(report, quick: bool, trial: bool = False) -> None:
    """Tables of accuracy and of time; of a trial a short piece of one study, with two rfes."""
    cases = studies() + ([] if quick else other_kinds())
    if trial:
        case = cases[1]
        links = [replace(link, rfes=min(link.rfes, 2)) for link in case.mechanism.links]
        shorter = replace(case.mechanism, links=links)
        cases = [case._replace(mechanism=shorter, duration=0.1 * case.duration, steps=(20, 40), limits=(1e-6, 1e-2))]
    rows = [compare(report, case) for case in cases]
    report.table(
        f"Joints of several kinds: largest differences from {SETTLED:g} of the duration on, ours exact - Exudyn",
        ["mechanism", "positions, rad or m", "preload, relative", "force", "moment", "RMS loads"],
        rows,
    )
    timed = [time_study(case, trial) for case in (cases if trial else studies())]
    report.table(
        f"Time of the studies, RMS loads within {ACCURACY:g}: Exudyn {exu.config.Version()} and ours, processor time "
        "of one thread, ms a sample",
        ["study", "Exudyn's step ms", "CPU ms", "our step ms", "CPU ms alone", "in a batch", "ratio alone",
         "ratio in a batch"],
        timed,
    )  # fmt: skip


def compare(report, case: Case) -> list:
    """A row of differences of one mechanism, and the checks."""
    model = discretise(case.mechanism, elements="geometrically_exact")
    errors = assembly_errors(model, case.errors)
    every = case.duration / case.saved
    method = GeneralisedAlpha(step=every / case.steps[0])
    ours = simulate(
        Simulation(model, drive=case.drive, duration=case.duration, method=method, save_every=every), errors
    )
    mechanism = exudyn_numbers(model, errors) | drive_pieces(case.drive, case.duration)
    start, their_preload = equilibrium(mechanism)
    steps = (every / n for n in (case.steps[1] // 2, case.steps[1]))
    runs = [move(mechanism, step, SPHERICAL, start) for step in steps]
    later = np.asarray(ours.times) >= SETTLED * case.duration
    report.check(f"{case.title}: status of ours ({STATUS[int(ours.status)].name})", float(ours.status), 0.0)
    preload = _preload(assemble(model, errors).preload, their_preload)
    histories = [result.histories for result in runs]
    place = _positions(ours, histories, later)
    force, moment = (_loads(ours, histories, later, kind) for kind in ("force", "moment"))
    windows = [_rms_difference(ours, one, case.duration) for one in histories]
    report.check(f"{case.title}: positions (rad, m)", place, case.limits[0])
    report.check(f"{case.title}: preload over the largest", preload, 1e-5)
    report.check(f"{case.title}: forces over the largest", force, case.limits[1])
    report.check(f"{case.title}: moments over the largest", moment, case.limits[1])
    return [case.title, *(float(f"{x:.1e}") for x in (place, preload, force, moment, windows[-1]))]


def _preload(ours, theirs) -> float:
    away = []
    for kind in (0, 1):
        largest = max(np.linalg.norm(load[kind]) for load in theirs.values())
        away += [float(np.linalg.norm(np.asarray(ours[j][kind]) - theirs[j][kind]) / largest) for j in theirs]
    return max(away)


def _at(histories, times):
    """Rows of saved times; a saved time at a jump of the drive is the end of the piece before."""
    return np.searchsorted(histories.times, np.asarray(times) - 0.1 * (histories.times[1] - histories.times[0]))


def _extrapolated(histories, ours, pick):
    coarse, fine = (pick(one)[_at(one, ours.times)] for one in histories)
    return fine + (fine - coarse) / 3.0


def _positions(ours, histories, later) -> float:
    away = [0.0]
    for kind, mine in (("angles", ours.motion.angles), ("displacements", ours.motion.displacements)):
        for name in getattr(histories[0], kind).keys() & mine.keys():
            theirs = _extrapolated(histories, ours, lambda one, kind=kind, name=name: getattr(one, kind)[name])
            difference = theirs - np.asarray(mine[name])
            if kind == "angles":
                difference -= 2.0 * np.pi * np.round(difference / (2.0 * np.pi))
            away.append(float(np.abs(difference[later]).max()))
    return max(away)


def _loads(ours, histories, later, kind: str) -> float:
    names = list(histories[0].force)
    theirs = {j: _extrapolated(histories, ours, lambda one, j=j: getattr(one, kind)[j])[later] for j in names}
    largest = max(np.linalg.norm(vectors, axis=1).max() for vectors in theirs.values())
    away = [np.linalg.norm(theirs[j] - np.asarray(getattr(ours.loads[j], kind))[later], axis=1).max() for j in names]
    return float(max(away) / largest)


def _rms_difference(ours, histories, duration: float) -> float:
    """Largest difference of RMS loads after the start, over the largest of their kind."""
    window, away = (SETTLED * duration, duration), []
    theirs, mine = rms_loads_of(histories, window), ours.window(*window)
    for kind, values in theirs.items():
        found = getattr(mine, f"rms_{kind}")
        away += [abs(float(found[name]) - value) / max(values.values()) for name, value in values.items()]
    return max(away)


def time_study(case: Case, trial: bool) -> list:
    """A row of the table of times."""
    model = discretise(case.mechanism)
    errors = assembly_errors(model, case.errors)
    peer = time_exudyn(model, errors, case, trial)
    ours = time_ours(model, errors, case, 1 if trial else BATCH, trial)
    if peer is None or ours is None:
        return [case.title, *[None] * 7]
    times = [1e3 * x for x in (*peer, *ours)]
    ratios = [peer[1] / seconds for seconds in ours[1:]]
    return [case.title, *(float(f"{x:.3g}") for x in times), *(float(f"{x:.2g}") for x in ratios)]


def _longest(found: list[tuple]):
    """Of (step, error, ...) from long steps to short ones the first that is within the accuracy as the next one is."""
    good = [one for one, finer in itertools.pairwise(found) if max(one[1], finer[1]) <= ACCURACY]
    return good[0] if good else None


def _enough(rows: list[tuple]) -> bool:
    return len(rows) > 1 and max(rows[-1][1], rows[-2][1]) <= ACCURACY


def error_of(rms: dict, reference: dict) -> float:
    """Largest relative deviation of RMS loads, of those that are a thousandth of the largest of their kind at least:
    moments in ball joints are zero but for rounding."""
    away = []
    for kind, values in reference.items():
        loaded = [joint for joint, value in values.items() if value > 1e-3 * max(values.values())]
        away += [abs(rms[kind][joint] / values[joint] - 1.0) for joint in loaded]
    return max(away)


def time_ours(model, errors: AssemblyErrors, case: Case, samples: int, trial: bool):
    """Step [s], and seconds of processor time of a sample alone and in a batch: generalised-alpha, tolerance and
    largest residual by the accuracy as "auto" has them; the errors are scaled sample by sample in the batch."""
    interval, found = case.duration / round(SEARCHED * case.saved), []
    method = GeneralisedAlpha(step=interval, tolerance=ACCURACY / ACCURACY_OF_TOLERANCE)
    grid, _ = grid_for(case.drive, case.duration, method, interval, model)

    def loads(count, samples=1):
        scales = jnp.linspace(1.0, 0.2, samples)
        batch = jax.tree.map(lambda x: scales.reshape(-1, *[1] * x.ndim) * x[None], errors)
        whole = Integration(model, case.drive, grid, method, jnp.asarray(count, jnp.float64))
        return loads_of_trials(whole, *prepare_batch(whole, batch))

    coarse, fine = (np.asarray(loads(n)[0][0]) for n in ((20, 40) if trial else (200, 400)))
    reference = _table(model, fine + (fine - coarse) / 3.0)
    for count in COUNTS:
        result, residual, *_ = loads(count)
        error = max(error_of(_table(model, np.asarray(result[0])), reference), float(residual[0]))
        found.append((interval / count, error, count))
        if _enough(found):
            break
    best = _longest(found)
    if best is None:
        return None
    seconds = []
    for n in (1, samples):
        loads(best[2], n)
        runs = [run_once(loads, best[2], n)[2] for _ in range(1 if trial else 5)]
        seconds.append(statistics.median(runs) / n)
    return best[0], *seconds


def _table(model, loads) -> dict:
    """RMS loads (2, joints) as Exudyn's are kept."""
    rows = dict(zip(("force", "moment"), loads, strict=True))
    return {kind: dict(zip(model.joint_names, map(float, row), strict=True)) for kind, row in rows.items()}


def time_exudyn(model, errors: AssemblyErrors, case: Case, trial: bool):
    """Step [s] and seconds of processor time of the fastest settings, medians, or None."""
    mechanism = exudyn_numbers(model, errors) | drive_pieces(case.drive, case.duration)
    start, _ = equilibrium(mechanism)

    def solved(step: float, settings: Settings):
        try:
            return move(mechanism, step, settings, start)
        except exu.SolverError:
            return None

    interval = case.duration / round(SEARCHED * case.saved)
    coarse, fine = (solved(interval / n, SPHERICAL).rms for n in ((20, 40) if trial else (400, 800)))
    reference = {k: {j: fine[k][j] + (fine[k][j] - coarse[k][j]) / 3.0 for j in fine[k]} for k in fine}
    candidates = []
    for settings in [SPHERICAL] if trial else variants(FULL):
        found = []
        for count in COUNTS:
            result = solved(interval / count, settings)
            good = result is not None and np.isfinite(result.histories.angle[-1])
            error = error_of(result.rms, reference) if good else np.inf
            found.append((interval / count, error, result.cpu if good else np.inf))
            if _enough(found):
                break
        best = _longest(found)
        if best is not None:
            candidates.append((best[2], best[0], settings))
    timed = []
    for _, step, settings in sorted(candidates, key=lambda one: one[0])[:3]:
        runs = [solved(step, settings).cpu for _ in range(1 if trial else 5)]
        timed.append((step, statistics.median(runs)))
    return min(timed, key=lambda one: one[1], default=None)
