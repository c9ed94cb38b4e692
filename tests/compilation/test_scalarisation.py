"""Scalarised jaxprs give the results of the operations on arrays, in all transformations: every kind of primitive, and
the right-hand sides of mechanisms."""

import functools
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from rfem_jax import (
    Joint,
    Mechanism,
    Method,
    MomentRamp,
    PrescribedRate,
    assembly_errors,
    discretise,
    simulate,
)  # fmt: skip
from rfem_jax.compilation import options, scalarisation
from rfem_jax.compilation.scalarisation import scalarised
from rfem_jax.mechanics.inputs import Stabilisation
from rfem_jax.mechanics.model_with_errors import apply_errors
from rfem_jax.simulation import equations, integration, stepping
from rfem_jax.simulation.driving import active_drives
from rfem_jax.simulation.equations import Conditions
from rfem_jax.simulation.solvers.generalised_alpha import GeneralisedAlpha
from rfem_jax.simulation.solvers.implicit_step import StepConstants, StepStart, form_matrix, solved_step
from tests.mechanisms import ALL, four_bar, link, open_chain, random_state, some_errors
from tests.numpy_evaluation import by_numpy
from tests.processes import in_a_new_process

COMPILED_AS_SHIPPED = True

X = np.linspace(0.3, 1.9, 12).reshape(3, 4)
Y = np.linspace(-1.0, 1.2, 12).reshape(3, 4)
PLACES = np.array([2, 0, 2])


def arithmetic(x, y):
    nothing, one = jnp.zeros_like(x), jnp.ones_like(x)
    known = nothing - y, nothing / x, y - one, -x * nothing + one * y, nothing + y, y / one
    return known, (x + y) * x - y / x, x**3 + jnp.square(y) - 2.0, -y * (0.0 - one)


def functions(x, y):
    return jnp.sin(x) + jnp.arctan2(y, x), jnp.sqrt(x), jnp.exp(y), jnp.where(y > 0.1, x, y * x)


def sums(x, y):
    empty = jnp.sum(x[:0], axis=0)
    return jnp.sum(x * y), jnp.sum(x, axis=0), jnp.max(jnp.abs(y), axis=1), jnp.min(x), empty


def products(x, y):
    return x @ y.T, jnp.einsum("ij,kj->jik", x, y), jnp.tensordot(x, y, axes=1 + 1), jnp.cross(x[:, 0], y[:, 1])


def shapes(x, y):
    joined = jnp.concatenate([x, y[::-1]], axis=1), jnp.stack([x, y], axis=1)
    return joined, x.T.reshape(2, 6), jnp.swapaxes(x[None], 0, 2), jnp.split(y, 2, axis=1)


def places(x, y):
    x = jnp.asarray(x)
    padded = jnp.pad(x, ((1, 0), (0, 2)))
    changed = x.at[:, 1].set(y[:, 0]), x.at[1].add(2.0)
    return x[PLACES], changed, padded, lax.dynamic_slice(y, (1, 0), (2, 2)), x[-1, ::2]


def loops(x, y):
    def halve(carry):
        count, values = carry
        return count + 1, values * 0.5 + jnp.cos(values)

    _, low = lax.while_loop(lambda carry: jnp.sum(carry[1][0]) > 4.0, halve, (0, x * y[0, 0]))
    summed, rows = lax.scan(lambda total, row: (total + row @ row, total * row), 0.0, x)
    back, _ = lax.scan(lambda total, row: (0.5 * total + row, None), jnp.zeros(4), y, reverse=True)
    again, _ = lax.scan(lambda values, _: (jnp.sin(values), None), x, None, length=3)
    return low, summed, rows, back, again


def branches(x, y):
    def small(values):
        return values * 2.0, 1.0

    def large(values):
        return values + y, jnp.sum(values)

    return lax.cond(jnp.sum(x) > 1.0, small, large, x), lax.switch(1, [small, large], x)


