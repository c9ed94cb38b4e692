"""Tasks on a closed-form problem: what is computed and written, and the commands that do it."""

import json
import math
import os
import subprocess
import sys
from pathlib import Path

import equinox as eqx
import jax
import numpy as np
import pytest

import rfem_jax.simulation
from rfem_jax import Explicit, GeneralisedAlpha, RungeKutta4, Tolerances, load_study, monte_carlo
from rfem_jax import worst_case as search
from rfem_jax.compilation.stages import listening
from rfem_jax.report import command_line
from rfem_jax.report.command_line import main
from rfem_jax.report.drawings import pictures
from rfem_jax.report.tasks import catalogue, study_problem, task_report
from rfem_jax.report.tasks.task_overview import tasks_text
from rfem_jax.tolerancing.problems import sharing
from rfem_jax.tolerancing.problems.results_store import ResultsStore
from rfem_jax.tolerancing.problems.simulated_problem import finer_method
from tests.processes import path_without_matplotlib
from tests.study_texts import ROUND, STEEL, hinge, link

from . import closed_form
from .conftest import STUDY, rows_of

TASKS = """
[tolerances]
"D.delta_x" = "0.25 deg"
"D.delta_z" = "0.25 deg"
"D.d_y" = "0.25 mm"
[sensitivity]
metrics = ["D.mean_square_moment", "A.mean_square_force"]
half_step = true
[monte_carlo]
metrics = ["A.mean_square_force"]
limits = { "D.mean_square_moment" = 7.0 }
n = 32
batch = 8
seed = 3
[worst_case]
metrics = ["D.mean_square_moment", "A.mean_square_force"]
starts = { corners = 2, sobol = 2 }
[allocation]
limits = { "D.mean_square_moment" = 21.0 }
starts = { corners = 2, sobol = 2 }
scales = [0.5, 2.0]
[allocation.bounds]
"D.delta_x" = ["0.02 deg", "2 deg"]
"D.delta_z" = ["0.02 deg", "2 deg"]
"D.d_y" = ["0.02 mm", "2 mm"]
"""
BUILD_PROBLEM = study_problem.build_problem
MOMENT, FORCE = "D.mean_square_moment", "A.mean_square_force"


@pytest.fixture(autouse=True)
def closed(monkeypatch):
    """The simulator replaced by a closed form; no settings of the process are changed."""
    monkeypatch.setattr(study_problem, "build_problem", closed_form.build_problem)
    monkeypatch.setattr(command_line, "set_up_jax", lambda *_: None)
    monkeypatch.setattr(rfem_jax.simulation, "check_step", lambda model, method, drive: 1.9e-5)


@pytest.fixture
def task_file(tmp_path):
    path = tmp_path / "tasks.toml"
    path.write_text(STUDY + TASKS, encoding="utf-8")
    return path


def call(command, task_file, out, *options):
    return main([command, str(task_file), "--out", str(out), *options])


def read(path):
    return json.loads(path.read_text(encoding="utf-8"))


def names_in(folder):
    """Files in a folder besides the page, which every command writes."""
    names = {path.name for path in folder.iterdir()}
    assert "report.html" in names
    return names - {"report.html"}


