"""Sections of any outline: exact constants, given and computed ones of torsion and shear, and what is refused."""

import dataclasses
import math

import jax
import numpy as np
import pytest

from rfem_jax import (
    AngleSection,
    InputError,
    Joint,
    Link,
    Mechanism,
    PolygonSection,
    Rectangle,
    Station,
    discretise,
    parameters,
    static_loads,
)
from rfem_jax.description.mechanism import polygons
from rfem_jax.description.mechanism.shear_flows import shear_flow
from tests.mechanisms import BAR, STEEL

WIDTH, HEIGHT, WALL = 0.03, 0.04, 0.002
GIVEN = {"torsion": 1e-9, "shear_factor_y": 1.3, "shear_factor_z": 1.2, "shear_centre": (0.0, 0.0)}


def angle_points(wall=WALL):
    return [(0, 0), (WIDTH, 0), (WIDTH, wall), (wall, wall), (wall, HEIGHT), (0, HEIGHT)]


def matrix(section):
    return np.array(section.properties(STEEL).matrix)


def test_a_rectangle_and_an_angle_are_those_of_their_sizes():
    """In any place, and whichever way its corners are run through."""
    moved = [(0.1 + y, z - 0.2) for y, z in ((0, 0), (0, BAR.height), (BAR.width, BAR.height), (BAR.width, 0))]
    for points, twin, centre, factors in (
        (moved, BAR, (0.1 + 0.5 * BAR.width, 0.5 * BAR.height - 0.2), (BAR.kappa, 0.0, BAR.kappa)),
        (angle_points(), AngleSection(WIDTH, HEIGHT, WALL), (0.5 * WALL, 0.5 * WALL), None),
    ):
        kappa_y, kappa_yz, kappa_z = factors or shear_flow(twin.walls).factors
        section = PolygonSection(points, twin.torsion_constant, kappa_y, kappa_z, kappa_yz, centre)
        assert section.area == pytest.approx(twin.area, rel=1e-12)
        found, expected = section.properties(STEEL), twin.properties(STEEL)
        for name in ("axial", "line_density", "rotary_x", "rotary_y", "rotary_z", "bending_y", "bending_z", "damping"):
            assert getattr(found, name) == pytest.approx(getattr(expected, name), rel=1e-10), name
        if factors is None:
            whole = np.array(expected.matrix)
            np.testing.assert_allclose(matrix(section), whole, rtol=0, atol=1e-9 * np.sqrt(np.abs(whole).max()))
            assert found.product == pytest.approx(expected.product, rel=1e-10)
        else:
            names = "axial", "shear_y", "shear_z", "torsion", "bending_y", "bending_z"
            plain = [getattr(expected, name) for name in names]
            size = np.sqrt(np.outer(plain, plain))
            np.testing.assert_allclose(matrix(section) / size, np.eye(6), rtol=0, atol=1e-10)


def test_second_moments_turn_as_a_tensor():
    """Of an irregular polygon against sums over the small triangles that it is divided into."""
    points = [(0, 0), (0.03, -0.004), (0.041, 0.012), (0.02, 0.01), (0.007, 0.03)]
    section = PolygonSection(points, **GIVEN)
    corners, centre = np.array(points), np.array(section.centroid)
    tensor, area, first = np.zeros((2, 2)), 0.0, np.zeros(2)
    for a, b in zip(corners, np.roll(corners, -1, axis=0)):  # triangles with the origin, signed; by their middles
        part = 0.5 * (a[0] * b[1] - b[0] * a[1])
        area, first = area + part, first + part * (a + b) / 3.0
        for middle in (0.5 * a, 0.5 * b, 0.5 * (a + b)):  # exact for polynomials of second order
            tensor += part / 3.0 * np.outer(middle - centre, middle - centre)
    assert section.area == pytest.approx(area, rel=1e-12)
    np.testing.assert_allclose(centre, first / area, rtol=1e-12)
    found = [section.second_moment_z, section.product_of_inertia, section.second_moment_y]
    np.testing.assert_allclose(found, [tensor[0, 0], tensor[0, 1], tensor[1, 1]], rtol=1e-10)


def test_the_scale_multiplies_all_sizes():
    """Those that are given, too; and it has derivatives."""
    points, scale = angle_points(), 1.3
    one = PolygonSection(points, 1e-10, 2.9, 2.0, 0.03, (1e-3, 2e-3), torsion_modulus=1e-8)
    larger = [(scale * y, scale * z) for y, z in points]
    other = PolygonSection(larger, 1e-10 * scale**4, 2.9, 2.0, 0.03, (1.3e-3, 2.6e-3), torsion_modulus=1e-8 * scale**3)
    np.testing.assert_allclose(matrix(dataclasses.replace(one, scale=scale)), matrix(other), rtol=1e-12, atol=1e-9)
    np.testing.assert_allclose(
        dataclasses.replace(one, scale=scale).edge_stresses(), other.edge_stresses(), rtol=1e-9, atol=1e-3
    )

    def torsion(factor):
        return one.with_fields(scale=factor).properties(STEEL).matrix[4][4]

    slope = jax.grad(torsion)(1.0)
    assert slope == pytest.approx(4.0 * torsion(1.0), rel=1e-12)


