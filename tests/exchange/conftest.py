"""Commands run in the process of their tests, whose JAX is set up."""

import pytest

from rfem_jax.report import command_line


@pytest.fixture(autouse=True)
def _jax_is_set_up(monkeypatch):
    monkeypatch.setattr(command_line, "set_up_jax", lambda *_: None)
