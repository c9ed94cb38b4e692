"""A folder that cannot hold the results of a command is refused before anything is computed for them."""

import argparse
import os
import shutil

import jax
import numpy as np
import pytest

import rfem_jax.mechanics
import rfem_jax.simulation
from rfem_jax import RungeKutta4, Tolerances, first_samples
from rfem_jax.compilation import program
from rfem_jax.report import command_line
from rfem_jax.report.command_line import main
from rfem_jax.report.commands import run
from rfem_jax.report.commands.command import Interrupted
from rfem_jax.report.commands.steps import read_study, settle_method, settle_task
from rfem_jax.report.tasks import study_problem

from .test_task_output import call, contents, task_file  # noqa: F401

AUTO = 'method = "auto"\naccuracy = 1e-3'
FIXED = 'method = "rk4"\nstep = 1e-5'


@pytest.fixture
def nothing_computed(monkeypatch):
    """From here on a mechanism that is assembled, a step that is looked for, a run or a compilation is a fault."""

    def forbidden(*_, **__):
        raise AssertionError("computed before the folder was refused")

    def forbid():
        monkeypatch.setattr(study_problem, "build_problem", forbidden)
        for name in ("discretise", "describe"):
            monkeypatch.setattr(rfem_jax.mechanics, name, forbidden)
        for name in ("check_step", "choose_method", "run_cases"):
            monkeypatch.setattr(rfem_jax.simulation, name, forbidden)
        monkeypatch.setattr(program.Program, "__call__", forbidden)

    return forbid


def changed(path, old, new):
    text = path.read_text(encoding="utf-8")
    assert old in text
    path.write_text(text.replace(old, new, 1), encoding="utf-8")


@pytest.fixture(scope="module")
def samples_of_a_study(tmp_path_factory):
    """The folder `out` that a Monte Carlo study wrote, from which tests copy; empty until the first one made it."""
    return tmp_path_factory.mktemp("finished") / "out"


@pytest.fixture
def finished(samples_of_a_study, task_file, tmp_path):  # noqa: F811
    """A copy of it beside the study's file."""
    if not samples_of_a_study.exists():
        assert call("monte-carlo", task_file, samples_of_a_study) == 0
    return shutil.copytree(samples_of_a_study, tmp_path / "out")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("old", "new", "word"),
    [
        ("length = 0.12", "length = 0.13", "mechanism"),
        ("density = 7850.0", "density = 7851.0", "mechanism"),
        ("moment = 1.5", "moment = 1.6", "drive"),
        ("step = 1e-5", "step = 9e-6", "simulation"),
        ("save_every = 0.05", "save_every = 0.1", "simulation"),
        ("seed = 3", "seed = 4", "key"),
        ("batch = 8", "batch = 16", "batch"),
        ('"0.25 mm"', '"0.5 mm"', "tolerances"),
        ('metrics = ["A.mean_square_force"]\nlimits', 'metrics = ["A.rms_force"]\nlimits', "metrics"),
        ("seed = 3", 'seed = 3\nsampling = "pseudo_random"', "sampling"),
        ("seed = 3", "seed = 3\nsobol_indices = true", "sobol_indices"),
    ],
)
def test_samples_of_another_study(task_file, finished, capsys, nothing_computed, old, new, word):  # noqa: F811
    out, before = finished, contents(finished)
    nothing_computed()
    changed(task_file, old, new)
    capsys.readouterr()
    for command in ("monte-carlo", "run"):
        assert call(command, task_file, out) == 2
        (sentence,) = [line for line in capsys.readouterr().err.splitlines() if "`--out`" in line]
        assert f"holds another study, which differs in {word} (there " in sentence
    assert contents(out) == before


@pytest.mark.long
def test_samples_of_another_accuracy_of_a_method_that_is_chosen(
    task_file,  # noqa: F811
    tmp_path,
    capsys,
    monkeypatch,
    nothing_computed,
):
    out = tmp_path / "out"
    chosen = RungeKutta4(step=1e-5)
    monkeypatch.setattr(rfem_jax.simulation, "choose_method", lambda *_, **__: chosen)
    changed(task_file, FIXED, AUTO)
    assert call("monte-carlo", task_file, out) == 0
    assert call("monte-carlo", task_file, out) == 0  # the same study goes on
    changed(task_file, "n = 32", "n = 40")
    assert call("monte-carlo", task_file, out) == 0  # and grows
    nothing_computed()
    changed(task_file, "accuracy = 1e-3", "accuracy = 1e-4")
    capsys.readouterr()
    assert call("monte-carlo", task_file, out) == 2
    assert "which differs in simulation (there" in capsys.readouterr().err


