"""A line of the validation table: our value, the reference, their difference and the verdict.

Place in the pipeline: every benchmark of this room returns lines; `report.validation_tables` shows
them.

A line passes if the difference is within what is allowed.  Where it is not, and the reason is known
and written down, it is "not met"; otherwise it fails.  A value that does not exist (NaN) fails.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

PASS, NOT_MET, FAIL = "pass", "not met", "fail"


@dataclass(frozen=True)
class Line:
    """One checked value.

    Args:
        group: what lines belong together (a benchmark and a quantity).
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
    def verdict(self) -> str:
        """ "pass", "not met" (for a known reason) or "fail"."""
        if not math.isfinite(self.difference):
            return FAIL
        if abs(self.difference) <= self.allowed:
            return PASS
        return NOT_MET if self.reason else FAIL


def relative(group, name, value, reference, allowed, source, unit="", reason="") -> Line:
    """A value that may differ by the share `allowed` of the reference."""
    value, reference = float(value), float(reference)
    difference = (value - reference) / abs(reference)
    return Line(group, name, value, reference, difference, allowed, True, source, unit, reason)


def absolute(group, name, value, reference, allowed, source, unit="", reason="") -> Line:
    """A value that may differ by `allowed`, in its unit."""
    value, reference = float(value), float(reference)
    difference = value - reference
    return Line(group, name, value, reference, difference, allowed, False, source, unit, reason)


def same(group, name, value: str, reference: str, source, reason="") -> Line:
    """A word that must be the reference's."""
    differs = 0.0 if value == reference else 1.0
    return Line(group, name, value, reference, differs, 0.0, False, source, "", reason)


@dataclass(frozen=True)
class Curve:
    """Points of a picture; `reference` ones are drawn as markers."""

    label: str
    x: np.ndarray
    y: np.ndarray
    reference: bool = False


@dataclass(frozen=True)
class Picture:
    """What is drawn of a benchmark: one panel of curves; `name` becomes the file's."""

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
    """A published problem: `run(full, progress)` computes it; progress takes the fraction done."""

    name: str
    title: str
    run: Callable[[bool, Callable[[float], None]], Outcome]
