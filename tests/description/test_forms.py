"""Curved links and errors of form in study files, their zone, and in files of other programs."""

import numpy as np
import pytest

from rfem_jax import InputError, load_study
from rfem_jax.description.tolerances.zones import SpecifiedZone
from rfem_jax.exchange.exudyn_writer import exudyn_text
from rfem_jax.exchange.study_layout import layout_of

STUDY = """
[mechanism.materials.steel]
youngs_modulus = "210 GPa"
density = "7850 kg/m^3"
poisson_ratio = 0.3
[mechanism.sections.bar]
shape = "rectangle"
width = "10 mm"
height = "16 mm"
[[mechanism.links]]
name = "beam"
length = "400 mm"
section = "bar"
material = "steel"
rfes = 4
[[mechanism.links]]
name = "hook"
section = "bar"
material = "steel"
rfes = 4
axis = [{ to = ["50 mm", 0, 0], radius = "10 mm" }, { to = ["50 mm", 0, "80 mm"], roll = "5 deg" }]
[[mechanism.joints]]
name = "A"
parent = "base"
child = "beam"
[[mechanism.joints]]
name = "B"
parent = "beam"
child = "hook"
[drive]
kind = "moment_ramp"
joint = "A"
moment = 1.0
rise_time = 1.0
[simulation]
duration = 0.01
"""


def read(tmp_path, more=""):
    path = tmp_path / "study.toml"
    path.write_text(STUDY + more, encoding="utf-8")
    return load_study(path)


def test_a_study_that_names_a_bow_has_links_with_errors_of_form(tmp_path):
    plain = read(tmp_path)
    assert not any(link.form_errors for link in plain.mechanism.links)
    assert plain.mechanism.links[1].length == pytest.approx(0.05 + 0.08 - 0.02 + 0.5 * np.pi * 0.01)
    for more in (
        '[[cases]]\nname = "bowed"\nerrors = { "beam.bow_y" = "1 mm" }\n',
        '[tolerances]\n"beam.straightness" = "0.2 mm"\n',
        '[tolerances]\n"beam.bow_z" = "0.2 mm"\n',
    ):
        asked = read(tmp_path, more)
        assert [link.form_errors for link in asked.mechanism.links] == [True, False]
        assert {"beam.bow_y", "beam.bow_z"} <= set(asked.mechanism.error_names)
    of_hook = '[[cases]]\nname = "c"\nerrors = { "hook.bow_y" = 1e-3 }\n'
    for more in ('[tolerances]\n"hook.straightness" = 1e-4\n', of_hook):
        with pytest.raises(InputError, match="of a link with an axis its points may deviate"):
            read(tmp_path, more)
    with pytest.raises(InputError, match="`length` of the zone `beam.straightness` must be left out"):
        read(tmp_path, '[tolerances]\n"beam.straightness" = { diameter = 1e-4, length = 0.1 }\n')


def test_a_straightness_is_the_smallest_cylinder_around_the_bow(tmp_path):
    """A half-wave of the amplitude b lies in a cylinder of the diameter b, and in none that is smaller."""
    zone = SpecifiedZone("beam.straightness", 2e-4)
    assert zone.errors == ("beam.bow_y", "beam.bow_z") and zone.balls == (2,)
    np.testing.assert_array_equal(zone.matrix(), 2e-4 * np.eye(2))
    assert zone.half_widths() == {"beam.bow_y": 2e-4, "beam.bow_z": 2e-4}
    wave = 2e-4 * np.sin(np.pi * np.linspace(0.0, 1.0, 101))
    assert np.ptp(wave) == pytest.approx(2e-4)
    study = read(tmp_path, '[tolerances]\n"beam.straightness" = "0.2 mm"\n')
    assert study.tolerances.zones == (zone,)


def test_bowed_and_bent_links_in_files_of_other_programs(tmp_path):
    """Their rigid bodies have the centres of mass of their curves; Exudyn's script has no such elements."""
    study = read(tmp_path, '[[cases]]\nname = "bowed"\nerrors = { "beam.bow_y" = "1 mm" }\n')
    layout = layout_of(study, "bowed")
    assert layout.body("hook").mass == pytest.approx(study.mechanism.links[1].mass)
    along = 2.0 / np.pi  # of the half-wave, whose stretch adds a millionth
    np.testing.assert_allclose(layout.body("beam").centre, [0.2, 1e-3 * along, 0.0], rtol=1e-4, atol=1e-12)
    with pytest.raises(
        InputError, match="without links with an axis, errors of form or .* but the study has `hook`, `beam`"
    ):
        exudyn_text(study, "bowed", "study.toml")
