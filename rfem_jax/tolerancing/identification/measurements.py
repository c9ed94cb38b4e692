"""Measured histories: each signal at its own times, read from a CSV file or given as arrays, and checked.

Place in the pipeline: CSV file or arrays -> **measurements** -> residuals.
"""

import csv
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from rfem_jax.description.basics.errors import InputError, suggestion
from rfem_jax.description.tasks.identification import TIME, Sensors, sensors_of

MACHINE = "machine"  # column of a file with several machines
FEWEST = 4  # samples of a signal
Data = str | Path | Mapping[str, Any]


@dataclass(frozen=True, eq=False)
class History:
    """One measured signal: column, times (n,) [s], values (n,) in its unit."""

    column: str
    times: Float[np.ndarray, " n"]
    values: Float[np.ndarray, " n"]

    def rough_noise(self) -> float:
        """Standard deviation of the noise by second differences: median of |y1 - 2 y2 + y3| / sqrt(6), to which a
        smooth signal that is sampled densely adds little (theory (17.9))."""
        bends = np.abs(np.diff(self.values, 2)) / np.sqrt(6.0)
        rough = 1.4826 * float(np.median(bends))
        return rough if rough > 0.0 else 1e-6 * float(np.ptp(self.values)) or 1.0


def read_signals(signals: Any) -> Sensors:
    """{column: Sensor} of what a call names. Raises InputError."""
    found = sensors_of([signals] if isinstance(signals, str) else signals, "signals")
    if not found:
        raise InputError("Argument `signals` must name at least one column, but names none; name what is measured.")
    return found


def read_data(data: Data, columns: Iterable[str]) -> list[History]:
    """The histories of these columns.

    Args: data, the path of a CSV file with `time_s` and these columns, in which an empty cell is a signal that was not
        sampled then; or a mapping (a DataFrame too) of the same names to arrays, in which a signal sampled at times of
        its own is a pair (times, values).
    Raises: InputError for files that cannot be read, missing columns, NaN, times that do not increase, few samples.
    """
    if isinstance(data, (str, Path)):
        return [_history(name, *pair, f"file `{data}`") for name, pair in _of_file(Path(data), list(columns)).items()]
    found = []
    for name in columns:
        _require_columns([name], data, "`data`")
        if isinstance(data[name], tuple):
            times, values = data[name]
        else:
            _require_columns([TIME], data, "`data`")
            times, values = data[TIME], data[name]
        found.append(_history(name, times, values, "`data`"))
    return found


def _require_columns(names: Iterable[str], known: Any, where: str) -> None:
    for name in names:
        if name not in known:
            raise InputError(
                f"Argument `data` must have the column `{name}`, but {where} has none; {suggestion(name, list(known))}"
            )


def machines_in(path: Path, columns: Iterable[str]) -> dict[str, Data]:
    """{machine: its data}, as `identify` takes them, of a CSV file with the column `machine`; none without it. Raises
    InputError as `read_data`."""
    header, rows = _table(path)
    if MACHINE not in header:
        return {}
    place, by_machine = header.index(MACHINE), {}
    for number, row in enumerate(rows, start=2):
        name = row[place].strip() if place < len(row) else ""
        if not name:
            raise InputError(
                f"Argument `data` must say of which machine a row is, but `{MACHINE}` of row {number} of `{path}` is "
                "empty; write a name or a number."
            )
        by_machine.setdefault(name, []).append((number, row))
    columns = list(columns)
    found: dict[str, Data] = {}
    for name, some in by_machine.items():
        found[name] = {
            column: (np.array(times), np.array(values))
            for column, (times, values) in _signals(path, header, some, columns).items()
        }
    return found


def _of_file(path: Path, columns: list[str]) -> dict[str, tuple[list[float], list[float]]]:
    header, rows = _table(path)
    return _signals(path, header, list(enumerate(rows, start=2)), columns)


