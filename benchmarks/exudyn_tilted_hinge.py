"""The flexible four-bar with a tilted hinge: Exudyn against published values and against ours.

O. A. Bauchau et al., Validation of flexible multibody dynamics beam formulations using benchmark
problems, Multibody Syst. Dyn. 37 (2016) 29-48; set-up of its public versions (mb_sef_py).  Values:
limits of mesh refinement in the window 0.1 s <= t <= 2.4 s by two independent codes, and the errors
of a geometrically exact chain of m sdes a bar.
"""


import numpy as np
from exudyn_models import Settings
from exudyn_runs import simulate
from rfem_jax import (
    STATUS,
    GivenSection,
    Joint,
    Link,
    Mechanism,
    Method,
    PrescribedRate,
    assembly_errors,
    discretise,
)
from rfem_jax import simulate as simulate_ours

WINDOW = (0.1, 2.4)
STEP = 2e-3
LIMIT = {"force A": 332.215, "moment A": 67.982, "moment B": 30.470, "moment C": 49.010,
         "moment D": 23.294, "u_Y of C at 2 s": 2.660182e-3}
CHAIN = {4: (0.0197, 0.0350), 8: (0.0049, 0.0086), 16: (0.0012, 0.0022)}  # force A, moment B
SAVE_EVERY = 4e-3


def _section(axial, shear, torsion, bending, density, rotary):
    return GivenSection(
        axial, shear, shear, torsion, bending, bending, density, 2.0 * rotary, rotary, rotary
    )


def tilted_hinge(m: int) -> Mechanism:
    """The four-bar with m sdes a bar; the pin of C is tilted by the error "C.pin_tilt_x"."""
    thick = _section(52.99e6, 16.88e6, 733.5, 1131.0, 1.997, 42.6e-6)
    thin = _section(13.25e6, 4.22e6, 45.84, 70.66, 0.4992, 2.662e-6)
    return Mechanism(
        links=(
            Link("bar1", 0.12, thick, None, rfes=m + 1),
            Link("bar2", 0.24, thick, None, rfes=m + 1),
            Link("bar3", 0.12, thin, None, rfes=m + 1),
        ),
        joints=(
            Joint("A", "base", "bar1", position=(0.0, 0.0, 0.0), angle=-np.pi / 2),
            Joint("B", "bar1", "bar2", angle=np.pi / 2),
            Joint("D", "base", "bar3", position=(0.24, 0.0, 0.0), angle=-np.pi / 2),
            Joint("C", "bar2", "bar3", cut=True),
        ),
        gravity=(0.0, 0.0, 0.0),
        driven_joint="A",
    )


def by_exudyn(m: int, step: float = STEP, settings: Settings = Settings()) -> dict:
    """The compared values by Exudyn."""
    model = discretise(tilted_hinge(m))
    errors = assembly_errors(model, {"C.pin_tilt_x": "5 deg"})
    result = simulate(
        model, errors, PrescribedRate("A", 0.6), WINDOW[1], step, settings, WINDOW, track="C"
    )
    h = result.histories
    at = int(np.searchsorted(h.times, 2.0 - 0.1 * step))
    return {
        "force A": result.rms["force"]["A"],
        **{f"moment {j}": result.rms["moment"][j] for j in "ABCD"},
        "u_Y of C at 2 s": float(h.place[at, 1] - h.place[0, 1]),
        "CPU s": round(result.cpu, 3),
    }


def by_us(m: int, form: str) -> dict:
    """The compared values by rfem_jax."""
    model = discretise(tilted_hinge(m), elements=form)
    errors = assembly_errors(model, {"C.pin_tilt_x": "5 deg"})
    run = simulate_ours(
        model, errors, drive=PrescribedRate("A", 0.6), duration=WINDOW[1], save_every=SAVE_EVERY,
        method=Method("generalised_alpha", step=STEP),
    )
    window = run.window(*WINDOW)
    return {
        "status": STATUS[int(run.status)].name,
        "force A": float(window.rms_force["A"]),
        **{f"moment {j}": float(window.rms_moment[j]) for j in "ABCD"},
    }


def compare_tilted_hinge(report, quick: bool) -> None:
    """Table of the window's RMS loads by Exudyn (m = 4, 8, 16) and by us (m = 4)."""
    columns = {f"exudyn m = {m}": by_exudyn(m) for m in (4, 8) + (() if quick else (16,))}
    half = by_exudyn(4, 0.5 * STEP)
    if not quick:
        for form in ("linear", "geometrically_exact"):
            columns[f"ours {form} m = 4"] = by_us(4, form)
    rows = [
        [name, *(values.get(name) for values in columns.values()), LIMIT.get(name)]
        for name in ("status", *LIMIT, "CPU s")
    ]
    report.table(
        f"Four-bar with a hinge tilted by 5 deg, RMS loads in {WINDOW} s (N, N m, m)",
        ["value", *columns, "published limit"], rows,
    )
    coarse = columns["exudyn m = 4"]
    change = max(abs(half[name] / coarse[name] - 1.0) for name in LIMIT)
    report.check("tilted hinge, Exudyn m = 4: change when the step is halved", change, 2e-5)
    for m, expected in CHAIN.items():
        values = columns.get(f"exudyn m = {m}")
        if values is None:
            continue
        for name, error in zip(("force A", "moment B"), expected):
            away = values[name] / LIMIT[name] - 1.0
            report.check(
                f"tilted hinge, Exudyn m = {m}: error of {name} ({100 * away:.2f} %) against that "
                f"of a geometrically exact chain ({100 * error:.2f} %)",
                abs(away - error), 1.5e-4,
            )
    ours = columns.get("ours geometrically_exact m = 4")
    if ours is not None:
        worst = max(abs(ours[name] / coarse[name] - 1.0) for name in LIMIT if name in ours)
        report.check("tilted hinge, m = 4: ours geometrically exact against Exudyn", worst, 1e-4)
