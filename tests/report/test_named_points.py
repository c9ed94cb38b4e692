"""Centres of joints and ends of links as points: in study files, in everything that commands write, in all tasks."""

import json

import numpy as np
import pytest
from numpy.testing import assert_allclose

from rfem_jax import InputError, load_study
from rfem_jax.description.metrics.path_metrics import REPORTED
from rfem_jax.report.command_line import main
from rfem_jax.simulation.cases import run_cases
from tests.report.test_paths import ERROR, LENGTH, RATE, STUDY, TOLERANCES, columns

pytestmark = pytest.mark.usefixtures("commands_here")

TABLE = '[[mechanism.points]]\nname = "tip"\nlink = "hand"\nposition = 0.3\n'
TITLE = 'title = "A hand that goes round"\n'
NAMED = STUDY.replace(TABLE, "").replace(TITLE, TITLE + 'metrics = ["hand.end.max_deviation", "A.max_deviation"]\n')
UPPER = 0.2
AT_REST = f"""
title = "A crank and a rod at rest"
metrics = ["B.x"]
[mechanism]
gravity = [0, 0, 0]
[mechanism.materials.steel]
youngs_modulus = "210 GPa"
poisson_ratio = 0.3
density = 7850.0
[mechanism.sections.bar]
shape = "circle"
diameter = "10 mm"
[[mechanism.links]]
name = "upper"
length = {UPPER}
section = "bar"
material = "steel"
rigid = true
[[mechanism.links]]
name = "hand"
length = {LENGTH}
section = "bar"
material = "steel"
rigid = true
[[mechanism.joints]]
name = "A"
parent = "base"
child = "upper"
[[mechanism.joints]]
name = "B"
parent = "upper"
child = "hand"
[statics]
hold = ["A", "B"]
"""
WIDE = '[tolerances]\n"upper.length" = "1 mm"\n"B.d_x" = "0.5 mm"\n'


def written(tmp_path, text):
    path = tmp_path / "study.toml"
    path.write_text(text, encoding="utf-8")
    return path


def answer(tmp_path, task, text):
    """What a task finds, as its JSON file has it."""
    path = written(tmp_path, AT_REST + text)
    assert main([task, str(path), "--out", str(tmp_path)]) == 0
    name = {"allocate": "allocation"}.get(task, task.replace("-", "_"))
    return json.loads((tmp_path / f"{name}.json").read_text(encoding="utf-8"))


def test_a_study_follows_the_points_that_its_metrics_name(tmp_path):
    study = load_study(written(tmp_path, NAMED))
    assert [point.name for point in study.mechanism.points] == ["hand.end", "A"]
    assert study.metrics == ("hand.end.max_deviation", "A.max_deviation")
    _, runs = run_cases(study)
    assert_allclose(runs["long"].points["hand.end"].position[0], (LENGTH + ERROR, 0.0, 0.0), atol=1e-12)
    assert list(runs.to_xarray().followed_point.values) == ["A", "hand.end"]


def test_a_list_of_names_is_followed_and_reported(tmp_path):
    text = STUDY.replace(TABLE, "").replace(
        "[mechanism.materials", '[mechanism]\npoints = ["hand.end"]\n[mechanism.materials'
    )
    study = load_study(written(tmp_path, text))
    assert study.metrics == tuple(f"hand.end.{kind}" for kind in REPORTED)
    # Tables beside names: a list of both.
    both = 'points = ["A", { name = "tip", link = "hand", position = 0.1 }]'
    study = load_study(written(tmp_path, text.replace('points = ["hand.end"]', both)))
    assert [point.name for point in study.mechanism.points] == ["tip", "A"]
    with pytest.raises(InputError, match=r"did you mean `hand\.end`"):
        load_study(written(tmp_path, text.replace("hand.end", "hand.ent")))


def test_tasks_alone_do_not_make_runs_follow_points(tmp_path):
    text = STUDY.replace(TABLE, "") + TOLERANCES.replace("tip", "hand.end")
    study = load_study(written(tmp_path, text))
    assert study.mechanism.points == () and study.tasks.monte_carlo.bands == ("hand.end",)


