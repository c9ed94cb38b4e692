"""What a user sees of tasks: the same command twice, its words, no line wider than a terminal."""

import math

import pytest

import rfem_jax.simulation
from rfem_jax import FunctionProblem, Metric
from rfem_jax.report import command_line
from rfem_jax.report.command_line import main
from rfem_jax.report.tasks import study_problem
from rfem_jax.report.tasks.catalogue import report_on
from rfem_jax.text_layout import WIDTH, align_columns, wrap_lines
from rfem_jax.tolerancing.layout import show_number

from . import closed_form
from .conftest import STUDY
from .test_tasks import MOMENT, TASKS

COMMANDS = ("sensitivity", "monte-carlo", "worst-case", "allocate")


@pytest.fixture
def task_file(tmp_path, monkeypatch):
    """A study file with all tasks, and the simulator replaced by a closed form."""
    monkeypatch.setattr(study_problem, "build_problem", closed_form.build_problem)
    monkeypatch.setattr(command_line, "set_up_jax", lambda *_: None)
    monkeypatch.setattr(rfem_jax.simulation, "check_step", lambda model, method, drive: 1.9e-5)
    path = tmp_path / "tasks.toml"
    path.write_text(STUDY + TASKS, encoding="utf-8")
    return path


def call(command, path, out):
    return main([command, str(path), "--out", str(out)])


