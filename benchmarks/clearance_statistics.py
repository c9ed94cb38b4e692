"""Statistics of impacts after chaos: many runs of the slider-crank with play, by rfem_jax and by the own code.

    seeds -> clearances -> by_us, by_own_code -> values of every run -> compare

Starts differ by the clearance, which is uniform within a hundredth. Hunt and Crossley's law with a given chi needs no
memory; rfem_jax takes Runge-Kutta 4 with equal steps, the own code steps that follow contact. What is compared are
values of a run after the first turn of the crank: RMS and largest force at the joint, and of the contacts that begin
faster than `SLOWEST` how many they are and how fast they begin on average; all from the same saved times, but the RMS.
Means must be within three standard errors of their difference, and Kolmogorov and Smirnov's test must have p > 0.01.
"""

import time
from typing import NamedTuple

import speed_timing  # noqa: F401  first: it sets JAX up

import jax  # isort: skip
import jax.numpy as jnp
import numpy as np
from clearance_reference import Contact, Crank, batch
from scipy.stats import ks_2samp

from rfem_jax import RungeKutta4, Simulation, design, simulate
from rfem_jax.validation.impacts import FAST, slider_crank

CHI, SPREAD = 0.03, 0.01  # s/m; relative, of the clearances
INTERVAL, STEP, CHUNK = 2e-6, 1e-6, 16  # s, s, runs at once: their records take memory
SLOWEST = 0.1  # m/s
VALUES = ("RMS force, N", "largest force, N", "impacts", "mean speed of approach, m/s")


class Sample(NamedTuple):
    """values (runs, VALUES); how many runs failed; processor time of a run [s]."""

    values: np.ndarray
    failed: int
    cpu: float


def clearances(count: int, seed: int = 1) -> np.ndarray:
    """Radial clearances of the runs [m]."""
    return FAST.radial * (1.0 + SPREAD * np.random.default_rng(seed).uniform(-1.0, 1.0, count))


def values_of(depth: np.ndarray, force: np.ndarray, mean_square: np.ndarray) -> np.ndarray:
    """`VALUES` of runs from penetrations [m] and forces [N] (times, runs), and mean squares of forces (runs,)."""
    begins = (depth[:-1] <= 0.0) & (depth[1:] > 0.0)
    speed = np.where(begins, (depth[1:] - depth[:-1]) / INTERVAL, 0.0)
    counted = speed > SLOWEST
    count = counted.sum(axis=0)
    approach = np.where(counted, speed, 0.0).sum(axis=0) / np.maximum(count, 1)
    return np.stack([np.sqrt(mean_square), force.max(axis=0), count, approach], axis=1)


def by_own_code(radial: np.ndarray, first: float, duration: float) -> Sample:
    """From `first` to `duration` [s]."""
    before = time.process_time()
    found = batch(Crank(FAST.rate), Contact(radial, FAST.stiffness, CHI), duration, INTERVAL)
    cpu = (time.process_time() - before) / len(radial)
    at = round(first / INTERVAL)
    mean_square = (found.square[-1] - found.square[at]) / (duration - first)
    return Sample(values_of(found.depth[at:], found.force[at:], mean_square), 0, cpu)


def by_us(radial: np.ndarray, first: float, duration: float) -> Sample:
    """Likewise; without compilation."""
    model, drive, start = slider_crank(FAST, damping=CHI)
    method = RungeKutta4(step=STEP)

    def one(radial):
        run = simulate(
            Simulation(
                model,
                drive=drive,
                duration=duration,
                method=method,
                save_every=INTERVAL,
                start=start,
                design=design(model, {"C.clearance.radial": radial}),
            )
        )
        force = jnp.linalg.norm(run.loads["C"].force, axis=1)
        mean_square = run.window(first, duration).mean_square_force["C"]
        return run.contacts["C"].penetration[:, 0], force, mean_square, run.status

    size = min(CHUNK, len(radial))
    chunks = np.resize(radial, (-(-len(radial) // size), size))
    program = jax.jit(jax.vmap(one)).lower(jnp.asarray(chunks[0])).compile()
    at, cpu, values, failed = round(first / INTERVAL), 0.0, [], []
    for chunk in chunks:
        before = time.process_time()
        depth, force, mean_square, status = jax.block_until_ready(program(jnp.asarray(chunk)))
        cpu += time.process_time() - before
        values.append(values_of(np.asarray(depth).T[at:], np.asarray(force).T[at:], np.asarray(mean_square)))
        failed.append(np.asarray(status) != 0)
    count = len(radial)
    return Sample(np.concatenate(values)[:count], int(np.concatenate(failed)[:count].sum()), cpu / chunks.size)


def compare_statistics(report, runs: int, turns: int, trial: bool = False) -> None:
    """Table of means with standard errors and of quantiles, and agreements."""
    turn = 2.0 * np.pi / FAST.rate
    first, duration = (1.5e-4, 4e-4) if trial else (turn, turns * turn)
    first, duration = (INTERVAL * round(time / INTERVAL) for time in (first, duration))
    radial = clearances(runs)
    ours, own = by_us(radial, first, duration), by_own_code(radial, first, duration)
    rows = []
    for k, name in enumerate(VALUES):
        a, b = ours.values[:, k], own.values[:, k]
        errors = [x.std(ddof=1) / np.sqrt(runs) for x in (a, b)]
        apart = abs(a.mean() - b.mean()) / max(np.hypot(*errors), 1e-30)
        _, p = ks_2samp(a, b)
        for who, x, error in zip(("ours", "own code"), (a, b), errors, strict=True):
            rows.append(
                [f"{name}: {who}", _show(x.mean(), error), *(f"{q:.4g}" for q in np.quantile(x, (0.1, 0.5, 0.9)))]
            )
        alike = np.corrcoef(a, b)[0, 1] if a.std() and b.std() else np.nan
        rows[-1] += [f"{apart:.2f}", f"{p:.2f}", f"{alike:.2f}"]
        rows[-2] += ["", "", ""]
        report.check(f"{name}: difference of the means over its standard error", apart, 3.0)
        report.check(f"{name}: 0.01 over p of Kolmogorov and Smirnov's test", 0.01 / max(p, 1e-30), 1.0)
    report.table(
        f"{runs} runs, {1e3 * first:.3g} ms to {1e3 * duration:.3g} ms, chi = {CHI} s/m",
        ["value", "mean", "10 %", "median", "90 %", "means apart, standard errors", "p", "correlation of the same run"],
        rows,
    )
    report.check("runs that fail", ours.failed, 0)
    # Runs that were the same would show nothing; a trial has no chaos.
    single = np.median(np.abs(ours.values[:, 0] / own.values[:, 0] - 1.0))
    if not trial:
        report.check("0.01 over the median difference of the RMS forces of a single run", 0.01 / single, 1.0)
    print(f"Same run by both: RMS forces {single:.2g} apart (median). Processor time of a run: ours {ours.cpu:.3f} s, "
          f"own code {own.cpu:.3f} s.")  # fmt: skip


def _show(mean: float, error: float) -> str:
    return f"{mean:.5g} +- {error:.2g}"
