"""Functions in parts: values, derivatives and batches are those of the whole; a part is differentiated by, and batched
over, what depends on such arguments; a second process traces nothing."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rfem_jax.compilation import executable
from rfem_jax.compilation.call import Call
from rfem_jax.compilation.parts import ProgramInParts
from rfem_jax.compilation.program import Program
from tests.compilation.functions import covered, ended, forget, journey, oscillator, turned, walked

COMPILED_AS_SHIPPED = True
PARTS = 3
X = jnp.linspace(0.2, 0.9, 3)
BATCH = jnp.stack([X, X + 0.1])


def whole(oscillator, x, rate):
    """The same by JAX alone."""
    return journey.function(oscillator, x, rate)


def numbers(function):
    """Of what a journey returns, the arrays that are not whole numbers."""

    def of(x, rate):
        found = function(oscillator(), x, rate)
        return found.path, found.end["end"], found.end["twice"]

    return of


TRANSFORMED = {
    "value": lambda f: f(X, 0.7),
    "forward": lambda f: jax.jacfwd(f)(X, 0.7),
    "forward by both": lambda f: jax.jacfwd(f, argnums=(0, 1))(X, jnp.asarray(0.7)),
    "batch": lambda f: jax.vmap(f, in_axes=(0, None))(BATCH, 0.7),
    "another axis": lambda f: jax.vmap(f, in_axes=(1, None))(BATCH.T, 0.7),
    "batch of derivatives": lambda f: jax.vmap(jax.jacfwd(f), in_axes=(0, None))(BATCH, 0.7),
    "derivatives of a batch": lambda f: jax.jacfwd(jax.vmap(f, in_axes=(0, None)))(BATCH, 0.7),
    "second": lambda f: jax.jacfwd(jax.jacfwd(f), argnums=1)(X, jnp.asarray(0.7)),
    "reverse": lambda f: jax.jacrev(f)(X, 0.7),
    "forward over reverse": lambda f: jax.jacfwd(jax.jacrev(f))(X, 0.7),
    "of a gradient": lambda f: jax.grad(lambda x: jnp.sum(f(x, 0.7)[1] ** 2))(X),
    "within a program": lambda f: jax.jit(jax.vmap(f, in_axes=(0, None)))(BATCH, 0.7),
}


@pytest.mark.parametrize("transform", TRANSFORMED.values(), ids=TRANSFORMED)
def test_transformations_are_those_of_the_whole(kept, transform):
    expected = transform(numbers(whole))
    for _ in range(2):
        found = transform(numbers(journey))
        assert jax.tree.structure(found) == jax.tree.structure(expected)
        for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
            assert one.shape == other.shape
            np.testing.assert_allclose(one, other, rtol=1e-12, atol=1e-13)
        forget()


def test_the_tree_of_the_results_has_its_static_values(kept):
    found, expected = journey(oscillator(), X, 0.7), whole(oscillator(), X, 0.7)
    assert jax.tree.structure(found) == jax.tree.structure(expected)
    assert found.steps == expected.steps == 3
    assert found.end["count"].dtype == expected.end["count"].dtype
    np.testing.assert_array_equal(found.end["count"], expected.end["count"])


def test_every_part_is_kept_and_loaded_as_one_program(kept):
    first = journey(oscillator(), X, 0.7)
    assert (kept.traced, kept.loaded, kept.written) == (PARTS, 0, PARTS)
    forget()
    again = journey(oscillator(), X, 0.7)
    assert (kept.traced, kept.loaded, kept.written) == (PARTS, PARTS, PARTS)
    for one, other in zip(jax.tree.leaves(first), jax.tree.leaves(again), strict=True):
        np.testing.assert_array_equal(one, other)


def test_ahead_compiles_what_the_call_needs(kept):
    form = journey.ahead(oscillator(), X, jnp.asarray(0.7))
    found = journey(oscillator(), X, jnp.asarray(0.7))
    assert kept.traced == PARTS
    assert [np.shape(x) for x in jax.tree.leaves(form)] == [np.shape(x) for x in jax.tree.leaves(found)]


def steps_of_parts(monkeypatch, transform):
    """{part: transformations of it} that were traced."""
    seen = {}
    pending = Call.pending

    def noted(call, arrays):
        chain = call.chain()
        seen[chain[-1].function.__name__] = [one.step for one in chain[-2::-1]]
        return pending(call, arrays)

    monkeypatch.setattr(Call, "pending", noted)
    transform(numbers(journey))
    return seen


def test_a_part_is_differentiated_by_what_depends_on_the_arguments(kept, monkeypatch):
    """`turned` does not depend on x; of what `walked` takes only x changes, and the count does not."""
    found = steps_of_parts(monkeypatch, lambda f: jax.jvp(lambda x: f(x, 0.7), (X,), (X,)))
    assert found["turned"] == []
    assert [(kind, sum(active)) for kind, active in found["walked"]] == [("jvp", 1)]
    assert [(kind, sum(active)) for kind, active in found["ended"]] == [("jvp", 2)]


def test_a_part_has_a_batch_axis_in_what_depends_on_the_arguments(kept, monkeypatch):
    found = steps_of_parts(monkeypatch, lambda f: jax.vmap(f, in_axes=(None, 0))(X, jnp.array([0.7, 0.8])))
    assert [[axis for axis in axes if axis is not None] for _, _, axes in found["turned"]] == [[0]]
    assert all(len(steps) == 1 for steps in found.values())
    forget()
    found = steps_of_parts(monkeypatch, lambda f: jax.vmap(f, in_axes=(1, None))(BATCH.T, 0.7))
    assert found["turned"] == []
    assert [[axis for axis in axes if axis is not None] for _, _, axes in found["walked"]] == [[1]]


def test_parts_compile_side_by_side(kept, monkeypatch):
    """All are traced before the first result is waited for."""
    order = []
    trace, run = executable.trace, executable.Executable.__call__
    monkeypatch.setattr("rfem_jax.compilation.call.trace", lambda *a: (order.append("trace"), trace(*a))[1])
    monkeypatch.setattr(executable.Executable, "__call__", lambda *a: (order.append("run"), run(*a))[1])
    journey(oscillator(), X, 0.7)
    assert order == ["trace"] * PARTS + ["run"] * PARTS


def test_what_depends_on_something_unknown_is_computed_and_not_kept(kept):
    scaled = Program(lambda walk, unknown: walk)

    @ProgramInParts
    def ours(run, oscillator, x, rate, unknown):
        return run(ended, 2.0, run(scaled, run(walked, oscillator, run(turned, oscillator, rate), x), unknown))

    found, expected = ours(oscillator(), X, 0.7, object()), whole(oscillator(), X, 0.7)
    np.testing.assert_allclose(found.path, expected.path, rtol=1e-13)
    assert (kept.traced, kept.written) == (PARTS + 1, PARTS)


def test_functions_have_their_common_parts_in_memory_once(kept):
    @ProgramInParts
    def shorter(run, oscillator, x, rate):
        return run(walked, oscillator, run(turned, oscillator, rate), x)

    journey(oscillator(), X, 0.7)
    shorter(oscillator(), X, 0.7)
    assert (kept.traced, kept.loaded) == (PARTS, 0)


@pytest.mark.parametrize("transform", [TRANSFORMED["value"], TRANSFORMED["batch of derivatives"]])
def test_on_a_device_of_the_users_choice_it_is_one_program(kept, transform, monkeypatch):
    expected = transform(numbers(whole))
    device = jax.devices()[0]
    monkeypatch.setattr(f"{__name__}.X", jax.device_put(X, device))
    monkeypatch.setattr(f"{__name__}.BATCH", jax.device_put(BATCH, device))
    found = transform(numbers(journey))
    assert kept.traced == 1
    for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-12, atol=1e-13)


def test_without_a_folder_it_is_in_parts_too():
    with covered(None) as statistics:
        found, expected = journey(oscillator(), X, 0.7), whole(oscillator(), X, 0.7)
        np.testing.assert_allclose(found.path, expected.path, rtol=1e-13)
        assert (statistics.traced, statistics.written) == (PARTS, 0)
