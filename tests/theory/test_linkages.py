"""Textbook linkages: coupler curves by their equations, a function generator by its own, a scissor lift at rest."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

from rfem_jax import Joint, Mechanism, PointForce, discretise, inverse_dynamics, static_loads
from rfem_jax.description.metrics.catalogue import metric_of
from rfem_jax.simulation.rest.poses import poses_at
from rfem_jax.validation import straight_lines
from rfem_jax.validation.lines import PASS
from rfem_jax.validation.straight_lines import PLACES, four_bar, hoecken
from tests.mechanisms import body, link


def moving(mechanism, angles):
    """All of these have one program: as many places, one structure."""
    assert len(angles) == len(PLACES)
    found = inverse_dynamics(discretise(mechanism), {"A": angles}, {"A": 1.0})
    assert (np.asarray(found.status) == 0).all()
    return found


def places(found):
    return np.asarray(found.points["P"].position)[:, [0, 2]].T


def off_the_curve(place, lengths, ground, point):
    """How far places (2, n) are from a coupler curve: of the two circles of the coupler's ends, which are linear in
    cosine and sine of its angle, these are solved for; their squares add up to 1 on the curve alone."""
    x, z = place
    along, across = point
    one = np.stack([x * along + z * across, z * along - x * across])
    right_one = 0.5 * (x**2 + z**2 + along**2 + across**2 - lengths[0] ** 2)
    x, along = x - ground, along - lengths[1]
    other = np.stack([x * along + z * across, z * along - x * across])
    right_other = 0.5 * (x**2 + z**2 + along**2 + across**2 - lengths[2] ** 2)
    determinant = one[0] * other[1] - one[1] * other[0]
    cosine = right_one * other[1] - right_other * one[1]
    sine = right_other * one[0] - right_one * other[0]
    return cosine**2 + sine**2 - determinant**2


def straightness(place):
    """Diameter of the strip about the line of least squares, by singular values."""
    centred = place - place.mean(axis=1, keepdims=True)
    return 2.0 * np.abs(np.linalg.svd(centred)[0][:, 1] @ centred).max()


@pytest.mark.long
def test_hoeckens_line():
    """The point, the pin and the second hinge are on a circle about the rocker's end: a right angle is at the hinge."""
    ground, coupler = 2.0, 2.5

    def exact(angle):
        away = jnp.stack([jnp.cos(angle) - ground, -jnp.sin(angle)])
        square = jnp.sum(away**2)
        height = jnp.sqrt(4.0 * coupler**2 / square - 1.0)
        return jnp.stack([ground + height * away[1], -height * away[0]])

    angles = np.pi + PLACES
    found = moving(hoecken(ground, coupler), angles)
    wanted = np.array(jax.vmap(exact)(angles)).T
    assert_allclose(places(found), wanted, rtol=0, atol=1e-12)
    rates = np.array(jax.vmap(jax.jacfwd(exact))(angles))
    assert_allclose(np.asarray(found.points["P"].velocity)[:, [0, 2]], rates, rtol=0, atol=1e-11)
    assert_allclose(metric_of(found, "P.straightness"), straightness(wanted), rtol=1e-9)
    # Over half a turn a line of four cranks within a hundredth of a crank (studies/straight_line: 100 mm, 0.994 mm).
    assert 3.9 < np.ptp(wanted[0]) < 4.1 and straightness(wanted) == pytest.approx(9.94e-3, abs=2e-5)


@pytest.mark.long
def test_hoeckens_lines_of_a_textbook():
    """Strokes, speeds and errors of eighteen linkages to the last digit that is printed."""
    lines = straight_lines.validate(False, lambda share: None).lines
    assert len(lines) == 72 and [line.name for line in lines if line.verdict != PASS] == []


def test_chebyshevs_line():
    """Rockers 5, coupler 2, hinges 4 apart: the middle of the coupler is at a height of 4 in the middle and above the
    hinges, and within 1.2 % of half a coupler between these."""
    lengths, ground, point = (5.0, 2.0, 5.0), 4.0, (1.0, 0.0)
    ends = -np.arctan2(4.0, 3.0), -0.5 * np.pi  # coupler level, then upright above the first hinge
    place = places(moving(four_bar(lengths, ground, point, ends[0], -1.0), np.linspace(*ends, len(PLACES))))
    assert_allclose(off_the_curve(place, lengths, ground, point), 0.0, atol=1e-9)
    assert_allclose(place[:, [0, -1]], [[2.0, 0.0], [4.0, 4.0]], atol=1e-12)
    assert 0.0 < np.abs(place[1] - 4.0).max() < 0.012


