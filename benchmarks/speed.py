"""How fast the simulator is at a wanted accuracy, beside the peer and a naive version.

    python benchmarks/speed.py [--quick | --trial] [--parts methods table peer dense devices scaling]
                               [--cases P5] [--batches 1 8 16 32 64] [--platforms cpu] [--out DIR]
                               [--sweeps rfes links batch errors]

    methods   the fastest settings of generalised-alpha whose RMS loads are within 1 % and 0.1 %
    table     cases x methods x batches x platforms: build, lowering (tracing, and the machine code of the
              kernels), compilation by XLA, first and steady run apart, accuracy, memory
    peer      Exudyn at the same accuracy on the same processor
    dense     a naive dense right-hand side beside the recursive one
    devices   a batch on one CPU device and divided between two
    scaling   time against rfes, links, batch and number of errors in a gradient, with pictures

The study four-bar, 0.5 s, errors of a case scaled sample by sample (1 to 0.2).  CPU times are those of the processor,
one thread: other programs disturb them less than the clock's.  Error: largest relative deviation of the RMS force and
moment of all joints from the converged result.  Settings are judged by the case itself, as the peer's are; a step
counts only if the next smaller one is as accurate, and if the residual of every step is so small that the run's
status is ok.  `--trial` simulates 25 ms with 2 rfes and few samples: it shows that the command works, its numbers mean
nothing.
"""

import argparse
import itertools
import json
import os
import platform
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import speed_scaling
from jax.sharding import Mesh, PartitionSpec
from speed_timing import (
    FULL,
    INTERVAL,
    STUDY,
    TRIAL,
    Size,
    converged,
    error_of,
    run_once,
    sample_errors,
    simulation,
    stepping,
    timed,
)

from rfem_jax import GeneralisedAlpha, Method, discretise
from rfem_jax.description.methods import named_method
from rfem_jax.kernels import is_available, kernel
from rfem_jax.mechanics.dynamics.dynamics import accelerations
from rfem_jax.mechanics.dynamics.loads import static_state
from rfem_jax.mechanics.model.errors import assembly_errors
from rfem_jax.mechanics.model.inputs import DriveInput, Stabilisation
from rfem_jax.mechanics.model.model import State
from rfem_jax.mechanics.model.with_errors import apply_errors, with_structural_zeros
from rfem_jax.mechanics.reference.formulation import reference_accelerations
from rfem_jax.simulation.outcome.run import RESIDUAL_LIMIT

ACCURACIES = (1e-2, 1e-3)
EXPLICIT_STEP = 1e-5  # s; in batches times for 0.5 s are by proportion
CPP_RIGHT_HAND_SIDE = 58e-9  # s a sample and core, hand-written C++, AVX-512, another machine


class Found(NamedTuple):
    """A setting of generalised-alpha: method, error of the case, processor s a sample, largest residual of a step
    over the largest joint force."""

    method: Method
    error: float
    seconds: float
    residual: float


def search_settings(model, case: str, reference, options) -> dict[float, Found]:
    """The fastest setting within every accuracy whose runs have the status ok."""
    rows = []
    samples = options.size.samples
    print(f"\nSettings of generalised_alpha, batch of {samples}: error of the case, of all, residual, CPU ms a sample")
    for tolerance in options.tolerances:
        for radius in options.radii:
            first = GeneralisedAlpha(step=INTERVAL, tolerance=tolerance, spectral_radius=radius)
            rows.append(_search_steps(model, case, reference, first, options.size))
    best = {}
    for accuracy in ACCURACIES:
        good = [
            one for found in rows for one, finer in itertools.pairwise(found) if max(one.error, finer.error) <= accuracy
        ]
        converged_ones = [one for one in good if one.residual < RESIDUAL_LIMIT]
        for label, chosen in (("", good), (", status ok", converged_ones)):
            if chosen:
                one = min(chosen, key=lambda found: found.seconds)
                print(f"Fastest within {accuracy:g}{label}: {_label(one.method)}, {1e3 * one.seconds:.2f} ms")
        if converged_ones:
            best[accuracy] = min(converged_ones, key=lambda found: found.seconds)
        else:
            print(f"No step within {accuracy:g} has the status ok; the default settings are used.")
    return best


