"""Labelled data for other programs: xarray Datasets and pandas DataFrames with units, without requiring either.

Place in the pipeline: beside all packages, and imports none of them. `Run` (simulation) and the results of
tolerancing describe their arrays as `Labelled` variables; `dataset` and `frame` make of them what the user's program
reads. Both libraries come with the extra `xarray` and are imported when they are asked for.

Datasets can be written to netCDF (`dataset.to_netcdf(path, engine="scipy")`): attributes are strings and numbers,
names are strings, and there are no objects.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from typing import Any

import numpy as np

Dataset = Any  # `xarray.Dataset`, and
DataFrame = Any  # `pandas.DataFrame`: libraries that need not be there
COMPONENTS = ("x", "y", "z")
ESTIMATE = ("value", "low", "high")  # an estimate and the ends of its interval


@dataclass(frozen=True)
class Labelled:
    """An array with the names of its dimensions.

    Args:
        dims: a name for each dimension.
        values: numbers, or strings.
        units: "N m", "1" for a plain number; "" where it changes along a dimension, whose unit is then a coordinate.
        long_name: for axes of plots and tables.
        attributes: further ones.
    """

    dims: tuple[str, ...]
    values: Any
    units: str = ""
    long_name: str = ""
    attributes: Mapping[str, Any] = field(default_factory=dict)

    def variable(self) -> tuple[tuple[str, ...], np.ndarray, dict[str, Any]]:
        """As `xarray.Dataset` takes it."""
        said = {name: text for name, text in (("units", self.units), ("long_name", self.long_name)) if text}
        return self.dims, np.asarray(self.values), {**said, **self.attributes}


def dataset(
    variables: Mapping[str, Labelled],
    coordinates: Mapping[str, Labelled | Sequence[str]],
    attributes: Mapping[str, Any],
) -> Dataset:
    """An `xarray.Dataset`.

    Args: variables {name: array}; coordinates {name: array, or the names along the dimension `name`}; attributes of
        the whole.
    Raises: ModuleNotFoundError where xarray is not installed.
    """
    xarray = require("xarray")
    named = {
        name: one.variable() if isinstance(one, Labelled) else ((name,), np.array(list(one), dtype=np.str_), {})
        for name, one in coordinates.items()
    }
    return xarray.Dataset({name: one.variable() for name, one in variables.items()}, named, dict(attributes))


def frame(rows: Sequence[Mapping[str, Any]], index: Sequence[str] = ()) -> DataFrame:
    """A `pandas.DataFrame` of rows, with some columns as its index.

    Raises: ModuleNotFoundError where pandas is not installed.
    """
    pandas = require("pandas")
    made = pandas.DataFrame(list(rows))
    return made.set_index(list(index)) if index else made


def require(module: str) -> Any:
    """The module "xarray" or "pandas". Raises: ModuleNotFoundError, with what to install."""
    try:
        return import_module(module)
    except ImportError as problem:
        raise ModuleNotFoundError(
            f'Labelled data need the package {module}, which is not installed: pip install "rfem_jax[xarray]".',
            name=module,
        ) from problem


def column_name(name: str, unit: str) -> str:
    """Name of a column of a table: with its unit, "time_s", "rate_rad_s", "D.mean_square_moment_N2m2"; without one
    where it has none."""
    while (power := re.search(r"\(([^()]*)\)\^(\d+)", unit)) is not None:
        factors = " ".join(f"{factor}^{power[2]}" for factor in power[1].split())
        unit = f"{unit[: power.start()]}{factors}{unit[power.end() :]}"
    suffix = unit.replace(" ", "").replace("^", "").replace("/", "_")
    return f"{name}_{suffix}" if suffix else name
