"""What a long computation is doing, told to whoever listens.

Place in the pipeline: everything that takes long -> **stages** -> a progress line, if there is one.

Nothing is printed here and nothing is imported: a program announces a stage by `on_stage`, and a command that
shows progress listens.  Without a listener nothing happens.

    def show(stage, done): ...

    with listening(show):
        on_stage("Compiling the simulation")
        on_stage("Simulating", 0.25)
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

_listeners: list[Callable[[str, float | None], None]] = []


def on_stage(stage: str, done: float | None = None) -> None:
    """Tell all listeners what begins now, as a participle ("Tracing the simulation"), or which fraction (0 to 1)
    of it is done."""
    for listener in tuple(_listeners):
        listener(stage, done)


@contextmanager
def listening(listener: Callable[[str, float | None], None]) -> Iterator[None]:
    """Call `listener` with every stage that begins within the block."""
    _listeners.append(listener)
    try:
        yield
    finally:
        _listeners.remove(listener)
