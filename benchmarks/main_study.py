"""Time of the main study, compilation apart: the five cases as one batch, and batches of more.

    python benchmarks/main_study.py [--samples 1 5 64] [--duration 0.02] [--rfes 5] [--repeats 101]

Prints build, lowering (with the machine code of the kernels), compilation by XLA, first and steady run; time a step
and sample; and, on the same inputs, one right-hand side of the recursive formulation, a kernel, against the dense
reference formulation.  Medians of repeated runs, each until its results are there.
"""

import argparse
import platform
import statistics
import time
from pathlib import Path

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp  # noqa: E402

from rfem_jax import Simulation, assembly_errors, discretise, load_study, simulate  # noqa: E402
from rfem_jax.kernels import kernel  # noqa: E402
from rfem_jax.mechanics.dynamics.dynamics import accelerations  # noqa: E402
from rfem_jax.mechanics.dynamics.loads import static_state  # noqa: E402
from rfem_jax.mechanics.model.inputs import DriveInput, Stabilisation  # noqa: E402
from rfem_jax.mechanics.model.with_errors import apply_errors, with_structural_zeros  # noqa: E402
from rfem_jax.mechanics.reference.formulation import reference_accelerations  # noqa: E402

STUDY = Path(__file__).parents[1] / "studies" / "four_bar" / "study.toml"


def timed(function, *arguments):
    """Result and seconds of one call, until the result is there."""
    start = time.perf_counter()
    result = jax.block_until_ready(function(*arguments))
    return result, time.perf_counter() - start


def median_time(function, *arguments, repeats=7):
    """Median seconds of a compiled call."""
    return statistics.median(timed(function, *arguments)[1] for _ in range(repeats))


def measure(study, model, samples: int, duration: float) -> None:
    """One row: a batch of samples of the study's last case, each with its own errors."""
    errors = assembly_errors(model, study.cases[-1].errors)
    scales = jnp.linspace(0.2, 1.0, samples)
    batch = jax.vmap(lambda scale: jax.tree.map(lambda x: scale * x, errors))(scales)

    def run(errors):
        return simulate(
            Simulation(model, drive=study.drive, duration=duration, method=study.method, save_every=study.save_every),
            errors,
        ).metrics

    start = time.perf_counter()
    lowered = jax.jit(jax.vmap(run)).lower(batch)
    lowering = time.perf_counter() - start
    start = time.perf_counter()
    compiled = lowered.compile()
    compiling = time.perf_counter() - start
    _, first = timed(compiled, batch)
    steady = median_time(compiled, batch, repeats=3)
    steps = duration / study.method.step
    print(
        f"{samples:8d}{lowering:12.2f}{compiling:12.2f}{first:12.2f}{steady:12.2f}"
        f"{1e6 * steady / steps / samples:22.2f}{0.5 / duration * steady / samples:22.2f}"
    )


def compare_formulations(model, repeats: int) -> None:
    """One right-hand side, recursive against dense, alone."""
    actual = jax.jit(apply_errors)(model, assembly_errors(model))
    state = static_state(model.topology, model.start_coordinates())
    gains = Stabilisation(1.0, 1.0, 0.3)

    def fast(actual, state):
        return accelerations(with_structural_zeros(actual), state, DriveInput(), gains).coordinates

    def dense(actual, state):
        return reference_accelerations(actual, state, DriveInput(), gains)[0]

    times = [median_time(jax.jit(f), actual, state, repeats=repeats) for f in (kernel(fast), dense)]
    print(
        f"One right-hand side: recursive {1e6 * times[0]:.0f} us, dense {1e6 * times[1]:.0f} us, "
        f"ratio {times[1] / times[0]:.1f}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--samples", type=int, nargs="+", default=[1, 5, 64])
    parser.add_argument("--duration", type=float, default=0.02, help="simulated seconds")
    parser.add_argument("--rfes", type=int, default=5, help="of a flexible link")
    parser.add_argument("--repeats", type=int, default=101, help="of one right-hand side")
    options = parser.parse_args()
    study = load_study(STUDY)
    model, build = timed(lambda: discretise(study.mechanism, rfes=options.rfes))
    print(
        f"{platform.processor() or platform.machine()}, {jax.devices()[0].device_kind}, "
        f"JAX {jax.__version__}; {study.method.name}, step {study.method.step:g} s"
    )
    print(f"Building the model: {build:.2f} s")
    print(
        f"{'samples':>8}{'lower s':>12}{'compile s':>12}{'first s':>12}{'steady s':>12}"
        f"{'us a step and sample':>22}{'s a sample of 0.5 s':>22}"
    )
    for samples in options.samples:
        measure(study, model, samples, options.duration)
    compare_formulations(model, options.repeats)


if __name__ == "__main__":
    main()
