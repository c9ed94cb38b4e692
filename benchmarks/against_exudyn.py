"""rfem_jax against an independent engine, Exudyn, in the same run: accuracy and time.

    python benchmarks/against_exudyn.py [--quick | --trial] [--parts preload loads convergence time ...] [--json FILE]

    preload       at the start, of the main study's cases: ours linear, ours geometrically exact, Exudyn, and the
                  values of the independent reference code
    loads         RMS loads and time histories, likewise
    convergence   of Exudyn itself with its step
    time          of Exudyn: its fastest settings
    tilted_hinge  the four-bar with a tilted hinge
    open_chain    an open chain with all errors
    studies       the studies four_bar, slider_crank, spatial_linkage and six_bar_press, accuracy and time; joints of
                  other kinds, and friction

Every agreement is checked; the exit code is 1 if one fails.  `--quick` leaves out most of our own simulations.
`--trial` simulates few steps: it shows that the command works, and its agreements may fail (exit code 0).

Other modules may import `simulate(model, errors, drive, duration, step, ...)` and
`fastest(case, accuracy) -> (step, seconds, error)` from here.  Times are medians; other programs on
the machine disturb them, so compare ratios within one run.
"""

import argparse
import dataclasses
import functools
import json
import sys
import time

import speed_timing  # noqa: F401  first: it sets JAX up

import exudyn_speed as speed  # isort: skip
import numpy as np
from comparison_report import Report
from exudyn_engine import PLANAR, exu, exudyn_numbers, simulate
from exudyn_open_chain import all_errors, compare_open_chain
from exudyn_speed import fastest
from exudyn_studies import compare_studies
from exudyn_tilted_hinge import compare_tilted_hinge

from rfem_jax import assemble, assembly_errors, discretise, run_cases
from rfem_jax.exchange.exudyn_program import build, equilibrium, rms_loads
from rfem_jax.validation.reference_values import read_reference

__all__ = ["fastest", "simulate"]

JOINTS = "ABCD"
REFERENCE = read_reference("four_bar_study")
FORMS = ("linear", "geometrically_exact")
# Fair tolerances (relative) of RMS forces, RMS moments, preload against exact rotations.
LIMITS = {"linear": (5e-4, 1e-3, 5e-4), "geometrically_exact": (1e-4, 1e-4, 1e-5)}


def _short(value) -> float:
    """Two digits are enough for a difference."""
    return float(f"{value:.1e}")


def relative(value: float, reference: float | None) -> float | None:
    """Relative difference, None where there is no reference or it is zero."""
    if reference is None or abs(reference) < speed.SMALLEST_LOAD:
        return None
    return _short(value / reference - 1.0)


def compare_preload(report: Report, cases) -> None:
    """Static start of every case: ours, both forms, against Exudyn's."""
    models = _models()
    rows, worst = [], dict.fromkeys(models, 0.0)
    for case in cases:
        theirs = speed.prepared(case.name)[1][1]
        ours = {f: assemble(m, assembly_errors(m, case.errors)).preload for f, m in models.items()}
        for joint in JOINTS:
            for kind, unit in ((0, "force N"), (1, "moment N m")):
                value = float(np.linalg.norm(theirs[joint][kind]))
                given = REFERENCE[("preload_force", "preload_moment")[kind]].get(case.name, {}).get(joint)
                row = [case.name, joint, unit]
                for form, loads in ours.items():
                    vector = np.asarray(loads[joint][kind])
                    row.append(float(np.linalg.norm(vector)))
                    scale = max(np.linalg.norm(theirs[j][kind]) for j in JOINTS)
                    away = float(np.linalg.norm(vector - theirs[joint][kind]) / scale)
                    worst[form] = max(worst[form], away)
                rows.append([*row, value, given])
                if given is not None:
                    # The reference's moments leave out the one that holds the crank (about y).
                    across = float(np.linalg.norm(theirs[joint][kind] * [1.0, 1.0 - kind, 1.0]))
                    report.check(
                        f"Exudyn's preload, {case.name} {joint} {unit}, against the reference",
                        abs(across / given - 1.0),
                        2e-6,
                    )
    heads = ["case", "joint", "preload", *(f"ours {f}" for f in models), "exudyn", "reference"]
    report.table("Preload at the start (reference: without the moment that holds A)", heads, rows)
    exact = models["geometrically_exact"]
    errors = assembly_errors(exact, all_errors(exact, 0.1))
    ours = assemble(exact, errors).preload
    theirs = equilibrium(exudyn_numbers(exact, errors))[1]
    away = [np.linalg.norm(np.asarray(ours[j].force) - theirs[j][0]) for j in JOINTS]
    report.check(
        f"preload forces with all {len(exact.topology.error_names)} errors at once, ours "
        "geometrically exact against Exudyn, over the largest",
        max(away) / max(np.linalg.norm(theirs[j][0]) for j in JOINTS),
        1e-6,
    )
    for form, away in worst.items():
        report.check(
            f"preload vectors in hinge frames, ours {form} against Exudyn, over the largest",
            away,
            LIMITS[form][2],
        )


