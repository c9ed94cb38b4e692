"""[optimise] on closed forms: from the study file to tables, pictures and exit codes."""

import json
import math

import numpy as np
import pytest

from rfem_jax import FunctionProblem, Metric, load_study
from rfem_jax.report.command_line import main
from rfem_jax.report.tasks.catalogue import report_on
from rfem_jax.report.tasks.task_overview import tasks_text
from rfem_jax.text_layout import WIDTH

from .conftest import STUDY, rows_of

HEIGHT, WIDTH_OF_TILT = 0.01, math.radians(0.25)
TABLES = """
[design]
"bar.height" = ["6 mm", "14 mm"]
[tolerances]
"D.delta_x" = "0.25 deg"
[optimise]
objective = { "A.mean_square_force" = 1.0, cost = 2.0 }
limits = { "D.mean_square_moment" = 4.0 }
front = [0.4, 0.5, 0.6]
[optimise.bounds]
"D.delta_x" = ["0.02 deg", "1 deg"]
[optimise.cost]
model = "reciprocal"
"""
METRICS = {
    "D.mean_square_moment": Metric("D.mean_square_moment", "(N m)^2", "mean square moment in D"),
    "A.mean_square_force": Metric("A.mean_square_force", "N^2", "mean square force in A"),
}


class Bar(FunctionProblem):
    """A bar whose height u, in 10 mm, makes its bearing stiff, and whose tilt loads it the more the higher it is."""

    undamped = False

    def nominal_value(self, name):
        return HEIGHT if name == "bar.height" else 0.0


def build_problem(study, metrics, model=None, trials=None):
    def function(errors):
        u, tilt = 1.0 + errors["bar.height"] / HEIGHT, errors["D.delta_x"] / WIDTH_OF_TILT
        values = {"A.mean_square_force": 2.0 / u, "D.mean_square_moment": (4.0 * u * tilt) ** 2}
        return {name: values[name] for name in metrics}

    names = ("bar.height", "D.delta_x")
    return Bar(function, names, [METRICS[name] for name in metrics], error_units={"bar.height": "m"})


@pytest.fixture
def path(answered_by):
    return answered_by(build_problem, TABLES)


@pytest.mark.slow
def test_an_optimum_is_computed_written_and_drawn(path, tmp_path, capsys):
    out = tmp_path / "out"
    assert main(["optimise", str(path), "--out", str(out)]) == 0
    files = ("optimise.json", "optimise.csv", "optimise_limits.csv", "optimise_front.csv", "report.html")
    assert {one.name for one in out.iterdir()} == {*files, "optimise_answer.png", "optimise_front.png"}
    # 4 u t = 2 in the worst case, at a price of 1 / t: min 2 / u + 2 (2 u).
    u = math.sqrt(0.5)
    height, tilt = rows_of(out / "optimise.csv")
    assert (height["name"], height["kind"], height["unit"]) == ("bar.height", "dimension", "m")
    numbers = [float(height[key]) for key in ("before", "after", "lowest", "highest")]
    assert numbers == pytest.approx([HEIGHT, u * HEIGHT, 0.006, 0.014], rel=1e-4)
    assert (tilt["name"], tilt["kind"], tilt["unit"]) == ("D.delta_x", "tolerance", "rad")
    before, after = float(tilt["before"]), float(tilt["after"])
    assert (before, after) == pytest.approx((WIDTH_OF_TILT, WIDTH_OF_TILT / (2.0 * u)), rel=1e-4)
    (limit,) = rows_of(out / "optimise_limits.csv")
    assert float(limit["verified"]) == pytest.approx(4.0, rel=1e-5) and limit["side"] == "upper"
    assert float(limit["nominal"]) == 0.0
    # d (4 u) / d limit, u from the tilt's price alone: c = 2 / u + 4 u sqrt(4 / limit).
    assert float(limit["shadow_price"]) == pytest.approx(-4.0 * u / 8.0, rel=1e-3)
    # (1 - w) 2 / u over 2 and w 2 u over 2: u^2 = (1 - w) / w; w = 0.6 and 0.4 are inside the bounds.
    front = {float(row["weight"]): row for row in rows_of(out / "optimise_front.csv")}
    for weight, row in front.items():
        expected = math.sqrt((1.0 - weight) / weight)
        assert float(row["bar.height_m"]) == pytest.approx(expected * HEIGHT, rel=1e-3)
        assert float(row["cost"]) == pytest.approx(2.0 * expected, rel=1e-3) and row["status"] == "ok"
        assert float(row["D.delta_x_tolerance_rad"]) == pytest.approx(WIDTH_OF_TILT / (2.0 * expected), rel=1e-3)
    found = json.loads((out / "optimise.json").read_text(encoding="utf-8"))
    assert found["status"] == "ok" and found["designs"]["bar.height"] == pytest.approx(u * HEIGHT, rel=1e-4)
    units = {"bar.height": "m", "D.delta_x": "rad", "D.mean_square_moment": "(N m)^2"}
    assert units.items() <= found["units"].items()
    assert [one["weight"] for one in found["front"]] == [0.4, 0.5, 0.6]
    assert found["task"]["bounds"]["D.delta_x"] == pytest.approx([math.radians(0.02), math.radians(1.0)])
    printed = capsys.readouterr().out
    assert "Optimum (worst case): status ok" in printed and "Pareto front" in printed
    assert max(len(line) for line in printed.splitlines() if str(tmp_path) not in line) <= WIDTH


def test_the_pictures_show_the_answer_between_its_bounds(path, tmp_path):
    report = report_on(load_study(path), "optimise")
    result = report.run(tmp_path)
    figures = report.pictures(result)
    axes = figures["optimise_answer"].axes[0]
    assert [one.get_text() for one in axes.get_yticklabels()] == ["D.delta_x (tolerance)", "bar.height"]
    points = [one for line in axes.lines for one in zip(line.get_xdata(), line.get_ydata(), strict=True)]
    # The height from 6 to 14 mm, before 10 and after 7.07.
    before, after = (x for x, place in points if place == 1 and 0.0 < x < 1.0)
    assert (before, after) == pytest.approx((0.5, (math.sqrt(50.0) - 6.0) / 8.0), abs=1e-4)
    front = figures["optimise_front"].axes[0]
    line = front.lines[0]
    forces, costs = line.get_xdata(), line.get_ydata()
    np.testing.assert_allclose(np.asarray(forces) * np.asarray(costs), 4.0, rtol=1e-6)
    assert "cost" in front.get_ylabel() and front.get_xlabel().startswith("A.mean_square_force, N^2")
    assert "objective: 1 A.mean_square_force + 2 cost" in " ".join(tasks_text(load_study(path)).split())


def test_what_cannot_be_met_has_another_exit_code(path, tmp_path, capsys):
    text = TABLES.replace('{ "D.mean_square_moment" = 4.0 }', '{ "A.mean_square_force" = 1.0 }')
    path.write_text(STUDY + text.replace("front = [0.4, 0.5, 0.6]\n", ""), encoding="utf-8")
    assert main(["optimise", str(path), "--out", str(tmp_path / "out")]) == 3
    printed = " ".join(capsys.readouterr().out.split())
    assert "status infeasible" in printed and "at most 1 N^2 on A.mean_square_force cannot be met" in printed
    path.write_text(STUDY + "[optimise]\nobjective = 'mass'\n", encoding="utf-8")
    assert main(["optimise", str(path), "--out", str(tmp_path / "other")]) == 2
    assert "must have something to change" in " ".join(capsys.readouterr().err.split())
