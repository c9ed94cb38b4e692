"""Results as labelled data: what a kind of result gives, and the forms that are made of it.

Place in the pipeline: beside all packages, and imports none of them; results of tolerancing are `LabelledResult`s, and
`Run` (simulation) describes its arrays as they do. xarray, and with it pandas, is imported when a result becomes a
Dataset or a DataFrame: that takes as long as a quarter of a short command, which needs neither.

Datasets can be written to netCDF (`dataset.to_netcdf(path, engine="scipy")`): attributes are strings and numbers,
names are strings, and there are no objects.
"""

import abc
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from rfem_jax.rich_text import document, paragraph, table
from rfem_jax.text_layout import align_columns, wrap_lines

if TYPE_CHECKING:
    from pandas import DataFrame
    from xarray import Dataset
else:
    DataFrame = Dataset = Any
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


Arrays = tuple[dict[str, Labelled], dict[str, Any], dict[str, Any]]  # variables, coordinates, attributes


@dataclass(frozen=True)
class Table:
    """Texts in rows under a header; columns whose index is in `words` to the left, those of numbers to the right."""

    header: Sequence[str]
    rows: Sequence[Sequence[str]]
    words: Sequence[int] = (0,)

    def text(self) -> str:
        """For a terminal."""
        return align_columns(self.header, self.rows, self.words)

    def html(self) -> str:
        """For a notebook."""
        return table(self.header, self.rows, self.words)


Parts = Sequence[str | Table]  # sentences and tables in their order; "" is an empty line of a text


class LabelledResult(abc.ABC):
    """A result: a kind of it says what it holds and what is shown of it, each once, and all forms are made of that."""

    index: ClassVar[tuple[str, ...]]  # columns of `rows` that tell them apart

    @abc.abstractmethod
    def arrays(self) -> Arrays:
        """All arrays with their dimensions, units and meanings, {name: array}; those that are None are left out."""

    @abc.abstractmethod
    def rows(self) -> list[dict[str, Any]]:
        """The result as one table, {column with unit: value} a row, as CSV files have it."""

    @abc.abstractmethod
    def parts(self) -> Parts:
        """The result in words: first what it is, then sentences and tables."""

    def notes(self) -> Sequence[str]:
        """What a reader of its numbers must know besides, as that a metric is a bound of what it is named after."""
        return ()

    def to_xarray(self) -> Dataset:
        """An `xarray.Dataset` of `arrays`."""
        variables, coordinates, attributes = self.arrays()
        notes = self.notes()
        return dataset(variables, coordinates, {**attributes, "notes": " ".join(notes)} if notes else attributes)

    def to_pandas(self) -> DataFrame:
        """A `pandas.DataFrame` of `rows`."""
        return frame(self.rows(), self.index)

    def __str__(self) -> str:
        return text_of([*self.parts(), *self.notes()])

    def _repr_html_(self) -> str:
        title, *parts = (*self.parts(), *self.notes())
        shown = (one.html() if isinstance(one, Table) else paragraph(one) for one in parts if one)
        return document(str(title), *shown)


def text_of(parts: Parts) -> str:
    """Sentences, their lines broken where they are too long, and tables as text."""
    return "\n".join(one.text() if isinstance(one, Table) else wrap_lines(one) for one in parts)


def dataset(
    variables: Mapping[str, Labelled],
    coordinates: Mapping[str, Labelled | Sequence[str]],
    attributes: Mapping[str, Any],
) -> Dataset:
    """An `xarray.Dataset` of what is not None.

    Args: variables {name: array}; coordinates {name: array, or the names along the dimension `name`}; attributes of
        the whole.
    """
    import xarray

    named = {
        name: one.variable() if isinstance(one, Labelled) else ((name,), text_array(one), {})
        for name, one in coordinates.items()
    }
    found = {name: one.variable() for name, one in variables.items() if one.values is not None}
    return xarray.Dataset(found, named, {name: one for name, one in attributes.items() if one is not None})


def frame(rows: Sequence[Mapping[str, Any]], index: Sequence[str] = ()) -> DataFrame:
    """A `pandas.DataFrame` of rows, with some columns as its index."""
    import pandas

    made = pandas.DataFrame(list(rows))
    return made.set_index(list(index)) if index else made


def text_array(texts: Iterable[str]) -> np.ndarray:
    """Texts as an array that netCDF can hold."""
    return np.array(list(texts), dtype=np.str_)


def named_dimension(dimension: str, names: Sequence[str], units: Iterable[str]) -> dict[str, Any]:
    """Coordinates of a dimension: its names and their units."""
    return {
        dimension: tuple(names),
        f"{dimension}_unit": Labelled((dimension,), text_array(unit or "1" for unit in units)),
    }


def limit_coordinates(limits: Iterable[Any]) -> dict[str, Labelled]:
    """Coordinates of the dimension `limit_number`: `metric`, `side` and `unit` of every limit."""
    named = {"metric": "metric", "side": "side", "limit_unit": "unit"}
    return {
        name: Labelled(("limit_number",), text_array(getattr(one, field) or "1" for one in limits))
        for name, field in named.items()
    }


def column_name(name: str, unit: str) -> str:
    """Name of a column of a table: with its unit, "time_s", "rate_rad_s", "D.mean_square_moment_N2m2"; without one
    where it has none."""
    while (power := re.search(r"\(([^()]*)\)\^(\d+)", unit)) is not None:
        factors = " ".join(f"{factor}^{power[2]}" for factor in power[1].split())
        unit = f"{unit[: power.start()]}{factors}{unit[power.end() :]}"
    suffix = unit.replace(" ", "").replace("^", "").replace("/", "_")
    return f"{name}_{suffix}" if suffix else name