def by_library(x, y):
    square = x @ x.T + jnp.eye(3)
    return jnp.linalg.solve(square, y), jnp.cumsum(y, axis=1)


@pytest.mark.parametrize(
    "function",
    [arithmetic, functions, sums, products, shapes, places, loops, branches, by_library],
    ids=lambda function: function.__name__,
)
def test_results_are_those_of_arrays(function):
    def close(a, b):
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-13, atol=1e-14), a, b)

    def forward(function):
        return lambda x, y: jax.jvp(function, (x, y), (jnp.cos(x), y))

    scalar = scalarised(function)
    assert jax.tree.structure(jax.eval_shape(scalar, X, Y)) == jax.tree.structure(jax.eval_shape(function, X, Y))
    close(jax.jit(scalar)(X, Y), by_numpy(function)(X, Y))
    close(jax.jit(forward(scalar))(X, Y), by_numpy(forward(function))(X, Y))
    many = jnp.stack([X, X + 0.1]), jnp.stack([Y, -Y])
    close(jax.jit(jax.vmap(scalar))(*many), by_numpy(jax.vmap(function))(*many))
    if function not in (loops, by_library):

        def total(function):
            return lambda x: sum(jnp.sum(jnp.asarray(part) ** 2) for part in jax.tree.leaves(function(x, Y)))

        close(jax.jit(jax.grad(total(scalar)))(X), by_numpy(jax.grad(total(function)))(X))


def primitives(function, *arguments):
    return [equation.primitive.name for equation in jax.make_jaxpr(function)(*arguments).jaxpr.eqns]


GATHERS = {
    "rows": lambda x: x[PLACES],
    "columns": lambda x: x[:, PLACES],
    "entries": lambda x: x[PLACES, 1 + PLACES[::-1]],
    "a table of places": lambda x: x[np.array([[0, 2], [1, 1]])],
    "a place of an axis": lambda x: x.reshape(2, 3, 2)[:, PLACES, 1],
    "a place in every row": lambda x: jax.vmap(lambda row, i: row[i])(x, PLACES),
    "along an axis": lambda x: jnp.take_along_axis(x, np.array([[1, 0, 3, 3]] * 3), axis=1),
    "windows": lambda x: jax.vmap(lambda i: lax.dynamic_slice(x, (i, 1), (1, 2)))(PLACES),
    "windows of the last axis": lambda x: jax.vmap(lambda i: lax.dynamic_slice(x, (0, i), (3, 2)), out_axes=1)(PLACES),
}


@pytest.mark.parametrize("name", GATHERS)
def test_gathers_are_carried_out_in_numpy(name, monkeypatch):
    """No program is compiled for them while another one is traced."""
    found = []
    gathered = scalarisation._gathered

    def noted(*arguments, **settings):
        found.append(gathered(*arguments, **settings) is not None)
        return gathered(*arguments, **settings)

    monkeypatch.setattr(scalarisation, "_gathered", noted)
    np.testing.assert_array_equal(scalarised(GATHERS[name])(X), GATHERS[name](X))
    assert found and all(found)


def test_a_gather_beyond_the_operand_is_left_to_jax():
    """Windows are moved inside, entries are filled in."""
    for mode in ("clip", "fill"):
        beyond = functools.partial(jnp.take, indices=np.array([0, 7]), axis=0, mode=mode)
        np.testing.assert_array_equal(scalarised(beyond)(X), beyond(X))


def test_operations_with_known_zeros_disappear():
    """A product with a diagonal matrix: three multiplications, no addition."""
    matrix, vector = np.diag([1.0, 2.0, 3.0]), np.array([1.0, 2.0, 4.0])
    zeros = ~np.eye(3, dtype=bool), False

    def product(matrix, vector):
        return jnp.sum(matrix * vector[None], axis=1)

    names = primitives(scalarised(product, zeros), matrix, vector)
    assert names.count("mul") == 3 and "add" not in names
    names = primitives(scalarised(product), matrix, vector)
    assert names.count("mul") == 9 and names.count("add") == 6
    np.testing.assert_array_equal(scalarised(product, zeros)(matrix, vector), matrix @ vector)


