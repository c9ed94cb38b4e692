"""The module of Exudyn as all programs here use it, and its axes.

Place in the pipeline: **exudyn_engine** -> exudyn_joints -> exudyn_models -> exudyn_runs.

Exudyn's revolute joint turns about z, ours about y: all axes, global and of bodies, are renamed in a circle,
(x, y, z) there = (z, x, y) here.
"""

import contextlib
import io
import os
import sys

os.environ.setdefault("OMP_NUM_THREADS", "1")
sys.exudynFast = True  # the module without range checks, for fair times

try:
    with contextlib.redirect_stdout(io.StringIO()):
        import exudyn as exu
        import exudyn.utilities as exut
except ImportError as missing:
    raise SystemExit(
        "The package exudyn must be there to compare with it, but it cannot be imported; install "
        'it with `pip install "rfem_jax[bench]"`.'
    ) from missing

__all__ = ["BACK", "HINGE", "TURNED", "exu", "exut"]

exu.config.printToConsole = False  # a solver that fails says so by its exception

TURNED = [2, 0, 1]  # ours -> Exudyn's axes
BACK = [1, 2, 0]
HINGE = 2
