"""Ctrl-C, as a real SIGINT in the middle of every command that takes long: what is left, what is said, and that the
same command goes on to the same numbers."""

import json
import signal

import pytest

import rfem_jax.simulation
from rfem_jax.compilation.stages import listening
from rfem_jax.report import command_line
from rfem_jax.report.command_line import main
from rfem_jax.report.tasks import study_problem
from rfem_jax.report.validation import validation_command
from rfem_jax.tolerancing.problems import evaluation, kept_evaluations, quadratic_model
from rfem_jax.validation.lines import Benchmark, Line, Outcome
from tests.study_texts import ROUND, STEEL, hinge, link

from . import closed_form
from .conftest import STUDY
from .test_tasks import TASKS

SLIDER = f"""{STEEL}{ROUND}{link("arm", 0.3)}{hinge("arm")}[drive]
joint = "A"
kind = "moment_ramp"
moment = 0.2
rise_time = 0.1
[simulation]
duration = 0.2
method = "rk4"
step = 1e-2
save_every = 1e-2
[[cases]]
name = "perfect"
[[cases]]
name = "tilted"
errors = {{ "A.delta_x" = 0.01 }}
"""


class Closed(closed_form.ClosedForm):
    """The closed form, known by its name."""

    def fingerprint(self):
        return str(
            {name: float(value) for name, value in self.function(dict.fromkeys(closed_form.NAMES, 1e-3)).items()}
        )


@pytest.fixture
def closed(monkeypatch):
    """The simulator replaced by a closed form; no settings of the process are changed."""
    monkeypatch.setattr(closed_form, "ClosedForm", Closed)
    monkeypatch.setattr(study_problem, "build_problem", closed_form.build_problem)
    monkeypatch.setattr(command_line, "set_up_jax", lambda *_: None)
    monkeypatch.setattr(rfem_jax.simulation, "check_step", lambda model, method, drive: 1.9e-5)


@pytest.fixture
def task_file(tmp_path):
    path = tmp_path / "tasks.toml"
    path.write_text(STUDY + TASKS, encoding="utf-8")
    return path


def interrupting(monkeypatch, turn):
    """A SIGINT before evaluation number `turn`; counts those that are computed."""
    computed = []

    def results(self, problem, inputs, compute):
        def one():
            if len(computed) == turn:
                computed.append("interrupted")
                signal.raise_signal(signal.SIGINT)
            computed.append(1)
            return compute()

        return original(self, problem, inputs, one)

    original = kept_evaluations.KeptEvaluations.results
    monkeypatch.setattr(kept_evaluations.KeptEvaluations, "results", results)
    return computed


@pytest.mark.long
@pytest.mark.parametrize(("command", "name", "turn"), [("worst-case", "worst_case", 3), ("allocate", "allocation", 4)])
def test_evaluations_are_kept(closed, task_file, tmp_path, capsys, monkeypatch, command, name, turn):
    with monkeypatch.context() as without:
        whole = interrupting(without, -1)
        assert main([command, str(task_file), "--out", str(tmp_path / "whole")]) == 0
    computed, out = interrupting(monkeypatch, turn), tmp_path / "out"
    assert main([command, str(task_file), "--out", str(out)]) == 130
    assert len(computed) == turn + 1
    error = capsys.readouterr().err.splitlines()[-1]
    assert f"Interrupted: {name.replace('_', ' ')} is not complete: {turn} evaluations are kept in" in error
    assert error.endswith("; the same command goes on from there.")
    assert {one.name for one in out.iterdir()} == {f"{name}.unfinished"}
    assert main([command, str(task_file), "--out", str(out)]) == 0
    assert len(computed) == 1 + len(whole)  # none twice
    assert not (out / f"{name}.unfinished").exists()
    for file in (f"{name}.json", f"{name}.csv"):
        assert (out / file).read_bytes() == (tmp_path / "whole" / file).read_bytes()


def test_directions_are_kept(closed, task_file, tmp_path, capsys, monkeypatch):
    """The second expansion of a sensitivity, that of the finer step."""
    computed, out = interrupting(monkeypatch, 1), tmp_path / "out"
    assert main(["sensitivity", str(task_file), "--out", str(out), "--json"]) == 130
    captured = capsys.readouterr()
    assert json.loads(captured.out)["problems"] == captured.err.splitlines()[-1:]
    assert "1 evaluations are kept" in captured.err
    assert main(["sensitivity", str(task_file), "--out", str(out)]) == 0
    assert computed == [1, "interrupted", 1]


def test_another_study_reads_none_of_them(closed, task_file, tmp_path, monkeypatch):
    computed, out = interrupting(monkeypatch, 2), tmp_path / "out"
    assert main(["worst-case", str(task_file), "--out", str(out)]) == 130
    text = task_file.read_text(encoding="utf-8")
    both = 'metrics = ["D.mean_square_moment", "A.mean_square_force"]\nstarts'
    assert both in text
    task_file.write_text(text.replace(both, 'metrics = ["A.mean_square_force"]\nstarts'), encoding="utf-8")
    count = len(computed)
    assert main(["worst-case", str(task_file), "--out", str(out)]) == 0
    with_all = len(computed) - count
    assert main(["worst-case", str(task_file), "--out", str(tmp_path / "alone")]) == 0
    assert len(computed) - count == 2 * with_all


