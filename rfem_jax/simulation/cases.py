"""All cases of a study as one batch, in pieces of time so that progress is seen.

Place in the pipeline: study -> **cases** -> report.
"""

import dataclasses
import functools
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from rfem_jax.compilation.program import Program
from rfem_jax.description.drives.driven_motions import Drive
from rfem_jax.description.methods import Method
from rfem_jax.description.metrics.catalogue import records_for
from rfem_jax.description.study_file.study import Study
from rfem_jax.labelled_data import DataFrame, Dataset, frame
from rfem_jax.mechanics.model.errors import Deviations, deviations
from rfem_jax.mechanics.model.model import Model
from rfem_jax.mechanics.statics.designs import model_of_study
from rfem_jax.simulation.accuracy import choose_method
from rfem_jax.simulation.locking import with_limit
from rfem_jax.simulation.outcome import labelled_runs
from rfem_jax.simulation.outcome.records import require_records
from rfem_jax.simulation.outcome.run import Run, of_model, one_of
from rfem_jax.simulation.simulating import simulate
from rfem_jax.simulation.specification import Simulation
from rfem_jax.simulation.stages import integration
from rfem_jax.simulation.stages.conclusion import run_of
from rfem_jax.simulation.stages.stepping import Integration
from rfem_jax.simulation.system.driving import require_driven
from rfem_jax.simulation.system.time_grid import TimeGrid
from rfem_jax.simulation.unfinished import Unfinished

PIECES = 20


class Runs(dict[str, Run]):
    """The runs of a study by case, with what shows and hands on all of them."""

    def to_xarray(self, axes: str = "joint") -> Dataset:
        """An `xarray.Dataset` as `Run.to_xarray` makes it, with the dimension `case`; `axes`: as there."""
        stacked = jax.tree.map(lambda *leaves: np.stack([np.asarray(leaf) for leaf in leaves]), *self.values())
        return labelled_runs.run_dataset(stacked, tuple(self), axes)

    def to_pandas(self) -> DataFrame:
        """A `pandas.DataFrame` with a row per case and joint: metrics and preload."""
        rows = [row for case, run in self.items() for row in labelled_runs.joint_rows(run, case)]
        return frame(rows, ["case", "joint"])

    def _repr_html_(self) -> str:
        return labelled_runs.runs_html(self)


def run_cases(
    study: Study,
    progress: Callable[[float], None] | None = None,
    model: Model | None = None,
    keep: Path | None = None,
) -> tuple[Model, Runs]:
    """Simulate all cases of a study as one batch.

    **Arguments:** `progress` is called with the fraction of simulated time; `model`: the study's mechanism if it is
    discretised already; `keep`: file in which an interruption (KeyboardInterrupt) leaves what is done, and from which
    the same call goes on, to the same numbers; None keeps nothing.

    **Returns:** the model, and a run of NumPy arrays for every case by its name.

    **Raises:** `InputError` as `choose_method`, and for a model whose driven joint is not that of the study's drive.
    """
    model = model_of_study(study) if model is None else model
    drive = study.designed_drive
    require_driven(model, drive)
    each = errors_of_cases(study, model)
    deviating = jax.tree.map(lambda *leaves: jnp.asarray(np.stack(leaves), jnp.float64), *each)
    errors = deviating.errors
    method = choose_method(model, study.method, drive, study.require_duration(), errors, study.save_every)
    grid, steps = integration.grid_for(drive, study.require_duration(), method, study.save_every, model)
    asked = require_records(model, records_for(study.metrics))
    if deviating.parameters:
        runs = with_limit(_run_with_parameters(model, deviating, drive, study, method, asked), model, drive)
        return model, Runs({case.name: one_of(runs, i) for i, case in enumerate(study.cases)})
    unfinished = Unfinished(keep, (model, errors, drive, study.require_duration(), method, study.save_every))
    whole = Integration.of_any_step(model, drive, grid, steps, method, errors)
    prepared, carry = integration.prepare_batch(whole, errors)
    try:
        carry, ends = _advance_all(whole, prepared, carry, unfinished, progress)
        conclusions = _conclude(whole, prepared, carry, ends, asked, _perfect(whole, asked))
        conclusions = jax.tree.map(np.asarray, conclusions)
    except KeyboardInterrupt:
        unfinished.write()
        raise
    unfinished.remove()
    runs = Runs()
    for i, (case, of_case) in enumerate(zip(study.cases, each, strict=True)):
        run = run_of(model, jax.tree.map(lambda x: np.asarray(x[i]), conclusions))
        runs[case.name] = with_limit(of_model(run, model, of_case.errors), model, drive)
    return model, runs


def errors_of_cases(study: Study, model: Model) -> list[Deviations]:
    """What deviates in every case; parameters that deviate in any case do so by zero in the others."""
    names = {name for case in study.cases for name in case.errors if name not in model.topology.error_names}
    zeros = dict.fromkeys(sorted(names), 0.0)
    return [deviations(model, zeros | case.errors) for case in study.cases]


def _run_with_parameters(
    model: Model, errors: Deviations, drive: Drive, study: Study, method: Method, asked: tuple[str, ...]
) -> Run:
    """Runs whose models differ, all at once."""

    settings = {"duration": study.require_duration(), "method": method, "save_every": study.save_every}
    simulation = Simulation(model, drive=drive, **settings)
    return jax.tree.map(np.asarray, jax.vmap(lambda one: simulate(simulation, one, record=asked))(errors))


def _advance_all(whole: Integration, prepared, carry, unfinished: Unfinished, progress):
    """The integrator's state at the end, and what it has recorded at the saved times; from where `unfinished` says."""
    pieces, duration = list(_pieces(whole.grid)), float((whole.grid.starts + whole.grid.lengths)[-1])
    first, carry, parts = unfinished.restore(carry)
    tree = None
    for number, piece in enumerate(pieces[first:], first + 1):
        carry, reached = _advance(dataclasses.replace(whole, grid=piece), prepared.actual, carry)
        leaves, tree = jax.tree.flatten(jax.tree.map(np.asarray, reached))
        parts.append(leaves)
        if number < len(pieces):  # the last piece gives the tree of all, and is computed again
            unfinished.reach(number, carry, parts)
        if progress is not None:
            progress(float((piece.starts + piece.lengths)[-1]) / duration)
    assert tree is not None
    count = len(whole.grid.starts)
    ends = [np.concatenate(leaves, axis=1)[:, :count] for leaves in zip(*parts, strict=True)]
    return carry, jax.tree.unflatten(tree, ends)


def _pieces(grid: TimeGrid):
    """The grid in pieces of equal size, for one compiled program."""
    count = len(grid.starts)
    size = -(-count // PIECES)
    for first in range(0, count, size):
        yield grid.piece(first, size)


@functools.partial(Program, nameless=True)
def _advance(whole, actual, carry):
    return jax.vmap(jax.jit(lambda actual, carry: integration.advance(whole, actual, carry)))(actual, carry)


@functools.partial(Program, nameless=True)
def _perfect(whole, asked):
    return integration.perfect_paths(whole, asked)


@functools.partial(Program, nameless=True)
def _conclude(whole, prepared, carry, ends, asked, perfect):
    def one(prepared, carry, ends):
        return integration.conclude(whole, prepared, carry, ends, asked, perfect)

    return jax.vmap(jax.jit(one))(prepared, carry, ends)
