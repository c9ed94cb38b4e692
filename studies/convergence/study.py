"""How many rfes, which step, which elements, how much damping: what the joint loads depend on.

    python studies/convergence/study.py --out results/convergence [--questions rfes steps ...] [--quick]

The main study's four-bar (studies/four_bar/study.toml, a substitute for the paper's lost data),
cases P1, P2 and P5, changed in one respect at a time:

    rfes      m = 2, 4, 8, 16 spring-damping elements a flexible link; error against the limit
    steps     rk4, leapfrog, generalised_alpha, several steps; error against rk4 at 4.5 us, cost
    elements  geometrically exact spring-damping elements against linear ones
    crank     flexible crank against rigid one
    damping   eta = 0 ... 1e-4 s: loads, and derivatives of mean squares by D.delta_x at P2

Every simulation is compiled first (two at a time), then run alone: times of runs are CPU seconds of one case
undisturbed by compilation.  Files: one CSV and one picture a question, `results.json`.  Units: N, N m, s; errors are
relative; derivatives N^2/deg and (N m)^2/deg.  `--quick` computes the first 10 ms with few rfes and steps: it shows
what the command makes, its numbers mean nothing.
"""

import argparse
import itertools
import sys
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import jax

jax.config.update("jax_enable_x64", True)

import convergence_figures  # noqa: E402
import equinox as eqx  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402

from rfem_jax import (  # noqa: E402
    STATUS,
    AssemblyErrors,
    Model,
    Run,
    Simulation,
    Study,
    assembly_errors,
    discretise,
    load_study,
    simulate,
)
from rfem_jax.description.methods import named_method  # noqa: E402
from rfem_jax.report.contents.output import write_csv, write_json  # noqa: E402

CASES = ("P1", "P2", "P5")
QUESTIONS = ("rfes", "steps", "elements", "crank", "damping")


class Plan(NamedTuple):
    """What is simulated; methods are pairs (name, step [s]).

    duration [s]; save_every [s]; sdes a flexible link, the study's 4 among them; usual method; that of the flexible
    crank; methods of the question `steps`, and their reference; dampings [s]; derivatives: methods, each with the
    number of dampings that it takes.
    """

    duration: float
    save_every: float
    sdes: tuple[int, ...]
    usual: tuple[str, float]
    of_flexible_crank: tuple[str, float]
    steps: tuple[tuple[str, float], ...]
    reference: tuple[str, float]
    dampings: tuple[float, ...]
    derivatives: tuple[tuple[str, float, int], ...]


IMPLICIT = "generalised_alpha"
FULL = Plan(
    duration=0.5,
    save_every=5e-3,  # to record a state costs as much as a step
    sdes=(2, 4, 8, 16),
    usual=(IMPLICIT, 2.5e-4),  # its error is far below the differences that the other questions are about
    # A flexible crank has a tiny first rfe, which the drive accelerates at once: it needs a smaller step.
    of_flexible_crank=(IMPLICIT, 5e-5),
    steps=(
        *((IMPLICIT, h) for h in (2e-3, 1e-3, 5e-4, 2.5e-4)),
        *(("rk4", h) for h in (1.8e-5, 9e-6)),
        ("leapfrog", 3e-6),
    ),
    reference=("rk4", 4.5e-6),
    dampings=(0.0, 1e-6, 1e-5, 1e-4),
    # Explicit methods need steps below 2e-6 s at eta = 1e-4 s: the implicit one alone takes it.
    derivatives=(("rk4", 1.8e-5, 3), ("rk4", 9e-6, 3), (IMPLICIT, 2.5e-4, 4), (IMPLICIT, 1.25e-4, 4)),
)
QUICK = Plan(
    duration=0.01,
    save_every=5e-3,
    sdes=(2, 4),
    usual=(IMPLICIT, 2.5e-3),
    of_flexible_crank=(IMPLICIT, 1.25e-4),
    steps=((IMPLICIT, 2.5e-3),),
    reference=(IMPLICIT, 1.25e-3),
    dampings=(0.0, 1e-5),
    derivatives=((IMPLICIT, 2.5e-3, 2),),
)
METRICS = {"rms_force": "N", "rms_moment": "N m", "max_axial_force": "N", "max_normal_force": "N"}
DEGREE = np.pi / 180.0


class Program(NamedTuple):
    """A function and its arguments; `samples` simulations run in it."""

    function: Any
    arguments: tuple
    samples: int


