"""The law of contacts, and a pin in its bush as a force element: energy, derivatives, which side holds the pin."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import quad

from rfem_jax import Clearance
from rfem_jax.kernels import kernel
from rfem_jax.mechanics.algebra.vectors import product, rotation_x, rotation_y, rotation_z
from rfem_jax.mechanics.laws.clearances import ContactMemory, pin_in_bush
from rfem_jax.mechanics.laws.contact_law import ContactLaw, chi_of_restitution, distance, sliding_share
from rfem_jax.mechanics.laws.frame_forces import START, NodeFrame, Pose
from rfem_jax.mechanics.model.topology import BASE

BASE_FRAME = NodeFrame(BASE, jnp.eye(3), jnp.zeros(3))
FULL = {"radial": 1e-4, "axial": 2e-4, "length": 0.02, "stiffness": 3e9, "axial_stiffness": 2e7, "axial_exponent": 1.0}
DAMPERS = {"elastic": {}, "fixed chi": {"damping": 0.4}, "restitution": {"restitution": 0.8}}
FRICTION = {"friction": 0.3, "diameter": 0.012, "sliding_speed": 1e-3}


def law(exponent=1.5):
    return ContactLaw(jnp.asarray(4e9), exponent)


def rotation(angles):
    """By angles about x, y, z [rad]."""
    x, y, z = jnp.asarray(angles, float)
    return product(rotation_z(z), product(rotation_y(y), rotation_x(x)))


def pose_of(shift, turn, linear=(0.0, 0.0, 0.0), angular=(0.0, 0.0, 0.0)):
    return Pose(jnp.asarray(shift, float), rotation(turn), jnp.asarray(linear, float), jnp.asarray(angular, float))


def pin(**settings):
    return pin_in_bush(Clearance(**{**FULL, **settings}), BASE_FRAME, BASE_FRAME)


# Both ends and the stop closed, on different sides of the bush.
PRESSED = pose_of((1.8e-4, -2.6e-4, 1.2e-4), (0.012, 0.8, -0.02), (0.02, -0.01, 0.05), (0.9, 4.0, -1.3))


class TestLaw:
    @pytest.mark.parametrize("exponent", [1.0, 1.5, 2.2])
    def test_energy_is_the_work_of_the_force(self, exponent):
        one = law(exponent)
        work = 2e-5 * quad(lambda x: float(one.push(jnp.asarray(2e-5 * x), jnp.zeros(()), None).normal), 0.0, 1.0)[0]
        np.testing.assert_allclose(one.energy(jnp.asarray(2e-5)), work, rtol=1e-8)
        assert one.energy(jnp.asarray(-1e-5)) == 0.0

    def test_open_contacts_and_those_that_open_fast_do_not_pull(self):
        depth, rate = jnp.array([-1e-6, 1e-6, 1e-6, 1e-6]), jnp.array([5.0, -10.0, -1.0, 1.0])
        push = law().push(depth, rate, 0.5 * jnp.ones(4))
        elastic = 4e9 * 1e-9
        np.testing.assert_allclose(push.normal, [0.0, 0.0, 0.5 * elastic, 1.5 * elastic], rtol=1e-12)
        np.testing.assert_allclose(push.elastic, [0.0, elastic, elastic, elastic], rtol=1e-12)

    def test_restitution_makes_chi_by_the_speed_of_approach(self):
        chi = chi_of_restitution(jnp.asarray(0.9), jnp.array([2.0, 1e-9]), jnp.asarray(1e-3))
        np.testing.assert_allclose(chi, [0.75 * 0.19 / 2.0, 0.75 * 0.19 / 1e-3], rtol=1e-14)

    @pytest.mark.slow
    def test_derivatives_where_a_contact_touches_and_where_axes_meet(self):
        touching = jax.grad(lambda x: law().push(x, jnp.ones(()), jnp.ones(())).normal)(jnp.zeros(()))
        assert touching == 0.0
        at_centre = jax.jit(jax.jacfwd(lambda e: distance(e, 0)))(jnp.zeros(2))
        np.testing.assert_array_equal(at_centre, 0.0)
        assert np.isfinite(jax.jit(jax.hessian(lambda e: distance(e, 0)))(jnp.zeros(2))).all()

    @pytest.mark.slow
    @pytest.mark.parametrize("share", [0.0, 1e-5, 9.9e-3, 1.01e-2, 0.7, 30.0])
    def test_smooth_sign_of_sliding(self, share):
        def size(v):
            return sliding_share(jnp.stack([0.6 * v, -0.8 * v]), jnp.asarray(0.02))

        value, slope = jax.jvp(size, (jnp.asarray(0.02 * share),), (jnp.ones(()),))
        np.testing.assert_allclose(value, np.array([0.6, -0.8]) * np.tanh(share), rtol=1e-12, atol=1e-15)
        np.testing.assert_allclose(slope, np.array([0.6, -0.8]) / np.cosh(share) ** 2 / 0.02, rtol=1e-9, atol=1e-15)


def moved(pose, shift, turn):
    """The pose displaced by a small shift and small angles in the parent's axes."""
    return pose._replace(position=pose.position + shift, rotation=product(rotation(turn), pose.rotation))


