"""Functions of the user's own as pytrees: what they close over is a leaf where JAX differentiates by it."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rfem_jax import ForceFunction, MomentFunction, PointSpringFunction, PrescribedFunction

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
