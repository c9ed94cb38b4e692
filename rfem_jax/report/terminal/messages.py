"""What a command prints, and the line that says what it is doing and how far it is.

Place in the pipeline: `rfem_jax.compilation.stages` -> **messages** -> the person who waits.

What is printed by `show`, `note` and `say` takes the place of the line (`rfem_jax.progress_line`), which comes back
below.

Within `output_mode(document=True)` standard output is for one JSON document alone: results are not printed, remarks go
to standard error; within `output_mode(quiet=True)` there are neither remarks nor progress.
"""

import io
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TextIO

from rfem_jax.progress_line import PATIENCE
from rfem_jax.progress_line import ProgressLine as PlainLine
from rfem_jax.report.terminal.console import write

_lines: list["ProgressLine"] = []


@dataclass(frozen=True)
class _Manner:
    document: bool = False
    quiet: bool = False


_manner = _Manner()


@contextmanager
def output_mode(document: bool = False, quiet: bool = False) -> Iterator[None]:
    """In which results are not printed as text, as a `document` follows, or remarks and progress are left out."""
    global _manner
    before, _manner = _manner, _Manner(document, quiet)
    try:
        yield
    finally:
        _manner = before


class ProgressLine(PlainLine):
    """The line of a command, above which it prints; silent within `output_mode(quiet=True)`.

    **Arguments:** `stream` that is written to; `patience` [s].
    """

    def __init__(self, stream, patience: float = PATIENCE):
        super().__init__(stream, patience)
        self.quiet = _manner.quiet

    def __enter__(self):
        _lines.append(self)
        return super().__enter__()

    def __exit__(self, *_):
        super().__exit__()
        _lines.remove(self)

    def __call__(self, stage: str, done: float | None = None) -> None:
        if not self.quiet:
            super().__call__(stage, done)

    def _write(self, text):
        write(self.stream, text)


def clear_lines() -> None:
    """Take what is shown off the terminal, in a process that ends: nobody is waited for who may be writing."""
    for line in _lines:
        if line.width:
            line._write("\r" + " " * line.width + "\r")


COLOURS = {"red": "31", "yellow": "33", "bold": "1"}


def paint(text: str, colour: str, stream: TextIO | io.TextIOBase) -> str:
    """Text in a colour where `stream` is a terminal, unless the environment has NO_COLOR (https://no-color.org) or
    TERM=dumb, or the terminal is the old console of Windows, which shows the codes."""
    if not text or not stream.isatty() or os.environ.get("NO_COLOR") or os.environ.get("TERM") == "dumb":
        return text
    if sys.platform == "win32" and not any(os.environ.get(name) for name in ("WT_SESSION", "TERM", "ANSICON")):
        return text
    return f"\033[{COLOURS[colour]}m{text}\033[0m"


def show(text: str = "", end: str = "\n") -> None:
    """Print a result on standard output, above the progress line, unless a document has it."""
    if not _manner.document:
        _print(text, end, sys.stdout)


def note(text: str) -> None:
    """Print a remark on the results beside them; on standard error where standard output is a document's."""
    if not _manner.quiet:
        _print(text, "\n", sys.stderr if _manner.document else sys.stdout)


def remark(text: str) -> None:
    """Print a remark on standard error, above the progress line."""
    if not _manner.quiet:
        say(text)


def say(text: str) -> None:
    """Print on standard error, above the progress line, what must be known."""
    _print(text, "\n", sys.stderr)


def print_document(text: str) -> None:
    """Print the one document that standard output is for."""
    _print(text, "\n", sys.stdout)


def _print(text, end, stream):
    if not _lines:
        write(stream, text + end)
        return
    line = _lines[-1]
    with line.lock:
        line.clear()
        write(stream, text + end)
