"""Points of a study in everything that commands write: tables, files, labelled data and the page's animation."""

import json

import numpy as np
import pytest
from numpy.testing import assert_allclose

from rfem_jax import InputError, load_study
from rfem_jax.description.metrics.path_metrics import REPORTED
from rfem_jax.report.command_line import main
from rfem_jax.simulation.cases import run_cases

pytestmark = pytest.mark.usefixtures("commands_here")

LENGTH, ERROR, RATE = 0.3, 1e-3, 6.0
STUDY = f"""
title = "A hand that goes round"

[mechanism.materials.steel]
youngs_modulus = "210 GPa"
poisson_ratio = 0.3
density = 7850.0

[mechanism.sections.bar]
shape = "circle"
diameter = "10 mm"

[[mechanism.links]]
name = "hand"
length = {LENGTH}
section = "bar"
material = "steel"
rigid = true

[[mechanism.joints]]
name = "A"
parent = "base"
child = "hand"

[[mechanism.points]]
name = "tip"
link = "hand"
position = {LENGTH}

[drive]
joint = "A"
kind = "prescribed_rate"
rate = {RATE}

[simulation]
duration = 0.5
method = "rk4"
step = 5e-3
save_every = 2.5e-2

[[cases]]
name = "perfect"

[[cases]]
name = "long"
errors = {{ "hand.length" = {ERROR} }}
"""


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    file = tmp_path_factory.mktemp("paths") / "study.toml"
    file.write_text(STUDY, encoding="utf-8")
    return file


@pytest.fixture(scope="module")
def folder(path):
    out = path.parent / "out"
    assert main(["run", str(path), "--out", str(out)]) == 0
    return out


def columns(file):
    return np.genfromtxt(file, delimiter=",", names=True)


@pytest.mark.long
def test_points_are_reported_by_their_deviations_unless_metrics_name_others(path, folder, tmp_path):
    results = json.loads((folder / "results.json").read_text(encoding="utf-8"))
    perfect, long = (results["cases"][case]["metrics"] for case in ("perfect", "long"))
    assert list(long) == [f"tip.{kind}" for kind in REPORTED]
    assert set(perfect.values()) == {0.0}
    # A longer hand is off along itself, which is across its path.
    for kind in ("max_deviation", "rms_deviation", "rms_deviation_across"):
        assert_allclose(long[f"tip.{kind}"], ERROR, rtol=1e-9)
    for kind in ("rms_deviation_along", "rms_deviation_out_of_plane", "max_angle_deviation"):
        assert_allclose(long[f"tip.{kind}"], 0.0, atol=1e-12)
    other = tmp_path / "study.toml"
    other.write_text('metrics = ["tip@0.2s.x"]\n' + STUDY, encoding="utf-8")
    assert load_study(other).metrics == ("tip@0.2s.x",)


def test_files_have_the_path(folder):
    table = columns(folder / "long.csv")
    angle, radius = RATE * table["time_s"], LENGTH + ERROR
    assert_allclose(table["tip_x_m"], radius * np.cos(angle), atol=1e-9)
    assert_allclose(table["tip_z_m"], -radius * np.sin(angle), atol=1e-9)
    assert_allclose(table["tip_velocity_x_m_s"], -RATE * radius * np.sin(angle), atol=1e-8)
    assert_allclose(table["tip_acceleration_z_m_s2"], RATE**2 * radius * np.sin(angle), atol=1e-7)
    assert_allclose(table["tip_angle_y_rad"], angle, atol=1e-9)


def test_the_page_draws_the_path_and_that_of_the_perfect_mechanism(folder):
    with np.load(folder / "animation.npz") as file:
        description = json.loads(str(file["description"]))
        places, perfect = file["1_path_place"], file["1_nominal_path_place"]
    assert description["paths"] == [{"name": "tip", "link": "hand"}]
    assert_allclose(np.linalg.norm(places[:, 0], axis=1), LENGTH + ERROR, rtol=1e-9)
    assert_allclose(np.linalg.norm(perfect[:, 0], axis=1), LENGTH, rtol=1e-9)


def test_labelled_data_have_the_path(path):
    _, runs = run_cases(load_study(path))
    data = runs.to_xarray()
    assert list(data.followed_point.values) == ["tip"]
    place = data.path_position.sel(case="long", followed_point="tip")
    assert_allclose(place.sel(component="x"), runs["long"].points["tip"].position[:, 0])
    assert data.path_acceleration.attrs["units"] == "m/s^2"


@pytest.mark.long
def test_cycles_and_turns_have_the_path(path):
    cycle, turn = path.parent / "cycle", path.parent / "turn"
    assert main(["cycle", str(path), "--out", str(cycle)]) == 0
    assert main(["turn", str(path), "--out", str(turn), "--positions", "4"]) == 0
    table = columns(cycle / "long.csv")
    assert_allclose(np.hypot(table["tip_x_m"], table["tip_z_m"]), LENGTH + ERROR, rtol=1e-9)
    metrics = json.loads((cycle / "results.json").read_text(encoding="utf-8"))["cases"]["long"]["metrics"]
    assert_allclose(metrics["tip.max_deviation"], ERROR, rtol=1e-8)
    rows = np.genfromtxt(turn / "turn.csv", delimiter=",", names=True, dtype=None, encoding="utf-8")
    long = rows[rows["case"] == "long"]
    assert_allclose(long["tip_x_m"], (LENGTH + ERROR) * np.cos(long["position_rad"]), atol=1e-9)


TOLERANCES = """
[tolerances]
"hand.length" = "1 mm"

[monte_carlo]
n = 16
metrics = ["tip.max_deviation"]
"""


@pytest.mark.long
def test_monte_carlo_studies_have_the_band(path, tmp_path):
    study = tmp_path / "study.toml"
    study.write_text(STUDY + TOLERANCES, encoding="utf-8")
    assert load_study(study).tasks.monte_carlo.bands == ("tip",)
    assert main(["monte-carlo", str(study), "--out", str(tmp_path)]) == 0
    band = columns(tmp_path / "monte_carlo_path_tip.csv")
    values = columns(tmp_path / "monte_carlo.csv")
    written = json.loads((tmp_path / "monte_carlo.json").read_text(encoding="utf-8"))["path_bands"]["tip"]
    assert_allclose(written["across"]["high"], band["across_high_m"], rtol=1e-9)
    assert written["samples"] == 16
    assert_allclose(band["tip_x_m"], LENGTH * np.cos(RATE * band["time_s"]), atol=1e-9)
    reach = np.maximum(band["across_largest_m"], -band["across_smallest_m"])
    assert_allclose(reach, values["tipmax_deviation_m"].max(), rtol=1e-9)
    assert (tmp_path / "monte_carlo_path_tip.png").stat().st_size > 10_000


@pytest.mark.long
@pytest.mark.parametrize(
    ("bands", "words"),
    [
        ('["tp"]', "has no point `tp`; did you mean `tip`"),
        ("3", "must be a list of names of points, but was 3"),
    ],
)
def test_bands_of_what_is_no_point(bands, words, tmp_path):
    study = tmp_path / "study.toml"
    study.write_text(f"{STUDY}{TOLERANCES}bands = {bands}\n", encoding="utf-8")
    with pytest.raises(InputError, match=words):
        load_study(study)