def _table(path: Path) -> tuple[list[str], list[list[str]]]:
    """Header and rows of a file. Raises: InputError."""
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            header, *rows = [row for row in csv.reader(file) if any(cell.strip() for cell in row)] or [[]]
    except (OSError, UnicodeDecodeError, csv.Error) as problem:
        raise InputError(
            f"Argument `data` must be a CSV file, but `{path}` cannot be read ({problem}); give the path of a table "
            f"with the columns `{TIME}` and those of the signals."
        ) from None
    header = [cell.strip() for cell in header]
    if len(header) == 1 and any(mark in header[0] for mark in ";\t"):
        raise InputError(
            f"Argument `data` must have commas between its columns, but `{path}` has other marks; write it with "
            "commas, and with points in decimal numbers."
        )
    for number, row in enumerate(rows, start=2):
        if any(cell.strip() for cell in row[len(header) :]):
            raise InputError(
                f"Argument `data` must have a name for every column, but row {number} of `{path}` has {len(row)} cells "
                f"and the first row {len(header)}; name all, and write decimal numbers with points, not with commas."
            )
    return header, rows


def _signals(
    path: Path, header: list[str], rows: list[tuple[int, list[str]]], columns: list[str]
) -> dict[str, tuple[list[float], list[float]]]:
    """{column: (times, values)} of numbered rows, in which an empty cell is no sample."""
    _require_columns([TIME, *columns], header, f"`{path}`")
    for name in (TIME, *columns):
        if header.count(name) > 1:
            raise InputError(
                f"Argument `data` must have one column of a name, but `{path}` has `{name}` {header.count(name)} "
                "times; keep the one that was measured."
            )
    places = {name: header.index(name) for name in (TIME, *columns)}
    found: dict[str, tuple[list[float], list[float]]] = {name: ([], []) for name in columns}
    for number, row in rows:
        cells = {name: row[place].strip() if place < len(row) else "" for name, place in places.items()}
        for name in columns:
            if cells[name]:
                found[name][0].append(_number(cells[TIME], TIME, number, path))
                found[name][1].append(_number(cells[name], name, number, path))
    return found


def _number(text: str, name: str, row: int, path: Path) -> float:
    try:
        return float(text)
    except ValueError:
        raise InputError(
            f"Argument `data` must hold numbers, but `{path}` has {text!r} in `{name}` of row {row}; correct it, or "
            "leave the cell of a signal empty that was not sampled then."
        ) from None


def _history(column: str, times: Any, values: Any, where: str) -> History:
    """Raises: InputError."""
    try:
        times, values = (np.array(one, dtype=float) for one in (times, values))
    except (TypeError, ValueError):
        raise InputError(
            f"Argument `data` must hold numbers, but `{column}` of {where} does not; give arrays."
        ) from None
    if times.ndim != 1 or times.shape != values.shape:
        raise InputError(
            f"Argument `data` must have a value for every time, but `{column}` of {where} has the shape "
            f"{values.shape} with times of the shape {times.shape}; give lists of the same length."
        )
    for what, numbers in ((TIME, times), (column, values)):
        if not np.isfinite(numbers).all():
            raise InputError(
                f"Argument `data` must hold finite numbers, but sample {int(np.argmin(np.isfinite(numbers)))} of "
                f"`{what}` in {where} is {numbers[np.argmin(np.isfinite(numbers))]}; leave out samples without a value."
            )
    if len(times) < FEWEST:
        raise InputError(
            f"Argument `data` must have at least {FEWEST} samples of a signal, but `{column}` of {where} has "
            f"{len(times)}; measure longer, or leave the signal out."
        )
    if not (np.diff(times) > 0.0).all():
        first = int(np.argmin(np.diff(times) > 0.0))
        raise InputError(
            f"Argument `data` must have times that increase, but those of `{column}` in {where} go from "
            f"{times[first]:.9g} s to {times[first + 1]:.9g} s; sort the samples, and keep one of each time."
        )
    return History(column, times, values)


def require_within(histories: Iterable[History], times: Float[np.ndarray, " T"], number: int) -> None:
    """Raise InputError for samples outside the simulated times."""
    for one in histories:
        slack = 1e-9 * (times[-1] - times[0])
        if one.times[0] < times[0] - slack or one.times[-1] > times[-1] + slack:
            raise InputError(
                f"Argument `data` must lie within the simulated time of {times[0]:g} to {times[-1]:g} s, but "
                f"`{one.column}` of experiment {number} goes from {one.times[0]:.9g} to {one.times[-1]:.9g} s; give "
                "seconds from the start of the simulation, simulate a longer time, or cut the samples off."
            )
