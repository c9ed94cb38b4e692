"""diffrax's own loop over steps against ours: tracing, compilation, time of a sample, memory.

    python benchmarks/diffrax_loop.py METHOD LOOP MODE BATCH [--share 1] [--rfes 5] [--study FILE]

METHOD: generalised_alpha, rk4; LOOP: own, which is a kernel, or `diffeqsolve` in every interval of the time grid with
the adjoint forward, direct or checkpoint, which XLA compiles around kernels of right-hand sides; MODE: value, forward
(three errors), reverse (one metric).  Main study; one process a row, since the programs are large.  `--share` simulates
a share of the duration.
"""

import argparse
import time
from pathlib import Path

import jax

jax.config.update("jax_enable_x64", True)

import diffrax  # noqa: E402
import jax.numpy as jnp  # noqa: E402

from rfem_jax import GeneralisedAlpha, RungeKutta4, assembly_errors, discretise, load_study  # noqa: E402
from rfem_jax.simulation import integration, stepping  # noqa: E402

STUDY = Path(__file__).parents[1] / "studies" / "four_bar" / "study.toml"
KINDS = ("delta_x", "delta_z", "d_y")  # of the last joint
ADJOINTS = {
    "forward": diffrax.ForwardMode, "direct": diffrax.DirectAdjoint,
    "checkpoint": diffrax.RecursiveCheckpointAdjoint,
}  # fmt: skip


def by_diffeqsolve(adjoint: str):
    """One interval, in the place of `stepping._fixed`.

    An interval of length zero takes one step by itself, where diffrax would take none.
    """

    def integrate(solver, carry, schedule, conditions, tolerance=None):
        del tolerance  # of contacts, which these mechanisms do not have
        start, step, _, _ = schedule.step(jnp.zeros(()))
        steps = schedule.number
        length = step * steps
        terms, y = diffrax.ODETerm(stepping.vector_field), (carry.trajectory, carry.peaks)
        memory = solver.resume(terms, start, start + length, y, conditions, carry.memory)
        moving = length > 0.0

        def step_of_length_zero():
            found, _, _, after, _ = solver.step(terms, start, start, y, conditions, memory, False)
            return found, after

        def move():
            h = jnp.where(moving, length / steps, 1.0)
            solution = diffrax.diffeqsolve(
                terms, solver, start, start + jnp.where(moving, length, 1.0), h, y, conditions,
                saveat=diffrax.SaveAt(t1=True, solver_state=True), solver_state=memory,
                adjoint=ADJOINTS[adjoint](), max_steps=steps + 2, throw=False,
            )  # fmt: skip
            return jax.tree.map(lambda x: x[-1], solution.ys), solution.solver_state

        (trajectory, peaks), memory = jax.lax.cond(moving, move, step_of_length_zero)
        memory = None if carry.memory is None else memory
        return carry._replace(trajectory=trajectory, peaks=peaks, memory=memory)

    return integrate


def loads(options):
    """Three errors -> mean squares of the joint loads."""
    study = load_study(options.study)
    model = discretise(study.mechanism, rfes=options.rfes)
    names = [f"{max(model.joint_names)}.{kind}" for kind in KINDS]
    if options.method == "rk4":
        chosen, duration = RungeKutta4(step=1e-5), options.share * (0.12 if options.mode == "value" else 0.02)
    else:
        chosen, duration = GeneralisedAlpha(step=2.5e-3, tolerance=1e-3), options.share * 0.5
    grid, steps = integration.grid_for(study.drive, duration, chosen, duration / 20)

    def function(point):
        errors = assembly_errors(model, dict(zip(names, point)))
        prepared = integration.prepare(model, errors, study.drive, None)
        carry = integration.start_carry(model, prepared, study.drive, chosen)
        carry, _ = integration.advance(model, prepared.actual, study.drive, carry, grid, chosen, steps, None)
        metrics = integration.metrics_of(model, carry, duration)
        return jnp.stack([*metrics.mean_square_force.values(), *metrics.mean_square_moment.values()])

    return function


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("method", choices=("generalised_alpha", "rk4"))
    parser.add_argument("loop", choices=("own", *ADJOINTS))
    parser.add_argument("mode", choices=("value", "forward", "reverse"))
    parser.add_argument("batch", type=int)
    parser.add_argument("--share", type=float, default=1.0, help="of the duration that is simulated")
    parser.add_argument("--rfes", type=int, default=5, help="of a flexible link")
    parser.add_argument("--study", type=Path, default=STUDY, help="file; the main study by default")
    options = parser.parse_args()
    if options.loop != "own":
        stepping._fixed = by_diffeqsolve(options.loop)
        integration.kernel = lambda function, **settings: function  # these loops have no machine code
    function = loads(options)
    if options.mode == "forward":
        function = jax.jacfwd(function)
    if options.mode == "reverse":
        function = jax.grad(lambda point, values=function: values(point)[0])
    points = jnp.linspace(0.5, 1.5, options.batch)[:, None] * jnp.asarray([2e-3, 1.5e-3, 5e-4])
    times = [time.process_time()]
    traced = jax.jit(jax.vmap(function)).trace(points)
    times.append(time.process_time())
    compiled = traced.lower().compile()
    times.append(time.process_time())
    runs = []
    for _ in range(6):
        start = time.process_time()
        jax.block_until_ready(compiled(points))
        runs.append(time.process_time() - start)
    memory = compiled.memory_analysis().temp_size_in_bytes / 1e6 / options.batch
    print(
        f"{options.method}, {options.loop}, {options.mode}, batch {options.batch}: tracing "
        f"{times[1] - times[0]:.1f} s, compilation {times[2] - times[1]:.1f} s, "
        f"{1e3 * min(runs) / options.batch:.2f} ms and {memory:.2f} MB a sample"
    )


if __name__ == "__main__":
    main()