@functools.cache
def _models() -> dict:
    """Our model of the main study with each form of elements."""
    study, linear = speed.main_study()
    return {form: linear if form == "linear" else discretise(study.mechanism, elements=form) for form in FORMS}


def our_runs(cases, duration: float, forms=FORMS) -> dict:
    """form -> case -> our run with the study's method and step (Runge-Kutta 4, 1e-5 s)."""
    study, _ = speed.main_study()
    part = dataclasses.replace(study, cases=cases, duration=duration)
    return {form: run_cases(part, model=_models()[form])[1] for form in forms}


def compare_rms(report: Report, cases, theirs: dict, ours: dict) -> None:
    """RMS loads of all joints, Exudyn at its smallest step against ours and the reference."""
    rows, worst = [], {form: [0.0, 0.0] for form in ours}
    for case in cases:
        for kind in ("force", "moment"):
            for joint in JOINTS:
                value = theirs[case.name][kind][joint]
                reference = REFERENCE[f"rms_{kind}"].get(case.name, {}).get(joint)
                row = [case.name, joint, f"RMS {kind}"]
                for form, runs in ours.items():
                    mine = float(getattr(runs[case.name].metrics, f"rms_{kind}")[joint])
                    away = relative(mine, value)
                    row += [mine, away]
                    if away is not None:
                        place = 0 if kind == "force" else 1
                        worst[form][place] = max(worst[form][place], abs(away))
                rows.append([*row, value, reference, relative(value, reference)])
                if reference is not None:
                    report.check(
                        f"Exudyn's RMS {kind}, {case.name} {joint}, against the reference",
                        abs(value / reference - 1.0),
                        2e-6,
                    )
    mine = [head for form in ours for head in (f"ours {form}", "difference")]
    heads = ["case", "joint", "load", *mine, "exudyn", "reference", "exudyn - reference"]
    report.table("RMS loads over the whole duration (N, N m; differences relative)", heads, rows)
    for form, (force, moment) in worst.items():
        report.check(f"RMS forces, ours {form} against Exudyn", force, LIMITS[form][0])
        report.check(f"RMS moments, ours {form} against Exudyn", moment, LIMITS[form][1])


def compare_histories(report: Report, cases, ours: dict, search: speed.Search) -> None:
    """Crank angle and rate, and the vectors of force and moment, at our saved times."""
    rows = []
    for case in cases:
        for form, mine in ours.items():
            r = mine[case.name]
            theirs = speed.converged_at(case.name, r.times, search)
            row = [case.name, form]
            for name in ("angle", "rate"):
                row.append(_short(np.abs(theirs[name] - np.asarray(getattr(r, name))).max()))
            for kind in ("force", "moment"):
                largest = max(np.abs(vectors).max() for vectors in theirs[kind].values())
                if largest < speed.SMALLEST_LOAD:
                    row += [None, None]
                    continue
                away = [np.linalg.norm(theirs[kind][j] - np.asarray(getattr(r.loads[j], kind)), axis=1) for j in JOINTS]
                row += [_short(np.max(away) / largest), _short(np.sqrt(np.mean(np.square(away))) / largest)]
            rows.append(row)
            limit_angle, limit_rate = (3e-4, 1e-2) if form == "linear" else (3e-6, 1.5e-3)
            report.check(f"crank angle (rad), {case.name}, ours {form}", row[2], limit_angle)
            report.check(f"crank rate (rad/s), {case.name}, ours {form}", row[3], limit_rate)
            report.check(f"force histories (RMS), {case.name}, ours {form}", row[5], 5e-3)
    report.table(
        f"Time histories, Exudyn extrapolated from {search.converged} s: largest differences; "
        "loads of all joints as vectors in hinge frames, over the largest load",
        ["case", "ours", "angle rad", "rate rad/s", "force, largest", "force, RMS", "moment, largest", "moment, RMS"],
        rows,
    )


