"""A kind of task from outside the package: read from a study file, done by the command line, shown by `check`."""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

import rfem_jax.simulation
from rfem_jax import TaskKind, load_study, register_task, task_kinds
from rfem_jax.description.tasks import MonteCarloTask, Task, Tasks
from rfem_jax.description.tasks.catalogue import asked_classes
from rfem_jax.description.tasks.settings import metric_names, set_fields
from rfem_jax.description.tolerances.tolerances import error_quantities
from rfem_jax.report import command_line
from rfem_jax.report.command_line import main
from rfem_jax.report.contents.output import write_csv
from rfem_jax.report.drawings.style import add_titles, new_figure
from rfem_jax.report.tasks.catalogue import report_class
from rfem_jax.report.tasks.task_files import write_task_json
from rfem_jax.report.tasks.task_report import TaskReport

from .conftest import STUDY

TABLE = """
[lever_arms]
metrics = ["*.rms_moment"]
at = { "D.delta_x" = "0.5 deg" }
factor = 2.0
"""


@dataclass(frozen=True)
class LeverArmsTask(Task):
    """What is asked."""

    needs_tolerances = False

    metrics: tuple[str, ...]
    at: dict[str, float]
    factor: float = 1.0

    def __post_init__(self):
        set_fields(self, metrics=metric_names(self.metrics), at=error_quantities(self.at, "at"))


class LeverArmsReport(TaskReport[LeverArmsTask, dict[str, float]]):
    """A number for each metric: no mechanics, the test is of the way that it takes."""

    def run(self, folder: Path) -> dict[str, float]:
        return {name: self.task.factor * (1.0 + number) for number, name in enumerate(self.task.metrics)}

    def text(self, result: dict[str, float]) -> str:
        return "\n".join(f"lever arm of {name}: {value:g} m" for name, value in result.items())

    def write(self, folder: Path, result: dict[str, float]) -> list[Path]:
        rows = [{"metric": name, "arm_m": value} for name, value in result.items()]
        return [
            write_task_json(folder / "lever_arms.json", self.study, self.name, {"arms": result}),
            write_csv(folder / "lever_arms.csv", rows),
        ]

    def draw(self, result: dict[str, float]):
        figure = new_figure(7.2, 4.0)
        figure.subplots().bar(list(result), list(result.values()))
        add_titles(figure, "Lever arms", self.study)
        return {"bars": figure}

    def succeeded(self, result: dict[str, float]) -> bool:
        return max(result.values()) < 10.0


KIND = TaskKind(
    "lever_arms",
    asks=LeverArmsTask,
    reports=LeverArmsReport,
    purpose="lever arms of the moments",
    results="a table and a picture",
    command="arms",
)


@pytest.fixture
def registered(monkeypatch):
    """The kind is known within the test; the simulator and the settings of the process are left alone."""
    monkeypatch.setattr(task_kinds, "_kinds", dict(task_kinds._kinds))
    monkeypatch.setattr(command_line, "set_up_jax", lambda *_: None)
    monkeypatch.setattr(rfem_jax.simulation, "check_step", lambda model, method, drive: 1.9e-5)
    return register_task(KIND)


@pytest.fixture
def path(tmp_path):
    path = tmp_path / "study.toml"
    path.write_text(STUDY + TABLE, encoding="utf-8")
    return path


def test_its_table_is_read_like_all_others(registered, path, refused):
    task = load_study(path).tasks.lever_arms
    assert task.metrics == tuple(f"{joint}.rms_moment" for joint in "ABDC")
    assert (task.factor, load_study(path).tasks.declared) == (2.0, ("lever_arms",))
    for old, new, pieces in (
        ("factor", "factr", ("[lever_arms]", "`factr`", "did you mean `factor`?")),
        ("at =", "factor = 2.0 #", ("[lever_arms]", "`at`", "missing")),
        ("*.rms_moment", "*.rms_momen", ("[lever_arms]", "did you mean")),
        ("D.delta_x", "Q.delta_x", ("`lever_arms`", "`Q.delta_x`")),
        ("[lever_arms]", "[lever_arm]", ("`lever_arm`", "did you mean `lever_arms`?")),
    ):
        text = TABLE.replace(old, new, 1)
        text = text.replace("\nfactor = 2.0\n", "\n") if new.startswith("factor = 2.0 #") else text
        path.write_text(STUDY + text, encoding="utf-8")
        with refused(*pieces):
            load_study(path)