def _search_steps(model, case, reference, first: Method, size: Size) -> list[Found]:
    """Shorter and shorter steps until two in a row reach the finest accuracy."""
    loads = stepping(model, case, size.samples, first, size.duration)
    loads(size.steps[0])
    found: list[Found] = []
    for steps in size.steps:
        runs = [run_once(loads, steps) for _ in range(3)]
        result, residual = (np.asarray(x) for x in runs[0][0])
        seconds = min(run[2] for run in runs) / size.samples
        method = replace(first, step=INTERVAL / steps)
        one = Found(method, error_of(result[:1], reference), seconds, float(residual))
        print(
            f"  {_label(method):<52}{one.error:>10.1e}{error_of(result, reference):>10.1e}"
            f"{one.residual:>10.1e}{1e3 * seconds:>9.2f}",
            flush=True,
        )
        found.append(one)
        finest = len(found) > 1 and max(found[-2].error, one.error) <= ACCURACIES[-1]
        if finest and found[-2].residual < RESIDUAL_LIMIT:
            break
    return found


def _label(method: Method) -> str:
    text = f"{method.name} {1e3 * method.step:.4g} ms"
    if method.implicit:
        text += f", tolerance {method.tolerance:g}, radius {method.spectral_radius:g}"
    return text


def measure_table(model, case: str, methods, reference, options) -> list[dict]:
    """Every method at every batch size on every platform."""
    print(
        f"\n{case}, one device{'':<33}{'batch':>6}{'lower s':>8}{'compile':>8}{'first':>7}"
        f"{'steady s':>9}{'CPU ms a sample (least, most)':>31}{'error':>9}{'of all':>9}{'MB':>7}"
    )
    rows = []
    for name in options.platforms:
        for method in methods:
            for batch in options.batches:
                rows.append(_measure_row(model, case, method, batch, reference, name, options.size))
    return rows


def _measure_row(model, case, method: Method, batch: int, reference, name: str, size: Size) -> dict:
    # Explicit methods in a batch run a part of the duration; alone they run all of it, for the error.
    whole = method.implicit or batch == 1
    duration = size.duration if whole else size.explicit_duration
    with jax.default_device(jax.devices(name)[0]):
        errors = sample_errors(case, batch)
        run = jax.vmap(simulation(model, method, duration=duration))
        timing = timed(run, errors, repeats=min(size.repeats, 5 if method.implicit else 3))
    share = 1e3 * STUDY.duration / duration / batch
    # On an accelerator, for which the processor waits, the time is the clock's.
    seconds = (timing.cpu, timing.least, timing.most) if name == "cpu" else (timing.clock,) * 3
    row = {
        "case": case,
        "platform": name,
        "method": _label(method),
        "batch": batch,
        "lowering_s": timing.lowering,
        "compilation_s": timing.compilation,
        "first_s": timing.first,
        "steady_s": timing.clock,
        "ms_a_sample": share * seconds[0],
        "spread_ms": [share * s for s in seconds[1:]],
        "memory_mb": timing.memory / 1e6,
        "error": error_of(timing.result[:1], reference) if whole else None,
        "error_of_all": error_of(timing.result, reference) if whole else None,
    }
    errors_shown = "".join(f"{row[key]:>9.1e}" if whole else f"{'-':>9}" for key in ("error", "error_of_all"))
    print(
        f"{name + ' ' + row['method']:<48}{batch:>6}{timing.lowering:>8.1f}"
        f"{timing.compilation:>8.1f}{timing.first:>7.2f}{timing.clock:>9.3f}"
        f"{row['ms_a_sample']:>14.2f} ({row['spread_ms'][0]:>6.2f}, {row['spread_ms'][1]:>6.2f})"
        f"{errors_shown}{row['memory_mb']:>7.2f}",
        flush=True,
    )
    return row


