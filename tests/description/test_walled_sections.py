"""Sections of flat walls against tables of rolled sections, closed forms and, where installed, finite elements."""

import math

import numpy as np
import pytest

from rfem_jax import AngleSection, ChannelSection, HollowRectangle, InputError, ISection, Link, Material, TeeSection
from rfem_jax.description.mechanism.shear_flows import Wall, shear_flow
from rfem_jax.description.mechanism.walled_sections import cowper_factor
from rfem_jax.report.contents.overview import section_text

STEEL = Material("steel", "210 GPa", 7850.0, poisson_ratio=0.3)
SECTIONS = {
    "box": HollowRectangle(0.06, 0.1, 0.008),
    "i": ISection(0.06, 0.1, 0.005, 0.008),
    "channel": ChannelSection(0.05, 0.1, 0.005, 0.007),
    "angle": AngleSection(0.06, 0.1, 0.006),
    "tee": TeeSection(0.06, 0.08, 0.005, 0.007),
}


def outline(name):
    """Corners (y, z) of a section, those of a hole behind them."""
    s = SECTIONS[name]
    b, h = s.width, s.height
    if name == "box":
        t = s.wall
        return [(0, 0), (b, 0), (b, h), (0, h)], [(t, t), (b - t, t), (b - t, h - t), (t, h - t)]
    if name == "angle":
        t = s.wall
        return [(0, 0), (b, 0), (b, t), (t, t), (t, h), (0, h)], None
    w, f = s.web, s.flange
    if name == "channel":
        return [(0, 0), (b, 0), (b, f), (w, f), (w, h - f), (b, h - f), (b, h), (0, h)], None
    a, c = (b - w) / 2, (b + w) / 2
    if name == "tee":
        return [(a, 0), (c, 0), (c, h - f), (b, h - f), (b, h), (0, h), (0, h - f), (a, h - f)], None
    top = [(c, h - f), (b, h - f), (b, h), (0, h), (0, h - f), (a, h - f)]
    return [(0, 0), (b, 0), (b, f), (c, f), *top, (a, f), (0, f)], None


def polygon_moments(corners):
    """Area, first moments and second moments about the origin, by Green's theorem."""
    (y, z), (v, w) = np.array(corners).T, np.roll(np.array(corners), -1, axis=0).T
    cross = y * w - v * z
    return np.array([
        cross.sum() / 2, ((y + v) * cross).sum() / 6, ((z + w) * cross).sum() / 6,
        ((z * z + z * w + w * w) * cross).sum() / 12, ((y * y + y * v + v * v) * cross).sum() / 12,
        ((y * w + 2 * y * z + 2 * v * w + v * z) * cross).sum() / 24,
    ])  # fmt: skip


@pytest.mark.parametrize("name", SECTIONS)
def test_areas_and_second_moments_are_those_of_the_outline(name):
    outside, hole = outline(name)
    found = polygon_moments(outside) - (0.0 if hole is None else polygon_moments(hole))
    area, y, z = found[0], found[1] / found[0], found[2] / found[0]
    section = SECTIONS[name]
    assert section.area == pytest.approx(area, rel=1e-12)
    assert section.second_moment_y == pytest.approx(found[3] - area * z * z, rel=1e-12)
    assert section.second_moment_z == pytest.approx(found[4] - area * y * y, rel=1e-12)
    if name in ("channel", "angle", "tee"):
        expected = found[5] - area * y * z
        assert section.product_of_inertia == pytest.approx(expected, abs=1e-12 * found[3])


def fillets(count, radius, height):
    """Area of fillets, and what they add to I_y, where the flanges end at a height from the middle."""
    area = count * (1.0 - math.pi / 4.0) * radius**2
    return area, area * (height - 0.2234 * radius) ** 2


