"""Cost of derivatives, as ratios to one simulation in the same run, and memory.

    python benchmarks/gradients.py [--methods generalised_alpha rk4] [--counts 3 30] [--batches 1 16]
                                   [--parameters 10] [--tolerance 1e-3] [--parts cost accuracy] [--share 1]
                                   [--study FILE] [--runs N] ...

cost: for 3 errors (joint D) and 30 (both sides of all joints), alone and in a batch: the value, forward mode
(`jacfwd` of the mean-square moments of all joints) and reverse mode (`grad` of one); with `--parameters` last of all
for so many parameters of the description, one of every kind first, with the 3 errors.  The implicit
method runs the whole 0.5 s of the main study with steps of 2 ms, Runge-Kutta 4 its first 10 ms.  Times are
those of the processor (one thread, so that other programs do not count), on a GPU those of the clock; the least of
several runs, compilation apart; memory is what the compiler reserves for intermediates.  `--runs`: everything is
compiled for so many runs (`kernels.expecting`); without it as for a single one.

accuracy: derivatives of all mean squares at tolerances from loose to tight, against those at a tolerance
of 1e-11; the errors of five kinds at 0.05 to 3 times their sizes.  Differences are relative to the
largest influence on the same metric in the same sample (derivative times size).

`--share` simulates a share of these durations; `--study` takes another study file, whose errors are then in the order
of the model.
"""

import argparse
import os
import time
from pathlib import Path

os.environ.setdefault("XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1")

# SciPy's LAPACK keeps its threads spinning after a call: they would count as ours.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402

from rfem_jax import GeneralisedAlpha, Problem, Simulation, discretise, largest_stable_step, load_study  # noqa: E402
from rfem_jax.description.methods import named_method  # noqa: E402
from rfem_jax.kernels import expecting  # noqa: E402
from rfem_jax.simulation.solvers.generalised_alpha import GeneralisedAlphaSolver  # noqa: E402

STUDY = Path(__file__).parents[1] / "studies" / "four_bar" / "study.toml"
FIRST = ("D.delta_x", "D.delta_z", "D.d_y")
PARAMETERS = (
    *("bar.height", "bar.width", "steel.youngs_modulus", "steel.density", "D.position.x", "A.angle"),
    *("gravity.z", "steel.damping", "D.position.z", "D.child_position.x", "bar.shear_factor", "steel.poisson_ratio"),
)
KINDS = {"D.delta_x": 2e-3, "D.delta_z": -1.5e-3, "D.d_y": 5e-4, "B.child.delta_x": 1e-3, "coupler.length": 5e-4}
SIZES = {"delta_x": 2e-3, "delta_z": -1.5e-3, "d_y": 5e-4}  # of other studies
SCALES, TIGHT = (0.05, 0.5, 1.0, 3.0), 1e-11


def build_problem(options, method: str) -> Problem:
    """The study, or a share of its duration, by one method."""
    study = load_study(options.study)
    model = discretise(study.mechanism, rfes=options.rfes)
    metrics = tuple(f"{joint}.mean_square_moment" for joint in sorted(model.joint_names))
    if method == "generalised_alpha":
        chosen, duration = named_method(method, step=2e-3, tolerance=options.tolerance), 0.5 * options.share
        return Problem(
            Simulation(model, drive=study.drive, duration=duration, method=chosen, save_every=min(2e-2, duration)),
            metrics,
        )
    chosen = named_method(method, step=0.9 * largest_stable_step(model, named_method(method, step=1e-6)))
    duration = 0.01 * options.share
    return Problem(
        Simulation(model, drive=study.drive, duration=duration, method=chosen, save_every=min(1e-3, duration)), metrics
    )


def chosen_errors(problem: Problem, count: int) -> tuple[str, ...]:
    """The first `count` errors: those of joint D first, then seats and bores of all joints."""
    first = tuple(name for name in FIRST if name in problem.error_names)
    others = [n for n in problem.error_names if "pin" not in n and n not in FIRST]
    return (*first, *others)[:count]


def chosen_parameters(problem: Problem, count: int) -> tuple[str, ...]:
    """So many parameters: those of `PARAMETERS` first, and the first three errors."""
    known = [name for name in problem.error_names if name not in problem.model.topology.error_names]
    first = [name for name in PARAMETERS if name in known]
    return (*first, *(name for name in known if name not in first))[:count] + chosen_errors(problem, 3)


def measure(label: str, function, points, base: float | None, repeats: int, runs: int) -> float:
    """One row, of what is compiled for so many runs; returns the least time [s] of a run, of the processor or, on a
    GPU, of the clock."""
    clock = time.process_time if jax.default_backend() == "cpu" else time.perf_counter
    start = time.perf_counter()
    compiled = jax.jit(jax.vmap(function) if len(points) > 1 else lambda x: function(x[0]))
    with expecting(runs):
        compiled = compiled.lower(points).compile()
    compiling = time.perf_counter() - start
    jax.block_until_ready(compiled(points))
    times = []
    for _ in range(repeats):
        start = clock()
        jax.block_until_ready(compiled(points))
        times.append(clock() - start)
    least = min(times)
    ratio = 1.0 if base is None else least / base
    memory = compiled.memory_analysis().temp_size_in_bytes / 1e6 / len(points)
    print(
        f"{label:<44}{compiling:>10.1f}{1e3 * least / len(points):>14.2f}{ratio:>8.2f}{memory:>20.2f}",
        flush=True,
    )
    return least


