"""The commands for natural modes and for the kinetostatic turn, from a study file to tables and files."""

import csv
import json
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rfem_jax import load_study
from rfem_jax.mechanics.model.model import Coordinates
from rfem_jax.mechanics.model.status import NO_MODES, OK
from rfem_jax.report import command_line
from rfem_jax.report.analyses import modes_report
from rfem_jax.report.command_line import main
from rfem_jax.simulation.vibrations.modes import NaturalModes
from tests.study_texts import STEEL, hinge, link, rectangle

from .page_folder import content_of

STUDY = f"""
title = "Arm"
{STEEL}{rectangle('"8 mm"', '"12 mm"')}{link("arm", 0.4, "rfes = 2")}{hinge("arm", 'angle = "90 deg"')}[drive]
joint = "A"
kind = "prescribed_rate"
rate = 1
[simulation]
duration = 0.1
step = 1e-6
[[cases]]
name = "nominal"
[[cases]]
name = "longer"
errors = {{ "arm.length" = "2 mm" }}
"""
DENSER = """
[[cases]]
name = "denser"
errors = { "steel.density" = "100 kg/m^3" }
[tolerances]
"drive.rate" = 0.1
"""


@pytest.fixture(autouse=True)
def _settled(monkeypatch):
    """JAX is set up already."""
    monkeypatch.setattr(command_line, "set_up_jax", lambda *_: None)


@pytest.fixture
def study(tmp_path):
    path = tmp_path / "study.toml"
    path.write_text(STUDY, encoding="utf-8")
    return path


@pytest.mark.long
def test_modes_of_all_cases_with_derivatives(study, tmp_path, capsys):
    out = tmp_path / "out"
    study.write_text(STUDY + DENSER, encoding="utf-8")
    assert main(["modes", str(study), "--out", str(out), "--count", "2"]) == 0
    text = capsys.readouterr().out
    assert "nominal, Hz" in text and "arm.length" in text and "4 files written" in text
    content = json.loads((out / "modes.json").read_text(encoding="utf-8"))
    assert "drive.rate" not in text  # which no frequency depends on
    assert content["units"]["frequency"] == "Hz" and content["analysis"] == "modes"
    first, longer = (content["cases"][name] for name in ("nominal", "longer"))
    assert first["status"] == longer["status"] == "ok"
    difference = (longer["modes"][0]["frequency"] - first["modes"][0]["frequency"]) / 2e-3
    mean = (first["modes"][0]["derivatives"]["arm.length"] + longer["modes"][0]["derivatives"]["arm.length"]) / 2
    assert difference == pytest.approx(mean, rel=1e-3)
    rows = list(csv.DictReader((out / "modes.csv").read_text(encoding="utf-8").splitlines()))
    assert len(rows) == 6 and float(rows[0]["by_arm.length_Hz_m"]) < 0
    denser = content["cases"]["denser"]["modes"][0]["frequency"]  # without gravity's part, which is small
    assert denser / first["modes"][0]["frequency"] == pytest.approx((7850 / 7950) ** 0.5, rel=1e-5)
    assert (out / "modes.png").stat().st_size > 1000
    shape = content["shapes"]["links"]["arm"]
    points, moves = np.array(shape["points"]), np.array(shape["moves"])
    assert content["shapes"]["case"] == "nominal" and moves.shape == (2, *points.shape)
    # It hangs from A; the largest displacement of each mode is one, and A, which is locked, stays where it is.
    np.testing.assert_allclose(points[[0, -1]], [[0.0, 0.0, 0.0], [0.0, 0.0, -0.4]], atol=1e-6)
    np.testing.assert_allclose(np.abs(moves).max(axis=(1, 2)), 1.0)
    np.testing.assert_allclose(moves[:, 0], 0.0, atol=1e-6)
    assert [one["name"] for one in content_of(out / "report.html")["tasks"]] == ["modes"]


def test_frequencies_that_are_not_numbers_are_told(study, tmp_path):
    """As of one of two cases: in the table, in the files, and by their status."""

    def modes_of(frequency, status):
        values, nothing = jnp.full(1, frequency), jnp.zeros((1, 6, 0))
        still = Coordinates(jnp.zeros(1), nothing[0])
        shapes = values[:, None], nothing
        return NaturalModes(values, values, values, *shapes, jnp.ones(1), jnp.zeros(()), still, jnp.asarray(status))

    modes = jax.tree.map(lambda *x: np.stack(x), modes_of(1.5, OK), modes_of(np.nan, NO_MODES))
    result = modes_report.ModesResult(modes, (), (), np.zeros((2, 1, 0)))
    read = load_study(study)
    text = modes_report.modes_text(read, result)
    assert "longer*, Hz" in text and "nominal, Hz" in text and "not finite numbers" in text
    modes_report.write_modes(tmp_path, read, result, modes_report.Shapes({}, {"arm": np.zeros((1, 2, 3))}))
    cases = json.loads((tmp_path / "modes.json").read_text(encoding="utf-8"))["cases"]
    assert [one["status"] for one in cases.values()] == ["ok", "no_modes"]
    assert [one["modes"][0]["stable"] for one in cases.values()] == [True, None]
    assert cases["longer"]["modes"][0]["frequency"] is None


