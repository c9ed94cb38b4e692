"""Plain text for a terminal: columns, lines, sizes and times.

Place in the pipeline: beside all packages, and imports none of them; used where results print themselves
(`tolerancing`) and by `report`.
"""

import textwrap
from collections.abc import Collection, Iterable, Sequence

WIDTH = 120  # columns of a terminal


def align_columns(
    header: Sequence[str], rows: Iterable[Sequence[str]], words: Collection[int] = (0,), width: float = WIDTH
) -> str:
    """One string: `rows` under `header`, columns of words to the left, those of numbers to the right.

    Columns that do not fit into `width` follow in blocks below, each with the first column.

    Args: header; rows, as many strings each; words, the indices of the columns of words; width, in letters.
    """
    table = [tuple(header), *(tuple(row) for row in rows)]
    widths = [max(len(row[column]) for row in table) for column in range(len(header))]
    blocks, chosen = [], [0]
    for column in range(1, len(header)):
        if len(chosen) > 1 and sum(2 + widths[c] for c in (*chosen, column)) - 2 > width:
            blocks.append(chosen)
            chosen = [0]
        chosen.append(column)
    return "\n\n".join(_block(table, widths, columns, words) for columns in [*blocks, chosen])


def _block(
    table: Sequence[Sequence[str]], widths: Sequence[int], columns: Sequence[int], words: Collection[int]
) -> str:
    lines = []
    for row in table:
        cells = [row[c].ljust(widths[c]) if c in words else row[c].rjust(widths[c]) for c in columns]
        lines.append("  ".join(cells).rstrip())
    lines.insert(1, "-" * (sum(2 + widths[c] for c in columns) - 2))
    return "\n".join(lines)


def wrap_lines(text: str, indent: int = 2, width: int = WIDTH) -> str:
    """`text` with its long lines broken at spaces, and the broken lines indented."""
    return "\n".join(
        textwrap.fill(line, width, subsequent_indent=" " * indent, break_long_words=False, break_on_hyphens=False)
        for line in text.splitlines()
    )


def size_text(number: int | float) -> str:
    """A number of bytes."""
    return f"{number / 1e6:.2g} MB" if number < 1e9 else f"{number / 1e9:.2g} GB"


def time_text(seconds: int | float) -> str:
    """A rough time, one digit in the unit that suits it."""
    for unit, length in (("day", 86400.0), ("hour", 3600.0), ("minute", 60.0)):
        if seconds >= length:
            number = f"{float(f'{seconds / length:.1g}'):.0f}"
            return f"{number} {unit}{'' if number == '1' else 's'}"
    return f"{float(f'{seconds:.1g}'):g} s" if seconds >= 1.0 else "less than a second"
