"""Programs run as a user runs them, in processes of their own, on small inputs."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.conftest import QUICK_OPTIONS

ROOT = Path(__file__).parents[2]
LAUNCH = Path(__file__).with_name("launch.py")
# Compiled without most optimisations, and kept by JAX for the next test and the next session.
ENVIRONMENT = {
    "PYTHONPATH": str(ROOT),
    "JAX_PLATFORMS": "cpu",
    "JAX_DISABLE_MOST_OPTIMIZATIONS": "1",
    "JAX_COMPILATION_CACHE_DIR": str(ROOT / ".pytest_cache" / "compiled"),
    "MPLBACKEND": "agg",
}

QUICK_FLAGS = " ".join(f"--{name}={str(value).lower()}" for name, value in QUICK_OPTIONS.items())

PENDULUM = """
title = "A driven flexible link"

[mechanism.materials.steel]
youngs_modulus = "210 GPa"
poisson_ratio = 0.3
density = 7850.0
damping = 1e-5

[mechanism.sections.bar]
shape = "rectangle"
width = "10 mm"
height = "10 mm"

[[mechanism.links]]
name = "bar"
length = 0.3
section = "bar"
material = "steel"
rfes = 2

[[mechanism.joints]]
name = "A"
parent = "base"
child = "bar"

[drive]
joint = "A"
kind = "moment_ramp"
moment = 1.5
rise_time = 0.1

[simulation]
duration = 0.5
method = "rk4"
step = 1e-5
"""


@pytest.fixture(scope="session")
def run_program():
    """What a program of this repository prints, given its path, or its module's name, and its arguments; `compiled`:
    as it is, without `launch.py`."""

    def run(program, *arguments, code=0, compiled=False):
        environment = {**os.environ, **ENVIRONMENT}
        environment["XLA_FLAGS"] = QUICK_FLAGS
        environment["RFEM_JAX_NO_CACHE"] = "1"
        program = str(ROOT / program) if program.endswith(".py") else program
        plainly = [program] if program.endswith(".py") else ["-m", program]
        start = plainly if compiled else [str(LAUNCH), program]
        command = [sys.executable, *start, *map(str, arguments)]
        answer = subprocess.run(command, env=environment, cwd=ROOT, capture_output=True, text=True)
        assert answer.returncode == code, answer.stdout[-2000:] + answer.stderr[-4000:]
        return answer.stdout

    return run


@pytest.fixture(scope="session")
def pendulum_file(tmp_path_factory):
    """A study file whose simulation compiles in seconds, with derivatives too."""
    path = tmp_path_factory.mktemp("pendulum") / "pendulum.toml"
    path.write_text(PENDULUM, encoding="utf-8")
    return path


def rows_of(text):
    """Cells of the rows of Markdown tables, without heads."""
    lines = [line.strip().strip("|").split("|") for line in text.splitlines() if line.startswith("|")]
    return [[cell.strip() for cell in line] for line in lines if not set(line[0]) <= {"-"}]
