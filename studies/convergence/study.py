"""How many rfes, which step, which elements, how much damping: what the joint loads depend on.

    python studies/convergence/study.py --out results/convergence

The main study's four-bar (studies/four_bar/study.toml, a substitute for the paper's lost data),
cases P1, P2 and P5, changed in one respect at a time:

    rfes      m = 2, 4, 8, 16 spring-damping elements a flexible link; error against the limit
    steps     rk4, leapfrog, generalised_alpha, several steps; error against rk4 at 4.5 us, cost
    elements  geometrically exact spring-damping elements against linear ones
    crank     flexible crank against rigid one
    damping   eta = 0 ... 1e-4 s: loads, and derivatives of mean squares by D.delta_x at P2

Every program is compiled first (two at a time), then run alone: times of runs are CPU seconds of
one case undisturbed by compilation.  Files: one CSV a question, `results.json`, five pictures.
Units: N, N m, s; errors are relative; derivatives N^2/deg and (N m)^2/deg.
"""

import argparse
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from rfem_jax.compilation.options import take_process

take_process()

import jax  # noqa: E402

jax.config.update("jax_enable_x64", True)

import convergence_figures  # noqa: E402
import equinox as eqx  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402

from rfem_jax import STATUS, Method, assembly_errors, discretise, load_study, simulate  # noqa: E402
from rfem_jax.report.output import write_csv, write_json  # noqa: E402

CASES = ("P1", "P2", "P5")
SDES = (2, 4, 8, 16)
USUAL = ("generalised_alpha", 2.5e-4)  # its error is far below what the other questions are about
# A flexible crank has a tiny first rfe, which the drive turns at once: a smaller step is needed.
OF_FLEXIBLE_CRANK = ("generalised_alpha", 5e-5)
STEPS = (
    *(("generalised_alpha", h) for h in (2e-3, 1e-3, 5e-4, 2.5e-4)),
    *(("rk4", h) for h in (1.8e-5, 9e-6)),
    ("leapfrog", 3e-6),
)
REFERENCE = ("rk4", 4.5e-6)
DAMPINGS = (0.0, 1e-6, 1e-5, 1e-4)  # s
# Explicit methods need steps below 2e-6 s at eta = 1e-4 s: the implicit one alone does it.
SLOPES = (("rk4", 1.8e-5, 3), ("rk4", 9e-6, 3), (*USUAL, 4), (USUAL[0], USUAL[1] / 2.0, 4))
METRICS = {"rms_force": "N", "rms_moment": "Nm", "max_axial_force": "N", "max_normal_force": "N"}
SAVE_EVERY = 5e-3  # s; looking at a state costs as much as a step
DEGREE = np.pi / 180.0


class Program(NamedTuple):
    """A function and its arguments; `samples` simulations run in it."""

    function: object
    arguments: tuple
    samples: int


def loads_program(study, model, method) -> Program:
    """Metrics, preload and status of the cases, one batch."""

    @eqx.filter_jit
    def run(model, errors):
        def one(errors):
            run = simulate(
                model,
                errors,
                drive=study.drive,
                duration=study.duration,
                method=Method(method[0], step=method[1]),
                save_every=SAVE_EVERY,
            )
            return {name: getattr(run.metrics, name) for name in METRICS}, run.preload, run.status

        return jax.vmap(one)(errors)

    errors = [assembly_errors(model, study.case(name).errors) for name in CASES]
    errors = jax.tree.map(lambda *leaves: jnp.stack(leaves), *errors)
    return Program(run, (model, errors), len(CASES))


def slopes_program(study, model, method, dampings) -> Program:
    """Mean squares of P2 and their derivatives by D.delta_x [rad], for several eta."""
    tilt = study.case("P2").errors["D.delta_x"]

    @eqx.filter_jit
    def run(model, dampings):
        def one(damping):
            of_links = jnp.full_like(model.section.damping, damping)
            damped = eqx.tree_at(lambda m: m.section.damping, model, of_links)

            def squares(tilt):
                run = simulate(
                    damped,
                    assembly_errors(model, {"D.delta_x": tilt}),
                    drive=study.drive,
                    duration=study.duration,
                    method=Method(method[0], step=method[1]),
                    save_every=SAVE_EVERY,
                )
                m = run.metrics
                return (m.mean_square_force, m.mean_square_moment), run.status

            one = jnp.ones(())
            return jax.jvp(squares, (tilt * one,), (one,), has_aux=True)

        return jax.lax.map(one, dampings)

    return Program(run, (model, jnp.asarray(dampings)), len(dampings))


