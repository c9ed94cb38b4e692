"""Kernels beside the functions that they are of: values, batches, derivatives."""

import warnings
from fractions import Fraction

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rfem_jax.kernels import expand_primitive, expecting, is_available, kernel, machine_code, programs, registry
from rfem_jax.kernels.arithmetic import Arithmetic
from rfem_jax.kernels.builder import Builder, Value
from tests.processes import in_a_new_process

pytestmark = pytest.mark.skipif(not is_available(), reason="llvmlite is not installed")

KEY = jax.random.key(0)
X = jnp.array([0.1, 0.6, 2.0])


def fast(function):
    """A kernel that is compiled as fast as possible, and may not fall back to XLA."""
    made = kernel(function, selection="fast")

    def strict(*arguments):
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            return made(*arguments)

    return strict


def assert_same(found, wanted, rtol=1e-13):
    assert jax.tree.structure(found) == jax.tree.structure(wanted)
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(wanted), strict=True):
        a, b = jnp.asarray(a), jnp.asarray(b)
        assert a.shape == b.shape and a.dtype == b.dtype
        np.testing.assert_allclose(a, b, rtol=rtol, atol=1e-14)


def integrated(x, rate):
    """Steps of a pendulum with a stage loop inside, as in a method of integration."""

    def step(state, t):
        def stage(k, node):
            angle, speed = state[0] + 0.01 * node * k[0], state[1] + 0.01 * node * k[1]
            return jnp.stack([speed, -jnp.sin(angle) + rate * jnp.cos(t)]), None

        k, _ = jax.lax.scan(stage, jnp.zeros(2), jnp.array([0.0, 0.5, 0.5, 1.0]))
        state = state + 0.01 * k
        return state, state[0]

    return jax.lax.scan(step, x[:2], jnp.linspace(0.0, 1.0, 100))


def newton(x, target):
    """A root by Newton's method, whose number of iterations differs from sample to sample."""

    def goes_on(carry):
        _, change, count = carry
        return (jnp.abs(change) > 1e-13) & (count < 50)

    def improve(carry):
        y, _, count = carry
        change = (y**3 + y - target) / (3 * y**2 + 1.0)
        return y - change, change, count + 1

    return jax.lax.while_loop(goes_on, improve, (x[0], jnp.inf, 0))


def branches(x, index):
    long = lambda y: jax.lax.fori_loop(0, 70, lambda i, z: jnp.tanh(z) + 0.01 * i, y)  # noqa: E731
    chosen = jax.lax.switch(index, [lambda y: y, long, lambda y: -2.0 * y], x)
    return jax.lax.cond(x[0] > 0.3, long, lambda y: y * 2.0, chosen)


def places(x, index):
    """Rows that are read and written at places that are computed."""
    table = jnp.outer(jnp.arange(5.0), x)
    row = jax.lax.dynamic_slice(table, (index, 0), (2, 3))
    table = jax.lax.dynamic_update_slice(table, row * 3.0, (index - 1, 0))
    column = jax.lax.dynamic_index_in_dim(table, index, keepdims=False)
    return table, column, x[jnp.array([2, 0, 1])], x.at[1].add(3.0), x.at[jnp.array([0, 2])].set(7.0)


