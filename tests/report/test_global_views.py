"""Sweeps, reliability studies, zones, contributions on a closed form: from the study file to table and picture."""

import json

import numpy as np
import pytest
from scipy import stats

from rfem_jax import Tolerances, load_study
from rfem_jax.report.command_line import main
from rfem_jax.report.tasks.catalogue import report_on
from rfem_jax.report.tasks.task_overview import tasks_text
from rfem_jax.text_layout import WIDTH

from . import closed_form
from .conftest import STUDY, rows_of

TABLES = """
[tolerances]
"D.delta_x" = { half_width = "0.25 deg", cp = 1.0 }
"D.delta_z" = { half_width = "0.25 deg", distribution = "normal" }
"D.d_y" = "0.25 mm"
[sweep]
metrics = ["D.mean_square_moment", "A.mean_square_force"]
levels = 3
batch = 8
at = { "D.d_y" = "0.1 mm" }
[reliability]
limits = { "D.mean_square_moment" = 36.0, "A.mean_square_force" = [850.0, inf] }
n = 2000
[sensitivity]
metrics = ["A.mean_square_force"]
"""


@pytest.fixture
def path(answered_by):
    return answered_by(closed_form.build_problem, TABLES)


@pytest.mark.slow
def test_a_sweep_is_computed_written_drawn_and_continued(path, tmp_path, capsys):
    out = tmp_path / "out"
    assert main(["sweep", str(path), "--out", str(out)]) == 0
    assert {one.name for one in out.iterdir()} == {
        *("sweep", "sweep.csv", "sweep.json", "sweep_responses.png", "sweep_contours.png", "report.html")
    }
    rows = rows_of(out / "sweep.csv")
    assert len(rows) == 9
    width = np.radians(0.25)
    for row in rows:
        x, z = (float(row[f"D.delta_{axis}_rad"]) / width for axis in "xz")
        assert float(row["D.mean_square_moment_N2m2"]) == pytest.approx(16 * x**2 + 4 * z**2 + 0.16)
        assert float(row["D.mean_square_moment_surface_N2m2"]) == pytest.approx(16 * x**2 + 4 * z**2 + 0.16)
    found = json.loads((out / "sweep.json").read_text(encoding="utf-8"))
    moment = found["surface"]["metrics"]["D.mean_square_moment"]
    assert moment["hessian"][0][0] == pytest.approx(32.0 / width**2) and moment["explained"] == pytest.approx(1.0)
    assert found["task"]["bounds"]["D.delta_x"] == pytest.approx([-width, width])
    printed = capsys.readouterr().out
    assert "9 points (3 levels of each), 0 failed" in printed and "cross-validated error" in printed
    assert max(len(line) for line in printed.splitlines() if str(tmp_path) not in line) <= WIDTH
    chunks = {one: one.stat().st_mtime_ns for one in out.rglob("chunk-*.npz")}
    assert len(chunks) == 2 and main(["sweep", str(path), "--out", str(out)]) == 0
    assert {one: one.stat().st_mtime_ns for one in out.rglob("chunk-*.npz")} == chunks
    path.write_text(STUDY + TABLES.replace("levels = 3", "levels = 4"), encoding="utf-8")
    assert main(["sweep", str(path), "--out", str(out)]) == 2
    assert "this sweep can start or continue" in capsys.readouterr().err.replace("\n", " ")


def test_the_pictures_of_a_sweep_show_its_points(path, tmp_path):
    report = report_on(load_study(path), "sweep")
    result = report.run(tmp_path)
    figures = report.pictures(result)
    line = figures["sweep_responses"].axes[0].lines[0]
    np.testing.assert_allclose(sorted(set(np.round(line.get_xdata(), 9))), [-0.25, 0.0, 0.25])
    np.testing.assert_allclose(line.get_ydata(), result.values[:, 0])
    contours = figures["sweep_contours"]
    assert contours.axes[0].get_xlabel() == "D.delta_x, deg" and contours.axes[0].get_ylabel() == "D.delta_z, deg"
    assert len(contours.axes[0].collections) > 0


