"""Plain-text tables for the terminal: the results of a run, and how a table is laid out.

Place in the pipeline: `results_text` after `summary` (command `run`); `overview` lays out its
tables with `format_table`. SI units but for the driven angle in degrees, named in every heading.
"""

import math
import textwrap
from collections.abc import Collection, Iterable, Sequence
from functools import reduce
from operator import getitem

from rfem_jax.description.metrics.catalogue import note_sentences, unit_of
from rfem_jax.description.study_file.study import Study
from rfem_jax.description.tolerances.error_catalogue import as_specified
from rfem_jax.report.contents.annotations import Summaries
from rfem_jax.report.contents.driven_motions_report import drive_quantities, has_driven_joint
from rfem_jax.report.contents.summary import OK, joint_names, marked, marked_cases, study_note
from rfem_jax.simulation.outcome.quantities import (
    AT_REST,
    BALANCES,
    DRIVEN_JOINT,
    JOINT_METRICS,
    PRELOAD_FORCE,
    Quantity,
)
from rfem_jax.text_layout import align_columns, wrap_lines

_WIDTH = 96


def format_table(header: Sequence[str], rows: Iterable[Sequence[str]], words: Collection[int] = (0,)) -> str:
    """Columns under `header`, however wide: those of words to the left, of numbers to the right.

    Arguments: header, a sequence of strings; rows, sequences of as many strings; words, the
    indices of the columns of words.
    """
    return align_columns(header, rows, words, width=math.inf)


def format_numbers(values: Sequence[float], digits: int = 6) -> list[str]:
    """Write numbers with the same decimals, `digits` significant ones in the largest; NaN is "-".

    One scale for all, so that columns compare at a glance; a number that is not zero but would
    look like it is written with an exponent.
    """
    finite = [abs(value) for value in values if math.isfinite(value)]
    largest = max(finite, default=0.0)
    if largest > 0.0 and not 1e-3 <= largest < 1e7:
        return [f"{value:.2e}" if math.isfinite(value) else "-" for value in values]
    decimals = digits if largest == 0.0 else digits - 1 - math.floor(math.log10(largest))
    decimals = min(max(decimals, 0), digits)
    # Rounding noise next to numbers of order one (a moment that symmetry makes zero) is zero.
    smallest = 0.5 * 10.0**-decimals
    texts = []
    for value in values:
        if not math.isfinite(value):
            texts.append("-")
        elif 1e-9 * largest < abs(value) < smallest:
            texts.append(f"{value:.1e}")
        else:
            texts.append(f"{0.0 if abs(value) < smallest else value:.{decimals}f}")
    return texts


def joint_table(summaries: Summaries, names: Sequence[str], quantity: Quantity) -> str:
    """One metric, or the resultant of a load, for all cases (rows) and joints (columns)."""
    cases = marked_cases(summaries)
    found = [summaries[case]["joints"][name][quantity.name] for case in cases for name in names]
    values = [math.hypot(*one) if isinstance(one, list) else one for one in found]
    texts = format_numbers(values)
    rows = [[case, *texts[len(names) * row : len(names) * (row + 1)]] for row, case in enumerate(cases.values())]
    blocks = [
        format_table(
            ["case", *names[first : first + 8]],
            [[row[0], *row[1 + first : 9 + first]] for row in rows],
        )
        for first in range(0, len(names), 8)
    ]
    return "\n".join([f"{quantity.title}  ({quantity.description})", *blocks])


def driven_joint_table(study: Study, summaries: Summaries) -> str:
    """End of the driven joint or joints (where there are any) and status of all cases."""
    header, columns = ["case", "status"], [list(marked_cases(summaries).values())]
    columns.append([one["status"] for one in summaries.values()])
    ends = [(one.end, ("drives", one.label)) for one in drive_quantities(study)]
    if has_driven_joint(study):
        ends = [(quantity, ("driven_joint",)) for quantity in DRIVEN_JOINT]
    for quantity, path in ends:
        unit, factor = _shown(quantity.unit)
        header.append(f"{quantity.label}, {unit}")
        found = [reduce(getitem, path, one)[quantity.name] for one in summaries.values()]
        columns.append(format_numbers([factor * value for value in found], digits=8))
    table = format_table(header, zip(*columns, strict=True), words=(0, 1))
    if not study.drives:
        return table
    return f"Driven joint {study.drives[0].joint}\n{table}" if has_driven_joint(study) else f"Drives\n{table}"


