"""The command for loads at rest, and tasks of a mechanism at rest, from a study file to tables and files."""

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from rfem_jax import InputError, load_study
from rfem_jax.report.command_line import main

from .page_folder import content_of

TOGGLE = Path(__file__).parents[2] / "studies" / "toggle" / "study.toml"


pytestmark = pytest.mark.usefixtures("commands_here")


def changed(tmp_path, *changes):
    text = TOGGLE.read_text(encoding="utf-8")
    for before, after in changes:
        assert before in text
        text = text.replace(before, after)
    path = tmp_path / "study.toml"
    path.write_text(text, encoding="utf-8")
    return path


@pytest.mark.long
def test_a_toggle_is_held_by_its_closed_form(tmp_path, capsys):
    out = tmp_path / "out"
    assert main(["statics", str(TOGGLE), "--out", str(out)]) == 0
    text = capsys.readouterr().out
    assert "What holds the mechanism of case perfect" in text and "jaw_edge.deviation" in text
    content = json.loads((out / "statics.json").read_text(encoding="utf-8"))
    angles = np.radians([20.0, 10.0, 5.0, 2.0])
    perfect, short = (content["cases"][name] for name in ("perfect", "rod_short"))
    assert perfect["status"] == "ok" and perfect["statuses"] == ["ok"] * 4 and content["units"]["A"] == "N m"
    np.testing.assert_allclose(perfect["holding"]["A"], 2.0 * 500.0 * 0.1 * np.sin(angles), rtol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(perfect["joints"]["B"]["force"], axis=1), 500.0 / np.cos(angles))
    assert perfect["metrics"]["A.max_drive_moment"] == pytest.approx(100.0 * np.sin(angles[0]))
    # A rod that is too short leans more: sin(a) r = sin(b) (r - e).
    lean = np.arcsin(0.1 * np.sin(angles) / 0.0998)
    held = 500.0 * 0.1 * (np.sin(angles) + np.cos(angles) * np.tan(lean))
    np.testing.assert_allclose(short["holding"]["A"], held, rtol=1e-9)
    place = 0.03 + 0.1 * np.cos(angles) + 0.0998 * np.cos(lean)
    np.testing.assert_allclose(np.array(short["place"]["jaw_edge"])[:, 0], place, rtol=1e-9)
    assert content["units"]["A.max_drive_moment"] == "N m"
    rows = list(csv.DictReader((out / "statics.csv").read_text(encoding="utf-8").splitlines()))
    assert len(rows) == 8 and float(rows[1]["A_position_rad"]) == pytest.approx(-angles[1])
    assert float(rows[1]["A_holding_Nm"]) == pytest.approx(perfect["holding"]["A"][1])
    assert [one["name"] for one in content_of(out / "report.html")["tasks"]] == ["statics"]


@pytest.mark.long
def test_tolerances_of_a_mechanism_at_rest(tmp_path, capsys):
    out = tmp_path / "out"
    path = changed(tmp_path, ('A = ["-20 deg", "-10 deg", "-5 deg", "-2 deg"]', 'A = "-20 deg"'))
    assert main(["sensitivity", str(path), "--out", str(out)]) == 0
    assert "moment of the drive of A" in capsys.readouterr().out
    content = json.loads((out / "sensitivity.json").read_text(encoding="utf-8"))
    gradient = content["metrics"]["A.end_drive_moment"]["gradient"]
    step, angle = 1e-6, np.radians(20.0)

    def held(lever, rod):
        lean = np.arcsin(lever * np.sin(angle) / rod)
        return 500.0 * lever * (np.sin(angle) + np.cos(angle) * np.tan(lean))

    of_rod = (held(0.1, 0.1 + step) - held(0.1, 0.1 - step)) / (2.0 * step)
    of_lever = (held(0.1 + step, 0.1) - held(0.1 - step, 0.1)) / (2.0 * step)
    assert gradient["rod.length"] == pytest.approx(of_rod, rel=1e-6)
    assert gradient["lever.length"] == pytest.approx(of_lever, rel=1e-6)
    assert content["duration"] is None and content["statics"]["positions"] == {"A": [pytest.approx(-angle)]}


def test_a_simulation_of_a_study_without_one_is_refused(tmp_path, capsys):
    assert main(["run", str(TOGGLE), "--out", str(tmp_path / "no")]) == 2
    assert "[simulation]" in capsys.readouterr().err
    assert main(["check", str(TOGGLE)]) == 0
    assert "Statics: held A, at 4 positions" in capsys.readouterr().out


def test_options_take_the_place_of_the_table(tmp_path, capsys):
    for options, words in (
        (["--positions", "20 deg"], "--positions"),
        (["--positions", "A=20 mm"], "positions.A"),
        (["--positions", "Q=1"], "`Q`"),
        (["--hold", "C"], "`hold`"),
    ):
        assert main(["statics", str(TOGGLE), "--out", str(tmp_path / "no"), *options]) == 2
        assert words in capsys.readouterr().err