def test_tables_of_rolled_sections():
    """IPE 200 and UPE 200 of EN 10365 with their fillets; SHS 100 x 5 of EN 10210, whose corners are round. [cm]"""
    ipe, upe, box = ISection(10.0, 20.0, 0.56, 0.85), ChannelSection(8.0, 20.0, 0.6, 1.1), HollowRectangle(10, 10, 0.5)
    area, moment = fillets(4, 1.2, 9.15)
    assert ipe.area + area == pytest.approx(28.5, rel=2e-3)
    assert ipe.second_moment_y + moment == pytest.approx(1943.0, rel=2e-3)
    assert ipe.second_moment_z == pytest.approx(142.0, rel=0.01)
    assert 0.6 * 6.98 < ipe.torsion_constant < 6.98
    area, moment = fillets(2, 1.3, 8.9)
    assert upe.area + area == pytest.approx(29.0, rel=2e-3)
    assert upe.second_moment_y + moment == pytest.approx(1910.0, rel=5e-3)
    assert upe.second_moment_z == pytest.approx(187.0, rel=0.02)
    assert upe.centroid[0] == pytest.approx(2.56, rel=0.02)
    assert -upe.shear_centre[0] == pytest.approx(5.41, rel=0.03)
    assert box.second_moment_y == pytest.approx(279.0, rel=0.03)
    assert box.torsion_constant == pytest.approx(439.0, rel=0.02)


def test_a_thin_channel_has_the_shear_centre_and_the_factor_of_closed_forms():
    width, height, web, flange = 0.05, 0.1, 0.0004, 0.0006
    section = ChannelSection(width, height, web, flange)
    b, h = width - web / 2, height - flange
    from_web = 3.0 * b**2 * flange / (h * web + 6.0 * b * flange)
    assert section.shear_centre[0] + section.centroid[0] == pytest.approx(web / 2 - from_web, rel=1e-9)
    # Half an I whose flanges are twice as wide has its flow.
    along_z = cowper_factor(2.0 * b * flange / (h * web), 2.0 * b / h)
    assert section.kappas[1] == pytest.approx(along_z, rel=1e-9)


def test_shear_flow_of_an_i_is_cowpers_formula():
    b, h, web, flange = 0.06, 0.09, 0.004, 0.007
    half = [((side * b / 2, z), (0.0, z)) for z in (-h / 2, h / 2) for side in (1, -1)]
    lower = [Wall(*half[0], flange, b / 2), Wall(*half[1], flange, b / 2)]
    middle = Wall((0.0, -h / 2), (0.0, h / 2), web, h, (0, 1))
    # Beyond the web the flow leaves by two flanges whose ends are free, half by each.
    upper = [Wall(*half[2], flange, b / 2), Wall(*half[3], flange, b / 2)]
    flow = shear_flow([*lower, middle, *upper])
    assert flow.centre == pytest.approx((0.0, 0.0), abs=1e-12)
    ky, kyz, kz = flow.factors
    assert kz == pytest.approx(cowper_factor(2.0 * b * flange / (h * web), b / h), rel=1e-12)
    assert kyz == pytest.approx(0.0, abs=1e-12)
    assert ky == pytest.approx(1.2 * (2.0 * b * flange + h * web) / (2.0 * b * flange), rel=1e-12)


def test_thin_walls_twist_as_bredt_and_as_strips():
    t = 1e-4
    box, angle = HollowRectangle(0.05, 0.08, t), AngleSection(0.05, 0.08, t)
    assert box.torsion_constant == pytest.approx(2 * t * (0.05 * 0.08) ** 2 / 0.13, rel=6e-3)
    assert angle.torsion_constant == pytest.approx(0.13 * t**3 / 3, rel=3e-3)


