"""Results of tasks and analyses side by side: what the command `compare` prints and writes beside the loads.

Place in the pipeline: reads the JSON files of two folders (`report.tasks`, `report.analyses`), computes nothing. The
files may be from anywhere: what is not understood is left out.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rfem_jax.report.contents.comparison import ROUNDING, Difference
from rfem_jax.report.contents.tables import format_numbers, format_table
from rfem_jax.report.page.task_results import ANALYSES, read_json
from rfem_jax.task_kinds import task_kinds

# What is compared: the place of a number in the file, "*" for every key or entry (they name the row), the quantity, and
# its unit: METRIC for what `units` of the file says of these names.
Place = tuple[str, ...]
METRIC, NONE = "", "1"
QUANTITIES: dict[str, tuple[tuple[Place, str, str], ...]] = {
    "turn": (
        (("cases", "*", "joints", "*", "max_force"), "largest force", "N"),
        (("cases", "*", "joints", "*", "max_moment"), "largest moment", "N m"),
        (("cases", "*", "stress", "*", "max_stress"), "largest stress", "Pa"),
    ),
    "statics": (
        (("cases", "*", "metrics", "*"), "metric", METRIC),
        (("cases", "*", "holding", "*", "*"), "what holds", METRIC),
    ),
    "modes": ((("cases", "*", "modes", "*", "frequency"), "natural frequency", "Hz"),),
    "cycle": ((("cases", "*", "revolutions"), "revolutions simulated", NONE),),
    "sensitivity": (
        (("metrics", "*", "value"), "value", METRIC),
        (("metrics", "*", "effects", "*"), "effect of the tolerance", METRIC),
    ),
    "monte_carlo": (
        (("samples",), "samples", NONE),
        (("metrics", "*", "mean", "value"), "mean", METRIC),
        (("metrics", "*", "std", "value"), "standard deviation", METRIC),
        (("metrics", "*", "yield_of_all", "value"), "yield", NONE),
        (("joint_yield_of_all", "value"), "yield of all limits", NONE),
    ),
    "worst_case": (
        (("metrics", "*", "value"), "worst case", METRIC),
        (("metrics", "*", "nominal"), "nominal", METRIC),
    ),
    "allocation": (
        (("cost",), "cost", NONE),
        (("tolerances", "*"), "tolerance", METRIC),
        (("verified_yield",), "verified yield", NONE),
    ),
    "optimise": (
        (("objective",), "objective", NONE),
        (("terms", "*"), "term of the objective", METRIC),
        (("designs", "*"), "dimension", METRIC),
        (("tolerances", "*"), "tolerance", METRIC),
        (("verified_yield",), "verified yield", NONE),
    ),
    "reliability": ((("any_limit", "value"), "probability that a limit is broken", NONE), (("yield",), "yield", NONE)),
    "identification": (
        (("estimate", "*"), "error", METRIC),
        (("deviation", "*"), "standard deviation", METRIC),
    ),
}


@dataclass(frozen=True)
class TaskComparison:
    """Differences by task, {task: rows} (`case` of a row is the task, `joint` what it is of), and remarks."""

    differences: dict[str, tuple[Difference, ...]]
    remarks: tuple[str, ...]

    def text(self) -> str:
        """A table for every quantity of every task, then the remarks."""
        parts = []
        for task, rows in self.differences.items():
            for quantity in dict.fromkeys(row.quantity for row in rows):
                parts.append(
                    f"{titles()[task]}: {quantity}\n{_table([row for row in rows if row.quantity == quantity])}"
                )
        return "\n\n".join([*parts, *(["\n".join(self.remarks)] if self.remarks else [])])

    def rows(self) -> list[dict[str, Any]]:
        """As the files have them."""
        found = [row.row() for rows in self.differences.values() for row in rows]
        return [{"task": row.pop("case"), "of": row.pop("joint"), **row} for row in found]


def titles() -> dict[str, str]:
    """Names in words of all tasks and analyses that may have a file."""
    return ANALYSES | {kind.name: str(kind.title) for kind in task_kinds().values()}


def compare_tasks(first: Path, second: Path) -> TaskComparison:
    """All tasks that both folders have results of, those of kinds from outside of the package left out."""
    differences, remarks = {}, []
    for task in titles():
        one, other = (read_json(folder / f"{task}.json") for folder in (first, second))
        if one is None or other is None:
            if one is not other:
                remarks.append(f"Only the {'first' if other is None else 'second'} has results of {task}.")
            continue
        rows = [row for asked in QUANTITIES.get(task, ()) for row in _rows(task, *asked, one, other)]
        if rows:
            differences[task] = tuple(rows)
        if not all(row.complete for row in rows):
            remarks.append(f"* Results of {task}: the status of one of both says that it is not complete.")
        remarks += _notes(one, other) if rows else []
        if one.get("title") != other.get("title"):
            remarks.append(f"Results of {task} are of two studies: {one.get('title')}; {other.get('title')}.")
    return TaskComparison(differences, tuple(dict.fromkeys(remarks)))


def _notes(*contents: Mapping[str, Any]) -> list[str]:
    """What the files say that a reader of their metrics must know."""
    notes = [one.get("metric_notes") for one in contents]
    return [f"{kind}: {note}." for one in notes if isinstance(one, dict) for kind, note in one.items()]


def _rows(task: str, place: Place, quantity: str, unit: str, one: Any, other: Any) -> list[Difference]:
    """Both values of all numbers at a place, by the names on the way to them."""
    good: dict[tuple[str, ...], bool] = {}
    found: list[dict[tuple[str, ...], float]] = []
    for content in (one, other):
        numbers = list(_numbers(content, place))
        found.append({name: number for name, number, _ in numbers})
        good |= {name: complete and good.get(name, True) for name, _, complete in numbers}
    names = list(good)
    pairs = [tuple(numbers.get(name, math.nan) for numbers in found) for name in names]
    largest = max((abs(x) for pair in pairs for x in pair if math.isfinite(x)), default=0.0)
    units = one.get("units") if isinstance(one.get("units"), dict) else {}
    return [
        Difference(
            task,
            ", ".join(name) or "-",
            quantity,
            unit or _unit(units, name),
            *pair,
            scale=largest,
            complete=good[name],
        )
        for name, pair in zip(names, pairs, strict=True)
    ]


def _unit(units: Mapping[str, Any], name: Sequence[str]) -> str:
    """That of the metric, dimension or error that a row is of; "1" where the file says none."""
    return next((str(units[word]) for word in name if word in units), NONE)


def _numbers(
    content: Any, place: Place, name: tuple[str, ...] = (), complete: bool = True
) -> Iterator[tuple[tuple[str, ...], float, bool]]:
    """(names on the way, number, whether no status on the way says that something failed) of all numbers at a place."""
    if not place:
        if isinstance(content, (int, float)) and not isinstance(content, bool):
            yield name, float(content), complete
        return
    complete = complete and not (isinstance(content, dict) and content.get("status") not in (None, "ok"))
    key, rest = place[0], place[1:]
    if key != "*":
        if isinstance(content, dict) and key in content:
            yield from _numbers(content[key], rest, name, complete)
        return
    entries = list(content.items()) if isinstance(content, dict) else []
    if isinstance(content, list):
        entries = [(str(i + 1), entry) for i, entry in enumerate(content)]
    for word, entry in entries:
        yield from _numbers(entry, rest, (*name, word), complete)


def _table(rows: Sequence[Difference]) -> str:
    cells = []
    for unit in dict.fromkeys(row.unit for row in rows):  # numbers of one unit are laid out together
        chosen = [row for row in rows if row.unit == unit]
        texts = format_numbers([value for one in chosen for value in (one.first, one.second)])
        for i, one in enumerate(chosen):
            change = "0" if abs(one.difference) <= ROUNDING * one.scale else f"{one.difference:+.3g}"
            share = f"{100.0 * one.relative:+.3g} %" if math.isfinite(one.relative) else "-"
            shown = "" if unit == NONE else unit
            cells.append(
                [one.joint + one.mark, shown, texts[2 * i], texts[2 * i + 1], change.replace("+nan", "-"), share]
            )
    return format_table(["of", "unit", "first", "second", "difference", "relative"], cells, words=(0, 1))
