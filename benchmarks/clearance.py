"""Static preload of a four-bar over a clearance: a thousand equilibria with contact in one batch.

    python benchmarks/clearance.py [--folders FOLDER ...] [--count 1000] [--repeats 5]

The flexible four-bar of `rfem_jax.validation.clearances` (5 rfes a link, joint D a pin in a bush) with D tilted by 0.5
deg about x and z and shifted by 0.5 mm; radial clearances of D from 0 to 150 um.  For every checkout of the project
(default: this one) a process of its own: processor time to trace, lower and compile the batch, shortest run of it by
the clock and in processor time, the shortest single equilibrium, equilibria that were not found, and the largest
moment in D.  What was compiled before is not used.
"""

import argparse
import os
import subprocess
import sys
import time
from pathlib import Path

HERE = Path(__file__).resolve()
LARGEST, SHIFT = 150e-6, 5e-4  # m


def measure(folder: Path, count: int, repeats: int) -> None:
    """Print the row of the checkout that is imported here."""
    import jax

    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_enable_compilation_cache", False)
    import jax.numpy as jnp
    import numpy as np

    from rfem_jax import assemble, assembly_errors, design, discretise
    from rfem_jax.validation.clearances import TILT, flexible_four_bar

    model = discretise(flexible_four_bar())
    errors = assembly_errors(model, {"D.delta_x": TILT, "D.delta_z": TILT, "D.d_y": SHIFT})

    def preload(radial):
        made = assemble(model, errors, design=design(model, {"D.clearance.radial": radial}))
        return made.preload, made.status

    def shortest(compiled, values):
        """Shortest run by the clock and in processor time [s]."""
        times = []
        for _ in range(repeats):
            clock, processor = time.perf_counter(), time.process_time()
            jax.block_until_ready(compiled(values))
            times.append((time.perf_counter() - clock, time.process_time() - processor))
        return [min(column) for column in zip(*times, strict=True)]

    clearances = jnp.linspace(0.0, LARGEST, count)
    start = time.process_time()
    batch = jax.jit(jax.vmap(preload)).lower(clearances).compile()
    compiling = time.process_time() - start
    loads, status = batch(clearances)
    clock, processor = shortest(batch, clearances)
    single = shortest(jax.jit(preload).lower(clearances[0]).compile(), clearances[count // 2])[0]
    largest = float(np.max(np.linalg.norm(loads["D"].moment, axis=-1)))
    print(
        f"| {folder.name} | {compiling:.1f} | {clock:.2f} | {processor:.2f} | {1e3 * single:.2f} | "
        f"{int(np.count_nonzero(status))} of {count} | {largest:.6f} |",
        flush=True,
    )


def main() -> int:
    """The command."""
    parser = argparse.ArgumentParser(description="Static preload of a four-bar over a clearance.")
    parser.add_argument("--folders", type=Path, nargs="+", default=[HERE.parents[1]], help="checkouts of the project")
    parser.add_argument("--count", type=int, default=1000, help="clearances")
    parser.add_argument("--repeats", type=int, default=5, help="runs, the shortest of which counts")
    parser.add_argument("--here", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.here:
        measure(options.here, options.count, options.repeats)
        return 0
    print(
        "| checkout | compilation, CPU s | batch, s | batch, CPU s | one alone, ms | not found | largest moment, N m |"
    )
    print("|---|---|---|---|---|---|---|", flush=True)
    for folder in options.folders:
        environment = {**os.environ, "PYTHONPATH": str(folder.resolve()), "RFEM_JAX_NO_CACHE": "1"}
        command = [sys.executable, str(HERE), "--here", str(folder.resolve())]
        command += ["--count", str(options.count), "--repeats", str(options.repeats)]
        subprocess.run(command, env=environment, check=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