def influences(options, step: float, tolerance: float) -> np.ndarray:
    """Derivatives times the errors' sizes (samples, metrics, errors)."""
    study = load_study(options.study)
    model = discretise(study.mechanism, rfes=options.rfes)
    method = GeneralisedAlpha(step=step, tolerance=tolerance, corrections=12)
    metrics = tuple(f"{j}.mean_square_{kind}" for j in sorted(model.joint_names) for kind in ("force", "moment"))
    duration = 0.5 * options.share
    problem = Problem(
        Simulation(model, drive=study.drive, duration=duration, method=method, save_every=min(2.5e-2, duration)),
        metrics,
    )
    sizes = KINDS
    if not set(KINDS) <= set(problem.error_names):
        joint = sorted(model.joint_names)[-1]
        sizes = {f"{joint}.{kind}": size for kind, size in SIZES.items()}

    def values(factors):
        point = factors * jnp.asarray(list(sizes.values()))
        return jnp.stack(list(problem(dict(zip(sizes, point)))[0].values()))

    factors = jnp.asarray(SCALES)[:, None] * jnp.ones((1, len(sizes)))
    return np.asarray(jax.jit(jax.vmap(jax.jacfwd(values)))(factors))


def measure_accuracy(options) -> None:
    """One row for every step and tolerance."""
    print(f"\n{'step ms':>8}{'tolerance':>11}{'increments':>12}    difference, errors at {SCALES} times")
    for step in options.steps:
        exact = influences(options, step, TIGHT)
        scale = np.abs(exact).max(axis=2, keepdims=True)
        for tolerance in options.tolerances:
            method = GeneralisedAlpha(step=step, tolerance=tolerance)
            found = influences(options, step, tolerance)
            off = np.abs((found - exact) / scale).max(axis=(1, 2))
            shown = "".join(f"{one:>10.1e}" for one in off)
            count = GeneralisedAlphaSolver(method).tangent_increments
            print(f"{1e3 * step:>8g}{tolerance:>11g}{count:>12}    {shown}", flush=True)


def measure_cost(options) -> None:
    """One row for every method, batch, number of errors and mode."""
    header = ("compile s", "ms a sample", "ratio", "MB a sample")
    print(f"{'':<44}{header[0]:>10}{header[1]:>14}{header[2]:>8}{header[3]:>20}")
    for method in options.methods:
        problem = build_problem(options, method)
        for batch in options.batches:
            base = None
            asked = [(f"{count} errors", chosen_errors(problem, count)) for count in options.counts]
            if options.parameters:
                asked.append((f"{options.parameters} parameters", chosen_parameters(problem, options.parameters)))
            for what, names in asked:

                def values(point, names=names, problem=problem):
                    return problem(dict(zip(names, point)))[0]

                spread = jnp.linspace(0.5, 1.5, batch)[:, None]
                points = 1e-4 * spread * jnp.ones((1, len(names)))
                label = f"{method}, batch {batch}"
                if base is None:
                    base = measure(f"{label}, value", values, points, None, options.repeats, options.runs)
                label = f"{label}, {what}"
                if "forward" in options.modes:
                    measure(f"{label}, forward", jax.jacfwd(values), points, base, options.repeats, options.runs)
                metric = problem.metrics[0].name
                one = jax.grad(lambda p, values=values, metric=metric: values(p)[metric])
                if "reverse" in options.modes:
                    measure(f"{label}, reverse", one, points, base, options.repeats, options.runs)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parts = ("cost", "accuracy")
    parser.add_argument("--parts", nargs="+", choices=parts, default=list(parts))
    parser.add_argument("--methods", nargs="+", default=["generalised_alpha", "rk4"])
    parser.add_argument("--counts", nargs="+", type=int, default=[3, 30])
    parser.add_argument("--parameters", type=int, default=0, help="of the description, with the first three errors")
    parser.add_argument("--batches", nargs="+", type=int, default=[1, 16])
    parser.add_argument("--rfes", type=int, default=5)
    parser.add_argument("--tolerance", type=float, default=1e-3, help="of the implicit method")
    parser.add_argument("--modes", nargs="+", choices=("forward", "reverse"), default=["forward", "reverse"])
    parser.add_argument("--steps", nargs="+", type=float, default=[2.5e-3, 5e-3], help="s, of the part accuracy")
    tolerances = [1e-3, 1e-4, 1e-5, 1e-6]
    parser.add_argument("--tolerances", nargs="+", type=float, default=tolerances, help="of the part accuracy")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--runs", type=int, default=1, help="for which everything is compiled")
    parser.add_argument("--study", type=Path, default=STUDY, help="file; the main study by default")
    parser.add_argument("--share", type=float, default=1.0, help="of the durations that are simulated")
    options = parser.parse_args()
    if "cost" in options.parts:
        measure_cost(options)
    if "accuracy" in options.parts:
        measure_accuracy(options)


if __name__ == "__main__":
    main()
