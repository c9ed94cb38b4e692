"""Frames of deep calls have room: the interpreter asks the system for no memory for them."""

import sys

import pytest

from rfem_jax.stack_room import with_room

resource = pytest.importorskip("resource")
CALLS = 200


def small(a, b, c, d):
    return a


def faults(depth):
    """Pages that the system gave while a small function was called again and again, so many calls deep."""
    if depth:
        return faults(depth - 1)
    small(1, 2, 3, 4)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(CALLS):
        small(1, 2, 3, 4)
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before


def most_faults():
    return max(faults(depth) for depth in range(200))


@pytest.mark.skipif(sys.platform != "linux" or sys.implementation.name != "cpython", reason="frames are kept otherwise")
def test_no_depth_needs_pages_for_each_call():
    assert with_room(most_faults)() < CALLS / 4


def test_a_function_with_room_is_the_function():
    @with_room
    def deep(depth, *, last):
        """Its own words."""
        if depth == 0:
            raise ValueError(last)
        return deep.__wrapped__(depth - 1, last=last)

    assert deep.__doc__ == "Its own words." and deep.__name__ == "deep"
    with pytest.raises(ValueError, match="the last"):
        deep(500, last="the last")
    assert with_room(dict)(a=1) == {"a": 1}
