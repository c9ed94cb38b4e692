"""The module of Exudyn as all programs here use it, and mechanisms for it.

Place in the pipeline: rfem_jax.exchange -> **exudyn_engine** -> exudyn_speed, exudyn_studies and others.

The mechanism in Exudyn is that of `rfem_jax export --to exudyn` (`rfem_jax.exchange.exudyn_mechanism`, whose
`exudyn_program` runs it), but that it starts in Exudyn's own static equilibrium, sought from the nominal start.
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

from rfem_jax.exchange.exudyn_mechanism import drive_pieces, exudyn_numbers  # noqa: E402
from rfem_jax.exchange.exudyn_program import Result, Settings, equilibrium, move  # noqa: E402

__all__ = ["PLANAR", "drive_pieces", "exu", "exudyn_numbers", "exut", "simulate"]

exu.config.printToConsole = False  # a solver that fails says so by its exception
PLANAR = Settings(nodes="angles")  # links turn about axes near the hinges'


def simulate(model, errors, drive, duration, step, settings=PLANAR, window=None, track=()) -> Result:
    """Static equilibrium with the driven joint held, then motion, all by Exudyn.

    **Arguments:** as of `rfem_jax.simulate` and of `move`.

    **Raises:** exudyn's `SolverError` where Newton's method fails.
    """
    mechanism = exudyn_numbers(model, errors) | drive_pieces(drive, duration)
    return move(mechanism, step, settings, equilibrium(mechanism, settings)[0], track, window)