def test_sensitivity(task_file, tmp_path, capsys):
    out = tmp_path / "out"
    assert call("sensitivity", task_file, out) == 0
    names = {"sensitivity.json", "sensitivity.csv"}
    assert names_in(out) == names | {
        "sensitivity_heat_map.png",
        "sensitivity_tornado.png",
        "sensitivity_contributions.png",
    }
    found = read(out / "sensitivity.json")
    assert (found["status"], found["undamped"]) == ("ok", False)
    moment, force = found["metrics"][MOMENT], found["metrics"][FORCE]
    assert moment["character"] == "kink"
    expected = {"D.delta_x": 16.0, "D.delta_z": 4.0, "D.d_y": 1.0}
    assert moment["effects"] == pytest.approx(expected)
    assert force["gradient"]["D.delta_x"] == pytest.approx(30.0 / closed_form.WIDTHS[0])
    # The finer step changes moments by one per cent, forces not at all.
    assert moment["hessian_change_at_finer_step"] == pytest.approx(0.01)
    assert force["hessian_change_at_finer_step"] == 0.0
    first = moment["principal_directions"][0]
    assert first["eigenvalue"] == pytest.approx(32.0)
    assert first["direction"]["D.delta_x"] == pytest.approx(1.0)
    assert found["units"][MOMENT] == "(N m)^2"
    rows = rows_of(out / "sensitivity.csv")
    ranked = [row["error"] for row in rows if row["metric"] == MOMENT]
    assert ranked == ["D.delta_x", "D.delta_z", "D.d_y"]
    assert list(rows[0]) == [
        *("metric", "error", "rank", "character", "unit", "value", "gradient", "gradient_unit"),
        *("gradient_per_tolerance", "curvature", "curvature_unit", "curvature_per_tolerance", "effect"),
        "vanishes_by_symmetry",
        "factor",
        "variance_linear_percent",
        "variance_first_order_percent",
        "variance_total_percent",
    ]
    units = {(row["metric"], row["error"]): [row[key] for key in rows[0] if key.endswith("unit")] for row in rows}
    assert units[MOMENT, "D.delta_x"] == ["(N m)^2", "(N m)^2/rad", "(N m)^2/rad^2"]
    assert units[FORCE, "D.d_y"] == ["N^2", "N^2/m", "N^2/m^2"]
    text = capsys.readouterr().out
    # Tolerances in the units of the study, gradients per such a unit.
    assert "[(N m)^2]" in text and "gradient per deg, mm" in text
    assert [line.split()[1:4] for line in text.splitlines() if line.startswith("D.delta_x")][1] == [
        "0.25",
        "deg",
        "120",
    ]
    assert [line.split()[1:3] for line in text.splitlines() if line.startswith("D.d_y")][1] == ["0.25", "mm"]
    assert " rad" not in text
    assert "Change with the finer step" in text
    directions = text[text.index("the first principal direction") :].splitlines()
    first = next(line for line in directions if line.startswith(MOMENT)).split()
    head = next(line for line in directions if "D.delta_x" in line).split()
    assert first[first.index("+1.00") :] == ["+1.00", "+0.00", "+0.00"] and head[-3] == "D.delta_x"
    assert "damping" not in text


@pytest.mark.long
@pytest.mark.parametrize("command", ["run", "sensitivity"])
def test_the_process_that_draws_is_started_before_anything_is_computed(command, task_file, tmp_path, monkeypatch, runs):
    order = []
    monkeypatch.setattr(pictures, "draw_beside", lambda: order.append("started"))
    monkeypatch.setattr(rfem_jax.simulation, "run_cases", lambda *_, **__: order.append("cases") or (None, runs))
    monkeypatch.setattr(catalogue, "do_task", lambda *_: order.append("task") or (True, []))
    assert call(command, task_file, tmp_path / "out") == 0
    assert order[0] == "started" and order[1] in ("cases", "task") and order.count("started") == 1


