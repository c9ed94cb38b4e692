"""Kept programs: a program compiled once is not traced again, also in another process, and gives the same bits, with a
kernel in it or without; what depends on something outside of the key is not kept; within a transformation of JAX a
program is the function itself."""

import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rfem_jax.compilation import keeping
from rfem_jax.compilation.program import Program
from rfem_jax.kernels import machine_code
from tests.compilation.functions import covered, forget, oscillator, swing, swing_kept
from tests.processes import in_a_new_process

X = jnp.linspace(0.2, 0.9, 3)


def by_jax(*arguments):
    """Without keeping."""
    return eqx.filter_jit(lambda *arguments: swing(*arguments))(*arguments)


def assert_same_bits(found, expected):
    assert jax.tree.structure(found) == jax.tree.structure(expected)
    for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_array_equal(one, other)
        assert getattr(one, "dtype", None) == getattr(other, "dtype", None)


def counts(statistics):
    return statistics.traced, statistics.loaded, statistics.written


def test_what_was_kept_gives_the_same_bits_without_tracing(kept):
    expected = by_jax(oscillator(), X)
    assert_same_bits(swing_kept(oscillator(), X), expected)
    assert counts(kept) == (1, 0, 1)
    swing_kept(oscillator(), X)
    assert counts(kept) == (1, 0, 1)
    forget()
    assert_same_bits(swing_kept(oscillator(), X), expected)
    assert counts(kept) == (1, 1, 1)


def test_numbers_are_inputs_of_one_program(kept):
    for rate in (0.7, 0.8):
        for x in (X, X + 1.0, np.asarray(X)):
            expected = by_jax(oscillator(rate), x)
            assert_same_bits(swing_kept(oscillator(rate), x), expected)
    assert kept.traced == 1


@pytest.mark.parametrize(
    "other",
    [
        lambda: swing_kept(oscillator(steps=4), X),
        lambda: swing_kept(oscillator(), X[:2]),
        lambda: swing_kept(oscillator(), X, scale=2.0),
        lambda: swing_kept(oscillator(), X, scale=2),
        lambda: swing_kept(oscillator(), X, scale=jnp.asarray(2.0)),
        lambda: swing_kept(oscillator(), X.astype(jnp.float32)),
        lambda: swing_kept(oscillator(), jax.device_put(X, jax.devices()[0])),
    ],
)
def test_another_structure_type_or_place_is_another_program(kept, other):
    swing_kept(oscillator(), X)
    with jax.numpy_dtype_promotion("standard"):
        other()
    assert kept.traced == 2 and kept.written == 2


def test_a_kept_program_that_xla_cannot_load_is_traced_anew(kept, monkeypatch):
    expected = swing_kept(oscillator(), X)
    forget()

    def fail(packed):
        raise RuntimeError("of another processor")

    monkeypatch.setattr("rfem_jax.compilation.executable.Packed.loaded", fail)
    assert_same_bits(swing_kept(oscillator(), X), expected)
    assert counts(kept) == (2, 0, 2)


@pytest.mark.parametrize(
    "setting",
    [
        lambda: jax.default_matmul_precision("highest"),
        lambda: jax.numpy_rank_promotion("allow"),
        lambda: jax.threefry_partitionable(False),
    ],
)
def test_settings_of_jax_are_part_of_the_key(kept, setting):
    swing_kept(oscillator(), X)
    forget()
    with setting():
        swing_kept(oscillator(), X)
    assert counts(kept) == (2, 0, 2)


def test_a_damaged_or_unreadable_program_is_compiled_again(kept, tmp_path):
    expected = swing_kept(oscillator(), X)
    (file,) = (tmp_path / "programs").iterdir()
    file.write_bytes(file.read_bytes()[:-5])
    forget()
    assert_same_bits(swing_kept(oscillator(), X), expected)
    assert counts(kept) == (2, 0, 2)
    keeping.write(file.stem, b"whole, but no program")
    forget()
    assert_same_bits(swing_kept(oscillator(), X), expected)
    assert kept.traced == 3
    forget()
    swing_kept(oscillator(), X)
    assert kept.traced == 3 and kept.loaded == 1


def test_functions_of_the_user_are_not_kept(kept, tmp_path):
    user = {"__name__": "__main__"}
    exec("def own(x): return x**2", user)
    exec("triple = lambda x: 3.0 * x", user)
    own = user["own"]
    with_function = Program(lambda function, x: function(x))
    np.testing.assert_array_equal(with_function(own, X), X**2)
    np.testing.assert_array_equal(with_function(user["triple"], X), 3.0 * X)
    with_function(own, X)
    assert counts(kept) == (2, 0, 0) and len(kept.unkept) == 1
    # Also by what a function has from outside.
    np.testing.assert_allclose(jax.jacfwd(lambda x: with_function(own, x))(X), jnp.diag(2.0 * X))
    np.testing.assert_allclose(jax.jacfwd(lambda a: with_function(lambda x: a**2 * x, X))(3.0), 6.0 * X)
    assert counts(kept) == (2, 0, 0) and len(kept.unkept) == 1
    assert not (tmp_path / "programs").exists()


