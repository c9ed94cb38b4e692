"""Signals: time histories of a run by the names of the columns of its CSV file, as metrics with an axis of times.

Place in the pipeline: Run -> **signals** -> predictions. A problem whose metrics are signals returns {column: (T,)}.

Symbols: T saved times.
"""

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from rfem_jax.compilation.naming import Names, NotRenamable
from rfem_jax.description.basics.errors import InputError, suggestion
from rfem_jax.description.metrics.shaking_metrics import RECORD
from rfem_jax.description.tasks.identification import TIME, unit_of_column
from rfem_jax.labelled_data import COMPONENTS, column_name
from rfem_jax.mechanics.dynamics.load_axes import AXES
from rfem_jax.mechanics.forces.bush_contacts import CONTACT_NAMES
from rfem_jax.tolerancing.problems.problem import Metric

# A strain gauge: LINK@FRACTION_strain_SIDE_m_m, or the stress there, SIDE of the section in the link's axes.
_GAUGE = re.compile(r"(?P<place>.+@[0-9.]+)_(?P<what>strain|stress)_(?P<side>-?[yz])_(m_m|Pa)")
_OF_AXES = re.compile(rf".+_(force|moment)_({'|'.join(AXES)})_[xyz]_(N|Nm)")
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
        gauge = _GAUGE.fullmatch(self.column)
        if gauge is not None:
            return _of_gauge(run, gauge)
        columns = dict(run_columns(run, in_axes=_OF_AXES.fullmatch(self.column) is not None))
        if self.column not in columns:
            raise InputError(
                f"Argument `signals` must name columns of a run of this mechanism, but it has no `{self.column}`; "
                f"{suggestion(self.column, columns)}"
            )
        return jnp.asarray(columns[self.column]())


def signal(column: str) -> Signal:
    """The metric of a column, as "rate_rad_s", "A_force_x_N", "P_velocity_z_m_s", or of a strain gauge on a link,
    "coupler@0.5_strain_z_m_m": at half its length on the side of the section towards z of the link.

    Raises: InputError for a name that does not end in an SI unit, and in use for a column that the run has not.
    """
    unit, gauge = unit_of_column(column), _GAUGE.fullmatch(column)
    records = () if gauge is None else (f"{gauge['place']}.sections",)
    if column.startswith(f"{RECORD}_"):
        records = (RECORD,)
    return Signal(column, unit, function=_OfRun(column), records=records)


def _of_gauge(run: Any, gauge: re.Match) -> Float[Array, " T"]:
    """Strain [m/m] or stress [Pa] at a gauge."""
    sections = run.recorded[f"{gauge['place']}.sections"]
    felt = sections.strain if gauge["what"] == "strain" else sections.direct_stress
    return felt(gauge["side"])[:, 0]


def run_columns(run: Any, in_axes: bool = False) -> Iterator[Column]:
    """(column, function that returns its values (T,)) of a run, as `rfem-jax run` names and writes them, but for
    energies; `in_axes`: with the loads of joints in other axes; traced."""
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
    yield from _of_forces(run)
    for axes in AXES if in_axes else ():
        loads = run.loads_in(axes)
        for joint, load in loads.items():
            yield from _components(f"{joint}_force_{axes}_", "N", lambda load=load: load.force)
            yield from _components(f"{joint}_moment_{axes}_", "N m", lambda load=load: load.moment)


def _of_forces(run: Any) -> Iterator[Column]:
    """Forces at and between points, couplings, contacts in bushes, and the load on the base where it is recorded."""
    for name, history in run.forces.items():
        yield column_name(f"{name}_length", "m"), lambda history=history: history.length
        yield column_name(f"{name}_tension", "N"), lambda history=history: history.tension
        yield from _components(f"{name}_force_", "N", lambda history=history: history.force)
        yield from _components(f"{name}_moment_", "N m", lambda history=history: history.moment)
    for name, history in run.couplings.items():
        sliding = _sliding(run, name)
        for side, slides in enumerate(sliding):
            what, unit = ("force", "N") if slides else ("moment", "N m")
            column = column_name(f"{name}_{('first', 'second')[side]}_{what}", unit)
            yield column, lambda history=history, side=side: history.loads[:, side]
        yield (
            column_name(f"{name}_deflection", "m" if sliding[1] else "rad"),
            lambda history=history: history.deflection,
        )
    for joint, state in run.contacts.items():
        for n, contact in enumerate(CONTACT_NAMES):
            yield column_name(f"{joint}_penetration_{contact}", "m"), lambda one=state, n=n: one.penetration[:, n]
            yield column_name(f"{joint}_contact_force_{contact}", "N"), lambda one=state, n=n: one.normal_force[:, n]
    if RECORD in run.recorded:
        yield from _components(f"{RECORD}_force_", "N", lambda: run.recorded[RECORD].force)
        yield from _components(f"{RECORD}_moment_", "N m", lambda: run.recorded[RECORD].moment)


def _sliding(run: Any, coupling: str) -> list[bool]:
    """Whether the two coordinates of a coupling slide."""
    first, second = run.model.couplings[coupling].coordinates
    return [run.model.topology.slides[first], run.model.topology.slides[second]]


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
