"""Functions of the user's own as pytrees: what they close over is a leaf where JAX differentiates by it."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rfem_jax import ForceFunction, InputError, MomentFunction, PointSpringFunction, PrescribedFunction

MADE = {
    "moment": lambda function: MomentFunction("A", function),
    "force": lambda function: ForceFunction("A", function),
    "motion": lambda function: PrescribedFunction("A", lambda t: function(t, 0)),
    "motion in phases": lambda function: PrescribedFunction("A", function, breakpoints=(1.0,)),
}
T, PHASE = jnp.asarray(0.5), jnp.asarray(0, jnp.int32)


def value(drive):
    return drive.motion_at(T, PHASE)[0] if isinstance(drive, PrescribedFunction) else drive.force_at(T, PHASE)


@pytest.mark.parametrize("kind", MADE)
def test_what_is_differentiated_is_a_leaf(kind):
    def made(x):
        return MADE[kind](lambda t, phase: x**2 * t)

    def found(x):
        drive = made(x)
        assert any(leaf is x for leaf in jax.tree.leaves(drive))
        return value(drive)

    assert jax.grad(found)(3.0) == pytest.approx(6.0 * 0.5)
    np.testing.assert_allclose(jax.vmap(lambda x: value(made(x)))(jnp.asarray([2.0, 3.0])), [2.0, 4.5])
    # Programs are the same for the same function, and would not be with what was made of it.
    assert jax.tree.leaves(made(3.0)) == [] and jax.tree.leaves(made(jnp.asarray(3.0))) == []


def test_defaults_and_partial_functions_count_as_closed_over():
    def found(x):
        default = MomentFunction("A", lambda t, phase, x=x: x * t)
        partial = MomentFunction("A", functools.partial(lambda x, t, phase: x * t, x))
        return value(default) * value(partial)

    assert jax.grad(found)(3.0) == pytest.approx(6.0 * 0.25)


class Slope(eqx.Module):
    slope: jax.Array

    def __call__(self, t, phase):
        return self.slope * t


def test_a_module_stays_what_it_is():
    def found(x):
        drive = MomentFunction("A", Slope(x))
        assert isinstance(drive.function, Slope)
        return value(drive)

    assert jax.grad(found)(3.0) == pytest.approx(0.5)


def test_a_spring_between_points_by_length_and_rate():
    def tension(x):
        spring = PointSpringFunction("spring", ("base", "bar"), (0.1, 0.2), lambda length, rate: x * length**2 - rate)
        assert any(leaf is x for leaf in jax.tree.leaves(spring.function))
        return spring.function(jnp.asarray(2.0), jnp.asarray(1.0))

    assert jax.value_and_grad(tension)(3.0) == pytest.approx((11.0, 4.0))


class Network(eqx.Module):
    """A network and what else a module of a user's may hold, with branches by plain values."""

    net: eqx.nn.MLP
    table: np.ndarray
    gain: float = 2.0
    words: tuple[str, ...] = ("up", "down")
    rising: bool = True

    def __call__(self, t, phase):
        if not self.rising or self.words[0] != "up" or self.gain < 0.0:
            raise ValueError("plain values stay what they are")
        return self.gain * self.net(t) + jnp.sum(self.table * t)


def network(activation=jnp.tanh):
    return Network(eqx.nn.MLP("scalar", "scalar", 3, 1, activation=activation, key=jax.random.key(0)), np.ones(2))


@pytest.mark.parametrize("kind", ["moment", "force"])
def test_a_module_of_networks_and_plain_values_has_arrays_as_its_leaves(kind):
    drive = MADE[kind](network())
    assert len(jax.tree.leaves(drive)) == 5 and all(eqx.is_array(leaf) for leaf in jax.tree.leaves(drive))
    assert value(drive) == pytest.approx(float(network()(T, PHASE)), rel=1e-14)
    # The same structure each time, or programs would be compiled anew; another one of another activation.
    again = [MADE[kind](network(function)) for function in (jnp.tanh, jnp.sin)]
    assert [jax.tree.structure(one) == jax.tree.structure(drive) for one in again] == [True, False]


def test_weights_of_a_network_have_derivatives():
    weights, rest = eqx.partition(network(), eqx.is_inexact_array)

    def found(weights):
        return value(MomentFunction("A", eqx.combine(weights, rest)))

    slopes, along = jax.grad(found)(weights), jax.tree.map(jnp.ones_like, weights)
    change = jax.jvp(found, (weights,), (along,))[1]
    assert sum(float(jnp.sum(x)) for x in jax.tree.leaves(slopes)) == pytest.approx(float(change), rel=1e-12)
    ends = [found(jax.tree.map(lambda x: x + step, weights)) for step in (1e-5, -1e-5)]
    assert float(change) == pytest.approx(float(ends[0] - ends[1]) / 2e-5, rel=1e-7)


def test_what_cannot_be_compared_is_refused():
    class Holder(eqx.Module):
        thing: object

        def __call__(self, t, phase):
            return t

    class Unhashable:
        __hash__ = None

    with pytest.raises(InputError, match="must hold arrays, functions and plain values, but holds Unhashable"):
        MomentFunction("A", Holder(Unhashable()))
