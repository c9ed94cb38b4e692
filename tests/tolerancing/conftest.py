"""A check of how input is refused."""

from tests.description.conftest import refused  # noqa: F401