def test_what_is_wrong_in_the_table_is_said(tmp_path):
    positions = 'A = ["-20 deg", "-10 deg", "-5 deg", "-2 deg"]'
    for change, words in (
        ((positions, 'A = ["-20 deg", "1 mm"]'), ("positions.A", "angle")),
        ((positions, 'A = ["-20 deg", "-10 deg"]\nB = ["1 deg", "2 deg", "3 deg"]'), ("one length", "`A`")),
        ((positions, "A = []"), ("one length",)),
        ((positions, "Q = 1"), ("`Q`", "positions")),
        ((positions, f'{positions}\n[statics2]'), ("statics2",)),
        (("[statics.positions]", '[statics]\nhold = 3\n[statics.positions]'), ("`hold`", "a name of a joint")),
        (("[statics.positions]", '[statics]\nstart = "hung"\n[statics.positions]'), ("`start`", "equilibrium")),
        (('[sensitivity]\nmetrics = ["A.end_drive_moment",', '[sensitivity]\nmetrics = ["A.peak_drive_power",'),
         ("`sensitivity`", "at rest", "A.peak_drive_power")),
        (('[sensitivity]\nmetrics = ["A.end_drive_moment",', '[sensitivity]\nmetrics = ["jaw_edge@1s.x",'),
         ("jaw_edge.x", "last position")),
    ):  # fmt: skip
        with pytest.raises(InputError) as told:
            load_study(changed(tmp_path, change))
        assert all(word in str(told.value) for word in words), str(told.value)


HAND = """
[mechanism]
gravity = [0, 0, 0]
[mechanism.materials.steel]
youngs_modulus = "210 GPa"
poisson_ratio = 0.3
density = 7850.0
[mechanism.sections.bar]
shape = "circle"
diameter = "10 mm"
[[mechanism.links]]
name = "hand"
length = 0.3
section = "bar"
material = "steel"
rigid = true
[[mechanism.joints]]
name = "A"
parent = "base"
child = "hand"
[[cases]]
name = "perfect"
[statics.positions]
A = ["0 deg", "90 deg"]
[statics.rates]
A = "60 rpm"
[statics.accelerations]
A = ["0 rad/s^2", "10 rad/s^2"]
"""


def test_loads_in_a_given_motion(tmp_path, capsys):
    file = tmp_path / "study.toml"
    file.write_text(HAND, encoding="utf-8")
    assert load_study(file).statics.accelerations == {"A": (0.0, 10.0)}
    assert main(["statics", str(file), "--out", str(tmp_path / "out")]) == 0
    assert "What drives the mechanism" in capsys.readouterr().out
    found = json.loads((tmp_path / "out" / "statics.json").read_text(encoding="utf-8"))["cases"]["perfect"]
    mass = 7850.0 * np.pi * 0.005**2 * 0.3
    assert_allclose(found["rate"]["A"], 2 * [2.0 * np.pi])
    assert_allclose(found["holding"]["A"], [0.0, 10.0 * mass * (0.3**2 / 3.0 + 0.005**2 / 4.0)], rtol=1e-9, atol=1e-12)
    rows = np.genfromtxt(tmp_path / "out" / "statics.csv", delimiter=",", names=True, dtype=None, encoding="utf-8")
    assert_allclose(rows["A_acceleration_rad_s2"], [0.0, 10.0])
    # The pull of the hinge is what holds the hand's centre on its circle.
    assert_allclose(np.hypot(rows["A_force_x_N"], rows["A_force_z_N"])[0], mass * 0.15 * (2.0 * np.pi) ** 2, rtol=1e-9)
    arguments = ["statics", str(file), "--out", str(tmp_path / "other"), "--rates", "A=0 rpm", "--accelerations", "A=0"]
    assert main(arguments) == 0
    assert main(["statics", str(file), "--out", str(tmp_path), "--rates", "60 rpm"]) == 2
    assert "`--rates` must name a joint and its rates" in capsys.readouterr().err


COLUMN = """
[mechanism]
gravity = [0.0, 0.0, 0.0]
elements = "geometrically_exact"

[mechanism.materials.steel]
youngs_modulus = "210 GPa"
poisson_ratio = 0.3
density = 7850.0

[mechanism.sections.bar]
shape = "rectangle"
width = "10 mm"
height = "10 mm"

[[mechanism.links]]
name = "bar"
length = "1 m"
section = "bar"
material = "steel"
rfes = 4

[[mechanism.joints]]
name = "A"
kind = "fixed"
parent = "base"
child = "bar"

[[mechanism.forces]]
name = "load"
kind = "point_force"
link = "bar"
position = 1.0
force = [-3000.0, 0.0, 0.0]

[statics]
"""


def test_a_column_beyond_its_buckling_load_is_told(tmp_path, capsys):
    """432 N is Euler's load of it: status, exit code, how it is left, in words, file and page."""
    file, out = tmp_path / "study.toml", tmp_path / "out"
    file.write_text(COLUMN, encoding="utf-8")
    assert main(["statics", str(file), "--out", str(out)]) == 3
    printed = " ".join(capsys.readouterr().out.split())
    assert "1 of 1 positions of case nominal have no stable equilibrium" in printed
    case = json.loads((out / "statics.json").read_text(encoding="utf-8"))["cases"]["nominal"]
    assert case["status"] == "unstable" and case["growth_rate"][0] > 100.0
    assert case["remarks"][0].endswith("mostly in link bar.") and case["remarks"][0] in printed
    (task,) = content_of(out / "report.html")["tasks"]
    assert "remarks" in str(task)
