"""Curved and bent links against closed forms and beam finite elements."""

from itertools import pairwise

import jax
import numpy as np
import pytest

from rfem_jax import (
    AxisPoint,
    DistributedForce,
    InputError,
    Joint,
    Link,
    Mechanism,
    PointForce,
    Rectangle,
    assembly_errors,
    discretise,
    static_loads,
)
from rfem_jax.mechanics.elements.elasticity import stiffness_blocks
from rfem_jax.mechanics.model.with_errors import apply_errors
from rfem_jax.mechanics.statics.designs import designed
from rfem_jax.simulation.vibrations.modes import natural_frequencies
from tests.derivatives import check_derivatives
from tests.mechanisms import STEEL

NOTHING = (0.0, 0.0, 0.0)
RADIUS = 0.2
SECTION = Rectangle(0.01, 0.016)
POINTS, WEIGHTS = np.polynomial.legendre.leggauss(60)
RING = AxisPoint((RADIUS, 0.0, RADIUS), through=(RADIUS * np.sin(0.5), 0.0, RADIUS * (1.0 - np.cos(0.5))))


def clamped(axis, rfes, forces=(), section=SECTION, **more):
    smooth = more.pop("smooth", False)
    beam = Link("beam", section=section, material=STEEL, rfes=rfes, axis=axis, smooth=smooth)
    return discretise(
        Mechanism([beam], [Joint("A", "base", "beam", kind="fixed")], forces=forces, gravity=NOTHING, **more)
    )


@jax.jit
def stiffness(actual):
    return stiffness_blocks(actual), actual.rest


def tip_compliance(axis, rfes, **more):
    """Displacements and rotations (6, 6) of the end of a clamped link per unit of forces and moments there."""
    model = clamped(axis, rfes, **more)
    blocks, rest = jax.tree.map(np.asarray, stiffness(apply_errors(model, assembly_errors(model))))
    m = rfes - 1
    whole = np.zeros((6 * m, 6 * m))  # rotations first
    for k in range(m):
        at, before = slice(6 * k, 6 * k + 6), slice(6 * k - 6, 6 * k)
        whole[at, at] = blocks.diagonal[k]
        if k:
            whole[at, before], whole[before, at] = blocks.lower[k], blocks.lower[k].T
    of_last = np.linalg.inv(whole)[-6:, -6:][np.ix_((3, 4, 5, 0, 1, 2), (3, 4, 5, 0, 1, 2))]
    x, y, z = np.array(axis[-1].to) - rest[:, -1]
    to_tip = np.eye(6)
    to_tip[:3, 3:] = -np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return to_tip @ of_last @ to_tip.T


def castigliano(place, axes, length, end):
    """Compliance (6, 6) of a clamped curved beam at its end by its energy, of the curve `place(s)` and the sections'
    axes `axes(s)`, columns."""
    found = SECTION.properties(STEEL)
    names = "axial", "shear_y", "shear_z", "torsion", "bending_y", "bending_z"
    compliance = np.diag([1.0 / getattr(found, name) for name in names])
    total = np.zeros((6, 6))
    for node, weight in zip(0.5 * length * (1.0 + POINTS), 0.5 * length * WEIGHTS):
        x, y, z = np.array(end) - place(node)
        lever = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        loads = np.block([[axes(node).T, np.zeros((3, 3))], [axes(node).T @ lever, axes(node).T]])
        total += weight * loads.T @ compliance @ loads
    return total


def ring_axes(s):
    a = s / RADIUS
    return np.array([[np.cos(a), 0.0, -np.sin(a)], [0.0, 1.0, 0.0], [np.sin(a), 0.0, np.cos(a)]])


def ring_place(s):
    a = s / RADIUS
    return RADIUS * np.array([np.sin(a), 0.0, 1.0 - np.cos(a)])


