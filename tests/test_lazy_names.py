"""Packages whose names are loaded when they are first used."""

import pytest

from rfem_jax.lazy_names import lazy_names
from tests.processes import in_a_new_process

UNUSED = "scipy.stats xarray pandas "
UNUSED += "rfem_jax.tolerancing.robust_design.allocation rfem_jax.tolerancing.sampling.monte_carlo_study"


def test_names_are_those_of_their_modules():
    load, _, names = lazy_names("json", {"decoder": "JSONDecoder JSONDecodeError", "encoder": "JSONEncoder"})
    assert names == ["JSONDecodeError", "JSONDecoder", "JSONEncoder"]
    from json.encoder import JSONEncoder

    assert load("JSONEncoder") is JSONEncoder
    with pytest.raises(AttributeError, match="module 'json' has no attribute 'loads'"):
        load("loads")


@pytest.mark.parametrize("package", ["rfem_jax", "rfem_jax.simulation", "rfem_jax.tolerancing"])
def test_all_public_names_are_found(package):
    from importlib import import_module

    module = import_module(package)
    assert set(module.__all__) <= set(dir(module))
    for name in module.__all__:
        assert getattr(module, name) is not None


@pytest.mark.slow
def test_a_problem_needs_no_statistics_and_no_tables():
    code = f"import sys; from rfem_jax import Problem; print([x for x in '{UNUSED}'.split() if x in sys.modules])"
    assert in_a_new_process(code) == "[]"
