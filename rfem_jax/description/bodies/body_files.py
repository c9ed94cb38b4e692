"""Reduced bodies in files: archives of NumPy, a pair of matrices in the format of Matrix Market, files of Nastran.

Place in the pipeline: reduced_bodies, bulk_data, nastran_output, file_units -> **body_files** -> study_reader.
"""

import io
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from rfem_jax.description.basics.errors import InputError, located, suggestion
from rfem_jax.description.basics.units import Quantities, Quantity, short, vector
from rfem_jax.description.bodies.bulk_data import ENDINGS, MOST_ROWS, read_bulk_data
from rfem_jax.description.bodies.file_units import SI_UNITS, in_si, read_units
from rfem_jax.description.bodies.nastran_output import (
    OUTPUT_ENDINGS,
    read_output,
    read_rows,
    reduced_matrices,
    require_reader,
)
from rfem_jax.description.mechanism.reduced_bodies import ReducedBody
from rfem_jax.whole_files import write_whole

KEYS = tuple(field.name for field in fields(ReducedBody))
NEEDED = ("interfaces", "mass", "stiffness")


def save_body(body: ReducedBody, path: str | Path) -> Path:
    """Write a reduced body as an archive of NumPy, in SI units, which `load_body` and study files read.

    Args:
        path: that ends in ".npz".
    Raises:
        InputError: the path has another ending, or cannot be written.
    """
    path = Path(path)
    if path.suffix.lower() != ".npz":
        raise InputError(f'Argument `path` of a reduced body must end in ".npz", but was `{path}`; rename it.')
    content = {name: np.asarray(getattr(body, name)) for name in KEYS if getattr(body, name) is not None}
    buffer = io.BytesIO()
    arrays: dict[str, Any] = {name: one for name, one in content.items() if one.size}
    np.savez_compressed(buffer, **arrays)
    try:
        write_whole(path, buffer.getvalue())
    except OSError as error:
        raise InputError(
            f"Argument `path` of a reduced body must be one that can be written, but `{path}` cannot "
            f"({error.strerror}); choose another folder."
        ) from None
    return path


def load_body(
    path: str | Path,
    damping: Quantity | None = None,
    units: Sequence[str] = SI_UNITS,
    grids: str | Path | None = None,
) -> ReducedBody:
    """Read a reduced body from a file.

    Args:
        path: an archive of NumPy (.npz) with the arguments of ReducedBody by their names; bulk data (.bdf, .dat,
            .nas, .pch, .asm) with GRID entries of the interfaces and DMIG entries KAAX and MAAX, whose other points
            are modes; or a binary file of Nastran (.op2, .op4) with these matrices, or KXX and MXX. Interfaces are in
            the ascending order of their grids.
        damping: eta [s] >= 0, in the place of that in the file: the damping matrix is eta times the stiffness.
        units: those of length, mass and time in the file, as ["mm", "t", "s"].
        grids: the assembly file (.asm) with the grids and modes of a binary file; left out, that of its name.
    Raises:
        InputError: the file is missing, damaged, or holds something else.
    """
    path, scales = Path(path), read_units(units)
    ending = path.suffix.lower()
    if grids is not None and ending not in OUTPUT_ENDINGS:
        raise InputError(
            f"Argument `grids` of a reduced body must be left out beside `{path}`, which has its interfaces itself, "
            f"but was `{grids}`; remove it."
        )
    if ending == ".npz":
        content = _read_archive(path)
    elif ending in ENDINGS:
        content = read_bulk_data(path)
    elif ending in OUTPUT_ENDINGS:
        content = _read_output(path, path.with_suffix(".asm") if grids is None else Path(grids))
    else:
        raise InputError(
            f"Reduced body `{path}` must be in a file that ends in .npz, .bdf, .pch, .op2 or .op4, but ends in "
            f"`{ending}`; give matrices in the format of Matrix Market (.mtx) as `mass` and `stiffness` beside "
            "`interfaces`."
        )
    dampers = content.pop("dampers", ())
    if dampers and damping is None:
        raise InputError(
            f"Reduced body `{path}` must have no damping matrix, but has {', '.join(dampers)}, which is not read; "
            "give `damping`, by which the damping matrix is in proportion to the stiffness, or 0."
        )
    return _body(path, content, damping, scales)


def read_matrices(
    mass: str | Path,
    stiffness: str | Path,
    interfaces: Sequence[Quantities],
    damping: Quantity = 0.0,
    units: Sequence[str] = SI_UNITS,
) -> ReducedBody:
    """Read a reduced body from two files in the format of Matrix Market.

    Args:
        mass, stiffness: path of the matrix, whose rows are those of a ReducedBody.
        interfaces: places (x, y, z) [m] of the interfaces, in the axes of the link.
        damping: eta [s] >= 0: the damping matrix is eta times the stiffness.
        units: those of length, mass and time in the files, as ["mm", "t", "s"].
    Raises:
        InputError: a file is missing, damaged, or holds something else.
    """
    scales = read_units(units)
    if not isinstance(interfaces, (list, tuple)) or not interfaces:
        raise InputError(
            f"Argument `interfaces` of a reduced body must be a list of places, but was {interfaces!r}; write for "
            'example [[0, 0, 0], ["120 mm", 0, 0]].'
        )
    places = [vector(one, "length", f"`interfaces` (place {k})") for k, one in enumerate(interfaces, start=1)]
    content: dict[str, Any] = {"mass": _matrix_market(Path(mass)), "stiffness": _matrix_market(Path(stiffness))}
    content["interfaces"] = np.array(places) / scales[0]  # which stand in the study, in its units
    return _body(Path(stiffness), content, damping, scales)