def _shown(unit: str) -> tuple[str, float]:
    """Unit of a printed table for a unit of the files, and the factor to it: angles in degrees."""
    return as_specified(unit) if unit == "rad" else (unit, 1.0)


def balance_table(summaries: Summaries) -> str:
    """Balances of all cases, with what each of them means."""
    header = ["case", *(quantity.title for quantity in BALANCES)]
    rows = [
        [marked(case, one["status"]), *(_exponent(one[quantity.name]) for quantity in BALANCES)]
        for case, one in summaries.items()
    ]
    meanings = [f"  {quantity.label}: {quantity.description}" for quantity in BALANCES]
    return "\n".join(["Balances", format_table(header, rows), *meanings])


def _exponent(value: float) -> str:
    return f"{value:.1e}" if math.isfinite(value) else "-"


def _metrics_table(study: Study, summaries: Summaries) -> str:
    """The metrics that the study asks for: a row per metric, a column per case."""
    rows = []
    for name in study.metrics:
        values = [one["metrics"][name] for one in summaries.values()]
        rows.append([name, unit_of(name) or "1", *(f"{x:.5g}" if math.isfinite(x) else "-" for x in values)])
    table = format_table(["metric", "unit", *marked_cases(summaries).values()], rows, (0, 1))
    return "\n".join(["Metrics", table, *note_sentences(study.metrics)])


def _contacts_table(summaries: Summaries) -> str:
    """Which contacts of joints with clearance carry at the start and over the run; '' without any."""
    rows, floating = [], []
    for case, one in summaries.items():
        for joint, contact in one.get("contacts", {}).items():
            shares = [f"{100.0 * share:.0f} %" for share in contact["carrying_share"].values()]
            numbers = 1e6 * contact["largest_penetration"], contact["largest_contact_force"]
            at_start = contact["carrying_at_start"]
            rows.append(
                [
                    marked(case, one["status"]),
                    joint,
                    "+".join(at_start) or "none",
                    *shares,
                    *(f"{x:.5g}" for x in numbers),
                ]
            )
            if not at_start and one["status"] == OK:
                floating.append(f"{joint} (case {case})")
    if not rows:
        return ""
    header = ["case", "joint", "at the start", "start", "end", "axial", "penetration, um", "contact force, N"]
    text = "Contacts of joints with clearance: which carry at the start, shares of time, largest of the run\n"
    text += format_table(header, rows, (0, 1, 2))
    if floating:
        text += "\nPins that float at the start, held by nothing but their weak spring: " + ", ".join(floating) + "."
    return text


def results_text(study: Study, summaries: Summaries) -> str:
    """Everything the command `run` prints about its results.

    Arguments: study as loaded; summaries from `rfem_jax.report.contents.summary.summarise`.
    """
    names = joint_names(study)
    parts = [title_text(study)]
    at_rest = AT_REST if _known_at_rest(summaries) else ()
    parts += [joint_table(summaries, names, quantity) for quantity in (*at_rest, *JOINT_METRICS)]
    if study.metrics:
        parts.append(_metrics_table(study, summaries))
    if contacts := _contacts_table(summaries):
        parts.append(contacts)
    parts += [balance_table(summaries), driven_joint_table(study, summaries)]
    failed = {case: one for case, one in summaries.items() if one["status"] != OK}
    if failed:
        parts.append("\n".join(f"* Case {case}: {one['message']}" for case, one in failed.items()))
    good = [one["remarks"] for case, one in summaries.items() if case not in failed]
    of_all = [remark for remark in good[0] if len(good) > 1 and all(remark in one for one in good)] if good else []
    lines = [
        f"Case {case}: {remark}" for case, one in summaries.items() for remark in one["remarks"] if remark not in of_all
    ]
    if remarks := [*lines, *map(wrap_lines, of_all)]:
        parts.append("\n".join(remarks))
    return "\n\n".join(parts)


def _known_at_rest(summaries: Summaries) -> bool:
    """Whether any run began at rest: one that starts in motion, as a cycle, has no loads there."""
    rows = (row for one in summaries.values() for row in one["joints"].values())
    return any(math.isfinite(value) for row in rows for value in row[PRELOAD_FORCE.name])


def title_text(study: Study) -> str:
    """Title of the study, underlined, its note, and in what norm redundant reactions are the least."""
    lines, length = [study.title, "=" * len(study.title)], study.mechanism.norm_length
    lines += textwrap.wrap(study_note(study), _WIDTH)
    if length is not None:
        lines.append(f"Redundant reactions are the least: force^2 + (moment / {length:g} m)^2 of all joints.")
    return "\n".join(lines)
