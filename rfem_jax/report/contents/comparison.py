"""Two results side by side: what the command `compare` prints and writes.

Place in the pipeline: reads two `results.json` (`files`), computes no mechanics. The files may be from anywhere: what
is not understood is refused in one sentence.

A relative difference is (second - first) / |first|; it does not exist (null, "-") where the first value is zero, or so
small beside the largest of its quantity that it is rounding.
"""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rfem_jax.description.basics.errors import InputError
from rfem_jax.report.contents.tables import format_numbers, format_table
from rfem_jax.simulation.outcome.quantities import DRIVEN_JOINT, JOINT_METRICS, Quantity

RESULTS = "results.json"
ROUNDING = 1e-9  # of the largest value of a quantity
OF_RUN = "-"  # in the place of a joint


@dataclass(frozen=True)
class Difference:
    """A quantity of a joint (`OF_RUN`: of the driven joint) in a case: both values, NaN where there is none;
    `complete`: whether both are those of a complete run."""

    case: str
    joint: str
    quantity: str
    unit: str
    first: float
    second: float
    scale: float
    complete: bool = True

    @property
    def mark(self) -> str:
        """An asterisk where not both values are those of a complete run."""
        return "" if self.complete else "*"

    @property
    def difference(self) -> float:
        """second - first."""
        return self.second - self.first

    @property
    def relative(self) -> float:
        """Relative to the first, NaN where it is no number to compare with."""
        if not abs(self.first) > ROUNDING * self.scale:
            return math.nan
        return self.difference / abs(self.first)

    def row(self) -> dict[str, Any]:
        """As the files have it."""
        return {
            "case": self.case, "joint": self.joint, "quantity": self.quantity, "unit": self.unit, "first": self.first,
            "second": self.second, "difference": self.difference, "relative": self.relative,
        }  # fmt: skip


@dataclass(frozen=True)
class Comparison:
    """All differences of what both have, and sentences on what only one of them has or what is not the same."""

    differences: tuple[Difference, ...]
    remarks: tuple[str, ...]

    def text(self, names: Sequence[str]) -> str:
        """Tables by quantity, then the remarks; `names` of the two results."""
        parts = [f"first: {names[0]}\nsecond: {names[1]}"]
        for quantity in (*JOINT_METRICS, *DRIVEN_JOINT):
            rows = [one for one in self.differences if one.quantity == quantity.name]
            if rows:
                parts.append(f"{quantity.title}\n{_table(rows)}")
        if self.remarks:
            parts.append("\n".join(self.remarks))
        return "\n\n".join(parts)

    def largest(self) -> str:
        """One sentence on the largest relative difference."""
        known = [one for one in self.differences if math.isfinite(one.relative)]
        if not known:
            return "There is no value to compare."
        most = max(known, key=lambda one: abs(one.relative))
        where = f"{most.quantity.replace('_', ' ')}, case {most.case}{most.mark}"
        where += "" if most.joint == OF_RUN else f", joint {most.joint}"
        return f"Largest relative difference: {100.0 * most.relative:+.3g} % ({where})."


def read_results(folder: str | Path) -> dict[str, Any]:
    """The content of `results.json` in a folder, or of the file itself. Raises InputError."""
    path = Path(folder) / RESULTS if Path(folder).is_dir() else Path(folder)
    content: dict[str, Any] = {}
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        cases = content["cases"]
        good = all(isinstance(one["joints"], dict) for one in cases.values())
    except OSError as problem:
        raise InputError(
            f"Argument `DIR` must be a folder with {RESULTS}, as `rfem-jax run` writes it, but `{path}` cannot be read "
            f"({problem.strerror or problem}); name another folder."
        ) from problem
    except (ValueError, KeyError, TypeError, AttributeError):
        good = False
    if not good:
        raise InputError(
            f"Argument `DIR` must be a folder with {RESULTS}, as `rfem-jax run` writes it, but `{path}` is something "
            "else; name another folder."
        )
    return content