def _body(path: Path, content: dict[str, Any], damping: Any, scales: tuple[float, float, float]) -> ReducedBody:
    """The body, in SI units, of arrays in those of a file; `damping` is in SI units already."""
    with located(f"Reduced body `{path}`"):
        found = ReducedBody(**content)  # whose checks need no units
        if scales != (1.0, 1.0, 1.0):
            found = ReducedBody(**in_si({name: getattr(found, name) for name in KEYS}, scales))
        return found if damping is None else replace(found, damping=damping)


def _read_output(path: Path, grids: Path) -> dict[str, Any]:
    require_reader(path)
    with _readable(path, "a file of OUTPUT2 or OUTPUT4"), warnings.catch_warnings(action="error"):
        matrices = read_output(path)  # which warns of files that are cut short
    with _readable(grids, "the assembly file (.asm) of EXTSEOUT(ASMBULK) beside the matrices"):
        rows = read_rows(grids)
    return reduced_matrices(path, matrices, rows)


def _read_archive(path: Path) -> dict[str, Any]:
    with (
        _readable(path, "an archive of NumPy with arrays of numbers"),
        np.load(io.BytesIO(path.read_bytes()), allow_pickle=False) as archive,
    ):
        content = {name: archive[name] for name in archive.files}
        if any(np.iscomplexobj(one) for one in content.values()):
            raise ValueError("it has complex numbers")
    for name in content:
        if name not in KEYS:
            raise InputError(
                f"Reduced body `{path}` must have known arrays only, but has `{name}`; {suggestion(name, KEYS)}"
            )
    for name in NEEDED:
        if name not in content:
            raise InputError(f"Reduced body `{path}` must have an array `{name}`, but has none; add it.")
    if "damping" in content:
        content["damping"] = content["damping"][()]
    if "stress_names" in content:
        content["stress_names"] = content["stress_names"].tolist()
    return content


def _matrix_market(path: Path) -> Float[np.ndarray, "N N"]:
    """A dense matrix of a file. (The reader of SciPy ends the process where numbers of a list are missing.)"""
    with _readable(path, "a matrix in the format of Matrix Market"):
        head, *lines = path.read_text(encoding="utf-8").splitlines()
        mark, kind, layout, field, symmetry = head.lower().split()
        wrong = mark != "%%matrixmarket" or kind != "matrix" or layout not in ("array", "coordinate")
        if wrong or field not in ("real", "integer") or symmetry not in ("general", "symmetric"):
            raise ValueError(f"it begins with {short(head)!r}, not with that of a real matrix, general or symmetric")
        numbers = " ".join(line for line in lines if not line.startswith("%")).split()
        rows, columns = int(numbers[0]), int(numbers[1])
        if rows != columns or not 0 < rows <= MOST_ROWS:
            raise ValueError(f"it is {rows} x {columns}, and reduced ones are square, of at most {MOST_ROWS} rows")
        matrix = np.zeros((rows, rows))
        if layout == "array":
            values = np.array(numbers[2:], dtype=float)
            column, row = np.triu_indices(rows) if symmetry == "symmetric" else np.indices(matrix.shape).reshape(2, -1)
        else:
            row, column, values = np.array(numbers[3:], dtype=float).reshape(-1, 3).T
            if len(values) != int(numbers[2]) or min(row.min(), column.min()) < 1:
                raise ValueError(f"it has {len(values)} entries, of {numbers[2]}, or one without a row")
            row, column = row.astype(int) - 1, column.astype(int) - 1
        if len(values) != len(row):
            raise ValueError(f"it has {len(values)} numbers, not {len(row)}")
        np.add.at(matrix, (row, column), values)
        if symmetry == "symmetric":
            apart = row != column
            np.add.at(matrix, (column[apart], row[apart]), values[apart])
    return matrix


@contextmanager
def _readable(path: Path, what: str) -> Iterator[None]:
    """InputError for whatever is wrong with a file."""
    try:
        yield
    except InputError:
        raise
    except FileNotFoundError:
        raise InputError(f"Reduced body `{path}` must be a file, but there is none; correct the path.") from None
    except Exception as error:  # NumPy, pyYeti, zipfile and zlib raise ten kinds and more, by the byte that is wrong
        reason = (getattr(error, "strerror", None) or str(error) or type(error).__name__).splitlines()[0]
        raise InputError(f"Reduced body `{path}` must be {what}, but is not ({reason}); write it again.") from None
