"""Zones in the tables [allocation.bounds] and [optimise.bounds]: from the study file to table and picture."""

import json

import numpy as np
import pytest

from rfem_jax import InputError, load_study
from rfem_jax.report.command_line import main

from . import closed_form
from .conftest import STUDY, rows_of

TABLES = """
[tolerances]
"D.parallelism" = { diameter = "0.1 mm", length = "20 mm" }
"D.d_y" = "0.2 mm"
[allocation]
limits = { "D.mean_square_moment" = 9.0 }
[allocation.bounds]
"D.parallelism" = ["0.01 mm", "0.5 mm"]
[optimise]
objective = "cost"
limits = { "D.mean_square_moment" = 9.0 }
[optimise.bounds]
"D.parallelism" = ["0.01 mm", "0.5 mm"]
"""
WIDTH = np.radians(0.25)  # at which the tilt about x alone gives a moment of 4, along d_y 1 at 0.25 mm


@pytest.mark.long
def test_the_diameter_of_a_zone_is_found_and_shown(answered_by, tmp_path, capsys):
    path, out = answered_by(closed_form.build_problem, TABLES), tmp_path / "out"
    assert main(["allocate", str(path), "--out", str(out)]) == 0
    diameter = 3.0 / 4.0 * WIDTH * 0.02
    (row,) = rows_of(out / "allocation.csv")
    assert (row["error"], row["unit"]) == ("D.parallelism", "m")
    assert float(row["after"]) == pytest.approx(diameter, rel=1e-3) and float(row["before"]) == pytest.approx(1e-4)
    found = json.loads((out / "allocation.json").read_text(encoding="utf-8"))
    assert found["cost"] == pytest.approx(1e-4 / diameter, rel=1e-3)  # reciprocal, at what [tolerances] has
    assert found["before"]["cost"] == pytest.approx(1.0)
    assert "D.parallelism" in capsys.readouterr().out
    assert main(["check", str(path)]) == 0
    assert "D.parallelism a cylinder over 20 mm" in " ".join(capsys.readouterr().out.split())


def test_an_optimisation_finds_it_beside_a_tolerance_that_stays(answered_by, tmp_path):
    path, out = answered_by(closed_form.build_problem, TABLES), tmp_path / "out"
    assert main(["optimise", str(path), "--out", str(out)]) == 0
    found = json.loads((out / "optimise.json").read_text(encoding="utf-8"))
    expected = np.sqrt(9.0 - 0.8**2) / 4.0 * WIDTH * 0.02
    assert found["tolerances"] == pytest.approx({"D.d_y": 2e-4, "D.parallelism": expected}, rel=1e-3)
    assert found["units"]["D.parallelism"] == "m"


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('bounds]\n"D.parallelism"', 'bounds]\n"D.paralelism"', "did you mean `D.parallelism`?"),
        ('bounds]\n"D.parallelism"', 'bounds]\n"D.perpendicularity"', "whose length is known"),
        ('bounds]\n"D.parallelism"', 'bounds]\n"E.coaxiality"', "did you mean `A.coaxiality`?"),
        ('"0.01 mm", "0.5 mm"', '"0.01 deg", "0.5 deg"', "must be a length"),
        ('"0.01 mm", "0.5 mm"', '"0.5 mm", "0.1 mm"', "[smallest, largest]"),
    ],
)
def test_wrong_bounds_are_one_sentence_each(tmp_path, old, new, words):
    path = tmp_path / "study.toml"
    head = TABLES.partition("[optimise]")[0]
    path.write_text(STUDY + head.replace(old, new), encoding="utf-8")
    with pytest.raises(InputError) as caught:
        load_study(path)
    text = str(caught.value)
    assert words in text and "allocation.cost" not in text and text.count("Argument") == 1, text
