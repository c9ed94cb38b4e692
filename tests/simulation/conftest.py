"""A small four-bar whose compiled simulation the tests of this folder share."""

from typing import NamedTuple

import jax
import pytest

from rfem_jax import Method, Model, MomentRamp, assembly_errors, discretise, simulate
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
        "method": Method("rk4", step=2e-5),
        "save_every": 1e-3,
    }

    @jax.jit
    def run(values):
        return simulate(model, assembly_errors(model, values), **settings)

    return Small(model, drive, settings, run)