def run_of(study: Study, model: Model, errors: AssemblyErrors, method: tuple[str, float], plan: Plan) -> Run:
    """One simulation of the plan."""
    return simulate(
        Simulation(
            model,
            drive=study.drive,
            duration=plan.duration,
            method=named_method(method[0], step=method[1]),
            save_every=plan.save_every,
        ),
        errors,
    )


def loads_program(study: Study, model: Model, method: tuple[str, float], plan: Plan) -> Program:
    """Metrics, preload and status of the cases, one batch."""

    @eqx.filter_jit
    def run(model, errors):
        def one(errors):
            run = run_of(study, model, errors, method, plan)
            return {name: getattr(run.metrics, name) for name in METRICS}, run.preload, run.status

        return jax.vmap(one)(errors)

    errors = [assembly_errors(model, study.case(name).errors) for name in CASES]
    errors = jax.tree.map(lambda *leaves: jnp.stack(leaves), *errors)
    return Program(run, (model, errors), len(CASES))


def derivatives_program(study: Study, model: Model, method: tuple[str, float], dampings, plan: Plan) -> Program:
    """Mean squares of P2 and their derivatives by D.delta_x [1/rad], for several eta [s]."""
    tilt = study.case("P2").errors["D.delta_x"]

    @eqx.filter_jit
    def run(model, dampings):
        def one(damping):
            of_links = jnp.full_like(model.section.damping, damping)
            damped = eqx.tree_at(lambda m: m.section.damping, model, of_links)

            def squares(tilt):
                run = run_of(study, damped, assembly_errors(model, {"D.delta_x": tilt}), method, plan)
                m = run.metrics
                return (m.mean_square_force, m.mean_square_moment), run.status

            one = jnp.ones(())
            return jax.jvp(squares, (tilt * one,), (one,), has_aux=True)

        return jax.lax.map(one, dampings)

    return Program(run, (model, jnp.asarray(dampings)), len(dampings))


def programs_of(study: Study, plan: Plan, questions: Sequence[str]) -> dict[tuple, Program]:
    """Everything that is simulated for some questions, by (question, variant).

    ("rfes", 4) is the study itself by the usual method, with which other questions compare.
    """
    usual = discretise(study.mechanism)
    programs = {}
    for m in plan.sdes if "rfes" in questions else (4,):
        programs["rfes", m] = loads_program(study, discretise(study.mechanism, rfes=m + 1), plan.usual, plan)
    if "steps" in questions:
        for method in (*plan.steps, plan.reference):
            if method != plan.usual:
                programs["steps", *method] = loads_program(study, usual, method, plan)
    if "elements" in questions:
        exact = discretise(study.mechanism, elements="geometrically_exact")
        programs["elements", "geometrically_exact"] = loads_program(study, exact, plan.usual, plan)
    if "crank" in questions:
        links = tuple(replace(link, rigid=False, rfes=5) for link in study.mechanism.links)
        flexible = discretise(replace(study.mechanism, links=links))
        programs["crank", "flexible"] = loads_program(study, flexible, plan.of_flexible_crank, plan)
    if "damping" in questions:
        for name, step, count in plan.derivatives:
            dampings = plan.dampings[:count]
            programs["damping", name, step] = derivatives_program(study, usual, (name, step), dampings, plan)
    if set(questions) == {"damping"}:
        del programs["rfes", 4]
    return programs


class Outcome(NamedTuple):
    """values: arrays with a leading axis of cases; seconds: CPU time of one case [s]."""

    values: Any
    seconds: float


def compiled_function(program: Program, is_trial: bool) -> Callable:
    """Its function, compiled: that of a trial by a first call, which takes no time and which tests can answer."""
    if is_trial:
        jax.block_until_ready(program.function(*program.arguments))
        return program.function
    return program.function.lower(*program.arguments).compile()


def compute(programs: dict[tuple, Program], is_trial: bool, progress: Callable[[str], None]) -> dict[tuple, Outcome]:
    """Compile all programs, then run them; short ones several times, for their time."""
    outcomes, compiled = {}, {}
    with ThreadPoolExecutor(2) as pool:
        started = {key: pool.submit(compiled_function, program, is_trial) for key, program in programs.items()}
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


def require_success(outcomes: dict[tuple, Outcome]) -> None:
    """Stop if a simulation failed, unless the step is the question."""
    for key, outcome in outcomes.items():
        if key[0] != "steps" and status_of(outcome) != "ok":
            raise SystemExit(f"{_words(key)}: {status_of(outcome)}; no tables were written.")


def status_of(outcome: Outcome) -> str:
    """Name of the worst status of a batch."""
    return STATUS[int(np.max(outcome.values[-1]))].name