def small_operations(x, other):
    a = jnp.outer(x, x) + jnp.eye(3)
    whole = jnp.array([3, -1, 2], jnp.int32)
    return {
        "products": a @ a.T @ x,
        "sums": (jnp.sum(a, axis=0), jnp.max(a, axis=1), jnp.min(a), jnp.all(x > 0.05), jnp.any(x > 1.0)),
        "powers": (x**3, x**-2, x**0.5, jnp.sqrt(x), 1.0 / x, jax.lax.rsqrt(x)),
        "functions": (jnp.tan(x), jnp.arctan2(x, other), jnp.tanh(x), jnp.exp(x), jnp.log(x), jnp.arccos(x / 3.0)),
        "selected": (jnp.where(x > other, x, -x), jnp.clip(x, 0.2, 1.0), jnp.sign(x - 0.6), jnp.abs(-x)),
        "whole": (whole * 2, (x * 10).astype(jnp.int32), (x > 0.5).astype(float), whole // 2, jnp.isfinite(x)),
        "shapes": (a.T.reshape(9)[::-1], jnp.concatenate([x, x[1:]]), jnp.pad(x, (1, 2)), a[None, ..., :2]),
    }


CASES = {
    "integrated": (integrated, (X, jnp.asarray(0.3))),
    "newton": (newton, (X, jnp.asarray(2.0))),
    "branches": (branches, (X, jnp.asarray(1))),
    "places": (places, (X, jnp.asarray(2))),
    "small_operations": (small_operations, (X, jnp.asarray(0.5))),
}


@pytest.mark.parametrize("name", CASES)
def test_values_are_those_of_the_function(name):
    function, arguments = CASES[name]
    assert_same(jax.jit(fast(function))(*arguments), function(*arguments))


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_batches_of_any_axes(name):
    function, (_, other) = CASES[name]
    xs = jnp.linspace(0.05, 1.4, 33).reshape(11, 3)
    others = other + jnp.arange(3).astype(other.dtype)
    over = lambda f: jax.vmap(jax.vmap(f, in_axes=(0, None)), in_axes=(None, 0), out_axes=0)  # noqa: E731
    assert_same(over(fast(function))(xs, others), over(function)(xs, others))


def test_a_sample_has_the_same_bits_in_any_batch():
    made = kernel(integrated, selection="fast")
    xs = jax.random.normal(KEY, (19, 3))
    rates = jnp.linspace(0.0, 1.0, 19)
    whole = jax.vmap(made)(xs, rates)
    for size in (1, 2, 3, 8, 19):
        part = jax.vmap(made)(xs[-size:], rates[-size:])
        for a, b in zip(jax.tree.leaves(part), jax.tree.leaves(whole)):
            np.testing.assert_array_equal(a, b[-size:])


def test_what_is_not_a_number_stays_in_its_sample_and_ends_its_loop():
    xs = jnp.array([[1.0], [jnp.nan], [2.0]])
    found = jax.vmap(fast(newton), in_axes=(0, None))(xs, jnp.asarray(2.0))
    alone = newton(xs[2], jnp.asarray(2.0))
    assert jnp.isnan(found[0][1])
    assert found[0][2] == pytest.approx(float(alone[0]), rel=1e-15) and found[2][2] == alone[2]
    assert found[2][1] == newton(xs[1], jnp.asarray(2.0))[2]


def weighted(f):
    return lambda x, rate: jnp.sum(f(x, rate)[1] ** 2)


@pytest.mark.parametrize("mode", [jax.jacfwd, jax.jacrev, jax.hessian], ids=["forward", "reverse", "second"])
def test_derivatives_in_both_modes(mode):
    arguments = X, jnp.asarray(0.3)
    found = jax.jit(mode(weighted(fast(integrated)), argnums=(0, 1)))(*arguments)
    assert_same(found, mode(weighted(integrated), argnums=(0, 1))(*arguments), rtol=1e-11)


@pytest.mark.slow
def test_derivatives_of_batches_that_share_an_argument():
    xs = jnp.linspace(0.05, 1.4, 15).reshape(5, 3)
    total = lambda f: lambda rate: jnp.sum(jax.vmap(weighted(f), in_axes=(0, None))(xs, rate))  # noqa: E731
    found = jax.grad(total(fast(integrated)))(jnp.asarray(0.3))
    assert_same(found, jax.grad(total(integrated))(jnp.asarray(0.3)), rtol=1e-11)


def test_values_that_the_function_closes_over_are_differentiated():
    def outer(f):
        def with_rate(rate):
            return jnp.sum(f(lambda x: jnp.sin(x) * rate)(X))

        return with_rate

    found = jax.jit(jax.grad(outer(fast)))(0.7)
    assert found == pytest.approx(float(jnp.sum(jnp.sin(X))), rel=1e-14)


def test_what_has_no_machine_code_runs_by_xla_and_says_so_once():
    def eigenvalues(x):
        return jnp.linalg.eigvalsh(jnp.outer(x, x) + jnp.eye(3))

    made = kernel(eigenvalues, name="eigenvalues")
    with pytest.warns(UserWarning, match="'eigenvalues' is compiled by XLA: there is no machine code for") as seen:
        found = jax.jit(made)(X)
        jax.vmap(made)(jnp.stack([X, X]))
    assert len(seen) == 1
    assert_same(found, eigenvalues(X))


def test_other_types_of_numbers_run_by_xla():
    with pytest.warns(UserWarning, match="numbers of type float32"):
        found = kernel(lambda x: x * 2)(jnp.ones(2, jnp.float32))
    assert found.dtype == jnp.float32


def test_primitives_of_others_by_what_they_are_made_of():
    from jax.core import ShapedArray
    from jax.extend.core import Primitive

    thrice = Primitive("thrice_for_a_test")
    thrice.def_abstract_eval(lambda x, *, plus: ShapedArray(x.shape, x.dtype))
    expand_primitive("thrice_for_a_test", lambda x, *, plus: 3.0 * x + plus)
    assert_same(jax.jit(fast(lambda x: thrice.bind(x, plus=1.0)))(X), 3.0 * X + 1.0)


def test_rows_without_entries_at_a_place_that_is_computed():
    """A mechanism without loops has tables without columns."""

    def function(place, table, empty):
        changed = jax.lax.dynamic_update_index_in_dim(empty, empty[0], place, 0)
        return table[place], jax.lax.dynamic_index_in_dim(empty, place, keepdims=False), changed

    arguments = jnp.asarray(1), jnp.arange(6.0).reshape(2, 3), jnp.zeros((2, 0))
    assert_same(jax.jit(fast(function))(*arguments), function(*arguments))


def test_a_new_number_traces_nothing():
    traced = []

    def function(x):
        traced.append(1)
        return jnp.sin(x)

    made = jax.jit(kernel(function, selection="fast"))
    for number in (1.0, 2.0, 3.0):
        assert made(number) == pytest.approx(np.sin(number), rel=1e-15)
    assert len(traced) == 1


def test_thorough_and_fast_compilation_give_the_same_bits():
    arguments = X, jnp.asarray(0.3)
    thorough, quick = kernel(integrated)(*arguments), kernel(integrated, selection="fast")(*arguments)
    for a, b in zip(jax.tree.leaves(thorough), jax.tree.leaves(quick)):
        np.testing.assert_array_equal(a, b)


def sums_of_products(x, y):
    """Sums with a product; a product less another; and one that is read once more."""

    def turn(i, found):
        factor = x + 0.0 * found[0]  # computed in every turn
        product = factor * y
        again = jnp.sin(factor) * y
        return product - 1.0, 1.0 - product, product + factor * x, product - y * factor, again + 1.0, again

    return jax.lax.fori_loop(0, 100, turn, (jnp.zeros(jnp.shape(x)),) * 6)


@pytest.mark.parametrize("selection", ["fast", "thorough"])
def test_a_product_and_a_term_are_rounded_once(selection):
    """x y = 1 - 2^-60, which is 1 where it is rounded before one is taken away."""
    x, y = 1.0 + 2.0**-30, 1.0 - 2.0**-30
    made = jax.jit(kernel(sums_of_products, selection=selection))
    less, more, squares, nothing, *_ = map(float, made(x, y))
    once = machine_code.fuses()
    assert (less, more) == ((-(2.0**-60), 2.0**-60) if once else (0.0, 0.0))
    assert squares == float(Fraction(x) ** 2 + 1) and nothing == 0.0
    xs, ys = jnp.linspace(0.3, 1.7, 11), jnp.linspace(1.3, -0.7, 11)
    batch = jax.jit(jax.vmap(kernel(sums_of_products, selection=selection)))(xs, ys)
    for i in range(11):
        for one, all_ in zip(made(xs[i], ys[i]), batch, strict=True):
            assert one == all_[i]
    assert_same(batch, sums_of_products(xs, ys), rtol=1e-14)


@pytest.mark.parametrize("fuses", [False, True])
def test_products_that_are_read_are_computed(fuses):
    """Six products, of which three are in sums alone, one is read besides, and two are the two of a difference."""
    build, turns = Builder(immediate=True, fuses=fuses), 100
    arithmetic, x, y, z = Arithmetic(build), *(Value(f"%{name}", "d") for name in "xyz")

    def turn():
        arithmetic.add(arithmetic.multiply(x, x), z)
        arithmetic.subtract(z, arithmetic.multiply(x, z))
        arithmetic.subtract(arithmetic.multiply(y, y), np.float64(1.0))
        read = arithmetic.multiply(x, y)
        arithmetic.add(z, read)
        arithmetic.divide(read, z)
        arithmetic.subtract(arithmetic.multiply(y, z), arithmetic.multiply(z, z))

    build.inside(turn, turns)
    build.finish()
    text = "\n".join(build.lines)
    assert text.count("fmul") == (3 if fuses else 6) and text.count("@llvm.fma") == (4 if fuses else 0)
    assert build.operations == (3 + 4 + 1 + 1 + 1 if fuses else 6 + 4 + 1 + 1) == build.work / turns


BITS = """
import hashlib, sys
import jax
jax.config.update("jax_enable_x64", True)
import jax.numpy as jnp
from rfem_jax.kernels import kernel, machine_code
from tests.kernels.test_kernel import X, integrated
machine_code.leave_out_features(*sys.argv[1:])
found = jax.vmap(kernel(integrated, selection="fast"))(jnp.stack([X] * 5), jnp.linspace(0.0, 1.0, 5))
print(machine_code.vector_width(), hashlib.sha256(b"".join(x.tobytes() for x in jax.tree.leaves(found))).hexdigest())
"""


@pytest.mark.slow
def test_narrower_registers_give_the_same_bits():
    width, bits = in_a_new_process(BITS).split()
    narrow, same = in_a_new_process(BITS, "avx").split()
    assert int(narrow) == 2 <= int(width) and bits == same


def turns(x, rate):
    """A long loop over a kernel, and a kernel of the whole loop that reverse mode does not take."""

    def turn(state, t):
        state = state + 0.01 * jnp.sin(rate * state + t)
        return state, jnp.sum(state**2)

    return turn, (x, jnp.linspace(0.0, 1.0, 80))


def by_jax(x, rate):
    turn, (start, times) = turns(x, rate)
    return jax.lax.scan(turn, start, times)


def by_turns(x, rate):
    turn, (start, times) = turns(x, rate)
    return jax.lax.scan(kernel(turn, selection="fast"), start, times)


LONG = kernel(by_jax, selection="fast", reverse=by_turns)


@pytest.mark.long
@pytest.mark.parametrize(
    "derivative",
    [
        lambda f: jax.jacfwd(f, argnums=(0, 1)),
        lambda f: jax.jacrev(f, argnums=(0, 1)),
        lambda f: jax.jacfwd(jax.jacfwd(f)),
        lambda f: jax.jacfwd(jax.jacrev(f), argnums=(0, 1)),
        lambda f: jax.jacrev(jax.jacfwd(f), argnums=(0, 1)),
        lambda f: jax.vmap(jax.jacfwd(f), in_axes=(0, None)),
        lambda f: jax.vmap(jax.jacrev(f), in_axes=(0, None)),
        lambda f: jax.jacfwd(jax.vmap(f, in_axes=(0, None)), argnums=1),
    ],
    ids=["forward", "reverse", "twice forward", "forward of reverse", "reverse of forward", "batch", "batch of reverse",
         "of a batch"],
)  # fmt: skip
def test_derivatives_of_a_long_loop(derivative):
    x = jnp.stack([X, 2.0 * X])
    assert_same(jax.jit(derivative(LONG))(x, jnp.asarray(0.7)), derivative(by_jax)(x, jnp.asarray(0.7)), rtol=1e-11)


def test_reverse_mode_takes_the_other_function():
    other = kernel(by_jax, selection="fast", reverse=lambda x, rate: (2.0 * x, jnp.zeros(80)))
    np.testing.assert_array_equal(jax.jacrev(lambda x: other(x, jnp.asarray(0.7))[0])(X), 2.0 * np.eye(3))
    np.testing.assert_allclose(
        jax.jacfwd(lambda x: other(x, jnp.asarray(0.7))[0])(X), jax.jacfwd(lambda x: by_jax(x, 0.7)[0])(X), rtol=1e-12
    )


@pytest.mark.slow
def test_directions_are_one_kernel():
    """What does not depend on the directions is computed once for all of them."""

    def costly(x):
        for _ in range(40):
            x = jnp.sin(x) + 0.1 * x
        return x

    lowered = {n: jax.jit(jax.vmap(jax.linearize(fast(costly), X)[1])).lower(jnp.eye(3)[:n]) for n in (1, 3)}
    assert [text.as_text().count("custom_call @kernel_") for text in lowered.values()] == [1, 1]
    np.testing.assert_allclose(jax.jacfwd(fast(costly))(X), jax.jacfwd(costly)(X), rtol=1e-12)


def test_what_runs_often_is_compiled_thoroughly(monkeypatch):
    chosen = []
    announce = registry.announce

    def noted(name, text, thorough):
        chosen.append(thorough)
        announce(name, text, thorough)

    monkeypatch.setattr(registry, "announce", noted)
    jax.jit(kernel(lambda x: x + 1.25))(X)
    with expecting(10_000):
        jax.jit(kernel(lambda x: x + 2.25))(X)
    jax.jit(kernel(lambda x: jax.lax.fori_loop(0, 10_000, lambda i, y: jnp.sin(y + 3.25), x)))(X)
    assert chosen == [False, True, True]


def test_a_function_that_is_too_large_is_compiled_by_xla_in_silence(monkeypatch):
    monkeypatch.setattr("rfem_jax.kernels.builder.MOST_OPERATIONS", 100)

    def large(x):
        for i in range(60):
            x = x * 1.01 + 0.1 * i
        return x

    np.testing.assert_allclose(jax.jit(fast(large))(X), large(X), rtol=1e-14)


def test_jax_finds_what_is_no_number():
    found = kernel(lambda x: 2.0 * jnp.sin(x))
    infinite = jnp.array([jnp.inf, 1.0])
    assert jnp.isnan(found(infinite))[0]
    jax.config.update("jax_debug_nans", True)
    try:
        for function in (found, jax.jit(found), jax.vmap(found)):
            with pytest.raises(FloatingPointError, match="nan"):
                function(infinite)
    finally:
        jax.config.update("jax_debug_nans", False)


def test_random_keys_are_left_to_xla():
    with pytest.warns(UserWarning, match="there is no machine code for numbers of type key"):
        found = kernel(lambda key: jax.random.normal(key, (3,)))(jax.random.key(0))
    np.testing.assert_array_equal(found, jax.random.normal(KEY, (3,)))


def test_programs_whose_values_do_not_fit_on_the_stack_take_fewer_samples_at_a_time(monkeypatch):
    xs, rates = jax.random.normal(KEY, (19, 3)), jnp.linspace(0.0, 1.0, 19)
    wanted = jax.vmap(kernel(integrated, selection="fast"))(xs, rates)
    operations = programs.emit(jax.make_jaxpr(integrated)(xs[0], rates[0])).operations
    for room, allowed in ((24 * operations, {1, 2}), (400 * operations, {2, 4, 8}), (4 * operations, set())):
        monkeypatch.setattr(machine_code, "stack_bytes", lambda room=room: room)
        with registry.noting() as names:
            found = jax.vmap(kernel(integrated, selection="fast"))(xs, rates)
        lanes = {int(name.split("_")[2]) for name in names}
        assert lanes <= allowed and bool(lanes) == bool(allowed)
        for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(wanted), strict=True):
            np.testing.assert_allclose(a, b, rtol=0 if names else 1e-12)


