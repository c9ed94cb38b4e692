"""Functions of time of the user's own, sampled densely before a step is chosen.

Place in the pipeline: driving, time_grid -> **sampled_laws** -> accuracy.

Rows of tables are ends of steps; of a function nothing is known between the instants at which it is evaluated.  A peak
that lies between two trial steps would be seen by neither, and both would agree.  Here functions alone are evaluated,
at many more instants than steps are tried with.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from rfem_jax.description.drives.rotations import GivenDrive, MomentFunction, PrescribedFunction
from rfem_jax.description.drives.translations import ForceFunction
from rfem_jax.mechanics.laws.frame_forces import Time
from rfem_jax.mechanics.laws.point_laws import FunctionVector
from rfem_jax.mechanics.model.model import Model
from rfem_jax.simulation.system.driving import Drive, active_drives, all_jumps
from rfem_jax.simulation.system.time_grid import TimeGrid

SAMPLES = 1024  # of a function in an interval of the trials
CURVED = 0.25  # of its range: by so much a function may differ from straight lines between steps that see it


def steps_that_see(model: Model, drive: Drive, grid: TimeGrid, most: int) -> int | None:
    """The smallest power of two of steps in an interval of a grid between which functions of time are nearly straight,
    at least 1; None where `most` are too few."""
    values = _sampled(model, drive, grid)
    found = 1
    for one in values:
        allowed = CURVED * np.ptp(one) + 1e-300
        while found <= most and _largest_curve(one, found) > allowed:
            found *= 2
    return found if found <= most else None


def _largest_curve(values: np.ndarray, steps: int) -> float:
    """Largest difference of samples (intervals, SAMPLES + 1, ...) from straight lines between the ends of steps."""
    size = SAMPLES // steps
    ends = values[:, ::size]
    share = np.linspace(0.0, 1.0, size + 1).reshape(-1, *[1] * (values.ndim - 2))
    straight = ends[:, :-1, None] + share * (ends[:, 1:, None] - ends[:, :-1, None])
    seen = np.stack([values[:, i : i + SAMPLES : size] for i in range(size)], axis=2)
    return float(np.abs(seen - straight[:, :, :-1]).max())


def _sampled(model: Model, drive: Drive, grid: TimeGrid) -> list[np.ndarray]:
    """Values (intervals, SAMPLES + 1, ...) of all functions of time; of prescribed motions the accelerations."""
    active = active_drives(model, drive)
    functions = [
        k
        for k, one in zip(active.coordinates, active.drives, strict=True)
        if isinstance(one, (MomentFunction, ForceFunction, PrescribedFunction))
    ]
    vectors = [one for one in model.vectors_of_time if isinstance(one, FunctionVector)]
    if not functions and not vectors:
        return []
    passed = jnp.asarray((-1.0, *all_jumps(drive, model)))
    given = [k for k, one in zip(active.coordinates, active.drives, strict=True) if isinstance(one, GivenDrive)]

    def at(t, phase):
        found = active.at(t, phase)
        forces = [found.forces[k] if k in given else found.motions[k][2] for k in functions]
        return [*forces, *(vector.at(Time(t, passed[phase])) for vector in vectors)]

    times = grid.starts[:, None] + grid.lengths[:, None] * np.linspace(0.0, 1.0, SAMPLES + 1)
    values = jax.vmap(jax.vmap(at, (0, None)))(jnp.asarray(times), jnp.asarray(grid.phases))
    known = [np.asarray(one) for one in values if not isinstance(one, Tracer)]
    return [one for one in known if np.isfinite(one).all()]
