"""Cost of derivatives, as ratios to one simulation in the same run, and memory.

    python benchmarks/gradients.py [--rfes 5] [--duration 0.01]

For 3 errors (joint D) and 30 (both sides of all joints): value, forward mode (`jacfwd` of all metrics) and
reverse mode (`grad` of one).  Medians of repeated runs, compilation apart; memory is what the compiler
reserves for intermediates.
"""

import argparse
import statistics
import time
from pathlib import Path

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp  # noqa: E402
from rfem_jax import Method, Problem, discretise, largest_stable_step, load_study  # noqa: E402

STUDY = Path(__file__).parents[1] / "studies" / "four_bar" / "study.toml"
METRICS = tuple(f"{joint}.mean_square_moment" for joint in "ABCD")


def chosen_errors(model, count: int) -> tuple[str, ...]:
    """The first `count` errors: those of joint D first, then seats and bores of all joints."""
    first = ("D.delta_x", "D.delta_z", "D.d_y")
    sides = [n for n in model.topology.error_names if "pin" not in n and "." in n and n not in first]
    return (*first, *sides)[:count]


def measure(label: str, function, point, base: float | None, repeats: int) -> float:
    """One row; returns the median seconds of a run."""
    start = time.perf_counter()
    compiled = jax.jit(function).lower(point).compile()
    compiling = time.perf_counter() - start
    jax.block_until_ready(compiled(point))
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        jax.block_until_ready(compiled(point))
        times.append(time.perf_counter() - start)
    median = statistics.median(times)
    memory = compiled.memory_analysis().temp_size_in_bytes / 1e6
    ratio = 1.0 if base is None else median / base
    print(f"{label:<28}{compiling:>12.1f}{median:>10.3f}{ratio:>8.2f}{memory:>12.2f}", flush=True)
    return median


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rfes", type=int, default=5)
    parser.add_argument("--duration", type=float, default=0.01, help="simulated seconds")
    parser.add_argument("--repeats", type=int, default=5)
    options = parser.parse_args()
    study = load_study(STUDY)
    model = discretise(study.mechanism, rfes=options.rfes)
    step = 0.9 * largest_stable_step(model, Method("rk4", step=1e-6))
    problem = Problem(
        model, study.drive, options.duration, METRICS, Method("rk4", step=step), save_every=1e-3
    )
    print(f"{'':<28}{'compile s':>12}{'run s':>10}{'ratio':>8}{'memory MB':>12}")
    for count in (3, 30):
        names = chosen_errors(model, count)

        def values(point, names=names):
            return problem(dict(zip(names, point)))[0]

        point = jnp.full(count, 1e-4)
        base = measure(f"{count} errors, value", values, point, None, options.repeats)
        measure(f"{count} errors, forward", jax.jacfwd(values), point, base, options.repeats)
        one = jax.grad(lambda p: values(p)[METRICS[0]])
        measure(f"{count} errors, reverse", one, point, base, options.repeats)


if __name__ == "__main__":
    main()