def programs_of(study) -> dict[tuple, Program]:
    """Everything that is simulated, by (question, what)."""
    usual = discretise(study.mechanism)
    links = [replace(link, rigid=False, rfes=5) for link in study.mechanism.links]
    flexible = discretise(replace(study.mechanism, links=links))
    exact = discretise(study.mechanism, elements="geometrically_exact")
    programs = {("rfes", m): loads_program(study, discretise(study.mechanism, rfes=m + 1), USUAL) for m in SDES}
    for method in (*STEPS, REFERENCE):
        if method != USUAL:
            programs["steps", *method] = loads_program(study, usual, method)
    programs["elements", "geometrically_exact"] = loads_program(study, exact, USUAL)
    programs["crank", "flexible"] = loads_program(study, flexible, OF_FLEXIBLE_CRANK)
    for name, step, count in SLOPES:
        program = slopes_program(study, usual, (name, step), DAMPINGS[:count])
        programs["damping", name, step] = program
    return programs


class Outcome(NamedTuple):
    """values: arrays with a leading axis of cases; seconds: CPU time of one case [s]."""

    values: object
    seconds: float


def compute(programs: dict, progress) -> dict[tuple, Outcome]:
    """Compile all programs, then run them; quick ones again, for their time."""
    outcomes, compiled = {}, {}
    with ThreadPoolExecutor(2) as pool:
        started = {
            key: pool.submit(lambda p: p.function.lower(*p.arguments).compile(), program)
            for key, program in programs.items()
        }
        for key, future in started.items():
            compiled[key] = future.result()
            progress(f"compiled {len(compiled)} of {len(programs)}: {_words(key)}")
    for key, program in programs.items():
        times = []
        while not times or (sum(times) < 1.0 and len(times) < 5):
            start = time.process_time()
            values = jax.block_until_ready(compiled[key](*program.arguments))
            times.append(time.process_time() - start)
        outcomes[key] = Outcome(jax.tree.map(np.asarray, values), min(times) / program.samples)
        progress(f"ran {len(outcomes)} of {len(programs)}: {_words(key)}, {sum(times):.1f} s CPU")
    return outcomes


def _words(key) -> str:
    return " ".join(str(part) for part in key)


def require_success(outcomes) -> None:
    """Stop if a simulation failed where the step is not the question."""
    for key, outcome in outcomes.items():
        if key[0] != "steps" and status_of(outcome) != "ok":
            raise SystemExit(f"{_words(key)}: {status_of(outcome)}; no tables were written.")


def status_of(outcome: Outcome) -> str:
    """Name of the worst status of a batch."""
    return STATUS[int(np.max(outcome.values[-1]))].name


def metric(outcome: Outcome, name: str, case: str, joint: str) -> float:
    """One number of a batch of cases."""
    return float(outcome.values[0][name][joint][CASES.index(case)])


def worst(outcome, limit, name, case, joints) -> float | None:
    """Largest relative difference over the joints to `limit` (joint -> value); None if it is 0."""
    if min(limit[joint] for joint in joints) < 1e-3:
        return None  # the perfect mechanism has no moments, but for rounding
    return max(abs(metric(outcome, name, case, j) / limit[j] - 1.0) for j in joints)


def rfes_table(outcomes, joints) -> list[dict]:
    """Loads against m, with errors against the limit by Richardson's extrapolation (order 2)."""
    rows = []
    fine, finest = (outcomes["rfes", m] for m in SDES[-2:])
    for case in CASES:
        for name, unit in METRICS.items():
            limit = {j: (4.0 * metric(finest, name, case, j) - metric(fine, name, case, j)) / 3.0 for j in joints}
            for m in SDES:
                outcome = outcomes["rfes", m]
                rows.append(
                    {
                        "case": case,
                        "metric": name,
                        "unit": unit,
                        "sdes": m,
                        "rfes": m + 1,
                        **{j: metric(outcome, name, case, j) for j in joints},
                        "largest_relative_error": worst(outcome, limit, name, case, joints),
                        "cpu_s_per_case": outcome.seconds,
                    }
                )
    return rows


