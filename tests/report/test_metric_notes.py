"""Wherever a norm over time is shown it is called what it is, and sensitivities say that derivatives of maxima jump."""

import json
from types import SimpleNamespace

import pytest

from rfem_jax import load_study, metric
from rfem_jax.description.metrics.catalogue import note_sentences
from rfem_jax.labelled_data import Labelled, Table
from rfem_jax.report.task_comparison import compare_tasks
from rfem_jax.report.tasks.sensitivity import kink_notes
from rfem_jax.report.tasks.task_files import write_task_json
from rfem_jax.tolerancing.labelled_results import MetricResult

from .conftest import STUDY

TABLES = """
[tolerances]
"D.delta_z" = "0.1 deg"
"B.position" = "0.2 mm"
[monte_carlo]
metrics = ["A.peak_force", "A.max_force", "A.rms_force"]
n = 16
"""


@pytest.fixture
def with_zone(tmp_path):
    path = tmp_path / "study.toml"
    path.write_text(STUDY + TABLES, encoding="utf-8")
    return load_study(path)


def test_norms_are_called_a_lower_bound_of_the_maximum():
    (line,) = note_sentences(("A.peak_force", "B.peak_force", "A.max_force", "end_energy"))
    assert line == (
        "peak_force: smooth 16-norm over the saved times, a lower bound of the maximum, which is `max_force`."
    )
    assert (
        "below its maximum" in metric("A.peak_moment").label and metric("A.max_moment").label == "largest moment in A"
    )


def test_files_of_tasks_say_it_too_and_name_zones(with_zone, tmp_path):
    content = json.loads(write_task_json(tmp_path / "x.json", with_zone, "monte_carlo", {}).read_text(encoding="utf-8"))
    assert list(content["metric_notes"]) == ["peak_force"] and "lower bound" in content["metric_notes"]["peak_force"]
    (zone,) = with_zone.tasks.tolerances.zones
    assert content["zone_names"] == {"+".join(zone.errors): "B.position"} and len(zone.errors) > 1


def test_sensitivities_say_that_derivatives_of_maxima_jump():
    (text,) = kink_notes(SimpleNamespace(metrics=("A.max_force", "A.rms_force", "D.angle_range")))
    assert text.startswith("A.max_force, D.angle_range: maxima or ranges over time; ") and "jump" in text
    assert kink_notes(SimpleNamespace(metrics=("A.peak_force", "A.mean_square_force"))) == []


class Peaks(MetricResult):
    """A result of two metrics, of which one is a norm."""

    index = ("metric",)
    metrics = ("A.peak_force", "A.max_force")

    def arrays(self):
        return {"value": Labelled(("metric",), [1.0, 1.2], "N")}, {"metric": self.metrics}, {"title": "Peaks"}

    def rows(self):
        return [{"metric": name} for name in self.metrics]

    def parts(self):
        return ["Peaks", Table(["metric", "value"], [["A.peak_force", "1"], ["A.max_force", "1.2"]])]


def test_results_say_it_in_terminals_notebooks_and_data():
    (line,) = note_sentences(Peaks.metrics)
    assert str(Peaks()).endswith(line) and f"<p>{line}</p>" in Peaks()._repr_html_()
    assert Peaks().to_xarray().attrs == {"title": "Peaks", "notes": line}


def test_comparisons_say_it_once(tmp_path):
    content = {"title": "x", "status": "ok", "metrics": {"A.peak_force": {"value": 1.0, "nominal": 0.9}}}
    content |= {"units": {"A.peak_force": "N"}, "metric_notes": {"peak_force": "below the maximum"}}
    for folder in ("one", "two"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "worst_case.json").write_text(json.dumps(content), encoding="utf-8")
    found = compare_tasks(tmp_path / "one", tmp_path / "two")
    assert found.remarks == ("peak_force: below the maximum.",) and found.text().endswith(found.remarks[0])
