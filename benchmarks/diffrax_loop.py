"""Which loop over steps: ours within one kernel, one of JAX around kernels of a step, or `diffrax.diffeqsolve`.

    python benchmarks/diffrax_loop.py [--methods generalised_alpha rk4] [--batches 1 16 64] [--steps N]

The same solver and the same steps in all of them, on the main study's mechanism with errors in joint D, after its
static start: seconds of the processor until the first result, nothing kept, and microseconds of a sample's step in
batches, medians of five runs.
"""

import argparse
import os
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar

os.environ.setdefault("XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1")

os.environ.setdefault("RFEM_JAX_NO_CACHE", "1")

import jax

jax.config.update("jax_enable_x64", True)

import diffrax  # noqa: E402
import jax.numpy as jnp  # noqa: E402

from rfem_jax import GeneralisedAlpha, RungeKutta4, assembly_errors, discretise, load_study  # noqa: E402
from rfem_jax.kernels import kernel  # noqa: E402
from rfem_jax.mechanics.model.with_errors import with_structural_zeros  # noqa: E402
from rfem_jax.simulation.stages import integration, stepping  # noqa: E402
from rfem_jax.simulation.system.equations import Conditions  # noqa: E402

STUDY = load_study(Path(__file__).parents[1] / "studies" / "four_bar" / "study.toml")
METHODS = {"generalised_alpha": GeneralisedAlpha(step=1e-3, tolerance=1e-3), "rk4": RungeKutta4(step=1e-5)}
STEPS = {"generalised_alpha": 200, "rk4": 2000}
ERRORS = ("D.delta_x", "D.delta_z", "D.d_y")
REPEATS = 5


class StepByKernel(diffrax.AbstractSolver):
    """A solver of ours whose step is a kernel, for diffrax's loop."""

    inner: Any
    term_structure: ClassVar = diffrax.AbstractTerm
    interpolation_cls: ClassVar[Callable] = diffrax.LocalLinearInterpolation

    def order(self, terms):
        return self.inner.order(terms)

    def init(self, terms, t0, t1, y0, args):
        return self.inner.init(terms, t0, t1, y0, args)

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        del made_jump
        y1, after = step_kernel(self.inner, terms)(t0, t1, y0, args, solver_state)
        return y1, None, {"y0": y0, "y1": y1}, after, diffrax.RESULTS.successful

    def func(self, terms, t0, y0, args):
        return terms.vf(t0, y0, args)


def step_kernel(solver, terms) -> Callable:
    """(t0, t1, state, conditions, memory) -> (state, memory) as one kernel."""

    def step(t0, t1, y, conditions, memory):
        y, _, _, memory, _ = solver.step(terms, t0, t1, y, conditions, memory, jnp.asarray(False))
        return y, memory

    return kernel(step, name="step")


def by_one_kernel(solver, terms, y, conditions, memory, h, steps):
    def loop(y, conditions, memory):
        def step(state, i):
            y, memory = state
            y, _, _, memory, _ = solver.step(terms, h * i, h * (i + 1.0), y, conditions, memory, jnp.asarray(False))
            return (y, memory), None

        return jax.lax.scan(step, (y, memory), jnp.arange(steps, dtype=jnp.float64))[0]

    return kernel(loop, name="steps")(y, conditions, memory)[0]


def by_scan(solver, terms, y, conditions, memory, h, steps):
    one = step_kernel(solver, terms)

    def step(state, i):
        return one(h * i, h * (i + 1.0), state[0], conditions, state[1]), None

    return jax.lax.scan(step, (y, memory), jnp.arange(steps, dtype=jnp.float64))[0][0]


def by_diffeqsolve(solver, terms, y, conditions, memory, h, steps):
    solution = diffrax.diffeqsolve(
        terms, StepByKernel(solver), 0.0, h * steps, h, y, conditions, solver_state=memory,
        adjoint=diffrax.ForwardMode(), max_steps=steps + 2, throw=False,
    )  # fmt: skip
    return jax.tree.map(lambda x: x[-1], solution.ys)


LOOPS = {"one kernel": by_one_kernel, "lax.scan": by_scan, "diffeqsolve": by_diffeqsolve}


def starts(name: str, points, steps: int) -> tuple:
    """State, conditions and memory at the start of the steps, with errors (samples, 3)."""
    model, method = discretise(STUDY.mechanism), METHODS[name]
    grid, _ = integration.grid_for(STUDY.drive, method.step * steps, method, method.step * steps)
    whole = stepping.Integration(model, STUDY.drive, grid, method, steps)

    def start(point):
        prepared = integration.prepare(model, assembly_errors(model, dict(zip(ERRORS, point))), STUDY.drive, None)
        carry, operators = integration.start_carry(whole, prepared), whole.operators(prepared.actual)
        last = None if operators is None else jax.tree.map(lambda x: x[-1], operators)
        actual, phase = with_structural_zeros(prepared.actual), jnp.asarray(0, jnp.int32)
        conditions = Conditions(actual, whole.drives, phase, whole.stabilisation, operators=last)
        y, zero = (carry.trajectory, carry.peaks), jnp.zeros(())
        return y, conditions, whole.solver.resume(stepping.TERMS, zero, zero + method.step, y, conditions, carry.memory)

    return whole.solver, jax.block_until_ready(jax.jit(jax.vmap(start))(points))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--methods", nargs="+", choices=tuple(METHODS), default=list(METHODS))
    parser.add_argument("--batches", type=int, nargs="+", default=[1, 16, 64])
    parser.add_argument("--steps", type=int, help="number of steps (200; 2000 of rk4)")
    options = parser.parse_args()
    print(f"| method, loop | first result s | us a step in batches of {', '.join(map(str, options.batches))} |")
    print("|---|---|---|")
    for name in options.methods:
        begun, h, steps = {}, METHODS[name].step, options.steps or STEPS[name]
        for batch in options.batches:
            points = jnp.asarray([4e-3, 2e-3, 2e-4]) * jnp.linspace(1.0, 0.2, batch)[:, None]
            solver, begun[batch] = starts(name, points, steps)
        for label, loop in LOOPS.items():
            batched = jax.jit(jax.vmap(lambda *start, loop=loop: loop(solver, stepping.TERMS, *start, h, steps)))
            first, each = None, []
            for batch, start in begun.items():
                times = []
                for _ in range(REPEATS + 1):
                    started = time.process_time()
                    jax.block_until_ready(batched(*start))
                    times.append(time.process_time() - started)
                first = times[0] if first is None else first
                each.append(1e6 * statistics.median(times[1:]) / batch / steps)
            print(f"| {name}, {label} | {first:.2g} | {', '.join(f'{one:.3g}' for one in each)} |", flush=True)


if __name__ == "__main__":
    main()
