"""`rfem-jax init`: studies to start from, which are understood and simulated."""

import json
import runpy
import sys
import tomllib
from pathlib import Path

import pytest

from rfem_jax import describe, discretise, load_study
from rfem_jax.description.study_file.schema import FILE, LINE, study_schema
from rfem_jax.report import command_line
from rfem_jax.report.command_line import main
from rfem_jax.report.commands.init import KINDS


@pytest.mark.parametrize("kind", KINDS)
def test_a_study_that_closes_at_its_start(kind, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["init", "mine", "--kind", kind]) == 0
    said = capsys.readouterr()
    assert "rfem-jax check mine.toml" in said.out and said.err == ""
    assert (tmp_path / "mine.toml").read_text(encoding="utf-8").startswith(f"{LINE}\n")
    assert json.loads((tmp_path / FILE).read_text(encoding="utf-8")) == study_schema()
    study = load_study("mine.toml")
    assert study.title == f"My {kind}" and len(study.cases) == 3
    found = describe(discretise(study.mechanism))
    # Contacts and teeth are elastic, and leave each wheel a freedom; the rods of the five-bar are rigid.
    mobility = {"cam": 2, "geared-five-bar": 2, "planetary": 5}.get(kind, 1)
    redundant = kind == "geared-five-bar"
    assert (found.rigid_mobility, found.redundant, found.idle) == (mobility, redundant, ())
    assert found.gap < 1e-3 and len(study.mechanism.cut_joints) == {"six-bar": 2, "cam": 0, "planetary": 0}.get(kind, 1)


def test_nothing_is_overwritten(tmp_path, capsys):
    path = tmp_path / "mine.toml"
    path.write_text("precious", encoding="utf-8")
    assert main(["init", str(path)]) == 2
    assert "exists; choose another name" in capsys.readouterr().err
    assert path.read_text(encoding="utf-8") == "precious"
    assert main(["init", str(tmp_path / "none" / "mine")]) == 2
    assert "cannot (No such file" in capsys.readouterr().err
    assert main(["init", str(tmp_path / "new"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["files"] == [
        str(tmp_path / "new.toml"),
        str(tmp_path / FILE),
    ]


@pytest.mark.parametrize("kind", KINDS)
def test_its_tasks_are_understood_where_they_are_taken_in(kind, tmp_path):
    path = tmp_path / "mine.toml"
    assert main(["init", str(path), "--kind", kind]) == 0
    before, _, tasks = path.read_text(encoding="utf-8").partition("# [tolerances]")
    text = before + "\n".join(line.removeprefix("# ") for line in f"# [tolerances]{tasks}".splitlines())
    assert {"tolerances", "sensitivity", "monte_carlo"} <= tomllib.loads(text).keys()
    path.write_text(text, encoding="utf-8")
    assert load_study(path).tasks.declared == ("sensitivity", "monte_carlo")


@pytest.mark.long
def test_the_slider_crank_runs(tmp_path, monkeypatch):
    """With fewer rfes, two steps and without pictures, as compilation is all that takes time; that of two loops takes a
    minute, so that the others are only closed above."""
    monkeypatch.setattr(command_line, "set_up_jax", lambda *_: None)
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    path, out = tmp_path / "mine.toml", tmp_path / "out"
    assert main(["init", str(path), "--kind", "slider-crank"]) == 0
    text = path.read_text(encoding="utf-8").replace("rfes = 5", "rfes = 2")
    simulation = '[simulation]\nduration = 2e-3\nmethod = "generalised_alpha"\nstep = 1e-3\nsave_every = 1e-3\n'
    before, _, after = text.partition("[simulation]")
    path.write_text(before + simulation + after[after.index("\n# Errors") :], encoding="utf-8")
    assert main(["check", str(path)]) == 0
    assert main(["run", str(path), "--out", str(out)]) == 0
    cases = json.loads((out / "results.json").read_text(encoding="utf-8"))["cases"]
    assert [case["status"] for case in cases.values()] == ["ok"] * 3


@pytest.mark.slow
def test_the_schema_is_printed(capsys):
    assert main(["keys", "--schema"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert {key: printed[key] for key in study_schema()} == study_schema()
    assert main(["keys", "--schema", "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert {key: printed[key] for key in study_schema()} == study_schema()


def test_benchmarks_start_with_the_same_study(tmp_path):
    """The rigid slider-crank has no errors, which it could not take up; the other one has its tolerance studies."""
    program = runpy.run_path(str(Path(__file__).parents[2] / "benchmarks" / "first_answer.py"))
    rigid, whole = (load_study(program["new_study"](name, tmp_path)) for name in ("new_run", "new_sensitivity"))
    assert [case.name for case in rigid.cases] == ["perfect"] and not any(one.flexible for one in rigid.mechanism.links)
    assert len(whole.cases) > 1 and any(one.flexible for one in whole.mechanism.links)
    assert {"monte_carlo", "sensitivity"} <= set(whole.tasks.declared)
