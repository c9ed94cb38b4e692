"""What a command is doing and how far it is, on standard error.

Place in the pipeline: `rfem_jax.compilation.stages` -> **progress line** -> the person who waits.

On a terminal one line that is rewritten every second, with the time that the stage takes and, where it is known,
what remains; elsewhere plain lines: a stage that takes longer than a moment, then every quarter of it and twice a
minute.  What is printed by `show`, `note` and `say` meanwhile takes the place of the line, which comes back below.

Within `speaking(document=True)` standard output is for one JSON document alone: results are not printed, remarks go to
standard error; within `speaking(quiet=True)` there are neither remarks nor progress.
"""

import os
import shutil
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TextIO

from rfem_jax.report.console import write

PATIENCE = 0.5  # s that a stage takes before it is worth a line of its own in a log
TICK = 1.0  # s
SILENCE = 30.0  # s in a log, at most
SURE = 0.02  # of a stage done before the remaining time can be told

_lines: list["ProgressLine"] = []


@dataclass(frozen=True)
class _Manner:
    document: bool = False
    quiet: bool = False


_manner = _Manner()


@contextmanager
def speaking(document: bool = False, quiet: bool = False) -> Iterator[None]:
    """In which results are not printed as text, as a `document` follows, or remarks and progress are left out."""
    global _manner
    before, _manner = _manner, _Manner(document, quiet)
    try:
        yield
    finally:
        _manner = before


class ProgressLine:
    """Context in which an instance is the listener of `stages.listening`: called with the name of a stage and,
    from time to time, the fraction of it that is done (0 to 1).

    **Arguments:** `stream` that is written to; `patience` [s].
    """

    def __init__(self, stream, patience: float = PATIENCE):
        self.stream, self.patience = stream, patience
        self.live = stream.isatty()
        self.quiet = _manner.quiet
        self.stage, self.done, self.shown = None, None, True
        self.began = time.monotonic()
        self.first = (self.began, 0.0)
        self.printed = self.began
        self.width = 0
        # Stages are reported by the threads of a batch too, late or twice.
        self.lock = threading.RLock()
        self.ended = threading.Event()
        self.thread = threading.Thread(target=self._tick, daemon=True)

    def __enter__(self):
        _lines.append(self)
        self.thread.start()
        return self

    def __exit__(self, *_):
        self.ended.set()
        self.thread.join()
        _lines.remove(self)
        self.clear()

    def __call__(self, stage: str, done: float | None = None) -> None:
        """A stage begins, or a fraction `done` of it is."""
        if self.quiet:
            return
        with self.lock:
            if stage != self.stage:
                self.stage, self.done, self.shown = stage, None, False
                self.began = time.monotonic()
            if done is not None:
                if self.done is None:
                    self.first = (time.monotonic(), done)
                before, self.done = self.done or 0.0, max(min(done, 1.0), self.done or 0.0)
                if not self.live and int(4.0 * self.done) > int(4.0 * before):
                    self._print_line()
            if self.live:
                self._rewrite()

    def clear(self) -> None:
        """Take the line off the terminal."""
        with self.lock:
            if self.width:
                self._write("\r" + " " * self.width + "\r")
            self.width = 0

    def text(self) -> str:
        """The stage, its time, and what remains."""
        seconds = time.monotonic() - self.began
        if self.done is None:
            return f"{self.stage} ..." + (f" {seconds:.0f} s" if seconds >= TICK else "")
        # Counted from the first report: what went before was compilation, or is the work of an earlier run.
        started, first = self.first
        left = ""
        if self.done - first > SURE and self.done < 1.0:
            left = (time.monotonic() - started) * (1.0 - self.done) / (self.done - first)
            left = f", {left:.0f} s remaining"
        return f"{self.stage}: {int(100.0 * self.done):3d} % after {seconds:.1f} s{left}"

    def _tick(self):
        while not self.ended.wait(TICK if self.live else 0.2 * self.patience):
            with self.lock:
                if self.stage is None:
                    continue
                if self.live:
                    self._rewrite()
                    continue
                new = not self.shown and time.monotonic() - self.began >= self.patience
                if new or time.monotonic() - self.printed >= SILENCE:
                    self._print_line()

    def _rewrite(self):
        text = self.text()[: shutil.get_terminal_size().columns - 1]
        self._write(f"\r{text:<{self.width}}")
        self.width = len(text)

    def _print_line(self):
        self.shown, self.printed = True, time.monotonic()
        self._write(f"{self.text()}\n")

    def _write(self, text):
        write(self.stream, text)


def clear_lines() -> None:
    """Take what is shown off the terminal, in a process that ends: nobody is waited for who may be writing."""
    for line in _lines:
        if line.width:
            line._write("\r" + " " * line.width + "\r")


COLOURS = {"red": "31", "yellow": "33", "bold": "1"}


def paint(text: str, colour: str, stream: TextIO) -> str:
    """Text in a colour where `stream` is a terminal, unless the environment has NO_COLOR (https://no-color.org) or
    TERM=dumb."""
    if not text or not stream.isatty() or os.environ.get("NO_COLOR") or os.environ.get("TERM") == "dumb":
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
