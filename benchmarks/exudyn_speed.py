"""How fast Exudyn is at a wanted accuracy: its best settings and step for a case of the main study.

    fastest("P5", 1e-3) -> (step, seconds, error)

The peer gets its best: the module without range checks, one thread, nothing written to files, loads
stored in memory, no Python call while the drive's moment is zero, and the fastest of all
combinations of node type, Newton settings, spectral radius and step.  Error: the largest relative
deviation of the RMS force and moment of all joints from Exudyn's own converged result.  A step
counts only if the next smaller one of the same settings is as accurate: no lucky hits.
"""

import functools
import itertools
import statistics
from pathlib import Path
from typing import NamedTuple

import numpy as np
from exudyn_engine import PLANAR, drive_pieces, exu, exudyn_numbers

from rfem_jax import assembly_errors, discretise, load_study
from rfem_jax.exchange.exudyn_program import Settings, equilibrium, move

STUDY = Path(__file__).parents[1] / "studies" / "four_bar" / "study.toml"
SMALLEST_LOAD = 1e-6  # N, N m: smaller RMS loads are zero and have no relative error


class Search(NamedTuple):
    """What is simulated and searched: duration [s]; steps [s]; the two steps of the converged result [s]; finest
    accuracy that is searched; timed runs; node types; tolerances of Newton's method; spectral radii."""

    duration: float
    steps: tuple[float, ...]
    converged: tuple[float, float]
    finest: float
    timed: int
    nodes: tuple[str, ...]
    tolerances: tuple[float, ...]
    radii: tuple[float, ...]


FULL = Search(
    duration=0.5,
    steps=(1e-2, 6.25e-3, 5e-3, 4e-3, 3.125e-3, 2.5e-3, 2e-3, 1.25e-3, 1e-3, 5e-4, 2.5e-4),
    converged=(5e-5, 2.5e-5),
    finest=1e-4,
    timed=5,
    nodes=("angles", "euler_parameters"),
    tolerances=(1e-4, 1e-5),
    radii=(0.6, 0.7),
)
# A few steps: that everything works, not how fast.
TRIAL = FULL._replace(
    duration=0.02,
    steps=(2e-3, 1e-3),
    converged=(5e-4, 2.5e-4),
    finest=0.2,
    timed=1,
    nodes=("angles",),
    tolerances=(1e-5,),
)


class Best(NamedTuple):
    """The fastest way found: step [s], median seconds of the time integration by the clock and of
    the CPU, error (relative), spread (smallest, largest seconds), settings."""

    step: float
    seconds: float
    error: float
    cpu: float
    spread: tuple[float, float]
    settings: Settings


@functools.cache
def main_study():
    """The study and its discretised model."""
    study = load_study(STUDY)
    return study, discretise(study.mechanism)


@functools.cache
def prepared(case: str):
    """Numbers and static start of a case of the main study."""
    study, model = main_study()
    errors = {c.name: c.errors for c in study.cases}[case]
    mechanism = exudyn_numbers(model, assembly_errors(model, errors))
    return mechanism, equilibrium(mechanism)


@functools.cache
def driven(duration: float) -> dict:
    """The drive of the main study."""
    return drive_pieces(main_study()[0].drive, duration)


def solve(case: str, step: float, settings: Settings = PLANAR, search: Search = FULL):
    """A run of a case of the main study, or None where Exudyn's solver fails."""
    mechanism, (start, _) = prepared(case)
    try:
        return move(mechanism | driven(search.duration), step, settings, start)
    except exu.SolverError:
        return None


@functools.cache
def converged_runs(case: str, search: Search = FULL):
    """Runs at the two smallest steps."""
    return tuple(solve(case, step, search=search) for step in search.converged)


def extrapolated(coarse, fine, search: Search = FULL):
    """The limit of second order of values at the two smallest steps."""
    gain = (search.converged[0] / search.converged[1]) ** 2 - 1.0
    return fine + (fine - coarse) / gain


@functools.cache
def converged(case: str, search: Search = FULL) -> dict:
    """RMS loads extrapolated from the two smallest steps."""
    coarse, fine = (result.rms for result in converged_runs(case, search))
    return {
        kind: {joint: extrapolated(coarse[kind][joint], fine[kind][joint], search) for joint in fine[kind]}
        for kind in fine
    }


