"""The command keeps its programs, and the object code of their kernels: the second run traces none, writes the same
numbers, and says so; with --no-cache nothing is kept."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.processes import path_without_matplotlib
from tests.study_texts import STEEL, hinge, link, rectangle

ROOT = Path(__file__).parents[2]
STUDY = f"""
title = "Pendulum"
[mechanism]
gravity = [0.0, 0.0, -9.81]
{STEEL}{rectangle(height='"20 mm"')}{link("bar", 0.3)}{hinge("bar", 'angle = "GUESS deg"')}[drive]
joint = "A"
kind = "moment_ramp"
moment = 0.5
rise_time = 0.01
[simulation]
duration = 0.02
method = "rk4"
step = 1e-4
save_every = 0.01
[[cases]]
name = "P1"
[[cases]]
name = "P2"
errors = {{ "A.delta_x" = "0.5 deg" }}
"""


def run(folder, out, *options, angle="-90"):
    """What the command writes, in a process with a cache folder of its own."""
    study = folder / "study.toml"
    study.write_text(STUDY.replace("GUESS", angle), encoding="utf-8")
    command = [sys.executable, "-m", "rfem_jax.report.command_line", "run", str(study), "--out", str(folder / out)]
    environment = {key: value for key, value in os.environ.items() if not key.startswith(("JAX_", "RFEM_"))}
    environment |= dict.fromkeys(("HOME", "XDG_CACHE_HOME", "LOCALAPPDATA"), str(folder / "home"))
    environment |= {"JAX_PLATFORMS": "cpu", "JAX_DISABLE_MOST_OPTIMIZATIONS": "1"}
    environment["PYTHONPATH"] = path_without_matplotlib(folder / "path")
    answer = subprocess.run([*command, *options], env=environment, cwd=ROOT, capture_output=True, text=True)
    assert answer.returncode == 0, answer.stderr
    results = json.loads((folder / out / "results.json").read_text(encoding="utf-8"))
    return results, [(folder / out / f"{case}.csv").read_bytes() for case in ("P1", "P2")]


@pytest.mark.long
def test_a_second_run_traces_nothing_and_writes_the_same(tmp_path):
    first, histories = run(tmp_path, "first")
    made = first["compilation"]["programs_traced"]
    assert made > 3 and first["compilation"]["kept_programs"] == "used"
    assert first["compilation"]["kernels"] == "machine code"
    kept = [path.name for path in (tmp_path / "home" / "rfem_jax" / "programs").iterdir()]
    assert len(kept) > made > 3 and any(name.startswith("kernel_") for name in kept)
    again, same = run(tmp_path, "again")
    assert again["compilation"] == {**first["compilation"], "programs_traced": 0, "programs_loaded": made}
    assert same == histories and again["cases"] == first["cases"]
    other, different = run(tmp_path, "other", angle="-80")  # another model of the same topology
    assert other["compilation"]["programs_traced"] == 0 and different != histories
    files = {path: path.stat().st_mtime_ns for path in (tmp_path / "home").rglob("*") if path.is_file()}
    without, plain = run(tmp_path, "without", "--no-cache", angle="-80")
    assert without["compilation"]["kept_programs"] == "not used: switched off"
    assert plain == different
    assert files == {path: path.stat().st_mtime_ns for path in (tmp_path / "home").rglob("*") if path.is_file()}
