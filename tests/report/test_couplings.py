"""A coupling of a study in what commands write: the text of `check`, files, labelled data and the page, and its errors
in cases and sensitivities."""

import json

import numpy as np
import pytest
from numpy.testing import assert_allclose

from rfem_jax import InputError, load_study
from rfem_jax.report.command_line import main
from rfem_jax.simulation.cases import run_cases

pytestmark = pytest.mark.usefixtures("commands_here")

RADIUS, STIFFNESS, RATE, MASS = 0.02, 1e5, 40.0, 0.3
STUDY = f"""
title = "A rack under its pinion"

[mechanism]
gravity = [0, 0, 0]

[[mechanism.links]]
name = "pinion"
length = 0.05
body = {{ mass = 0.1, centre = [0, 0, 0], inertia = [1e-4, 1e-4, 1e-4] }}

[[mechanism.links]]
name = "rack"
length = 0.1
body = {{ mass = {MASS}, centre = [0, 0, 0], inertia = [1e-4, 1e-4, 1e-4] }}

[[mechanism.joints]]
name = "A"
parent = "base"
child = "pinion"

[[mechanism.joints]]
name = "G"
parent = "base"
child = "rack"
kind = "prismatic"
speed = {RADIUS * RATE}

[[mechanism.couplings]]
name = "mesh"
joints = ["A", "G"]
ratio = "{1e3 * RADIUS} mm/rad"
stiffness = {STIFFNESS}
damping = 100

[drive]
joint = "A"
kind = "prescribed_rate"
rate = {RATE}

[simulation]
duration = 0.1
method = "rk4"
step = 2e-4
save_every = 1e-2

[[cases]]
name = "perfect"

[[cases]]
name = "eccentric"
errors = {{ "mesh.eccentricity" = "0.1 mm" }}

[tolerances]
"mesh.ratio" = "0.01 mm/rad"
"mesh.pitch_error" = "0.02 deg"

[sensitivity]
metrics = ["G.end_displacement", "mesh.max_mesh_force", "*.peak_mesh_force"]
"""


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    file = tmp_path_factory.mktemp("couplings") / "study.toml"
    file.write_text(STUDY, encoding="utf-8")
    return file


@pytest.fixture(scope="module")
def folder(path):
    out = path.parent / "out"
    assert main(["run", str(path), "--out", str(out)]) == 0
    return out


def columns(file):
    return np.genfromtxt(file, delimiter=",", names=True)


@pytest.mark.long
def test_the_files_have_both_loads(folder):
    perfect, eccentric = (columns(folder / f"{case}.csv") for case in ("perfect", "eccentric"))
    assert_allclose(perfect["G_displacement_m"], RADIUS * RATE * perfect["time_s"], rtol=0, atol=1e-9)
    force = eccentric["mesh_second_force_N"]
    # The rack follows the pinion's error once the mesh has settled.
    angle = RATE * eccentric["time_s"]
    accelerated = -MASS * 1e-4 * RATE**2 * np.sin(angle)
    assert_allclose(force[5:], accelerated[5:], rtol=0, atol=0.02 * np.abs(accelerated).max())
    slope = RADIUS + 1e-4 * np.cos(angle)
    assert_allclose(eccentric["mesh_first_moment_Nm"], -slope * force, rtol=1e-9, atol=1e-12)
    assert np.all(np.isfinite(eccentric["mesh_deflection_m"]))
    cases = json.loads((folder / "results.json").read_text(encoding="utf-8"))["cases"]
    assert [case["status"] for case in cases.values()] == ["ok", "ok"]


@pytest.fixture(scope="module")
def ideal(tmp_path_factory):
    """The same without a mesh, in which the rack follows without a start of its own."""
    file = tmp_path_factory.mktemp("ideal") / "study.toml"
    text = STUDY.replace(f"stiffness = {STIFFNESS}\ndamping = 100\n", "").replace(f"speed = {RADIUS * RATE}\n", "")
    file.write_text(text, encoding="utf-8")
    return file