@pytest.mark.parametrize("holder", ["child", "parent"])
class TestPinInBush:
    @pytest.mark.slow
    def test_all_three_contacts_carry(self, holder):
        assert (np.asarray(pin(pin=holder).contacts(PRESSED).depth) > 0.0).all()

    @pytest.mark.slow
    @pytest.mark.parametrize("exponent", [1.0, 1.5])
    def test_wrench_is_minus_the_gradient_of_the_energy(self, holder, exponent):
        one = pin(pin=holder, exponent=exponent, centring=300.0, stiffness=4e7)
        still = PRESSED._replace(linear=jnp.zeros(3), angular=jnp.zeros(3))
        gradient = jax.jit(jax.grad(lambda by: one.energy(moved(still, by[:3], by[3:]))))(jnp.zeros(6))
        np.testing.assert_allclose(jnp.concatenate(one.wrench(still, START)), -gradient, rtol=1e-9, atol=1e-9)

    @pytest.mark.slow
    @pytest.mark.parametrize("damper", DAMPERS)
    @pytest.mark.parametrize("friction", [{}, FRICTION], ids=["smooth", "rough"])
    def test_power_is_what_is_stored_and_lost(self, holder, damper, friction):
        one = pin(pin=holder, **DAMPERS[damper], **friction)
        if one.approach is not None:
            one = type(one)(**{**vars(one), "approach": jnp.array([0.1, 0.2, 0.3])})
        force, moment = one.wrench(PRESSED, START)
        power = force @ PRESSED.linear + moment @ PRESSED.angular
        rate = jax.jvp(lambda t: one.energy(moved(PRESSED, t * PRESSED.linear, t * PRESSED.angular)), (0.0,), (1.0,))[1]
        lost = one.dissipation(PRESSED)
        np.testing.assert_allclose(power, -rate - lost, rtol=1e-10)
        assert lost >= 0.0 and (lost > 0.0) == bool(DAMPERS[damper] or friction)

    @pytest.mark.long
    def test_tangent_is_the_derivative_by_the_accelerations(self, holder):
        one = pin(pin=holder, damping=0.4, **FRICTION)
        tangent = one.tangent(PRESSED, START, 1e-8, 1e-4)
        for n, unit in enumerate(np.eye(6)):

            def wrench(size, unit=unit):
                pose = moved(PRESSED, 1e-8 * size * unit[:3], 1e-8 * size * unit[3:])
                pose = pose._replace(
                    linear=pose.linear + 1e-4 * size * unit[:3], angular=pose.angular + 1e-4 * size * unit[3:]
                )
                return np.concatenate(one.wrench(pose, START))

            difference = (wrench(1e-1) - wrench(-1e-1)) / 2e-1
            np.testing.assert_allclose(tangent[:, n], -difference, rtol=1e-5, atol=1e-6 * np.abs(difference).max())

    def test_second_derivatives_are_finite_in_the_middle_and_where_contacts_touch(self, holder):
        one = pin(pin=holder, **FRICTION, damping=0.1)
        for pose in (pose_of((0, 0, 0), (0, 0, 0)), pose_of((1e-4, 2e-4, 0), (0, 0, 0))):

            def wrench(by, pose=pose):
                return jnp.concatenate(one.wrench(moved(pose, by[:3], by[3:]), START))

            assert np.isfinite(kernel(jax.jacfwd(wrench))(jnp.zeros(6))).all()
            assert np.isfinite(kernel(jax.jacrev(wrench))(jnp.zeros(6))).all()


def test_pin_on_either_side_is_one_joint_seen_from_both_sides():
    """The parent's pin in the child's bush is the child's pin in the parent's bush with parent and child exchanged."""
    on_child, on_parent = pin(damping=0.4, **FRICTION), pin(damping=0.4, pin="parent", **FRICTION)
    turned = PRESSED.rotation
    seen = Pose(
        -turned.T @ PRESSED.position,
        turned.T,
        turned.T @ (jnp.cross(PRESSED.angular, PRESSED.position) - PRESSED.linear),
        -turned.T @ PRESSED.angular,
    )
    force, moment = on_parent.wrench(PRESSED, START)
    other_force, other_moment = on_child.wrench(seen, START)
    np.testing.assert_allclose(turned @ other_force, -force, rtol=1e-9, atol=1e-9)
    # About the parent's point, which is the child's of the exchanged joint.
    np.testing.assert_allclose(turned @ other_moment, -(moment + jnp.cross(PRESSED.position, force)), rtol=1e-9)


def test_a_tilted_pin_in_the_middle_carries_nothing_until_its_ends_touch():
    one = pin(exponent=1.0, stiffness=5e7)
    for tilt, expected in ((0.0099, 0.0), (0.012, 0.02 * 5e7 * (0.01 * np.sin(0.012) - 1e-4))):
        force, moment = one.wrench(pose_of((0, 0, 0), (tilt, 0, 0)), START)
        np.testing.assert_allclose(force, 0.0, atol=1e-9)
        np.testing.assert_allclose(moment[0], -expected * np.cos(tilt), rtol=1e-6, atol=2e-9)


def test_memory_of_a_contact_that_closes_between_two_instants():
    """A constant acceleration of depth: the speed where it closed, whatever the instants."""
    one = pin(restitution=0.9)
    acceleration, start = -300.0, 2.0

    def pose(t):
        size = start * t + 0.5 * acceleration * t**2
        return pose_of((8e-5 + size, 0, 0), (0, 0, 0), (start + acceleration * t, 0, 0))

    nothing = ContactMemory(jnp.zeros(3), -jnp.ones(3), jnp.zeros(3))
    before = one.remembered(pose(2e-6), nothing)
    np.testing.assert_allclose(before.approach[:2], start + acceleration * 2e-6)
    after = one.remembered(pose(3e-5), before)
    np.testing.assert_allclose(after.approach[:2], np.sqrt(start**2 + 2.0 * acceleration * 2e-5), rtol=1e-9)
    np.testing.assert_allclose(one.remembered(pose(4e-5), after).approach[:2], after.approach[:2])
