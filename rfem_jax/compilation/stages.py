"""Stages of a long computation, for listeners that show its progress.

Place in the pipeline: everything that takes long -> **stages** -> a progress line, if there is one.

A computation announces its stages by `on_stage`, and a command that shows progress listens.  Without a listener
nothing happens.

    def show(stage, done): ...

    with listening(show):
        on_stage("Compiling the simulation")
        on_stage("Simulating", 0.25)
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

_listeners: list[Callable[[str, float | None], None]] = []


def on_stage(stage: str, done: float | None = None) -> None:
    """Tell all listeners which stage begins.

    **Arguments:** `stage`: a participle ("Tracing the simulation"); `done`: the fraction of the stage that is done,
    0 to 1, None where it begins.
    """
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
