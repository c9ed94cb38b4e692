"""Shared by the tests of the description package: a check of how input is refused."""

import os
import re
from contextlib import contextmanager

import pytest
from jaxtyping import TypeCheckError

from rfem_jax import InputError

# Where types are checked at run time, the checker may be faster than the sentence about a value of a wrong type.
REFUSALS = (InputError, TypeCheckError) if os.environ.get("RFEM_JAX_CHECK_TYPES") == "1" else InputError


@contextmanager
def _refused(*expected):
    """The block must raise InputError: one sentence with "must", "but" and the fix, that holds all
    the `expected` pieces of text."""
    with pytest.raises(REFUSALS) as caught:
        yield
    if isinstance(caught.value, TypeCheckError):
        return
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