def test_a_quarter_ring_deflects_as_castigliano_says_with_an_error_of_second_order():
    """In its plane and out of it, with the coupling of bending and torsion."""
    exact = castigliano(ring_place, ring_axes, 0.5 * np.pi * RADIUS, RING.to)
    found = SECTION.properties(STEEL)
    bending, torsion, shear, r = found.bending_z, found.torsion, found.shear_y, RADIUS
    out_of_plane = r**3 * (np.pi / 4 / bending + (3 * np.pi / 4 - 2) / torsion) + 0.5 * np.pi * r / shear
    assert exact[1, 1] == pytest.approx(out_of_plane, rel=1e-12)  # Castigliano's theorem by hand
    size = np.sqrt(np.outer(np.diag(exact), np.diag(exact)))
    coarse, fine = ((tip_compliance([RING], rfes) - exact) / size for rfes in (5, 9))
    assert np.abs(coarse[3:, 3:]).max() < 1e-9  # by moments: the sdes' compliances are those of their segments
    assert 0.01 < np.abs(coarse).max() < 0.03
    assert np.abs(coarse).max() / np.abs(fine).max() == pytest.approx(4.0, rel=0.05)


def test_an_angle_of_two_straight_legs_bends_and_twists():
    """One leg turned out of the plane; what a force along the second one does to the first is exact."""
    first, second = 0.15, 0.1
    axis = [AxisPoint((first, 0.0, 0.0)), AxisPoint((first, 0.02, second))]
    found = SECTION.properties(STEEL)
    compliance = tip_compliance(axis, 26)
    along = np.hypot(0.02, second)
    turned = np.array([[1.0, 0, 0], [0, 1.0, 0], [0, 0, 1.0]])
    t = np.array([0.0, 0.02, second]) / along
    y = np.array([0.0, 1.0, 0.0]) - t * t[1]
    y /= np.linalg.norm(y)

    def place(s):
        return np.array([s, 0.0, 0.0]) if s < first else np.array([first, 0.0, 0.0]) + (s - first) * t

    def axes(s):
        return turned if s < first else np.array([t, y, np.cross(t, y)]).T

    exact = castigliano(place, axes, first, axis[-1].to)
    exact = exact + castigliano(lambda s: place(s + first), lambda s: axes(s + first), along, axis[-1].to)
    size = np.sqrt(np.outer(np.diag(exact), np.diag(exact)))
    assert np.abs((compliance - exact) / size).max() < 2e-3
    assert abs(compliance[3, 3] - (first / found.torsion + compliance_of_leg(found, along, t, y))) < 1e-12


def compliance_of_leg(found, along, t, y):
    """Rotation about x by a moment about x of a leg in another direction."""
    x = np.array([1.0, 0.0, 0.0])
    z = np.cross(t, y)
    return along * ((x @ t) ** 2 / found.torsion + (x @ y) ** 2 / found.bending_y + (x @ z) ** 2 / found.bending_z)


def test_bodies_of_a_ring_have_its_mass_its_centre_and_its_inertia():
    """To rounding, with any number of rfes; longer by an error all over."""
    longer = 1.02
    model = clamped([RING], 4)
    length = 0.5 * np.pi * RADIUS
    actual = apply_errors(model, assembly_errors(model, {"beam.length": (longer - 1.0) * length}))
    mass, radius = longer * SECTION.properties(STEEL).line_density * length, longer * RADIUS
    places = np.asarray(actual.centre) + np.concatenate([np.zeros((3, 1)), np.asarray(actual.rest)], axis=1)
    weights = np.asarray(actual.mass)
    assert weights.sum() == pytest.approx(mass, rel=1e-14)
    centre = np.array([2.0 / np.pi, 0.0, 1.0 - 2.0 / np.pi]) * radius
    np.testing.assert_allclose(places @ weights / mass, centre, rtol=1e-13, atol=1e-15)
    whole = np.asarray(actual.inertia).sum(axis=2)
    for m, p in zip(weights, places.T):
        whole += m * (p @ p * np.eye(3) - np.outer(p, p))
    own = longer * STEEL.density * length * SECTION.area / 12.0 * np.array([SECTION.width**2, SECTION.height**2])
    # About the origin: of a line on x the half of R^2, of z 3/2 - 4/pi of it.
    x, z = 0.5 * mass * radius**2, (1.5 - 4.0 / np.pi) * mass * radius**2
    assert whole[1, 1] == pytest.approx(x + z + own[1], rel=1e-13)
    assert whole[0, 0] + whole[2, 2] == pytest.approx(x + z + 2.0 * own[0] + own[1], rel=1e-13)
    assert whole[0, 2] == pytest.approx(-mass * radius**2 / np.pi, rel=2e-3)  # the sections' own part is small


