"""Joints with clearance against an own code and Exudyn in the same run: first impacts, and statistics after chaos.

    python benchmarks/clearance_peers.py [--parts own first chaos] [--runs 128] [--turns 3] [--batch 64] [--trial]
                                         [--json FILE]

    own    the own code (`clearance_reference`) against the reference values of `rfem-jax validate`
    first  the first five contacts of a rigid slider-crank with play at its wrist pin, at 5000 and 600 rpm, with a
           coefficient of restitution (Lankarani and Nikravesh) and with a given damping factor (Hunt and Crossley):
           errors of rfem_jax and Exudyn against the own code, and processor times
    chaos  distributions over many runs that have long become chaotic (`clearance_statistics`)

Of every method the cheapest setting is shown with which contacts begin and end within 1e-7 s and largest forces are
within 1e-3, or else the last one tried. Loads are at saved times; edges of contacts are interpolated linearly, largest
forces by a parabola. Rebounds show in the ends of contacts and the starts of the next. One thread; times are medians of
processor time, without compilation and building. Every agreement is checked; the exit code is 1 if one fails.
`--trial` shows that the command works.
"""

import argparse
import json
import statistics
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, NamedTuple

import speed_timing  # first: it sets JAX up

import jax  # isort: skip
import jax.numpy as jnp
import numpy as np
from clearance_reference import Contact, Crank, Impact, first_impacts
from clearance_statistics import compare_statistics
from comparison_report import Report
from exudyn_clearance import SolverSettings
from exudyn_clearance import simulate as by_exudyn

from rfem_jax import Explicit, GeneralisedAlpha, Method, RungeKutta4, Simulation, design, simulate
from rfem_jax.validation.impacts import FAST, REFERENCE, SLOW, CrankCase, impacts_of, slider_crank

TARGET = 1e-7, 1e-3  # s, relative
INTERVAL = 2e-6  # s between our saved times
SPREAD = 0.01  # of the clearances of a batch
DAMPING = {FAST.name: 0.07, SLOW.name: 0.7}  # s/m: about what a restitution of 0.9 gives the first impacts
# From cheap to dear.
EXPLICIT_STEPS = tuple(RungeKutta4(step=h) for h in (2e-6, 1e-6, 5e-7))
ADAPTIVE = tuple(Explicit("dopri8", rtol=r, atol=1e-2 * r) for r in (1e-6, 1e-8))
FOLLOWING = tuple(
    GeneralisedAlpha(step=INTERVAL, contact_tolerance=tolerance) for tolerance in (2e-2, 2e-3, 2e-4, 2e-5, 2e-6)
)
THEIR_EXPLICIT = tuple(SolverSettings("dopri5", h, r) for r in (1e-6, 1e-7, 1e-8, 1e-9) for h in (5e-5, 2e-5))
THEIR_IMPLICIT = tuple(SolverSettings("generalised_alpha", h, 1e-4) for h in (1e-6, 5e-7, 2e-7, 1e-7))


class Observed(NamedTuple):
    """The largest errors of begins and ends of contacts [s], and of largest forces (relative); infinite where contacts
    are missing."""

    edges: float
    peaks: float

    @property
    def good(self) -> bool:
        """Whether the target is met."""
        return self.edges <= TARGET[0] and self.peaks <= TARGET[1]


class Answer(NamedTuple):
    """Setting; its errors; processor time of a run [ms]."""

    setting: str
    errors: Observed
    cpu: float


def observed(times: np.ndarray, depth: np.ndarray, force: np.ndarray, known: list[Impact]) -> Observed:
    """Errors of a history by the contacts that are known."""
    found = impacts_of(times, depth)[: len(known)]
    if len(found) < len(known):
        return Observed(np.inf, np.inf)
    pairs = list(zip(found, known, strict=True))
    edges = [max(abs(a.begin - b.begin), abs(a.end - b.end)) for a, b in pairs]
    peaks = [abs(_largest(times, force, a.inside) / b.peak - 1.0) for a, b in pairs]
    return Observed(max(edges), max(peaks))


def _largest(times: np.ndarray, force: np.ndarray, inside: slice) -> float:
    """Largest force of a contact, by the parabola through the largest saved one and those beside it."""
    at = inside.start + int(np.argmax(force[inside]))
    near = slice(at - 1, at + 2)
    x = (times[near] - times[at]) / (times[at + 1] - times[at - 1])
    a, b, c = np.polyfit(x, force[near], 2)
    return float(c - b**2 / (4.0 * a)) if a < 0.0 else float(c)


def _cheapest(settings: Iterable[Any], attempt: Callable[[Any], Answer]) -> Answer:
    """The answer of the first setting that is good enough, or of the last one."""
    answer = None
    for setting in settings:
        answer = attempt(setting)
        if answer.errors.good:
            break
    assert answer is not None
    return answer


def exudyns(case: CrankCase, contact: Contact, duration: float, known: list[Impact], repeats: int):
    """Tries a setting of Exudyn."""

    def attempt(settings: SolverSettings) -> Answer:
        runs = [by_exudyn(Crank(case.rate), contact, duration, settings) for _ in range(repeats)]
        errors = observed(runs[0].times, runs[0].depth, runs[0].force, known)
        return Answer(settings.name, errors, 1e3 * statistics.median(run.cpu for run in runs))

    return attempt


