"""The step that "auto" chooses by samples of the tolerances: how accurate other samples are, and what one takes.

    python benchmarks/automatic_steps.py [--accuracies 1e-2 1e-3] [--samples 64] [--batches 1 16 64] [--exudyn N]
                                         [--without avx512]
    python benchmarks/automatic_steps.py --batches 4096 65536 --exudyn 8        where JAX finds a GPU

On the shipped Monte Carlo study.  "auto" sees the first eight samples, errors are those of others: the largest
relative deviation of the RMS force and moment of all joints from our own converged result (`--fine`, and half of it,
extrapolated).  Times are those of the processor, on a GPU those of the clock, static starts included, compilation not;
medians of five runs: of a batch as it is called now and then, and of one that is called thousands of times, within a
`jax.jit` that was compiled with care (`kernels.expecting`).  Exudyn (extra `bench`), with its fastest settings, takes
for N of these samples the longest of `--exudyn-steps` with which none is farther than the accuracy from its own result
with steps of `--exudyn-fine`: its elements are geometrically exact, the study's are linear, and what this changes is no
error of a step.
`--without`: beginnings of the names of features that the processor is taken not to have.
"""

import argparse
import os
import statistics
import time
from pathlib import Path

os.environ.setdefault("XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1")

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402

from rfem_jax import (  # noqa: E402
    Automatic,
    GeneralisedAlpha,
    Method,
    Problem,
    Simulation,
    Tolerances,
    discretise,
    first_samples,
    load_study,
)
from rfem_jax.kernels import expecting, machine_code  # noqa: E402

STUDY = load_study(Path(__file__).parents[1] / "studies" / "monte_carlo" / "study.toml")
TOLERANCES = Tolerances.of(STUDY)
REPEATS = 5
MANY = 10_000  # runs of what is compiled with care


def problem_with(model, method: Method, duration: float, trials=None) -> Problem:
    """The study's mechanism with all RMS loads as metrics."""
    metrics = [f"{joint}.{kind}" for kind in ("rms_force", "rms_moment") for joint in model.joint_names]
    return Problem(
        Simulation(
            model,
            drive=STUDY.drive,
            duration=duration,
            method=method,
            save_every=min(STUDY.save_every, duration),
            trials=trials,
        ),
        metrics,
    )


def loads(problem: Problem, samples: dict) -> np.ndarray:
    """RMS loads (samples, loads) [N, N m]."""
    values, status = jax.vmap(problem)(samples)
    assert not np.asarray(status).any()
    return np.stack([np.asarray(values[metric.name]) for metric in problem.metrics], axis=1)


def errors_of(found: np.ndarray, exact: np.ndarray) -> np.ndarray:
    """The largest relative deviation (samples,) of any load."""
    return np.max(np.abs(found / exact - 1.0), axis=1)


def time_of(function) -> float:
    """Median of the processor's time, on another device of the clock's [s], after a first run."""
    now = time.process_time if jax.default_backend() == "cpu" else time.perf_counter
    function()
    times = []
    for _ in range(REPEATS):
        started = now()
        function()
        times.append(now() - started)
    return statistics.median(times)


def times_of(problem: Problem, samples: dict, batch: int) -> tuple[float, float]:
    """Time of a sample [ms] in a batch that is called now and then, and in one that is called thousands of times."""
    some = {name: jnp.resize(values, batch) for name, values in samples.items()}
    often = jax.jit(jax.vmap(problem))
    seldom = time_of(lambda: jax.block_until_ready(jax.vmap(problem)(some)))
    with expecting(MANY):
        jax.block_until_ready(often(some))
    return 1e3 * seldom / batch, 1e3 * time_of(lambda: jax.block_until_ready(often(some))) / batch


def exudyn(samples: dict, accuracies, options) -> dict[float, tuple[float, float, float]]:
    """{accuracy: step, the largest error, processor time of a sample [s]}."""
    from exudyn_first_answer import drive_pieces, rms_of

    model, drive, found = discretise(STUDY.mechanism), drive_pieces(STUDY.drive, options.duration), {}

    def rows(step: float) -> np.ndarray:
        errors = ({name: float(values[i]) for name, values in samples.items()} for i in range(options.exudyn))
        return np.array([rms_of(model, one, step, drive).ravel() for one in errors])

    exact = rows(options.exudyn_fine)
    for step in sorted(options.exudyn_steps, reverse=True):
        started = time.process_time()
        of_step = rows(step)
        each = (time.process_time() - started) / options.exudyn
        worst = errors_of(of_step, exact).max()
        print(f"Exudyn, step {1e3 * step:g} ms: largest error {worst:.1e}, {1e3 * each:.3g} ms a sample")
        for accuracy in accuracies:
            if worst <= accuracy and accuracy not in found:
                found[accuracy] = step, worst, each
        if len(found) == len(accuracies):
            break
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--accuracies", type=float, nargs="+", default=[1e-2, 1e-3])
    parser.add_argument("--samples", type=int, default=64)
    parser.add_argument("--batches", type=int, nargs="+", default=[1, 16, 64])
    parser.add_argument("--duration", type=float, default=STUDY.duration, help="s")
    parser.add_argument("--fine", type=float, default=5e-5, help="s, step of the converged result")
    parser.add_argument("--exudyn", type=int, default=0, help="samples of Exudyn")
    parser.add_argument("--exudyn-steps", type=float, nargs="+", default=[5e-3, 2.5e-3, 2e-3, 1e-3, 5e-4], help="s")
    parser.add_argument("--exudyn-fine", type=float, default=5e-5, help="s, step of its converged result")
    parser.add_argument("--without", nargs="+", default=[], help="beginnings of features of the processor")
    options = parser.parse_args()
    if options.without:
        machine_code.leave_out_features(*options.without)
    model, others = discretise(STUDY.mechanism), first_samples(TOLERANCES, jax.random.key(2), options.samples)
    coarse, fine = (
        loads(
            problem_with(model, GeneralisedAlpha(step=step, tolerance=1e-6), options.duration),
            others,
        )
        for step in (options.fine, options.fine / 2)
    )
    exact = fine + (fine - coarse) / 3.0
    print(f"Converged result: half the step changes loads by {errors_of(coarse, fine).max():.1e} at most.")
    peer = exudyn(others, options.accuracies, options) if options.exudyn else {}
    print(f"Device: {jax.devices()[0].device_kind}")
    print("| RMS loads within | step ms | median and largest error of others | ms a sample in batches of "
          f"{', '.join(map(str, options.batches))} | called often | Exudyn ms (step, error), over ours |")  # fmt: skip
    print("|---|---|---|---|---|---|")
    trials = first_samples(TOLERANCES, jax.random.key(1))
    for accuracy in options.accuracies:
        problem = problem_with(model, Automatic(accuracy=accuracy), options.duration, trials)
        found = errors_of(loads(problem, others), exact)
        times = [times_of(problem, others, batch) for batch in options.batches]
        beside = "-"
        if accuracy in peer:
            step, worst, each = peer[accuracy]
            over = ", ".join(f"{1e3 * each / often:.3g}" for _, often in times)
            beside = f"{1e3 * each:.3g} ({1e3 * step:g} ms, {worst:.1e}), {over}"
        seldom, often = (", ".join(f"{one:.3g}" for one in column) for column in zip(*times))
        print(f"| {accuracy:g} | {1e3 * problem.method.step:.3g} | {np.median(found):.1e}, {found.max():.1e} | "
              f"{seldom} | {often} | {beside} |")  # fmt: skip


if __name__ == "__main__":
    main()
