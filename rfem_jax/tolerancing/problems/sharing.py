"""Several processes that share the chunks of one study: which this one is, and whether the others still live.

Place in the pipeline: the command line says how many there are (`shared_among`), else JAX's distributed runtime does;
`execution` divides the chunks, and looks at the signs of life while it waits for those of others.

Processes need nothing of each other but the files of the folder, so that none has to be connected with another one:
with JAX's runtime the death of one ends all.
"""

import secrets
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import jax

EVERY = 2.0  # s between two signs of life
SILENCE = 120.0  # s without a sign after which a process that gave signs before counts as stopped

_told: tuple[int, int] | None = None


@contextmanager
def shared_among(process: int, processes: int) -> Iterator[None]:
    """Within the block this is process number `process`, from 0, of `processes`."""
    global _told
    before, _told = _told, (process, processes)
    try:
        yield
    finally:
        _told = before


def process_index() -> int:
    """Number of this process among those that share the work, from 0."""
    return jax.process_index() if _told is None else _told[0]


def process_count() -> int:
    """Number of processes that share the work."""
    return jax.process_count() if _told is None else _told[1]


class SignsOfLife:
    """Context in which this process gives signs of life in a folder, and watches those of the others: files whose
    content changes. Clocks of machines are not compared. A process alone gives none."""

    def __init__(self, folder: Path | None):
        self.folder = folder if process_count() > 1 else None
        self._own, self._token, self._number = process_index(), secrets.token_hex(4), 0
        self._others = [process for process in range(process_count()) if process != self._own]
        self._seen: dict[int, str] = {}
        self._changed: dict[int, float] = {}
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)

    def __enter__(self) -> "SignsOfLife":
        if self.folder is not None:
            self._look()
            self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self.folder is not None:
            self._ended.set()
            self._thread.join()
            with suppress(OSError):
                self._path(self._own).unlink(missing_ok=True)

    def stopped(self) -> list[int]:
        """Numbers of processes that gave signs of life, and give none any more."""
        now = time.monotonic()
        return [process for process, changed in self._changed.items() if now - changed > SILENCE]

    def _path(self, process: int) -> Path:
        assert self.folder is not None
        return self.folder / f"process-{process}.alive"

    def _watch(self) -> None:
        while not self._ended.wait(EVERY):
            self._look()

    def _look(self) -> None:
        """Give a sign, and see which others have given one since the last time."""
        self._number += 1
        with suppress(OSError):
            self._path(self._own).write_text(f"{self._token} {self._number}", encoding="utf-8", newline="\n")
        for process in self._others:
            try:
                content = self._path(process).read_text(encoding="utf-8")
            except (OSError, ValueError):  # not begun yet, or ended
                continue
            if process in self._seen and content != self._seen[process]:
                self._changed[process] = time.monotonic()
            self._seen[process] = content
