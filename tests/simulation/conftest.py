"""A small four-bar whose compiled simulation the tests of this folder share."""

from typing import NamedTuple

import jax
import pytest

from rfem_jax import Model, MomentRamp, RungeKutta4, Simulation, assembly_errors, discretise, simulate
from tests.mechanisms import four_bar


class Small(NamedTuple):
    """A four-bar with 3 rfes a link, its drive, and simulate with everything but errors fixed."""

    model: Model
    drive: MomentRamp
    settings: dict
    run: object


@pytest.fixture(scope="session")
def small():
    model = discretise(four_bar(3))
    drive = MomentRamp("A", 1.5, 0.01)
    settings = {
        "drive": drive,
        "duration": 0.02,
        "method": RungeKutta4(step=2e-5),
        "save_every": 1e-3,
    }

    @jax.jit
    def run(values):
        return simulate(Simulation(model, **settings), assembly_errors(model, values))

    return Small(model, drive, settings, run)
