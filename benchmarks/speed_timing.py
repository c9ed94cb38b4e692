"""Compiled programs timed part by part, and the accuracy of what they compute.

    study, errors -> program -> timed -> Timing;   RMS loads, converged ones -> error

Importing it sets JAX up for the benchmarks: float64, one thread a device for what XLA compiles (so that the time of
the processor is the program's, whatever else runs), two CPU devices.  Times in s, memory in bytes.
"""

import os
import statistics
import time
from pathlib import Path
from typing import Any, NamedTuple

FLAGS = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"
os.environ.setdefault("XLA_FLAGS", FLAGS)
# SciPy's LAPACK keeps its threads spinning after a call: they would count as ours.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# XLA's pool must be larger than the number of devices that run at once.
os.environ.setdefault("NPROC", "4")

import jax  # noqa: E402

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_num_cpu_devices", 2)

import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
from jax import Array  # noqa: E402

from rfem_jax import GeneralisedAlpha, Method, Simulation, assembly_errors, load_study, simulate  # noqa: E402
from rfem_jax.simulation.accuracy import loads_of_trials  # noqa: E402
from rfem_jax.simulation.stages.integration import grid_for, prepare_batch  # noqa: E402
from rfem_jax.simulation.stages.stepping import Integration  # noqa: E402

STUDY = load_study(Path(__file__).parents[1] / "studies" / "four_bar" / "study.toml")
INTERVAL = 25e-3  # s between observations: they cost little
SCALES = np.linspace(1.0, 0.2, 16)  # of a case's errors, sample by sample, over and over
SMALLEST_LOAD = 1e-6  # N, N m: smaller RMS loads are zero and have no relative error


class Size(NamedTuple):
    """How much is computed: rfes of a flexible link; simulated duration [s], a multiple of `INTERVAL`, and that of
    explicit methods in a batch; steps in an interval that are searched, and those of the converged result; samples of
    the batch by which settings are compared; evaluations of a right-hand side; timed runs; numbers of CPU devices."""

    rfes: int
    duration: float
    explicit_duration: float
    steps: tuple[int, ...]
    converged: int
    samples: int
    evaluations: int
    repeats: int
    devices: tuple[int, ...]


FULL = Size(5, 0.5, 5e-3, (4, 5, 6, 7, 8, 10, 12, 15, 18, 20, 25, 33, 50), 500, 16, 200, 5, (1, 2))
TRIAL = Size(2, 0.025, 2e-4, (4, 5), 8, 2, 2, 1, (2,))


class Timing(NamedTuple):
    """One program: lowering (with the machine code of its kernels), compilation by XLA, first run by the clock; steady:
    medians of clock and processor time, the least and the most processor time; memory of intermediates; its result."""

    lowering: float
    compilation: float
    first: float
    clock: float
    cpu: float
    least: float
    most: float
    memory: int
    result: Any


def run_once(function, *arguments) -> tuple[Any, float, float]:
    """Result; clock and processor time [s] until it is there."""
    clock, cpu = time.perf_counter(), time.process_time()
    result = jax.block_until_ready(function(*arguments))
    return result, time.perf_counter() - clock, time.process_time() - cpu


def timed(function, *arguments, repeats: int = 5) -> Timing:
    """Lower, compile and run a function of arrays."""
    traced, lowering, _ = run_once(lambda: jax.jit(function).lower(*arguments))
    compiled, compilation, _ = run_once(traced.compile)
    result, first, _ = run_once(compiled, *arguments)
    runs = [run_once(compiled, *arguments)[1:] for _ in range(repeats)]
    clocks, cpus = zip(*runs)
    return Timing(
        lowering,
        compilation,
        first,
        statistics.median(clocks),
        statistics.median(cpus),
        min(cpus),
        max(cpus),
        compiled.memory_analysis().temp_size_in_bytes,
        result,
    )


def sample_errors(case: str, count: int) -> dict[str, Array]:
    """Errors {name: values (count,)} of a case of the main study scaled sample by sample; the first is
    the case itself."""
    named = {c.name: c.errors for c in STUDY.cases}[case]
    scales = jnp.asarray(np.resize(SCALES, count))
    return {name: scales * value for name, value in named.items()}


def simulation(model, method: Method, drive=STUDY.drive, duration=STUDY.duration):
    """Errors {name: value} -> RMS loads (2, joints) of one sample."""

    def run(errors) -> Array:
        metrics = simulate(
            Simulation(model, drive=drive, duration=duration, method=method, save_every=min(INTERVAL, duration)),
            assembly_errors(model, errors),
        ).metrics
        kinds = (metrics.rms_force, metrics.rms_moment)
        return jnp.stack([jnp.stack([kind[name] for name in model.joint_names]) for kind in kinds])

    return run


def stepping(model, case: str, count: int, method: Method, duration=STUDY.duration):
    """Steps an interval -> RMS loads (samples, 2, joints) and the largest residual of a step over the largest joint
    force, by one program for all steps."""
    errors = jax.vmap(lambda one: assembly_errors(model, one))(sample_errors(case, count))
    grid, _ = grid_for(STUDY.drive, duration, method, INTERVAL)

    def loads(steps: int):
        count = jnp.asarray(steps, jnp.float64)
        whole = Integration(model, STUDY.drive, grid, method, count)
        found, residual, *_ = loads_of_trials(whole, *prepare_batch(whole, errors))
        return found, jnp.max(residual)

    return loads


def converged(model, case: str, steps: int = 500, samples: int = len(SCALES), duration=STUDY.duration) -> np.ndarray:
    """RMS loads of the samples by generalised-alpha, extrapolated from steps of twice `INTERVAL` / steps and of that
    (with 500: 50 us) by its order 2."""
    method = GeneralisedAlpha(step=INTERVAL)
    loads = stepping(model, case, samples, method, duration)
    coarse, fine = (np.asarray(loads(n)[0]) for n in (steps // 2, steps))
    return fine + (fine - coarse) / 3.0


def error_of(loads, reference: np.ndarray) -> float:
    """Largest relative deviation of RMS loads (samples, 2, joints) that are not zero."""
    loads = np.asarray(loads)
    reference = reference[np.arange(len(loads)) % len(reference)]
    if not np.isfinite(loads).all():
        return np.inf
    loaded = np.abs(reference) > SMALLEST_LOAD
    return float(np.max(np.abs(loads[loaded] / reference[loaded] - 1.0)))
