"""The page of an identification: errors with intervals, curves, fits, what signals can tell; and that without data."""

import json

import numpy as np
import pytest

from rfem_jax import load_study
from rfem_jax.report.page.document import write_folder
from rfem_jax.report.tasks import study_problem
from rfem_jax.report.tasks.catalogue import report_on
from tests.report.conftest import STUDY
from tests.report.test_identification import CORRECTION, TABLES, build, measure, measure_machines

from .test_results import table, task_tab


@pytest.fixture
def identified(tmp_path, monkeypatch):
    """A function that writes the results of these tables, and returns the folder."""
    monkeypatch.setattr(study_problem, "build_problem", build)

    def write(tables, measuring=measure, **settings):
        measuring(tmp_path / "measured.csv", **settings)
        path = tmp_path / "study.toml"
        path.write_text(STUDY + tables, encoding="utf-8")
        report = report_on(load_study(path), "identification")
        out = tmp_path / "out"
        out.mkdir()
        report.write(out, report.run(out))
        write_folder(out)
        return out

    return write


def test_errors_intervals_curves_and_fits_are_shown(identified, open_page):
    out = identified(TABLES + CORRECTION)
    found, page = json.loads((out / "identification.json").read_text(encoding="utf-8")), open_page(out / "report.html")
    task_tab(page, "Identification")
    shown = [row[-1] for row in table(page, "#divisions")[1]]
    assert shown == ["fine enough"] * len(found["divisions"]) and "rfes" in [one["what"] for one in found["divisions"]]
    assert page.text("#identification-status") == f"Status ok: {found['message']}."
    head, rows = table(page, "#identified-errors")
    assert [row[0] for row in rows] == ["D.delta_x", "D.d_y"]
    tilt, one = rows[0], found["errors"][0]
    for label, key in (("estimate", "estimate"), ("95 % interval from", "low"), ("to", "high")):
        shown, unit = tilt[head.index(label)].split()
        assert unit == "deg" and float(shown) == pytest.approx(np.degrees(one[key]), rel=1e-3)
    assert tilt[head.index("tolerance \u00b1")] == "0.25 deg"
    assert len(page.all("#identification-curves figure")) == 2
    dots = page.all("#identification-curves figure:nth-child(1) circle.faint")
    assert len(dots) == found["signals"][0]["samples"] == 99
    assert len(page.all("#identification-curves figure:nth-child(1) polyline.curve")) == 2
    assert [row[-1] for row in table(page, "#fitted-signals")[1]] == ["fits", "fits"]
    assert len(table(page, "#combinations")[1]) == 2 and len(table(page, "#signal-worth")[1]) == 3
    # What is known of the errors together, and what a correction does.
    assert len(page.all("#posterior figure")) == 1 and len(page.all("#posterior circle.faint")) > 40
    head, rows = table(page, "#corrections")
    assert [row[0] for row in rows] == ["as it is", "D.delta_x", "D.d_y", "all together"]
    for row, outcome in zip(rows, found["correction"]["outcomes"], strict=True):
        shown = row[next(i for i, label in enumerate(head) if label.startswith("D.rms_moment"))]
        assert float(shown.split()[0]) == pytest.approx(outcome["mean"], rel=1e-3)
    assert len(page.all("#correction-chart polyline.curve")) == 3
    assert page.text("#correction-status").startswith("Status ok: ")
    assert page.complaints() == []


def test_what_signals_can_tell_is_shown_without_data(identified, open_page):
    more = 'experiments = { tilted = { "D.delta_z" = "0.1 deg" } }\n'
    out = identified(TABLES.replace('data = "measured.csv"\n', more))
    page = open_page(out / "report.html")
    task_tab(page, "Identification")
    head, rows = table(page, "#identified-errors")
    assert head == ["error", "deviation before", "deviation after"] and rows[1][1].endswith(" mm")
    assert not page.all("#identification-curves") and not page.all("#suspects")
    found = json.loads((out / "identification.json").read_text(encoding="utf-8"))["experiments"]
    head, rows = table(page, "#experiments")
    assert [row[0] for row in rows] == ["as given", "tilted"]
    shown = rows[1][head.index("D.d_y")]
    assert float(shown) == pytest.approx(found[1]["deviations"][-1][1], rel=1e-2)
    assert len(page.all("#experiment-lengths figure:nth-child(2) polyline")) == 2
    assert page.complaints() == []


def test_what_is_behind_a_misfit_is_shown(identified, open_page):
    text = TABLES.replace('offset = "1 N"', 'offset = "0 N"')
    out = identified(text, force=3.0)
    page = open_page(out / "report.html")
    task_tab(page, "Identification")
    found = json.loads((out / "identification.json").read_text(encoding="utf-8"))["suspects"]
    _, rows = table(page, "#suspects")
    assert found[0]["name"] == "offset of A_force_x_N" == rows[0][0] and rows[0][-1] == "explains it"
    assert page.complaints() == []


def test_the_errors_of_production_are_shown(identified, open_page):
    out = identified(TABLES, measure_machines)
    page = open_page(out / "report.html")
    task_tab(page, "Identification")
    assert page.text("#identification-status").startswith("Status ok: ")
    assert len(table(page, "#production")[1]) == 2 and len(table(page, "#machines")[1]) == 12
    assert page.text("#production-tolerances").startswith("[tolerances]") and page.complaints() == []