def test_a_run_and_a_page_have_the_end_of_the_hand(tmp_path):
    path = written(tmp_path, NAMED)
    assert main(["run", str(path), "--out", str(tmp_path / "out")]) == 0
    table = columns(tmp_path / "out" / "long.csv")
    assert_allclose(table["handend_x_m"], (LENGTH + ERROR) * np.cos(RATE * table["time_s"]), atol=1e-8)
    assert_allclose(table["A_x_m"], 0.0, atol=1e-12)
    metrics = json.loads((tmp_path / "out" / "results.json").read_text(encoding="utf-8"))["cases"]["long"]["metrics"]
    assert_allclose(metrics["hand.end.max_deviation"], ERROR, rtol=1e-8)
    assert metrics["A.max_deviation"] == 0.0


@pytest.mark.long
def test_monte_carlo_studies_have_the_band(tmp_path):
    path = written(tmp_path, STUDY.replace(TABLE, "") + TOLERANCES.replace("tip", "hand.end"))
    assert main(["monte-carlo", str(path), "--out", str(tmp_path)]) == 0
    band = columns(tmp_path / "monte_carlo_path_hand.end.csv")
    values = columns(tmp_path / "monte_carlo.csv")
    reach = np.maximum(band["across_largest_m"], -band["across_smallest_m"])
    assert_allclose(reach, values["handendmax_deviation_m"].max(), rtol=1e-9)
    assert (tmp_path / "monte_carlo_path_hand.end.png").stat().st_size > 10_000


@pytest.mark.long
def test_tasks_know_them_at_rest(tmp_path):
    found = answer(tmp_path, "sensitivity", WIDE + '[sensitivity]\nmetrics = ["hand.end.x", "B.x"]\norder = 1\n')
    for metric in ("hand.end.x", "B.x"):
        assert found["metrics"][metric]["gradient"] == pytest.approx({"upper.length": 1.0, "B.d_x": 1.0})
    assert found["metrics"]["B.x"]["value"] == pytest.approx(UPPER)
    found = answer(tmp_path, "worst-case", WIDE + '[worst_case]\nmetrics = ["hand.end.deviation_x"]\n')
    assert found["metrics"]["hand.end.deviation_x"]["value"] == pytest.approx(1.5e-3)
    answer(tmp_path, "sweep", WIDE + '[sweep]\nmetrics = ["hand.end.x"]\nlevels = 3\n')
    table = columns(tmp_path / "sweep.csv")
    assert_allclose(table["handendx_m"], UPPER + LENGTH + table["upperlength_m"] + table["Bd_x_m"], rtol=1e-12)


@pytest.mark.long
def test_tolerances_of_them_are_allocated(tmp_path):
    text = '[allocation]\nlimits = { "hand.end.deviation_x" = ["-0.5 mm", "0.5 mm"] }\n[allocation.bounds]\n'
    text += '"upper.length" = ["0.01 mm", "1 mm"]\n"hand.length" = ["0.01 mm", "2 mm"]\n'
    found = answer(tmp_path, "allocate", text)
    # Of a / t_1 + b / t_2 with t_1 + t_2 = t the least is where t_1 / t_2 = (a / b)^(1/2); costs are 1 at 1 and 2 mm.
    share = np.array([1.0, np.sqrt(2.0)]) / (1.0 + np.sqrt(2.0))
    assert_allclose(list(found["tolerances"].values()), 5e-4 * share, rtol=1e-4)
    assert found["status"] == "ok"


@pytest.mark.long
def test_a_design_is_found_by_them(tmp_path):
    text = '[design]\n"hand.length" = ["0.2 m", "0.4 m"]\n[optimise]\nobjective = { "hand.end.x" = 1.0 }\n'
    text += 'limits = { "hand.end.x" = ["0.45 m", "0.7 m"] }\nrobust = "nominal"\nstarts = 2\n'
    found = answer(tmp_path, "optimise", text)
    assert found["status"] == "ok" and found["designs"]["hand.length"] == pytest.approx(0.45 - UPPER, rel=1e-6)
