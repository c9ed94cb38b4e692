"""Tables of the terminal: alignment, numbers, names and units, what is said about failures."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np

from rfem_jax import JointForceTable, JointSpring
from rfem_jax.mechanics.model.discretisation import StartHeld
from rfem_jax.report.contents.overview import format_error, section_text, start_text, study_text
from rfem_jax.report.contents.summary import summarise
from rfem_jax.report.contents.tables import format_numbers, format_table, results_text

from .conftest import START

COUNTS = {"coordinates": 51, "constraints": 5, "rank": 5, "mobility": 46, "rigid_mobility": 1, "gap": 0.0}


def test_columns_are_aligned():
    text = format_table(["case", "A"], [["P1", "1.0"], ["long name", "10.0"]])
    assert text.splitlines() == [
        "case          A",
        "---------------",
        "P1          1.0",
        "long name  10.0",
    ]


def test_numbers_share_their_decimals():
    assert format_numbers([41.46875, 1.0, 0.0]) == ["41.4688", "1.0000", "0.0000"]
    assert format_numbers([float("nan"), 2.0]) == ["-", "2.00000"]
    assert format_numbers([0.0, 0.0]) == ["0.000000", "0.000000"]


def test_small_numbers_are_not_shown_as_zero_but_rounding_is():
    assert format_numbers([1000.0, 1e-4]) == ["1000.00", "1.0e-04"]
    assert format_numbers([1000.0, -1e-12]) == ["1000.00", "0.00"]
    assert format_numbers([2.5e-9, 1e-9]) == ["2.50e-09", "1.00e-09"]


def test_results_name_every_metric_with_its_unit(study, runs, statuses):
    text = results_text(study, summarise(study, runs, statuses))
    for heading in (
        "RMS resultant force, N",
        "RMS resultant moment, N m",
        "Maximum axial force, N",
        "Maximum normal force, N",
        "Angle at end, deg",
        "Rate at end, rad/s",
        "Drift, m",
    ):
        assert heading in text
    block = text.split("RMS resultant force, N")[1].splitlines()
    assert block[1].split() == ["case", "A", "B", "D", "C"]
    assert block[4].split() == ["P2", "2.00000", "4.00000", "6.00000", "8.00000"]
    assert max(map(len, text.splitlines())) <= 100


def test_loads_at_rest_come_first(study, runs, statuses):
    """Of the first saved time, at which this run begins: sizes of (1, 2, 3) times the run's, and one more per joint."""
    summaries = summarise(study, runs, statuses)
    text = results_text(study, summaries)
    assert text.index("Resultant force at rest, N") < text.index("Resultant moment at rest, N m") < text.index("RMS")
    block = text.split("Resultant force at rest, N")[1].splitlines()
    assert block[1].split() == ["case", "A", "B", "D", "C"]
    wanted = [np.linalg.norm(np.array([2.0, 4.0, 6.0]) + number) for number in range(4)]
    np.testing.assert_allclose([float(x) for x in block[4].split()[1:]], wanted, atol=1e-4)
    for summary in summaries.values():  # of a run that begins in motion nothing is known at rest
        for row in summary["joints"].values():
            row["preload_force"] = row["preload_moment"] = [np.nan] * 3
    assert "at rest" not in results_text(study, summaries)


def test_the_driven_angle_is_in_degrees(study, runs, statuses):
    block = results_text(study, summarise(study, runs, statuses)).split("Driven joint A\n")[1].splitlines()
    assert "Angle at end, deg  Rate at end, rad/s" in block[0]
    angles = [float(line.split()[2]) for line in block[2:5]]
    np.testing.assert_allclose(angles, np.degrees([8.5, 8.51, 8.505]), rtol=1e-7)


def test_many_joints_are_broken_into_blocks(study, runs, statuses):
    summaries = summarise(study, runs, statuses)
    names = [f"J{number}" for number in range(11)]
    row = summaries["P1"]["joints"]["A"]
    for summary in summaries.values():
        summary["joints"] = dict.fromkeys(names, row)
    joints = tuple(SimpleNamespace(name=name) for name in names)
    object.__setattr__(study.mechanism, "joints", joints)
    object.__setattr__(study, "drive", None)
    text = results_text(study, summaries)
    assert "J10" in text
    assert max(map(len, text.splitlines())) <= 100


def test_a_failed_case_says_why(study, runs, statuses):
    statuses["P2"] = ("diverged", "The run diverged at 0.2 s; reduce the step.")
    text = results_text(study, summarise(study, runs, statuses))
    assert "* Case P2: The run diverged at 0.2 s; reduce the step." in text
    assert "Case P1" not in text
    rows = [line.split() for line in text.splitlines()]
    named = [row[0] for row in rows if row and row[0].startswith("P2")]
    assert len(named) > 5 and set(named) == {"P2*"}  # wherever its numbers are
    assert not [row for row in rows if row and row[0] in ("P1*", "P3*")]


