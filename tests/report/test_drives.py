"""Reports of several drives, and of one on a translation: by the names of their joints."""

import json
from types import SimpleNamespace

import numpy as np
import pytest

from rfem_jax import load_study
from rfem_jax.report.contents.driven_motions_report import drive_quantities, has_driven_joint
from rfem_jax.report.contents.files import history_columns, write_results
from rfem_jax.report.contents.overview import _drives_text, joint_rows
from rfem_jax.report.contents.summary import _driven_joints, summarise
from rfem_jax.report.contents.tables import driven_joint_table
from tests.description.test_several_drives import MOMENT, PUSH, SLIDER
from tests.report.conftest import STUDY

SEVERAL = """
[[drives]]
joint = "D"
kind = "prescribed_rate"
rate = 2.0
[[drives]]
joint = "A"
kind = "moment_ramp"
moment = 1.5
rise_time = 0.1
"""


@pytest.fixture
def several(tmp_path, runs):
    """Study and runs of a four-bar with two drives."""
    start, end = STUDY.index("[drive]"), STUDY.index("[simulation]")
    path = tmp_path / "study.toml"
    path.write_text(STUDY[:start] + SEVERAL + STUDY[end:], encoding="utf-8")
    for run in runs.values():
        times = run.times
        run.motion.drives = {
            "A": SimpleNamespace(position=run.motion.angle, rate=run.motion.rate, force=run.motion.drive_moment),
            "D": SimpleNamespace(position=2.0 * times, rate=2.0 + 0.0 * times, force=-3.0 * times),
        }
    return load_study(path), runs


def test_columns_of_each_drive(several):
    study, runs = several
    columns = history_columns(study, runs["P2"])
    assert "drive_moment_Nm" not in columns
    np.testing.assert_array_equal(columns["angle_rad"], 2.0 * runs["P2"].times)  # of D, the first drive
    assert "A_angle_rad" in columns and "D_angle_rad" not in columns
    own = [name for name in columns if "_drive_" in name]
    assert own == [f"{joint}_drive_{what}" for joint in "DA" for what in ("angle_rad", "rate_rad_s", "moment_Nm")]
    np.testing.assert_array_equal(columns["D_drive_moment_Nm"], -3.0 * runs["P2"].times)


def test_ends_in_summary_table_and_file(several, statuses, tmp_path):
    study, runs = several
    summaries = summarise(study, runs, statuses)
    assert summaries["P2"]["drives"]["D"] == {"angle_end": 1.0, "rate_end": 2.0, "moment_end": -1.5}
    table = driven_joint_table(study, summaries)
    assert table.startswith("Drives\n") and "D: angle at end, deg" in table and "57.29578" in table
    write_results(tmp_path / "results.json", study, summaries)
    written = json.loads((tmp_path / "results.json").read_text())
    assert written["drives"] == ["D", "A"] and written["driven_joint"] == "D", "the first one"
    case = written["cases"]["P2"]
    assert case["driven_joint"] == {"angle_end": 1.0, "rate_end": 2.0}
    assert [(one["joint"], one["motion"], one["rate_end"]) for one in case["driven_joints"]] == [
        ("D", "R_y", 2.0), ("A", "R_y", 20.0)
    ]  # fmt: skip
    assert written["units"]["moment_end"] == "N m"


def test_a_picture_of_position_rate_and_force(several, statuses):
    pytest.importorskip("matplotlib", reason="pictures need the extra `plots`")
    from rfem_jax.report.drawings.figures import _motion_figures

    figures = _motion_figures(*several)
    assert list(figures) == [f"{joint}_drive_{what}" for joint in "DA" for what in ("angle", "rate", "moment")]
    axes = figures["D_drive_moment"].axes[0]
    assert axes.get_ylabel() == "drive moment, N m"
    np.testing.assert_allclose(axes.lines[0].get_ydata()[-1], -1.5)


def test_the_overview_names_all_drives(several):
    study, _ = several
    assert [row[0] for row in joint_rows(study) if "driven" in row[-1]] == ["A", "D"]
    assert _drives_text(study) == (
        "Drive: prescribed rate on joint D (SI: rate 2, rise time 0).\n"
        "Drive: moment ramp on joint A (SI: moment 1.5, rise time 0.1).\n"
    )


def test_a_driven_slide_ends_at_a_position(tmp_path):
    path = tmp_path / "study.toml"
    path.write_text(SLIDER + PUSH, encoding="utf-8")
    drive = SimpleNamespace(position=np.array([0.0, 0.3]), rate=np.array([0.0, 4.0]), force=np.zeros(2))
    driven = _driven_joints(load_study(path), SimpleNamespace(motion=SimpleNamespace(drives={"C.T_y": drive})))
    assert driven == [{"joint": "C", "motion": "T_y", "position_end": 0.3, "speed_end": 4.0}]


def test_translations_have_their_units(tmp_path):
    path = tmp_path / "study.toml"
    path.write_text(SLIDER + PUSH, encoding="utf-8")
    study = load_study(path)
    assert not has_driven_joint(study)
    assert [(one.name, one.quantity.unit) for one in drive_quantities(study)] == [
        ("C_T_y_drive_displacement", "m"), ("C_T_y_drive_speed", "m/s"), ("C_T_y_drive_force", "N")
    ]  # fmt: skip
    assert _drives_text(study).startswith("Drive: force ramp on joint C, T_y (SI: force 5")
    path.write_text(SLIDER + MOMENT, encoding="utf-8")
    assert has_driven_joint(load_study(path)) and drive_quantities(load_study(path)) == []
