"""Handlers of kernels by their names: XLA must know one before a program that calls it is compiled or loaded.

Place in the pipeline: programs, machine_code -> **registry** -> primitive.

A program of XLA that was kept on disk names the handlers that it calls, so a name is that of the content, and whoever
keeps a program keeps its handlers' names (`noting`) and makes them known (`prepare`) before it is loaded.  Object code
is kept where the process says so (`keep_with`); what cannot be loaded is compiled anew.
"""

import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import NamedTuple

import jax

from rfem_jax.kernels import machine_code


class _Store(NamedTuple):
    """Where object code is kept: functions of a name."""

    read: Callable[[str], bytes | None]
    write: Callable[[str, bytes], object]


_known: set[str] = set()
_noted: dict[str, bytes] = {}
_lock = threading.RLock()
_store: list[_Store] = []
_notes = threading.local()


def keep_with(read: Callable[[str], bytes | None], write: Callable[[str, bytes], object]) -> None:
    """From now on object code is kept: `read` gives what `write` was given under a name, in any process, or None.

    Object code is run: `read` must give bytes that nobody else could have written.
    """
    _store[:] = [_Store(read, write)]


@contextmanager
def noting() -> Iterator[set[str]]:
    """The names of the handlers of all kernels that are lowered by this thread within the block."""
    before, _notes.names = getattr(_notes, "names", None), set()
    try:
        yield _notes.names
    finally:
        _notes.names = before


def note(name: str, content: bytes) -> None:
    """Note something about a kernel beside its object code."""
    _noted[name] = content
    if _store:
        _store[0].write(name, content)


def noted(name: str) -> bytes | None:
    """What was noted under a name."""
    if name not in _noted and _store:
        content = _store[0].read(name)
        if content is not None:
            _noted[name] = content
    return _noted.get(name)


def announce(name: str, text: Callable[[], str], thorough: bool) -> None:
    """Make a handler known to XLA when a program that calls it is lowered: by its text, unless its code is kept.

    At once, also where names are noted: a kernel may be computed while a program is traced.
    """
    noted = getattr(_notes, "names", None)
    if noted is not None:
        noted.add(name)
    with _lock:
        if name not in _known and not _know_kept(name):
            code = machine_code.compiled(text(), thorough)
            if _store:
                _store[0].write(name, code)
            _know(name, code)


def prepare(names: Iterable[str]) -> None:
    """Make handlers known to XLA whose object code is kept.

    **Raises:** KeyError for a name whose object code is not, or cannot be loaded.
    """
    for name in sorted(names):
        with _lock:
            if name not in _known and not _know_kept(name):
                raise KeyError(name)


def _know_kept(name: str) -> bool:
    """Make a handler known whose object code is kept; returns whether that was done."""
    code = _store[0].read(name) if _store else None
    if code is None:
        return False
    try:
        _know(name, code)
    except ValueError:  # no object code: it will be written anew
        return False
    return True


def _know(name: str, code: bytes) -> None:
    address = machine_code.loaded(name, code)
    jax.ffi.register_ffi_target(name, machine_code.capsule(address), platform="cpu", api_version=1)
    _known.add(name)