def test_a_report_of_derivatives_says_that_there_is_no_damping(task_file, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(closed_form.ClosedForm, "undamped", True)
    assert call("sensitivity", task_file, tmp_path / "out") == 0
    assert "No flexible link has damping" in capsys.readouterr().out
    assert read(tmp_path / "out" / "sensitivity.json")["undamped"] is True


def test_monte_carlo(task_file, tmp_path, capsys):
    out = tmp_path / "out"
    assert call("monte-carlo", task_file, out) == 0
    pictures = {"monte_carlo_histograms.png", "monte_carlo_scatter_matrix.png"}
    assert names_in(out) == {"monte_carlo", "monte_carlo.json", "monte_carlo.csv", *pictures}
    assert len(list((out / "monte_carlo").glob("chunk-*.npz"))) == 4
    found, rows = read(out / "monte_carlo.json"), rows_of(out / "monte_carlo.csv")
    assert (found["samples"], found["good"], len(rows)) == (32, 32, 32)
    errors = [f"{n}_{u}" for n, u in zip(closed_form.NAMES, ("rad", "rad", "m"), strict=True)]
    assert list(rows[0]) == ["sample", "status", *errors, f"{FORCE}_N2", f"{MOMENT}_N2m2"]
    moments = np.array([float(row[f"{MOMENT}_N2m2"]) for row in rows])
    z = np.array([[float(row[name]) for name in errors] for row in rows]) / closed_form.WIDTHS
    assert np.max(np.abs(z)) < 1.0
    np.testing.assert_allclose(moments, np.sum((z * closed_form.ROOTS) ** 2, axis=1), rtol=1e-9)
    statistics = found["metrics"][MOMENT]
    assert statistics["mean"]["value"] == pytest.approx(np.mean(moments))
    assert statistics["mean"]["low"] < 7.0 < statistics["mean"]["high"]  # 21 / 3 in the limit
    assert statistics["yield_of_all"]["value"] == pytest.approx(np.mean(moments <= 7.0))
    assert statistics["limits"] == [None, 7.0]
    assert "all limits" in capsys.readouterr().out


def test_pictures_of_a_task_can_be_left_out(task_file, tmp_path, monkeypatch):
    monkeypatch.setattr(task_report, "write_pictures", None)
    out = tmp_path / "out"
    assert call("monte-carlo", task_file, out, "--no-pictures") == 0
    assert names_in(out) == {"monte_carlo", "monte_carlo.json", "monte_carlo.csv"}


@pytest.mark.long
def test_an_interrupted_study_continues_by_the_same_command(task_file, tmp_path, monkeypatch):
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    assert call("monte-carlo", task_file, whole) == 0
    write, written = ResultsStore.write, []

    def interrupted(store, index, arrays):
        if index == 2 and not written.count(2):
            written.append(2)
            raise KeyboardInterrupt
        written.append(index)
        write(store, index, arrays)

    monkeypatch.setattr(ResultsStore, "write", interrupted)
    assert call("monte-carlo", task_file, parts) == 130
    assert not (parts / "monte_carlo.json").exists()
    assert call("monte-carlo", task_file, parts) == 0
    assert written == [0, 1, 2, 2, 3]
    for name in ("monte_carlo.json", "monte_carlo.csv"):
        assert (parts / name).read_bytes() == (whole / name).read_bytes()


@pytest.mark.long
def test_a_finished_study_is_extended_by_a_larger_n(task_file, tmp_path):
    small, out, whole = tmp_path / "small.toml", tmp_path / "out", tmp_path / "whole"
    small.write_text(task_file.read_text(encoding="utf-8").replace("n = 32", "n = 20"), encoding="utf-8")
    assert call("monte-carlo", small, out) == 0
    assert read(out / "monte_carlo.json")["samples"] == 20
    assert call("monte-carlo", task_file, out) == 0
    assert call("monte-carlo", task_file, whole) == 0
    for name in ("monte_carlo.json", "monte_carlo.csv"):
        assert (out / name).read_bytes() == (whole / name).read_bytes()


def test_the_command_shows_the_progress_of_a_sensitivity_study(task_file, tmp_path):
    seen = []
    with listening(lambda stage, done: seen.append((stage, done))):
        assert call("sensitivity", task_file, tmp_path / "out") == 0
    told = [done for stage, done in seen if stage.startswith("Differentiating 2 metrics")]
    assert told == [None, 0.5, 1.0]  # both steps


def test_the_folder_of_another_study_is_refused(task_file, tmp_path, capsys):
    out = tmp_path / "out"
    assert call("monte-carlo", task_file, out) == 0
    text = task_file.read_text(encoding="utf-8").replace("seed = 3", "seed = 4")
    task_file.write_text(text, encoding="utf-8")
    capsys.readouterr()
    assert call("monte-carlo", task_file, out) == 2
    error = capsys.readouterr().err.splitlines()[-1]
    assert "another study" in error and "key" in error and "monte_carlo" in error


def test_a_full_disk_is_one_sentence(task_file, tmp_path, capsys, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(task_report, "write_csv", full)
    assert call("worst-case", task_file, tmp_path / "out") == 2
    assert "No space left on device" in capsys.readouterr().err.splitlines()[-1]


def test_worst_case(task_file, tmp_path, capsys):
    out = tmp_path / "out"
    assert call("worst-case", task_file, out) == 0
    table = capsys.readouterr().out.split("Largest A.mean_square_force")[1].splitlines()
    assert table[3].split()[:4] == ["D.delta_x", "0.25", "deg", "upper"]
    assert table[5].split()[:3] == ["D.d_y", "0", "mm"]
    names = {"worst_case.json", "worst_case.csv", "worst_case_corners.png"}
    assert names_in(out) == names
    found = read(out / "worst_case.json")["metrics"]
    assert found[MOMENT]["value"] == pytest.approx(21.0, rel=1e-9)
    assert found[MOMENT]["corners"]["values"] == pytest.approx([21.0] * 8)
    assert found[FORCE]["value"] == pytest.approx(935.0)
    assert found[FORCE]["errors"]["D.delta_x"] == pytest.approx(closed_form.WIDTHS[0])
    rows = [row for row in rows_of(out / "worst_case.csv") if row["metric"] == FORCE]
    assert [row["kind"] for row in rows] == ["found", "best_corner", "quadratic_model", "nominal"]
    assert list(rows[0]) == ["metric", "unit", "kind", "value", "D.delta_x_rad", "D.delta_z_rad", "D.d_y_m"]
    assert rows[0]["unit"] == "N^2"
    assert float(rows[0]["D.delta_x_rad"]) == pytest.approx(closed_form.WIDTHS[0])


def test_allocation(task_file, tmp_path, capsys):
    out = tmp_path / "out"
    assert call("allocate", task_file, out) == 0
    pictures = {"allocation_tolerances.png", "allocation_front.png"}
    tables = {"allocation.json", "allocation.csv", "allocation_front.csv"}
    assert names_in(out) == tables | pictures
    found = read(out / "allocation.json")
    # min sum 1/s_i with sum (a_i s_i)^2 = 21, s_i = t_i / (tolerance before): s_i ~ a_i^(-2/3).
    shape = np.array(closed_form.ROOTS) ** (-2.0 / 3.0)
    s = shape * math.sqrt(21.0 / np.sum((np.array(closed_form.ROOTS) * shape) ** 2))
    after = np.array([found["tolerances"][name] for name in closed_form.NAMES])
    np.testing.assert_allclose(after / closed_form.WIDTHS, s, rtol=2e-3)
    assert found["cost"] == pytest.approx(np.sum(1.0 / s), rel=1e-3)
    assert found["before"]["cost"] == pytest.approx(3.0)
    front = rows_of(out / "allocation_front.csv")
    assert [row["status"] for row in front] == ["ok"] * 3
    limits = [f"{MOMENT}_upper_limit_N2m2", f"{MOMENT}_upper_verified_N2m2"]
    tolerances = ["D.delta_x_rad", "D.delta_z_rad", "D.d_y_m"]
    assert list(front[0]) == ["scale", "status", "cost", *limits, *tolerances]
    assert [row["unit"] for row in rows_of(out / "allocation.csv")] == ["rad", "rad", "m"]
    # Moments scale with the square of all tolerances, costs with their inverse.
    costs = [float(row["cost"]) for row in front]
    np.testing.assert_allclose(costs[0] / costs[1], math.sqrt(2.0), rtol=2e-3)
    np.testing.assert_allclose(costs[2] / costs[1], math.sqrt(0.5), rtol=2e-3)
    text = capsys.readouterr().out
    assert "Cost against limits" in text
    (row,) = [line.split() for line in text.splitlines() if line.startswith("D.delta_x")]
    assert row[2] == "deg" and float(row[1]) == pytest.approx(math.degrees(found["tolerances"]["D.delta_x"]), rel=1e-4)


def test_a_request_that_cannot_be_met_is_exit_code_3_and_is_written(task_file, tmp_path):
    text = task_file.read_text(encoding="utf-8").replace('" = 21.0 }', '" = 1e-3 }')
    task_file.write_text(text.replace("scales = [0.5, 2.0]", ""), encoding="utf-8")
    assert call("allocate", task_file, tmp_path / "out") == 3
    found = read(tmp_path / "out" / "allocation.json")
    assert found["status"] == "infeasible"
    assert MOMENT in found["message"]


@pytest.mark.long
def test_run_does_the_cases_and_then_every_task(task_file, tmp_path, capsys, monkeypatch, runs):
    monkeypatch.setattr(rfem_jax.simulation, "run_cases", lambda study, **_: (None, runs))
    done = []

    def do_task(study, name, folder, pictures):
        done.append(name)
        return name != "worst_case", [folder / name]

    monkeypatch.setattr(catalogue, "do_task", do_task)
    assert call("run", task_file, tmp_path / "out") == 3  # one task did not succeed
    assert done == ["sensitivity", "monte_carlo", "worst_case", "allocation"]
    assert "23 files written" in capsys.readouterr().out


def test_check_prints_the_tasks(task_file, study, capsys):
    assert main(["check", str(task_file)]) == 0
    text = capsys.readouterr().out
    assert "D.delta_x  -0.25 deg  0.25 deg  uniform" in text
    assert "limits: D.mean_square_moment <= 7" in text
    assert "D.d_y 0.02 mm to 2 mm" in text
    assert tasks_text(study) == ""


def test_a_command_without_its_table_is_refused(study_file, tmp_path, capsys):
    assert call("worst-case", study_file, tmp_path / "out") == 2
    assert "[worst_case]" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("options", "word"),
    [
        (("--devices", "0"), "`--devices`"),
        (("--processes", "2"), "`--process-id`"),
        (("--processes", "2", "--process-id", "2"), "0 <= I < N"),
        (("--process-id", "0"), "`--processes`"),
    ],
)
def test_wrong_options_are_one_sentence(task_file, tmp_path, capsys, options, word):
    assert call("monte-carlo", task_file, tmp_path / "out", *options) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1 and word in lines[0]


@pytest.mark.parametrize(
    ("method", "expected"),
    [
        (RungeKutta4(step=2e-5), RungeKutta4(step=1e-5)),
        (
            GeneralisedAlpha(step=2e-3, contact_tolerance=0.02),
            GeneralisedAlpha(step=1e-3, contact_tolerance=0.005),  # steps that follow are halved
        ),
        (Explicit("dopri8", rtol=1e-6, atol=1e-9), Explicit("dopri8", rtol=1e-7, atol=1e-10)),
    ],
)
def test_the_finer_method(method, expected):
    finer = finer_method(method)
    assert type(finer) is type(expected)
    numbers = {name: value for name, value in vars(expected).items() if isinstance(value, float)}
    assert {name: getattr(finer, name) for name in numbers} == pytest.approx(numbers)


def test_distributions_are_those_that_are_specified(tmp_path):
    path = tmp_path / "study.toml"
    text = """
[tolerances]
"D.delta_x" = { half_width = 0.3, distribution = "normal", deviations = 2 }
"D.d_y" = { interval = [-1e-3, 3e-3], distribution = "triangular" }
[[tolerances.correlated]]
half_widths = { "B.d_x" = 3e-3, "B.d_z" = 6e-3 }
correlation = -0.5
"""
    path.write_text(STUDY + text, encoding="utf-8")
    study = load_study(path)
    found = Tolerances.of(study)
    assert eqx.tree_equal(found, Tolerances.of(study.tolerances))
    assert found.names == ("D.delta_x", "D.d_y", "B.d_x", "B.d_z")
    means = {name: float(mean) for name, mean in found.means().items()}
    assert means["D.d_y"] == pytest.approx(1e-3)
    covariance = np.asarray(found.covariance())
    expected = [0.15**2, (2e-3) ** 2 / 6.0, 1e-6, 4e-6]
    np.testing.assert_allclose(np.diag(covariance), expected, rtol=1e-9)
    assert covariance[2, 3] == pytest.approx(-1e-6)


def test_the_tolerances_of_a_study_serve_as_an_argument(task_file):
    study = load_study(task_file)
    problem = closed_form.build([MOMENT])
    known, key = Tolerances.of(study), jax.random.key(0)
    for given in (study, study.tolerances):
        found = monte_carlo(problem, given, 16, key)
        np.testing.assert_array_equal(found.values, monte_carlo(problem, known, 16, key).values)
        assert search(problem, given, MOMENT, key=key).value == pytest.approx(21.0)
    assert study.tolerances.half_widths()["D.d_y"] == 2.5e-4


def test_a_study_without_tolerances_has_no_distributions(study, refused):
    assert study.tolerances is None
    with refused("`study`", "specifies none", "[tolerances]"):
        Tolerances.of(study)
    with refused("`study`", "was {'D.d_y': 0.001}"):
        Tolerances.of({"D.d_y": 1e-3})


PROCESS = """
import sys
from rfem_jax.report import command_line
command_line.set_up_jax(1)
from rfem_jax.report.tasks import study_problem
import rfem_jax.simulation
rfem_jax.simulation.check_step = lambda model, method, drive: None
def build_problem(study, metrics, model=None, trials=None):
    from tests.report import closed_form
    return closed_form.build_problem(study, metrics)
study_problem.build_problem = build_problem
sys.exit(command_line.main(sys.argv[1:]))
"""


@pytest.mark.long
def test_two_processes_share_the_samples(task_file, tmp_path):
    out, root = tmp_path / "out", Path(__file__).parents[2]
    # Without pictures: these are drawn by one process as by two.
    alone = [sys.executable, "-c", PROCESS, "monte-carlo", str(task_file), "--devices", "1", "--out"]
    command = [*alone, str(out), "--processes", "2", "--process-id"]
    environment = {**os.environ, "JAX_PLATFORMS": "cpu"}
    environment["PYTHONPATH"] = path_without_matplotlib(tmp_path / "path")
    started = [
        subprocess.Popen(
            [*command, str(number)],
            cwd=root,
            env=environment,
            text=True,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
        )
        for number in range(2)
    ]
    answers = [process.communicate(timeout=120) for process in started]
    assert [process.returncode for process in started] == [0, 0], answers
    assert "Process 1 computed 2 chunks." in answers[1][0]
    # A process of the same kind: this one compiles without most optimisations, and rounds differently.
    subprocess.run([*alone, str(tmp_path / "alone")], cwd=root, env=environment, check=True, capture_output=True)
    for name in ("monte_carlo.json", "monte_carlo.csv"):
        assert (out / name).read_bytes() == (tmp_path / "alone" / name).read_bytes()
    assert not list((out / "monte_carlo").glob("*.alive"))


def test_a_process_whose_partner_stops_says_so(task_file, monkeypatch, tmp_path, capsys, closed):
    monkeypatch.setattr(sharing.SignsOfLife, "stopped", lambda signs: [1])
    out = tmp_path / "out"
    assert call("monte-carlo", task_file, out, "--processes", "2", "--process-id", "0") == 3
    (sentence,) = [line for line in capsys.readouterr().err.splitlines() if "stopped" in line]
    assert "Process 1 has stopped" in sentence and "finished chunks are kept" in sentence
    assert "--out" not in sentence and list((out / "monte_carlo").glob("chunk-*.npz"))
    assert call("monte-carlo", task_file, out) == 0


PENDULUM = f"""
[mechanism]
gravity = [0.0, 0.0, -9.81]
{STEEL}damping = 1e-5
{ROUND}{link("arm", 0.3, "rfes = 2")}{hinge("arm")}[drive]
joint = "A"
kind = "prescribed_rate"
rate = 3.0
[simulation]
duration = 4e-4
step = 2e-5
save_every = 4e-4
[tolerances]
"A.delta_x" = "0.5 deg"
"arm.length" = "1 mm"
[monte_carlo]
metrics = ["A.mean_square_moment"]
n = 3
lanes = 2
"""


@pytest.mark.slow
def test_the_simulator_itself_serves_as_the_problem(tmp_path, monkeypatch):
    monkeypatch.setattr(study_problem, "build_problem", BUILD_PROBLEM)
    path, out = tmp_path / "study.toml", tmp_path / "out"
    path.write_text(PENDULUM, encoding="utf-8")
    assert call("monte-carlo", path, out) == 0
    # The arm lies level: the joint carries its weight, m g L / 2.
    mass = 7850.0 * math.pi * 0.005**2 * 0.3
    expected = (mass * 9.81 * 0.15) ** 2
    rows = rows_of(out / "monte_carlo.csv")
    assert [row["status"] for row in rows] == ["0"] * 3
    values = [float(row["A.mean_square_moment_N2m2"]) for row in rows]
    assert values == pytest.approx([expected] * 3, rel=0.03)
    assert len(set(values)) == 3
