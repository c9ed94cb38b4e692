"""One simulation: the function that users call, and its stages.

Place in the pipeline: Simulation, errors -> **simulate** -> Run.

    designed      numbers of the design put into the model and its drives
    prepare       errors applied, mechanism assembled: start state and preload
    advance       motion integrated over the time grid
    conclude      loads, balances, metrics and status observed
    run_of        results by the names of joints, links and drives
"""

import dataclasses
from collections.abc import Iterable, Sequence
from functools import partial
from typing import Any

import diffrax

from rfem_jax.compilation.program import Program
from rfem_jax.mechanics.model.errors import AssemblyErrors, Deviations, Errors, deviations_of
from rfem_jax.mechanics.model.model import Model, State
from rfem_jax.mechanics.statics.designs import Design, designed
from rfem_jax.simulation.locking import with_limit
from rfem_jax.simulation.outcome.records import asks_perfect_path, require_records
from rfem_jax.simulation.outcome.run import Run
from rfem_jax.simulation.specification import Simulation, simulation_of_call
from rfem_jax.simulation.stages.conclusion import Conclusion, run_of_design
from rfem_jax.simulation.stages.integration import advance, conclude, grid_for, perfect_paths, prepare, start_carry
from rfem_jax.simulation.stages.stepping import Integration
from rfem_jax.simulation.system.driving import drive_of_design


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
    "coupler.sections" (see `outcome.records`), into `run.recorded`. A model in place of the simulation, with
    `former` arguments, is the call of an earlier version, which warns.

    **Returns:** `Run`.  Works under jit, vmap, jacfwd; with fixed-step methods also grad, jacrev and Hessians (memory
    in reverse mode: the state at the end of every interval, and the steps of one interval; with an implicit method the
    state at the end of every step).

    **Raises:** `InputError` for arguments that cannot be used.  A run that fails says so in its status.
    """
    simulation = simulation_of_call("simulate", simulation, former)
    model, method, design = simulation.model, simulation.chosen, simulation.design
    grid, steps = grid_for(simulation.drive, simulation.require_duration(), method, simulation.save_every, model)
    drive = drive_of_design(model, simulation.drive, design)
    errors = deviations_of(model, errors)
    made = designed(model, design, errors)
    integration = Integration.of_any_step(made.model, drive, grid, steps, method, (made, simulation.start))
    asked = require_records(made.model, record)
    perfect = perfect_model(model, design, errors, asked)
    run = run_of_design(made, simulated(integration, made.errors, simulation.start, adjoint, asked, perfect))
    return with_limit(run, model, drive)


@partial(Program, nameless=True)
def simulated(
    integration: Integration,
    errors: AssemblyErrors,
    start: State | None,
    adjoint: diffrax.AbstractAdjoint | None,
    asked: Sequence[str],
    perfect: Model | None = None,
) -> Conclusion:
    """The conclusion of a simulation; `asked`: names as in `outcome.records`; `perfect`: as of `perfect_model`."""
    undisturbed = integration if perfect is None else dataclasses.replace(integration, model=perfect)
    paths = perfect_paths(undisturbed, asked, start, adjoint)
    prepared = prepare(integration.model, errors, integration.drive, start)
    carry, ends = advance(integration, prepared.actual, start_carry(integration, prepared), adjoint)
    return conclude(integration, prepared, carry, ends, asked, paths)


def perfect_model(model: Model, design: Design | None, errors: Deviations, asked: Sequence[str]) -> Model | None:
    """The model from which errors of paths are measured, if any record asks for these and it is not the one that is
    simulated: without deviations of parameters, which that has."""
    if not errors.parameters or not asks_perfect_path(asked):
        return None
    return designed(model, design).model