def test_roberts_line():
    """Rockers and sides of the coupler's triangle alike, its base half the distance of the hinges: the apex passes
    through both hinges and the middle between them."""
    side, ground = 1.2, 2.0
    height = np.sqrt(side**2 - 0.25 * ground**2 / 4.0)
    lengths, point = (side, 0.5 * ground, side), (0.25 * ground, -height)
    middle = -np.arctan2(height, 0.25 * ground)
    # With the apex at the first hinge the coupler's far end is above the middle of the base.
    end = -np.arctan2(np.sqrt(side**2 - 0.25 * ground**2), 0.5 * ground) - 2.0 * np.arcsin(0.25 * ground / side)
    mechanism = four_bar(lengths, ground, point, middle)
    angles = np.linspace(middle, end, len(PLACES))
    place = places(moving(mechanism, angles))
    assert_allclose(off_the_curve(place, lengths, ground, point), 0.0, atol=1e-10)
    assert_allclose(place[:, [0, -1]], [[0.5 * ground, 0.0], [0.0, 0.0]], atol=1e-12)
    assert 1e-3 < np.abs(place[1]).max() < 0.02


def test_watts_curve():
    """Equal rockers r, hinges 2 a and coupler's ends 2 c apart: from the middle between the hinges
    rho^2 = r^2 - (a sin t +- sqrt(c^2 - a^2 cos^2 t))^2."""
    rocker, half = 1.0, 0.35
    apart = np.hypot(rocker, half)  # rockers level, coupler upright in the middle, turned into the line of the hinges
    lengths, point = (rocker, 2.0 * half, rocker), (half, 0.0)
    middle = -np.arctan2(half, rocker)
    angles = middle + np.linspace(0.0, 0.45, len(PLACES))
    place = places(moving(four_bar(lengths, 2.0 * apart, point, middle, -1.0), angles))
    assert_allclose(off_the_curve(place, lengths, 2.0 * apart, point), 0.0, atol=1e-11)
    x, z = place[0, 1:] - apart, place[1, 1:]
    assert_allclose(place[:, 0], [apart, 0.0], atol=1e-12)
    angle = np.arctan2(z, x)
    root = np.sqrt(half**2 - apart**2 * np.cos(angle) ** 2)
    both = [rocker**2 - (apart * np.sin(angle) + sign * root) ** 2 for sign in (1.0, -1.0)]
    # Close to the middle, where the angle is of two small differences, rounding counts.
    assert_allclose(np.abs(x**2 + z**2 - np.array(both)).min(axis=0), 0.0, atol=1e-9)
    # Nearly straight along the coupler: the tangent in the middle is that of its upright.
    along = np.array([-half, rocker]) / np.hypot(rocker, half)
    off = np.abs(along[0] * z - along[1] * x)
    assert off[: len(off) // 2].max() < 5e-3 * np.hypot(x, z)[len(off) // 2]


def test_a_function_generator_has_its_structural_error():
    """y = 1/x over 1 <= x <= 2 for a quarter turn of both cranks: exact at three places of Chebyshev's spacing, between
    them off by what Freudenstein's equation says."""
    x = 1.5 - 0.5 * np.cos(np.pi * np.array([1.0, 3.0, 5.0]) / 6.0)

    def angles_of(x):
        return np.radians(30.0 + 90.0 * (x - 1.0)), np.radians(240.0 + 180.0 * (1.0 - 1.0 / x))

    first, second = angles_of(x)
    k1, k2, k3 = np.linalg.solve(np.stack([np.cos(first), np.cos(second), np.ones(3)], axis=1), np.cos(first - second))
    # K1 = -g / d, K2 = g / a, K3 = (a^2 + d^2 + g^2 - b^2) / (2 a d), with lengths that may point the other way.
    crank, rocker = 1.0 / k2, -1.0 / k1
    coupler = np.sqrt(crank**2 + rocker**2 + 1.0 - 2.0 * crank * rocker * k3)
    turned_first, turned_second = (0.0 if length > 0.0 else np.pi for length in (crank, rocker))
    lengths = abs(crank), coupler, abs(rocker)

    def mechanism(x, side):
        return four_bar(lengths, 1.0, (0.0, 0.0), -(angles_of(x)[0] + turned_first), side)

    def rocker_angle(x, side):
        found = moving(mechanism(x[0], side), -(angles_of(x)[0] + turned_first))
        return -np.asarray(found.angles["D"]) - turned_second

    over = np.sort(np.append(np.linspace(1.0, 2.0, len(PLACES) - 3), x))
    errors = [(rocker_angle(over, side) - angles_of(over)[1] + np.pi) % (2.0 * np.pi) - np.pi for side in (1.0, -1.0)]
    error = min(errors, key=lambda one: np.abs(one).max())
    assert_allclose(error[np.isin(over, x)], 0.0, atol=1e-12)
    phi, psi = angles_of(over)
    actual = psi + error
    assert_allclose(k1 * np.cos(phi) + k2 * np.cos(actual) + k3, np.cos(phi - actual), atol=1e-12)
    assert np.radians(0.05) < np.abs(error).max() < np.radians(0.2)


def test_a_far_position_is_reached_as_the_linkage_moves():
    """One move of Newton's method over a quarter turn ends below the line of the hinges, where no motion leads."""
    model = discretise(hoecken(2.975, 3.9625))
    far = poses_at(model, {"A": np.array([0.5 * np.pi])})
    near = poses_at(model, {"A": np.linspace(np.pi, 0.5 * np.pi, 30)})
    assert_allclose(far.start_joints[0], near.start_joints[-1], atol=1e-12)


LENGTH, LOAD, STAGES = 0.8, 900.0, 2


def scissor_lift(angle):
    """Two crossed pairs of arms, the lower ones on a hinge and a slide; half the load on each upper end."""
    names = [f"{side}{n}" for n in range(STAGES) for side in "lr"]
    links = [*(link(name, LENGTH) for name in names), body("foot", 1e-9)]
    wide = LENGTH * np.cos(angle)
    joints = [
        Joint("A", "base", "l0", angle=-angle),
        Joint("G", "base", "foot", kind="prismatic", displacement=wide),
        Joint("F", "foot", "r0", position=(0.0, 0.0, 0.0), angle=angle - np.pi),
        Joint("L", "r0", "l1", angle=np.pi - 2.0 * angle),
        Joint("R", "l0", "r1", angle=2.0 * angle - np.pi),
    ]
    joints += [
        Joint(f"M{n}", f"l{n}", f"r{n}", cut=True, position=(0.5 * LENGTH, 0, 0), child_position=(0.5 * LENGTH, 0, 0))
        for n in range(STAGES)
    ]
    top = [PointForce(f"load_{side}", f"{side}{STAGES - 1}", LENGTH, (0.0, 0.0, -0.5 * LOAD)) for side in "lr"]
    return Mechanism(links, joints, driven_joint="G", forces=top)


@pytest.mark.long
def test_a_scissor_lift_is_held_by_its_closed_form():
    """Horizontal force on the slide, by virtual work: (n W + n^2 w) / tan(angle), with the weight w of an arm."""
    angles = np.radians([50.0, 35.0, 20.0])
    found = static_loads(discretise(scissor_lift(angles[0])), positions={"G": LENGTH * np.cos(angles)})
    assert (np.asarray(found.status) == 0).all()
    arm = 7850.0 * 0.01**2 * LENGTH * 9.81
    held = (STAGES * LOAD + STAGES**2 * arm) / np.tan(angles)
    assert_allclose(found.holding["G"], -held, rtol=1e-8)
    # The pin of the upper stage: each of its arms is pressed outwards at its foot, and its weight is carried there.
    upper = np.linalg.norm(np.asarray(found.loads["M1"].force), axis=1)
    assert_allclose(upper, (LOAD + arm) / np.tan(angles), rtol=1e-8)
