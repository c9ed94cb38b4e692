"""What reports say of joints of other kinds than revolute, and what a real run gives them to say."""

import json

import numpy as np
import pytest

from rfem_jax import describe, discretise, load_study, run_cases
from rfem_jax.report.contents.files import history_columns, write_files
from rfem_jax.report.contents.overview import study_text
from rfem_jax.report.contents.summary import summarise
from rfem_jax.report.drawings.figures import _component_titles
from rfem_jax.report.drawings.shapes import labelled_points
from rfem_jax.simulation.accuracy import trial_errors
from tests.study_texts import STEEL, hinge, link, rectangle

LINKS = link("crank", 0.06) + link("piston", 0.05) + link("rod", 0.2)
STUDY = f"""
title = "Slider-crank without redundant constraints"
{STEEL}{rectangle()}{LINKS}{hinge("crank", 'angle = "10 deg"')}[[mechanism.joints]]
name = "G"
kind = "prismatic"
parent = "base"
child = "piston"
displacement = "26 cm"
[[mechanism.joints]]
name = "U"
kind = "universal"
parent = "piston"
child = "rod"
position = [0, 0, 0]
child_position = [0.2, 0, 0]
[[mechanism.joints]]
name = "B"
kind = "spherical"
parent = "crank"
child = "rod"
child_position = [0, 0, 0]
cut = true
[drive]
joint = "A"
kind = "prescribed_rate"
rate = 60
[simulation]
duration = 1e-3
method = "rk4"
step = 1e-4
save_every = 5e-4
"""


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    path = tmp_path_factory.mktemp("kinds") / "study.toml"
    path.write_text(STUDY, encoding="utf-8")
    return load_study(path)


@pytest.fixture(scope="module")
def run(study):
    return run_cases(study)[1]["nominal"]


def test_check_names_the_kinds_and_their_starts(study):
    text = study_text(study, describe(discretise(study.mechanism)))
    rows = [line.split() for line in text.splitlines()]
    assert ["G", "prismatic", "base", "piston", "0.26", "m", "-"] in rows
    assert ["U", "universal", "piston", "rod", "0", "deg,", "0", "deg", "-"] in rows
    assert ["B", "spherical", "crank", "rod", "-", "cut"] in rows
    assert "Mobility: 1 with flexible links, 1 if all links were rigid." in text
    assert "Idle" not in text and "lock" not in text


@pytest.mark.slow
def test_files_have_kinds_nulls_and_coordinates(study, run, tmp_path):
    runs = {"nominal": run}
    write_files(tmp_path, study, runs, summarise(study, runs, {"nominal": ("ok", "")}))
    joints = json.loads((tmp_path / "results.json").read_text())["cases"]["nominal"]["joints"]
    assert {name: row["kind"] for name, row in joints.items()} == {
        "A": "revolute", "G": "prismatic", "U": "universal", "B": "spherical"
    }  # fmt: skip
    for name, has_axis in (("A", True), ("G", True), ("U", False), ("B", False)):
        row = joints[name]
        assert (row["max_axial_force"] is not None) == (row["max_normal_force"] is not None) == has_axis
        assert row["rms_force"] > 1.0
    columns = history_columns(study, run)
    assert list(columns)[-3:] == ["G_displacement_m", "U_angle_1_rad", "U_angle_2_rad"]
    crank = 10.0 * np.pi / 180.0 + 60.0 * columns["time_s"]
    slide = 0.06 * np.cos(crank) + np.sqrt(0.2**2 - (0.06 * np.sin(crank)) ** 2)
    np.testing.assert_allclose(columns["G_displacement_m"], slide, rtol=0, atol=1e-10)


def test_axial_force_is_along_the_guide_and_nothing_is_left_along_free_motions(run):
    # The guide takes no force along x, its axis, and the load across it is that of y and z.
    force = np.asarray(run.loads["G"].force)
    assert np.abs(force[:, 0]).max() < 1e-9 * np.abs(force).max()
    assert float(run.metrics.max_axial_force["G"]) < 1e-9 * float(run.metrics.max_normal_force["G"])
    np.testing.assert_allclose(run.metrics.max_normal_force["G"], np.hypot(force[:, 1], force[:, 2]).max(), rtol=1e-3)
    assert float(run.checks.hinge_moment_error) < 1e-9
    assert float(run.checks.momentum_balance_error) < 1e-12


def test_titles_of_components_say_which_is_along_the_axis():
    assert _component_titles("prismatic", "force")[0] == "(a) x, along the guide"
    assert _component_titles("cylindrical", "force")[1] == "(b) y, along the axis"
    assert _component_titles("revolute", "moment")[1] == "(b) about y, the hinge"
    assert _component_titles("spherical", "moment") == ["(a) about x", "(b) about y", "(c) about z"]


def test_joints_that_are_drawn_on_one_another_have_one_label():
    line = {"rod": np.array([[0.0, 0.0, 0.0], [0.3, 0.0, 0.0]])}
    points = {
        "A": np.zeros(3),
        "G": np.array([0.3, 0.0, 0.0]),
        "P": np.array([0.301, 0.0, 0.0]),
        "Q": np.full(3, np.nan),
    }
    assert [names for names, _ in labelled_points(points, line)] == [["A"], ["G", "P"]]


def test_auto_knows_the_errors_of_every_kind(study):
    """Trial errors of the choice of a step: of each joint those that its free motions do not make good."""
    model = discretise(study.mechanism)
    trial = np.asarray(trial_errors(model).seat)
    names = model.topology.error_components
    found = {j: {n for n, value in zip(names, column) if value} for j, column in zip(model.topology.joints, trial[1].T)}
    assert not trial[0].any()
    assert found["G"] == {"delta_x", "delta_y", "delta_z", "d_y", "d_z"}
    assert found["B"] == {"d_x", "d_y", "d_z"}
    assert all(f"{joint}.{name}" in model.topology.error_names for joint, column in found.items() for name in column)
