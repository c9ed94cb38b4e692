"""The main study as the README has it run, against values of an independent implementation (damping 1e-5 s, 5 rfes a
link): its command in a process of its own, compiled as shipped, and the files that it writes.

Reference: `rfem_jax/validation/references/four_bar_study.json`, with exact rotations.  Tolerances: differences of the
linear classical spring-damping elements from these.
"""

import csv
import json
import os
import subprocess
import sys

import numpy as np
import pytest

from rfem_jax.validation.reference_values import read_reference
from tests.programs.conftest import COMMAND_LINE, ROOT

pytestmark = pytest.mark.slow

JOINTS = "ABCD"
REFERENCE = read_reference("four_bar_study")


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """Folder of the results and what was printed."""
    folder = tmp_path_factory.mktemp("four_bar")
    command = [sys.executable, "-m", COMMAND_LINE, "run", "studies/four_bar/study.toml", "--out", str(folder / "out")]
    environment = {key: value for key, value in os.environ.items() if not key.startswith(("JAX_", "RFEM_", "XLA_"))}
    environment |= dict.fromkeys(("HOME", "XDG_CACHE_HOME"), str(folder / "home"))
    environment |= {"PYTHONPATH": str(ROOT), "JAX_PLATFORMS": "cpu"}
    answer = subprocess.run(command, env=environment, cwd=ROOT, capture_output=True, text=True)
    assert answer.returncode == 0, answer.stdout[-2000:] + answer.stderr[-4000:]
    return folder / "out", answer.stdout


@pytest.fixture(scope="module")
def results(written):
    return json.loads((written[0] / "results.json").read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def cases(results):
    return results["cases"]


@pytest.fixture(scope="module")
def histories(written, cases):
    """{case: {column: values at the saved times}}."""
    found = {}
    for case in cases:
        with open(written[0] / f"{case}.csv", newline="", encoding="utf-8") as file:
            rows = list(csv.DictReader(file))
        found[case] = {name: np.array([float(row[name]) for row in rows]) for name in rows[0]}
    return found


def by_joint(case, quantity):
    return np.array([case["joints"][name][quantity] for name in JOINTS])


def known(name, case):
    return [REFERENCE[name][case][joint] for joint in JOINTS]


def test_all_cases_are_complete_and_compiled_as_shipped(results, cases, written):
    assert list(cases) == ["P1", "P2", "P3", "P4", "P5"] and {case["status"] for case in cases.values()} == {"ok"}
    assert results["compilation"]["kept_programs"] == "used"
    assert {"rms_loads.png", "preload.png", "report.html"} <= {path.name for path in written[0].iterdir()}
    assert all(name in written[1] for name in cases)


@pytest.mark.parametrize("case", ["P1", "P2"])
def test_rms_forces(cases, case):
    np.testing.assert_allclose(by_joint(cases[case], "rms_force"), known("rms_force", case), rtol=5e-4)


def test_rms_moments(cases):
    np.testing.assert_allclose(by_joint(cases["P2"], "rms_moment"), known("rms_moment", "P2"), rtol=1e-3)
    assert max(by_joint(cases["P1"], "rms_moment")) < 1e-6


def test_maxima(cases):
    axial = by_joint(cases["P2"], "max_axial_force")
    np.testing.assert_allclose(axial, known("max_axial_force", "P2"), rtol=3e-3)
    for case in ("P1", "P2"):
        normal = by_joint(cases[case], "max_normal_force")
        np.testing.assert_allclose(normal, known("max_normal_force", case), rtol=8e-3)
    assert max(by_joint(cases["P1"], "max_axial_force")) < 1e-6


def test_preload(cases):
    for load in ("force", "moment"):
        found = np.linalg.norm(by_joint(cases["P2"], f"preload_{load}"), axis=1)
        np.testing.assert_allclose(found, known(f"preload_{load}", "P2"), rtol=5e-4)
    for case, value in REFERENCE["holding_moment"].items():
        np.testing.assert_allclose(cases[case]["joints"]["A"]["preload_moment"][1], value, rtol=1e-5)


@pytest.mark.parametrize("case", ["P1", "P2"])
def test_motion_and_energy(cases, histories, case):
    run = histories[case]
    angle, rate, energy = (REFERENCE[name][case] for name in ("crank_angle", "crank_rate", "energy"))
    at = [int(np.argmin(np.abs(run["time_s"] - float(time)))) for time in angle]
    np.testing.assert_allclose(run["angle_rad"][at] + np.pi / 2, list(angle.values()), rtol=0, atol=3e-4)
    np.testing.assert_allclose(run["rate_rad_s"][at], list(rate.values()), rtol=0, atol=5e-3)
    np.testing.assert_allclose(run["total_J"][at], list(energy.values()), rtol=2e-5)
    np.testing.assert_allclose(cases[case]["driven_joint"]["angle_end"], run["angle_rad"][-1])


def test_end_angle_of_the_perfect_case(cases):
    end = REFERENCE["crank_angle"]["P1"]["0.5"] - np.pi / 2
    np.testing.assert_allclose(cases["P1"]["driven_joint"]["angle_end"], end, rtol=0, atol=1e-5)


def test_balances(cases, histories):
    for name, case in cases.items():
        assert case["energy_balance_error"] < 2e-6
        assert case["closure_drift"] < 1e-9
        assert case["closure_drift_angle"] < 1e-9
        assert case["momentum_balance_error"] < 1e-8
        assert case["stabilisation_share"] < 1e-6
        # Hinges carry no moment about themselves; the drive's is not theirs.
        assert max(np.abs(histories[name][f"{joint}_moment_y_Nm"]).max() for joint in JOINTS) < 1e-8


def test_conclusions_of_the_paper_on_the_substitute_data(cases):
    for quantity in ("rms_force", "rms_moment", "max_axial_force"):
        largest = {name: max(by_joint(case, quantity)) for name, case in cases.items()}
        assert max(largest, key=largest.get) == "P5"
    # Tilts matter more than the shift, and P2 and P5 are largest in joint A.
    in_a = {name: case["joints"]["A"]["rms_force"] for name, case in cases.items()}
    assert in_a["P5"] > in_a["P2"] > in_a["P3"] > in_a["P4"] > in_a["P1"]
    moments = {joint: loads["rms_moment"] for joint, loads in cases["P5"]["joints"].items()}
    assert min(moments["A"], moments["D"]) > max(moments["B"], moments["C"])


def test_forces_in_the_plane_follow_the_moment(histories):
    """The time at which the moment ends is the end of a step, and saved."""
    run = histories["P1"]
    assert np.any(np.abs(run["time_s"] - 0.1) < 1e-12)
    assert run["drive_moment_Nm"][run["time_s"] > 0.1 + 1e-9].max() == 0.0
    np.testing.assert_allclose(run["drive_moment_Nm"][100], 1.5, rtol=1e-12)
