"""How long it takes to find errors from measurements: estimate, intervals, check of the model, and what can be known.

    python benchmarks/identification.py [--rfes 5] [--duration 1] [--repeat 3]

The four-bar of `studies/identify_misassembly` and its drive, measured at 500 Hz on a machine of three times as many
rfes: three errors from two signals, and ten errors from four. Seconds of the processor, the first time and, medians,
again in the same process.
"""

import argparse
import statistics
import time
from pathlib import Path

import jax

jax.config.update("jax_enable_x64", True)

import numpy as np  # noqa: E402

from rfem_jax import (  # noqa: E402
    GeneralisedAlpha,
    Normal,
    Sensor,
    Simulation,
    Tolerances,
    assembly_errors,
    discretise,
    identifiability,
    identify,
    load_study,
    simulate,
)

STUDY = load_study(Path(__file__).parents[1] / "studies" / "identify_misassembly" / "study.toml")
NOISE = {"rate_rad_s": 0.15, "D_moment_z_Nm": 0.2, "D_moment_x_Nm": 0.2, "B_moment_z_Nm": 0.2}  # as the study has
TILTS = ("D.delta_x", "D.delta_z", "A.delta_x", "A.delta_z", "B.delta_z", "B.child.delta_z", "C.delta_z")
LENGTHS = ("D.d_y", "coupler.length", "D.d_x")
THREE = ("D.delta_x", "D.delta_z", "D.d_y")
CASES = {"3 errors, 2 signals": (THREE, 2), "10 errors, 4 signals": ((*TILTS, *LENGTHS), 4)}


def curve(run, column: str) -> np.ndarray:
    """A column of a run."""
    if column == "rate_rad_s":
        return np.asarray(run.motion.rate)
    joint, _, axis, _ = column.split("_")
    return np.asarray(run.loads[joint].moment)[:, "xyz".index(axis)]


def simulation(rfes: int, duration: float) -> Simulation:
    """The study's mechanism in so many rfes a flexible link."""
    model = discretise(STUDY.mechanism, rfes)
    method = GeneralisedAlpha(step=1e-3)
    return Simulation(model, drive=STUDY.drive, method=method, duration=duration, save_every=2e-3)


def measured(errors: tuple[str, ...], columns: list[str], options) -> dict[str, np.ndarray]:
    """Noisy signals of a machine with a third of a tolerance of every error."""
    machine = simulation(3 * options.rfes, options.duration)
    truth = {name: (0.2 if name in TILTS else 0.2e-3) * (-1.0) ** i for i, name in enumerate(errors)}
    truth = {name: np.radians(value) if name in TILTS else value for name, value in truth.items()}
    run, rng = simulate(machine, assembly_errors(machine.model, truth)), np.random.default_rng(5)
    found = {name: curve(run, name) + NOISE[name] * rng.normal(size=run.times.shape) for name in columns}
    return {"time_s": np.asarray(run.times), **found}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rfes", type=int, default=5, help="of each flexible link")
    parser.add_argument("--duration", type=float, default=1.0, help="s")
    parser.add_argument("--repeat", type=int, default=3)
    parser.add_argument("--samples", type=int, default=256, help="runs of the importance sampling")
    options = parser.parse_args()
    problem, finer = (simulation(n, options.duration) for n in (options.rfes, 2 * options.rfes - 1))
    print("| | first, s | again, s | status | largest deviation of an error from the truth's, its own deviations |")
    print("|---|---|---|---|---|")
    for title, (errors, signals) in CASES.items():
        columns = [*NOISE][:signals]
        data = measured(errors, columns, options)
        tolerances = Tolerances({name: Normal("0.6 deg" if name in TILTS else "0.6 mm") for name in errors})
        sensors, times = {name: Sensor(NOISE[name]) for name in columns}, []
        for _ in range(1 + options.repeat):
            started = time.process_time()
            identifiability(problem, sensors, tolerances)
            found = identify(problem, data, sensors, tolerances, finer=finer, samples=options.samples)
            times.append(time.process_time() - started)
        truth = np.array([np.radians(0.2) if name in TILTS else 0.2e-3 for name in errors])
        truth *= (-1.0) ** np.arange(len(errors))
        apart = np.abs(found.estimate - truth) / found.deviation
        print(f"| {title} | {times[0]:.3g} | {statistics.median(times[1:] or times):.3g} | {found.status} | "
              f"{apart.max():.2g} |")  # fmt: skip


if __name__ == "__main__":
    main()