def metric(outcome: Outcome, name: str, case: str, joint: str) -> float:
    """One number of a batch of cases."""
    return float(outcome.values[0][name][joint][CASES.index(case)])


def worst(outcome: Outcome, limit: dict[str, float], name: str, case: str, joints: Sequence[str]) -> float | None:
    """Largest relative difference over the joints to `limit` (joint -> value); None where that is zero."""
    if min(limit[joint] for joint in joints) < 1e-3:
        return None  # moments of the perfect mechanism are rounding
    return max(abs(metric(outcome, name, case, j) / limit[j] - 1.0) for j in joints)


def rfes_table(outcomes: dict[tuple, Outcome], joints: Sequence[str], plan: Plan) -> list[dict]:
    """Loads against m, with errors against the limit by Richardson's extrapolation (order 2)."""
    rows = []
    fine, finest = (outcomes["rfes", m] for m in plan.sdes[-2:])
    for case in CASES:
        for name, unit in METRICS.items():
            limit = {j: (4.0 * metric(finest, name, case, j) - metric(fine, name, case, j)) / 3.0 for j in joints}
            for m in plan.sdes:
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


def steps_table(outcomes: dict[tuple, Outcome], joints: Sequence[str], plan: Plan) -> list[dict]:
    """Loads against method and step, with errors against the reference, and cost."""
    rows = []
    reference = outcomes["steps", *plan.reference]
    for method in (*plan.steps, plan.reference):
        outcome = outcomes["rfes", 4] if method == plan.usual else outcomes["steps", *method]
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
                        "largest_relative_error": None if method == plan.reference else error,
                        "cpu_s_per_case": outcome.seconds,
                    }
                )
    return rows


def comparison_table(names: Sequence[str], outcomes: Sequence[Outcome], joints: Sequence[str]) -> list[dict]:
    """Two variants side by side with their relative difference, joint by joint."""
    rows = []
    for case in CASES:
        for name, unit in {**METRICS, "preload_force": "N", "preload_moment": "N m"}.items():
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


def damping_table(outcomes: dict[tuple, Outcome], joints: Sequence[str], plan: Plan) -> list[dict]:
    """RMS loads of P2 and derivatives of mean squares by D.delta_x, by damping, method and step."""
    rows = []
    for name, step, count in plan.derivatives:
        values, derivatives, _ = outcomes["damping", name, step].values
        for i, damping in enumerate(plan.dampings[:count]):
            for kind, (unit, square) in enumerate((("N", "N^2"), ("N m", "(N m)^2"))):
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
                            "derivative_of_square": float(derivatives[kind][joint][i]) * DEGREE,
                            "derivative_of_square_unit": f"{square}/deg",
                        }
                    )
    return rows


def print_summary(tables: dict[str, list[dict]], plan: Plan) -> None:
    """The main results of the questions that were computed."""
    if "rfes" in tables:
        print_rfes(tables["rfes"])
    if "steps" in tables:
        print_steps(tables["steps"], plan)
    for title in ("elements", "crank"):
        if title in tables:
            print_differences(title, tables[title])
    if "damping" in tables:
        print_damping(tables["damping"])


def print_rfes(rows: list[dict]) -> None:
    """Errors against m, and the observed order."""
    print("\nRelative error of RMS loads (largest over the joints) against sdes a link")
    for case, name in (
        ("P1", "rms_force"),
        ("P2", "rms_force"),
        ("P2", "rms_moment"),
        ("P5", "rms_force"),
        ("P5", "rms_moment"),
    ):
        own = [r for r in rows if r["case"] == case and r["metric"] == name]
        errors = [r["largest_relative_error"] for r in own]
        # The last error is that of the extrapolation itself.
        orders = ", ".join(f"{np.log2(a / b):.2f}" for a, b in itertools.pairwise(errors[:-1]))
        text = "  ".join(f"m={r['sdes']}: {e:.2e}" for r, e in zip(own, errors))
        print(f"  {case} {name:<11}{text}  observed order {orders or '-'}")


def print_steps(rows: list[dict], plan: Plan) -> None:
    """Errors and cost of every method and step."""
    print("\nRelative error of the loads (largest over the joints, P2 and P5) against the step")
    for method in plan.steps:
        own = [r for r in rows if (r["method"], r["step_s"]) == method and r["case"] in ("P2", "P5")]
        text = own[0]["status"]
        if text == "ok":
            errors = {n: max(r["largest_relative_error"] for r in own if r["metric"] == n) for n in METRICS}
            text = "  ".join(f"{n} {e:.1e}" for n, e in errors.items())
        print(f"  {method[0]:<18}{method[1]:8.2g} s  {text}  {own[0]['cpu_s_per_case']:.3f} s CPU")