def test_given_shear_factors_count():
    plain, given = ISection(0.06, 0.1, 0.005, 0.008), ISection(0.06, 0.1, 0.005, 0.008, 2.0, 3.0)
    stiffness = STEEL.modulus_of_rigidity * given.area
    properties = given.properties(STEEL)
    assert properties.shear_y == pytest.approx(stiffness / 2.0)
    assert properties.shear_z == pytest.approx(stiffness / 3.0)
    assert plain.properties(STEEL).shear_z != properties.shear_z
    channel = ChannelSection(0.05, 0.1, 0.005, 0.007, shear_factor_z=4.0)
    shear = STEEL.modulus_of_rigidity * channel.area / 4.0
    assert channel.properties(STEEL).matrix[2][2] == pytest.approx(shear)


@pytest.mark.parametrize(
    ("build", "words"),
    [
        (lambda: HollowRectangle(0.02, 0.03, 0.01), "`wall` of HollowRectangle must be less than half of the smaller"),
        (lambda: ISection(0.02, 0.03, 0.011, 0.008), "`web` of ISection must be less than half of the width"),
        (lambda: ISection(0.02, 0.03, 0.006, 0.002), "`web` of ISection must be less than .* twice `flange`"),
        (lambda: ChannelSection(0.02, 0.03, 0.001, 0.005), "`flange` of ChannelSection .* four times `web`"),
        (lambda: TeeSection(0.02, 0.03, 0.008, 0.016), "`flange` of TeeSection must be less than half of the height"),
        (lambda: AngleSection(0.02, 0.03, 0.02), "`wall` of AngleSection must be less than the shorter leg"),
        (lambda: ISection("20 mm", "30 s", 0.002, 0.003), "`height` of ISection must be a length"),
        (lambda: AngleSection(0.02, 0.03, -0.002), "`wall` of AngleSection must be greater than 0"),
    ],
)
def test_walls_that_cannot_be_are_refused(build, words):
    with pytest.raises(InputError, match=words):
        build()


def test_sections_are_told_with_their_sizes():
    assert section_text(SECTIONS["i"]) == "I section, width 60 mm, height 100 mm, web 5 mm, flange 8 mm"
    assert section_text(SECTIONS["box"]) == "hollow rectangle, width 60 mm, height 100 mm, wall 8 mm"
    assert Link("a", 0.5, SECTIONS["angle"], STEEL).mass == pytest.approx(7850 * 0.5 * 0.154 * 0.006)


def test_torsion_stress_at_the_edge():
    """T t / J of a flange, and T / (2 A_m t) of a box."""
    i, box = SECTIONS["i"], SECTIONS["box"]
    assert max(point[3] for point in i.edge_stresses()) == pytest.approx(0.008 / i.torsion_constant)
    assert box.edge_stresses()[0][3] == pytest.approx(1.0 / (2 * 0.052 * 0.092 * 0.008))
    bending = max(point[1] for point in i.edge_stresses())
    assert bending == pytest.approx(0.05 / i.second_moment_y)


@pytest.mark.parametrize("name", SECTIONS)
def test_finite_elements_give_the_constants(name):
    """Walls of a tenth of the sides: torsion within 1 % and more, shear of thin walls within 12 %."""
    geometry = pytest.importorskip("sectionproperties.pre").Geometry
    polygon = pytest.importorskip("shapely").Polygon
    outside, hole = outline(name)
    shape = geometry(polygon(outside, None if hole is None else [hole]))
    shape.create_mesh([shape.geom.area / 800])
    found = pytest.importorskip("sectionproperties.analysis").Section(shape)
    found.calculate_geometric_properties()
    found.calculate_warping_properties()
    section = SECTIONS[name]
    assert section.torsion_constant == pytest.approx(found.get_j(), rel=0.002 if name == "box" else 0.02)
    area_y, area_z = found.get_as()
    kappas = np.array([found.get_area() / area_y, found.get_area() / area_z])
    np.testing.assert_allclose(section.kappas, kappas, rtol=0.14)
    if hasattr(section, "shear_centre"):
        (y, z), (y_s, z_s) = found.get_c(), found.get_sc()
        size = math.hypot(section.width, section.height)
        np.testing.assert_allclose(section.shear_centre, (y_s - y, z_s - z), atol=0.02 * size)