@pytest.mark.long
def test_an_ideal_coupling_follows_its_errors_at_once(ideal, capsys):
    out = ideal.parent / "out"
    assert main(["run", str(ideal), "--out", str(out)]) == 0
    perfect, eccentric = (columns(out / f"{case}.csv") for case in ("perfect", "eccentric"))
    assert_allclose(perfect["mesh_second_force_N"], 0.0, atol=1e-9)
    accelerated = -MASS * 1e-4 * RATE**2 * np.sin(RATE * eccentric["time_s"])
    assert_allclose(eccentric["mesh_second_force_N"], accelerated, rtol=0, atol=1e-9)
    assert_allclose(eccentric["mesh_deflection_m"], 0.0, atol=1e-9)
    capsys.readouterr()
    assert main(["check", str(ideal)]) == 0
    assert "of joints A, R_y and G, T_x, ideal, by a ratio" in " ".join(capsys.readouterr().out.split())


@pytest.mark.long
def test_tasks_with_an_ideal_coupling(ideal):
    """Monte Carlo by an angle that a load holds: the moment is the force times the radius of each sample."""
    text = ideal.read_text(encoding="utf-8")
    statics = text[: text.index("[drive]")] + text[text.index("[tolerances]") : text.index("[sensitivity]")]
    statics = statics.replace("gravity = [0, 0, 0]", "gravity = [10, 0, 0]")
    statics += """
[statics]
hold = "A"

[monte_carlo]
metrics = ["mesh.max_mesh_force"]
n = 8

[[cases]]
name = "perfect"
"""
    file = ideal.parent / "statics.toml"
    file.write_text(statics, encoding="utf-8")
    out = ideal.parent / "statics"
    assert main(["statics", str(file), "--out", str(out)]) == 0
    found = columns(out / "statics.csv")
    assert_allclose(found["mesh_second_force_N"], -10.0 * MASS, rtol=1e-12)
    assert_allclose(found["mesh_first_moment_Nm"], 10.0 * MASS * RADIUS, rtol=1e-12)
    assert main(["monte-carlo", str(file), "--out", str(out)]) == 0
    drawn = columns(out / "monte_carlo.csv")
    assert len(drawn) == 8
    assert_allclose(drawn["meshmax_mesh_force_N"], 10.0 * MASS, rtol=1e-12)


@pytest.mark.long
def test_a_turn_has_the_loads(path, tmp_path):
    """At rest the mesh carries nothing."""
    assert main(["turn", str(path), "--out", str(tmp_path)]) == 0
    found = np.genfromtxt(tmp_path / "turn.csv", delimiter=",", names=True, dtype=None, encoding="utf-8")
    assert_allclose([found["mesh_first_moment_Nm"], found["mesh_second_force_N"]], 0.0, atol=1e-9)


def test_check_says_what_is_coupled(path, capsys):
    assert main(["check", str(path)]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "Coupling mesh: of joints A, R_y and G, T_x, by a ratio" in said and "ratio 0.02" in said


def test_labelled_data(path):
    data = run_cases(load_study(path))[1].to_xarray()
    load = data["coupling_load"].sel(case="eccentric", coupling="mesh")
    assert load.dims == ("time", "coupled")
    assert_allclose(data["coupling_deflection"].sel(case="perfect", coupling="mesh"), 0.0, atol=1e-9)


@pytest.mark.long
def test_errors_have_sensitivities(path, capsys):
    out = path.parent / "sensitivity"
    assert main(["sensitivity", str(path), "--out", str(out)]) == 0
    found = json.loads((out / "sensitivity.json").read_text(encoding="utf-8"))
    # The way is ratio times the angle, 4 rad, and the radius times the pitch error.
    gradient = found["metrics"]["G.end_displacement"]["gradient"]
    assert_allclose([gradient["mesh.ratio"], gradient["mesh.pitch_error"]], [4.0, RADIUS], rtol=1e-7)
    # The perfect mesh carries nothing in even motion but what the first instants ask for.
    assert {"mesh.max_mesh_force", "mesh.peak_mesh_force"} < set(found["metrics"])


@pytest.mark.parametrize(
    ("name", "pieces"),
    [
        ("mesh.max_mesh_moment", ("second coordinate is a translation", "`max_mesh_force`")),
        ("mseh.max_mesh_force", ("no coupling `mseh`", "did you mean `mesh`?")),
    ],
)
def test_wrong_metrics_are_told(path, name, pieces, tmp_path):
    file = tmp_path / "wrong.toml"
    file.write_text(STUDY.replace("mesh.max_mesh_force", name), encoding="utf-8")
    with pytest.raises(InputError) as raised:
        load_study(file)
    assert all(piece in str(raised.value) for piece in pieces)
