"""Plain-text columns for the results of the tolerance studies, none wider than `WIDTH`.

Place in the pipeline: used where a result of this package prints itself, and by the reports on them; no symbols.
"""

import textwrap
from collections.abc import Iterable, Sequence
from typing import SupportsFloat

from rfem_jax.description.error_catalogue import as_specified

WIDTH = 120  # columns of a terminal
NEGLIGIBLE = 1e-12  # of the scale: rounding, shown as 0


def align_columns(header: Sequence[str], rows: Iterable[Sequence[str]], width: int = WIDTH) -> str:
    """One string: `rows` under `header`, the first column to the left, the others to the right.

    Columns that do not fit into `width` follow in blocks below, each with the first column.
    """
    table = [tuple(header), *(tuple(row) for row in rows)]
    widths = [max(len(row[column]) for row in table) for column in range(len(header))]
    blocks, chosen = [], []
    for column in range(1, len(header)):
        used = widths[0] + sum(2 + widths[c] for c in (*chosen, column))
        if chosen and used > width:
            blocks.append(chosen)
            chosen = []
        chosen.append(column)
    return "\n\n".join(_block(table, widths, columns) for columns in [*blocks, chosen])


def _block(table, widths, columns):
    lines = []
    for row in table:
        cells = [row[0].ljust(widths[0]), *(row[c].rjust(widths[c]) for c in columns)]
        lines.append("  ".join(cells).rstrip())
    lines.insert(1, "-" * (widths[0] + sum(2 + widths[c] for c in columns)))
    return "\n".join(lines)


def wrap_lines(text: str, indent: int = 2, width: int = WIDTH) -> str:
    """`text` with its long lines broken at spaces, and the broken lines indented."""
    return "\n".join(
        textwrap.fill(line, width, subsequent_indent=" " * indent, break_long_words=False, break_on_hyphens=False)
        for line in text.splitlines()
    )


def without_rounding(value: SupportsFloat, scale: SupportsFloat) -> float:
    """0 for a number that is only rounding of numbers of size `scale`, else the number."""
    value = float(value)
    return 0.0 if abs(value) <= NEGLIGIBLE * abs(float(scale)) else value


def show_error(value: SupportsFloat, unit: str, digits: int = 5) -> str:
    """An error or a tolerance of the SI unit "rad" or "m" for a table, in deg or mm."""
    specified, factor = as_specified(unit)
    return f"{show_number(factor * float(value), digits)} {specified}"


def show_number(value: SupportsFloat, digits: int = 5, scale: SupportsFloat = 0.0) -> str:
    """A number for a table; "-" where it does not exist, 0 where it is rounding of `scale`."""
    value = without_rounding(value, scale)
    return "-" if value != value else f"{value:.{digits}g}"
