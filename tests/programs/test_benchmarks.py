"""The programs in `benchmarks`, on small inputs: they run, and measure what they say; their times are not looked at."""

import functools
import importlib.util
import json
import re
from pathlib import Path

import numpy as np
import pytest

from tests.programs.conftest import rows_of

without_peer = importlib.util.find_spec("exudyn") is None
pytestmark = [pytest.mark.slow, pytest.mark.skipif(without_peer, reason="needs the extra `bench`")]


@pytest.fixture(scope="module")
def run_program(run_program):
    """Benchmarks measure compiled programs."""
    return functools.partial(run_program, compiled=True)


def test_main_study(run_program):
    said = run_program("benchmarks/main_study.py", "--samples", 1, "--duration", 1e-4, "--rfes", 2, "--repeats", 1)
    assert re.search(r"^ +1( +\d+\.\d\d){6}$", said, re.M)
    assert re.search(r"recursive \d+ us, dense \d+ us", said)


def test_program_size(run_program):
    """The loop over steps is a kernel, of the explicit method a smaller one."""
    said = run_program("benchmarks/program_size.py", "--batch", 2)
    steps = [row for row in rows_of(said) if row[0] == "steps"]
    assert [row[1:3] for row in steps] == [["1", "2"]] * 2
    assert 1000 < int(steps[0][3]) < int(steps[1][3])
    assert len(re.findall(r"^traced in [\d.]+ s, by XLA compiled in [\d.]+ s, run [\d.]+ ms$", said, re.M)) == 2


def test_programs_of_a_command(run_program, pendulum_file, tmp_path):
    said = run_program("benchmarks/program_size.py", "--command", "run", pendulum_file, "--out", tmp_path)
    programs = {row[0]: row[1:] for row in rows_of(said)}
    assert {"prepare_batch", "advance", "conclude"} <= set(programs)
    kernels, operations, *seconds = programs["advance"]
    assert int(kernels) >= 1 and int(operations) > 100 and float(seconds[-1]) > 0.0
    assert re.search(r"^whole command [\d.]+ s, programs [\d.]+ s of it$", said, re.M)


def test_clearance(run_program):
    said = run_program("benchmarks/clearance.py", "--count", 3, "--repeats", 1)
    assert re.search(r"^\| [^|]+ (\| \d+\.\d+ ){4}\| 0 of 3 \| 9\.690190 \|$", said, re.M)


@pytest.mark.slow
def test_steps_that_follow_contact(run_program):
    said = run_program("benchmarks/contact_steps.py", "--rfes", 2, "--repeats", 1)
    for row, changes in (("ideal joint", "-"), ("play, steps that follow", r"\d+")):
        assert re.search(rf"^\| {row} \| \d+ \| \d+\.\d\d \| \d+\.\d{{3}} \| {changes} \| ok \|$", said, re.M), said


def test_cost_of_gradients(run_program, pendulum_file):
    said = run_program(
        "benchmarks/gradients.py", "--study", pendulum_file, "--rfes", 2, "--share", 0.01, "--parts", "cost",
        "--counts", 2, "--parameters", 4, "--batches", 1, "--repeats", 1, "--runs", 2,
    )  # fmt: skip
    rows = [f"{asked}, {mode}" for asked in ("2 errors", "4 parameters") for mode in ("forward", "reverse")]
    for method in ("generalised_alpha", "rk4"):
        for row in (f"{method}, batch 1, value", *(f"{method}, batch 1, {row}" for row in rows)):
            assert re.search(rf"^{row}( +\d+\.\d+){{4}}$", said, re.M), said


def test_accuracy_of_gradients(run_program, pendulum_file):
    """A tighter tolerance gives a derivative that is more accurate, by more Newton increments."""
    said = run_program(
        "benchmarks/gradients.py", "--study", pendulum_file, "--rfes", 2, "--share", 0.04, "--parts", "accuracy",
        "--steps", 2.5e-3, "--tolerances", 1e-2, 1e-6,
    )  # fmt: skip
    loose, tight = (line.split() for line in said.splitlines()[-2:])
    assert int(loose[2]) < int(tight[2])
    assert all(float(b) < 0.1 * float(a) for a, b in zip(loose[3:], tight[3:]))


