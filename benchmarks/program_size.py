"""What XLA is given, and what it makes of it: programs of the main study's loads and of their gradient.

    python benchmarks/program_size.py [--folders FOLDER ...] [--gradient [MODE]] [--batch N] [--kept]

For every checkout of the project (default: this one) a process of its own: equations of the traced program, inner ones
included; processor time to trace and lower it and to compile it; shortest run of 30.  RMS loads with errors at joint D,
by Runge-Kutta 4 with the study's step and by generalised alpha with 2.5 ms; `--gradient`: instead the derivative of the
sum of all mean-square forces by these errors, in `reverse` (default) or `forward` mode; `--batch`: of N samples at
once, whose errors are from half to one and a half times as large; `--kept`: compiled as programs that are kept for the
next process (`jax.vmap` and `jax.jacfwd` of a `Problem`), not as in a `jax.jit` of the user.  What was compiled before
is not used.
"""

import argparse
import os
import subprocess
import sys
import time
from contextlib import nullcontext
from pathlib import Path

HERE = Path(__file__).resolve()
RUNS = 30
CASES = (("rk4", 1e-5, 0.02), ("generalised_alpha", 2.5e-3, 0.2))  # step, duration [s]
GRADIENT = (("generalised_alpha", 2.5e-3, 0.05),)
ERRORS = {"D.delta_x": 8.7e-3, "D.delta_z": 1e-3, "D.d_y": 1e-4}


def count_equations(jaxpr) -> int:
    """Equations of a jaxpr and of all that it contains."""
    total = 0
    for equation in jaxpr.eqns:
        total += 1
        for value in equation.params.values():
            for part in value if isinstance(value, list | tuple) else [value]:
                part = getattr(part, "jaxpr", part)
                total += count_equations(part) if hasattr(part, "eqns") else 0
    return total


def measure(folder: Path, gradient: str | None, batch: int | None, kept: bool) -> None:
    """Print a line for every program of the checkout that is imported here."""
    import jax

    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_enable_compilation_cache", False)
    import jax.numpy as jnp

    from rfem_jax import Method, assembly_errors, discretise, load_study, simulate
    from rfem_jax.compilation import options

    study = load_study(folder / "studies" / "four_bar" / "study.toml")
    model = discretise(study.mechanism)
    for name, step, duration in GRADIENT if gradient else CASES:

        def metrics(values, name=name, step=step, duration=duration):
            errors = assembly_errors(model, values)
            method = Method(name, step=step)
            run = simulate(
                model, errors, drive=study.drive, duration=duration, method=method, save_every=0.25 * duration
            )
            return run.metrics

        def rms(values, metrics=metrics):
            found = metrics(values)
            return found.rms_force, found.rms_moment

        def mean_square(values, metrics=metrics):
            return jnp.sum(jnp.stack(list(metrics(values).mean_square_force.values())))

        share = jnp.linspace(0.5, 1.5, batch) if batch else 1.0
        values = {error: jnp.asarray(size * share) for error, size in ERRORS.items()}
        function = {"reverse": jax.grad, "forward": jax.jacfwd}[gradient](mean_square) if gradient else rms
        function = jax.vmap(function) if batch else function
        if kept and not options.own_options_hold():
            raise SystemExit("The options of kept programs do not hold here: they are those of a CPU's compiler.")
        with options.own_program() if kept else nullcontext():
            start = time.process_time()
            traced = jax.jit(function).trace(values)
            lowered = traced.lower()
            middle = time.process_time()
            compiled = lowered.compile()
            end = time.process_time()
        shortest = min(timed(compiled, values) for _ in range(RUNS))
        what = f"{name} gradient, {gradient}" if gradient else name
        what += f", batch of {batch}" if batch else ""
        what += ", kept" if kept else ""
        print(
            f"{folder.name}, {what}: {count_equations(traced.jaxpr.jaxpr)} equations, "
            f"traced in {middle - start:.1f} s, compiled in {end - middle:.1f} s, run {1e3 * shortest:.2f} ms",
            flush=True,
        )


def timed(compiled, values) -> float:
    """Seconds of one run."""
    import jax

    start = time.perf_counter()
    jax.block_until_ready(compiled(values))
    return time.perf_counter() - start


def main() -> int:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--folders", type=Path, nargs="+", default=[HERE.parents[1]], help="checkouts of the project")
    parser.add_argument(
        "--gradient", nargs="?", const="reverse", choices=["reverse", "forward"], help="a derivative, in this mode"
    )
    parser.add_argument("--batch", type=int, help="samples at once")
    parser.add_argument("--kept", action="store_true", help="with the options of kept programs")
    parser.add_argument("--here", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.here:
        measure(options.here, options.gradient, options.batch, options.kept)
        return 0
    for folder in options.folders:
        environment = {**os.environ, "PYTHONPATH": str(folder.resolve()), "RFEM_JAX_NO_CACHE": "1"}
        command = [sys.executable, str(HERE), "--here", str(folder.resolve())]
        command += ["--gradient", options.gradient] if options.gradient else []
        command += ["--batch", str(options.batch)] if options.batch else []
        command += ["--kept"] if options.kept else []
        subprocess.run(command, env=environment, check=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
