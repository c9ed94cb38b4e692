"""Limits of size and fits by their ISO codes: "25 H7", "20 h9", "25 H7/g6".

Place in the pipeline: **iso_fits** -> `tolerances`. The numbers are in iso_286.json; up to 500 mm, grades 5 to 12,
holes D to H, JS, K, N, P and shafts d to h, js, k, n, p, the usual ones of bearings and pins.

    shaft d ... h    es = table, ei = es - IT            hole D ... H    EI = -es of the shaft, ES = EI + IT
    shaft k, n, p    ei = table, es = ei + IT            hole K, N (to grade 8), P (to 7)    ES = -ei + Delta
    js, JS           +- IT/2                             hole P (grade 8 on)  ES = -ei, N (9 on) ES = 0

with Delta = IT_n - IT_(n-1) over 3 mm and 0 up to 3 mm, where N is -ei in all grades.

Symbols: IT standard tolerance, es and ei upper and lower deviations of a shaft, ES and EI of a hole; all lengths in m
outside of the file.
Source: ISO 286-1:2010, tables 1 to 5.
"""

import json
import re
from bisect import bisect_left
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from rfem_jax.description.basics.errors import InputError

MICROMETRE, MILLIMETRE = 1e-6, 1e-3
GRADES = tuple(range(5, 13))
HOLES, SHAFTS = ("D", "E", "F", "G", "H", "JS", "K", "N", "P"), ("d", "e", "f", "g", "h", "js", "k", "n", "p")
_CODE = re.compile(r"\s*(\d+(?:\.\d+)?)\s*(?:mm)?\s+([A-Za-z]{1,2})(\d{1,2})(?:\s*/\s*([A-Za-z]{1,2})(\d{1,2}))?\s*")


@dataclass(frozen=True)
class Fit:
    """A hole and a shaft of one nominal size: its size, and the limits (low, high) of their deviations [m]."""

    size: float
    hole: tuple[float, float]
    shaft: tuple[float, float]

    @property
    def clearance(self) -> tuple[float, float]:
        """Smallest and largest diametral clearance [m]; negative where the fit interferes."""
        return self.hole[0] - self.shaft[1], self.hole[1] - self.shaft[0]

    @property
    def radial(self) -> tuple[float, float]:
        """Middle of the radial clearance, half the diametral one, and half of its range [m]."""
        low, high = self.clearance
        return 0.25 * (low + high), 0.25 * (high - low)


def deviations(code: str, where: str = "code") -> tuple[float, float]:
    """Lower and upper deviation [m] of a size with an ISO code, such as "25 H7" (a hole) or "20 h9" (a shaft).

    Raises: InputError for anything else; `where` names the argument.
    """
    size, letters, grade, other, _ = _parsed(code, where, "25 H7")
    if other is not None:
        raise InputError(f'Argument `{where}` must be one size, but {code!r} is a fit; write for example "25 H7".')
    return _deviations(size, letters, grade, code, where)


def fit(code: str, where: str = "fit") -> Fit:
    """The limits of a hole and a shaft of an ISO code such as "25 H7/g6".

    Raises: InputError for anything else; `where` names the argument.
    """
    size, hole, hole_grade, shaft, shaft_grade = _parsed(code, where, "25 H7/g6")
    if shaft is None or not hole.isupper() or not shaft.islower():
        raise InputError(
            f"Argument `{where}` must be a hole and a shaft of one size, but was {code!r}; write for example "
            '"25 H7/g6".'
        )
    return Fit(
        size * MILLIMETRE,
        _deviations(size, hole, hole_grade, code, where),
        _deviations(size, shaft, shaft_grade, code, where),
    )


def is_fit(code: Any) -> bool:
    """Whether a value has the form of a fit, a hole and a shaft."""
    found = _CODE.fullmatch(code) if isinstance(code, str) else None
    return found is not None and found.group(4) is not None


def clearance_fit(code: str, where: str) -> Fit:
    """A fit with a clearance in every pair. Raises: InputError for anything else."""
    found = fit(code, where)
    if found.clearance[0] < 0.0:
        raise InputError(
            f"Argument `{where}` must have a clearance in every pair, but {code!r} interferes by up to "
            f"{-found.clearance[0] / MICROMETRE:.4g} um; choose a looser fit."
        )
    return found


def _parsed(code: Any, where: str, example: str) -> tuple[float, str, int, str | None, int]:
    """Size [mm], letters and grade of a code, and those of the shaft where there is one."""
    found = _CODE.fullmatch(code) if isinstance(code, str) else None
    if found is None:
        raise InputError(
            f'Argument `{where}` must be a size in mm and an ISO code, but was {code!r}; write for example "{example}".'
        )
    size, letters, grade, shaft, shaft_grade = found.groups()
    return float(size), letters, int(grade), shaft, int(shaft_grade or 0)


def _deviations(size: float, letters: str, grade: int, code: str, where: str) -> tuple[float, float]:
    if letters not in (*HOLES, *SHAFTS) or grade not in GRADES:
        raise InputError(
            f"Argument `{where}` must have a known code, but `{letters}{grade}` in {code!r} is not known; known are "
            f"the holes {', '.join(HOLES)} and the shafts {', '.join(SHAFTS)} of the grades {GRADES[0]} to "
            f"{GRADES[-1]}: give other limits as an interval."
        )
    table = _table()
    column = bisect_left(table["up_to_mm"], size)
    if not 0.0 < size <= table["up_to_mm"][-1]:
        raise InputError(
            f"Argument `{where}` must have a size up to {table['up_to_mm'][-1]} mm, but {code!r} has {size:g} mm; give "
            "its limits as an interval."
        )
    width = table["grades_um"][str(grade)][column]
    if letters == "K" and grade > 8 and column:
        raise InputError(
            f"Argument `{where}` must have a code of the standard, but it has no K{grade} over 3 mm; give its limits "
            "as an interval."
        )
    low = _lower(letters, grade, column, width, table)
    return low * MICROMETRE, (low + width) * MICROMETRE


def _lower(letters: str, grade: int, column: int, width: int, table: dict[str, Any]) -> int | float:
    """Lower deviation [um] of a hole or a shaft."""
    small = letters.lower()
    if small == "js":
        return -0.5 * width
    of_shaft = table["shafts_um"][small][column]
    if small == "k" and grade > 7 and letters == "k":
        of_shaft = 0
    if letters == small:
        return of_shaft - width if small in "defgh" else of_shaft
    if small in "defgh":
        return -of_shaft
    return _upper_of_tight_hole(letters, grade, column, of_shaft, table) - width


def _upper_of_tight_hole(letters: str, grade: int, column: int, of_shaft: int, table: dict[str, Any]) -> int | float:
    """ES [um] of a hole K, N or P."""
    smallest = column == 0
    if letters == "N" and grade > 8 and not smallest:
        return 0.0
    corrected = grade <= (7 if letters == "P" else 8) and not smallest
    grades = table["grades_um"]
    return -of_shaft + (grades[str(grade)][column] - grades[str(grade - 1)][column] if corrected else 0)


@cache
def _table() -> dict[str, Any]:
    return json.loads(Path(__file__).with_name("iso_286.json").read_text(encoding="utf-8"))