def test_steps_are_chosen_for_the_samples_by_the_samples(task_file, monkeypatch, tmp_path):  # noqa: F811
    changed(task_file, FIXED, AUTO)
    asked = []

    def choose(model, method, drive, duration, trials=None, save_every=None):
        asked.append(trials)
        return RungeKutta4(step=1e-5 if trials is None else 5e-6)

    monkeypatch.setattr(rfem_jax.simulation, "choose_method", choose)
    study = read_study(str(task_file))
    of_samples, of_cases = settle_method(study, "monte_carlo"), settle_method(study)
    assert (of_samples.method.step, of_cases.method.step) == (5e-6, 1e-5)
    assert settle_task(of_cases, "monte_carlo", tmp_path) == of_samples
    assert settle_task(of_cases, "sensitivity", tmp_path) is of_cases
    samples = first_samples(Tolerances.of(study), jax.random.key(study.tasks.asked["monte_carlo"].seed))
    for trials in (asked[0], asked[2]):
        assert trials.keys() == samples.keys() == {"D.delta_x", "D.delta_z", "D.d_y"}
        assert all(np.array_equal(trials[name], samples[name]) for name in samples)
    assert asked[1] is None and len(asked) == 3

    done = {}

    def noted(study, task, folder, pictures):
        done[task] = study.method.step
        return True, []

    monkeypatch.setattr(run, "write_task", noted)
    assert run._do_tasks(of_cases, tmp_path, argparse.Namespace(study=task_file, out=tmp_path, pictures=True), []) == (
        True,
        [],
    )
    assert done == dict.fromkeys(study.tasks.declared, 1e-5) | {"monte_carlo": 5e-6}

    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(rfem_jax.simulation, "choose_method", interrupted)
    with pytest.raises(Interrupted, match="monte carlo is not complete: start it again"):
        settle_task(of_cases, "monte_carlo", tmp_path)


@pytest.mark.parametrize("command", ["monte-carlo", "run"])
def test_what_is_no_folder_of_samples(task_file, tmp_path, capsys, nothing_computed, command):  # noqa: F811
    nothing_computed()
    for number, (name, finding) in enumerate(
        [("", "is a file"), ("letter.txt", "holds `letter.txt`"), ("manifest.json", "cannot be read")]
    ):
        out = tmp_path / f"out{number}"
        path = out / "monte_carlo" / name
        path.parent.mkdir(parents=True)
        path.write_text("Dear Anna")
        assert call(command, task_file, out) == 2
        assert finding in capsys.readouterr().err


def test_samples_that_cannot_be_written(task_file, tmp_path, capsys, monkeypatch, nothing_computed):  # noqa: F811
    samples = tmp_path / "out" / "monte_carlo"
    samples.mkdir(parents=True)
    monkeypatch.setattr(os, "access", lambda path, mode: path != samples)
    nothing_computed()
    assert call("monte-carlo", task_file, tmp_path / "out") == 2
    assert "cannot be read and written" in capsys.readouterr().err


@pytest.mark.parametrize("command", ["run", "sensitivity", "monte-carlo", "worst-case", "allocate", "validate"])
def test_no_folder_at_all(task_file, tmp_path, capsys, monkeypatch, nothing_computed, command):  # noqa: F811
    (tmp_path / "file").write_text("")
    nothing_computed()
    monkeypatch.setattr(command_line, "require_platform", lambda: None)
    out = tmp_path / "file" / "out"
    assert main([command, *([] if command == "validate" else [str(task_file)]), "--out", str(out)]) == 2
    assert "must be a folder that can be written" in capsys.readouterr().err


@pytest.mark.slow
def test_tasks_that_keep_nothing_take_any_folder(task_file, tmp_path):  # noqa: F811
    out = tmp_path / "out"
    assert call("sensitivity", task_file, out) == 0
    changed(task_file, "length = 0.12", "length = 0.13")
    assert call("sensitivity", task_file, out) == 0
