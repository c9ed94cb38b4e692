"""Reduced bodies in files: archives of NumPy, a pair of matrices in the format of Matrix Market, bulk data.

Place in the pipeline: reduced_bodies, bulk_data, file_units -> **body_files** -> study_reader, the user.
"""

import io
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from rfem_jax.description.basics.errors import InputError, located, suggestion
from rfem_jax.description.basics.units import Quantities, Quantity, vector
from rfem_jax.description.bodies.bulk_data import ENDINGS, read_bulk_data
from rfem_jax.description.bodies.file_units import SI_UNITS, in_si, read_units
from rfem_jax.description.mechanism.reduced_bodies import ReducedBody
from rfem_jax.whole_files import write_whole

KEYS = tuple(field.name for field in fields(ReducedBody))
NEEDED = ("interfaces", "mass", "stiffness")
_MOST_ROWS = 3000  # of reduced matrices; a full one of a mesh is a mistake that takes all memory


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


def load_body(path: str | Path, damping: Quantity | None = None, units: Sequence[str] = SI_UNITS) -> ReducedBody:
    """Read a reduced body from a file.

    Args:
        path: an archive of NumPy (.npz) with the arguments of ReducedBody by their names, or bulk data (.bdf, .dat,
            .nas, .pch, .asm) with GRID entries of the interfaces and DMIG entries KAAX and MAAX, whose other points
            are modes; interfaces are in the ascending order of their grids.
        damping: eta [s], in the place of that in the file.
        units: of length, mass and time in the file, such as ("mm", "t", "s").
    Raises:
        InputError: the file is missing, damaged, or holds something else.
    """
    path, scales = Path(path), read_units(units)
    ending = path.suffix.lower()
    if ending == ".npz":
        content = _read_archive(path)
    elif ending in ENDINGS:
        content = read_bulk_data(path)
        dampers = content.pop("dampers")
        if dampers and damping is None:
            raise InputError(
                f"Reduced body `{path}` must have no damping matrix, but has {', '.join(dampers)}, which is not read; "
                "give `damping`, by which the damping matrix is in proportion to the stiffness, or 0."
            )
    elif ending == ".op2":
        raise InputError(
            f"Reduced body `{path}` must be in a file that ends in .npz, .bdf or .pch, but is a binary file of "
            "Nastran; write its matrices as DMIG entries, with EXTSEOUT(STIFFNESS, MASS, DMIGPCH)."
        )
    else:
        raise InputError(
            f"Reduced body `{path}` must be in a file that ends in .npz, .bdf or .pch, but ends in `{ending}`; give "
            "matrices in the format of Matrix Market (.mtx) as `mass` and `stiffness` beside `interfaces`."
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
        mass, stiffness: paths.
        interfaces: places (x, y, z) of the interfaces [m].
        damping: eta [s].
        units: of length, mass and time in the files.
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


def _read_archive(path: Path) -> dict[str, Any]:
    with (
        _readable(path, "an archive of NumPy with arrays of numbers"),
        np.load(io.BytesIO(path.read_bytes()), allow_pickle=False) as archive,
    ):
        content = {name: archive[name] for name in archive.files}
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


def _matrix_market(path: Path) -> Any:
    from scipy.io import mminfo, mmread

    with _readable(path, "a matrix in the format of Matrix Market"):
        rows, columns, *_ = mminfo(path)
        if max(rows, columns) <= _MOST_ROWS:
            matrix: Any = mmread(path)
            return matrix.toarray() if hasattr(matrix, "toarray") else matrix
    raise InputError(
        f"Reduced body `{path}` must have at most {_MOST_ROWS} rows, but has {rows}; reduce the matrices to interfaces "
        "and modes first, for example by craig_bampton."
    )


@contextmanager
def _readable(path: Path, what: str) -> Iterator[None]:
    """InputError for whatever is wrong with a file."""
    try:
        yield
    except FileNotFoundError:
        raise InputError(f"Reduced body `{path}` must be a file, but there is none; correct the path.") from None
    except Exception as error:  # NumPy, SciPy, zipfile and zlib raise ten kinds and more, by the byte that is wrong
        reason = (getattr(error, "strerror", None) or str(error) or type(error).__name__).splitlines()[0]
        raise InputError(f"Reduced body `{path}` must be {what}, but is not ({reason}); write it again.") from None
