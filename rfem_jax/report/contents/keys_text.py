"""The keys of study files and the metrics as text: what the command `keys` prints.

Place in the pipeline: after `rfem_jax.description.study_file.key_reference` and `metric_reference`.
"""

import textwrap
from dataclasses import replace

from rfem_jax.description.basics.errors import InputError, suggestion
from rfem_jax.description.metrics.reference import MetricTable, metric_tables
from rfem_jax.description.study_file.key_reference import Key, KeyTable, key_tables

METRICS = "metrics"  # the word that asks for them
WIDTH = 120  # columns of a terminal
WIDEST = 14  # columns of a default


def reference_text(word: str | None = None) -> str:
    """All tables of a study file with their keys, defaults and meanings; with a word, those with it in their header, or
    the metrics that it chooses.

    Raises: InputError for a word that is in no header and in no metric.
    """
    if metrics := chosen_metrics(word):
        return "\n\n".join(_metrics_text(table) for table in metrics)
    return "\n\n".join(_table_text(table) for table in chosen_tables(word))


def chosen_metrics(word: str | None) -> list[MetricTable]:
    """All metrics for the word "metrics"; for one that is in no header of a table those with it in their names."""
    if word is None:
        return []
    if word.lower() in (METRICS, METRICS[:-1]):
        return metric_tables()
    if any(word in table.header for table in key_tables()):
        return []
    found = [replace(one, rows=tuple(row for row in one.rows if word in row.name)) for one in metric_tables()]
    return [table for table in found if table.rows]


def chosen_tables(word: str | None = None) -> list[KeyTable]:
    """The tables with `word` in their header, all of them without one. Raises: InputError where there is none."""
    tables = key_tables()
    chosen = [table for table in tables if word is None or word in table.header]
    if not chosen:
        raise InputError(
            f"Argument `WORD` must be in the header of a table or the name of a metric, but `{word}` is in none of "
            f"them; {suggestion(word, [METRICS, *(table.header for table in tables)])}"
        )
    return chosen


def _table_text(table: KeyTable) -> str:
    name = max(len(key.name) for key in table.keys)
    default = min(max(len(key.default) for key in table.keys), WIDEST)
    return "\n".join([table.header, "-" * len(table.header), *(_row(key, name, default) for key in table.keys)])


def _metrics_text(table: MetricTable) -> str:
    name, unit = (max(len(getattr(row, column)) for row in table.rows) for column in ("name", "unit"))
    unit = max(unit, 1)
    rows = [_row(Key(row.name, row.unit or "1", row.text), name, unit) for row in table.rows]
    return "\n".join([table.header, "-" * len(table.header), *rows])


def _row(key: Key, name: int, default: int) -> str:
    begin = f"  {key.name:<{name}}  {key.default:<{default}}  "
    indent = " " * (name + default + 6)
    meaning = textwrap.wrap(key.meaning, WIDTH - len(indent), break_on_hyphens=False)
    if len(begin) > len(indent):  # a default wider than its column has a line of its own
        return "\n".join([begin.rstrip(), *(indent + line for line in meaning)])
    return "\n".join([begin + (meaning or [""])[0], *(indent + line for line in meaning[1:])]).rstrip()
