"""Runs a program of this repository, `launch.py PROGRAM ARGUMENTS`, as Python would; but what is not worth its
compilation is evaluated by NumPy, as in the other tests."""

import gc
import runpy
import sys
from pathlib import Path

from rfem_jax.compilation import options

options.take_process()

from tests.evaluation_by_numpy import instead_of_compilation  # noqa: E402

if __name__ == "__main__":
    program = sys.argv[1]
    del sys.argv[0]
    gc.set_threshold(200_000, 20, 20)  # as in tests/conftest.py
    with instead_of_compilation():
        if program.endswith(".py"):
            sys.path[0] = str(Path(program).parent)
            runpy.run_path(program, run_name="__main__")
        else:
            sys.path[0] = str(Path.cwd())
            runpy.run_module(program, run_name="__main__", alter_sys=True)
