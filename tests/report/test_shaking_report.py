"""What shakes the base in everything that commands write: files, labelled data, curves of the page."""

import json

import numpy as np
import pytest
from numpy.testing import assert_allclose

from rfem_jax import InputError, load_study
from rfem_jax.description.metrics.shaking_metrics import REPORTED
from rfem_jax.report.command_line import main
from rfem_jax.report.page.histories import pack_histories, read_table
from rfem_jax.simulation.cases import run_cases
from tests.report.test_paths import LENGTH, RATE, STUDY

pytestmark = pytest.mark.usefixtures("commands_here")

POINT = 0.2
TABLE = "[mechanism.materials.steel]"
SHAKEN = STUDY.replace(TABLE, f'[mechanism]\ngravity = [0, 0, 0]\nshaking_point = ["{POINT} m", 0, 0]\n{TABLE}')
SHAKEN = SHAKEN.replace('[[mechanism.points]]\nname = "tip"\nlink = "hand"\nposition = 0.3\n', "")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("shaking") / "study.toml"
    path.write_text(SHAKEN, encoding="utf-8")
    assert main(["run", str(path), "--out", str(path.parent / "out"), "--axes", "global"]) == 0
    return path.parent / "out"


def pull(length):
    return 7850.0 * 0.25 * np.pi * 0.01**2 * length * RATE**2 * 0.5 * length


@pytest.mark.long
def test_files_have_it_and_its_metrics(folder):
    table = np.genfromtxt(folder / "perfect.csv", delimiter=",", names=True)
    angle, force = RATE * table["time_s"], pull(LENGTH)
    assert_allclose(table["shaking_force_x_N"], force * np.cos(angle), atol=1e-8 * force)
    assert_allclose(table["shaking_force_z_N"], -force * np.sin(angle), atol=1e-8 * force)
    # Of the force at the hinge about a point on x: (p - a) x F with a = 0.2 m.
    assert_allclose(table["shaking_moment_y_Nm"], -POINT * force * np.sin(angle), atol=1e-8 * force)
    metrics = json.loads((folder / "results.json").read_text(encoding="utf-8"))["cases"]["long"]["metrics"]
    assert tuple(metrics) == REPORTED
    for kind in ("rms", "max"):
        assert_allclose(metrics[f"{kind}_shaking_force"], pull(LENGTH + 1e-3), rtol=1e-8)


def test_axes_add_columns_and_components(folder):
    with open(folder / "perfect.csv", encoding="utf-8") as file:
        names = file.readline().rstrip("\n").split(",")
    assert names[-6:] == [f"A_{load}_global_{axis}_{unit}" for load, unit in (("force", "N"), ("moment", "Nm"))
                          for axis in "xyz"]  # fmt: skip
    table = np.genfromtxt(folder / "perfect.csv", delimiter=",", names=True)
    for axis in "xyz":  # what the base exerts on the hand
        assert_allclose(table[f"A_force_global_{axis}_N"], -table[f"shaking_force_{axis}_N"], atol=1e-9)
    (row,) = json.loads((folder / "results.json").read_text(encoding="utf-8"))["cases"]["perfect"]["joints"].values()
    assert row["in_axes"]["axes"] == "global" and len(row["in_axes"]["preload_force"]) == 3
    squares = np.square(row["in_axes"]["rms_components"]["force"])
    assert_allclose(np.sum(squares), row["rms_force"] ** 2, rtol=1e-9)
    assert min(squares[0], squares[2]) > 0.1 * squares.sum() > row["rms_components"]["force"][2] ** 2
    packed = pack_histories({"perfect": read_table(folder / "perfect.csv")}, ["A"])
    assert packed is not None
    assert {"Force in A, global axes", "Moment in A, global axes"} <= {one["label"] for one in packed["quantities"]}


@pytest.mark.long
def test_cycles_and_turns_have_them_too(folder):
    study, cycle, turn = folder.parent / "study.toml", folder.parent / "cycle", folder.parent / "turn"
    assert main(["cycle", str(study), "--out", str(cycle), "--axes", "child"]) == 0
    assert main(["turn", str(study), "--out", str(turn), "--axes", "child", "--positions", "4"]) == 0
    table = np.genfromtxt(cycle / "perfect.csv", delimiter=",", names=True)
    assert_allclose(table["A_force_child_x_N"], -pull(LENGTH), rtol=1e-8)
    rows = np.genfromtxt(turn / "turn.csv", delimiter=",", names=True, dtype=None, encoding="utf-8")
    assert_allclose(rows["A_force_child_x_N"], 0.0, atol=1e-9)