def test_sections_of_a_ring_carry_its_load_in_the_axes_of_the_curve():
    """Its weight, a load along a part of it, and one at its end."""
    end, push, wind = np.array(RING.to), np.array([1.0, -2.0, 3.0]), np.array([0.5, 2.0, -1.0])
    begin, stop = 0.1, 0.25
    forces = [PointForce("push", "beam", RING.to, force=push.tolist()),
              DistributedForce("wind", "beam", wind.tolist(), begin=begin, end=stop)]  # fmt: skip
    beam = Link("beam", section=SECTION, material=STEEL, rfes=4, axis=[RING])
    weight = np.array([0.0, 0.0, -9.81])
    model = discretise(
        Mechanism([beam], [Joint("A", "base", "beam", kind="fixed")], forces=forces, gravity=weight.tolist())
    )
    record = static_loads(model, record=("beam.sections",)).recorded["beam.sections"]
    places = np.asarray(record.place)
    loads = np.asarray(record.resultants).reshape(6, -1)
    density, length = SECTION.properties(STEEL).line_density, 0.5 * np.pi * RADIUS

    def total(s):
        force, moment = push.copy(), np.cross(end - ring_place(s), push)
        for low, high, line in ((s, length, density * weight), (max(s, begin), max(s, stop), wind)):
            for node, factor in zip(POINTS, WEIGHTS):
                x = low + 0.5 * (high - low) * (1.0 + node)
                force = force + 0.5 * (high - low) * factor * line
                moment = moment + 0.5 * (high - low) * factor * np.cross(ring_place(x) - ring_place(s), line)
        return np.concatenate([ring_axes(s).T @ force, ring_axes(s).T @ moment])

    inside = [n for n, s in enumerate(places) if 0.0 < s < length * (1.0 - 1e-6)]
    assert len(inside) >= 4
    for n in inside:
        np.testing.assert_allclose(loads[:, n], total(places[n]), rtol=0, atol=2e-3)


def element_matrices(length, t, y):
    """Stiffness (12, 12) of a straight element of a curve with the direction t and the section's axis y, by the
    compliance of its end, and the mass of either half of it, lumped (6,)."""
    found = SECTION.properties(STEEL)
    axes = np.array([t, y, np.cross(t, y)]).T
    at_end = np.linalg.inv(castigliano(lambda s: s * t, lambda s: axes, length, length * t))
    x, y_, z = length * t
    from_begin = np.eye(6)
    from_begin[:3, 3:] = -np.array([[0, -z, y_], [z, 0, -x], [-y_, x, 0]])
    moved = np.hstack([-from_begin, np.eye(6)])
    inertia = axes @ np.diag([found.rotary_x, found.rotary_y, found.rotary_z]) @ axes.T
    mass = np.zeros((6, 6))
    mass[:3, :3] = 0.5 * length * found.line_density * np.eye(3)
    mass[3:, 3:] = 0.5 * length * inertia
    return moved.T @ at_end @ moved, mass


def ring_frequencies(count):
    """Lowest frequencies [Hz] of the quarter ring, clamped at its begin, by straight beam elements."""
    size = 6 * (count + 1)
    stiffness, mass = np.zeros((size, size)), np.zeros((size, size))
    places = [ring_place(s) for s in np.linspace(0.0, 0.5 * np.pi * RADIUS, count + 1)]
    for n, (a, b) in enumerate(pairwise(places)):
        length = np.linalg.norm(b - a)
        own, half = element_matrices(length, (b - a) / length, np.array([0.0, 1.0, 0.0]))
        at = slice(6 * n, 6 * n + 12)
        stiffness[at, at] += own
        mass[at, at] += np.kron(np.eye(2), half)
    values = np.linalg.eigvals(np.linalg.solve(mass[6:, 6:], stiffness[6:, 6:]))
    return np.sqrt(np.sort(values.real)[:4]) / (2.0 * np.pi)


def test_frequencies_of_a_ring_are_those_of_beam_finite_elements():
    """The first two in its plane and the first two out of it."""
    fine = ring_frequencies(40)
    expected = fine + (fine - ring_frequencies(20)) / 3.0
    modes = natural_frequencies(clamped([RING], 13), count=4)
    assert int(modes.status) == 0
    # The error of a straight beam grows with the number of the mode as well.
    np.testing.assert_array_less(np.abs(np.asarray(modes.frequency) / expected - 1.0), [2e-3, 2e-3, 4e-3, 9e-3])


