"""Natural frequencies about assembled configurations: closed forms, the independent modes of the perfect mechanism, and
derivatives in both modes."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rfem_jax import (
    InputError,
    Joint,
    Link,
    Mechanism,
    PrescribedRate,
    RigidBody,
    assembly_errors,
    design,
    deviations,
    discretise,
    natural_frequencies,
)
from rfem_jax.mechanics.model.status import STATUS
from rfem_jax.simulation.vibrations.modes import REPEATED
from rfem_jax.simulation.vibrations.stability import eigenvalues
from rfem_jax.simulation.vibrations.vibration import Vibration
from tests.derivatives import check_derivatives
from tests.evaluation import evaluated
from tests.mechanisms import BAR, STEEL, compliant_four_bar, four_bar, link

LENGTH = 0.4


def weightless(model):
    return eqx.tree_at(lambda m: m.gravity, model, jnp.zeros(3))


@pytest.mark.slow
@pytest.mark.parametrize("locked", [True, False])
def test_modes_of_a_perfect_four_bar_are_those_of_its_vibration(locked):
    """Which `vibration` finds from the velocities of free bodies; without weight, which it neglects."""
    model = weightless(discretise(four_bar(2)))
    found = evaluated(lambda: natural_frequencies(model, locked=locked, count=8))()
    other = eigenvalues(model, PrescribedRate("A", 0.0) if locked else None)
    expected = np.sort(np.abs(other))[::2][:8] / (2 * np.pi)  # undamped: moduli of the pairs
    first = 0 if locked else 1
    np.testing.assert_allclose(found.frequency[first:], expected[first:], rtol=1e-6)
    assert not found.repeated.any() and float(found.asymmetry) < 1e-8 and int(found.status) == 0
    if not locked:  # the crank turns freely
        assert abs(found.square[0]) < 1e-3
    # Damping of the material alone: eta omega / 2.
    np.testing.assert_allclose(found.damping[first:], 0.5e-5 * 2 * np.pi * found.frequency[first:], rtol=1e-6)


@pytest.mark.long
def test_springs_of_cut_joints_are_in_the_stiffness():
    model = weightless(discretise(compliant_four_bar()))
    found = evaluated(lambda: natural_frequencies(model, locked=False, count=6))()
    squares = np.sort(Vibration(model).modes(np.asarray(model.start_joints)).squares)[:6]
    assert abs(found.square[0]) < 1e-2
    np.testing.assert_allclose(found.square[1:], squares[1:], rtol=1e-6)


def cantilever(rfes=9):
    bar = Link("bar", LENGTH, BAR, STEEL, rfes=rfes)
    return weightless(discretise(Mechanism([bar], [Joint("A", "base", "bar")], driven_joint="A")))


@pytest.mark.long
def test_a_square_cantilever_has_its_frequencies_in_pairs_with_closed_form_derivatives():
    """Slender beam: f = 1.8751^2 / (2 pi L^2) sqrt(EI / rho A), of segments and with shear within a percent; twice,
    along both axes of the square."""
    model = cantilever()

    def frequencies(length):
        return natural_frequencies(model, assembly_errors(model, {"bar.length": length}), count=3)

    found = evaluated(lambda: frequencies(jnp.zeros(())))()
    beam = 1.875104**2 / (2 * np.pi * LENGTH**2) * np.sqrt(STEEL.youngs_modulus * 0.01**2 / 12 / STEEL.density)
    np.testing.assert_allclose(found.frequency[:2], beam, rtol=0.01)
    assert found.frequency[2] > 5 * beam
    np.testing.assert_array_equal(found.repeated, [1.0, 1.0, found.separation[2] < REPEATED])


@pytest.mark.long
def test_derivatives_are_those_of_differences_and_closed_forms():
    """A bar that is held against turning about its hinge has one frequency in the plane; a longer bar is slower by the
    square of its length."""
    bar = Link("bar", LENGTH, type(BAR)(0.01, 0.02), STEEL, rfes=4)
    model = weightless(discretise(Mechanism([bar], [Joint("A", "base", "bar")], driven_joint="A")))

    def frequencies(length):
        return natural_frequencies(model, assembly_errors(model, {"bar.length": length}), count=3).frequency

    found = check_derivatives(frequencies, 0.0, 1e-5, reverse=1e-8, differences=1e-6)
    np.testing.assert_allclose(found.forward[:2], -2 * found.values[:2] / LENGTH, rtol=0.02)
    curvature = evaluated(jax.jacfwd(jax.jacfwd(frequencies)))(jnp.zeros(()))
    around = evaluated(jax.vmap(frequencies))(jnp.asarray([1e-3, -1e-3]))
    np.testing.assert_allclose(curvature, (around.sum(axis=0) - 2 * found.values) / 1e-6, rtol=1e-3)


@pytest.mark.long
def test_preload_by_errors_moves_frequencies_as_their_derivatives_say():
    model = discretise(four_bar(2))

    def frequencies(tilt):
        return natural_frequencies(model, assembly_errors(model, {"D.delta_x": tilt}), count=4).frequency

    # Even in a tilt out of the plane: derivatives at half a degree.
    check_derivatives(frequencies, np.radians(0.5), 1e-4, reverse=1e-8, differences=1e-4, floor=0.1)


@pytest.mark.slow
@pytest.mark.parametrize(("angle", "sign"), [(np.pi / 2, 1.0), (-np.pi / 2, -1.0)])
def test_a_pendulum_swings_below_and_falls_from_above(angle, sign):
    """y of the hinge and x of the arm: at +90 deg the arm hangs."""
    length = 0.3
    model = discretise(Mechanism([link("arm", length)], [Joint("A", "base", "arm", angle=angle)], driven_joint="A"))
    found = evaluated(lambda: natural_frequencies(model, locked=False, count=3))()
    assert found.square.shape == (1,)
    square = 9.81 * (length / 2) / (length**2 / 3 + (0.01**2 / 12))
    assert float(found.square[0]) == pytest.approx(sign * square, rel=1e-9)
    assert float(found.frequency[0]) == pytest.approx(np.sqrt(square) / (2 * np.pi) if sign > 0 else 0.0, rel=1e-9)
    with pytest.raises(InputError, match="`count` must be a whole number"):
        natural_frequencies(model, count=0)


@pytest.mark.long
def test_a_higher_section_swings_faster_as_a_deviation_and_as_a_design():
    """In the plane of the height f ~ h (EI ~ h^3, mass ~ h), of few segments and little shear."""
    model = cantilever(3)
    name, more = "bar.section.height", 1e-3

    def lowest(deviation):
        return natural_frequencies(model, deviations(model, {name: deviation}), count=2).frequency

    def designed(height):
        return natural_frequencies(model, count=2, design=design(model, {name: height})).frequency

    deviating, as_designed = evaluated(lambda x: (lowest(x), designed(0.01 + x)))(jnp.asarray(more))
    np.testing.assert_allclose(deviating, as_designed, rtol=1e-10)
    width, height = np.sort(deviating)
    assert height / width == pytest.approx(1.1, rel=1e-3)
    slope = evaluated(jax.jacfwd(lowest))(jnp.asarray(more))
    np.testing.assert_allclose(np.sort(slope), [0.0, height / 0.011], rtol=2e-3, atol=1e-3 * height / 0.011)


def test_frequencies_that_are_not_numbers_are_not_ok():
    """A ring turns about the axis of a heavy arm: beside that, in the matrix of masses, its inertia is rounding."""
    ring = Link("ring", 0.1, body=RigidBody(1e-3, (0.0, 0.0, 0.0), (1e-3, 1e-3, 1e-3)))
    arm = Link("arm", 0.1, body=RigidBody(1.0, (0.1, 0.0, 0.03), (1e-3, 1e-3, 1e-3)))
    joints = [Joint("A", "base", "ring", angle=0.3), Joint("B", "ring", "arm", angle=0.4, position=(0.0, 0.0, 0.0))]
    model = discretise(Mechanism([ring, arm], joints, driven_joint="A"))
    numbers = ("ring.mass", "ring.inertia.x", "ring.inertia.y", "ring.inertia.z")

    def modes(inertia):
        return natural_frequencies(model, count=1, design=design(model, dict.fromkeys(numbers, inertia)))

    found = jax.jit(jax.vmap(modes))(jnp.asarray([1e-3, 1e-20, 1e-6]))
    assert [STATUS[int(code)].name for code in found.status] == ["ok", "no_modes", "ok"]
    # The ring is held, the arm a pendulum.
    reach = np.hypot(0.1, 0.03)
    expected = np.sqrt(9.81 * reach / (reach**2 + 1e-3)) / (2.0 * np.pi)
    np.testing.assert_allclose(found.frequency[np.array([0, 2]), 0], expected, rtol=1e-9)
    assert np.isnan(found.frequency[1]).all() and np.isnan(found.damping[1]).all()


def test_a_body_that_nothing_holds_has_repeated_frequencies_of_zero():
    """And a stiffness that is zero is symmetric."""
    body = Link("body", 0.1, body=RigidBody(1.0, (0.0, 0.0, 0.0), (1e-3, 2e-3, 3e-3)))
    model = discretise(Mechanism([body], [Joint("A", "base", "body", kind="free")], gravity=(0.0, 0.0, 0.0)))
    found = natural_frequencies(model)
    assert found.frequency.tolist() == [0.0] * 6 and found.repeated.tolist() == [1.0] * 6
    assert float(found.asymmetry) == 0.0 and int(found.status) == 0
