"""Capacities of bearings and edges of given sections in study files, and the metrics that need them."""

import pytest

from rfem_jax import Bearing, InputError, load_study

from .test_study_files import FULL

BEARING = (
    'bearing = { dynamic_capacity = "4.6 kN", static_capacity = 2000, moment_capacity = "3 N m", rolling = "roller" }\n'
)
TASK = '\n[tolerances]\n"A.delta_x" = "0.2 deg"\n[monte_carlo]\nn = 16\nmetrics = METRICS\nlimits = LIMITS\n'


def load(tmp_path, metrics, limits="{}", joint=""):
    path = tmp_path / "study.toml"
    text = FULL.replace('name = "A"\n', f'name = "A"\n{joint}', 1)
    path.write_text(text + TASK.replace("METRICS", metrics).replace("LIMITS", limits), encoding="utf-8")
    return load_study(path)


def test_a_bearing_in_a_study_file_and_its_metrics(tmp_path):
    limits = '{ "A.bearing_life" = ["20000 h", inf], "A.force_ratio" = 0.5 }'
    study = load(tmp_path, '["*.bearing_life", "A.moment_ratio", "mass"]', limits, BEARING)
    assert study.mechanism.joint("A").bearing == Bearing(4600.0, 2000.0, 3.0, "roller")
    assert study.tasks.monte_carlo.metrics == ("A.bearing_life", "A.moment_ratio", "mass", "A.force_ratio")
    assert study.tasks.monte_carlo.limits["A.bearing_life"] == (20000 * 3600.0, float("inf"))


def test_metrics_of_links_and_of_points_on_them(tmp_path, refused):
    limits = '{ "two.peak_stress" = "120 MPa", "two@0.25.peak_deflection" = "0.2 mm", mass = "2 kg" }'
    task = load(tmp_path, '["*.peak_stress", "*@0.5.end_deflection", "A.peak_drive_power"]', limits).tasks.monte_carlo
    assert task.metrics[:2] == ("one.peak_stress", "two.peak_stress")  # the third link's section has no edge
    middles = [f"{name}@0.5.end_deflection" for name in ("one", "two", "three")]
    assert task.metrics[2:] == (*middles, "A.peak_drive_power", "two@0.25.peak_deflection", "mass")
    assert task.limits["two.peak_stress"][1] == 120e6 and task.limits["two@0.25.peak_deflection"][1] == 2e-4
    for metrics, pieces in (
        ('["three.max_stress"]', ("`three.max_stress`", "`edge_y`", "links that have it are one, two")),
        ('["A.peak_stress"]', ("must be of links of the mechanism", "`A`")),
        ('["two@2.peak_deflection"]', ("fraction of its length", "two@0.5")),
        ('["A.bearing_life"]', ("`dynamic_capacity`", "no joint has it")),
        ('["friction_loss"]', ("`friction_loss` does not", "no friction")),
        ('["B.peak_drive_power"]', ("it is not driven", "joints that have it are A")),
    ):
        with refused(*pieces):
            load(tmp_path, metrics)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({}, "must have a capacity"),
        ({"static_capacity": -1.0}, "`static_capacity` of a bearing"),
        ({"static_capacity": 1.0, "rolling": "needle"}, "`rolling` of a bearing"),
    ],
)
def test_bearings_that_cannot_be_meant_are_refused(arguments, words):
    with pytest.raises(InputError, match=words):
        Bearing(**arguments)
