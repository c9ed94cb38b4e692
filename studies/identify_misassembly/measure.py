"""The machine that was measured: the four-bar of study.toml with errors that its estimate does not know.

It is another model than that of the estimate, so that this has to live with what a model leaves out: links of 12 rfes,
a step of 0.1 ms, and noise. Writes measured.csv beside this file.

    python studies/identify_misassembly/measure.py
"""

from dataclasses import replace
from pathlib import Path

import jax

jax.config.update("jax_enable_x64", True)

import numpy as np  # noqa: E402
from scipy.interpolate import CubicSpline  # noqa: E402

from rfem_jax import GeneralisedAlpha, Simulation, assembly_errors, discretise, load_study, simulate  # noqa: E402

FOLDER = Path(__file__).parent
TRUTH = {"D.delta_x": "0.20 deg", "D.delta_z": "-0.12 deg", "D.d_y": "0.30 mm"}
OFFSET = 0.12  # N m, of the strain gauges that measure the moment


def measured(folder: Path = FOLDER, seed: int = 3) -> Path:
    """Write measured.csv: the crank's rate at 200 Hz and the moment in joint D at 500 Hz, with noise."""
    study = load_study(FOLDER / "study.toml")
    links = [one if one.rigid else replace(one, rfes=12) for one in study.mechanism.links]
    model = discretise(replace(study.mechanism, links=links))
    simulation = Simulation.of(study, model=model, method=GeneralisedAlpha(step=1e-4), save_every=5e-4)
    run = simulate(simulation, assembly_errors(model, TRUTH))
    rng, times = np.random.default_rng(seed), np.asarray(run.times)
    rows: dict[int, dict[str, float]] = {}
    for column, values, interval, offset in (
        ("rate_rad_s", run.motion.rate, 5, 0.0),
        ("D_moment_x_Nm", run.loads["D"].moment[:, 0], 2, OFFSET),
    ):
        noise = study.tasks.identification.signals[column].noise
        for ms in range(interval, int(1000 * study.require_duration()) + 1, interval):
            value = float(CubicSpline(times, values)(1e-3 * ms)) + offset + noise * rng.normal()
            rows.setdefault(ms, {})[column] = value
    lines = ["time_s,rate_rad_s,D_moment_x_Nm"]
    for ms in sorted(rows):
        cells = (f"{rows[ms][one]:.4f}" if one in rows[ms] else "" for one in lines[0].split(",")[1:])
        lines.append(",".join([f"{1e-3 * ms:.3f}", *cells]))
    path = folder / "measured.csv"
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


if __name__ == "__main__":
    print(f"{measured()} is written")