def steps_table(outcomes, joints) -> list[dict]:
    """Loads against method and step, with errors against the reference, and cost."""
    rows = []
    reference = outcomes["steps", *REFERENCE]
    for method in (*STEPS, REFERENCE):
        outcome = outcomes["rfes", 4] if method == USUAL else outcomes["steps", *method]
        for case in CASES:
            for name, unit in METRICS.items():
                limit = {j: metric(reference, name, case, j) for j in joints}
                status = status_of(outcome)
                good = status == "ok"
                error = worst(outcome, limit, name, case, joints) if good else None
                rows.append(
                    {
                        "method": method[0],
                        "step_s": method[1],
                        "case": case,
                        "metric": name,
                        "unit": unit,
                        "status": status,
                        **{j: metric(outcome, name, case, j) if good else None for j in joints},
                        "largest_relative_error": None if method == REFERENCE else error,
                        "cpu_s_per_case": outcome.seconds,
                    }
                )
    return rows


def comparison_table(names, outcomes, joints) -> list[dict]:
    """Two variants side by side with their relative difference, joint by joint."""
    rows = []
    for case in CASES:
        for name, unit in {**METRICS, "preload_force": "N", "preload_moment": "Nm"}.items():
            for joint in joints:
                one, other = (_any_metric(outcome, name, case, joint) for outcome in outcomes)
                difference = other / one - 1.0 if one > 1e-3 else None
                rows.append(
                    {
                        "case": case,
                        "metric": name,
                        "unit": unit,
                        "joint": joint,
                        names[0]: one,
                        names[1]: other,
                        "relative_difference": difference,
                    }
                )
    return rows


def _any_metric(outcome, name, case, joint) -> float:
    if not name.startswith("preload"):
        return metric(outcome, name, case, joint)
    load = getattr(outcome.values[1][joint], name.removeprefix("preload_"))
    return float(np.linalg.norm(load[CASES.index(case)]))


def damping_table(outcomes, joints) -> list[dict]:
    """RMS loads of P2 and derivatives of mean squares by D.delta_x, by damping, method and step."""
    rows = []
    for name, step, count in SLOPES:
        values, slopes, _ = outcomes["damping", name, step].values
        for i, damping in enumerate(DAMPINGS[:count]):
            for kind, unit in enumerate(("N", "Nm")):
                for joint in joints:
                    rows.append(
                        {
                            "damping_s": damping,
                            "method": name,
                            "step_s": step,
                            "load": ("force", "moment")[kind],
                            "unit": unit,
                            "joint": joint,
                            "rms": float(np.sqrt(values[kind][joint][i])),
                            "slope_of_square_per_deg": float(slopes[kind][joint][i]) * DEGREE,
                        }
                    )
    return rows


