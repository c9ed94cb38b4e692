"""Executables that are still being compiled or loaded.

Place in the pipeline: `call` makes them of traced programs and of those read from disk, `last_time` of the latter.
"""

import atexit
import threading
from collections.abc import Callable
from contextlib import suppress

from rfem_jax.compilation import keeping
from rfem_jax.compilation.executable import Executable, Packed, Traced, unpack

_threads: set[threading.Thread] = set()


class Pending:
    """An executable that the first thread to ask for it makes, while others wait.

    **Arguments:** `program`: is finished for it; `made`: is called with the executable.

    Attributes: head: what is known of the program; instead: makes another one if the program cannot be finished.
    """

    def __init__(self, program: Traced | Packed, made: Callable[[Executable], None] | None = None):
        self.head = program.head
        self.instead: Callable[[], Pending] | None = None
        self._program, self._made = program, made
        self._lock = threading.Lock()
        self._executable: Executable | None = None

    def get(self) -> Executable:
        """The executable; compiles or loads it if that has not been done."""
        if self._executable is None:
            with self._lock:
                if self._executable is None:
                    self._executable = self._finish(self._program)
                    del self._program
        return self._executable

    def begin(self) -> None:
        """Make it in the background; an exception there is raised again by `get`."""
        thread = threading.Thread(target=self._quietly, daemon=True)
        _threads.add(thread)
        thread.start()

    def _quietly(self) -> None:
        with suppress(Exception):
            self.get()
        _threads.discard(threading.current_thread())

    def _finish(self, program: Traced | Packed) -> Executable:
        try:
            executable = program.finish()
        except Exception:
            if self.instead is None:
                raise
            return self.instead().get()
        if self._made is not None:
            self._made(executable)
        return executable


def in_progress() -> bool:
    """Whether programs are made in the background."""
    return bool(_threads)


@atexit.register
def _wait() -> None:
    """The process would be aborted if Python ended while a thread of it is in XLA's compiler."""
    for thread in tuple(_threads):
        thread.join()


def read_kept(key: str) -> Pending | None:
    """The program kept under a key, still to be loaded; None if there is none. Raises: an exception for other bytes."""
    content = keeping.read(key)
    return None if content is None else Pending(unpack(content))
