"""Programs that a command took last time, loaded while Python still imports.

Place in the pipeline: the command line says which command it is, on which study (`loading`); `call` takes the programs.

A list of the programs' keys is kept beside them. It may be wrong, since keys depend on more than the command and the
study's path: what is loaded in vain costs some time of another core, and what is missing is loaded when its turn comes.
"""

import hashlib
import re
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from rfem_jax.compilation import keeping
from rfem_jax.compilation.pending import Pending, read_kept

MOST = 8  # programs that are loaded ahead
KEY = re.compile(r"[0-9a-f]{64}")

_used: dict[str, None] = {}
_ahead: dict[str, Pending] = {}


@contextmanager
def loading(command: str, study: str | Path) -> Iterator[None]:
    """Load what this command took last time for this study; remember afterwards what it takes now."""
    if not keeping.wanted():
        yield
        return
    of_command = hashlib.sha256(f"last time {command} {Path(study).absolute()}".encode()).hexdigest()
    before = _keys(keeping.read(of_command))
    _used.clear()
    for key in before:
        _begin(key)
    try:
        yield
    finally:
        _ahead.clear()
    now = list(_used)[:MOST]
    if now != before:
        keeping.write(of_command, "\n".join(now).encode())


def note(key: str) -> None:
    """Record that a program is asked for."""
    _used.setdefault(key)


def take(key: str) -> Pending | None:
    """The program of a key, if it is loaded ahead."""
    return _ahead.pop(key, None)


def _keys(content: bytes | None) -> list[str]:
    lines = (content or b"").decode("ascii", "replace").splitlines()
    return [line for line in lines if KEY.fullmatch(line)][:MOST]


def _begin(key: str) -> None:
    with suppress(Exception):  # a damaged program is made anew when it is asked for
        kept = read_kept(key)
        if kept is not None:
            kept.begin()
            _ahead[key] = kept