def test_a_function_of_too_many_operations_is_not_scalarised():
    assert primitives(scalarised(jnp.sin, most=11), X) == ["sin"]
    assert primitives(scalarised(jnp.sin, most=11), X[:2]).count("sin") == 8


def test_stop_gradient_is_kept():
    def function(x):
        return jnp.sum(x * lax.stop_gradient(x))

    np.testing.assert_array_equal(jax.grad(scalarised(function))(X), X)


@pytest.fixture(scope="module")
def four_bar_in_motion(quick_compilation):
    return steps_of_a_four_bar()


def steps_of_a_four_bar():
    """Implicit method, its constants, and conditions, trajectory and memory after two steps."""
    model, drive = discretise(four_bar()), MomentRamp("A", -1.0, 0.01)
    method = Method("generalised_alpha", step=2.5e-3, tolerance=1e-6)
    return GeneralisedAlpha(method), *eqx.filter_jit(_steps)(model, drive, method)


def _steps(model, drive, method):
    prepared = integration.prepare(model, assembly_errors(model, {"D.delta_x": 2e-3}), drive, None)
    carry = integration.start_carry(model, prepared, drive, method)
    phase, gains = jnp.asarray(0, jnp.int32), stepping.stabilisation_of(model, method)
    conditions = Conditions(prepared.actual, active_drives(model, drive), phase, gains)
    implicit = GeneralisedAlpha(method)
    trajectory, memory = carry.trajectory, carry.memory
    for h, t1 in ((0.0, 0.0), (2.5e-3, 2.5e-3), (2.5e-3, 5e-3)):
        operators = jax.tree.map(lambda x: x[0], implicit.operators(prepared.actual, jnp.asarray([h])))
        constants = StepConstants(jnp.asarray(t1), jnp.asarray(h), jnp.asarray(10.0))
        start = StepStart(conditions, trajectory, memory)
        matrix = form_matrix(implicit, operators, constants, start)
        trajectory, memory = solved_step(implicit, matrix, constants, start)
    return constants, conditions, trajectory, memory


def assert_same(found, expected):
    """To rounding, relative to the largest of each array."""
    assert jax.tree.structure(found) == jax.tree.structure(expected)
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected)):
        np.testing.assert_allclose(a, b, rtol=1e-8, atol=1e-8 * max(1e-9, np.abs(np.asarray(b)).max(initial=0.0)))


def test_a_right_hand_side_and_its_derivative_are_the_same(four_bar_in_motion):
    _, _, conditions, trajectory, _ = four_bar_in_motion
    given = jnp.asarray(5e-3), trajectory, conditions
    found = jax.jit(stepping._scalarised_rate)(*given)
    assert_same(found, by_numpy(equations.right_hand_side)(*given))

    def along(rate):
        return jax.jvp(lambda trajectory: rate(given[0], trajectory, conditions), (trajectory,), (found,))[1]

    assert_same(
        jax.jit(lambda: along(stepping._scalarised_rate))(), by_numpy(lambda: along(equations.right_hand_side))()
    )

    def back(rate):
        _, pull = jax.vjp(lambda trajectory: jax.checkpoint(rate)(given[0], trajectory, conditions), trajectory)
        return pull(found)

    assert_same(jax.jit(lambda: back(stepping._scalarised_rate))(), by_numpy(lambda: back(equations.right_hand_side))())


def test_explicit_methods_are_scalarised(four_bar_in_motion, monkeypatch):
    _, _, conditions, trajectory, _ = four_bar_in_motion

    def products():
        state = trajectory, jnp.zeros((4, 4))
        program = jax.make_jaxpr(lambda t: stepping.vector_field(t, state, conditions))(0.0)
        return str(program).count(" mul ")

    monkeypatch.setattr(stepping, "explicit_methods_scalarised", options.explicit_methods_scalarised)
    many = products()
    monkeypatch.setattr(stepping, "explicit_methods_scalarised", lambda: False)
    assert many > 3 * products()