@pytest.mark.slow
def test_a_turn_over_a_range_of_all_cases(study, tmp_path, capsys):
    out = tmp_path / "out"
    assert main(["turn", str(study), "--out", str(out), "--positions", "3", "--from", "0 deg", "--to", "90 deg"]) == 0
    text = capsys.readouterr().out
    assert "Case longer" in text and "max stress, MPa" in text and "The drive holds with" in text
    content = json.loads((out / "turn.json").read_text(encoding="utf-8"))
    weight = 7850 * 0.008 * 0.012 * 0.4 * 9.81
    joint = content["cases"]["nominal"]["joints"]["A"]
    assert joint["max_force"] == pytest.approx(weight, rel=1e-9)
    assert joint["max_moment"] == pytest.approx(weight * 0.2, rel=1e-4) and abs(joint["max_moment_at"]) < 1e-12
    stress = content["cases"]["nominal"]["stress"]["arm"]
    assert stress["max_stress"] == pytest.approx(weight * 0.2 * 6 / (0.008 * 0.012**2), rel=1e-3)
    rows = list(csv.DictReader((out / "turn.csv").read_text(encoding="utf-8").splitlines()))
    assert len(rows) == 6 and float(rows[2]["position_rad"]) == pytest.approx(math.pi / 2)
    assert abs(float(rows[2]["holding_Nm"])) < 1e-9 and rows[2]["status"] == "ok"
    assert (out / "turn.png").stat().st_size > 1000
    curves = content["cases"]["nominal"]["curves"]
    np.testing.assert_allclose(curves["position"], [0.0, math.pi / 4, math.pi / 2])
    np.testing.assert_allclose(curves["force"]["A"], weight, rtol=1e-9)
    np.testing.assert_allclose(curves["moment"]["A"], weight * 0.2 * np.cos(curves["position"]), rtol=1e-3, atol=1e-9)
    assert max(curves["stress"]["arm"]) == pytest.approx(stress["max_stress"])
    assert [one["name"] for one in content_of(out / "report.html")["tasks"]] == ["turn"]


def test_what_cannot_be_asked_is_said(study, tmp_path, capsys):
    for arguments, words in (
        (["modes", "--count", "0"], "`count`"),
        (["turn", "--from", "3 mm"], "--from"),
        (["turn", "--positions", "0"], "`positions`"),
    ):
        assert main([arguments[0], str(study), "--out", str(tmp_path / "no"), *arguments[1:]]) == 2
        assert words in capsys.readouterr().err


@pytest.mark.long
def test_metrics_of_all_cases_of_a_run(tmp_path, capsys):
    text = STUDY.replace("rfes = 2", "rigid = true").replace("duration = 0.1", "duration = 1e-3\nsave_every = 5e-4")
    text = text.replace("step = 1e-6", "step = 1e-4").replace(
        'title = "Arm"', 'title = "Arm"\nmetrics = ["*.max_stress", "mass", "peak_drive_power"]'
    )
    path, out = tmp_path / "study.toml", tmp_path / "out"
    path.write_text(text, encoding="utf-8")
    assert main(["run", str(path), "--out", str(out)]) == 0
    assert "arm.max_stress" in capsys.readouterr().out
    content = json.loads((out / "results.json").read_text(encoding="utf-8"))
    assert content["units"]["metrics"] == {"arm.max_stress": "Pa", "mass": "kg", "peak_drive_power": "W"}
    nominal, longer = (content["cases"][name]["metrics"] for name in ("nominal", "longer"))
    weight = 7850 * 0.008 * 0.012 * 9.81
    assert nominal["mass"] == pytest.approx(weight * 0.4 / 9.81) and longer["mass"] == pytest.approx(
        weight * 0.402 / 9.81
    )
    # The arm hangs and turns by a milliradian: weight and centrifugal force pull at the hinge, and the weight bends.
    pull = weight * 0.4 + weight / 9.81 * 0.4 * 0.2
    bending = weight * 0.4 * 0.2 * 1e-3 * 6 / (0.008 * 0.012**2)
    assert nominal["arm.max_stress"] == pytest.approx(pull / (0.008 * 0.012) + bending, rel=1e-4)
    assert 0 < nominal["peak_drive_power"] < weight * 0.4 * 0.2 * 1e-3
    path.write_text(text.replace('"mass"', '"mas"'), encoding="utf-8")
    assert main(["run", str(path), "--out", str(out)]) == 2
    assert "did you mean `mass`" in capsys.readouterr().err


@pytest.mark.long
def test_a_cycle_is_reported_as_a_run_of_one_revolution(tmp_path, capsys):
    text = STUDY.replace("rfes = 2", "rigid = true").replace("duration = 0.1", "duration = 1.0\nsave_every = 0.5")
    text = text.replace("step = 1e-6", "step = 0.05").replace("rate = 1\n", "rate = 1\nrise_time = 0.1\n")
    path, out = tmp_path / "study.toml", tmp_path / "out"
    path.write_text(f'{text}\n[design]\n"drive.rate" = 2\n', encoding="utf-8")
    assert main(["cycle", str(path), "--out", str(out)]) == 0
    assert "repeats after 2 revolutions" in capsys.readouterr().out
    content = json.loads((out / "results.json").read_text(encoding="utf-8"))
    assert content["duration"] == pytest.approx(math.pi)
    mass = 7850 * 0.008 * 0.012 * 0.4
    # Weight and centrifugal force, over a revolution at right angles in the mean.
    rms = mass * math.hypot(9.81, 0.2 * 2.0**2)
    assert content["cases"]["nominal"]["joints"]["A"]["rms_force"] == pytest.approx(rms, rel=1e-6)
    path.write_text(
        text.replace(
            'kind = "prescribed_rate"\nrate = 1\nrise_time = 0.1', 'kind = "moment_ramp"\nmoment = 1\nrise_time = 0.1'
        )
    )
    assert main(["cycle", str(path), "--out", str(out)]) == 2
    assert "prescribed_rate" in capsys.readouterr().err
