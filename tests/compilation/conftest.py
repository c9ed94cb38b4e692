"""A folder of kept programs for a test."""

import pytest

from tests.compilation.functions import covered


@pytest.fixture
def kept(tmp_path):
    """Statistics of a folder of kept programs that is empty."""
    with covered(tmp_path / "programs") as statistics:
        yield statistics
