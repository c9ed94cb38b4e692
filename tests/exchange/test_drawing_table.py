"""Tolerances as on a drawing: symbols of ISO 1101, widths of zones, datums; of a study and of an answer."""

import csv
import io
import json

import pytest

from rfem_jax import InputError, load_study
from rfem_jax.exchange.drawing_table import COLUMNS, OVER, SYMBOLS, drawing_text
from rfem_jax.report.command_line import main

TOLERANCES = """
[tolerances]
"G.delta_z" = "0.1 deg"
"B.child.delta_x" = { interval = ["-0.05 deg", "0.1 deg"] }
"A.d_x" = "0.02 mm"
"G.d_z" = { half_width = "0.05 mm", distribution = "normal" }
"rod.length" = "0.05 mm"
"crank.length" = { interval = ["-0.02 mm", "0.05 mm"] }
"rod.twist" = "0.1 deg"
"B.position" = { diameter = "0.1 mm", length = "20 mm" }
"P.coaxiality" = { fit = "12 H7/g6", length = "15 mm" }
"P.pin_tilt_x" = "0.02 deg"
"crank.bow_y" = "0.02 mm"
"rod.straightness" = "0.1 mm"
"bar.width" = { iso = "12 h9" }
"load.stiffness" = 10.0
"drive.rate" = 0.1
"""


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    """The study of a slider-crank with tolerances of all kinds."""
    path = tmp_path_factory.mktemp("drawing") / "mine.toml"
    assert main(["init", str(path), "--kind", "slider-crank"]) == 0
    text = path.read_text(encoding="utf-8").partition("[tolerances]")[0].rstrip("# \n")
    path.write_text(text + "\n" + TOLERANCES, encoding="utf-8")
    return path


def rows_of(text):
    assert text.startswith("\ufeff")  # for spreadsheets
    rows = list(csv.DictReader(io.StringIO(text[1:])))
    assert tuple(rows[0]) == COLUMNS
    return {row["name"]: row for row in rows}


def test_symbols_are_those_of_the_standard():
    """Code points by their names in Unicode."""
    import unicodedata

    names = {key: unicodedata.name(symbol) for key, symbol in SYMBOLS.items()}
    assert names == {
        "position": "POSITION INDICATOR", "coaxiality": "BULLSEYE", "parallelism": "PARALLEL TO",
        "perpendicularity": "PERPENDICULAR", "angularity": "ANGLE", "straightness": "STRAIGHTNESS",
        "size": "PLUS-MINUS SIGN",
    }  # fmt: skip


def test_errors_zones_and_sizes(path):
    text, left = drawing_text(load_study(path))
    rows = rows_of(text)
    assert left == ("load.stiffness, which no drawing shows", "drive.rate, which no drawing shows")
    assert (rows["drive.rate"]["upper"], rows["drive.rate"]["unit"]) == ("0.1", "rad/s")
    # A displacement is between planes as far apart as its interval; a tilt so wide over 100 mm.
    assert (rows["A.d_x"]["symbol"], rows["A.d_x"]["value"], rows["A.d_x"]["unit"]) == (
        SYMBOLS["position"],
        "0.04",
        "mm",
    )
    assert "across x of A (1 0 0 in base)" in rows["A.d_x"]["zone"] and rows["A.d_x"]["datum"] == "frame of base"
    width = 2 * 0.1 * 3.141592653589793 / 180 * OVER
    assert float(rows["rod.twist"]["value"]) == pytest.approx(width, rel=1e-3)
    assert rows["rod.twist"]["indication"] == f"{SYMBOLS['parallelism']} {rows['rod.twist']['value']}/100 | near end"
    assert float(rows["B.child.delta_x"]["value"]) == pytest.approx(0.75 * width, rel=1e-3)
    # Bores of the rod at B and P: each is parallel to the other; the guide's x is across the base's y.
    assert (rows["B.child.delta_x"]["part"], rows["B.child.delta_x"]["datum"]) == ("rod", "axis of P in rod")
    assert rows["B.child.delta_x"]["characteristic"] == "parallelism"
    assert rows["G.delta_z"]["characteristic"] == "perpendicularity"
    assert rows["G.d_z"]["distribution"] == "normal, 3 sigma"
    zone = rows["B.position"]
    assert (zone["zone"], zone["value"], zone["over_length_mm"], zone["part"]) == ("cylinder", "0.1", "20", "crank")
    assert zone["indication"] == f"{SYMBOLS['position']} \u23000.1 | axis of A in crank"
    fit = rows["P.coaxiality"]  # ISO 286: 18 um of H7 and 17 um of g6 at 12 mm
    assert float(fit["value"]) == pytest.approx(0.035) and fit["indication"].endswith("(12 H7/g6)")
    assert rows["rod.length"]["indication"] == "\u00b10.05"
    assert rows["crank.length"]["indication"] == "+0.05 / -0.02" and rows["crank.length"]["value"] == ""
    # A half-wave of 0.02 mm lies between planes so far apart, and needs no datum.
    assert (rows["crank.bow_y"]["indication"], rows["crank.bow_y"]["datum"]) == (f"{SYMBOLS['straightness']} 0.02", "")
    assert rows["crank.bow_y"]["zone"] == "between planes across y of crank"
    assert rows["rod.straightness"]["indication"] == f"{SYMBOLS['straightness']} \u23000.1"
    # h9 at 12 mm: 0 and -43 um, which stands as its code.
    assert (rows["bar.width"]["lower"], rows["bar.width"]["upper"]) == ("-0.043", "0")
    assert rows["bar.width"]["indication"] == "12 h9"


def test_tolerances_of_an_answer(path, tmp_path, capsys):
    """They take the place of those of the study, with its middles; the table is the same else."""
    answer, table = tmp_path / "allocation.json", tmp_path / "answer.csv"
    found = {"A.d_x": 0.001, "B.position": 0.0004, "crank.length": 1e-4, "A.d_z": 2e-5}
    answer.write_text(json.dumps({"status": "ok", "tolerances": found}), encoding="utf-8")
    assert main(["export", str(path), "--to", "drawing", "--answer", str(answer), "-o", str(table)]) == 0
    rows = rows_of(table.read_text(encoding="utf-8"))
    assert rows["A.d_x"]["value"] == "2" and rows["B.position"]["value"] == "0.4" and rows["A.d_z"]["value"] == "0.04"
    assert (rows["crank.length"]["lower"], rows["crank.length"]["upper"]) == ("-0.085", "0.115")
    assert rows["G.delta_z"]["value"] == "0.3491"
    assert "load.stiffness, which no drawing shows" in capsys.readouterr().out
    for content in ('{"tolerances": {"A.d_x": "wide"}}', "{", "[]"):
        answer.write_text(content, encoding="utf-8")
        assert main(["export", str(path), "--to", "drawing", "--answer", str(answer), "-o", str(tmp_path / "x")]) == 2
    assert main(["export", str(path), "--to", "drawing", "--case", "perfect", "-o", str(tmp_path / "x")]) == 2
    assert main(["export", str(path), "--to", "mjcf", "--answer", str(answer), "-o", str(tmp_path / "x")]) == 2
    assert "must be left out unless --to is drawing" in capsys.readouterr().err
    assert not (tmp_path / "x").exists()


def test_a_study_without_tolerances(path, tmp_path):
    bare = tmp_path / "bare.toml"
    bare.write_text(path.read_text(encoding="utf-8").partition("[tolerances]")[0], encoding="utf-8")
    with pytest.raises(InputError, match="must have tolerances, but the study has none"):
        drawing_text(load_study(bare))