def test_its_command_prints_writes_and_draws(registered, path, tmp_path, capsys):
    out = tmp_path / "out"
    assert main(["arms", str(path), "--out", str(out)]) == 0
    written = {"lever_arms.json", "lever_arms.csv", "lever_arms_bars.png", "report.html"}
    assert {one.name for one in out.iterdir()} == written
    found = json.loads((out / "lever_arms.json").read_text(encoding="utf-8"))
    assert found["arms"] == {f"{joint}.rms_moment": 2.0 * (1 + i) for i, joint in enumerate("ABDC")}
    assert found["task"]["name"] == "lever_arms" and found["task"]["factor"] == 2.0
    captured = capsys.readouterr()
    assert "Test four-bar" in captured.out and "lever arm of D.rms_moment: 6 m" in captured.out
    assert "4 files written" in captured.out
    path.write_text(path.read_text(encoding="utf-8").replace("factor = 2.0", "factor = 20.0"), encoding="utf-8")
    assert main(["arms", str(path), "--out", str(out)]) == 3


def test_its_picture_shows_its_numbers(registered, path):
    report = LeverArmsReport(study := load_study(path), "lever_arms", study.tasks.lever_arms)
    (figure,) = report.pictures(report.run(Path())).values()
    np.testing.assert_array_equal([bar.get_height() for bar in figure.axes[0].patches], [2.0, 4.0, 6.0, 8.0])


@pytest.mark.long
def test_run_and_check_and_help_follow(registered, path, tmp_path, capsys, monkeypatch, runs):
    monkeypatch.setattr(rfem_jax.simulation, "run_cases", lambda study, **_: (None, runs))
    assert main(["run", str(path), "--out", str(tmp_path / "out")]) == 0
    assert (tmp_path / "out" / "lever_arms_bars.png").exists()
    assert main(["check", str(path)]) == 0
    text = capsys.readouterr().out
    assert "Lever arms\n  metrics: A.rms_moment, B.rms_moment" in text
    assert "at: D.delta_x = 0.5 deg" in text and "factor: 2\n" in text
    assert main(["--help"]) == 0 and "lever arms of the moments" in capsys.readouterr().out
    assert main(["run", "--help"]) == 0 and "[lever_arms]" in capsys.readouterr().out


def test_without_registration_nobody_knows_it(path, refused):
    with refused("The top level", "`lever_arms`"):
        load_study(path)
    with pytest.raises(AttributeError):
        _ = Tasks().lever_arms


@pytest.mark.parametrize(
    ("name", "command", "word"),
    [
        ("lever_arms", None, "`lever_arms` is in use"),
        ("cases", None, "`cases` is in use"),
        ("other", "arms", "`arms` is in use"),
        ("other", "check", "`check` is in use"),
        ("other task", None, "letters, digits"),
    ],
)
def test_names_in_use_are_refused(registered, name, command, word):
    with pytest.raises(ValueError, match=word):
        register_task(TaskKind(name, LeverArmsTask, LeverArmsReport, "", "", command=command))


def test_classes_may_be_named_by_strings_and_must_be_given(registered):
    kind = TaskKind("by_name", f"{__name__}:LeverArmsTask", f"{__name__}:LeverArmsReport", "", "")
    assert (kind.asked_class(), kind.report_class()) == (LeverArmsTask, LeverArmsReport)
    with pytest.raises(ValueError, match="`reports` of a kind of task"):
        register_task(TaskKind("by_name", LeverArmsTask, None, "", ""))


def test_every_kind_has_both_classes_and_its_words(registered):
    asked = asked_classes()
    assert list(asked) == list(task_kinds.task_kinds()) and asked["lever_arms"] is LeverArmsTask
    for name, asks in asked.items():
        reports = report_class(name)
        assert issubclass(asks, Task) and issubclass(reports, TaskReport)
        assert asks.__name__.removesuffix("Task") == reports.__name__.removesuffix("Report")


def test_tasks_in_python_are_of_known_kinds(refused):
    task = MonteCarloTask(64, ("D.rms_moment",))
    assert Tasks(None, monte_carlo=task).monte_carlo is task and Tasks(monte_carlo=task).sensitivity is None
    with refused("`monte_karlo`", "did you mean `monte_carlo`?"):
        Tasks(monte_karlo=task)
    with refused("`worst_case`", "WorstCaseTask"):
        Tasks(worst_case=task)