def converge(report: Report, quick: bool, search: speed.Search) -> None:
    """RMS loads of Exudyn against its step, its order, and the effect of the spectral radius."""
    trial = search == speed.TRIAL
    steps = (2e-3, 1e-3) if trial else (2e-3, 1e-3, 5e-4, 2e-4, 1e-4, 5e-5)
    for case in ("P2",) if trial else ("P1", "P2", "P5"):
        reference, rows, before = speed.converged(case, search), [], None
        for step in steps:
            result = speed.solve(case, step, search=search)
            error = speed.error_of(result.rms, reference)
            order = None
            if before is not None:
                order = round(float(np.log(before[1] / error) / np.log(before[0] / step)), 2)
            before = step, error
            loads = [result.rms["force"][j] for j in JOINTS]
            rows.append([1e3 * step, *loads, result.rms["moment"]["A"], _short(error), order])
        loads = [reference["force"][j] for j in JOINTS]
        rows.append(["-> 0", *loads, reference["moment"]["A"], None, None])
        report.table(
            f"Convergence of Exudyn, {case}, spectral radius 0.6",
            ["step ms", *(f"force {j}" for j in JOINTS), "moment A", "largest error", "order"],
            rows,
        )
        report.check(f"Exudyn's RMS loads at {steps[-1]:g} s, {case}, converged", before[1], 3e-5)
        if not trial:
            _check_motion(report, case)
    if not quick or trial:
        _radii(report, search)


def _check_motion(report: Report, case: str) -> None:
    if case not in REFERENCE["crank_angle"]:
        return
    h = speed.converged_runs(case)[1].histories
    for t, known in REFERENCE["crank_angle"][case].items():
        at = int(np.searchsorted(h.times, float(t) - 1e-6))
        away = abs((h.angle[at] - h.angle[0]) / known - 1.0)
        report.check(f"Exudyn's angle, {case} at {t} s", away, 2e-6)
        away = abs(h.rate[at] / REFERENCE["crank_rate"][case][t] - 1.0)
        report.check(f"Exudyn's rate, {case} at {t} s", away, 1e-5)


def _radii(report: Report, search: speed.Search) -> None:
    rows = []
    for radius in (1.0, 0.95, 0.9, 0.8, 0.7, 0.6, 0.5, 0.3, 0.0):
        row = [radius]
        for step in (2e-3, 1e-3, 5e-4):
            result = speed.solve("P5", step, PLANAR._replace(spectral_radius=radius), search)
            error = None if result is None else speed.error_of(result.rms, speed.converged("P5", search))
            row.append("fails" if error is None else _short(error))
        rows.append(row)
    report.table(
        "Largest error of an RMS load against the spectral radius, P5",
        ["spectral radius", "2 ms", "1 ms", "0.5 ms"],
        rows,
    )


def time_it(report: Report, quick: bool, search: speed.Search) -> None:
    """Exudyn's fastest runs at given accuracies, and what its settings cost."""
    rows = []
    for accuracy in (1e-2, 1e-3) if quick else (1e-2, 1e-3, 1e-4):
        b = speed.best("P5", accuracy, search)
        s = b.settings
        rows.append(
            [
                f"{accuracy:g}",
                1e3 * b.step,
                _short(b.error),
                round(b.cpu, 4),
                round(b.seconds, 4),
                f"{b.spread[0]:.4f} - {b.spread[1]:.4f}",
                f"{s.nodes}, radius {s.spectral_radius}, Newton {s.relative:g}"
                + (", a Jacobian a step" if s.new_jacobian else ""),
            ]
        )
    report.table(
        f"Exudyn {exu.config.Version()}, P5, {search.duration:g} s of motion, one thread, solver alone: fastest "
        f"found (medians of {search.timed})",
        ["RMS loads within", "step ms", "error", "CPU s", "clock s", "clock, spread", "settings"],
        rows,
    )
    base = PLANAR._replace(relative=1e-5, intrinsic=False, new_jacobian=True)
    changes = {
        "-": {},
        "Lie-group nodes": {"nodes": "rotation_vector"},
        "Euler parameters": {"nodes": "euler_parameters"},
        "dense solver": {"sparse": False},
        "full Newton": {"modified": False},
        "Jacobian when slow": {"new_jacobian": False},
        "Newton to 1e-8": {"relative": 1e-8},
        "symmetric connector": {"intrinsic": True},
    }
    rows = []
    for name, change in changes.items():
        cells = [name]
        for step in (5e-3, 2e-3, 1e-3):
            runs = [speed.solve("P5", step, base._replace(**change), search) for _ in range(min(3, search.timed))]
            if None in runs:
                cells += ["fails", "fails"]
                continue
            error = speed.error_of(runs[0].rms, speed.converged("P5", search))
            cells += [round(float(np.median([r.cpu for r in runs])), 4), _short(error)]
        rows.append(cells)
    heads = ["change", "5 ms: CPU s", "error", "2 ms: CPU s", "error ", "1 ms: CPU s", "error  "]
    report.table("What a setting costs (first row: the base)", heads, rows)
    _whole_sample(report, search)


