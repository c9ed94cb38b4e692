"""Materials and sections: properties against theory, refusals."""

import math
from dataclasses import astuple, replace

import numpy as np
import pytest

from rfem_jax import Circle, GivenSection, Material, Rectangle, Tube

STEEL = Material("steel", "210 GPa", 7850.0, poisson_ratio=0.3, damping=1e-5)
GIVEN = {
    "axial_stiffness": 52.99e6,
    "shear_stiffness_y": 16.88e6,
    "shear_stiffness_z": "16.9 MN",
    "torsion_stiffness": 733.5,
    "bending_stiffness_y": 1131.0,
    "bending_stiffness_z": "1132 N m^2",
    "line_density": 1.997,
    "rotary_inertia_x": 85.2e-6,
    "rotary_inertia_y": 42.6e-6,
    "rotary_inertia_z": 42.6e-6,
    "damping": "10 us",
}


def exact_torsion_constant(long, short):
    """Saint-Venant's series for a rectangle."""
    k = np.arange(1, 400, 2)
    terms = np.tanh(k * math.pi * long / (2 * short)) / k**5.0
    return long * short**3 / 3 * (1 - 192 / math.pi**5 * short / long * terms.sum())


def test_the_series_gives_the_published_value_of_the_square():
    """Timoshenko and Goodier, Theory of Elasticity, table of k_1: 0.1406 at 1, 0.229 at 2."""
    assert exact_torsion_constant(1.0, 1.0) == pytest.approx(0.1406, abs=5e-5)
    assert exact_torsion_constant(2.0, 1.0) / 2.0 == pytest.approx(0.229, abs=5e-4)


@pytest.mark.parametrize(
    ("ratio", "bound"),
    [(1.0, 2e-3), (1.14, 5e-3), (1.5, 2e-3), (2.0, 1e-3), (5.0, 1e-4), (100.0, 1e-5)],
)
def test_torsion_constant_of_a_rectangle_is_near_the_series(ratio, bound):
    exact = exact_torsion_constant(0.01 * ratio, 0.01)
    for section in (Rectangle(0.01, 0.01 * ratio), Rectangle(0.01 * ratio, 0.01)):
        assert section.torsion_constant == pytest.approx(exact, rel=bound)


def test_torsion_constant_of_a_square_is_the_value_of_the_documented_formula():
    assert Rectangle(2.0, 2.0).torsion_constant == pytest.approx(16 * (1 / 3 - 0.21 * 11 / 12))


def test_a_thin_strip_twists_as_a_c_cubed_over_3():
    assert Rectangle(1.0, 1e-5).torsion_constant == pytest.approx(1e-15 / 3, rel=1e-5)


def test_rectangle_bends_in_the_plane_of_motion_about_y():
    """A bar of 10 mm along y and 20 mm along z, by hand."""
    found = Rectangle("10 mm", "20 mm").properties(STEEL)
    shear_modulus = 210e9 / 2.6
    assert found.axial == pytest.approx(210e9 * 2e-4)
    assert found.shear_y == found.shear_z == pytest.approx(shear_modulus * 2e-4 / 1.2)
    assert found.bending_y == pytest.approx(210e9 * 0.01 * 0.02**3 / 12)
    assert found.bending_z == pytest.approx(210e9 * 0.02 * 0.01**3 / 12)
    assert found.torsion == pytest.approx(shear_modulus * 0.02 * 0.01**3 * 0.2287, rel=3e-3)
    assert found.line_density == pytest.approx(1.57)
    assert found.rotary_y == pytest.approx(7850 * 0.01 * 0.02**3 / 12)
    assert found.rotary_z == pytest.approx(7850 * 0.02 * 0.01**3 / 12)
    assert found.rotary_x == pytest.approx(found.rotary_y + found.rotary_z)
    assert found.damping == 1e-5


def polar_integrals(outer, inner):
    """Area and second moment of a ring by numerical integration over rings."""
    r, weight = np.polynomial.legendre.leggauss(8)
    r = inner / 2 + (outer - inner) / 4 * (r + 1)
    weight = weight * (outer - inner) / 4
    return 2 * math.pi * (weight * r).sum(), math.pi * (weight * r**3).sum()


@pytest.mark.parametrize(("section", "inner"), [(Circle("20 mm"), 0.0), (Tube("20 mm", "3 mm"), 0.014)])
def test_round_sections_match_integrals(section, inner):
    area, second_moment = polar_integrals(0.02, inner)
    assert section.area == pytest.approx(area, rel=1e-12)
    assert section.second_moment_y == pytest.approx(second_moment, rel=1e-12)
    assert section.second_moment_z == section.second_moment_y
    assert section.torsion_constant == pytest.approx(2 * second_moment, rel=1e-12)


