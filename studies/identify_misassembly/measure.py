"""The machine that was measured: the four-bar of a study with errors that its estimate does not know.

    python studies/identify_misassembly/measure.py [--study STUDY.toml] [--out DIR]

It is another model than that of the estimate, so that this has to live with what a model leaves out: twice as many rfes
and two more in each link, a fifth of the step, and noise. Writes measured.csv into DIR (beside this file): the crank's
rate at 200 Hz and the moment about z in joint D at 500 Hz, whose strain gauges have an offset.
"""

import argparse
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import jax

jax.config.update("jax_enable_x64", True)

import numpy as np  # noqa: E402
from scipy.interpolate import CubicSpline  # noqa: E402

from rfem_jax import (  # noqa: E402
    GeneralisedAlpha,
    Run,
    Simulation,
    Study,
    assembly_errors,
    discretise,
    load_study,
    simulate,
)

FOLDER = Path(__file__).parent
TRUTH = {"D.delta_x": "0.20 deg", "D.delta_z": "-0.12 deg", "D.d_y": "0.30 mm"}
OFFSET = 0.12  # N m
INTERVALS = {"rate_rad_s": 5, "D_moment_z_Nm": 2}  # ms


def true_run(study: Study, errors: Mapping[str, float | str]) -> Run:
    """The machine with these errors as it runs."""
    links = [one if one.rigid else replace(one, rfes=2 * one.rfes + 2) for one in study.mechanism.links]
    model = discretise(replace(study.mechanism, links=links))
    method = GeneralisedAlpha(step=0.2 * study.method.step)
    return simulate(Simulation.of(study, model=model, method=method, save_every=5e-4), assembly_errors(model, errors))


def measure(file: Path, folder: Path, seed: int = 3) -> Path:
    """Write measured.csv of the study in `file` into `folder`."""
    study = load_study(file)
    run = true_run(study, TRUTH)
    curves = {"rate_rad_s": run.motion.rate, "D_moment_z_Nm": run.loads["D"].moment[:, 2] + OFFSET}
    rng, rows = np.random.default_rng(seed), {}
    for column, values in curves.items():
        curve, noise = CubicSpline(np.asarray(run.times), values), study.tasks.identification.signals[column].noise
        for ms in range(INTERVALS[column], round(1000 * study.require_duration()) + 1, INTERVALS[column]):
            rows.setdefault(ms, {})[column] = float(curve(1e-3 * ms)) + noise * rng.normal()
    lines = [",".join(["time_s", *curves])]
    for ms, row in sorted(rows.items()):
        cells = (f"{row[column]:.4f}" if column in row else "" for column in curves)
        lines.append(",".join([f"{1e-3 * ms:.3f}", *cells]))
    path = folder / "measured.csv"
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Write the measurements of a machine that was assembled wrong.")
    parser.add_argument("--study", type=Path, default=FOLDER / "study.toml")
    parser.add_argument("--out", type=Path, default=FOLDER)
    asked = parser.parse_args()
    print(f"{measure(asked.study, asked.out)} is written")