def _whole_sample(report: Report, search: speed.Search) -> None:
    """What a sample of a Monte Carlo costs Exudyn besides the solver."""
    mechanism, (start, _) = speed.prepared("P5")
    settings = speed.best("P5", 1e-2, search).settings
    rows = []
    for name, work in (
        ("building the system (Python)", lambda: build(mechanism, settings, start)),
        ("building and static start", lambda: equilibrium(mechanism, settings)),
    ):
        cpu = []
        for _ in range(5):
            before = time.thread_time()
            work()
            cpu.append(time.thread_time() - before)
        rows.append([name, round(float(np.median(cpu)), 5)])
    report.table("Besides the solver, once a sample", ["work", "CPU s"], rows)


PARTS = ("preload", "loads", "convergence", "time", "tilted_hinge", "open_chain", "studies")


def compare_loads(report: Report, cases, quick: bool, search: speed.Search) -> None:
    """RMS loads and histories, ours against Exudyn's; in a quick run over a short time."""
    study, _ = speed.main_study()
    duration = min(0.02, search.duration) if quick else study.duration
    ours = our_runs(cases, duration, FORMS[:1] if search == speed.TRIAL else FORMS)
    if quick:
        theirs = {c.name: rms_loads(speed.converged_runs(c.name, search)[1].histories, (0.0, duration)) for c in cases}
        print(f"\nOurs over {duration} s only, so without the reference's values.")
        _quick_rms(report, theirs, ours)
    else:
        theirs = {case.name: speed.converged(case.name) for case in cases}
        compare_rms(report, cases, theirs, ours)
    compare_histories(report, cases, ours, search)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--parts", nargs="+", choices=PARTS, help="all by default; --quick leaves out the open chain")
    parser.add_argument("--quick", action="store_true", help="few cases, little of our own runs")
    parser.add_argument("--trial", action="store_true", help="few steps: only to see that it works")
    parser.add_argument("--json", metavar="FILE", help="write all tables to a file")
    options = parser.parse_args()
    report, (study, _) = Report(), speed.main_study()
    quick, search = options.quick or options.trial, speed.TRIAL if options.trial else speed.FULL
    wanted = ("P2",) if options.trial else ("P2", "P5")
    cases = tuple(c for c in study.cases if c.name in wanted or not quick)
    parts = options.parts or [part for part in PARTS if part != "open_chain" or not quick]
    if "preload" in parts:
        compare_preload(report, cases)
    if "loads" in parts:
        compare_loads(report, cases, quick, search)
    if "convergence" in parts:
        converge(report, quick, search)
    if "time" in parts:
        time_it(report, quick, search)
    if "tilted_hinge" in parts:
        compare_tilted_hinge(report, quick, options.trial)
    if "open_chain" in parts:
        compare_open_chain(report, options.trial)
    if "studies" in parts:
        compare_studies(report, quick, options.trial)
    print(f"\n{report.passed} agreements met, {len(report.failed)} failed")
    for what in report.failed:
        print(f"  {what}")
    if options.json:
        with open(options.json, "w", encoding="utf-8") as file:
            json.dump(report.data, file, indent=1, allow_nan=False)
    return 1 if report.failed and not options.trial else 0


def _quick_rms(report: Report, theirs: dict, ours: dict) -> None:
    for form, runs in ours.items():
        for k, kind in enumerate(("force", "moment")):
            away = max(
                abs(float(getattr(run.metrics, f"rms_{kind}")[j]) / theirs[name][kind][j] - 1.0)
                for name, run in runs.items()
                for j in JOINTS
            )
            report.check(f"RMS {kind}s, ours {form} against Exudyn", away, LIMITS[form][k])


if __name__ == "__main__":
    sys.exit(main())
