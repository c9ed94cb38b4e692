"""Measured shapes of links: a bow that is given by its offsets, and cubic ones against closed forms."""

import jax
import numpy as np
import pytest

from rfem_jax import (
    CamberPoint,
    InputError,
    Joint,
    Link,
    Mechanism,
    PointMass,
    Rectangle,
    assembly_errors,
    discretise,
    parameters,
    static_loads,
)
from rfem_jax.mechanics.model.planar_loops import opening
from rfem_jax.mechanics.model.with_errors import apply_errors
from rfem_jax.mechanics.statics.designs import designed
from tests.derivatives import check_derivatives
from tests.mechanics.test_planar_loops import rigid_links
from tests.mechanisms import STEEL, two_loop_six_bar

LENGTH = 0.4
SECTION = Rectangle(0.01, 0.016)
FOUND = SECTION.properties(STEEL)
NOTHING = (0.0, 0.0, 0.0)


def bar(rfes, joints, **more):
    beam = Link("beam", LENGTH, SECTION, STEEL, rfes=rfes, **more)
    return discretise(Mechanism([beam], [Joint("A", "base", "beam"), *joints], gravity=NOTHING))


def held_at(name, x, kind="revolute"):
    return Joint(name, "base", "beam", kind=kind, position=(x, 0, 0), child_position=(x, 0, 0), cut=True)


@pytest.mark.long
def test_a_bow_that_is_given_as_a_camber_is_that_bow():
    """Places, masses, stiffnesses and frames of joints, all but for the spline's error; with another bow beside it."""
    b, places = np.array([3e-3, -2e-3]), LENGTH * np.arange(1, 20) / 20.0
    offsets = b[:, None] * np.sin(np.pi * places / LENGTH)
    points = [CamberPoint(*map(float, one)) for one in (*zip(places, *offsets, strict=True),)]
    joints, masses = [held_at("M", 0.13), held_at("B", LENGTH)], [PointMass(0.1, (0.27, 0.01, 0.0))]
    bowed = bar(5, joints, point_masses=masses, form_errors=True)
    measured = bar(5, joints, point_masses=masses, camber=points)
    more = {"beam.length": 1e-3, "beam.bow_y": 1e-3, "beam.twist": 0.01}
    both = more | {"beam.bow_y": 1e-3 + b[0], "beam.bow_z": b[1]}
    straight, found, expected = (
        apply_errors(model, assembly_errors(model, errors))
        for model, errors in ((bowed, more), (measured, more), (bowed, both))
    )
    for name in ("rest", "lever_left", "lever_right", "mass", "centre", "inertia", "stiffness", "bore_position"):
        before, one, other = (np.asarray(getattr(actual, name)) for actual in (straight, found, expected))
        effect = np.abs(other - before).max()
        assert effect > 0.0
        np.testing.assert_allclose(one, other, rtol=0, atol=2e-4 * effect, err_msg=name)
    places = jax.numpy.asarray(np.linspace(0.01, 0.39, 7))
    for one, other in zip(found.form.at(0, places), expected.form.at(0, places), strict=True):
        np.testing.assert_allclose(one, other, rtol=0, atol=1e-5)


def cubic(x):
    return 300.0 * x * (LENGTH - x) * (0.1 + x)  # mm


POINTS = [CamberPoint(x, z=1e-3 * cubic(x)) for x in (0.1, 0.15, 0.3)]


@pytest.mark.long
def test_preload_of_a_link_of_a_measured_shape():
    """A spline is exact for a cubic shape w; too long by delta and held at both ends the link carries
    delta / (L/EA + int w^2 ds / EI), with N w(x) at every section."""
    delta = 1e-8
    nodes, weights = np.polynomial.legendre.leggauss(8)
    x = 0.5 * LENGTH * (1.0 + nodes)
    square = 0.5 * LENGTH * weights @ (1e-3 * cubic(x)) ** 2
    force = delta / (LENGTH / FOUND.axial + square / FOUND.bending_y)
    assert square / FOUND.bending_y > 0.02 * LENGTH / FOUND.axial
    model = bar(10, [held_at("B", LENGTH)], camber=POINTS)
    record = static_loads(model, {"beam.length": delta}, record=("beam.sections",)).recorded["beam.sections"]
    place, of_sections = np.asarray(record.place), np.asarray(record.resultants).reshape(6, -1)
    inside = (place > 0.0) & (place < LENGTH * (1.0 - 1e-6))
    place, of_sections = place[inside], of_sections[:, inside]
    assert len(place) >= 8
    np.testing.assert_allclose(of_sections[0], -force, rtol=3e-3)
    bending = force * 1e-3 * np.abs(cubic(place))
    np.testing.assert_allclose(np.abs(of_sections[4]), bending, rtol=3e-3, atol=1e-6 * force)


