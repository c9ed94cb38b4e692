"""Links that are twisted along their length against integrals of turned compliances."""

import jax
import numpy as np
import pytest

from rfem_jax import Joint, Link, Mechanism, PointMass, Rectangle, assembly_errors, discretise, static_loads
from rfem_jax.mechanics.elements.elasticity import stiffness_blocks
from rfem_jax.mechanics.model.with_errors import apply_errors
from tests.derivatives import check_derivatives
from tests.mechanisms import STEEL

LENGTH = 0.4
STRIP = Rectangle(0.03, 0.005)
FOUND = STRIP.properties(STEEL)
NOTHING = (0.0, 0.0, 0.0)
TWIST = 0.7


def bar(rfes, joints=(), **more):
    beam = Link("beam", LENGTH, STRIP, STEEL, rfes=rfes, **{"form_errors": True} | more)
    return discretise(Mechanism([beam], [Joint("A", "base", "beam", kind="fixed"), *joints], gravity=NOTHING))


@jax.jit
def stiffness(actual):
    return stiffness_blocks(actual), actual.rest


def tip_compliance(rfes):
    """Displacements and rotations (6, 6) of the end per unit of forces and moments there."""
    model = bar(rfes)
    blocks, rest = stiffness(apply_errors(model, assembly_errors(model, {"beam.twist": TWIST})))
    m = rfes - 1
    whole = np.zeros((6 * m, 6 * m))  # rotations first
    for k in range(m):
        at, before = slice(6 * k, 6 * k + 6), slice(6 * k - 6, 6 * k)
        whole[at, at] = blocks.diagonal[k]
        if k:
            whole[at, before], whole[before, at] = blocks.lower[k], blocks.lower[k].T
    of_last = np.linalg.inv(whole)[-6:, -6:][np.ix_((3, 4, 5, 0, 1, 2), (3, 4, 5, 0, 1, 2))]
    arm = LENGTH - float(rest[0, -1])
    to_tip = np.eye(6)
    to_tip[1, 5], to_tip[2, 4] = arm, -arm
    return to_tip @ of_last @ to_tip.T


def integral(power):
    """Integrals of (L - s)^power times (cos^2, sin^2, sin cos) of TWIST s / L along the link, by hand for the powers
    0 and 2."""
    k, length = 2.0 * TWIST / LENGTH, LENGTH
    if power == 0:
        cosine, sine, whole = np.sin(k * length) / k, (1.0 - np.cos(k * length)) / k, length
    else:  # by parts, twice
        cosine = 2.0 * length / k**2 - 2.0 * np.sin(k * length) / k**3
        sine = length**2 / k - 2.0 * (1.0 - np.cos(k * length)) / k**3
        whole = length**3 / 3.0
    return 0.5 * (whole + cosine), 0.5 * (whole - cosine), 0.5 * sine


def test_a_pretwisted_cantilever_bends_in_both_planes():
    """Its end moves across a force, by the integral of (L - s)^2 sin cos (1/EI_y - 1/EI_z)."""
    soft, stiff = 1.0 / FOUND.bending_y, 1.0 / FOUND.bending_z
    assert soft > 10.0 * stiff
    errors = []
    for rfes in (5, 9):
        found = tip_compliance(rfes)
        squared, other, mixed = integral(0)
        by_moment = np.array([
            [squared * soft + other * stiff, mixed * (soft - stiff)],
            [mixed * (soft - stiff), other * soft + squared * stiff],
        ])  # fmt: skip
        np.testing.assert_allclose(found[4:, 4:], by_moment, rtol=1e-10)
        assert found[3, 3] == pytest.approx(LENGTH / FOUND.torsion, rel=1e-12)
        squared, other, mixed = integral(2)
        # A force along z bends about y: of y and z the deflections have the opposite sign of the rotations' coupling.
        by_force = np.array([
            [other * soft + squared * stiff, -mixed * (soft - stiff)],
            [-mixed * (soft - stiff), squared * soft + other * stiff],
        ])  # fmt: skip
        errors.append(np.abs(found[1:3, 1:3] / by_force - 1.0))
    assert errors[0].max() < 0.03
    np.testing.assert_allclose(errors[0] / errors[1], 4.0, rtol=0.15)


