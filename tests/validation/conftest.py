"""Settings of the tests of validation."""

import pytest


@pytest.fixture(scope="module", autouse=True)
def _quick(quick_compilation):
    """All modules of this folder compile quickly."""
    yield