def converged_at(case: str, times, search: Search = FULL) -> dict:
    """Motion and loads at times [s] that are ends of steps, extrapolated likewise: "angle", "rate"
    (T,), "force" and "moment" (joint -> (T, 3)); at a jump of the drive the values before it."""
    rows = []
    for step, result in zip(search.converged, converged_runs(case, search)):
        h = result.histories
        at = np.searchsorted(h.times, np.asarray(times) - 0.1 * step)
        rows.append((h, at))
    (a, i), (b, k) = rows
    return {
        "angle": extrapolated(a.angle[i], b.angle[k], search),
        "rate": extrapolated(a.rate[i], b.rate[k], search),
        "force": {j: extrapolated(a.force[j][i], b.force[j][k], search) for j in a.force},
        "moment": {j: extrapolated(a.moment[j][i], b.moment[j][k], search) for j in a.moment},
    }


def error_of(rms: dict, reference: dict) -> float:
    """Largest relative deviation of RMS loads that are not zero."""
    return max(
        abs(rms[kind][joint] / value - 1.0)
        for kind in reference
        for joint, value in reference[kind].items()
        if value > SMALLEST_LOAD
    )


def variants(search: Search = FULL):
    """The settings that are tried."""
    for nodes, fresh, relative, radius in itertools.product(
        search.nodes, (True, False), search.tolerances, search.radii
    ):
        yield Settings(
            spectral_radius=radius,
            nodes=nodes,
            new_jacobian=fresh,
            relative=relative,
            intrinsic=False,
        )


@functools.cache
def survey(case: str, search: Search = FULL) -> tuple:
    """(settings, step, error, CPU seconds) of all settings, one run each, from long steps to short
    ones until two in a row reach the finest accuracy."""
    rows = []
    for settings in variants(search):
        before = np.inf
        for step in search.steps:
            result = solve(case, step, settings, search)
            failed = result is None or not np.isfinite(result.histories.angle[-1])
            error = np.inf if failed else error_of(result.rms, converged(case, search))
            rows.append((settings, step, error, np.inf if failed else result.cpu))
            if max(before, error) <= search.finest:
                break
            before = error
    return tuple(rows)


@functools.cache
def best(case: str, accuracy: float, search: Search = FULL) -> Best:
    """The fastest settings and step (CPU time, which other programs disturb least) whose RMS loads are within
    `accuracy` of the converged ones; of a trial within the finest accuracy that it searches, if that is larger."""
    rows = survey(case, search)
    accuracy = max(accuracy, search.finest) if search == TRIAL else accuracy
    good = [
        row
        for row, finer in itertools.pairwise(rows)
        if row[2] <= accuracy and finer[0] == row[0] and finer[2] <= accuracy
    ]
    if not good:
        raise ValueError(
            f"Argument `accuracy` must be at least {search.finest:g}, the finest that is searched, but is {accuracy:g}."
        )
    timed = []
    for settings, step, error, _ in sorted(good, key=lambda row: row[3])[:4]:
        runs = [solve(case, step, settings, search) for _ in range(search.timed)]
        clock = [r.seconds for r in runs]
        timed.append(
            Best(
                step=step,
                seconds=statistics.median(clock),
                error=error,
                cpu=statistics.median(r.cpu for r in runs),
                spread=(min(clock), max(clock)),
                settings=settings,
            )
        )
    return min(timed, key=lambda found: found.cpu)


def fastest(case: str, accuracy: float, clock: str = "cpu") -> tuple[float, float, float]:
    """Exudyn's fastest run of a case of the main study: (step [s], seconds, error).

    **Arguments:** `case`: "P1" ... "P5"; `accuracy`: wanted relative accuracy of all RMS loads;
    `clock`: "cpu" (the solver's one thread; equals the clock's time on an idle machine) or "wall".

    **Returns:** step, median seconds of the time integration alone, error reached; searched once a
    process.
    """
    if clock not in ("cpu", "wall"):
        raise ValueError(f'Argument `clock` must be "cpu" or "wall", but is {clock!r}.')
    found = best(case, accuracy)
    return found.step, found.cpu if clock == "cpu" else found.seconds, found.error