@pytest.mark.long
def test_a_twisted_link_between_walls_is_turned_back():
    """It carries GJ/L times its twist; a wall in its middle, where half of the twist is due, carries nothing. Without
    errors of form the hole in the middle is not turned."""
    walls = [
        Joint(name, "base", "beam", kind="fixed", position=(x, 0, 0), child_position=(x, 0, 0), cut=True)
        for name, x in (("M", 0.5 * LENGTH), ("B", LENGTH))
    ]
    twist = 2e-3
    torque = FOUND.torsion * twist / LENGTH
    for form_errors, (of_a, of_m) in ((True, (1.0, 0.0)), (False, (0.0, 2.0))):
        loads = static_loads(bar(5, walls, form_errors=form_errors), {"beam.twist": twist}).loads
        found = [float(np.asarray(loads[joint].moment).reshape(3)[0]) for joint in "AMB"]
        assert abs(found[0]) == pytest.approx(of_a * torque, rel=1e-6, abs=1e-9 * torque)
        assert abs(found[1]) == pytest.approx(of_m * torque, rel=1e-6, abs=1e-9 * torque)
        assert abs(found[2]) == pytest.approx(torque if form_errors else 2.0 * torque, rel=1e-6)
        assert sum(found) == pytest.approx(0.0, abs=1e-9 * torque)


def test_what_is_fixed_to_a_twisted_link_is_turned_with_it():
    """Joints and masses beside its axis, by the share of the twist at their places."""
    places = [(0.1, 0.02, 0.01), (LENGTH, 0.0, 0.03)]
    end = Joint("B", "base", "beam", kind="spherical", position=places[1], child_position=places[1], cut=True)
    model = bar(4, [end], point_masses=[PointMass(0.2, place) for place in places])
    straight, turned = (apply_errors(model, assembly_errors(model, {"beam.twist": twist})) for twist in (0.0, TWIST))

    def turn(angle):
        c, s = np.cos(angle), np.sin(angle)
        return np.array([[1.0, 0, 0], [0, c, -s], [0, s, c]])

    end = model.topology.joints.index("B")
    before = np.asarray(straight.bore_position)[:, end]
    np.testing.assert_allclose(np.asarray(turned.bore_position)[:, end], turn(TWIST) @ before, atol=1e-15)
    before, after = (np.asarray(one.bore_rotation)[:, :, end] for one in (straight, turned))
    np.testing.assert_allclose(after, turn(TWIST) @ before, atol=1e-15)
    moments = [np.asarray(one.mass)[None] * np.asarray(one.centre) for one in (straight, turned)]
    expected = sum(0.2 * (turn(TWIST * place[0] / LENGTH) - np.eye(3)) @ np.array(place) for place in places)
    np.testing.assert_allclose((moments[1] - moments[0]).sum(axis=1), expected, atol=1e-15)
    assert np.asarray(turned.mass).sum() == pytest.approx(np.asarray(straight.mass).sum(), rel=1e-14)


@pytest.mark.long
def test_derivatives_at_no_twist_in_both_modes():
    """Of a link between walls, one of which is higher by d: what bends it in one plane bends it in the other, too, and
    the walls push it back by 6 d tau (EI_z - EI_y)/L^3."""
    end, height = (LENGTH, 0.0, 0.0), 1e-4
    model = bar(6, [Joint("B", "base", "beam", kind="fixed", position=end, child_position=end, cut=True)])
    torque = FOUND.torsion / LENGTH

    def values(numbers):
        found = static_loads(model, {"beam.twist": numbers[0], "B.d_z": numbers[1]}).loads["B"]
        return jax.numpy.concatenate([found.moment.reshape(3) / torque, found.force.reshape(3)[1:]])

    found = check_derivatives(
        values, np.array([0.0, height]), np.array([1e-4, 1e-6]), reverse=1e-8, differences=1e-4, floor=1e-3
    )
    assert abs(found.forward[0, 0]) == pytest.approx(1.0, rel=1e-3)
    back = 6.0 * height * (FOUND.bending_z - FOUND.bending_y) / LENGTH**3
    assert abs(found.forward[3, 0]) == pytest.approx(back, rel=0.05)