def test_shear_factors():
    assert Rectangle(1.0, 2.0).shear_factor == 1.2
    assert Circle(1.0).shear_factor == pytest.approx(10 / 9)
    assert Tube(1.0, 1e-6).shear_factor == pytest.approx(2.0, rel=1e-9)
    assert Tube(1.0, 0.4999999).shear_factor == pytest.approx(7 / 6, rel=1e-6)
    assert Tube(1.0, 0.1, shear_factor=1.9).shear_factor == 1.9
    softer = Rectangle(0.01, 0.01, shear_factor=2.4).properties(STEEL)
    assert softer.shear_y == pytest.approx(Rectangle(0.01, 0.01).properties(STEEL).shear_y / 2)


def test_a_given_section_returns_what_was_given():
    stiffnesses = (52.99e6, 16.88e6, 16.9e6, 733.5, 1131.0, 1132.0)
    expected = (*stiffnesses, 1.997, 85.2e-6, 42.6e-6, 42.6e-6, 1e-5)
    assert astuple(GivenSection(**GIVEN).properties()) == pytest.approx(expected, rel=1e-15)


def test_given_stiffnesses_of_a_rectangle_give_the_rectangle():
    wanted = Rectangle(0.01, 0.02).properties(STEEL)
    assert GivenSection(*astuple(wanted)).properties() == wanted


@pytest.mark.parametrize("field", GIVEN)
def test_a_given_section_refuses_negative_values(refused, field):
    with refused(f"`{field}` of GivenSection"):
        GivenSection(**{**GIVEN, field: -1.0})
    with refused(f"`{field}` of GivenSection", "deg"):
        GivenSection(**{**GIVEN, field: "1 deg"})


def test_rotary_inertias_must_belong_to_a_body(refused):
    with refused("`rotary_inertia_x`", "real body"):
        GivenSection(**{**GIVEN, "rotary_inertia_x": 86e-6})


@pytest.mark.parametrize(
    ("build", "pieces"),
    [
        (lambda: Rectangle(-0.01, 0.01), ("`width` of Rectangle", "greater than 0")),
        (lambda: Rectangle(0.01, 0.0), ("`height` of Rectangle",)),
        (lambda: Rectangle(0.01, 0.01, "5 mm"), ("`shear_factor` of Rectangle", "length")),
        (lambda: Circle(0.0), ("`diameter` of Circle",)),
        (lambda: Circle(0.01, shear_factor=-1), ("`shear_factor` of Circle",)),
        (lambda: Tube(0.02, 0.01), ("`wall` of Tube", "Circle")),
        (lambda: Tube(0.02, 0.0), ("`wall` of Tube",)),
        (lambda: Tube(0.0, 0.01), ("`outer_diameter` of Tube",)),
        (lambda: Tube(0.02, 0.001, shear_factor=0.0), ("`shear_factor` of Tube",)),
        (lambda: Rectangle(0.01, 0.01).properties(None), ("Material", "Rectangle")),
        (lambda: GivenSection(**GIVEN).properties(STEEL), ("`material`", "remove it")),
    ],
)
def test_bad_sections_are_refused(refused, build, pieces):
    with refused(*pieces):
        build()


def test_material_takes_either_shear_modulus_or_poisson_ratio():
    assert STEEL.youngs_modulus == 210e9
    assert STEEL.modulus_of_rigidity == pytest.approx(210e9 / 2.6, rel=1e-15)
    given = Material("steel", 210e9, "7.85 g/cm^3", shear_modulus="81 GPa")
    assert given.modulus_of_rigidity == 81e9
    assert given.density == pytest.approx(7850.0)
    assert given.damping == 0.0
    assert hash(given) == hash(replace(given))


@pytest.mark.parametrize(
    ("changed", "pieces"),
    [
        ({"name": "my steel"}, ("`name`", "'my steel'")),
        ({"name": 7}, ("`name`", "quotes")),
        ({"name": ""}, ("`name`",)),
        ({"youngs_modulus": -1.0}, ("`youngs_modulus` of material `steel`",)),
        ({"youngs_modulus": "210 mm"}, ("`youngs_modulus`", "length")),
        ({"density": 0}, ("`density`",)),
        ({"damping": -1e-5}, ("`damping`",)),
        ({"damping": "1 mm"}, ("`damping`", "time")),
        ({"poisson_ratio": 0.6}, ("`poisson_ratio`", "0.6")),
        ({"poisson_ratio": -1.0}, ("`poisson_ratio`",)),
        ({"poisson_ratio": None}, ("neither", "exactly one")),
        ({"shear_modulus": 81e9}, ("both", "exactly one")),
        ({"poisson_ratio": None, "shear_modulus": 0.0}, ("`shear_modulus`",)),
    ],
)
def test_bad_materials_are_refused(refused, changed, pieces):
    good = {"name": "steel", "youngs_modulus": 210e9, "density": 7850.0, "poisson_ratio": 0.3}
    with refused(*pieces):
        Material(**{**good, **changed})