LENGTH = 0.4
IN_PLANE, ACROSS = SECTION.properties(STEEL).bending_y, SECTION.properties(STEEL).bending_z
AXIAL = SECTION.properties(STEEL).axial


def straight(rfes, form_errors, joints=(), **more):
    beam = Link("beam", LENGTH, SECTION, STEEL, rfes=rfes, form_errors=form_errors)
    kind = "revolute" if joints else "fixed"
    return discretise(Mechanism([beam], [Joint("A", "base", "beam", kind=kind), *joints], gravity=NOTHING, **more))


@pytest.mark.parametrize("elements", ["linear", "geometrically_exact"])
def test_a_bow_of_nothing_leaves_a_link_as_it_is(elements):
    """And only links that are asked for it have forms."""
    plain, bowed = (straight(4, form_errors, elements=elements) for form_errors in (False, True))
    assert plain.form is None and not plain.topology.shaped
    assert set(bowed.topology.error_names) - set(plain.topology.error_names) == {"beam.bow_y", "beam.bow_z"}
    one, other = (apply_errors(model, assembly_errors(model, {"beam.length": 3e-3})) for model in (plain, bowed))
    for name in ("mass", "centre", "inertia"):
        expected = np.asarray(getattr(one, name))
        scale = np.abs(expected).max()
        np.testing.assert_allclose(getattr(other, name), expected, rtol=1e-14, atol=1e-14 * scale)
    np.testing.assert_allclose(np.einsum("iik->ik", other.stiffness), one.stiffness, rtol=1e-14)
    assert np.all(np.asarray(other.stiffness)[~np.eye(6, dtype=bool)] == 0.0)
    np.testing.assert_allclose(other.rest[0], one.rest, rtol=1e-14)
    np.testing.assert_allclose(other.lever_right[0], one.lever_right, rtol=1e-14)
    assert np.all(np.asarray(other.rest)[1:] == 0.0)


def hinged(rfes, form_errors=True, **more):
    """A beam between two hinges about y on the base."""
    return straight(rfes, form_errors, [Joint("B", "base", "beam", position=(LENGTH, 0, 0), cut=True)], **more)


@pytest.mark.long
@pytest.mark.parametrize("elements", ["linear", "geometrically_exact"])
def test_preload_of_a_bowed_link_between_hinges(elements):
    """It is too long by delta, and softer by its bow b: in the plane N = delta / (L / EA + b^2 L / (2 E I_y)) with N b
    in the middle; across it the hinges clamp it, with moments 2 N b / pi at its ends (three-moment equation)."""
    model = hinged(10, elements=elements)
    delta, b = 1e-6, 5e-3
    soft = {
        "bow_z": LENGTH / AXIAL + b**2 * LENGTH / (2.0 * IN_PLANE),
        "bow_y": LENGTH / AXIAL + b**2 * LENGTH * (0.5 - 4.0 / np.pi**2) / ACROSS,
    }
    for bow, expected in soft.items():
        found = static_loads(model, {"beam.length": delta, f"beam.{bow}": b}, record=("beam.sections",))
        loads = found.recorded["beam.sections"]
        place, of_sections = np.asarray(loads.place), np.asarray(loads.resultants).reshape(6, -1)
        force = delta / expected
        middle = of_sections[:, np.argmin(np.abs(place - 0.5 * LENGTH))]
        assert middle[0] == pytest.approx(-force, rel=6e-3 if bow == "bow_z" else 0.015)
        moment = np.abs(np.asarray(found.loads["B"].moment)).max()
        if bow == "bow_z":
            assert abs(middle[4]) == pytest.approx(force * b, rel=6e-3)
            assert moment < 1e-6 * force * b
        else:
            assert moment == pytest.approx(2.0 * force * b / np.pi, rel=0.03)
            assert abs(middle[5]) == pytest.approx(force * b * (1.0 - 2.0 / np.pi), rel=0.03)


@pytest.mark.long
def test_derivatives_at_no_bow_in_both_modes():
    """The moment in the middle grows with the bow by the force, which does not."""
    model, delta = hinged(4), 1e-8
    force = AXIAL * delta / LENGTH

    def values(bows):
        found = static_loads(
            model, {"beam.length": delta, "beam.bow_y": bows[0], "beam.bow_z": bows[1]}, record=("beam.sections",)
        )
        loads = found.recorded["beam.sections"].resultants.reshape(6, -1)[:, :3]
        return jax.numpy.concatenate([loads[4:, 1], loads[:1, 1] / LENGTH])

    found = check_derivatives(values, np.zeros(2), np.full(2, 1e-5), reverse=1e-9, differences=1e-5, floor=1e-3)
    assert abs(found.forward[0, 1]) == pytest.approx(force, rel=1e-4)
    assert np.abs(found.forward[2]).max() < 1e-6 * force / LENGTH


