"""The programs in `studies`, on small inputs: they run, write what they promise, and their numbers are plausible."""

import csv
import json

import numpy as np
import pytest

pytestmark = pytest.mark.slow


def table(path):
    with open(path, newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def column(rows, name):
    return np.array([float(row[name]) for row in rows])


@pytest.mark.long
def test_assembly_preload(run_program, tmp_path):
    said = run_program("studies/assembly_preload/study.py", "--quick", "--out", tmp_path)
    assert "Tables and pictures are in" in said
    pictures = {"errors_of_joint_D", "moments_by_error", "largest_preload", "drive_moment"}
    assert {path.stem for path in tmp_path.glob("*.png")} == pictures
    assert json.loads((tmp_path / "results.json").read_text())["angles"] == 8
    # One force along the hinges of all joints; in-plane errors stress nothing.
    peaks = {row["error"]: row for row in table(tmp_path / "peaks.csv")}
    assert len(peaks) == 54
    tilt = [float(peaks["D.delta_x"][f"{joint}_force_N"]) for joint in "ABCD"]
    np.testing.assert_allclose(tilt, tilt[0], rtol=1e-2)
    assert tilt[0] > 50.0 and float(peaks["D.d_x"]["A_force_N"]) < 0.1
    # A unit error and the derivative agree; the moment that holds the crank is the derivative of the energy.
    assert column(table(tmp_path / "linearity.csv"), "relative_deviation_of_force").max() < 0.05
    drive = [row for row in table(tmp_path / "drive.csv") if row["case"] == "perfect"]
    np.testing.assert_allclose(column(drive, "moment_Nm"), column(drive, "derivative_of_energy_Nm"), atol=0.02)


@pytest.mark.long
def test_bearing_stiffness(run_program, tmp_path):
    said = run_program("studies/bearing_stiffness/study.py", "--quick", "--out", tmp_path)
    assert "Distance from ideal joints" in said
    assert {path.stem for path in tmp_path.glob("*.png")} == {"preload_over_stiffness", "stiffness_that_counts"}
    sweep = table(tmp_path / "sweep.csv")
    columns = [name for name in sweep[0] if name.endswith(("_N", "_Nm"))]
    loads = {
        links: np.stack([column([row for row in sweep if row["links"] == links], name) for name in columns], axis=1)
        for links in ("rigid", "flexible")
    }
    stiffness = column([row for row in sweep if row["links"] == "rigid"], "radial_N_per_m")
    assert len(columns) == 8 and len(stiffness) == 6 and stiffness[-1] / stiffness[0] == pytest.approx(1e6)
    # Rigid links: in proportion to the stiffness, without a limit.
    np.testing.assert_allclose(loads["rigid"] / stiffness[:, None], loads["rigid"][1:2] / 1e8 * np.ones((6, 1)), 1e-8)
    assert (loads["rigid"][1] > 0.1).all()
    # Flexible links: as much as rigid ones on soft bearings; near ideal joints the rest is of first order in 1/k.
    (limit,) = table(tmp_path / "ideal.csv")
    ideal = np.array([float(limit[name]) for name in columns])
    assert (loads["flexible"][0] > 0.8 * loads["rigid"][0]).all()
    assert (np.diff(loads["flexible"], axis=0) > 0.0).all()
    off = (1.0 - loads["flexible"] / ideal)[3:]
    assert (off[0] > 1e-3).all()
    np.testing.assert_allclose(off[:-1] / off[1:], 10.0, rtol=0.02)
    # All stiffnesses together: the loads of rigid links are of degree one in them, those of flexible links of less.
    directions = table(tmp_path / "directions.csv")
    for links, low, high in (("rigid", 1.0 - 1e-6, 1.0 + 1e-6), ("flexible", 0.1, 0.9)):
        own = [row for row in directions if row["links"] == links]
        sums = np.array([column(own, f"{joint}_{load}").sum() for joint in "ABCD" for load in ("force", "moment")])
        assert len(own) == 12 and (low < sums).all() and (sums < high).all()


@pytest.mark.long
def test_clearance_in_motion(run_program, tmp_path):
    said = run_program("studies/clearance/motion.py", "--quick", "--out", tmp_path)
    assert "The 95 % RMS force of D is least" in said
    assert {path.stem for path in tmp_path.glob("*.png")} == {"motion_over_clearance"}
    rows = table(tmp_path / "motion.csv")
    assert column(rows, "failed").tolist() == [0, 0] and column(rows, "radial_um").tolist() == [0.0, 100.0]
    # Without play the pin stays pressed by the misalignment; with play it strikes, and no moment is left.
    tight, loose = (dict(row) for row in rows)
    assert float(loose["mean_contact_changes"]) > 10.0 * float(tight["mean_contact_changes"])
    assert float(loose["95_percent_largest_force_N"]) > float(tight["95_percent_largest_force_N"])
    assert float(loose["mean_rms_moment_Nm"]) < 0.2 * float(tight["mean_rms_moment_Nm"])
    assert column(rows, "largest_energy_balance_error").max() < 0.01


def test_clearance(run_program, tmp_path):
    said = run_program("studies/clearance/study.py", "--quick", "--out", tmp_path)
    assert "The largest clearance takes from the 95 % force" in said
    assert {path.stem for path in tmp_path.glob("*.png")} == {"loads_over_clearance", "scatter_over_clearance"}
    sweep, batch = table(tmp_path / "sweep.csv"), table(tmp_path / "batch.csv")
    clearances = column(sweep, "radial_um")
    assert clearances.tolist() == [0.0, 40.0, 80.0, 120.0]
    # Play takes from every load until the weight is left, which D and A carry together.
    for joint in "ABCD":
        moment = column(sweep, f"{joint}_moment_Nm")
        assert (np.diff(moment) < 0.0).all() and moment[-1] < 0.05 * moment[0]
    weight = column(sweep, "D_force_N")[-1]
    assert weight < 0.1 * column(sweep, "D_force_N")[0]
    np.testing.assert_allclose(column(batch, "D_force_mean_N")[-1], weight, rtol=1e-2)
    # The derivative by the clearance is what the next row has.
    slope = column(sweep, "D_moment_by_radial_Nm_per_um")
    np.testing.assert_allclose(0.5 * (slope[0] + slope[1]) * 40.0, np.diff(column(sweep, "D_moment_Nm"))[0], rtol=1e-2)
    assert column(batch, "failed").sum() == 0 and column(batch, "samples").tolist() == [16] * 4
    shares = np.array([column(batch, f"share_{ends}_ends") for ends in range(3)])
    np.testing.assert_allclose(shares.sum(axis=0), 1.0)
    assert shares[2, 0] == 1.0 and (np.diff(shares[2]) <= 0.0).all() and shares[2, -1] < 1.0
    assert (column(batch, "D_force_95_percent_N") >= column(batch, "D_force_mean_N")).all()
    close, loose = table(tmp_path / "fits.csv")
    assert (close["fit"], float(close["smallest_radial_um"])) == ("20 H7/f7", pytest.approx(10.0))
    taken = [float(row[f"D_{end}_takes"]) for row in (close, loose) for end in ("smallest", "largest")]
    assert 0.0 < taken[0] < taken[1] < taken[2] < taken[3] < 1.0
    force = column(batch, "D_force_95_percent_N")
    assert taken[0] == pytest.approx(0.25 * (force[0] - force[1]) / (force[0] - force[3]))


@pytest.mark.long
def test_robust_four_bar(run_program, tmp_path):
    """Every way is answered, and its price is that of its mass and its tolerances. The step of the trial is too long
    for some of the fresh mechanisms."""
    said = run_program("studies/robust_four_bar/study.py", "--quick", "--reserves", 1.5, "--out", tmp_path)
    assert "Tables and a picture are in" in said
    assert {path.name for path in tmp_path.iterdir()} == {"comparison.csv", "results.json", "cost_of_every_way.png"}
    rows = {row["way"]: row for row in table(tmp_path / "comparison.csv")}
    assert list(rows) == ["together", "as drawn", "two stages, reserve 1.5"]
    for row in rows.values():
        objective, mass, cost = (float(row[name]) for name in ("objective", "mass_kg", "cost"))
        assert objective == pytest.approx(10.0 * mass + cost, rel=1e-9)
        assert int(row["failed"]) < int(row["samples"]) and float(row["largest_A.mean_square_moment"]) > 0.0
    assert float(rows["as drawn"]["rocker_bar.height_m"]) == pytest.approx(0.01, rel=1e-8)


QUESTIONS = ("rfes", "steps", "elements", "crank", "damping")


@pytest.mark.long
@pytest.mark.parametrize("question", QUESTIONS)
def test_convergence(run_program, tmp_path, question):
    said = run_program("studies/convergence/study.py", "--quick", "--questions", question, "--out", tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {f"{question}.csv", f"{question}.png", "results.json"}
    assert "A trial" in json.loads((tmp_path / "results.json").read_text())["note"]
    assert f"are in {tmp_path}" in said
    CHECKS[question](table(tmp_path / f"{question}.csv"))


def check_rfes(rows):
    """Two numbers of sdes: the finer one is four times as near to the extrapolated value."""
    own = [row for row in rows if (row["case"], row["metric"]) == ("P2", "rms_force")]
    coarse, fine = column(own, "largest_relative_error")
    assert 0.01 < fine < 0.1
    np.testing.assert_allclose(coarse / fine, 4.0, rtol=0.1)


def check_steps(rows):
    assert {row["status"] for row in rows} == {"ok"}
    errors = [row["largest_relative_error"] for row in rows if row["metric"] == "rms_force"]
    assert sorted(float(error) for error in errors if error)[-1] < 1e-2 and "" in errors


def check_elements(rows):
    """Linear and geometrically exact elements differ by less than a thousandth in preload forces, but do differ."""
    own = [row for row in rows if (row["case"], row["metric"]) == ("P2", "preload_force")]
    difference = np.abs(column(own, "relative_difference"))
    assert 1e-6 < difference.max() < 1e-3


def check_crank(rows):
    """A flexible crank takes half of the preload."""
    own = [row for row in rows if (row["case"], row["metric"]) == ("P2", "preload_force")]
    np.testing.assert_allclose(column(own, "relative_difference"), -0.52, atol=0.05)


def check_damping(rows):
    assert {float(row["damping_s"]) for row in rows} == {0.0, 1e-5}
    forces = [row for row in rows if row["load"] == "force"]
    # The preload dominates: mean squares grow with the square of the tilt of 0.5 deg.
    expected = 2.0 * column(forces, "rms") ** 2 / 0.5
    np.testing.assert_allclose(column(forces, "derivative_of_square"), expected, rtol=0.2)


CHECKS = {name: globals()[f"check_{name}"] for name in QUESTIONS}
