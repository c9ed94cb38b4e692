"""Reduced matrices in bulk data: GRID, SPOINT and DMIG entries, as Nastran and OptiStruct write and read them.

Place in the pipeline: errors -> **bulk_data** -> body_files.

An entry is a line of fields of 8 characters, of 16 where its name ends in "*", or between commas; lines that begin with
a blank, "+" or "*" continue it.  The reduced matrices of `EXTSEOUT(STIFFNESS, MASS, DMIGPCH)` are DMIG entries named
KAAX and MAAX, a column each: the grid and the component (1 to 6) of the column, then grid, component and value of its
entries; of symmetric ones half is given.  Modes are scalar points (SPOINT), or component 0.
"""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from rfem_jax.description.basics.errors import InputError

ENDINGS = (".bdf", ".dat", ".nas", ".pch", ".asm")
MOST_ROWS = 3000  # of reduced matrices; a full one of a mesh is a mistake that takes all memory
_DEEPEST = 10  # files that include each other
_LARGEST = 100_000_000  # bytes of a file
_REAL = re.compile(r"([+-]?(?:\d+\.?\d*|\.\d+))(?:[edED]?([+-]?\d+))?$")
_SYMMETRIC, _SQUARE = 6, 1
Place = tuple[int, int]


def read_bulk_data(path: Path) -> dict[str, Any]:
    """Interfaces (ascending numbers of their grids), mass and stiffness of a file, in its units.

    Returns: {"interfaces", "mass", "stiffness"}, and the names of matrices that are damping under "dampers".
    Raises: InputError, the file cannot be read, or holds no reduced body.
    """
    data = _BulkData(path)
    stiffness, mass = data.matrix("K", "stiffness"), data.matrix("M", "mass")
    used = sorted({place for entries in (stiffness, mass) for pair in entries for place in pair})
    grids, modes = [], []
    if len(used) > MOST_ROWS:
        data.refuse(f"have at most {MOST_ROWS} rows, but has {len(used)}; reduce the matrices to interfaces and modes")
    for point, component in used:
        if point in data.grids:
            if not 1 <= component <= 6:
                data.refuse(f"have components 1 to 6 of GRID {point}, but has {component}; correct it")
            grids.append(point)
        elif component > 1 or (component and point not in data.scalars):
            data.refuse(
                f"have a GRID entry for point {point}, whose component {component} its matrices have, but has none; "
                "include the file with its GRID entries, by INCLUDE"
            )
        else:
            modes.append((point, component))
    cut = [mode for mode in modes if any(entries.get((mode, mode), 0.0) <= 0.0 for entries in (stiffness, mass))]
    if cut:
        data.refuse(f"have mass and stiffness of every mode, but lacks one of point {cut[0][0]}; it may be cut short")
    grids = sorted(set(grids))
    rows = [(grid, component) for grid in grids for component in range(1, 7)] + modes
    missing = sorted(set(rows) - set(used))
    if missing or not grids:
        lacks = f"component {missing[0][1]} of GRID {missing[0][0]}" if missing else "all"
        data.refuse(f"have six rows for each interface, but lacks {lacks}; keep all six components of these grids")
    number = {place: k for k, place in enumerate(rows)}
    return {
        "interfaces": [data.grids[grid] for grid in grids],
        "mass": _dense(mass, number),
        "stiffness": _dense(stiffness, number),
        "dampers": [name for name in data.matrices if name[0] == "B" or name[:2] == "K4"],
    }


def _dense(entries: dict[tuple[Place, Place], float], number: dict[Place, int]) -> np.ndarray:
    matrix = np.zeros((len(number), len(number)))
    for (row, column), value in entries.items():
        matrix[number[row], number[column]] = value
    return matrix


