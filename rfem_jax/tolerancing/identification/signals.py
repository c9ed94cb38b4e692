"""Signals: time histories of a run by the names of the columns of its CSV file, as metrics with an axis of times.

Place in the pipeline: Run -> **signals** -> predictions. A problem whose metrics are signals returns {column: (T,)}.

Symbols: T saved times.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from rfem_jax.compilation.naming import Names, NotRenamable
from rfem_jax.description.basics.errors import InputError, suggestion
from rfem_jax.description.tasks.identification import TIME, unit_of_column
from rfem_jax.labelled_data import COMPONENTS, column_name
from rfem_jax.tolerancing.problems.problem import Metric

Column = tuple[str, Callable[[], Any]]


class Signal(Metric):
    """A column of a run; programs know it by the names of the things that it reads."""

    def renamed(self, names: Names) -> "Metric":
        """Raises: NotRenamable."""
        raise NotRenamable(self.name)


@dataclass(frozen=True)
class _OfRun:
    """A column of a run. A class and no function in a function, so that programs are known by its values."""

    column: str

    def __call__(self, run: Any) -> Float[Array, " T"]:
        columns = dict(run_columns(run))
        if self.column not in columns:
            raise InputError(
                f"Argument `signals` must name columns of a run of this mechanism, but it has no `{self.column}`; "
                f"{suggestion(self.column, columns)}"
            )
        return jnp.asarray(columns[self.column]())


def signal(column: str) -> Signal:
    """The metric of a column, as "rate_rad_s", "A_force_x_N", "P_velocity_z_m_s".

    Raises: InputError for a name that does not end in an SI unit, and in use for a column that the run has not.
    """
    return Signal(column, unit_of_column(column), function=_OfRun(column))


def run_columns(run: Any) -> Iterator[Column]:
    """(column, function that returns its values (T,)) of a run, as `rfem-jax run` names and writes them; traced."""
    motion = run.motion
    yield TIME, lambda: run.times
    yield "angle_rad", lambda: motion.angle
    yield "rate_rad_s", lambda: motion.rate
    yield "drive_moment_Nm", lambda: motion.drive_moment
    for joint, load in run.loads.items():
        yield from _components(f"{joint}_force_", "N", lambda load=load: load.force)
        yield from _components(f"{joint}_moment_", "N m", lambda load=load: load.moment)
    yield from _of_coordinates(motion)
    for point, path in run.points.items():
        yield from _components(f"{point}_", "m", lambda path=path: path.position)
        yield from _components(f"{point}_velocity_", "m/s", lambda path=path: path.velocity)
        yield from _components(f"{point}_acceleration_", "m/s^2", lambda path=path: path.acceleration)
        yield from _components(f"{point}_angle_", "rad", lambda path=path: path.angles)


def _components(name: str, unit: str, values: Callable[[], Any]) -> Iterator[Column]:
    for axis, letter in enumerate(COMPONENTS):
        yield column_name(f"{name}{letter}", unit), lambda axis=axis: values()[:, axis]


def _of_coordinates(motion: Any) -> Iterator[Column]:
    """Driven coordinates by their labels, and those of the joints of the tree."""
    for label, drive in motion.drives.items():
        joint, _, along = label.partition(".")
        turns = along.startswith("R") if along else joint in motion.angles
        words = ("angle", "rad", "rate", "rad/s", "moment", "N m")
        where, unit, rate, rate_unit, load, load_unit = (
            words if turns else ("displacement", "m", "speed", "m/s", "force", "N")
        )
        name = f"{label}_drive".replace(".", "_") if along else f"{label}_drive"
        yield column_name(f"{name}_{where}", unit), lambda drive=drive: drive.position
        yield column_name(f"{name}_{rate}", rate_unit), lambda drive=drive: drive.rate
        yield column_name(f"{name}_{load}", load_unit), lambda drive=drive: drive.force
    for what, unit, by_joint in (("angle", "rad", motion.angles), ("displacement", "m", motion.displacements)):
        for joint, values in by_joint.items():
            if values.ndim == 1:
                yield column_name(f"{joint}_{what}", unit), lambda values=values: values
            for n in range(values.shape[1] if values.ndim == 2 else 0):
                yield column_name(f"{joint}_{what}_{n + 1}", unit), lambda values=values, n=n: values[:, n]
