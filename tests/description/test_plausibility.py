"""Numbers whose unit was most likely forgotten are pointed out; those of the shipped studies are not."""

from pathlib import Path

import pytest

from rfem_jax import load_study
from rfem_jax.description.study_file.plausibility import doubtful_numbers

STUDIES = Path(__file__).parents[2] / "studies"


def of_text(tmp_path, *changes):
    """Sentences on the slider-crank with changed text."""
    text = (STUDIES / "slider_crank" / "study.toml").read_text(encoding="utf-8")
    for old, new in changes:
        assert text.count(old) == 1, old
        text = text.replace(old, new)
    file = tmp_path / "study.toml"
    file.write_text(text, encoding="utf-8")
    return doubtful_numbers(load_study(file))


@pytest.mark.parametrize("file", sorted(STUDIES.rglob("*.toml")), ids=lambda file: f"{file.parent.name}/{file.name}")
def test_nothing_is_said_of_the_studies(file):
    assert doubtful_numbers(load_study(file)) == []


def test_a_point_of_300_metres(tmp_path):
    point = '[[mechanism.points]]\nname = "T"\nlink = "piston"\nposition = 300\n\n[[cases]]\nname = "perfect"'
    (sentence,) = of_text(tmp_path, ('[[cases]]\nname = "perfect"', point))
    assert "`T` is 300 m from the origin" in sentence and "1.5e+03 times the longest" in sentence


def test_a_link_that_is_1000_kelvin_warmer(tmp_path):
    """Of its material alone: an expansion is given, and then a temperature as it is read above absolute zero."""
    expanding = "density = 7850.0", "density = 7850.0\nthermal_expansion = 12e-6"
    case = '[[cases]]\nname = "perfect"'
    warm = f'[[cases]]\nname = "warm"\nerrors = {{ "rod.temperature" = 313 }}\n\n{case}'
    assert of_text(tmp_path, expanding, (case, warm)) == []
    (sentence,) = of_text(tmp_path, expanding, (case, warm.replace("313", "1000")))
    assert "`rod.temperature` of case `warm` is 1000 K, much for steel" in sentence


def test_a_link_of_200_metres(tmp_path):
    (sentence,) = of_text(tmp_path, ('length = "200 mm"', "length = 200"))
    assert sentence.startswith("Link `rod` is 200 m long, 5e+03 times the shortest") and '"200 mm"' in sentence


def test_errors_and_tolerances_in_radians_and_metres(tmp_path):
    sentences = of_text(
        tmp_path,
        ('errors = { "G.delta_z" = "0.05 deg" }', 'errors = { "G.delta_z" = -0.2 }'),
        ('errors = { "G.d_y" = "0.1 mm" }', 'errors = { "G.d_y" = 0.1 }'),
        ('"P.delta_x" = "0.03 deg"', '"P.delta_x" = 0.3'),
    )
    tilt, shift, tolerance = sentences
    assert tilt.startswith("`G.delta_z` of case `guide_tilted` is 11.5 deg") and '"-0.2 deg"' in tilt
    assert shift.startswith("`G.d_y` of case") and "is 0.1 m, much beside the longest link (0.2 m)" in shift
    assert tolerance.startswith("`P.delta_x` in `[tolerances]` is 17.2 deg")