def compare_with_peer(case: str, best: dict[float, Found], rows: list[dict], options) -> None:
    """Processor seconds of Exudyn's fastest run over ours, at equal accuracy."""
    try:
        import exudyn_speed
    except SystemExit as missing:
        print(f"\nNo comparison with the peer: {missing}")
        return
    search = exudyn_speed.TRIAL if options.trial else exudyn_speed.FULL
    print("\nAgainst Exudyn at the same accuracy, CPU time of one thread (ours with the static start)")
    for accuracy, found in best.items():
        peer = exudyn_speed.best(case, accuracy, search)
        own = {
            row["batch"]: row["ms_a_sample"]
            for row in rows
            if row["method"] == _label(found.method) and row["platform"] == "cpu"
        }
        if np.isfinite(found.seconds):
            own.setdefault(options.size.samples, 1e3 * found.seconds)
        print(
            f"  within {accuracy:g}: Exudyn {1e3 * peer.cpu:.1f} ms (step "
            f"{1e3 * peer.step:g} ms, error {peer.error:.1e}); ours, error {found.error:.1e}:"
        )
        for batch, milliseconds in sorted(own.items()):
            print(
                f"    batch {batch:>4}: {milliseconds:7.2f} ms a sample, ratio {1e3 * peer.cpu / milliseconds:6.2f}",
                flush=True,
            )


def compare_with_dense(model, case: str, best: dict[float, Found], size: Size) -> None:
    """One right-hand side, recursive and dense, and what 0.5 s of Runge-Kutta 4 cost with them."""
    batch = size.samples
    mechanisms = jax.vmap(lambda values: apply_errors(model, assembly_errors(model, values)))(
        sample_errors(case, batch)
    )
    state = static_state(model.topology, model.start_coordinates())
    states = jax.tree.map(lambda x: jnp.stack([x + 1e-9 * i for i in range(batch)]), state)
    gains = Stabilisation(jnp.asarray(1.0), jnp.asarray(1.0), jnp.asarray(0.3))

    def recursive(actual, state):
        return accelerations(with_structural_zeros(actual), state, DriveInput(), gains).coordinates

    def dense(actual, state):
        return reference_accelerations(actual, state, DriveInput(), gains)[0]

    # The recursive one is a kernel with its loop, as in a simulation; the dense one is compiled by XLA.
    functions = {
        "recursive": kernel(_repeated(recursive, size.evaluations), name="right-hand sides"),
        "naive dense": _repeated(dense, size.evaluations),
    }
    evaluations = 4 * STUDY.duration / EXPLICIT_STEP
    print(f"\nOne right-hand side in a batch of {batch}, CPU; 0.5 s by Runge-Kutta 4 at {1e6 * EXPLICIT_STEP:g} us")
    for label, function in functions.items():
        timing = timed(jax.vmap(function), mechanisms, states, repeats=size.repeats)
        one = timing.cpu / size.evaluations / batch
        text = f"  {label:<12}{1e6 * one:9.2f} us a sample, {evaluations * one:8.2f} s a simulation"
        known = {a: f for a, f in best.items() if np.isfinite(f.seconds)}
        for accuracy, found in known.items() if label == "naive dense" else ():
            text += f", {evaluations * one / found.seconds:7.0f} times ours within {accuracy:g}"
        if label == "recursive":
            text += f"; over the C++ limit (58 ns, elsewhere): {one / CPP_RIGHT_HAND_SIDE:.0f}"
        print(text, flush=True)


def _repeated(function, evaluations: int):
    """Many evaluations in one program, each of which needs the one before."""

    def run(actual, state):
        def evaluate(state, _):
            answer = function(actual, state)
            moved = jax.tree.map(lambda q, a: q + 1e-18 * a, state.position, answer)
            return State(moved, state.velocity), None

        return jax.lax.scan(evaluate, state, length=evaluations)[0]

    return run


def compare_devices(model, case: str, method: Method, size: Size) -> None:
    """A batch on one device, and in equal parts on two."""
    batch = 2 * size.samples
    print(f"\nDevices, {_label(method)}, batch {batch}: clock s, CPU s, ms a sample by the clock")
    for count in size.devices:
        devices = jax.devices("cpu")[:count]
        if len(devices) < count:
            print(f"  {count} CPU devices: only {len(devices)} here.")
            return
        mesh, across = Mesh(devices, ("samples",)), PartitionSpec("samples")
        run = jax.shard_map(
            jax.vmap(simulation(model, method, duration=size.duration)),
            mesh=mesh,
            in_specs=across,
            out_specs=across,
            check_vma=False,
        )
        placed = jax.NamedSharding(mesh, across)
        timing = timed(run, jax.device_put(sample_errors(case, batch), placed), repeats=size.repeats)
        one = 1e3 * timing.clock / batch
        print(f"  {count} CPU: {timing.clock:.3f} {timing.cpu:.3f} {one:.2f}", flush=True)


