"""The streams of a command, whatever they are: closed, unread, or without the characters that are printed; and Ctrl-C
before anything is done.

Place in the pipeline: `command_line` -> **console** -> `messages`, which prints. Results are in files: that
nobody can read what is printed ends no computation.
"""

import io
import os
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import TextIO

NAMES = ("stdin", "stdout", "stderr")


def open_closed_streams() -> None:
    """Let the standard streams that a process has been started without (`>&-`) lead nowhere: the next file that is
    opened would take their numbers, and what is printed would go into it."""
    for number, name in enumerate(NAMES):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the smallest number that is free
        if getattr(sys, name) is None:
            stream = open(number, "w" if number else "r", encoding="utf-8", closefd=False)  # noqa: SIM115
            setattr(sys, name, stream)


@contextmanager
def printable() -> Iterator[None]:
    """Within the block a character that a stream's encoding lacks is printed by its number, and what is printed to a
    stream that there is not goes nowhere."""
    before = {name: getattr(sys, name) for name in NAMES[1:]}
    strict = [one for one in before.values() if isinstance(one, io.TextIOWrapper) and one.errors == "strict"]
    for stream in strict:
        stream.reconfigure(errors="backslashreplace")
    missing = [name for name, stream in before.items() if stream is None]
    for name in missing:
        setattr(sys, name, io.StringIO())
    try:
        yield
    finally:
        for name in missing:
            setattr(sys, name, None)
        for stream in strict:
            with suppress(OSError, ValueError):
                stream.reconfigure(errors="strict")


class Reading:
    """Whether somebody reads standard output: set to False where it could not be written."""

    ends = False


def write(stream: TextIO | io.TextIOBase, text: str) -> None:
    """Print and flush. Where that cannot be done (the reader is gone, the disk is full), nothing more is printed
    there."""
    try:
        stream.write(text)
        stream.flush()
    except (OSError, ValueError):  # the second of a stream that was closed
        Reading.ends = Reading.ends or stream is sys.stdout
        discard(stream)


def discard(stream: TextIO | io.TextIOBase) -> None:
    """Let what is written to a stream whose reader is gone, and what it still holds, go nowhere
    (https://docs.python.org/3/library/signal.html#note-on-sigpipe)."""
    with suppress(OSError, ValueError):  # a stream that is no file
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, stream.fileno())
        os.close(nowhere)


def flush() -> bool:
    """Write what standard output still holds; returns whether all that was printed there has been read."""
    write(sys.stdout, "")
    return not Reading.ends


_early: list[Callable[[], None]] = []  # what ends the process at an interruption while nothing is done yet


def end_early_by(end: Callable[[], None]) -> None:
    """Call `end`, which ends the process, at Ctrl-C, until `work_begins`: an exception in the middle of an import may
    be lost, or become one of a library."""
    _early[:] = [end]
    signal.signal(signal.SIGINT, _interrupted)


def ends_early() -> bool:
    """Whether Ctrl-C ends the process at once."""
    return bool(_early)


def _interrupted(number, frame) -> None:
    for end in _early:
        end()
    signal.default_int_handler(number, frame)


def work_begins() -> None:
    """From now on Ctrl-C is a KeyboardInterrupt: something may be done already, and can be kept."""
    _early.clear()