def test_a_program_that_calls_python_is_not_kept_but_runs(kept, monkeypatch):
    expected = swing(oscillator(), X).path

    def fail(_):
        raise ValueError("no serialisation")

    monkeypatch.setattr("rfem_jax.compilation.executable.Executable.dump", fail)
    np.testing.assert_allclose(swing_kept(oscillator(), X).path, expected)
    assert counts(kept) == (1, 0, 0) and "no serialisation" in str(kept.unkept)


@pytest.fixture
def jaxs_cache(tmp_path):
    """Folder of JAX's own cache, empty."""
    from jax.experimental.compilation_cache import compilation_cache

    before = jax.config.jax_compilation_cache_dir
    jax.config.update("jax_compilation_cache_dir", str(tmp_path / "jax"))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    compilation_cache.reset_cache()
    yield tmp_path / "jax"
    jax.config.update("jax_compilation_cache_dir", before)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 1.0)
    compilation_cache.reset_cache()


def test_programs_from_jaxs_own_cache_are_not_kept_broken(kept, tmp_path, jaxs_cache):
    """XLA cannot serialise an executable that it has deserialised."""
    expected = swing_kept(oscillator(), X)
    for _ in range(2):
        for file in (tmp_path / "programs").iterdir():
            file.unlink()
        forget()
        jax.clear_caches()
        swing_kept(oscillator(), X)
        forget()
        assert_same_bits(swing_kept(oscillator(), X), expected)
    assert kept.loaded == 2


def test_jaxs_own_cache_has_what_is_not_kept(kept, jaxs_cache):
    def written():
        return {path.name for path in jaxs_cache.iterdir() if "of_users" in path.name}

    jnp.zeros(3).block_until_ready()  # JAX makes the folder
    swing_kept(oscillator(), X)
    assert not any("swing" in path.name for path in jaxs_cache.iterdir()) and not written()

    user = {"__name__": "__main__"}
    exec("def of_users(x): return x + 0.125", user)
    Program(user["of_users"])(X)
    assert written() and kept.written == 1


def end(x, function):
    return function(oscillator(), x).end["end"]


def total(x, function):
    return jnp.sum(function(oscillator(), x).path)


def whole(x, function):
    return function(oscillator(), x)._replace(steps=0)


PAIR = jnp.stack([X, X + 0.3])
TRANSFORMED = {
    "jacfwd": lambda f: jax.jacfwd(lambda x: end(x, f))(X),
    "jacrev": lambda f: jax.jacrev(lambda x: end(x, f))(X),
    "value_and_grad": lambda f: jax.value_and_grad(lambda x: total(x, f))(X),
    "hessian": lambda f: jax.hessian(lambda x: total(x, f))(X),
    "forward twice": lambda f: jax.jacfwd(jax.jacfwd(lambda x: total(x, f)))(X),
    "reverse twice": lambda f: jax.jacrev(jax.jacrev(lambda x: total(x, f)))(X),
    "vmap": lambda f: jax.vmap(lambda x: whole(x, f))(PAIR),
    "vmap, last axis": lambda f: jax.vmap(lambda x: end(x, f), in_axes=1)(PAIR.T),
    "vmap of grad": lambda f: jax.vmap(jax.grad(lambda x: total(x, f)))(PAIR),
    "grad of vmap": lambda f: jax.grad(lambda xs: jnp.sum(jax.vmap(lambda x: total(x, f))(xs)))(PAIR),
    "by a number": lambda f: jax.jacfwd(lambda rate: f(oscillator(rate), X).path)(0.4),
    "of the model": lambda f: eqx.filter_grad(lambda o: jnp.sum(f(o, X).path))(oscillator()).rate,
    "without batch": lambda f: jax.vmap(lambda x: f(oscillator(), x).end["twice"], out_axes=None)(PAIR),
    "linearised": lambda f: jax.linearize(lambda x: end(x, f), X)[1](X),
    "linearised, in a batch": lambda f: jax.vmap(jax.linearize(lambda x: end(x, f), X)[1])(PAIR),
    "linearised, jitted": lambda f: jax.jit(jax.linearize(lambda x: end(x, f), X)[1])(X),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("name", TRANSFORMED)
@pytest.mark.parametrize("jitted", [False, True], ids=["plain", "jitted"])
def test_within_a_transformation_it_is_the_function_itself(kept, name, jitted):
    transform = TRANSFORMED[name]
    expected = transform(swing)
    found = jax.jit(lambda: transform(swing_kept))() if jitted else transform(swing_kept)
    assert jax.tree.structure(found) == jax.tree.structure(expected)
    for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-11, atol=1e-13)
    assert counts(kept) == (0, 0, 0)