class _BulkData:
    """The entries of a file: grids {number: place}, scalars, matrices {name: {(row, column): value}}."""

    def __init__(self, path: Path):
        self.path = path
        self.grids: dict[int, tuple[float, float, float]] = {}
        self.scalars: set[int] = set()
        self.matrices: dict[str, dict[tuple[Place, Place], float]] = {}
        self.forms: dict[str, int] = {}
        for fields in self._entries(path, 0):
            read = {"GRID": self._grid, "SPOINT": self._scalar, "DMIG": self._matrix}.get(fields[0])
            if read is not None:
                try:
                    read(fields)
                except InputError:  # which is a ValueError
                    raise
                except ValueError:
                    self.refuse(f"have numbers in all fields of {fields[0]}, but has {','.join(fields)!r}; correct it")

    def refuse(self, what: str) -> NoReturn:
        text, _, rest = what.partition("; ")
        raise InputError(f"Reduced body `{self.path}` must {text}; {rest}.")

    def _lines(self, path: Path, depth: int) -> Iterator[str]:
        """Lines without comments, those of included files in their places."""
        try:
            if path.stat().st_size > _LARGEST:
                self.refuse(f"be at most {_LARGEST:.0e} bytes, but `{path}` is larger; keep fewer grids and modes")
            text = path.read_text(encoding="utf-8", errors="replace")
        except OSError as error:
            self.refuse(f"be a readable file, but `{path}` is not ({error.strerror}); correct the path")
        if "\0" in text[:10000]:
            self.refuse("be bulk data, but is a binary file; write the matrices as DMIG entries")
        for line in text.splitlines():
            line = line.partition("$")[0].rstrip().expandtabs(8)
            included = re.match(r"\s*include\s+['\"]?(.*?)['\"]?\s*$", line, re.IGNORECASE)
            if included and depth >= _DEEPEST:
                self.refuse(f"include files a few levels deep, but `{path}` includes more; remove the circle")
            if included:
                yield from self._lines(path.parent / included[1], depth + 1)
            elif line.strip():
                yield line

    def _entries(self, path: Path, depth: int) -> Iterator[list[str]]:
        """Fields of every entry: its name, and those of all its lines without their own names."""
        fields: list[str] = []
        for line in self._lines(path, depth):
            named, own = _fields(line)
            if named and named[0] not in "+*":
                if fields:
                    yield fields
                fields = [named.rstrip("*").upper()]
            if fields:
                fields += own
        if fields:
            yield fields

    def _grid(self, fields: list[str]) -> None:
        number, system, *place, moved = (*fields[1:], *[""] * 6)[:6]
        if _whole(system) or _whole(moved):
            self.refuse(
                f"have its interfaces in the basic coordinate system, but GRID {number} is in another; write it, and "
                "its displacements, in the basic one"
            )
        x, y, z = (_real(one) for one in place)
        found, known = (x, y, z), self.grids.get(_whole(number))
        if known is not None and known != found:
            self.refuse(f"have each GRID once, but {number} is at {known} and {found}; remove one")
        self.grids[_whole(number)] = found

    def _scalar(self, fields: list[str]) -> None:
        given = [one for one in fields[1:] if one]
        if len(given) == 3 and given[1].upper() == "THRU":
            first, last = _whole(given[0]), _whole(given[2])
            if last - first > _LARGEST // 100:
                self.refuse(f"have SPOINT entries of as many modes as it has, but one reaches to {last}; correct it")
            self.scalars.update(range(first, last + 1))
        else:
            self.scalars.update(_whole(one) for one in given)

    def _matrix(self, fields: list[str]) -> None:
        name, grid, *rest = (*fields[1:], *[""] * 4)
        name = name.upper()
        if not name:
            raise ValueError("a matrix without a name")
        if _whole(grid) == 0:  # the head of a matrix
            form, kind = _whole(rest[0]), _whole(rest[1])
            if name in self.forms:
                self.refuse(f"have each matrix once, but has a second head of {name}; remove one")
            if name[0] in "KM" and (form not in (_SYMMETRIC, _SQUARE) or kind not in (1, 2)):
                self.refuse(
                    f"have real square matrices, but {name} is of form {form} and type {kind}; write KAAX, MAAX"
                )
            self.forms[name], self.matrices[name] = form, {}
            return
        if name not in self.forms:
            self.refuse(f"have the head of a matrix before its columns, but {name} has none; include all of the file")
        column, entries = (_whole(grid), _whole(rest[0])), self.matrices[name]
        for k in range(2, len(rest) - 2, 4):
            if rest[k]:
                row = (_whole(rest[k]), _whole(rest[k + 1]))
                value = _real(rest[k + 2])
                for pair in ((row, column), (column, row)) if self.forms[name] == _SYMMETRIC else ((row, column),):
                    if entries.get(pair, value) != value:
                        self.refuse(
                            f"have each entry of {name} once, but row {row} of column {column} is twice; keep one"
                        )
                    entries[pair] = value

    def matrix(self, letter: str, what: str) -> dict[tuple[Place, Place], float]:
        """The matrix KAAX or MAAX, or the only other one of this letter."""
        known = [name for name in self.matrices if name[0] == letter and name[:2] != "K4"]
        chosen = [name for name in known if name == f"{letter}AAX"] or known
        if len(chosen) != 1:
            found = ", ".join(known or self.matrices) or "no DMIG entry"
            self.refuse(f"have one {what} matrix, the DMIG {letter}AAX, but has {found}; write it into the file")
        return self.matrices[chosen[0]]


def _fields(line: str) -> tuple[str, list[str]]:
    """The name of a line ("" or of a continuation) and its fields, as many as it has places."""
    if "," in line:
        named, *own = (one.strip() for one in line.split(","))
        places = 4 if "*" in named else 8
        own = own[:places]
    else:
        named = line[:8].strip()
        width, places = (16, 4) if "*" in named else (8, 8)
        own = [line[8 + k * width : 8 + (k + 1) * width].strip() for k in range(places)]
    return named, own + [""] * (places - len(own))


def _whole(text: str) -> int:
    return int(text) if text else 0


def _real(text: str) -> float:
    """A number as bulk data have it: 1.5, .5, 1.5E+3, 1.5D+3, 1.5+3; nothing is 0."""
    match = _REAL.match(text.strip()) if text.strip() else None
    if match is None:
        if text.strip():
            raise ValueError(text)
        return 0.0
    return float(f"{match[1]}e{match[2] or 0}")