@pytest.mark.long
def test_a_reliability_study_is_computed_written_and_drawn(path, tmp_path, capsys):
    out = tmp_path / "out"
    assert main(["reliability", str(path), "--out", str(out)]) == 0
    assert {one.name for one in out.iterdir()} == {
        *("reliability.csv", "reliability.json", "reliability_shares.png", "report.html")
    }
    moment, force = rows_of(out / "reliability.csv")
    # Force 900 + 30 z + 5 z'^2 below 850 takes z = -5/3, which is five standard deviations.
    assert (force["side"], force["unit"]) == ("lower", "N^2") and float(force["beta"]) == pytest.approx(5.0, rel=1e-4)
    assert float(force["first_order_probability"]) == pytest.approx(stats.norm.sf(5.0), rel=1e-3)
    assert float(force["D.delta_x_rad"]) == pytest.approx(-5.0 / 3.0 * np.radians(0.25), rel=1e-3)
    # Moment 16 z^2 + ... = 36 takes z = +-3/2 at most, 4.5 standard deviations; the others help a little.
    assert 2 * stats.norm.sf(4.5) < float(moment["probability"]) < 4 * stats.norm.sf(4.5)
    found = json.loads((out / "reliability.json").read_text(encoding="utf-8"))
    assert found["yield"] == pytest.approx(1.0 - found["any_limit"]["value"])
    assert found["limits"][0]["points"] == 2 and found["task"]["limits"]["A.mean_square_force"] == [850.0, None]
    printed = capsys.readouterr().out
    assert "breaks most probably at" in printed and "any limit" in printed
    assert max(len(line) for line in printed.splitlines() if str(tmp_path) not in line) <= WIDTH


def test_sensitivities_tell_contributions(path, tmp_path, capsys):
    out = tmp_path / "out"
    assert main(["sensitivity", str(path), "--out", str(out)]) == 0
    assert (out / "sensitivity_contributions.png").exists()
    by_error = {row["error"]: row for row in rows_of(out / "sensitivity.csv")}
    linear, square = 30.0**2 / 9.0, 25.0 * 2.0 / 81.0  # of 30 z and of 5 z^2, z normal of deviation 1/3
    expected = 100.0 * linear / (linear + square)
    assert float(by_error["D.delta_x"]["variance_total_percent"]) == pytest.approx(expected, rel=1e-9)
    assert float(by_error["D.delta_x"]["variance_linear_percent"]) == pytest.approx(100.0)
    assert float(by_error["D.d_y"]["variance_total_percent"]) == 0.0
    assert "Contributions to the variance in percent" in capsys.readouterr().out


def test_check_shows_zones_and_settings(path, capsys):
    zone = (
        '"B.position" = { fit = "25 H7/g6", length = "30 mm" }\n"C.parallelism" = { diameter = 2e-5, length = 0.03 }\n'
    )
    capable = TABLES.replace("cp = 1.0", 'cp = 1.5, cpk = 1.2, side = "lower"')
    path.write_text(STUDY + capable.replace("[sweep]", f"{zone}[sweep]"), encoding="utf-8")
    study = load_study(path)
    text = tasks_text(study)
    assert "zone B.position, cylinder of 0.041 mm" in text and "cpk 1.2 at the lower limit" in text
    assert "bounds: D.delta_x -0.25 deg to 0.25 deg" in text
    found = Tolerances.of(study)
    assert found.factors[-2:] == (("B.d_x", "B.d_z", "B.delta_x", "B.delta_z"), ("C.delta_x", "C.delta_z"))
    assert float(found.half_widths()["B.d_x"]) == pytest.approx(20.5e-6)


def test_what_the_tables_refuse(path, refused):
    for old, new, pieces in (
        ("levels = 3", 'bounds = { "D.delta_x" = ["1 deg", "0 deg"] }', ("[sweep]", "`bounds`", "rise")),
        ("levels = 3", 'bounds = { "Q.delta_x" = ["0 deg", "1 deg"] }', ("`sweep`", "`Q.delta_x`")),
        ("levels = 3", 'bounds = { "D.d_y" = [0, 1e-3] }', ("[sweep]", "`at`", "`D.d_y`")),
        ("levels = 3", "levels = 1", ("[sweep]", "`levels`", "at least 2")),
        ("n = 2000", "n = 20", ("[reliability]", "`n`", "at least 50")),
        ("[850.0, inf]", "[-inf, inf]", ("[reliability]", "`limits`", "finite end")),
    ):
        text = TABLES.replace(old, new, 1).replace("36.0", "inf" if "[-inf" in new else "36.0")
        path.write_text(STUDY + text, encoding="utf-8")
        with refused(*pieces):
            load_study(path)
    path.write_text(STUDY + "[sweep]" + TABLES.partition("[sweep]")[2].partition("[reliability]")[0], encoding="utf-8")
    with refused("[sweep]", "`bounds`", "no tolerances"):
        load_study(path)
