"""Cost of derivatives, as ratios to one simulation in the same run, and memory.

    python benchmarks/gradients.py [--methods generalised_alpha rk4] [--counts 3 30] [--batches 1 16]
                                   [--tolerance 1e-3]

For 3 errors (joint D) and 30 (both sides of all joints), alone and in a batch: the value, forward mode
(`jacfwd` of the mean-square moments of all joints) and reverse mode (`grad` of one).  The implicit
method runs the whole 0.5 s of the main study with steps of 2 ms, Runge-Kutta 4 its first 10 ms.  Times are
those of the processor (one thread, so that other programs do not count), the least of several runs,
compilation apart; memory is what the compiler reserves for intermediates.
"""

import argparse
import os
import time
from pathlib import Path

os.environ.setdefault(
    "XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"
)

# SciPy's LAPACK keeps its threads spinning after a call: they would count as ours.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import jax  # noqa: E402

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp  # noqa: E402
from rfem_jax import Method, Problem, discretise, largest_stable_step, load_study  # noqa: E402

STUDY = Path(__file__).parents[1] / "studies" / "four_bar" / "study.toml"
METRICS = tuple(f"{joint}.mean_square_moment" for joint in "ABCD")
FIRST = ("D.delta_x", "D.delta_z", "D.d_y")


def build_problem(method: str, rfes: int, tolerance: float) -> Problem:
    """The main study by one method."""
    study = load_study(STUDY)
    model = discretise(study.mechanism, rfes=rfes)
    if method == "generalised_alpha":
        chosen = Method(method, step=2e-3, tolerance=tolerance)
        return Problem(model, study.drive, 0.5, METRICS, chosen, save_every=2e-2)
    chosen = Method(method, step=0.9 * largest_stable_step(model, Method(method, step=1e-6)))
    return Problem(model, study.drive, 0.01, METRICS, chosen, save_every=1e-3)


def chosen_errors(problem: Problem, count: int) -> tuple[str, ...]:
    """The first `count` errors: those of joint D first, then seats and bores of all joints."""
    sides = [n for n in problem.error_names if "pin" not in n and n not in FIRST]
    return (*FIRST, *sides)[:count]


def measure(label: str, function, points, base: float | None, repeats: int) -> float:
    """One row; returns the least processor time [s] of a run."""
    start = time.perf_counter()
    compiled = jax.jit(jax.vmap(function) if len(points) > 1 else lambda x: function(x[0]))
    compiled = compiled.lower(points).compile()
    compiling = time.perf_counter() - start
    jax.block_until_ready(compiled(points))
    times = []
    for _ in range(repeats):
        start = time.process_time()
        jax.block_until_ready(compiled(points))
        times.append(time.process_time() - start)
    least = min(times)
    ratio = 1.0 if base is None else least / base
    memory = compiled.memory_analysis().temp_size_in_bytes / 1e6 / len(points)
    print(
        f"{label:<44}{compiling:>10.1f}{1e3 * least / len(points):>14.2f}{ratio:>8.2f}{memory:>20.2f}",
        flush=True,
    )
    return least


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--methods", nargs="+", default=["generalised_alpha", "rk4"])
    parser.add_argument("--counts", nargs="+", type=int, default=[3, 30])
    parser.add_argument("--batches", nargs="+", type=int, default=[1, 16])
    parser.add_argument("--rfes", type=int, default=5)
    parser.add_argument("--tolerance", type=float, default=1e-3, help="of the implicit method")
    parser.add_argument("--repeats", type=int, default=5)
    options = parser.parse_args()
    header = ("compile s", "ms a sample", "ratio", "MB a sample")
    print(f"{'':<44}{header[0]:>10}{header[1]:>14}{header[2]:>8}{header[3]:>20}")
    for method in options.methods:
        problem = build_problem(method, options.rfes, options.tolerance)
        for batch in options.batches:
            base = None
            for count in options.counts:
                names = chosen_errors(problem, count)

                def values(point, names=names, problem=problem):
                    return problem(dict(zip(names, point)))[0]

                spread = jnp.linspace(0.5, 1.5, batch)[:, None]
                points = 1e-4 * spread * jnp.ones((1, count))
                label = f"{method}, batch {batch}"
                if base is None:
                    base = measure(f"{label}, value", values, points, None, options.repeats)
                label = f"{label}, {count} errors"
                measure(f"{label}, forward", jax.jacfwd(values), points, base, options.repeats)
                one = jax.grad(lambda p, values=values: values(p)[METRICS[0]])
                measure(f"{label}, reverse", one, points, base, options.repeats)


if __name__ == "__main__":
    main()