@pytest.mark.long
def test_a_joint_on_a_measured_link_is_displaced_and_loads_it():
    """A support in the middle of a beam on two others: 48 E I w / L^3, by the three-moment equation; by its derivative
    by the offset there the same, in both modes."""
    middle = CamberPoint(0.5 * LENGTH, z=1e-5)
    model = bar(9, [held_at("M", 0.5 * LENGTH), held_at("B", LENGTH)], camber=[middle])
    expected = 48.0 * FOUND.bending_y / LENGTH**3

    def force(offsets):
        errors = {"beam.camber.1.z": offsets[0], "beam.camber.1.x": offsets[1]}
        return jax.numpy.stack([static_loads(model, errors).loads["M"].force.reshape(3)[2] / expected])

    assert abs(float(force(np.zeros(2))[0])) == pytest.approx(1e-5, rel=0.04)  # shear, and four segments to a span
    found = check_derivatives(force, np.zeros(2), np.array([1e-6, 1e-5]), reverse=1e-8, differences=1e-4, floor=1e-3)
    assert abs(found.forward[0, 0]) == pytest.approx(1.0, rel=0.04)


NAMES = [f"beam.camber.{n}.{axis}" for n in (1, 2, 3) for axis in "xyz"]


@pytest.mark.long
def test_derivatives_by_all_numbers_of_a_camber():
    mass = PointMass(0.1, (0.25, 0.0, 0.01))
    points = [point.with_fields(y=y) for point, y in zip(POINTS, (1e-3, -2e-3, 1.5e-3), strict=True)]
    model = bar(4, [], camber=points, thermal_expansion=1e-5, temperature=10.0, point_masses=[mass])
    assert {*NAMES} <= {*parameters(model)}
    weights = np.random.default_rng(0).uniform(0.5, 1.5, 400)

    def values(numbers):
        made = designed(model, None, dict(zip(NAMES, numbers, strict=True)))
        actual = apply_errors(made.model, made.errors)
        scaled = actual.stiffness / jax.numpy.abs(actual.stiffness).mean(axis=2, keepdims=True)
        parts = actual.mass, 10.0 * actual.rest, 1e5 * actual.inertia, 1e-3 * scaled, 10.0 * actual.centre
        return jax.numpy.stack([part.reshape(-1) @ weights[: part.size] for part in parts])

    check_derivatives(values, np.zeros(9), np.full(9, 3e-7), reverse=1e-9, differences=1e-5, floor=1e-3)


def test_a_camber_across_the_plane_opens_a_loop_of_rigid_links_where_a_joint_is():
    mechanism = rigid_links(two_loop_six_bar())
    links = [one.with_fields(camber=(CamberPoint(0.1),), form_errors=True) if one.name in ("coupler", "rocker") else one
             for one in mechanism.links]  # fmt: skip
    model = discretise(Mechanism(links, mechanism.joints, driven_joint="A"))
    names = [f"link.{link}.camber.1.{axis}" for link in ("coupler", "rocker") for axis in "yz"]
    assert [*opening(model, names)] == ["link.rocker.camber.1.y"]


@pytest.mark.parametrize(
    ("more", "words"),
    [
        ({"camber": [CamberPoint(0.3), CamberPoint(0.2)]}, "`camber` of link `beam` must have points that follow each"),
        ({"camber": [CamberPoint(0.4)]}, "leave out the ends, from whose line"),
        ({"camber": [(0.1, 0.0)]}, "must be a list of CamberPoint"),
        ({"camber": [CamberPoint(0.1)], "axis": "all"}, "must be a list of AxisPoint"),
    ],
)
def test_cambers_that_cannot_be_are_refused(more, words):
    with pytest.raises(InputError, match=words):
        Link("beam", LENGTH, SECTION, STEEL, **more)