def test_a_single_lane_has_no_vectors():
    """LLVM's fast selection does not know vectors of one entry; loops, and reads and writes at computed places, too."""

    def function(x, place):
        x = jax.lax.while_loop(lambda x: jnp.sum(x) < 9.0, lambda x: 2.0 * jnp.abs(jnp.sin(x)) + x, x)
        x = jax.lax.dynamic_update_slice(x, jax.lax.dynamic_slice(x, (place,), (1,)), (2 - place,))
        return jnp.where(x > 1.0, x, jnp.linspace(0.0, 1.0, 3)[place])

    place = jnp.int32(1)
    program = programs.emit(jax.make_jaxpr(function)(X, place))
    one, four = (program.module(lanes, False)[1] for lanes in (1, 4))
    assert "<4 x double>" in four and "gather" in four and "scatter" in four and "reduce.or" in four
    assert not any(mark in one for mark in ("<", "#", "splat", "gather", "scatter", "reduce"))
    assert_same(fast(function)(X, place), function(X, place))


def test_closed_over_number_of_python_that_is_differentiated():
    slope = jax.jacfwd(lambda z: kernel(lambda x: jnp.sin(x * z))(X))(1.3)
    np.testing.assert_allclose(slope, X * np.cos(1.3 * X), rtol=1e-14)
