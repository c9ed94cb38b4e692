"""The key of a kept program changes with everything that the program depends on, and with nothing else."""

import functools
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rfem_jax import MomentRamp, Problem, RungeKutta4, Simulation, discretise, metric
from rfem_jax.compilation import keys
from rfem_jax.compilation.keys import NotDigestible, canonical, digest_content, digest_named
from rfem_jax.description.methods import named_method
from rfem_jax.tolerancing.problems.kept_evaluations import fingerprint_problem
from rfem_jax.tolerancing.problems.metrics import end_angle
from tests.mechanisms import four_bar

SMALL = "generalised_alpha"


@pytest.fixture(autouse=True)
def tests_are_covered(monkeypatch):
    monkeypatch.setattr(keys, "COVERED", keys.COVERED | {__name__.split(".")[0]})


@dataclass(frozen=True)
class Point:
    x: float
    names: tuple = field(default=("a",))


class Pair(NamedTuple):
    x: float
    names: tuple


@pytest.mark.parametrize(
    "values",
    [
        (1, 1.0, True, "1", b"1", None, ..., 1j, np.float64(1.0), np.array(1.0), np.array(1), (1,), [1]),
        (0.0, -0.0, 5e-324, float("nan"), float("inf")),
        ((1, 2), (2, 1), ((1,), 2), (1, (2,)), "(1, 2)", (1,), ()),
        ({"a": 1}, {"a": 2}, {"b": 1}, {"a": 1, "b": 2}, {"b": 2, "a": 1}, {1: 1}),
        (Point(1.0), Point(2.0), Point(1.0, ("b",)), Pair(1.0, ("a",)), (1.0, ("a",)), Point, Pair),
        (np.zeros(2), np.zeros(3), np.zeros((1, 2)), np.array([0.0, 1e-300]), np.zeros(2, np.float32)),
        (jnp.sin, jnp.cos, functools.partial(jnp.sin), functools.partial(jnp.sin, 1.0), len, max),
        (metric("A.rms_force"), metric("B.rms_force"), metric("A.rms_moment"), end_angle(), end_angle(1.0)),
        (RungeKutta4(step=1e-5), RungeKutta4(step=1.1e-5), named_method(SMALL, step=1e-5)),
    ],
)
def test_different_values_have_different_names(values):
    names = [canonical(value, True) for value in values]
    assert len({repr(name) for name in names}) == len(values)
    assert names == [canonical(value, True) for value in values]


def test_arrays_count_by_content_in_static_places_only():
    one, other = discretise(four_bar(2)), discretise(replace(four_bar(2), gravity=(0.0, 0.0, -1.0)))
    assert canonical(one) == canonical(other)
    assert canonical(one, True) != canonical(other, True)
    assert canonical(jnp.ones(2)) == canonical(jnp.zeros(2)) != canonical(jnp.ones(3))
    assert canonical(jnp.asarray(1.0)) != canonical(jnp.asarray(1))


def made_of(number):
    return lambda x: number * x


def test_functions_count_by_what_they_close_over():
    assert canonical(made_of(2.0)) == canonical(made_of(2.0)) != canonical(made_of(3.0))
    assert canonical(made_of(np.ones(2))) != canonical(made_of(np.zeros(2)))
    assert canonical(lambda x, y=1: x) != canonical(lambda x, y=2: x)


def user_namespace():
    space = {"__name__": "__main__"}
    exec("class Drive:\n    def moment(self, t): return t\ndef own(t): return t", space)
    return space


def disguised():
    function = user_namespace()["own"]
    function.__module__, function.__qualname__ = "rfem_jax.mechanics.statics.assembly", "assemble"
    return function


@pytest.mark.parametrize(
    "make",
    [
        lambda: user_namespace()["own"],
        lambda: user_namespace()["Drive"](),
        lambda: user_namespace()["Drive"],
        lambda: made_of(user_namespace()["own"]),
        lambda: functools.partial(user_namespace()["own"], 1.0),
        lambda: np.array([object()]),
        disguised,
        object,
    ],
)  # fmt: skip
def test_what_is_not_known_is_refused(make):
    with pytest.raises(NotDigestible):
        canonical(make(), True)


INGREDIENTS = {
    "sources": ("hash_sources", lambda: "edited"),
    "versions": ("_versions", lambda: ("3.14", (("jax", "1.0"),))),
    "processor": ("_processor", lambda: "another model"),
    "devices": ("_devices", lambda: "two of them"),
}


