"""The validation table: on the terminal, as Markdown for docs/validation.md, as CSV and JSON.

Place in the pipeline: after `validation`; called by the command `rfem-jax validate`.
"""

import math
from collections import Counter
from dataclasses import asdict
from pathlib import Path
from typing import Any

from rfem_jax.report.contents.output import write_csv, write_json
from rfem_jax.report.contents.tables import format_table
from rfem_jax.validation.lines import FAIL, Line
from rfem_jax.whole_files import write_text

HEADER = ("checked", "ours", "reference", "difference", "allowed", "verdict", "source")


def benchmark_text(title: str, lines: list[Line]) -> str:
    """Tables of one benchmark with all its lines, and the reasons of those not met."""
    parts = [title, "=" * len(title)]
    for group, members in by_group(lines).items():
        table = format_table((group, *HEADER[1:]), map(_cells, members), words=(0, 5, 6))
        parts += [table, *reasons(members), ""]
    return "\n".join(parts[:-1])


def by_group(lines: list[Line]) -> dict[str, list[Line]]:
    """Lines by group, in their order."""
    groups: dict[str, list[Line]] = {}
    for line in lines:
        groups.setdefault(line.group, []).append(line)
    return groups


def reasons(lines: list[Line]) -> list[str]:
    """One sentence for every reason why lines are not met, with how many there are."""
    why = Counter(line.reason for line in lines if line.verdict not in ("pass", FAIL))
    return [f"  not met ({count}): {reason}." for reason, count in why.items()]


def verdict_text(lines: list[Line]) -> str:
    """How many lines there are of each verdict."""
    count = Counter(line.verdict for line in lines)
    return (
        f"{len(lines)} values: {count['pass']} pass, {count['not met']} not met for a known "
        f"reason, {count['fail']} fail."
    )


def has_failed(lines: list[Line]) -> bool:
    """Whether any line fails."""
    return any(line.verdict == FAIL for line in lines)


def markdown(lines: list[Line]) -> str:
    """One row for every group of lines: the one nearest to its limit (or farthest beyond)."""
    rows = ["| " + " | ".join(("values", *HEADER)) + " |", "|---" * (len(HEADER) + 1) + "|"]
    for group, members in by_group(lines).items():
        name, *cells = _cells(max(members, key=_strain))
        met = sum(line.verdict == "pass" for line in members)
        cells = [f"{group}: {name}" if name not in group else group, *cells]
        rows.append("| " + " | ".join((f"{met} of {len(members)}", *cells)) + " |")
    head = "Of each group the value nearest to its limit; all values are in `validation.csv`.\n\n"
    return "\n".join([head + rows[0], *rows[1:], "", *reasons(lines), verdict_text(lines), ""])


def _strain(line: Line) -> float:
    """|difference| / allowed; not a number counts as the worst."""
    if not math.isfinite(line.difference):
        return math.inf
    return abs(line.difference) / line.allowed if line.allowed else abs(line.difference)


def _cells(line: Line) -> tuple[str, ...]:
    return (
        line.name,
        _number(line.value, line.unit),
        _number(line.reference, line.unit),
        _difference(line, line.difference, "+.1e"),
        _difference(line, line.allowed, ".0e"),
        line.verdict,
        line.source,
    )


def _number(value: float | str, unit: str) -> str:
    if isinstance(value, str):
        return value
    return f"{value:.6g} {unit}".rstrip()


def _difference(line: Line, value: float, form: str) -> str:
    if isinstance(line.value, str):
        return "-" if value == 0.0 else "differs"
    if not line.relative:
        return f"{value:{form}} {line.unit}".rstrip()
    sign = "+" if "+" in form else ""
    return f"{100.0 * value:{sign}.2g} %"


def line_rows(lines: list[Line]) -> list[dict[str, Any]]:
    """A dict per line, as the files have it."""
    return [{**asdict(line), "difference_unit": line.difference_unit, "verdict": line.verdict} for line in lines]


def write_validation(folder: str | Path, lines: list[Line], settings: dict[str, Any]) -> list[Path]:
    """Write validation.json, validation.csv and validation.md; returns their paths. In the CSV `unit` is that of value
    and reference, `difference_unit` that of difference and allowed.

    Arguments: settings, what the command was asked for (names of benchmarks, full) and took.
    """
    folder = Path(folder)
    rows = line_rows(lines)
    return [
        write_json(folder / "validation.json", {**settings, "lines": rows}),
        write_csv(folder / "validation.csv", rows),
        write_text(folder / "validation.md", markdown(lines)),
    ]