def compare_results(first: Mapping[str, Any], second: Mapping[str, Any]) -> Comparison:
    """Every number of cases and joints that both have, and what is not the same. Raises InputError for text in the
    place of a number."""
    remarks = [
        f"They differ in {what}: {first.get(what)}; {second.get(what)}."
        for what in ("title", "duration", "method")
        if first.get(what) != second.get(what)
    ]
    cases = _common("cases", first["cases"], second["cases"], remarks)
    scales: dict[str, float] = {}
    found: list[tuple[str, str, Quantity, float, float]] = []
    incomplete = set()
    for case in cases:
        one, other = first["cases"][case], second["cases"][case]
        for what in ("errors", "status"):
            if one.get(what) != other.get(what):
                remarks.append(f"Case {case}: {what} {one.get(what)} in the first, {other.get(what)} in the second.")
        if any(of.get("status") not in ("ok", None) for of in (one, other)):
            incomplete.add(case)
            remarks.append(f"* Case {case}: {_failures(one, other)}; these numbers are not of a complete run.")
        for joint in _common(f"joints of case {case}", one["joints"], other["joints"], remarks):
            for quantity in JOINT_METRICS:
                first_value, second_value = (_number(of["joints"][joint], quantity.name) for of in (one, other))
                found.append((case, joint, quantity, first_value, second_value))
        for quantity in DRIVEN_JOINT:
            first_value, second_value = (_number(of.get("driven_joint"), quantity.name) for of in (one, other))
            found.append((case, OF_RUN, quantity, first_value, second_value))
    found = [one for one in found if not (math.isnan(one[3]) and math.isnan(one[4]))]
    for _, _, quantity, *pair in found:
        scales[quantity.name] = max(scales.get(quantity.name, 0.0), *(abs(x) for x in pair if math.isfinite(x)), 0.0)
    differences = tuple(
        Difference(c, j, q.name, q.unit, a, b, scales[q.name], c not in incomplete) for c, j, q, a, b in found
    )
    return Comparison(differences, tuple(remarks))


def _failures(first: Mapping[str, Any], second: Mapping[str, Any]) -> str:
    """What happened to a case in both results, of which one at least is not complete."""
    one, other = (str(of.get("status")).replace("_", " ") for of in (first, second))
    return f"{one} in both" if one == other else f"{one} in the first, {other} in the second"


def _common(what: str, first: Mapping[str, Any], second: Mapping[str, Any], remarks: list[str]) -> list[str]:
    """Names that both have; a remark on those that only one of them has."""
    for names, others, which in ((first, second, "first"), (second, first, "second")):
        alone = [name for name in names if name not in others]
        if alone:
            remarks.append(f"Only the {which} has the {what}: {', '.join(alone)}.")
    return [name for name in first if name in second]


def _number(content: Any, name: str) -> float:
    """A number of a table, NaN for null and for what is not there. Raises InputError."""
    value = content.get(name) if isinstance(content, dict) else None
    if value is None:
        return math.nan
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise InputError(
            f"Argument `DIR` must be a folder with {RESULTS}, as `rfem-jax run` writes it, but `{name}` is {value!r} "
            "there; name another folder."
        )
    return float(value)


def _table(rows: Sequence[Difference]) -> str:
    texts = format_numbers([value for one in rows for value in (one.first, one.second)])
    small = rows[0].scale * ROUNDING
    changes = ["0" if abs(one.difference) <= small else f"{one.difference:+.3g}" for one in rows]
    shares = [f"{100.0 * one.relative:+.3g} %" if math.isfinite(one.relative) else "-" for one in rows]
    cells = [
        [one.case + one.mark, one.joint, texts[2 * i], texts[2 * i + 1], changes[i].replace("+nan", "-"), shares[i]]
        for i, one in enumerate(rows)
    ]
    return format_table(["case", "joint", "first", "second", "difference", "relative"], cells, words=(0, 1))
