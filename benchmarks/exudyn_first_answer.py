"""What `first_answer.py` times of Exudyn: whole studies of the four-bar, static starts included.

    python benchmarks/exudyn_first_answer.py run|monte_carlo [--step 1e-3] [--samples N]

run: the five cases of the main study, one after the other.  monte_carlo: uniform errors of the shipped study on
all cores, a process each.  Settings are the fastest that `exudyn_speed.py` finds at 0.1 % of the RMS loads.
"""

import argparse
import multiprocessing
import os
from pathlib import Path

import jax

jax.config.update("jax_enable_x64", True)

import numpy as np  # noqa: E402
from exudyn_engine import drive_pieces, exudyn_numbers  # noqa: E402

from rfem_jax import assembly_errors, discretise, load_study  # noqa: E402
from rfem_jax.exchange.exudyn_program import Settings, equilibrium, move  # noqa: E402

STUDIES = Path(__file__).resolve().parents[1] / "studies"
FASTEST = Settings(nodes="angles", relative=1e-4, intrinsic=False)


def rms_of(model, errors: dict, step: float, drive: dict) -> np.ndarray:
    """RMS force and moment (2, joints) of one sample; `drive`: as `drive_pieces` has it."""
    mechanism = exudyn_numbers(model, assembly_errors(model, errors)) | drive
    result = move(mechanism, step, FASTEST, equilibrium(mechanism)[0])
    return np.array([list(result.rms[kind].values()) for kind in ("force", "moment")])


def samples_of(share: np.ndarray, step: float, duration: float | None = None) -> np.ndarray:
    """RMS loads (samples, 2, joints) of errors `share` (samples, errors) of their half-widths."""
    study = load_study(STUDIES / "monte_carlo" / "study.toml")
    model = discretise(study.mechanism)
    widths, drive = study.tasks.tolerances.half_widths(), drive_pieces(study.drive, duration or study.duration)
    return np.array([
        rms_of(model, {n: float(s * w) for s, (n, w) in zip(row, widths.items())}, step, drive)
        for row in share
    ])  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("study", choices=("run", "monte_carlo"))
    parser.add_argument("--step", type=float, default=1e-3, help="s")
    parser.add_argument("--samples", type=int, default=4096)
    parser.add_argument("--duration", type=float, help="s, instead of the study's")
    options = parser.parse_args()
    if options.study == "run":
        study = load_study(STUDIES / "four_bar" / "study.toml")
        model = discretise(study.mechanism)
        drive = drive_pieces(study.drive, options.duration or study.duration)
        for case in study.cases[: options.samples]:
            print(case.name, rms_of(model, case.errors, options.step, drive))
        return
    cores = len(os.sched_getaffinity(0))
    share = np.random.default_rng(1).uniform(-1.0, 1.0, (options.samples, 3))
    parts = [(part, options.step, options.duration) for part in np.array_split(share, cores)]
    # JAX's threads do not survive a fork.
    with multiprocessing.get_context("spawn").Pool(cores) as pool:
        values = np.concatenate(pool.starmap(samples_of, parts))
    print("mean", values.mean(axis=0), "deviation", values.std(axis=0))


if __name__ == "__main__":
    main()
