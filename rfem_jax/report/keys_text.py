"""The keys of study files and the metrics as text: what the command `keys` prints.

Place in the pipeline: after `rfem_jax.description.key_reference` and `metric_reference`.
"""

import textwrap

from rfem_jax.description.errors import InputError, suggestion
from rfem_jax.description.key_reference import Key, KeyTable, key_tables
from rfem_jax.description.metric_reference import MetricTable, metric_tables

METRICS = "metrics"  # the word that asks for them
WIDTH = 120  # columns of a terminal
WIDEST = 14  # columns of a default


def reference_text(word: str | None = None) -> str:
    """All tables of a study file with their keys, defaults and meanings; with a word, those with it in their header;
    with the word "metrics" all metrics.

    Raises: InputError for a word that is in no header.
    """
    if word == METRICS:
        return "\n\n".join(_metrics_text(table) for table in metric_tables())
    return "\n\n".join(_table_text(table) for table in chosen_tables(word))


def chosen_tables(word: str | None = None) -> list[KeyTable]:
    """The tables with `word` in their header, all of them without one. Raises: InputError where there is none."""
    tables = key_tables()
    chosen = [table for table in tables if word is None or word in table.header]
    if not chosen:
        raise InputError(
            f"Argument `WORD` must be in the header of a table, but `{word}` is in none; "
            f"{suggestion(word, [METRICS, *(table.header for table in tables)])}"
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
