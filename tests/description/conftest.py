"""Shared by the tests of the description package: a check of how input is refused."""

import re
from contextlib import contextmanager

import pytest

from rfem_jax.description import InputError


@contextmanager
def _refused(*expected):
    """The block must raise InputError: one sentence with "must", "but" and the fix, that holds all
    the `expected` pieces of text."""
    with pytest.raises(InputError) as caught:
        yield
    message = str(caught.value)
    assert "\n" not in message
    assert re.search(r"\bmust\b", message), message
    assert re.search(r"\bbut\b", message), message
    assert message.endswith((".", "?")), message
    sentence, _, fix = message.rpartition("; ")
    assert sentence and len(fix) > 3, message
    for text in expected:
        assert text in message, f"{text!r} is not in {message!r}"


@pytest.fixture
def refused():
    return _refused