def contents(folder):
    return {path.name: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.long
@pytest.mark.parametrize("command", COMMANDS)
def test_the_same_command_twice_writes_the_same_files(task_file, tmp_path, command):
    out = tmp_path / "out"
    assert call(command, task_file, out) == 0
    first = contents(out)
    chunks = {p: p.stat().st_mtime_ns for p in out.rglob("chunk-*.npz")}
    written = next(p for p in out.glob("*.csv"))
    before = written.stat().st_mtime_ns
    assert call(command, task_file, out) == 0
    second = contents(out)
    assert second.keys() == first.keys()
    for name in first:  # pictures too: nothing depends on the time or on what was there before
        assert second[name] == first[name], name
    assert written.stat().st_mtime_ns > before  # overwritten, not skipped
    # The samples of the first run serve: none is computed again.
    assert {p: p.stat().st_mtime_ns for p in out.rglob("chunk-*.npz")} == chunks
    assert bool(chunks) == (command == "monte-carlo")


@pytest.mark.long
def test_another_study_overwrites_results_of_all_tasks_but_monte_carlo(task_file, tmp_path, capsys):
    out = tmp_path / "out"
    assert [call(command, task_file, out) for command in COMMANDS] == [0, 0, 0, 0]
    before = contents(out)
    text = task_file.read_text(encoding="utf-8").replace('"0.25 mm"', '"0.5 mm"')
    task_file.write_text(text.replace("scales = [0.5, 2.0]", ""), encoding="utf-8")
    capsys.readouterr()
    assert [call(command, task_file, out) for command in COMMANDS] == [0, 2, 0, 0]
    after = contents(out)
    for name in ("sensitivity.json", "worst_case.json", "allocation.json"):
        assert after[name] != before[name]
    for name in ("monte_carlo.json", "monte_carlo.csv", "manifest.json"):
        assert after[name] == before[name]
    # Sentences of the command line speak of what was typed there.
    errors = capsys.readouterr().err
    sentence = next(line for line in errors.splitlines() if "--out" in line)
    assert "`resume`" not in errors
    assert "another study" in sentence and "tolerances" in sentence
    assert f"remove `{out / 'monte_carlo'}`" in sentence


def test_a_folder_of_samples_that_is_a_file_is_told_in_words_of_the_command(task_file, tmp_path, capsys):
    out = tmp_path / "out"
    out.mkdir()
    (out / "monte_carlo").write_text("notes")
    assert call("monte-carlo", task_file, out) == 2
    sentence = capsys.readouterr().err.splitlines()[-1]
    assert sentence.startswith("Argument `--out` must") and "is a file" in sentence
    assert "`resume`" not in sentence


class Undamped(FunctionProblem):
    undamped = True

    def refined(self):
        return self


def long_problem(study, metrics, model=None, trials=None):
    """Many metrics with long names, of three errors."""
    short = closed_form.build(list(closed_form.METRICS))

    def function(errors):
        moment = short({name: errors[name] for name in closed_form.NAMES})[0][MOMENT]
        return {name: moment + 1e-3 * i for i, name in enumerate(metrics)}

    named = [Metric(name, "(N m)^2", f"mean square moment in {name}") for name in metrics]
    return Undamped(function, closed_form.NAMES, named, error_units={"D.d_y": "m"})


@pytest.mark.long
@pytest.mark.parametrize("command", [*COMMANDS, "check"])
def test_no_printed_line_is_wider_than_a_terminal(task_file, tmp_path, capsys, monkeypatch, command):
    monkeypatch.setattr(study_problem, "build_problem", long_problem)
    joints = [f'"{joint}.mean_square_{kind}"' for joint in "ABCD" for kind in ("force", "moment")]
    text = task_file.read_text(encoding="utf-8")
    pair = f'metrics = ["{MOMENT}", "A.mean_square_force"]'
    assert text.count(pair) == 2
    text = text.replace(pair, f"metrics = [{', '.join(joints)}]")
    text = text.replace('metrics = ["A.mean_square_force"]', f"metrics = [{', '.join(joints)}]")
    limits = ", ".join(f"{name} = {30 + i}.0" for i, name in enumerate(joints))
    text = text.replace(f'limits = {{ "{MOMENT}" = 21.0 }}', f"limits = {{ {limits} }}")
    text = text.replace("seed = 3", "seed = 3\nsobol_indices = true")
    task_file.write_text(text, encoding="utf-8")
    if command == "check":
        assert main(["check", str(task_file)]) == 0
    else:
        assert call(command, task_file, tmp_path / "out") == 0
    printed = capsys.readouterr().out
    assert "D.mean_square_moment" in printed
    lines = [line for line in printed.splitlines() if str(tmp_path) not in line]
    assert max(map(len, lines)) <= WIDTH, max(lines, key=len)


def test_columns_that_do_not_fit_follow_below_with_their_rows():
    header = ["name", *(f"column {i}" for i in range(9))]
    rows = [[f"row {r}", *(f"{r}{i}" * 8 for i in range(9))] for r in range(2)]
    text = align_columns(header, rows, width=60)
    blocks = text.split("\n\n")
    assert len(blocks) == 3 and all(len(line) <= 60 for line in text.splitlines())
    for block in blocks:
        assert [line.split()[0] for line in block.splitlines()][2:] == ["row", "row"]
    words = text.split()
    assert all(f"{r}{i}" * 8 in words for r in range(2) for i in range(9))
    assert align_columns(["a", "b"], [["x", "1"]]) == "a  b\n----\nx  1"
    assert wrap_lines("one two three", indent=1, width=8) == "one two\n three"


@pytest.mark.slow
def test_rounding_next_to_large_numbers_is_shown_as_zero(task_file, tmp_path, capsys, monkeypatch):
    assert show_number(3e-33, scale=21.0) == "0" and show_number(3e-33) == "3e-33"
    assert show_number(2e-12, scale=1.0) == "2e-12" and show_number(math.nan, scale=1.0) == "-"

    def build(study, metrics, model=None):
        exact = closed_form.build(metrics)

        def function(errors):
            values = exact(errors)[0]
            return {name: value + 3e-33 for name, value in values.items()}

        units = {"D.d_y": "m"}
        return FunctionProblem(function, exact.error_names, exact.metrics, error_units=units)

    monkeypatch.setattr(study_problem, "build_problem", build)
    for command in ("worst-case", "allocate"):
        assert call(command, task_file, tmp_path / "out") == 0
    printed = capsys.readouterr().out
    assert "nominal 0)" in printed and "e-33" not in printed
    study = rfem_jax.description.load_study(task_file)
    report = report_on(study, "worst_case")
    results = report.run(tmp_path)
    assert results[MOMENT].nominal == 3e-33  # files keep what was computed
    figure = report.pictures(results)["worst_case_corners"]
    labels = [line.get_label() for line in figure.axes[0].lines]
    assert "nominal: 0" in labels