def defaults() -> dict[float, Found]:
    """Settings that a search has found, for parts that run without one."""
    settings = {1e-2: (6.25e-3, 0.4), 1e-3: (2.5e-3, 0.6)}
    return {
        accuracy: Found(
            GeneralisedAlpha(step=step, tolerance=accuracy, spectral_radius=radius),
            *3 * (np.nan,),
        )
        for accuracy, (step, radius) in settings.items()
    }


def parse_options():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parts = ("methods", "table", "peer", "dense", "devices", "scaling")
    parser.add_argument("--parts", nargs="+", choices=parts, default=list(parts))
    parser.add_argument("--quick", action="store_true", help="a subset, about 3 minutes")
    parser.add_argument("--trial", action="store_true", help="25 ms, 2 rfes, few samples: numbers mean nothing")
    parser.add_argument("--cases", nargs="+", default=["P5"])
    parser.add_argument("--batches", type=int, nargs="+")
    parser.add_argument("--tolerances", type=float, nargs="+")
    parser.add_argument("--radii", type=float, nargs="+")
    parser.add_argument("--explicit", nargs="*", default=["rk4", "leapfrog"])
    parser.add_argument(
        "--sweeps", nargs="+", default=list(speed_scaling.SWEEP_NAMES), choices=speed_scaling.SWEEP_NAMES
    )
    parser.add_argument("--platforms", nargs="+", default=["cpu"], help="JAX platforms: cpu, gpu")
    parser.add_argument("--out", type=Path, default=Path("benchmark_results"))
    # Read by speed_timing, before JAX starts.
    options = parser.parse_args()
    quick, options.size = options.quick or options.trial, TRIAL if options.trial else FULL
    options.batches = options.batches or ([1, 16] if quick else [1, 8, 16, 32, 64])
    options.tolerances = options.tolerances or list(ACCURACIES)
    options.radii = options.radii or ([0.6] if quick else [0.4, 0.6, 0.8])
    if quick:
        options.explicit = options.explicit[:1]
    if options.trial:
        # The tolerance of the converged result, so that one program serves both.
        options.batches, options.explicit, options.tolerances = [options.size.samples], [], [1e-8]
    return options


def main() -> None:
    options = parse_options()
    options.out.mkdir(parents=True, exist_ok=True)
    size = options.size
    model, build, _ = run_once(lambda: discretise(STUDY.mechanism, rfes=size.rfes))
    print(
        f"{platform.processor() or platform.machine()}, {jax.devices()[0].device_kind}, "
        f"JAX {jax.__version__}, XLA_FLAGS {os.environ['XLA_FLAGS']}, "
        f"kernels {'of machine code' if is_available() else 'compiled by XLA'}\n"
        f"Building the model: {build:.2f} s"
    )
    explicit = [named_method(name, step=EXPLICIT_STEP) for name in options.explicit]
    rows: list[dict] = []
    for case in options.cases:
        best = defaults()
        if {"methods", "table"} & set(options.parts):
            reference = converged(model, case, size.converged, size.samples, size.duration)
        if "methods" in options.parts:
            best = {**best, **search_settings(model, case, reference, options)}
        if "table" in options.parts:
            found = list(best.values())[:1] if options.trial else best.values()
            methods = [*dict.fromkeys(one.method for one in found), *explicit]
            rows += measure_table(model, case, methods, reference, options)
        if "peer" in options.parts:
            compare_with_peer(case, best, [row for row in rows if row["case"] == case], options)
        if "dense" in options.parts:
            compare_with_dense(model, case, best, size)
        if "devices" in options.parts:
            compare_devices(model, case, best[ACCURACIES[0]].method, size)
    (options.out / "speed.json").write_text(json.dumps(rows, indent=1))
    if "scaling" in options.parts:
        speed_scaling.draw(options.out, options.size is TRIAL, options.quick, options.sweeps)


if __name__ == "__main__":
    main()
