"""The numbers of drives that a design may set, and drives with other ones.

Place in the pipeline: family, driven_motions -> **numbers_by_name** -> the mechanics' `design`, simulation.

A number is called "drive.moment", or "drive.A.moment" by its motion ("A", "C.T_y") where there are several drives.
Times are none of them: they divide a run into pieces, which programs are compiled for.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike

from rfem_jax.description.basics.errors import InputError, subject, suggestion
from rfem_jax.description.basics.units import DIMENSIONS, quantity
from rfem_jax.description.drives.driven_motions import AnyDrive

NUMBER_DIMENSIONS = {"moment": "moment", "force": "force", "rate": "rate", "speed": "speed", "factor": "none"}


def drive_number_names(drives: Sequence[AnyDrive], labels: Sequence[str]) -> dict[str, tuple[int, str]]:
    """{name: (index of the drive, name of its number)} of all numbers of drives, by their full names and, of a single
    drive, by the short one; `labels`: of the motions that they act on."""
    found = {}
    for i, (drive, label) in enumerate(zip(drives, labels, strict=True)):
        if drive.number_name is not None:
            found[f"drive.{label}.{drive.number_name}"] = i, drive.number_name
            if len(drives) == 1:
                found[f"drive.{drive.number_name}"] = i, drive.number_name
    return found


def each_drive_number(drives: Sequence[AnyDrive], labels: Sequence[str]) -> dict[str, int]:
    """{name: index of the drive}, one name of each number: the shorter one."""
    names = drive_number_names(drives, labels)
    return {name: i for name, (i, _) in names.items() if len(drives) > 1 or name.count(".") == 1}


def drive_number_dimension(name: str) -> str | None:
    """Dimension of what is called like a number of a drive, None for other names."""
    return NUMBER_DIMENSIONS.get(name.rpartition(".")[2]) if name.startswith("drive.") else None


def drive_number_unit(name: str) -> str:
    """SI unit of a number of a drive."""
    return DIMENSIONS[NUMBER_DIMENSIONS[name.rpartition(".")[2]]][1]


def drive_number_value(drive: AnyDrive) -> Array | float:
    """The number of a drive [its unit]; 1 for a factor."""
    return 1.0 if drive.scaled_field is not None else getattr(drive, str(drive.number_name))


def read_drive_number(name: str, value: Any, where: str, labels: Sequence[str]) -> float:
    """A value as a number of a drive on one of the motions of these labels; raises InputError."""
    known = [f"drive.{number}" for number in NUMBER_DIMENSIONS]
    known += [f"drive.{label}.{number}" for label in labels for number in NUMBER_DIMENSIONS]
    if name not in known:
        raise InputError(f"{subject(where)} must be a number of a drive, but is none; {suggestion(name, known)}")
    return quantity(value, NUMBER_DIMENSIONS[name.rpartition(".")[2]], where)


def drives_with(
    drives: Sequence[AnyDrive], labels: Sequence[str], values: Mapping[str, ArrayLike]
) -> tuple[AnyDrive, ...]:
    """Drives with other numbers, by their names.

    Raises:
        InputError: a name is of no number of these drives.
    """
    known, found = drive_number_names(drives, labels), list(drives)
    for name, value in values.items():
        if name not in known:
            raise InputError(
                f"Argument `design` must fit the drive, but `{name}` is no number of it; {suggestion(name, known)}"
            )
        i, number = known[name]
        field = drives[i].scaled_field or number
        new = jnp.asarray(value, jnp.float64)
        new = new * getattr(drives[i], field) if number == "factor" else new
        found[i] = eqx.tree_at(lambda one, field=field: getattr(one, field), found[i], new)
    return tuple(found)