def test_a_remark_on_all_cases_is_shown_once(study, runs, statuses):
    summaries = summarise(study, runs, statuses)
    for case, one in summaries.items():
        one["remarks"] = ["Of all.", *(["Of one."] if case == "P2" else [])]
    text = results_text(study, summaries)
    assert text.count("Of all.") == 1 and "Case P2: Of one.\nOf all." in text


def test_the_note_of_a_study_is_shown(study, runs, statuses):
    object.__setattr__(study, "note", "A substitute for the lost data.")
    text = results_text(study, summarise(study, runs, statuses))
    assert "A substitute for the lost data." in text


def test_the_overview_says_what_was_understood(study):
    text = study_text(study, SimpleNamespace(**COUNTS, redundant=False, reactions="", idle=(), start=START))
    words = {line.split()[0]: line.split() for line in text.splitlines() if line}
    assert words["crank"][1:4] == ["0.12", "0.1884", "rigid"]
    # 0.3 m of steel, 10 mm x 20 mm, and a point mass of 0.1 kg.
    assert words["coupler"][1:5] == ["0.3", "0.571", "5", "1"]
    assert words["A"] == ["A", "revolute", "base", "crank", "-90", "deg", "driven"]
    assert words["C"] == ["C", "revolute", "coupler", "rocker", "-", "cut"]
    assert "Coordinates: 51; constraint equations at the cut joints: 5, of rank 5." in text
    assert "No redundant constraints" in text
    assert "moment ramp on joint A (SI: moment 1.5, rise time 0.1)" in text
    assert "rk4, step = 1e-05" in text
    assert "P2    D.delta_x = 0.5 deg" in text
    assert "P3    D.d_y = 0.5 mm; coupler.length = -0.1 mm" in text
    assert "P1    none" in text
    assert "\nForce" not in text


def test_the_overview_shows_forces(study):
    forces = [JointSpring("return", "A", "2 N m/deg", preload=-1), JointForceTable("cam", "B", [0, 1], [0, 3])]
    object.__setattr__(study, "mechanism", replace(study.mechanism, forces=forces))
    text = study_text(study, SimpleNamespace(**COUNTS, redundant=False, reactions="", idle=(), start=START))
    numbers = "stiffness 114.592, damping 0, rest 0, preload -1"
    assert f"Force return: joint spring on joint A, R_y (SI: {numbers}).\n" in text
    numbers = "2 rows, positions 0 to 1, forces 0 to 3"
    assert f"Force cam: joint force table on joint B, R_y (SI: {numbers}).\n" in text


def test_redundant_reactions_are_reported(study):
    text = study_text(study, SimpleNamespace(**COUNTS, redundant=True, reactions="", idle=(), start=START))
    assert "not unique" in text
    assert 'redundant_reactions = "minimum_norm"' in text
    object.__setattr__(study.mechanism, "redundant_reactions", "minimum_norm")
    text = study_text(study, SimpleNamespace(**COUNTS, redundant=True, reactions="", idle=(), start=START))
    assert "minimum norm" in text
    assert "force^2 + (moment / 0.3 m)^2 is least (the longest link; `reaction_length` sets another)." in text
    object.__setattr__(study.mechanism, "reaction_length", 0.05)
    text = study_text(study, SimpleNamespace(**COUNTS, redundant=True, reactions="", idle=(), start=START))
    assert "(moment / 0.05 m)^2 is least (as given)." in text and "are the least: force^2 + (moment / 0.05 m)^2" in text


def test_a_study_without_a_drive(study, runs, statuses):
    object.__setattr__(study, "drive", None)
    assert "Drive: none." in study_text(
        study, SimpleNamespace(**COUNTS, redundant=False, reactions="", idle=(), start=START)
    )
    assert "Angle at end" not in results_text(study, summarise(study, runs, statuses))


def test_errors_and_sections_in_the_units_of_people(study):
    assert format_error("D.delta_z", np.pi / 360.0, "rad") == "D.delta_z = 0.5 deg"
    assert format_error("coupler.length", 2.5e-4, "m") == "coupler.length = 0.25 mm"
    section = study.mechanism.links[0].section
    assert section_text(section) == "rectangle, width 10 mm, height 20 mm"


def test_the_start_is_said_in_a_sentence(study):
    said = {
        StartHeld(
            "as_given", ("A",), (), ()
        ): "Start: as given; held: A, by drives; flexible links settle, and no other freedom is left.",
        StartHeld("as_given", (), ("A",), ()): "Start: as given; A is held at the start value while flexible links "
        "settle, then released from rest.",
        StartHeld(
            "as_given", ("A",), ("B", "S.R_x"), ("B",)
        ): "Start: as given; held: A, by drives; B, S.R_x are held at "
        "the start value while flexible links settle, then released with the initial rates of B.",
        StartHeld("equilibrium", (), (), ()): "Start: static equilibrium of all that no drive holds.",
    }
    for start, sentence in said.items():
        assert start_text(start) == sentence
        assert sentence in " ".join(
            study_text(study, SimpleNamespace(**COUNTS, redundant=False, reactions="", idle=(), start=start)).split()
        )
