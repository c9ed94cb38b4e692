"""Networks of Equinox as drive, law and forces, beside a design: values under jit and vmap, and derivatives by their
weights in both modes against differences, by an explicit and the implicit method."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

from rfem_jax import (
    GeneralisedAlpha,
    Joint,
    JointForceFunction,
    Mechanism,
    MomentFunction,
    PointForce,
    PointSpringFunction,
    PrescribedFunction,
    RungeKutta4,
    Simulation,
    design,
    designed,
    discretise,
    simulate,
)
from tests.evaluation import evaluated
from tests.mechanisms import link

METHODS = {
    "rk4": RungeKutta4(step=1e-3),
    "generalised_alpha": GeneralisedAlpha(step=1e-3, corrections=9, tolerance=1e-14),
}


class OfTime(eqx.Module):
    net: eqx.nn.MLP

    def __call__(self, t, phase):
        return self.net(100.0 * t)


class VectorOfTime(OfTime):
    def __call__(self, t, phase):
        return jnp.stack([self.net(100.0 * t), 1.0 + 0.0 * t, self.net(50.0 * t)])


class Angle(eqx.Module):
    net: eqx.nn.MLP

    def __call__(self, t):
        return 1e2 * t**2 * self.net(100.0 * t)


class Law(eqx.Module):
    net: eqx.nn.MLP

    def __call__(self, position, rate):
        return self.net(3.0 * position + 0.01 * rate) - 0.01 * rate


def network(activation):
    return eqx.nn.MLP("scalar", "scalar", 3, 1, activation=activation, key=jax.random.key(1))


def described(net):
    """Two hinged bars under a law in the second hinge and forces at points."""
    forces = [
        JointForceFunction("law", "B", Law(net)),
        PointForce("push", "lower", 0.1, VectorOfTime(net)),
        PointSpringFunction("tie", ("base", "lower"), (0.1, 0.1), Law(net)),
    ]
    joints = [Joint("A", "base", "upper", angle=0.2), Joint("B", "upper", "lower", angle=0.4)]
    return Mechanism([link("upper", 0.3), link("lower", 0.2)], joints, driven_joint="A", forces=forces)


def functions_of(model):
    return model.forces["law"].function, model.frame_forces["push"].value.function, model.frame_forces["tie"].function


def run(model, net, kind, method):
    """With another network, and a given moment or motion of the first hinge by it."""
    law, push, tie = described(net).forces
    model = eqx.tree_at(functions_of, model, (law.function, push.force, tie.function))
    drive = MomentFunction("A", OfTime(net)) if kind == "moment" else PrescribedFunction("A", Angle(net))
    found = simulate(
        Simulation(
            model, drive=drive, duration=4e-3, method=METHODS[method], design=design(model, {"lower.length": 0.21})
        )
    )
    return jnp.stack([1e-2 * found.metrics.rms_force["B"], found.motion.angles["B"][-1]]), found.status


@pytest.mark.long
@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("kind", ["moment", "motion"])
def test_derivatives_by_the_weights_of_networks(kind, method):
    net = network(jax.nn.softplus if kind == "motion" else jnp.tanh)
    weights, rest = eqx.partition(net, eqx.is_inexact_array)
    numbers, tree = ravel_pytree(weights)
    model = discretise(described(net))

    def ends(numbers):
        return run(model, eqx.combine(tree(numbers), rest), kind, method)

    along = np.random.default_rng(2).uniform(-1.0, 1.0, numbers.shape)
    cotangent = jnp.asarray([0.7, 1.3])
    forward = evaluated(lambda x: jax.jvp(lambda x: ends(x)[0], (x,), (jnp.asarray(along),))[1])(numbers)
    reverse = evaluated(jax.grad(lambda x: cotangent @ ends(x)[0]))(numbers)
    assert np.abs(forward).min() > 1e-8
    assert reverse @ along == pytest.approx(np.asarray(cotangent) @ forward, rel=1e-9)
    step = 2e-3
    points = np.asarray(numbers) + step * np.array([-2, -1, 0, 1, 2])[:, None] * along
    values, status = evaluated(jax.vmap(jax.jit(ends)))(jnp.asarray(points))
    assert not status.any()
    difference = (values[0] - 8.0 * values[1] + 8.0 * values[3] - values[4]) / (12.0 * step)
    np.testing.assert_allclose(forward, difference, rtol=1e-6)


@pytest.mark.slow
def test_a_design_beside_weights_that_are_differentiated():
    weights, rest = eqx.partition(network(jnp.tanh), eqx.is_inexact_array)
    numbers, tree = ravel_pytree(weights)
    at = jnp.asarray(0.3), jnp.asarray(0.2)

    def moment(numbers):
        model = discretise(described(eqx.combine(tree(numbers), rest)))
        made = designed(model, design(model, {"upper.length": 0.31})).model
        assert made.forces is not None
        return made.forces["law"].force(*at) * made.length[0]

    wanted = jax.grad(lambda numbers: 0.31 * Law(eqx.combine(tree(numbers), rest))(*at))(numbers)
    np.testing.assert_allclose(jax.grad(moment)(numbers), wanted, rtol=1e-12)