def test_the_page_has_curves_of_it_with_three_components(folder):
    packed = pack_histories({"perfect": read_table(folder / "perfect.csv")}, ["A"])
    assert packed is not None
    found = {one["label"]: one for one in packed["quantities"] if one["group"] == "Base"}
    assert list(found) == ["Shaking force", "Shaking moment"]
    assert all(one["parts"] == ["x", "y", "z"] and len(one["columns"]) == 3 for one in found.values())


def test_labelled_data_have_it(folder):
    _, runs = run_cases(load_study(folder.parent / "study.toml"))
    data = runs.to_xarray()
    force = data.shaking_force.sel(case="perfect")
    assert_allclose(np.sqrt((force**2).sum("component")), pull(LENGTH), rtol=1e-8)
    assert data.shaking_moment.attrs["units"] == "N m" and force.dims == ("time", "component")


def test_a_joint_with_the_name_of_its_columns_is_refused(tmp_path):
    path = tmp_path / "study.toml"
    path.write_text(SHAKEN.replace('"A"', '"shaking"'), encoding="utf-8")
    with pytest.raises(InputError, match="must not be `shaking`"):
        load_study(path)
    path.write_text('metrics = ["max_shaking_force"]\n' + SHAKEN, encoding="utf-8")
    assert load_study(path).metrics == ("max_shaking_force",)


@pytest.mark.slow
def test_turns_and_loads_at_rest_have_it(tmp_path, capsys):
    path, weight = tmp_path / "study.toml", pull(LENGTH) / (RATE**2 * 0.5 * LENGTH) * 9.81
    path.write_text(SHAKEN.replace("gravity = [0, 0, 0]\n", ""), encoding="utf-8")
    assert main(["turn", str(path), "--out", str(tmp_path), "--positions", "4"]) == 0
    assert "on the base" in capsys.readouterr().out
    table = np.genfromtxt(tmp_path / "turn.csv", delimiter=",", names=True, dtype=None, encoding="utf-8")
    perfect = table[table["case"] == "perfect"]
    assert_allclose(perfect["shaking_force_z_N"], -weight, rtol=1e-9)
    moment = weight * (0.5 * LENGTH * np.cos(perfect["position_rad"]) - POINT)
    assert_allclose(perfect["shaking_moment_y_Nm"], moment, atol=1e-9)
    case = json.loads((tmp_path / "turn.json").read_text(encoding="utf-8"))["cases"]["perfect"]
    assert_allclose(case["curves"]["shaking_moment"]["y"], moment, atol=1e-9)
    assert case["shaking"]["max_moment"] == pytest.approx(np.abs(moment).max())

    assert main(["statics", str(path), "--out", str(tmp_path)]) == 0
    text = capsys.readouterr().out
    assert "What the mechanism exerts on its base" in text and " -0 " not in text
    case = json.loads((tmp_path / "statics.json").read_text(encoding="utf-8"))["cases"]["perfect"]
    assert_allclose(case["shaking"]["moment"], [[0.0, weight * (0.5 * LENGTH - POINT), 0.0]], atol=1e-12)
    assert case["metrics"]["max_shaking_force"] == pytest.approx(weight)
    table = np.genfromtxt(tmp_path / "statics.csv", delimiter=",", names=True, dtype=None, encoding="utf-8")
    assert_allclose(table["shaking_force_z_N"][0], -weight, rtol=1e-9)


def test_a_metric_of_it_makes_a_turn_have_it_about_the_origin(tmp_path):
    """Without `shaking_point`, as in runs; without such a metric there is nothing."""
    text = SHAKEN.replace("gravity = [0, 0, 0]\n", "").replace(f'shaking_point = ["{POINT} m", 0, 0]\n', "")
    title = 'title = "A hand that goes round"\n'
    for metrics, there in (('metrics = ["max_shaking_force"]\n', True), ("", False)):
        path = tmp_path / "study.toml"
        path.write_text(text.replace(title, title + metrics), encoding="utf-8")
        assert main(["turn", str(path), "--out", str(tmp_path), "--positions", "2"]) == 0
        header = (tmp_path / "turn.csv").read_text(encoding="utf-8").splitlines()[0]
        assert ("shaking_moment_y_Nm" in header) == there
    assert "shaking" not in json.loads((tmp_path / "turn.json").read_text(encoding="utf-8"))["cases"]["perfect"]
