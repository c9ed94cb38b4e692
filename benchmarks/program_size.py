"""What programs are made of, and what it costs to make them: kernels of a simulation, programs of a command.

    python benchmarks/program_size.py [--folders FOLDER ...] [--gradient [MODE]] [--batch N]
    python benchmarks/program_size.py --command run studies/four_bar/study.toml --out results

For every checkout of the project (default: this one) a process of its own, in which nothing that was compiled before is
used.  Times are those of the processor.

Without `--command`: RMS loads of the main study with errors at joint D, by Runge-Kutta 4 with the study's step and by
generalised alpha with 2.5 ms.  A table of the kernels: operations on vectors, their emission as text, their machine
code by the fast and by the thorough selection and which of the two is taken, size of the object code that is taken; a
line for the program: tracing, XLA's compilation of what is around the kernels, shortest run of 30.  `--gradient`:
instead the derivative of the sum of all mean-square forces by these errors, in `reverse` (default) or `forward` mode;
`--batch`: of N samples at once, whose errors are from half to one and a half times as large.

With `--command` and a command's arguments: a table of the programs that it compiles: kernels and their operations,
tracing and lowering, emission, machine code, XLA's compilation, and all of these; then what the whole command takes.
"""

import argparse
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

HERE = Path(__file__).resolve()
RUNS = 30
CASES = (("rk4", 1e-5, 0.02), ("generalised_alpha", 2.5e-3, 0.2))  # step, duration [s]
GRADIENT = (("generalised_alpha", 2.5e-3, 0.05),)
ERRORS = {"D.delta_x": 8.7e-3, "D.delta_z": 1e-3, "D.d_y": 1e-4}
KERNELS = ("kernel", "calls", "samples", "operations", "emission s", "fast s", "thorough s", "taken", "object code kB")
PROGRAMS = ("program", "kernels", "operations", "tracing s", "emission s", "machine code s", "XLA s", "all s")


def print_row(*cells) -> None:
    """A row of a Markdown table."""
    shown = (f"{cell:.2f}" if isinstance(cell, float) else str(cell) for cell in cells)
    print(f"| {' | '.join(shown)} |", flush=True)


def print_head(names) -> None:
    print_row(*names)
    print("|" + "---|" * len(names), flush=True)


def processor_time(function, *arguments):
    """Result, and seconds of the processor."""
    start = time.process_time()
    result = function(*arguments)
    return result, time.process_time() - start


# The kernels of a simulation


def calls_of_kernels(jaxpr) -> Iterator:
    """Equations of a jaxpr that call kernels, also within loops and branches; what these call is a part of them."""
    for equation in jaxpr.eqns:
        if equation.primitive.name == "kernel":
            yield equation
            continue
        for value in equation.params.values():
            for part in value if isinstance(value, list | tuple) else [value]:
                part = getattr(part, "jaxpr", part)
                if hasattr(part, "eqns"):
                    yield from calls_of_kernels(part)


def samples_of(equation) -> int:
    """Samples for which a kernel is called."""
    pairs = zip(equation.invars, equation.params["batched"])
    return next((x.aval.shape[0] for x, batched in pairs if batched), 1)