@pytest.mark.parametrize(
    ("make", "elements"),
    [(make, "linear") for make in ALL] + [(make, "geometrically_exact") for make in (four_bar, open_chain)],
)
def test_right_hand_sides_of_all_mechanisms_are_the_same(make, elements, quick_compilation, monkeypatch):
    """Evaluated with concrete numbers, which compiles nothing; the jaxpr has hardly an operation on arrays."""
    monkeypatch.setattr(stepping, "MOST_OPERATIONS", 10**6)
    model, rng = discretise(make(), elements=elements), np.random.default_rng(5)
    state = random_state(model, rng, angle=0.2, rate=2.0)
    actual = apply_errors(model, some_errors(model, rng))
    gains = Stabilisation(jnp.asarray(20.0), jnp.asarray(100.0), jnp.asarray(0.1))
    drive = None if model.driven_joint is None else PrescribedRate(model.driven_joint, 3.0)
    conditions = Conditions(actual, active_drives(model, drive), jnp.asarray(0, jnp.int32), gains)
    given = jnp.asarray(0.1), equations.start_trajectory(state, len(model.topology.joints)), conditions
    assert_same(stepping._scalarised_rate(*given), by_numpy(equations.right_hand_side)(*given))
    names = primitives(stepping._scalarised_rate.fun, *given)
    assert names.count("mul") > 300 and not {"dot_general", "gather", "reduce_sum"} & set(names)


WITH_LOOPS = """
import sys
import jax
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_disable_most_optimizations", True)
import rfem_jax
from tests.compilation import test_scalarisation
getattr(test_scalarisation, sys.argv[1])(*sys.argv[2:])
"""  # without most optimisations: with them so many scalar operations take gigabytes to compile


BATCHES = {
    "rigid pendulum, rk4": (
        Mechanism([link("bar", 0.3)], [Joint("A", "base", "bar", angle=0.4)], driven_joint="A"),
        MomentRamp("A", 1.5, 1e-3),
        Method("rk4", step=1e-5),
    ),
    "four-bar, generalised_alpha": (
        replace(four_bar(2), links=[link("crank", 0.12), link("coupler", 0.3, 2), link("rocker", 0.3)]),
        MomentRamp("A", -1.0, 0.01),
        Method("generalised_alpha", step=1e-3),
    ),
}  # fmt: skip


@pytest.mark.slow
def test_derivatives_of_a_batch_are_those_of_its_samples():
    in_a_new_process(WITH_LOOPS, "check_derivatives_of_a_batch", "rigid pendulum, rk4")


@pytest.mark.slow
def test_derivatives_of_a_batch_of_an_implicit_method_are_those_of_its_samples(quick_compilation):
    """Whose steps are not scalarised."""
    check_derivatives_of_a_batch("four-bar, generalised_alpha")


def check_derivatives_of_a_batch(case):
    """Forward and reverse mode: under vmap a function and its rule need the same batch axes (jax issue 16374)."""
    mechanism, drive, method = BATCHES[case]
    model = discretise(mechanism)
    name = f"{mechanism.links[-1].name}.length"

    def force(error):
        run = simulate(
            model, assembly_errors(model, {name: error}), drive=drive, duration=2e-3, method=method,
            save_every=1e-3,
        )  # fmt: skip
        return run.metrics.mean_square_force["A"]

    errors, batch = jnp.array([2e-3, 5e-3]), jax.vmap(force)
    forward = jax.jit(lambda x: jax.jvp(batch, (x,), (jnp.ones(2),))[1])(errors)
    reverse = jax.jit(jax.grad(lambda x: jnp.sum(batch(x))))(errors)
    assert np.all(np.abs(forward) > 1e-3)
    np.testing.assert_allclose(reverse, forward, rtol=1e-9, atol=1e-9 * np.abs(forward).max())
