"""The flexible four-bar with a tilted hinge: Exudyn against published values and against ours.

Mechanism and reference values are those of `rfem_jax.validation.tilted_hinge`: limits of mesh refinement in the window
0.1 s <= t <= 2.4 s by two independent codes, and the errors of a geometrically exact chain of m sdes a bar.
"""

import numpy as np
from exudyn_engine import PLANAR, simulate

from rfem_jax import STATUS, GeneralisedAlpha, PrescribedRate, assembly_errors, discretise
from rfem_jax import simulate as simulate_ours
from rfem_jax.validation.reference_values import read_reference
from rfem_jax.validation.tilted_hinge import SAVE_EVERY, WINDOW, mechanism

STEP = 2e-3
REFERENCE = read_reference("tilted_hinge")
JOINTS, KINDS = "ABCD", ("force", "moment")
AT_2_S = "u_Y of C at 2 s"  # along the hinges, the benchmark's -z
LIMIT = {
    "force A": REFERENCE["rms_force"],
    **{f"moment {joint}": moment for joint, moment in REFERENCE["rms_moment"].items()},
    AT_2_S: -REFERENCE["displacement_at_2_s"],
}
NAMES = (*(f"{kind} {j}" for kind in KINDS for j in JOINTS), AT_2_S)


def by_exudyn(m: int, step: float = STEP, settings=PLANAR):
    """The compared values by Exudyn, and its histories."""
    model = discretise(mechanism(m), elements="linear")
    errors = assembly_errors(model, {"C.pin_tilt_x": "5 deg"})
    result = simulate(model, errors, PrescribedRate("A", 0.6), WINDOW[1], step, settings, WINDOW, track=("C",))
    h = result.histories
    at = int(np.searchsorted(h.times, 2.0 - 0.1 * step))
    values = {f"{kind} {j}": result.rms[kind][j] for kind in KINDS for j in JOINTS}
    values |= {
        AT_2_S: float(h.places["C"][at, 1] - h.places["C"][0, 1]),
        "CPU s": round(result.cpu, 3),
    }
    return values, h


def by_us(m: int, form: str):
    """The compared values by rfem_jax, and the run."""
    model = discretise(mechanism(m), elements=form)
    errors = assembly_errors(model, {"C.pin_tilt_x": "5 deg"})
    run = simulate_ours(
        model,
        errors,
        drive=PrescribedRate("A", 0.6),
        duration=WINDOW[1],
        save_every=SAVE_EVERY,
        method=GeneralisedAlpha(step=STEP),
    )
    window = run.window(*WINDOW)
    values = {"status": STATUS[int(run.status)].name}
    for kind, of_joints in (("force", window.rms_force), ("moment", window.rms_moment)):
        values |= {f"{kind} {j}": float(of_joints[j]) for j in JOINTS}
    return values, run


def compare_histories(report, histories, run) -> None:
    """Vectors of force and moment of all joints, in hinge frames, at our saved times in the window."""
    times = np.asarray(run.times)
    inside = (times >= WINDOW[0]) & (times <= WINDOW[1])
    at = np.searchsorted(histories.times, times[inside] - 0.1 * STEP)
    rows = []
    for kind in KINDS:
        theirs = {j: getattr(histories, kind)[j][at] for j in JOINTS}
        largest = max(np.abs(vectors).max() for vectors in theirs.values())
        for j in JOINTS:
            mine = np.asarray(getattr(run.loads[j], kind))[inside]
            away = float(np.linalg.norm(theirs[j] - mine, axis=1).max() / largest)
            rows.append([f"{kind} {j}", largest, away])
    report.table(
        "Histories with a tilted hinge, m = 4, geometrically exact: largest distance of ours from Exudyn's",
        ["value", "largest of its kind (N, N m)", "distance over it"],
        rows,
    )
    worst = max(row[2] for row in rows)
    report.check("tilted hinge, m = 4: histories of all joint loads", worst, 1e-4)


def compare_tilted_hinge(report, quick: bool, trial: bool = False) -> None:
    """Table of the window's RMS loads by Exudyn (m = 4, 8, 16) and by us (m = 4), and histories; of a trial by Exudyn
    with m = 4 and longer steps."""
    step = 10.0 * STEP if trial else STEP
    found = {f"exudyn m = {m}": by_exudyn(m, step) for m in (4, *(() if trial else (8,)), *(() if quick else (16,)))}
    half, _ = by_exudyn(4, 0.5 * step)
    if not quick:
        for form in ("linear", "geometrically_exact"):
            found[f"ours {form} m = 4"] = by_us(4, form)
    columns = {name: values for name, (values, _) in found.items()}
    rows = [
        [name, *(values.get(name) for values in columns.values()), LIMIT.get(name)]
        for name in ("status", *NAMES, "CPU s")
    ]
    report.table(
        f"Four-bar with a hinge tilted by 5 deg, RMS loads in {WINDOW} s (N, N m, m)",
        ["value", *columns, "published limit"],
        rows,
    )
    coarse = columns["exudyn m = 4"]
    change = max(abs(half[name] / coarse[name] - 1.0) for name in NAMES)
    report.check("tilted hinge, Exudyn m = 4: change when the step is halved", change, 2e-5)
    for m, expected in REFERENCE["chain_error"].items():
        values = columns.get(f"exudyn m = {m}")
        if values is None:
            continue
        for name, error in zip(("force A", "moment B"), expected):
            away = values[name] / LIMIT[name] - 1.0
            report.check(
                f"tilted hinge, Exudyn m = {m}: error of {name} ({100 * away:.2f} %) against that "
                f"of a geometrically exact chain ({100 * error:.2f} %)",
                abs(away - error),
                1.5e-4,
            )
    ours = columns.get("ours geometrically_exact m = 4")
    if ours is not None:
        worst = max(abs(ours[name] / coarse[name] - 1.0) for name in NAMES if name in ours)
        report.check("tilted hinge, m = 4: ours geometrically exact against Exudyn", worst, 1e-4)
        name = "ours geometrically_exact m = 4"
        compare_histories(report, found["exudyn m = 4"][1], found[name][1])
