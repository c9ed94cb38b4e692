"""The measurements of `tests/tolerancing/measured_by_exudyn.csv`: a four-bar that was assembled wrong, by Exudyn.

    python benchmarks/exudyn_measured.py [--out FILE.csv] [--rfes N] [--step SECONDS]

An identification must not be tried on what its own model has computed alone. Here the links of the study
`identify_misassembly` consist of three times as many elements, which are Exudyn's, as are kinematics in absolute
coordinates, constraints, static start and integration with steps of a seventh; what is measured has noise and, in the
moment, the offset of a strain gauge. Of ours are only lengths, masses, stiffnesses and the frames of the joints with
their errors.
"""

import argparse
from dataclasses import replace
from pathlib import Path

import jax

jax.config.update("jax_enable_x64", True)

import numpy as np  # noqa: E402
from exudyn_engine import simulate  # noqa: E402
from scipy.interpolate import CubicSpline  # noqa: E402

from rfem_jax import assembly_errors, discretise, load_study  # noqa: E402

ROOT = Path(__file__).parents[1]
FILE = ROOT / "tests" / "tolerancing" / "measured_by_exudyn.csv"
TRUTH = {"D.delta_x": "0.25 deg", "D.delta_z": "-0.15 deg", "D.d_y": "0.40 mm"}
OFFSET, DURATION = 0.05, 0.3  # N m, s
SAMPLED = {"rate_rad_s": (0.1, 5), "D_moment_x_Nm": (0.4, 2), "D_moment_z_Nm": (0.4, 2)}  # noise, interval [ms]


def measure(rfes: int, step: float, seed: int = 7) -> dict[int, dict[str, float]]:
    """{time [ms]: {column: value}}, as sensors show it."""
    study = load_study(ROOT / "studies" / "identify_misassembly" / "study.toml")
    links = [one if one.rigid else replace(one, rfes=rfes) for one in study.mechanism.links]
    model = discretise(replace(study.mechanism, links=links), elements="geometrically_exact")
    found = simulate(model, assembly_errors(model, TRUTH), study.drive, DURATION, step).histories
    moment = found.moment["D"]
    curves = dict(zip(SAMPLED, (found.rate, moment[:, 0] + OFFSET, moment[:, 2]), strict=True))
    kept = np.append(np.diff(found.times) > 0.5 * step, True)  # a jump of the drive has two rows
    rng, rows = np.random.default_rng(seed), {}
    for column, (noise, interval) in SAMPLED.items():
        curve = CubicSpline(found.times[kept], curves[column][kept])
        for ms in range(interval, round(1000 * DURATION) + 1, interval):
            rows.setdefault(ms, {})[column] = float(curve(1e-3 * ms)) + noise * rng.normal()
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description="Let Exudyn measure a four-bar that was assembled wrong.")
    parser.add_argument("--out", type=Path, default=FILE)
    parser.add_argument("--rfes", type=int, default=15)
    parser.add_argument("--step", type=float, default=1e-4)
    asked = parser.parse_args()
    lines = [",".join(["time_s", *SAMPLED])]
    for ms, row in sorted(measure(asked.rfes, asked.step).items()):
        cells = (f"{row[column]:.4f}" if column in row else "" for column in SAMPLED)
        lines.append(",".join([f"{1e-3 * ms:.3f}", *cells]))
    asked.out.write_text("\n".join(lines) + "\n", encoding="utf-8")
    print(f"{asked.out} is written")


if __name__ == "__main__":
    main()
