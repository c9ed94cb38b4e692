"""One simulation: the function that users call.

Place in the pipeline: Simulation, errors -> **simulate** -> Run.
"""

from collections.abc import Iterable
from typing import Any

import diffrax

from rfem_jax.mechanics.model.errors import Errors, errors_of
from rfem_jax.mechanics.model.model import Model
from rfem_jax.simulation.driving import drive_of_design
from rfem_jax.simulation.integration import grid_for, simulate_steps
from rfem_jax.simulation.locking import with_limit
from rfem_jax.simulation.run import Run
from rfem_jax.simulation.specification import Simulation, simulation_of_call


def simulate(
    simulation: Simulation | Model | None = None,
    errors: Errors | None = None,
    *,
    adjoint: diffrax.AbstractAdjoint | None = None,
    record: str | Iterable[str] = (),
    **former: Any,
) -> Run:
    """Assemble a mechanism with its errors and simulate its motion.

    **Arguments:** `simulation`: what is simulated, how long and by which method; `errors` from `assembly_errors`, or
    {name: value} (None: perfect); `adjoint`: diffrax's adjoint, for adaptive methods only (None: forward mode; give
    `diffrax.RecursiveCheckpointAdjoint()` for reverse mode); `record`: what the run records besides, such as
    "coupler.sections" (see `simulation.records`), into `run.recorded`. A model in place of the simulation, with
    `former` arguments, is the call of an earlier version, which warns.

    **Returns:** `Run`.  Works under jit, vmap, jacfwd; with fixed-step methods also grad, jacrev and Hessians (memory
    in reverse mode: the state at the end of every interval, and the steps of one interval; with an implicit method the
    state at the end of every step).

    **Raises:** `InputError` for arguments that cannot be used.  A run that fails says so in its status.
    """
    simulation = simulation_of_call("simulate", simulation, former)
    model, drive, method = simulation.model, simulation.drive, simulation.chosen
    grid, steps = grid_for(drive, simulation.require_duration(), method, simulation.save_every, model)
    errors = errors_of(model, errors)
    run = simulate_steps(
        model, errors, drive, grid, method, steps, simulation.start, adjoint, record, simulation.design
    )
    design = simulation.design
    return with_limit(run, model, drive if design is None else drive_of_design(model, drive, design))