def test_in_a_jit_it_is_traced_like_any_function(kept):
    expected = jax.grad(lambda x: total(x, swing))(X)
    np.testing.assert_allclose(jax.jit(lambda x: end(x, swing_kept))(X), end(X, swing), rtol=1e-12)
    np.testing.assert_allclose(jax.jit(jax.grad(lambda x: total(x, swing_kept)))(X), expected, rtol=1e-12)
    np.testing.assert_allclose(jax.grad(jax.jit(lambda x: total(x, swing_kept)))(X), expected, rtol=1e-12)
    checkpointed = jax.checkpoint(lambda x: total(x, swing_kept))
    np.testing.assert_allclose(jax.grad(checkpointed)(X), expected, rtol=1e-12)
    assert counts(kept) == (0, 0, 0)


def test_of_known_arrays_within_a_jit_it_is_the_kept_program(kept):
    """Its results are constants of what is traced."""
    found = jax.jit(lambda x: x + swing_kept(oscillator(), X).end["end"])(X)
    np.testing.assert_allclose(found, X + end(X, swing), rtol=1e-12)


@pytest.mark.parametrize("transform", [jax.jit, jax.vmap, jax.jacfwd, jax.jacrev, lambda f: jax.jit(jax.hessian(f))])
def test_static_results_come_back_from_a_transformation(kept, transform):
    seen = []

    def steps(x):
        run = swing_kept(oscillator(), jnp.broadcast_to(x, 3))
        seen.append(run.steps)
        return run.path

    expected = transform(lambda x: swing(oscillator(), jnp.broadcast_to(x, 3)).path)(X)
    np.testing.assert_allclose(transform(steps)(X), expected, rtol=1e-11, atol=1e-13)
    assert set(seen) == {3} and counts(kept) == (0, 0, 0)


def test_where_programs_are_not_kept_they_are_made_in_the_same_way(tmp_path, monkeypatch):
    monkeypatch.setattr(keeping, "write", lambda *_: pytest.fail("without a folder"))
    expected = by_jax(oscillator(), X)
    with covered(None) as statistics:
        assert_same_bits(swing_kept(oscillator(), X), expected)
        assert keeping.state()["kept_programs"] == "not used: switched off"
        assert counts(statistics) == (1, 0, 0)
        np.testing.assert_allclose(
            jax.grad(lambda x: total(x, swing_kept))(X), jax.grad(lambda x: total(x, swing))(X), rtol=1e-12
        )
        assert counts(statistics) == (1, 0, 0)


@pytest.mark.parametrize("folder", [None, "programs"])
def test_what_is_compiled_is_said_and_whether_it_is_kept(tmp_path, monkeypatch, folder):
    said = []
    monkeypatch.setattr("rfem_jax.compilation.executable.on_stage", said.append)
    with covered(folder and tmp_path / folder):
        swing_kept(oscillator(), X)
    once = ", once for all models of its kind" if folder else ""
    assert said == [f"Compiling the program 'swing'{once}"]


def test_a_folder_inside_of_jaxs_cache_is_refused(tmp_path):
    before = jax.config.jax_compilation_cache_dir
    jax.config.update("jax_compilation_cache_dir", str(tmp_path))
    try:
        with covered(tmp_path / "programs"):
            assert not keeping.wanted()
            assert "JAX_COMPILATION_CACHE_DIR" in keeping.state()["kept_programs"]
    finally:
        jax.config.update("jax_compilation_cache_dir", before)


def test_a_folder_inside_of_the_results_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(keeping, "_results", [])
    keeping.keep_apart_from(tmp_path / "results")
    with covered(tmp_path / "results" / "cache" / "programs"):
        assert "folder for results" in keeping.state()["kept_programs"]
    with covered(tmp_path / "programs"):
        assert keeping.wanted()


OTHER_PROCESS = """
import sys
from concurrent.futures import ThreadPoolExecutor
import rfem_jax, jax
jax.config.update("jax_enable_x64", True)
import jax.numpy as jnp
from tests.compilation.functions import covered, oscillator, solve_kept, swing_kept
with covered(sys.argv[1]) as statistics:
    found = swing_kept(oscillator(), jnp.linspace(0.2, 0.9, 3))
    # JAX looks up LAPACK's functions when it lowers a program that calls them: here it lowers none.
    solved = solve_kept(jnp.diag(jnp.arange(1.0, 4.0)), jnp.ones(3))
    values = [*found.path, *found.end["end"], *solved]
    print(statistics.traced, statistics.loaded, *(float(x).hex() for x in values))
"""