def test_what_is_missing_is_computed_by_finite_elements():
    """Torsion of an equilateral triangle; all of an L, whose walls are thin; shear factors turn as a tensor."""
    pytest.importorskip("sectionproperties")
    side = 0.02
    triangle = PolygonSection([(0, 0), (side, 0), (0.5 * side, 0.5 * math.sqrt(3.0) * side)])
    assert triangle.torsion == pytest.approx(math.sqrt(3.0) / 80.0 * side**4, rel=1e-4)
    np.testing.assert_allclose(triangle.from_centroid, 0.0, atol=1e-6 * side)
    flat = PolygonSection([(0, 0), (0.01, 0), (0.01, 0.016), (0, 0.016)])
    assert (flat.shear_factor_y, flat.shear_factor_z) == pytest.approx((1.2, 1.2), rel=1e-4)
    assert flat.torsion == pytest.approx(Rectangle(0.01, 0.016).torsion_constant, rel=3e-3)
    corner, twin = PolygonSection(angle_points()), AngleSection(WIDTH, HEIGHT, WALL)
    assert corner.torsion == pytest.approx(twin.torsion_constant, rel=0.01)
    np.testing.assert_allclose(corner.from_centroid, twin.shear_centre, atol=1e-4)
    assert (corner.shear_factor_y, corner.shear_factor_z) == pytest.approx(twin.kappas, rel=0.04)
    c, s = math.cos(0.35), math.sin(0.35)
    turned = PolygonSection([(c * y - s * z, s * y + c * z) for y, z in angle_points()])
    tensors = [np.array([[one.shear_factor_y, one.shear_factor_yz], [one.shear_factor_yz, one.shear_factor_z]])
               for one in (corner, turned)]  # fmt: skip
    turn = np.array([[c, -s], [s, c]])
    np.testing.assert_allclose(tensors[1], turn @ tensors[0] @ turn.T, atol=2e-3)


def test_without_the_package_a_sentence_says_what_is_missing(monkeypatch):
    def missing(name):
        raise ImportError(name)

    monkeypatch.setattr(polygons, "import_module", missing)
    polygons.by_finite_elements.cache_clear()
    words = r"`shear_centre` of PolygonSection must be given where .* rfem_jax\[sections\]"
    with pytest.raises(InputError, match=words):
        PolygonSection(angle_points(), **{**GIVEN, "shear_centre": None})
    PolygonSection(angle_points(), **GIVEN)


@pytest.mark.parametrize(
    ("points", "words"),
    [
        ([(0, 0), (1, 0)], "at least three corners"),
        ([(0, 0), (1, 0), 3], "must be two numbers"),
        ([(0, 0), (1, 0), (2, 0)], "on one line"),
        ([(0, 0), (1, 1), (1, 0), (0, 1)], "sides cross each other"),
        ([(0, 0), (1, 1), (1, 0), (0, 1.5)], "sides 1 and 3 do"),
        ([(0, 0), (1, 0), (1, 0), (0, 1)], "has no length"),
        ([(0, 0), (1, 0), (1, 2), (1, 1), (0, 1)], "sides 2 and 3 do"),
        ([(0, 0), (1, 0), (0.5, 0), (0, 1)], "sides 1 and 2 do"),
    ],
)
def test_outlines_that_cannot_be_are_refused(points, words):
    with pytest.raises(InputError, match=words):
        PolygonSection(points, **GIVEN)


def test_corners_are_no_parameters_and_tapers_change_the_scale():
    bar = PolygonSection(angle_points(), **GIVEN, name="bar")
    arm = Link("arm", 0.3, bar, STEEL, rfes=3)
    model = discretise(Mechanism([arm], [Joint("A", "base", "arm", kind="fixed")]))
    assert "bar.scale" in parameters(model)
    with pytest.raises(InputError, match="`bar.points.1.y` is a corner of a polygon, .* change its `scale`"):
        static_loads(model, {"bar.points.1.y": 1e-4})
    with pytest.raises(InputError, match="must be known numbers, since torsion and shear"):
        jax.grad(lambda y: PolygonSection([(y, 0.0), *angle_points()[1:]], **GIVEN).area)(0.0)
    half = dataclasses.replace(bar, scale=0.5)
    taper = Link("arm", 0.3, bar, STEEL, stations=[Station(section=half)])
    assert taper.mass == pytest.approx(STEEL.density * bar.area * 0.3 * (1.0 + 0.5 + 0.25) / 3.0, rel=1e-12)
    with pytest.raises(InputError, match="must change the scale of a polygon alone"):
        Link("arm", 0.3, bar, STEEL, stations=[Station(section=PolygonSection(angle_points(0.003), **GIVEN))])
    with pytest.raises(InputError, match="`shear_factor_yz` of PolygonSection must be less"):
        PolygonSection(angle_points(), **GIVEN, shear_factor_yz=1.3)