@pytest.mark.parametrize("name", INGREDIENTS)
def test_the_key_has_sources_versions_processor_and_devices(name, monkeypatch):
    before = digest_named(("program",))
    assert digest_named(("program",)) == before != digest_named(("another",))
    monkeypatch.setattr(keys, *INGREDIENTS[name])
    assert digest_named(("program",)) != before


def test_the_key_has_xlas_options_and_the_environment(monkeypatch):
    before = {digest_named(("program",))}
    monkeypatch.setenv("XLA_FLAGS", "--xla_cpu_enable_fast_math=true")
    before.add(digest_named(("program",)))
    monkeypatch.setenv("NPROC", "3")
    before.add(digest_named(("program",)))
    monkeypatch.setenv("EQX_ON_ERROR", "nan")
    before.add(digest_named(("program",)))
    assert len(before) == 4
    monkeypatch.setenv("HOME", "elsewhere")
    assert digest_named(("program",)) in before


def test_the_key_has_what_is_in_a_file_of_xlas_options(monkeypatch, tmp_path):
    file, found = tmp_path / "flags", set()
    monkeypatch.setenv("XLA_FLAGS", str(file))
    for text in ("--xla_cpu_enable_fast_math=true", "--xla_cpu_enable_fast_math=false"):
        file.write_text(text, encoding="utf-8")
        found.add(digest_named(("program",)))
    assert len(found) == 2


def test_the_key_has_the_compiler_of_kernels(monkeypatch):
    found = digest_named(("program",))
    monkeypatch.setattr(keys.machine_code, "processor", lambda: "another version")
    monkeypatch.setattr(keys.machine_code, "is_available", lambda: True)
    other = digest_named(("program",))
    monkeypatch.setattr(keys.machine_code, "is_available", lambda: False)
    assert len({found, other, digest_named(("program",))}) >= 2 and other != digest_named(("program",))


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("jax_disable_most_optimizations", True),
        ("jax_default_matmul_precision", "highest"),
        ("jax_debug_nans", True),
        ("jax_numpy_rank_promotion", "allow"),
    ],
)
def test_the_key_has_the_settings_of_jax(name, value):
    before, found = keys.read_setting(name), digest_named(("program",))
    try:
        jax.config.update(name, value)
        assert digest_named(("program",)) != found
    finally:
        jax.config.update(name, before)
    assert digest_named(("program",)) == found


def test_where_programs_are_kept_is_no_part_of_the_key():
    before, found = jax.config.jax_compilation_cache_dir, digest_named(("program",))
    try:
        jax.config.update("jax_compilation_cache_dir", "/elsewhere")
        assert digest_named(("program",)) == found
    finally:
        jax.config.update("jax_compilation_cache_dir", before)


def test_sources_are_read_whole(tmp_path, monkeypatch):
    package = tmp_path / "rfem_jax" / "compilation"
    package.mkdir(parents=True)
    (package.parent / "physics.py").write_text("g = 9.81")
    monkeypatch.setattr(keys, "__file__", str(package / "keys.py"))
    before = keys.read_sources()
    assert keys.read_sources() == before
    (package.parent / "physics.py").write_text("g = 9.82")
    assert keys.read_sources() != before


def test_a_problems_fingerprint_has_its_numbers_and_is_not_the_machines(monkeypatch):
    def problem(moment=1.0, duration=0.1, name="A.rms_force", step=1e-3):
        method = named_method(SMALL, step=step)
        return Problem(Simulation(model, drive=MomentRamp("A", moment, 0.01), duration=duration, method=method), [name])

    model = discretise(four_bar(2))
    whole = fingerprint_problem(problem())
    others = [
        problem(moment=1.0 + 1e-15), problem(duration=0.2), problem(name="A.rms_moment"), problem(step=2e-3)
    ]  # fmt: skip
    assert len({whole, *map(fingerprint_problem, others)}) == 5
    monkeypatch.setattr(keys, "_devices", lambda: "another machine")
    monkeypatch.setattr(keys, "_processor", lambda: "another machine")
    assert fingerprint_problem(problem()) == whole == digest_content(problem())
    monkeypatch.setattr(keys, "hash_sources", lambda: "edited")
    assert fingerprint_problem(problem()) != whole


def test_the_digest_of_a_value_is_of_its_content_alone(monkeypatch):
    value = {"a": (1.0, np.arange(3.0))}
    before = keys.digest_value(value)
    monkeypatch.setattr(keys, "hash_sources", lambda: "other sources")
    assert keys.digest_value({"a": (1.0, np.arange(3.0))}) == before
    assert keys.digest_value({"a": (1.0, np.arange(3.0) + 1e-15)}) != before
    with pytest.raises(NotDigestible):
        keys.digest_value(object())