NAMES = "beam.axis.1.to.x", "beam.axis.1.through.z", "beam.axis.2.to.z", "beam.axis.2.radius", "beam.axis.3.roll"


@pytest.mark.long
def test_derivatives_by_points_of_an_axis():
    axis = [
        AxisPoint((0.1, 0.0, 0.02), through=(0.05, 0.01, -0.01)),
        AxisPoint((0.2, 0.0, 0.0), radius=0.03),
        AxisPoint((0.3, 0.02, 0.1), roll=0.3),
    ]
    model = clamped(axis, 4)
    weights = np.random.default_rng(0).uniform(0.5, 1.5, 400)

    def values(numbers):
        made = designed(model, None, dict(zip(NAMES, numbers, strict=True)))
        actual = apply_errors(made.model, made.errors)
        scaled = actual.stiffness / jax.numpy.abs(actual.stiffness).mean(axis=2, keepdims=True)
        parts = actual.mass, 10.0 * actual.rest, 1e5 * actual.inertia, scaled, 10.0 * actual.bore_position
        return jax.numpy.stack([part.reshape(-1) @ weights[: part.size] for part in parts])

    check_derivatives(values, np.zeros(5), np.full(5, 1e-6), reverse=1e-9, differences=1e-5, floor=1e-3)


def test_a_smooth_axis_leads_through_its_points():
    """A ring's spline differs from it by the fourth power of the distance of its points."""
    lengths = []
    for n in (4, 8):
        angles = 0.5 * np.pi * np.arange(1, n + 1) / n
        points = [AxisPoint(tuple(float(x) for x in ring_place(RADIUS * a))) for a in angles]
        link = Link("beam", section=SECTION, material=STEEL, axis=points, smooth=True)
        lengths.append(abs(link.length / (0.5 * np.pi * RADIUS) - 1.0))
        at = link.curve.nearest(np.array(points[1].to)[:, None])
        np.testing.assert_allclose(link.curve.at(at).position[:, 0], points[1].to, atol=1e-12)
    assert lengths[0] < 1e-3
    assert lengths[1] < lengths[0] / 10.0


@pytest.mark.parametrize(
    ("more", "words"),
    [
        ({"axis": [AxisPoint((0.1, 0, 0)), AxisPoint((0.1, 0, 0))]}, "point 2 is where the one before is"),
        ({"axis": [AxisPoint((0.1, 0, 0), through=(0.05, 0, 0))]}, "that of point 1 is on it"),
        ({"axis": [AxisPoint((0.1, 0, 0), radius=0.01)]}, "`radius` at a corner"),
        ({"axis": [AxisPoint((0.1, 0, 0), radius=0.2), AxisPoint((0.1, 0, 0.1))]}, "with the radius 0.2 m does not"),
        ({"axis": [AxisPoint((0.1, 0, 0), through=(0.05, 0, 0.1))], "smooth": True}, "no `through` where the axis is"),
        ({"axis": "all"}, "must be a list of AxisPoint"),
        ({"axis": [AxisPoint((0.1, 0, 0))], "length": 0.3}, "`length` of link `beam` must be left out"),
        ({"axis": [AxisPoint((0.1, 0, 0))], "form_errors": True}, "`form_errors` of link `beam` must be left out"),
        ({"length": 0.1, "smooth": True}, "`smooth` of link `beam` must be left out"),
        ({"axis": [AxisPoint((0.1, 0, 0))], "temperature_gradient_y": 1.0}, "along which it would change"),
        ({}, "`length` of link `beam`"),
    ],
)
def test_forms_that_cannot_be_are_refused(more, words):
    with pytest.raises(InputError, match=words):
        Link("beam", section=SECTION, material=STEEL, thermal_expansion=1e-5, **more)


def test_an_axis_along_the_hinges_is_refused():
    with pytest.raises(InputError, match="must not lead along y"):
        clamped([AxisPoint((0.1, 0, 0)), AxisPoint((0.1, 0.1, 0))], 4)
