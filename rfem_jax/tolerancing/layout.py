"""Plain-text columns for the results of the tolerance studies.

Place in the pipeline: used where a result of this room prints itself; no symbols.
"""


def align_columns(header, rows):
    """One string: `rows` (sequences of strings) under `header`, first column left, others right."""
    table = [tuple(header), *(tuple(row) for row in rows)]
    widths = [max(len(row[column]) for row in table) for column in range(len(header))]
    lines = []
    for row in table:
        cells = [row[0].ljust(widths[0])]
        cells += [cell.rjust(width) for cell, width in zip(row[1:], widths[1:], strict=True)]
        lines.append("  ".join(cells).rstrip())
    lines.insert(1, "-" * (sum(widths) + 2 * (len(widths) - 1)))
    return "\n".join(lines)


def show_number(value, digits=5):
    """A number for a table; "-" where it does not exist."""
    value = float(value)
    return "-" if value != value else f"{value:.{digits}g}"
