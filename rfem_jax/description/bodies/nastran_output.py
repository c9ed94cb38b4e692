"""Reduced matrices in binary files of Nastran: OUTPUT2 (.op2) and OUTPUT4 (.op4), beside an assembly file (.asm).

Place in the pipeline: errors -> **nastran_output** -> body_files.

The package pyYeti reads the files.  `EXTSEOUT(ASMBULK, EXTBULK, MATOP4)` writes matrices KXX, MXX without the names of
their rows, which are those of the assembly file, in the order of its SECONCT entry; tables (`DMIGOP2`) have the names
of their rows with them.  Displacements of a grid are along the axes that it names (field CD), here turned to basic
ones: its rigid motions relative to itself tell these axes, whatever kind they are of.
"""

import re
from collections.abc import Mapping
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from rfem_jax.description.basics.errors import InputError
from rfem_jax.description.bodies.bulk_data import MOST_ROWS

OUTPUT_ENDINGS = (".op2", ".op4")


class Rows(NamedTuple):
    """What the rows of reduced matrices are, interfaces first.

    labels: grid, or mode, and its component, in the order of the assembly file; order: places of the rows in it;
    interfaces: places of the grids; axes: displacements of the rows, in that order, by those along basic axes.
    """

    labels: Any
    order: np.ndarray
    interfaces: Float[np.ndarray, "interfaces 3"]
    axes: Float[np.ndarray, "N N"]


def require_reader(path: Path) -> None:
    """Raise InputError for a file that is to be read where the package that reads it is not installed."""
    try:
        import_module("pyyeti.nastran")
    except ImportError:
        raise InputError(
            f"Reduced body `{path}` must be in a file that ends in .npz, .bdf or .pch where the package pyyeti is not "
            f"installed, but ends in `{path.suffix}`; install rfem_jax[nastran], or punch the matrices, by "
            "EXTSEOUT(STIFFNESS, MASS, DMIGPCH)."
        ) from None


def _require_file(path: Path) -> None:
    """Raise FileNotFoundError for what is no file: pyYeti opens a window to choose one from a folder."""
    if not path.is_file():
        raise FileNotFoundError(path)


def read_rows(path: Path) -> Rows:
    """Interfaces and modes of an assembly file.

    Raises: InputError, an interface has not all six components; what pyYeti raises for a file that it cannot read.
    """
    _require_file(path)
    read = import_module("pyyeti.nastran.bulk").asm2uset
    # Beside it may be a punched file that says which components the matrices have, by its entry EXTRN, or of results.
    punched = path.with_suffix(".pch")
    told = punched.is_file() and re.search(rb"^EXTRN", punched.read_bytes(), re.IGNORECASE | re.MULTILINE)
    points = read(str(path), try_rdextrn=bool(told))[0]
    numbers, components = np.array(points.index.tolist()).T
    grids, ends = np.unique(numbers[components == 1]), components > 0
    if not len(grids) or np.sum(ends) != 6 * len(grids):
        raise InputError(
            f"Assembly file `{path}` of a reduced body must have interfaces with six components each, but has "
            f"{'only some components of a grid' if len(grids) else 'no grid'}; keep all six."
        )
    places, axes = np.zeros((len(grids), 3)), np.eye(len(points))
    for k, grid in enumerate(grids):
        own = np.flatnonzero((numbers == grid) & ends)
        places[k] = points.to_numpy()[own[0], 1:]
        axes[np.ix_(own, own)] = import_module("pyyeti.nastran.n2p").rbgeom_uset(points.iloc[own], places[k][None])
    order = np.concatenate([*(np.flatnonzero((numbers == grid) & ends) for grid in grids), np.flatnonzero(~ends)])
    return Rows(points.index, order, places, axes)


def read_output(path: Path) -> dict[str, Any]:
    """Matrices of a file by their names, in lower case: arrays, or tables with the labels of their rows.

    Raises: what pyYeti raises for a file that it cannot read.
    """
    _require_file(path)
    if path.suffix.lower() == ".op4":
        reader = import_module("pyyeti.nastran.op4")
        names, sizes, *_ = reader.dir(str(path), verbose=False)
        wanted = [name for name, size in zip(names, sizes, strict=True) if 0 < size[0] == size[1] <= MOST_ROWS]
        return dict(reader.read(str(path), into="dct", namelist=wanted)) if wanted else {}
    tables = dict(import_module("pyyeti.nastran.bulk").rddmig(str(path), square=True))
    found = {name[1:] if name[:2] in ("mk", "mm", "mb") else name: table for name, table in tables.items()}
    return found | dict(import_module("pyyeti.nastran.op2").rdmats(str(path), lower=True))


def reduced_matrices(path: Path, matrices: Mapping[str, Any], rows: Rows) -> dict[str, Any]:
    """Interfaces, mass and stiffness, and the names of matrices that are damping under "dampers".

    Raises: InputError, a matrix is missing, or has other rows than the assembly file.
    """
    content: dict[str, Any] = {"interfaces": rows.interfaces}
    for letter, what in (("k", "stiffness"), ("m", "mass")):
        name = _chosen(path, matrices, letter, what)
        matrix = _in_rows(f"Reduced body `{path}` must", name.upper(), matrices[name], rows)
        content[what] = (rows.axes.T @ matrix @ rows.axes)[np.ix_(rows.order, rows.order)]
    dampers = [name for name in matrices if name[0] == "b" or name[:2] == "k4"]
    # Matrices of one row stand in the places of those that a run does not have.
    content["dampers"] = [name.upper() for name in dampers if matrices[name].shape[0] > 1]
    return content


def _in_rows(sentence: str, name: str, matrix: Any, rows: Rows) -> Float[np.ndarray, "N N"]:
    """A matrix in the order of the assembly file; InputError, which begins as given, if it has other rows."""
    if hasattr(matrix, "reindex"):  # a table, whose rows have their labels
        unknown = [label for label in matrix.index if label not in rows.labels]
        if unknown:
            point, component = unknown[0]
            raise InputError(
                f"{sentence} have the points of its assembly file, but {name} has component {component} of point "
                f"{point}; give the assembly file of the same run as `grids`."
            )
        matrix = matrix.reindex(index=rows.labels, columns=rows.labels, fill_value=0.0).to_numpy()
    if matrix.shape != rows.axes.shape or np.iscomplexobj(matrix):
        size = f"{matrix.shape[0]} x {matrix.shape[1]}{', complex' if np.iscomplexobj(matrix) else ''}"
        raise InputError(
            f"{sentence} have real matrices of the {len(rows.order)} rows of its assembly file, but {name} is {size}; "
            "give the assembly file of the same run as `grids`."
        )
    return matrix


def _chosen(path: Path, matrices: Mapping[str, Any], letter: str, what: str) -> str:
    """The name of the stiffness or mass matrix: KAAX, KAA, KXX, or the only one of its letter."""
    own = [name for name in matrices if name[0] == letter and name[:2] != "k4" and matrices[name].shape[0] > 1]
    named = [name for name in (f"{letter}aax", f"{letter}aa", f"{letter}xx") if name in own] or own
    if len(named) == 1:
        return named[0]
    raise InputError(
        f"Reduced body `{path}` must have one {what} matrix, {letter.upper()}AAX, {letter.upper()}AA or "
        f"{letter.upper()}XX, but has {', '.join(named or matrices).upper() or 'no matrix'}; write it by EXTSEOUT("
        "ASMBULK, EXTBULK, MATOP4), or by DMIGOP2."
    )
