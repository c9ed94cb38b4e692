"""Friction in joints of the tree and in cut joints: laws against closed forms, the recursive formulation against the
dense one, whose loads do not come from the recursion."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rfem_jax import Compliance, Joint, JointFriction, Mechanism, PointSpring, assembly_errors, discretise
from rfem_jax.kernels import kernel
from rfem_jax.mechanics.dynamics import energy_and_momentum, loads
from rfem_jax.mechanics.dynamics.dynamics import accelerations
from rfem_jax.mechanics.forces.friction import friction_lines
from rfem_jax.mechanics.forces.joint_forces import FrictionState
from rfem_jax.mechanics.implicit.residual import evaluate_residual
from rfem_jax.mechanics.laws.friction_laws import friction_law
from rfem_jax.mechanics.model.inputs import DriveInput, Stabilisation
from rfem_jax.mechanics.model.with_errors import apply_errors
from rfem_jax.mechanics.reference.friction import reference_with_friction
from tests.mechanisms import link, loop_cut_by, random_state, some_errors

from .test_formulations import close

GAINS = Stabilisation(3.0, 7.0, 0.3)


def law(**settings):
    joint = Joint("A", "base", "a", kind=settings.pop("kind", "revolute"))
    described = JointFriction("f", "A", **settings).resolved(joint)
    return friction_law(described, joint, 0, 0, 0)


class TestLaws:
    def test_tanh(self):
        made, rate, normal = law(constant=0.3, coefficient=0.2, radius=0.01, viscous=0.5, sliding_rate=0.1), 0.07, 40.0
        expected = -(0.3 + 0.2 * 0.01 * 40.0) * np.tanh(0.7) - 0.5 * rate
        np.testing.assert_allclose(made.force(0.0, jnp.asarray(rate), jnp.asarray(normal)), expected, rtol=1e-14)

    def test_brown_mcphee(self):
        """Their law without its viscous part, under 2 N of normal load."""
        made = law(kind="prismatic", coefficient=0.4, static_coefficient=0.6, sliding_rate=0.02, law="brown_mcphee")
        x = np.array([-3.0, -0.4, 0.0, 1.0, 2.5])
        expected = -2.0 * (0.4 * np.tanh(4.0 * x) + 0.2 * x / (0.25 * x**2 + 0.75) ** 2)
        found = jax.jit(jax.vmap(lambda rate: made.force(0.0, rate, jnp.asarray(2.0))))(jnp.asarray(0.02 * x))
        np.testing.assert_allclose(found, expected, rtol=1e-14, atol=1e-15)

    @pytest.mark.parametrize("settings", [{"law": "tanh"}, {"law": "brown_mcphee", "static_constant": 3.0}])
    def test_the_chord_from_rest(self, settings):
        made = law(constant=2.0, sliding_rate=0.1, viscous=0.4, **settings)
        for rate in map(jnp.asarray, (-3.0, 1e-2, 1e-6, 0.0)):
            chord, derivative = made.secant(rate, None), made.tangent(rate, None)
            if float(rate):
                np.testing.assert_allclose(chord, -made.force(0.0, rate) / rate, rtol=1e-9)
            assert float(chord) >= float(derivative) * (1.0 - 1e-12)
        np.testing.assert_allclose(chord, derivative, rtol=1e-12)

    @pytest.mark.slow
    @pytest.mark.parametrize("settings", [{"law": "tanh"}, {"law": "brown_mcphee", "static_constant": 2.1}])
    def test_chords_of_newtons_method(self, settings):
        """Whether it sticks, slides or turns round, few increments find the friction of an inertia from any guess."""
        friction = JointFriction("f", "A", constant=2.0, sliding_rate=0.1, viscous=0.4, **settings)
        model = discretise(Mechanism([link("a", 0.1)], [Joint("A", "base", "a")], forces=[friction]))
        actual = apply_errors(model, assembly_errors(model))
        made = actual.friction["f"]

        def residual_after(inertia, free, rate, increments):
            """Of a rate, at first a guess, for one at which the inertia is `free` of friction."""
            lines = None
            for count in range(increments + 1):
                force = made.force(0.0, rate)
                found = {"f": FrictionState(rate, rate, None, force)}
                lines = friction_lines(actual, found, lines, count)
                residual = inertia * (free - rate) + force
                rate = rate + residual / (inertia + lines["f"].slope)
            return residual

        sizes = [sign * size for sign in (1.0, -1.0) for size in (1e-3, 0.1, 30.0)]
        cases = jnp.array([(m, a, b) for m in (0.1, 3.0, 100.0) for a in sizes for b in (0.0, *sizes)])
        increments = 4 if settings["law"] == "tanh" else 5
        found = jax.jit(jax.vmap(lambda case: residual_after(*case, increments)))(cases)
        np.testing.assert_allclose(found, 0.0, atol=1e-5)

    def test_moments_press_the_ends_of_a_bearing(self):
        normal = law(coefficient=0.1, radius=0.01, length=0.05, sliding_rate=1.0).load.size
        force, moment, axis = jnp.array([3.0, 100.0, 4.0]), jnp.array([0.7, 50.0, -0.2]), jnp.array([0.0, 1.0, 0.0])
        # Reactions a, b across the axis at the ends +-25 mm, of which a + b = force and arm x (a - b) = moment.
        ends = np.linalg.solve([[1, 0, 1, 0], [0, 1, 0, 1], [0, 0.025, 0, -0.025], [-0.025, 0, 0.025, 0]],
                               [3.0, 4.0, 0.7, -0.2])  # fmt: skip
        expected = np.hypot(*ends[:2]) + np.hypot(*ends[2:])
        np.testing.assert_allclose(normal(force, moment, axis), expected, rtol=1e-8)

    @pytest.mark.long
    def test_the_normal_load_is_smooth_at_zero(self):
        normal = law(coefficient=0.1, radius=0.01, sliding_rate=1.0, load_scale=2.0).load.size

        def along(f):
            return normal(f * jnp.array([1.0, 0.0, 0.0]), jnp.zeros(3), jnp.array([0.0, 1.0, 0.0]))

        at = jnp.zeros(())
        np.testing.assert_allclose([along(at), jax.grad(along)(at), jax.hessian(along)(at)], [0.0, 0.0, 1.0])
        np.testing.assert_allclose(along(jnp.asarray(2e4)), 2e4, rtol=1e-8)


def chain_with_friction():
    """On a driven joint, with the length of a guide, on both motions of one joint, two on one motion."""
    links = [link("a", 0.1), link("b", 0.15), link("d", 0.25, 2), link("g", 0.1)]
    joints = [
        Joint("A", "base", "a", orientation=(0.2, 0.0, 0.3), angle=0.4),
        Joint("P", "a", "b", kind="prismatic", orientation=(0.3, -0.2, 0.1), displacement=0.05),
        Joint("C", "b", "d", kind="cylindrical", position=(0.12, 0.01, 0.0), angle=0.6, displacement=-0.03),
        Joint("R", "d", "g", position=(0.25, 0.0, 0.01), angle=-0.8),
    ]
    forces = [
        JointFriction("driven", "A", coefficient=0.3, radius=0.02, viscous=0.1, sliding_rate=2.0),
        JointFriction("guide", "P", coefficient=0.02, length=0.1, constant=3.0, sliding_rate=2.0),
        JointFriction("about", "C", motion="R_y", constant=0.3, law="brown_mcphee", static_constant=0.5,
                      coefficient=0.1, static_coefficient=0.12, radius=0.01, length=0.1, sliding_rate=2.0),
        JointFriction("along", "C", motion="T_y", coefficient=0.2, constant=2.0, viscous=0.5, sliding_rate=2.0),
        JointFriction("last", "R", coefficient=0.3, radius=0.01, constant=0.2, sliding_rate=2.0),
        JointFriction("more", "R", viscous=0.02),
    ]  # fmt: skip
    return Mechanism(links, joints, driven_joint="A", forces=forces)


def bearings_with_friction():
    """The chain with a part of what its joints hold sprung, and a spring between points of two links."""
    chain = chain_with_friction()
    springs = {
        "A": Compliance(radial=3e5, axial=2e5, radial_damping=30.0),
        "P": Compliance(normal=4e5, R_y=2e3, R_y_damping=0.1),
        "C": Compliance(radial=5e5),
        "R": Compliance(axial=2e5, axial_damping=20.0),
    }
    joints = [dataclasses.replace(joint, compliance=springs[joint.name]) for joint in chain.joints]
    coil = PointSpring("coil", ["a", "g"], [[0.05, 0.0, 0.01], [0.1, 0.0, 0.0]], 3e5, 40.0, free_length=0.1)
    return dataclasses.replace(chain, joints=joints, forces=[*chain.forces, coil])


def loops_with_friction():
    """A cut guide between flexible links and a cut hinge in the middle of one of them, on a rigid link outboard of a
    cylindrical joint."""
    loop = loop_cut_by("prismatic")
    joints = [
        *loop.joints,
        Joint("E", "base", "prop", position=(0.2, 0.0, 0.2), kind="cylindrical", angle=np.pi / 2),
        Joint("U", "left", "prop", cut=True, position=(0.2, 0.0, 0.0)),
    ]
    forces = [
        JointFriction("cut_hinge", "U", coefficient=0.3, radius=0.01, length=0.03, constant=0.4, sliding_rate=3.0),
        JointFriction("cut_guide", "C", coefficient=0.2, length=0.05, constant=4.0, sliding_rate=0.5),
        JointFriction("slide", "E", motion="T_y", coefficient=0.2, viscous=2.0, sliding_rate=0.5),
        JointFriction("foot", "D", coefficient=0.2, radius=0.02, constant=0.1, sliding_rate=3.0),
    ]
    return Mechanism([*loop.links, link("prop", 0.2)], joints, forces=forces)


@pytest.fixture(
    scope="module",
    params=[
        pytest.param(chain_with_friction, marks=pytest.mark.slow),
        *(pytest.param(make, marks=pytest.mark.long) for make in (bearings_with_friction, loops_with_friction)),
    ],
    ids=lambda make: make.__name__,
)
def compared(request):
    """Both formulations, first with friction by the rate alone, then by loads, too, which the recursive one has in its
    residual."""
    rng = np.random.default_rng(5)
    model = discretise(request.param())
    drive = (
        DriveInput()
        if model.topology.driven is None
        else DriveInput({model.topology.driven_coordinate: jnp.asarray(1.7)})
    )

    def both(errors, state, share):
        actual = apply_errors(model, errors)

        def arms(r):
            return [arm for one in r.friction.values() if one.load for arm in (one.load.arm, one.load.static_arm)]

        actual = eqx.tree_at(arms, actual, [share * arm for arm in arms(actual)])
        state = close(actual, state)
        slow = reference_with_friction(actual, state, drive, GAINS, rounds=16)
        fast = accelerations(actual, state, drive, GAINS)
        joint = loads.joint_loads(actual, fast, drive)
        chain, base = loads.chain_loads(actual, fast, fast.angular, fast.linear, drive)
        balance = energy_and_momentum.momentum_residual(actual, state, fast.coordinates, base)
        explicit = fast.coordinates, fast.multipliers, fast.laws, joint, chain, balance
        evaluation = evaluate_residual(actual, state, *slow[:2], drive, GAINS.scale)
        joint = loads.loads_of_wrenches(actual.topology, evaluation, evaluation.wrenches, drive)
        balance = energy_and_momentum.momentum_residual(
            actual, state, slow[0], loads.base_wrench(actual.topology, evaluation.wrenches)
        )
        residual = evaluation.hinge, evaluation.force, evaluation.moment
        return slow, explicit, (residual, evaluation.laws, joint, balance)

    size = 0.1 if model.topology.sprung else 0.5  # displacements of bearings are small
    samples = [(some_errors(model, rng), random_state(model, rng, size), share) for share in (0.0, 0.2)]
    samples = jax.tree.map(lambda *x: jnp.stack(x), *samples)
    return model, jax.jit(jax.vmap(kernel(both)))(*samples)


def without_loads(tree):
    return jax.tree.map(lambda x: x[:1], tree)


def test_accelerations_and_multipliers_agree(compared):
    model, (slow, explicit, _) = compared
    slow, reference, friction = without_loads(slow)
    fast, multipliers, laws, *_ = without_loads(explicit)
    for one, other in ((fast.joints, slow.joints), (fast.elastic, slow.elastic), (multipliers, reference)):
        if other.size:
            np.testing.assert_allclose(one / np.abs(other).max(), other / np.abs(other).max(), rtol=0, atol=1e-9)
    assert all(np.abs(force) > 1e-3 for name, force in friction.items() if name in model.friction)
    for name, force in friction.items():
        np.testing.assert_allclose(laws.friction[name].force, force, rtol=1e-9)


def test_loads_have_the_friction_and_balance_the_momentum(compared):
    model, (_, explicit, _) = compared
    _, _, laws, joint, chain, balance = without_loads(explicit)
    largest = np.abs(joint.force).max()
    for part in balance:
        np.testing.assert_allclose(part / largest, 0.0, atol=1e-9)
    for one, other in zip(joint, chain):
        np.testing.assert_allclose(one / largest, other / largest, rtol=0, atol=1e-9)
    for components, friction in along_motions(model, chain, laws):
        np.testing.assert_allclose(components / largest, friction / largest, rtol=0, atol=1e-9)


def test_the_residual_vanishes_with_friction_by_loads(compared):
    model, ((_, _, friction), _, (residual, laws, joint, balance)) = compared
    largest = np.abs(joint.force).max(axis=(1, 2))
    for part in (*residual, *balance):
        if part.size:
            np.testing.assert_allclose(np.abs(part.reshape(2, -1)).max(axis=1) / largest, 0.0, atol=1e-9)
    for name, force in friction.items():
        np.testing.assert_allclose(laws.friction[name].force, force, rtol=1e-8)
        if model.friction[name].load is not None:
            assert laws.friction[name].normal.min() > 1e-3 * largest.min()
    for components, friction in along_motions(model, joint, laws):
        np.testing.assert_allclose((components - friction) / largest, 0.0, atol=1e-9)


def along_motions(model, joint, laws):
    """Pairs of the load along a motion that has friction, and the friction on it."""
    by_component = np.concatenate([joint.force, joint.moment], axis=1)
    for joint, component in {(one.joint, one.component) for one in model.friction.values()}:
        own = [name for name, one in model.friction.items() if (one.joint, one.component) == (joint, component)]
        yield by_component[:, component, joint], sum(laws.friction[name].force for name in own)
