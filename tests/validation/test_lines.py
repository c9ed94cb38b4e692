"""Verdicts, tables and files of the validation; no mechanics."""

import csv
import json

import numpy as np
import pytest

from rfem_jax import InputError
from rfem_jax.report.command_line import main
from rfem_jax.report.validation import validation_command
from rfem_jax.report.validation.validation_tables import benchmark_text, markdown, write_validation
from rfem_jax.validation import catalogue
from rfem_jax.validation.lines import (
    Benchmark,
    Curve,
    Outcome,
    Picture,
    absolute,
    relative,
    same,
)

GOOD = relative("Beam", "deflection", 1.004, 1.0, 0.01, "closed form", "m")
BAD = absolute("Beam", "slope", 0.13, 0.1, 0.01, "Euler 1744", "rad")
KNOWN = relative("Table", "extension", 2.0, 1.0, 0.5, "Author 1990", "m", reason="its data are off")
WORD = same("Branch", "after the change point", "left", "left", "Author 1990")
PICTURE = Picture("beam", "Beam", "x, m", "m", (
    Curve("ours", np.arange(3.0), np.arange(3.0)),
    Curve("reference", np.arange(3.0), np.arange(3.0), reference=True),
))  # fmt: skip


def test_verdicts():
    verdicts = [line.verdict for line in (GOOD, BAD, KNOWN, WORD)]
    assert verdicts == ["pass", "fail", "not met", "pass"]
    assert [line.difference_unit for line in (GOOD, BAD, KNOWN, WORD)] == ["1", "rad", "1", "1"]
    assert same("", "", "left", "right", "").verdict == "fail"
    assert GOOD.difference == pytest.approx(0.004) and BAD.difference == pytest.approx(0.03)
    assert relative("", "", -0.99, -1.0, 0.1, "").difference == pytest.approx(0.01)


def test_a_reason_excuses_no_value_that_does_not_exist_and_is_not_needed_for_one_that_is_met():
    assert relative("", "", np.nan, 1.0, 0.5, "", reason="known").verdict == "fail"
    assert relative("", "", 1.2, 1.0, 0.5, "", reason="known").verdict == "pass"


def test_tables_show_values_sources_and_reasons():
    text = benchmark_text("Beams", [GOOD, BAD, KNOWN, WORD])
    for part in ("1.004 m", "Euler 1744", "+0.4 %", "0.13 rad", "fail", "not met (1): its data"):
        assert part in text
    table = markdown([GOOD, BAD, KNOWN, WORD])
    assert "| 1 of 2 | Beam: slope |" in table  # the worst of its group
    assert "4 values: 2 pass, 1 not met for a known reason, 1 fail." in table


def test_files(tmp_path):
    broken = relative("Beam", "lost", np.nan, 1.0, 0.01, "closed form")
    write_validation(tmp_path, [GOOD, KNOWN, broken], {"full": False})
    content = json.loads((tmp_path / "validation.json").read_text())
    assert [line["verdict"] for line in content["lines"]] == ["pass", "not met", "fail"]
    assert content["lines"][2]["value"] is None and content["full"] is False
    rows = list(csv.DictReader((tmp_path / "validation.csv").read_text().splitlines()))
    assert [row["difference_unit"] for row in rows] == ["1"] * 3  # relative
    assert float(rows[0]["value"]) == 1.004 and rows[1]["reason"] == "its data are off"


@pytest.mark.parametrize("lines, code", [([GOOD, KNOWN], 0), ([GOOD, BAD], 3)])
def test_the_command_prints_writes_and_tells_by_its_exit_code(lines, code, monkeypatch, tmp_path, capsys):
    asked = []

    def run(full, progress):
        asked.append(full)
        progress(1.0)
        return Outcome(lines, [PICTURE])

    monkeypatch.setattr(catalogue, "BENCHMARKS", (Benchmark("beam", "a beam", run),))
    assert main(["validate", "--only", "beam", "--full", "--out", str(tmp_path)]) == code
    assert asked == [True]
    captured = capsys.readouterr()
    assert "1.004 m" in captured.out and "1 of 1, a beam: 100 %" in captured.err
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {"validation.json", "validation.csv", "validation.md", "beam.png"}


def test_an_unknown_benchmark_is_refused(capsys):
    assert main(["validate", "--only", "elastika"]) == 2
    assert "elastica" in capsys.readouterr().err
    with pytest.raises(InputError, match="--only"):
        catalogue.chosen(["nothing"])


def test_all_benchmarks_are_run_by_default():
    assert catalogue.chosen(None) == catalogue.BENCHMARKS
    assert [one.name for one in catalogue.chosen(["elastica", "cantilever"])] == [
        "cantilever",
        "elastica",
    ]
    assert validation_command.chosen is catalogue.chosen
