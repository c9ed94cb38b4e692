"""Programs run as a user runs them, on small inputs."""

import io
import os
import runpy
import subprocess
import sys
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path

import jax
import pytest

from rfem_jax.report import command_line

ROOT = Path(__file__).parents[2]
COMMAND_LINE = "rfem_jax.report.command_line"
# Kept by JAX for the next test and the next session.
ENVIRONMENT = {
    "PYTHONPATH": str(ROOT),
    "JAX_PLATFORMS": "cpu",
    "JAX_COMPILATION_CACHE_DIR": str(ROOT / ".pytest_cache" / "compiled"),
    "MPLBACKEND": "agg",
}

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


def in_a_process_of_its_own(program, arguments):
    """Exit code, what is printed, and errors of a program that is compiled as it is."""
    environment = {**os.environ, **ENVIRONMENT, "RFEM_JAX_NO_CACHE": "1"}
    start = [program] if program.endswith(".py") else ["-m", program]
    command = [sys.executable, *start, *arguments]
    answer = subprocess.run(command, env=environment, cwd=ROOT, capture_output=True, text=True)
    return answer.returncode, answer.stdout, answer.stderr


def in_this_process(program, arguments):
    """The same of a program in this process: what was compiled before is not compiled again."""
    said, errors = io.StringIO(), io.StringIO()
    with (
        pytest.MonkeyPatch.context() as patch,
        redirect_stdout(said),
        redirect_stderr(errors),
        jax.numpy_dtype_promotion("standard"),
        jax.numpy_rank_promotion("allow"),
    ):
        patch.chdir(ROOT)
        patch.setattr(sys, "argv", [program, *arguments])
        patch.setattr(command_line, "set_up_jax", lambda *_: None)  # JAX has started, with one device
        if program == COMMAND_LINE:
            return command_line.main(arguments), said.getvalue(), errors.getvalue()
        before = dict(sys.modules)
        patch.syspath_prepend(str(Path(program).parent))
        try:
            runpy.run_path(program, run_name="__main__")
            code = 0
        except SystemExit as end:
            code = end.code or 0
        for name in [name for name, module in sys.modules.items() if name not in before and _beside(module, program)]:
            del sys.modules[name]
    return code, said.getvalue(), errors.getvalue()


def _beside(module, program):
    """Whether a module was found beside a program; another program may have one of the same name."""
    return Path(getattr(module, "__file__", None) or "").parent == Path(program).parent


@pytest.fixture(scope="session")
def run_program():
    """What a program of this repository prints, given its path, or its module's name, and its arguments; `compiled`:
    as a user's process does it."""

    def run(program, *arguments, code=0, compiled=False):
        program = str(ROOT / program) if program.endswith(".py") else program
        run_it = in_a_process_of_its_own if compiled else in_this_process
        found, said, errors = run_it(program, [*map(str, arguments)])
        assert found == code, said[-2000:] + errors[-4000:]
        return said

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