@pytest.mark.long
def test_samples_are_kept_and_run_says_how_to_go_on(closed, task_file, tmp_path, capsys, monkeypatch, runs):
    monkeypatch.setattr(rfem_jax.simulation, "run_cases", lambda study, **_: (None, runs))
    out = tmp_path / "out"

    def interrupt(stage, done=None):
        if stage.startswith("Sampling") and done is not None and done > 0.4:
            signal.raise_signal(signal.SIGINT)

    with listening(interrupt):
        assert main(["run", str(task_file), "--out", str(out)]) == 130
    error = capsys.readouterr().err.splitlines()[-1]
    assert "the cases, sensitivity done, in" in error and "2 chunks of samples are kept" in error
    rest = [f"rfem-jax {one} {task_file} --out {out}" for one in ("monte-carlo", "worst-case", "allocate")]
    assert error.endswith("Go on with: " + " && ".join(rest))
    assert {"results.json", "P1.csv", "sensitivity.json", "monte_carlo"} <= {one.name for one in out.iterdir()}
    assert main(["monte-carlo", str(task_file), "--out", str(out)]) == 0


@pytest.mark.long
def test_cases_go_on_where_they_stopped(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(command_line, "set_up_jax", lambda *_: None)
    path, out = tmp_path / "study.toml", tmp_path / "out"
    path.write_text(SLIDER, encoding="utf-8")
    told = []

    def interrupt(stage, done=None):
        if stage == "Simulating 2 cases" and done is not None:
            told.append(done)
            if len(told) == 4:
                signal.raise_signal(signal.SIGINT)

    assert main(["run", str(path), "--out", str(tmp_path / "whole"), "--no-pictures"]) == 0
    with listening(interrupt):
        assert main(["run", str(path), "--out", str(out), "--no-pictures"]) == 130
        error = capsys.readouterr().err.splitlines()[-1]
        assert f"the cases are simulated up to {0.2 * told[3]:.3g} s of 0.2 s, which is kept in" in error
        assert [one.name for one in out.iterdir()] == ["unfinished_cases.npz"]
        # Another study does not use it.
        other = tmp_path / "other.toml"
        other.write_text(SLIDER.replace("moment = 0.2", "moment = 0.3"), encoding="utf-8")
        kept = (out / "unfinished_cases.npz").read_bytes()
        assert main(["run", str(other), "--out", str(out), "--no-pictures"]) == 0
        every = told[4:]
        assert every[:4] == told[:4] and not (out / "unfinished_cases.npz").exists()
        (out / "unfinished_cases.npz").write_bytes(kept)
        count = len(told)
        assert main(["run", str(path), "--out", str(out), "--no-pictures"]) == 0
    assert told[count:] == every[4:]
    for name in ("perfect.csv", "tilted.csv"):
        assert (out / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()
    # A damaged file is as good as none.
    (out / "unfinished_cases.npz").write_bytes(kept[:1000])
    assert main(["run", str(path), "--out", str(out), "--no-pictures"]) == 0
    assert (out / "tilted.csv").read_bytes() == (tmp_path / "whole" / "tilted.csv").read_bytes()


def stand_ins(names):
    """Benchmarks of one line each."""
    line = Line("group", "value", 1.0, 1.0, 0.0, 1e-3, True, "closed form")
    return tuple(Benchmark(name, name, lambda full, progress: Outcome([line])) for name in names)


def test_benchmarks_that_are_done_are_written(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(command_line, "set_up_jax", lambda *_: None)
    original = validation_command.compute

    def compute(benchmarks, full, watched):
        for number, found in enumerate(original(benchmarks, full, watched)):
            if number == 1:
                signal.raise_signal(signal.SIGINT)
            yield found

    monkeypatch.setattr(validation_command, "compute", compute)
    out = tmp_path / "out"
    monkeypatch.setattr(validation_command, "chosen", lambda _: stand_ins(["elastica", "rotating_beams"]))
    assert main(["validate", "--out", str(out)]) == 130
    error = capsys.readouterr().err.splitlines()[-1]
    rest = f"rfem-jax validate --only rotating_beams --out {out}_rest"
    assert error == f"Interrupted: 1 benchmarks are done, in {out}. Go on with: {rest}"
    assert json.loads((out / "validation.json").read_text(encoding="utf-8"))["benchmarks"] == ["elastica"]


def test_nothing_is_asked_where_nothing_is_kept(monkeypatch):
    """Studies in Python run their programs as they are."""
    monkeypatch.setattr(kept_evaluations.keys, "digest_value", None)
    assert evaluation.remembered(None, (), lambda: (1, 2)) == (1, 2)
    assert quadratic_model.remembered is evaluation.remembered