@pytest.mark.parametrize("method", ["generalised_alpha", "rk4"])
def test_diffrax_loop(run_program, method):
    said = run_program("benchmarks/diffrax_loop.py", "--methods", method, "--batches", 1, "--steps", 5)
    rows = [line.strip("| ").split(" | ") for line in said.splitlines()[2:]]
    assert [row[0] for row in rows] == [f"{method}, {loop}" for loop in ("one kernel", "lax.scan", "diffeqsolve")]
    assert all(float(number) > 0.0 for row in rows for number in row[1:])


def test_first_answer(run_program, tmp_path):
    options = ("--only", "new_run", "--repeat", 1, "--no-exudyn", "--out", tmp_path)
    said = run_program("benchmarks/first_answer.py", *options)
    content = json.loads((tmp_path / "first_answer.json").read_text())
    assert [(row["program"], row["state"]) for row in content["times"]] == [("new_run", "cold"), ("new_run", "warm")]
    assert all(row["cpu"] > 0.0 and row["memory_mb"] > 10.0 for row in content["times"])
    assert content["table"] in said


def test_identification(run_program):
    said = run_program("benchmarks/identification.py", "--rfes", 2, "--duration", 0.05, "--repeat", 1, "--samples", 16)
    rows = {row[0]: row[1:] for row in rows_of(said)}
    assert set(rows) >= {"3 errors, 2 signals", "10 errors, 4 signals"}
    assert float(rows["3 errors, 2 signals"][1]) < float(rows["3 errors, 2 signals"][0])


def test_automatic_steps(run_program):
    said = run_program(
        "benchmarks/automatic_steps.py", "--accuracies", 1e-2, "--samples", 2, "--batches", 2, "--duration", 0.02,
        "--fine", 2e-4,
    )  # fmt: skip
    accuracy, step, errors, seldom, often, beside = map(str.strip, said.splitlines()[-1].strip("|").split("|"))
    assert accuracy == "0.01" and 0.1 < float(step) <= 20.0 and beside == "-"
    assert float(seldom) > 0.0 and float(often) > 0.0
    assert all(0.0 < float(error) < 1e-2 for error in errors.split(","))


def speed(run_program, folder, *arguments):
    return run_program("benchmarks/speed.py", "--trial", "--out", folder, "--parts", *arguments)


def test_speed_searches_settings(run_program, tmp_path):
    said = speed(run_program, tmp_path, "methods")
    assert re.search(r"Fastest within 0.01, status ok: generalised_alpha \S+ ms, tolerance 1e-08", said)


def test_speed_table(run_program, tmp_path):
    speed(run_program, tmp_path, "table")
    (row,) = json.loads((tmp_path / "speed.json").read_text())
    assert row["batch"] == 2 and row["error"] <= row["error_of_all"] < 1e-2 and row["memory_mb"] > 0.0


def test_speed_of_a_dense_right_hand_side(run_program, tmp_path):
    said = speed(run_program, tmp_path, "dense")
    recursive, dense = (float(re.search(rf"{name} +([\d.]+) us", said)[1]) for name in ("recursive", "naive dense"))
    assert recursive > 0.0 and dense > 0.0


def test_speed_on_two_devices(run_program, tmp_path):
    assert re.search(r"2 CPU: [\d.]+ [\d.]+ [\d.]+", speed(run_program, tmp_path, "devices"))


@pytest.mark.parametrize("sweep", ["rfes", "links", "batch", "errors"])
def test_speed_scaling(run_program, tmp_path, sweep):
    said = speed(run_program, tmp_path, "scaling", "--sweeps", sweep)
    assert (tmp_path / "scaling.png").stat().st_size > 1000
    curves = re.findall(r"^ +(\d+) +[\d.]+ +[\d.]+$", said, re.M)
    assert curves == {"rfes": ["2"], "links": ["3"], "batch": ["2"], "errors": ["1", "1"]}[sweep]


def test_speed_beside_exudyn(run_program, tmp_path):
    assert re.search(r"within 0.01: Exudyn [\d.]+ ms", speed(run_program, tmp_path, "peer"))


def agreements(path):
    return {entry["what"]: entry["met"] for entry in json.loads(path.read_text())["agreements"]}


@pytest.mark.parametrize("part", ["preload", "loads", "convergence", "open_chain"])
def test_agreement_with_exudyn(run_program, tmp_path, part):
    """Also with few steps, but for rates with the elements that are not exact."""
    file = tmp_path / "tables.json"
    run_program("benchmarks/against_exudyn.py", "--trial", "--parts", part, "--json", file)
    found = agreements(file)
    assert len(found) >= {"preload": 10, "loads": 5, "convergence": 1, "open_chain": 7}[part]
    assert [what for what, met in found.items() if not met] == []


