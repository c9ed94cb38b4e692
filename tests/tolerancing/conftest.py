"""Settings of the tests of tolerance studies."""

import pytest


@pytest.fixture(scope="module", autouse=True)
def _quick(quick_compilation):
    """All modules of this folder compile quickly."""
    yield
