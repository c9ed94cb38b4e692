"""The picture of a mechanism at its start, without a run, of a study that has what may be left out left out."""

import argparse

import numpy as np
import pytest

from rfem_jax import InputError, load_study
from rfem_jax.mechanics import discretise
from rfem_jax.report.commands import check
from rfem_jax.report.drawings.shapes import start_figure

STUDY = """
title = "A four-bar as in a figure"
[mechanism]
plane = "xy"
[[mechanism.links]]
name = "crank"
length = "120 mm"
body = { mass = 0.1, centre = ["60 mm", 0, 0], inertia = [1e-5, 1e-4, 1e-4] }
[[mechanism.links]]
name = "coupler"
length = "300 mm"
body = { mass = 0.3, centre = ["150 mm", 0, 0], inertia = [1e-5, 1e-3, 1e-3] }
[[mechanism.links]]
name = "rocker"
length = "250 mm"
body = { mass = 0.3, centre = ["125 mm", 0, 0], inertia = [1e-5, 1e-3, 1e-3] }
[[mechanism.joints]]
name = "A"
parent = "base"
child = "crank"
angle = "60 deg"
[[mechanism.joints]]
name = "B"
parent = "crank"
child = "coupler"
[[mechanism.joints]]
name = "D"
parent = "base"
child = "rocker"
position = ["300 mm", 0, 0]
[[mechanism.joints]]
name = "C"
parent = "coupler"
child = "rocker"
cut = true
mode = "open"
[[mechanism.forces]]
name = "load"
link = "coupler"
position = "150 mm"
force = [0, -20, 0]
[[mechanism.forces]]
name = "snow"
link = "rocker"
load = [0, -10, 0]
[drive]
joint = "A"
kind = "prescribed_rate"
rate = "60 rpm"
[simulation]
duration = 0.1
method = "rk4"
step = "1 ms"
[[cases]]
name = "perfect"
"""


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    path = tmp_path_factory.mktemp("start") / "figure.toml"
    path.write_text(STUDY, encoding="utf-8")
    return path


def asked(file, *more):
    command, parser = check.command(), argparse.ArgumentParser()
    command.add_arguments(parser)
    return check.act(parser.parse_args([str(file), *more]))


def test_the_start_is_drawn_as_it_is_closed(file):
    study = load_study(file)
    axes = start_figure(study, discretise(study.mechanism)).axes[0]
    lines = {line.get_label(): np.array(line.get_data_3d()) for line in axes.lines}
    crank = 0.12 * np.array([0.5, np.sqrt(0.75), 0.0])
    np.testing.assert_allclose(lines["crank"][:, 1], crank, atol=1e-12)
    np.testing.assert_allclose(lines["coupler"][:, 0], crank, atol=1e-12)
    np.testing.assert_allclose(lines["rocker"][:, 0], (0.3, 0.0, 0.0), atol=1e-12)
    end = lines["coupler"][:, 1]
    np.testing.assert_allclose(lines["rocker"][:, 1], end, atol=1e-9)
    # C by two circles, on the other side of the line from B to D than A: open.
    np.testing.assert_allclose([np.hypot(*(end - crank)[:2]), np.hypot(end[0] - 0.3, end[1])], (0.3, 0.25), rtol=1e-9)
    assert end[1] > crank[1] and end[2] == 0.0
    words = [text.get_text().strip() for text in axes.texts]
    assert words.count("load") == words.count("snow") == 1 and {"A", "B", "C", "D"} <= set(words)


def test_the_points_that_are_followed_are_drawn(file, tmp_path):
    points = 'points = ["B", "rocker.end", { name = "P", link = "coupler", position = [0.1, 0.05, 0] }]\n'
    path = tmp_path / "figure.toml"
    path.write_text(STUDY.replace("[mechanism]\n", f"[mechanism]\n{points}"), encoding="utf-8")
    study = load_study(path)
    axes = start_figure(study, discretise(study.mechanism)).axes[0]
    lines = {line.get_label(): np.array(line.get_data_3d()) for line in axes.lines}
    crosses = [np.array(line.get_data_3d())[:, 0] for line in axes.lines if line.get_marker() == "x"]
    start, end = lines["coupler"].T
    along = (end - start) / 0.3
    place = start + 0.1 * along + 0.05 * np.array([-along[1], along[0], 0.0])
    np.testing.assert_allclose(sorted(map(tuple, crosses)), sorted(map(tuple, [start, end, place])), atol=1e-9)
    words = [text.get_text().strip() for text in axes.texts]
    assert words.count("P") == words.count("rocker.end") == words.count("B") == 1
    assert "point that is followed" in [text.get_text() for text in axes.figure.legends[0].get_texts()]


def test_check_draws_it_and_says_how_loops_are_closed(file, tmp_path, capsys):
    asked(file, "--picture", str(tmp_path / "pictures" / "start.png"))
    told = " ".join(capsys.readouterr().out.split())
    assert (tmp_path / "pictures" / "start.png").read_bytes().startswith(b"\x89PNG")
    assert "The start is drawn in" in told and "Plane: x and y, hinges turn about z." in told
    assert "Loops are closed with A = 60 deg, B = -31.085 deg, D = 84.813 deg (C open)." in told
    assert "those across it are zero, since all joints, masses and forces lie in it." in told


def test_another_file_is_refused_before_anything_is_read(tmp_path):
    with pytest.raises(InputError, match='`--picture` must be a file that ends with ".png"'):
        asked(tmp_path / "none.toml", "--picture", "start.svg")
    occupied = tmp_path / "file"
    occupied.touch()
    with pytest.raises(InputError, match="must be a folder that can be written"):
        asked(tmp_path / "none.toml", "--picture", str(occupied / "start.png"))


def test_check_says_which_errors_cannot_be_assembled(tmp_path, capsys):
    """Those across the plane of rigid links, by cases and tolerances; others are not told."""
    case = '[[cases]]\nname = "askew"\nerrors = { "D.delta_x" = "0.5 deg", "rocker.length" = "1 mm" }\n'
    file = tmp_path / "figure.toml"
    tolerances = '[tolerances]\n"C.d_y" = "1 mm"\n"D.d_x" = "1 mm"\n'
    file.write_text(f"{STUDY}{case}{tolerances}", encoding="utf-8")
    asked(file)
    told = " ".join(capsys.readouterr().out.split())
    assert "nothing gives: `D.delta_x` of case askew; `C.d_y` of [tolerances] cannot be assembled." in told