def test_tilted_hinge_by_exudyn(run_program, tmp_path):
    """With steps ten times as long; their error is the one agreement that may fail."""
    file = tmp_path / "tables.json"
    said = run_program("benchmarks/against_exudyn.py", "--trial", "--parts", "tilted_hinge", "--json", file)
    assert [what for what, met in agreements(file).items() if not met and "halved" not in what] == []
    force = next(row for row in rows_of(said) if row[0] == "force A")
    assert float(force[1]) == pytest.approx(1.0197 * float(force[2]), rel=1e-3)


def test_studies_by_exudyn(run_program, tmp_path):
    """The slider-crank, with a few long steps and two rfes."""
    file = tmp_path / "tables.json"
    said = run_program("benchmarks/against_exudyn.py", "--trial", "--parts", "studies", "--json", file)
    found = agreements(file)
    assert len(found) == 5 and [what for what, met in found.items() if not met] == []
    timed = [row for row in rows_of(said) if row[0] == "slider_crank, guide_tilted"][1]
    assert all(float(number) > 0.0 for number in timed[1:])


def test_joints_with_clearance_by_exudyn_and_by_an_own_code(run_program, tmp_path):
    """The own code's contacts, the first contact by all programs, three short runs by two: all agree."""
    file = tmp_path / "tables.json"
    said = run_program("benchmarks/clearance_peers.py", "--trial", "--batch", 0, "--runs", 3, "--json", file)
    found = agreements(file)
    assert len(found) == 6 + 6 + 9 and [what for what, met in found.items() if not met] == []
    assert {row[1] for row in rows_of(said) if row[0].startswith("5000 rpm")} == {"own code", "Exudyn", "ours"}
    assert re.search(r"ours 0\.\d+ s, own code 0\.\d+ s", said)


def test_geared_five_bar_by_exudyn(run_program):
    said = run_program("benchmarks/exudyn_couplings.py")
    differences = [float(line.split()[-1]) for line in said.splitlines() if " at 0." in line]
    assert len(differences) == 24 and max(map(abs, differences)) < 5e-7


def test_curved_coupler_by_exudyn(run_program):
    """Straight pieces there and curved ones here have one limit, and ours are nearer to it."""
    said = run_program("benchmarks/exudyn_curved.py", "--quick")
    assert float(re.search(r"^limits differ by at most ([\d.]+) %$", said, re.M)[1]) < 0.02
    rows = [re.findall(r"(-?[\d.]+)%", line) for line in said.splitlines() if line.startswith(("force", "moment"))]
    assert len(rows) == 8 and all(0.0 < float(ours) < float(theirs) for theirs, _, ours, *_ in rows)


def test_measurements_by_exudyn(run_program, tmp_path):
    """With long steps and few elements: the table has the signals at their times, near those of the tests' file."""
    run_program("benchmarks/exudyn_measured.py", "--out", tmp_path / "new.csv", "--rfes", 5, "--step", 5e-4)
    new, kept = (
        np.genfromtxt(file, delimiter=",", names=True)
        for file in (tmp_path / "new.csv", Path(__file__).parents[1] / "tolerancing" / "measured_by_exudyn.csv")
    )
    for column in kept.dtype.names:
        np.testing.assert_allclose(new[column], kept[column], atol=0.3)


def test_time_of_exudyn(run_program):
    said = run_program("benchmarks/against_exudyn.py", "--trial", "--parts", "time")
    rows = rows_of(said)
    assert {"Lie-group nodes", "dense solver", "building and static start"} <= {row[0] for row in rows}


@pytest.mark.parametrize(("study", "samples"), [("run", 2), ("monte_carlo", 4)])
def test_first_answer_of_exudyn(run_program, study, samples):
    said = run_program("benchmarks/exudyn_first_answer.py", study, "--duration", 0.02, "--samples", samples)
    numbers = [float(x) for x in re.findall(r"\d+\.\d+", said)]
    assert said.startswith({"run": "P1", "monte_carlo": "mean"}[study])
    assert len(numbers) >= 8 and max(numbers) < 100.0


def test_page_frames_without_a_page(run_program, tmp_path):
    """With one it needs a browser: `tests/browser`."""
    assert "rfem-jax report" in run_program("benchmarks/page_frames.py", tmp_path, code=2)
