"""results.json and the CSV files: names, numbers, null for NaN, all or nothing."""

import json

import numpy as np
import pytest

from rfem_jax.report.contents.files import history_columns, write_files
from rfem_jax.report.contents.output import write_csv
from rfem_jax.report.contents.summary import reference_case, summarise
from rfem_jax.simulation.outcome.quantities import column_name
from rfem_jax.whole_files import replacing


@pytest.fixture
def folder(tmp_path, study, runs, statuses):
    write_files(tmp_path, study, runs, summarise(study, runs, statuses))
    return tmp_path


def refuse_constant(name):
    raise AssertionError(f"JSON holds {name}")


def read_json(folder):
    text = (folder / "results.json").read_text(encoding="utf-8")
    return json.loads(text, parse_constant=refuse_constant)


def test_json_has_the_promised_keys_and_numbers(folder):
    results = read_json(folder)
    assert list(results["cases"]) == ["P1", "P2", "P3"]
    case = results["cases"]["P2"]
    assert case["status"] == "ok"
    components = case["joints"]["C"].pop("rms_components")
    # RMS 8 N in the directions of (2, 4, 6) + 3, on all saved times the same.
    np.testing.assert_allclose(components["force"], 8.0 * np.array([5.0, 7.0, 9.0]) / np.sqrt(155.0), rtol=1e-12)
    np.testing.assert_allclose(components["moment"], 0.1 * np.array(components["force"]), rtol=1e-12)
    assert case["joints"]["C"] == {
        "kind": "revolute",
        "rms_force": 8.0,
        "rms_moment": pytest.approx(0.8),
        "max_force": 32.0,
        "max_moment": pytest.approx(3.2),
        "max_axial_force": 16.0,
        "max_normal_force": 24.0,
        "preload_force": [5.0, 7.0, 9.0],
        "preload_moment": pytest.approx([0.5, 0.7, 0.9]),
    }
    assert case["driven_joint"] == {"angle_end": 8.51, "rate_end": 20.0}
    assert case["driven_joints"] == [{"joint": "A", "motion": "R_y", "angle_end": 8.51, "rate_end": 20.0}]
    assert case["energy_balance_error"] == 1e-7
    assert case["closure_drift"] == 2e-12
    assert case["closure_drift_angle"] == 3e-12
    assert case["momentum_balance_error"] == 4e-12
    assert case["solution_residual"] == 6e-7
    assert case["branch"] == {"C": {"start": 1, "end": -1, "changes": 1}}
    assert case["errors"] == {"D.delta_x": pytest.approx(np.deg2rad(0.5))}


def test_json_has_a_unit_for_every_number_and_versions(folder):
    results = read_json(folder)
    case = results["cases"]["P1"]
    named = {*case["joints"]["A"], *case["driven_joint"]} - {"kind"}
    named |= {name for name, value in case.items() if isinstance(value, float)}
    assert named <= set(results["units"])
    assert results["units"]["rms_moment"] == "N m"
    assert results["units"]["closure_drift"] == "m"
    assert results["versions"]["jax"].count(".") >= 2
    assert results["method"]["name"] == "rk4"


def test_nan_and_infinity_become_null(tmp_path, study, runs, statuses):
    runs["P2"].metrics.rms_force["A"] = np.float64("nan")
    runs["P2"].preload["B"].force[1] = np.inf
    runs["P2"].checks.closure_drift = np.float64("nan")
    write_files(tmp_path, study, runs, summarise(study, runs, statuses))
    case = read_json(tmp_path)["cases"]["P2"]
    assert case["joints"]["A"]["rms_force"] is None
    assert case["joints"]["B"]["preload_force"] == [3.0, None, 7.0]
    assert case["closure_drift"] is None


def test_csv_has_units_in_its_header_and_the_right_columns(folder, runs):
    header, *rows = (folder / "P2.csv").read_text(encoding="utf-8").splitlines()
    names = header.split(",")
    assert names[:3] == ["time_s", "angle_rad", "rate_rad_s"]
    assert names[3:9] == [*("kinetic_J", "elastic_J", "gravity_J", "total_J", "work_J", "dissipation_J")]
    assert names[9:15] == [
        *("A_force_x_N", "A_force_y_N", "A_force_z_N"),
        *("A_moment_x_Nm", "A_moment_y_Nm", "A_moment_z_Nm"),
    ]
    assert names[15] == "B_force_x_N"
    assert names[-4:] == ["C_moment_z_Nm", "drive_moment_Nm", "B_angle_rad", "D_angle_rad"]
    assert len(rows) == 11
    table = np.genfromtxt(folder / "P2.csv", delimiter=",", names=True)
    np.testing.assert_allclose(table["time_s"], runs["P2"].times, rtol=1e-11)
    np.testing.assert_allclose(table["total_J"], 1.25 * runs["P2"].times, rtol=1e-11)
    np.testing.assert_allclose(table["D_force_y_N"], 6.0, rtol=1e-11)
    np.testing.assert_allclose(table["D_moment_x_Nm"], 0.4, rtol=1e-11)
    np.testing.assert_allclose(table["D_angle_rad"], 0.2 * runs["P2"].times, rtol=1e-11)


@pytest.mark.parametrize(
    ("unit", "name"),
    [("N m", "x_Nm"), ("rad/s", "x_rad_s"), ("(N m)^2", "x_N2m2"), ("N^2", "x_N2"), ("kg m^2", "x_kgm2"), ("", "x")],
)
def test_a_column_is_named_with_its_unit(unit, name):
    assert column_name("x", unit) == name


def test_one_csv_per_case_and_no_part_files(folder):
    names = sorted(path.name for path in folder.iterdir() if path.suffix != ".toml")
    assert names == ["P1.csv", "P2.csv", "P3.csv", "results.json"]


def test_columns_of_a_failed_run_keep_nan(study, runs):
    runs["P1"].motion.rate[5:] = np.nan
    rate = history_columns(study, runs["P1"])["rate_rad_s"]
    assert np.isnan(rate).tolist() == [False] * 5 + [True] * 6


def test_a_file_that_fails_half_way_leaves_the_old_one(tmp_path):
    path = tmp_path / "results.json"
    path.write_text("old", encoding="utf-8")
    with pytest.raises(RuntimeError), replacing(path) as temporary:
        temporary.write_text("half", encoding="utf-8")
        raise RuntimeError
    assert path.read_text(encoding="utf-8") == "old"
    assert [entry.name for entry in tmp_path.iterdir()] == ["results.json"]


def test_without_a_drive_the_driven_joint_is_null(tmp_path, study, runs, statuses):
    object.__setattr__(study, "drive", None)
    write_files(tmp_path, study, runs, summarise(study, runs, statuses))
    results = read_json(tmp_path)
    assert results["driven_joint"] is None
    assert results["cases"]["P1"]["driven_joint"] == {"angle_end": None, "rate_end": None}
    assert results["cases"]["P1"]["driven_joints"] == []


def test_the_reference_is_the_case_without_errors(study):
    object.__setattr__(study, "cases", study.cases[::-1])
    assert reference_case(study) == "P1"
    object.__setattr__(study, "cases", study.cases[:2])
    assert reference_case(study) == "P3"


def test_texts_that_begin_as_a_formula_are_texts_for_spreadsheets(tmp_path):
    rows = [{"=name": "=1+1", "value": -1.5}, {"=name": "+x", "value": np.float64("nan")}, {"=name": "@y", "value": -2}]
    path = write_csv(tmp_path / "table.csv", rows)
    assert path.read_text(encoding="utf-8").splitlines() == ["'=name,value", "'=1+1,-1.5", "'+x,", "'@y,-2"]