def print_summary(tables) -> None:
    """What an engineer reads first."""
    print("\nRelative error of RMS loads (largest over the joints) against sdes a link")
    for case, name in (
        ("P1", "rms_force"),
        ("P2", "rms_force"),
        ("P2", "rms_moment"),
        ("P5", "rms_force"),
        ("P5", "rms_moment"),
    ):
        rows = [r for r in tables["rfes"] if r["case"] == case and r["metric"] == name]
        errors = [r["largest_relative_error"] for r in rows]
        order = np.log2(errors[0] / errors[1]), np.log2(errors[1] / errors[2])
        text = "  ".join(f"m={r['sdes']}: {e:.2e}" for r, e in zip(rows, errors))
        print(f"  {case} {name:<11}{text}  observed order {order[0]:.2f}, {order[1]:.2f}")
    print("\nRelative error of the loads (largest over the joints, P2 and P5) against the step")
    for method in STEPS:
        rows = [r for r in tables["steps"] if (r["method"], r["step_s"]) == method and r["case"] in ("P2", "P5")]
        text = rows[0]["status"]
        if text == "ok":
            errors = {n: max(r["largest_relative_error"] for r in rows if r["metric"] == n) for n in METRICS}
            text = "  ".join(f"{n} {e:.1e}" for n, e in errors.items())
        print(f"  {method[0]:<18}{method[1]:8.2g} s  {text}  {rows[0]['cpu_s_per_case']:.3f} s CPU")
    for title in ("elements", "crank"):
        print(f"\nLargest relative difference over the joints: {title}")
        for case in CASES:
            parts = []
            for name in dict.fromkeys(row["metric"] for row in tables[title]):
                found = [
                    row["relative_difference"]
                    for row in tables[title]
                    if row["metric"] == name and row["case"] == case and row["relative_difference"] is not None
                ]
                if found:
                    parts.append(f"{name} {max(found, key=abs):+.1e}")
            print(f"  {case} {'  '.join(parts)}")
    print_damping(tables["damping"])


def print_damping(rows) -> None:
    """Joint A in full; of all joints the largest change between the two steps of a method."""
    print("\nRMS loads of P2 in joint A, and slopes of their squares by D.delta_x, against damping")
    runs = dict.fromkeys((r["damping_s"], r["method"], r["step_s"]) for r in rows)
    for damping, method, step in sorted(runs):
        wanted = (damping, method, step, "A")
        force, moment = (r for r in rows if (r["damping_s"], r["method"], r["step_s"], r["joint"]) == wanted)
        print(
            f"  eta {damping:<7g}{method:<18}{step:8.3g} s  {force['rms']:.5f} N  "
            f"{force['slope_of_square_per_deg']:.2f} N^2/deg  {moment['rms']:.6f} N m  "
            f"{moment['slope_of_square_per_deg']:.4f} (N m)^2/deg"
        )
    print("\nLargest relative change of these over the joints when the step is halved")
    for damping, method in dict.fromkeys((d, m) for d, m, _ in sorted(runs)):
        parts = []
        for load in ("force", "moment"):
            for quantity in ("rms", "slope_of_square_per_deg"):
                own = [r for r in rows if (r["damping_s"], r["method"], r["load"]) == (damping, method, load)]
                half = len(own) // 2
                change = max(abs(b[quantity] / a[quantity] - 1.0) for a, b in zip(own[:half], own[half:]))
                parts.append(f"{load} {quantity.split('_')[0]} {change:.1e}")
        print(f"  eta {damping:<7g}{method:<18}{'  '.join(parts)}")


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, required=True, help="folder for tables and pictures")
    folder = parser.parse_args().out
    folder.mkdir(parents=True, exist_ok=True)
    start = time.monotonic()

    def progress(text):
        print(f"[{time.monotonic() - start:4.0f} s] {text}", file=sys.stderr, flush=True)

    study = load_study(Path(__file__).parents[1] / "four_bar" / "study.toml")
    study = replace(study, title="Steel four-bar", note="Substitute for the paper's lost data.")
    joints = sorted(joint.name for joint in study.mechanism.joints)
    outcomes = compute(programs_of(study), progress)
    require_success(outcomes)
    usual = outcomes["rfes", 4]
    tables = {
        "rfes": rfes_table(outcomes, joints),
        "steps": steps_table(outcomes, joints),
        "elements": comparison_table(
            ("linear", "geometrically_exact"),
            (usual, outcomes["elements", "geometrically_exact"]),
            joints,
        ),
        "crank": comparison_table(("rigid", "flexible"), (usual, outcomes["crank", "flexible"]), joints),
        "damping": damping_table(outcomes, joints),
    }
    for name, rows in tables.items():
        write_csv(folder / f"{name}.csv", rows)
    content = {"title": study.title, "note": study.note, "tables": tables}
    write_json(folder / "results.json", content)
    convergence_figures.write_figures(folder, study, tables)
    print_summary(tables)
    print(f"\nTables and pictures are in {folder} ({time.monotonic() - start:.0f} s).")


if __name__ == "__main__":
    main()