def print_kernels(jaxpr) -> None:
    """A row for every kernel of a program, and number of samples."""
    from rfem_jax.kernels import machine_code, programs
    from rfem_jax.kernels.bodies import Size, thorough_pays

    calls: dict = {}
    for equation in calls_of_kernels(jaxpr):
        key = equation.params["body"], samples_of(equation)
        calls[key] = calls.get(key, 0) + 1
    print_head(KERNELS)
    for (body, samples), count in calls.items():
        size = body.size()
        if not isinstance(size, Size):
            print_row(body.name, count, samples, f"compiled by XLA: {size}", *"-----")
            continue
        program, emission = processor_time(programs.emit, body.program)
        lanes = min(1 << (samples - 1).bit_length(), machine_code.vector_width())
        thorough = thorough_pays(size, -(-samples // lanes))
        codes = [
            processor_time(machine_code.compiled, program.module(lanes, choice)[1], choice) for choice in (False, True)
        ]
        taken, size = ("fast", "thorough")[thorough], len(codes[thorough][0]) / 1e3
        print_row(
            body.name, count, samples, program.operations, emission, codes[0][1], codes[1][1], taken, f"{size:.0f}"
        )


def measure(folder: Path, gradient: str | None, batch: int | None) -> None:
    """Print a table and a line for every simulation by the checkout that is imported here."""
    import jax

    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_enable_compilation_cache", False)
    import jax.numpy as jnp

    from rfem_jax import Simulation, assembly_errors, discretise, load_study, simulate
    from rfem_jax.description.methods import named_method

    study = load_study(folder / "studies" / "four_bar" / "study.toml")
    model = discretise(study.mechanism)
    for name, step, duration in GRADIENT if gradient else CASES:

        def metrics(values, name=name, step=step, duration=duration):
            errors = assembly_errors(model, values)
            method = named_method(name, step=step)
            run = simulate(
                Simulation(model, drive=study.drive, duration=duration, method=method, save_every=0.25 * duration),
                errors,
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
        what = f"{name} gradient, {gradient}" if gradient else name
        what += f", batch of {batch}" if batch else ""
        print(f"\n{folder.name}, {what}:\n", flush=True)
        traced, tracing = processor_time(jax.jit(function).trace, values)
        print_kernels(traced.jaxpr.jaxpr)
        lowered = traced.lower()  # with the machine code of the kernels, which was measured above
        compiled, compiling = processor_time(lowered.compile)
        shortest = min(clock_time(compiled, values) for _ in range(RUNS))
        print(f"\ntraced in {tracing:.1f} s, by XLA compiled in {compiling:.1f} s, run {1e3 * shortest:.2f} ms")


def clock_time(compiled, values) -> float:
    """Seconds of one run."""
    import jax

    start = time.perf_counter()
    jax.block_until_ready(compiled(values))
    return time.perf_counter() - start


# The programs of a command


class Ledger:
    """What the programs that are being compiled have cost so far, one after the other."""

    def __init__(self) -> None:
        self.programs: list[dict] = []
        self.open: dict | None = None

    def counted(self, what: str, function, count=None):
        """The function, whose time is added to the program that is being compiled; `count` of its result, too."""

        def wrapped(*args, **kwargs):
            result, seconds = processor_time(lambda: function(*args, **kwargs))
            if self.open is not None:
                self.open[what] += seconds
                if count is not None:
                    self.open["kernels"] += 1
                    self.open["operations"] += count(result)
            return result

        return wrapped

    def opened(self, compiled):
        """`compiled` of a program, which opens an entry of its own."""

        def wrapped(function, *args, **kwargs):
            before, self.open = (
                self.open,
                dict.fromkeys(("kernels", "operations", "emission", "machine code", "XLA"), 0),
            )
            try:
                result, whole = processor_time(lambda: compiled(function, *args, **kwargs))
                self.programs.append({"name": function.__name__, "all": whole, **self.open})
            finally:
                self.open = before
            return result

        return wrapped


def measure_command(arguments: list[str]) -> int:
    """Run a command, and print a table of the programs that it has compiled."""
    start = time.process_time()
    import jax

    from rfem_jax.compilation import program
    from rfem_jax.kernels import machine_code, programs
    from rfem_jax.report import command_line

    ledger = Ledger()
    programs.emit = ledger.counted("emission", programs.emit, lambda found: found.operations)
    machine_code.compiled = ledger.counted("machine code", machine_code.compiled)
    jax.stages.Lowered.compile = ledger.counted("XLA", jax.stages.Lowered.compile)
    program.compiled = ledger.opened(program.compiled)
    code = command_line.main(arguments)
    whole = time.process_time() - start
    print()
    print_head(PROGRAMS)
    for one in ledger.programs:
        rest = one["all"] - one["emission"] - one["machine code"] - one["XLA"]
        parts = (float(one[what]) for what in ("emission", "machine code", "XLA", "all"))
        print_row(one["name"].strip("_"), one["kernels"], one["operations"], rest, *parts)
    made = sum(one["all"] for one in ledger.programs)
    print(f"\nwhole command {whole:.1f} s, programs {made:.1f} s of it")
    return code


def main() -> int:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--folders", type=Path, nargs="+", default=[HERE.parents[1]], help="checkouts of the project")
    parser.add_argument(
        "--gradient", nargs="?", const="reverse", choices=["reverse", "forward"], help="a derivative, in this mode"
    )
    parser.add_argument("--batch", type=int, help="samples at once")
    parser.add_argument("--here", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--command", nargs=argparse.REMAINDER, help="arguments of rfem-jax; the last option")
    options = parser.parse_args()
    if options.here and options.command:
        return measure_command(options.command)
    if options.here:
        measure(options.here, options.gradient, options.batch)
        return 0
    for folder in options.folders:
        environment = {**os.environ, "PYTHONPATH": str(folder.resolve()), "RFEM_JAX_NO_CACHE": "1"}
        command = [sys.executable, str(HERE), "--here", str(folder.resolve())]
        command += ["--gradient", options.gradient] if options.gradient else []
        command += ["--batch", str(options.batch)] if options.batch else []
        command += ["--command", *options.command] if options.command else []
        subprocess.run(command, env=environment, check=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