@pytest.mark.slow
def test_another_process_traces_nothing_and_finds_the_same_bits(tmp_path):
    first = in_a_new_process(OTHER_PROCESS, str(tmp_path / "programs")).split()
    second = in_a_new_process(OTHER_PROCESS, str(tmp_path / "programs")).split()
    assert first[:2] == ["2", "0"] and second[:2] == ["0", "2"]
    assert first[2:] == second[2:]


ON_TWO_DEVICES = """
import sys
from concurrent.futures import ThreadPoolExecutor
import rfem_jax, jax, numpy as np
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_num_cpu_devices", 2)
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from tests.compilation.functions import covered, oscillator, spread_kept, swing_kept
with covered(sys.argv[1]) as statistics:
    mesh = Mesh(np.array(jax.devices()), ("rows",))
    rows = NamedSharding(mesh, PartitionSpec("rows"))
    x = jax.device_put(np.arange(8.0).reshape(4, 2), rows)
    found = spread_kept(x, mesh)
    second = swing_kept(oscillator(), jax.device_put(np.ones(3), jax.devices()[1])).path
    devices = (d.id for d in second.devices())
print(statistics.traced, statistics.loaded, len(found.devices()), *devices, *np.asarray(found).ravel())
"""


@pytest.mark.slow
def test_programs_of_several_devices_and_of_the_second_one(tmp_path):
    first = in_a_new_process(ON_TWO_DEVICES, str(tmp_path / "programs")).split()
    second = in_a_new_process(ON_TWO_DEVICES, str(tmp_path / "programs")).split()
    assert first[:2] == ["2", "0"] and second[:2] == ["0", "2"]
    assert first[2:] == second[2:] == ["2", "1", *["0.0", "1.0", "2.0", "4.0", "4.0", "5.0", "10.0", "12.0"]]


@pytest.mark.slow
def test_two_processes_at_once(tmp_path):
    command = [sys.executable, "-c", OTHER_PROCESS, str(tmp_path / "programs")]
    environment = {**os.environ, "JAX_PLATFORMS": "cpu", "PYTHONPATH": os.getcwd()}
    processes = [subprocess.Popen(command, stdout=subprocess.PIPE, env=environment, text=True) for _ in range(2)]
    one, two = (process.communicate()[0].split() for process in processes)
    assert one[2:] == two[2:] and len(one) > 2


def test_the_state_says_what_was_used(kept, monkeypatch):
    swing_kept(oscillator(), X)
    found = keeping.state()
    assert found["kept_programs"] == "used" and (found["programs_loaded"], found["programs_traced"]) == (0, 1)
    monkeypatch.setattr(machine_code, "llvm", object())
    assert keeping.state()["kernels"] == "machine code"
    monkeypatch.setattr(machine_code, "llvm", None)
    assert keeping.state()["kernels"] == "compiled by XLA: llvmlite is not installed"


@pytest.mark.parametrize("transform", [jax.grad, jax.jit, jax.value_and_grad, lambda f: jax.jit(jax.hessian(f))])
def test_what_a_function_closes_over_may_be_transformed(kept, transform):
    """Also where no argument is, as the number in a force of the user's."""
    with_function = Program(lambda function, x: function(x))

    def total_of(program):
        return lambda a: jnp.sum(program(lambda x: jnp.sin(a * x) * a, X))

    found = transform(total_of(with_function))(jnp.asarray(0.4))
    expected = transform(total_of(lambda function, x: function(x)))(jnp.asarray(0.4))
    np.testing.assert_allclose(found, expected, rtol=1e-12)
    assert counts(kept) == (0, 0, 0)


def test_numbers_that_a_function_closes_over_are_constants(kept):
    """Another number is another program."""
    with_function = Program(lambda function, x: function(x))

    def made_of(number):
        number = jnp.full(1000, number)
        return lambda x: x[:, None] * number[None]

    for number in (0.4, 0.4, 0.5):
        forget()
        with_function.clear()
        np.testing.assert_allclose(with_function(made_of(number), X), X[:, None] * np.full((1, 1000), number))
    assert counts(kept) == (2, 1, 2)


@pytest.mark.parametrize("setting", [jax.debug_nans, jax.debug_infs, jax.checking_leaks])
def test_where_jax_watches_a_computation_it_is_the_function_itself(kept, setting):
    with setting(True) if setting is not jax.checking_leaks else setting():
        np.testing.assert_allclose(swing_kept(oscillator(), X).path, swing(oscillator(), X).path, rtol=1e-12)
    assert counts(kept) == (0, 0, 0)


def test_threads_wait_for_one_another(kept):
    with ThreadPoolExecutor(4) as pool:
        results = list(pool.map(lambda _: swing_kept(oscillator(), X), range(8)))
    for result in results:
        assert_same_bits(result, results[0])
    assert counts(kept) == (1, 0, 1)
