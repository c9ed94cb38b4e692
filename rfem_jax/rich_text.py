"""HTML for notebooks: tables in which every name and every text is escaped.

Place in the pipeline: beside all packages, and imports none of them; `_repr_html_` of mechanisms, studies, runs and
results call it. Jupyter shows what these return; nothing here needs it.
"""

from collections.abc import Iterable, Sequence
from html import escape

_CELL = "padding:0.1em 0.7em"


def document(title: str, *parts: str) -> str:
    """A title (text) and parts that are HTML already."""
    return f"<div><b>{escape(title)}</b>{''.join(parts)}</div>"


def table(header: Sequence[str], rows: Iterable[Sequence[object]], words: Sequence[int] = (0,)) -> str:
    """A table of texts and numbers; columns whose index is in `words` to the left, the others to the right.

    Numbers are shown with six digits, None and NaN as "-".
    """
    head = "".join(_cell("th", name, column in words) for column, name in enumerate(header))
    lines = ["".join(_cell("td", value, column in words) for column, value in enumerate(row)) for row in rows]
    body = "".join(f"<tr>{line}</tr>" for line in lines)
    return f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"


def paragraph(text: str) -> str:
    """A paragraph of text."""
    return f"<p>{escape(text)}</p>"


def preformatted(text: str) -> str:
    """Text with its line breaks and columns."""
    return f"<pre>{escape(text)}</pre>"


def _cell(tag: str, value: object, left: bool) -> str:
    side = "left" if left else "right"
    return f'<{tag} style="text-align:{side};{_CELL}">{escape(_text(value))}</{tag}>'


def _text(value: object) -> str:
    if value is None or value != value:
        return "-"
    return f"{value:.6g}" if isinstance(value, float) else str(value)