def print_differences(title: str, rows: list[dict]) -> None:
    """Differences of two variants by case and load."""
    print(f"\nLargest relative difference over the joints: {title}")
    for case in CASES:
        parts = []
        for name in dict.fromkeys(row["metric"] for row in rows):
            own = [row["relative_difference"] for row in rows if row["metric"] == name and row["case"] == case]
            found = [difference for difference in own if difference is not None]
            if found:
                parts.append(f"{name} {max(found, key=abs):+.1e}")
        print(f"  {case} {'  '.join(parts)}")


def print_damping(rows: list[dict]) -> None:
    """Joint A in full; of all joints the largest change between the two steps of a method."""
    print("\nRMS loads of P2 in joint A, and derivatives of their squares by D.delta_x, against damping")
    runs = dict.fromkeys((r["damping_s"], r["method"], r["step_s"]) for r in rows)
    for damping, method, step in sorted(runs):
        wanted = (damping, method, step, "A")
        force, moment = (r for r in rows if (r["damping_s"], r["method"], r["step_s"], r["joint"]) == wanted)
        print(
            f"  eta {damping:<7g}{method:<18}{step:8.3g} s  {force['rms']:.5f} N  "
            f"{force['derivative_of_square']:.2f} N^2/deg  {moment['rms']:.6f} N m  "
            f"{moment['derivative_of_square']:.4f} (N m)^2/deg"
        )
    pairs = [(damping, method) for damping, method, _ in sorted(runs)]
    halved = [pair for pair in dict.fromkeys(pairs) if pairs.count(pair) == 2]
    if halved:
        print("\nLargest relative change of these over the joints when the step is halved")
    for damping, method in halved:
        parts = []
        for load in ("force", "moment"):
            for quantity in ("rms", "derivative_of_square"):
                own = [r for r in rows if (r["damping_s"], r["method"], r["load"]) == (damping, method, load)]
                half = len(own) // 2
                change = max(abs(b[quantity] / a[quantity] - 1.0) for a, b in zip(own[:half], own[half:]))
                parts.append(f"{load} {quantity.split('_')[0]} {change:.1e}")
        print(f"  eta {damping:<7g}{method:<18}{'  '.join(parts)}")


def tables_of(outcomes: dict[tuple, Outcome], joints: Sequence[str], plan: Plan, questions: Sequence[str]) -> dict:
    """One table a question."""
    usual, tables = outcomes.get(("rfes", 4)), {}
    if "rfes" in questions:
        tables["rfes"] = rfes_table(outcomes, joints, plan)
    if "steps" in questions:
        tables["steps"] = steps_table(outcomes, joints, plan)
    for question, names in (("elements", ("linear", "geometrically_exact")), ("crank", ("rigid", "flexible"))):
        if question in questions:
            tables[question] = comparison_table(names, (usual, outcomes[question, names[1]]), joints)
    if "damping" in questions:
        tables["damping"] = damping_table(outcomes, joints, plan)
    return tables


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, required=True, help="folder for tables and pictures")
    parser.add_argument("--questions", nargs="+", choices=QUESTIONS, default=QUESTIONS, help="all by default")
    parser.add_argument("--quick", action="store_true", help="the first 10 ms, few rfes and steps: only a trial")
    options = parser.parse_args()
    folder, plan = options.out, QUICK if options.quick else FULL
    folder.mkdir(parents=True, exist_ok=True)
    start = time.monotonic()

    def progress(text):
        print(f"[{time.monotonic() - start:4.0f} s] {text}", file=sys.stderr, flush=True)

    study = load_study(Path(__file__).parents[1] / "four_bar" / "study.toml")
    note = "Substitute for the paper's lost data." + (" A trial (--quick)." if options.quick else "")
    study = replace(study, title="Steel four-bar", note=note)
    joints = sorted(joint.name for joint in study.mechanism.joints)
    outcomes = compute(programs_of(study, plan, options.questions), options.quick, progress)
    require_success(outcomes)
    tables = tables_of(outcomes, joints, plan, options.questions)
    for name, rows in tables.items():
        write_csv(folder / f"{name}.csv", rows)
    write_json(folder / "results.json", {"title": study.title, "note": study.note, "tables": tables})
    convergence_figures.write_figures(folder, study, tables)
    print_summary(tables, plan)
    print(f"\nTables and pictures are in {folder} ({time.monotonic() - start:.0f} s).")


if __name__ == "__main__":
    main()
