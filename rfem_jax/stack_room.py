"""Room on Python's stack of frames for functions that call deeply.

Place in the pipeline: beside it; `compilation` traces with it, and commands run with it.

CPython keeps frames in chunks of 16 KiB.  Where a call does not fit into the last chunk, it asks the system for another
one and gives it back on return, in microseconds instead of tens of nanoseconds.  Tracing is hundreds of calls deep, and
wherever a loop of small calls comes to such a depth, each of them pays that.  The chunk of a frame that asks for much
is as large, and what it does not use is for the frames after it.
"""

import functools
from collections.abc import Callable
from typing import ParamSpec, TypeVar

P = ParamSpec("P")
R = TypeVar("R")

WORDS = 1 << 17  # of the stack that are asked for, and at least as many left; memory is taken as it is used


def with_room(function: Callable[P, R]) -> Callable[P, R]:
    """The function, with room for the frames of all that it calls; each call of it asks for one chunk."""

    def roomy(*args: P.args, **kwargs: P.kwargs) -> R:
        return function(*args, **kwargs)

    roomy.__code__ = roomy.__code__.replace(co_stacksize=WORDS)
    return functools.wraps(function)(roomy)
