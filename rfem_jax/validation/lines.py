"""A line of the validation table: our value, the reference, their difference and the verdict.

Place in the pipeline: every benchmark of this package returns lines; `report.validation.validation_tables` shows them.

A line passes if the difference is within the allowed one.  Where it is not, and the reason is known and given, it is
"not met"; otherwise it fails.  A value that is not finite fails.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Array, Float, Real

Number = float | np.floating | Float[Array | np.ndarray, ""]
Progress = Callable[[float], None]

PASS, NOT_MET, FAIL = "pass", "not met", "fail"


@dataclass(frozen=True)
class Line:
    """One checked value.

    Args:
        group: heading of lines that belong together (a benchmark and a quantity).
        name: what is checked.
        value, reference: numbers in `unit`, or words.
        difference: relative (1) or absolute (in `unit`), as `allowed`; 0 or 1 for words.
        allowed: largest |difference|.
        relative: whether difference and allowed are shares of the reference.
        source: author and year, or "closed form".
        reason: why the reference is not met, where that is known.
    """

    group: str
    name: str
    value: float | str
    reference: float | str
    difference: float
    allowed: float
    relative: bool
    source: str
    unit: str = ""
    reason: str = ""

    @property
    def difference_unit(self) -> str:
        """Unit of the difference and of what is allowed; "1" for shares and words."""
        return "1" if self.relative or isinstance(self.value, str) else self.unit or "1"

    @property
    def verdict(self) -> str:
        """ "pass", "not met" (for a known reason) or "fail"."""
        if not math.isfinite(self.difference):
            return FAIL
        if abs(self.difference) <= self.allowed:
            return PASS
        return NOT_MET if self.reason else FAIL


def relative(
    group: str,
    name: str,
    value: Number,
    reference: Number,
    allowed: float,
    source: str,
    unit: str = "",
    reason: str = "",
) -> Line:
    """A value that may differ by the share `allowed` of the reference."""
    value, reference = float(value), float(reference)
    difference = (value - reference) / abs(reference)
    return Line(group, name, value, reference, difference, allowed, True, source, unit, reason)


def absolute(
    group: str,
    name: str,
    value: Number,
    reference: Number,
    allowed: float,
    source: str,
    unit: str = "",
    reason: str = "",
) -> Line:
    """A value that may differ by `allowed`, in its unit."""
    value, reference = float(value), float(reference)
    difference = value - reference
    return Line(group, name, value, reference, difference, allowed, False, source, unit, reason)


def same(group: str, name: str, value: str, reference: str, source: str, reason: str = "") -> Line:
    """A word that must be that of the reference."""
    differs = 0.0 if value == reference else 1.0
    return Line(group, name, value, reference, differs, 0.0, False, source, "", reason)


@dataclass(frozen=True)
class Curve:
    """Points of a picture; those of a reference are drawn as markers."""

    label: str
    x: Real[np.ndarray, " points"]
    y: Real[np.ndarray, " points"]
    reference: bool = False


@dataclass(frozen=True)
class Picture:
    """One panel of curves; `name` becomes that of the file."""

    name: str
    title: str
    x_label: str
    y_label: str
    curves: tuple[Curve, ...]


@dataclass(frozen=True)
class Outcome:
    """Lines and pictures of one benchmark."""

    lines: list[Line]
    pictures: list[Picture] = field(default_factory=list)


@dataclass(frozen=True)
class Benchmark:
    """A published problem: `run(full, progress)` computes it, with `full` also the lines that take long; `progress` is
    called with the fraction done."""

    name: str
    title: str
    run: Callable[[bool, Progress], Outcome]