def ours(case: CrankCase, losses: dict[str, float], duration: float, known: list[Impact], repeats: int, batch: int = 0):
    """Tries a method of rfem_jax, alone or in a batch whose first run is that of the case."""
    model, drive, start = slider_crank(case, **losses)
    spread = 1.0 + SPREAD * np.linspace(0.0, 1.0, max(batch, 1))
    radial = case.radial * (spread if batch else 1.0)

    def attempt(method: Method) -> Answer:
        def one(radial):
            run = simulate(
                Simulation(
                    model,
                    drive=drive,
                    duration=duration,
                    method=method,
                    save_every=INTERVAL,
                    start=start,
                    design=design(model, {"C.clearance.radial": radial}),
                )
            )
            force = jnp.linalg.norm(run.loads["C"].force, axis=1)
            return run.times, run.contacts["C"].penetration[:, 0], force

        timing = speed_timing.timed(jax.vmap(one) if batch else one, jnp.asarray(radial), repeats=repeats)
        times, depth, force = (np.asarray(x)[0] if batch else np.asarray(x) for x in timing.result)
        return Answer(_name(method), observed(times, depth, force, known), 1e3 * timing.cpu / max(batch, 1))

    return attempt


def _name(method: Any) -> str:
    if method.adaptive:
        return f"{method.name}, tolerance {method.rtol:g}"
    following = f", contacts {method.contact_tolerance:g}" if hasattr(method, "contact_tolerance") else ""
    return f"{method.name.replace('_', ' ')}, {1e6 * method.step:g} us{following}"


def compare_own(report: Report) -> None:
    """The own code against the values of two other programs."""
    for case in (FAST, SLOW):
        found = first_impacts(Crank(case.rate), Contact(case.radial, case.stiffness, restitution=0.9), case.duration)
        begins, peaks = (REFERENCE[f"{case.quantity}_{what}"] for what in ("start", "peak"))
        report.check(f"{case.name}, contacts of the own code, more or less", abs(len(found) - len(begins)), 0)
        away = max(abs(a.begin - b) for a, b in zip(found, begins))
        report.check(f"{case.name}, own code: starts, s", away, 1e-9)
        away = max(abs(a.peak / b - 1.0) for a, b in zip(found, peaks))
        report.check(f"{case.name}, own code: largest forces", away, 1e-6)


def compare_first_impacts(report: Report, batch: int, trial: bool) -> None:
    """A table for both rates and laws; edges may miss the target by ten, which fixed steps at 600 rpm do."""
    repeats, rows = 1 if trial else 5, []
    for case in (FAST,) if trial else (FAST, SLOW):
        for losses in ({"restitution": 0.9},) if trial else ({"restitution": 0.9}, {"damping": DAMPING[case.name]}):
            contact = Contact(case.radial, case.stiffness, **losses)
            (known, _, cpu) = speed_timing.run_once(first_impacts, Crank(case.rate), contact, case.duration)
            known = known[: 1 if trial else 5]
            duration = INTERVAL * np.ceil((known[-1].end + 5e-6) / INTERVAL)
            law = ", ".join(f"{name} {value:g}" for name, value in losses.items())
            name = f"{case.name}, {law}"
            rows.append([name, "own code", "DOP853, tolerance 1e-11", "", "", f"{1e3 * cpu:.3g}"])
            explicit, implicit = "damping" in losses, FOLLOWING[2:3] if trial else FOLLOWING
            theirs = exudyns(case, contact, duration, known, repeats)
            tried = [("Exudyn", settings, theirs) for settings in (THEIR_EXPLICIT, THEIR_IMPLICIT)]
            alone, many = (
                ours(case, losses, duration, known, repeats),
                ours(case, losses, duration, known, repeats, batch),
            )
            methods = (EXPLICIT_STEPS, ADAPTIVE, implicit) if explicit else (implicit,)
            answers = [(who, _cheapest(settings, attempt)) for who, settings, attempt in tried]
            for settings in methods:
                answer = _cheapest(settings, alone)
                answers.append(("ours", answer))
                chosen = [one for one in settings if _name(one) == answer.setting]
                if settings is not ADAPTIVE and batch:
                    answers.append((f"ours, batch of {batch}", _cheapest(chosen, many)))
            for who, (setting, errors, cpu) in answers:
                rows.append([name, who, setting, f"{errors.edges:.1e}", f"{errors.peaks:.1e}", f"{cpu:.3g}"])
                report.check(f"{name}, {who}, {setting}: edges of contacts, s", errors.edges, 10.0 * TARGET[0])
                report.check(f"{name}, {who}, {setting}: largest forces", errors.peaks, TARGET[1])
    report.table(
        "First five contacts, errors against the own code, processor time",
        ["case", "program", "setting", "edges of contacts within, s", "largest forces within", "CPU ms a run"],
        rows,
    )


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--parts", nargs="+", choices=("own", "first", "chaos"), default=("own", "first", "chaos"))
    parser.add_argument("--runs", type=int, default=128, help="of the statistics")
    parser.add_argument("--turns", type=int, default=3, help="of the crank in the statistics; the first does not count")
    parser.add_argument("--batch", type=int, default=64, help="runs in a batch that is timed; 0: none")
    parser.add_argument("--trial", action="store_true", help="few and short runs")
    parser.add_argument("--json", type=Path, help="file for the numbers")
    options = parser.parse_args()
    report = Report()
    if "own" in options.parts:
        compare_own(report)
    if "first" in options.parts:
        compare_first_impacts(report, options.batch, options.trial)
    if "chaos" in options.parts:
        compare_statistics(report, options.runs, options.turns, options.trial)
    if options.json:
        options.json.write_text(json.dumps(report.data, indent=2), encoding="utf-8")
    print(f"\n{report.passed} agreements met, {len(report.failed)} failed")
    return 1 if report.failed and not options.trial else 0


if __name__ == "__main__":
    sys.exit(main())
