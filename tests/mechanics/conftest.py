"""Settings of the tests of one instant."""

import pytest


@pytest.fixture(scope="module", autouse=True)
def _quick(quick_compilation):
    """All modules of this folder compile quickly."""
    yield
