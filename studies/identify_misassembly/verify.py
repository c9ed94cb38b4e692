"""Whether the machine keeps what the correction promises: the true machine, which the estimate does not know, with the
adjustments that `rfem-jax identify` proposed.

    python studies/identify_misassembly/verify.py RESULTS [--study STUDY.toml]

RESULTS is the folder with identification.json. Prints the metric of the true machine beside the promised interval for
every correction; measure.py, beside this file, has the machine.
"""

import argparse
import json
from pathlib import Path

from measure import FOLDER, TRUTH, true_run

from rfem_jax import load_study, metric
from rfem_jax.tolerancing.checks import parse_error


def verify(file: Path, results: Path) -> list[tuple[str, float, float, float]]:
    """(correction, promised from, to, of the true machine) of every correction."""
    study = load_study(file)
    correction = json.loads((results / "identification.json").read_text(encoding="utf-8"))["correction"]
    truth, found = {name: parse_error(text, name)[0] for name, text in TRUTH.items()}, []
    for outcome in correction["outcomes"]:
        errors = dict(truth)
        for name, amount in zip(correction["adjustments"], outcome["amounts"], strict=True):
            errors[name] = errors.get(name, 0.0) + amount
        value = float(metric(correction["metric"])(true_run(study, errors)))
        found.append((outcome["name"], outcome["low"], outcome["high"], value))
    return found


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Compare the true machine with what a correction promises.")
    parser.add_argument("results", type=Path)
    parser.add_argument("--study", type=Path, default=FOLDER / "study.toml")
    asked = parser.parse_args()
    for name, low, high, value in verify(asked.study, asked.results):
        verdict = "kept" if low <= value <= high else "not kept"
        print(f"{name:14} promised {low:.4g} to {high:.4g}, true machine {value:.4g}: {verdict}")
