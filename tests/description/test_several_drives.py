"""Drives of translations, and several drives in one study."""

import jax
import numpy as np
import pytest

from rfem_jax import (
    ForceFunction,
    ForceRamp,
    ForceTable,
    MomentRamp,
    MomentTable,
    PrescribedDisplacements,
    PrescribedRate,
    PrescribedRunUp,
    PrescribedSpeed,
    PrescribedSpinUp,
    PrescribedTable,
    load_study,
)
from rfem_jax.description.drives.driven_motions import all_breakpoints, each_drive, own_breakpoints
from tests.study_texts import STEEL, hinge, link, rectangle

PAIRS = [  # of a rotation and of a translation: the same law
    (MomentRamp("A", 1.5, 0.1), ForceRamp("G", "1.5 N", 0.1)),
    (MomentTable("A", [0, 0.2, 0.2, 0.4], [1, 2, -1, 0]), ForceTable("G", [0, 0.2, 0.2, 0.4], ["1 N", 2, -1, 0])),
    (PrescribedRate("A", 0.2, 0.3), PrescribedSpeed("G", "0.2 m/s", 0.3)),
    (PrescribedSpinUp("A", 0.2, 0.3), PrescribedRunUp("G", "200 mm/s", 0.3)),
    (PrescribedTable("A", [0, 1, 2], [0, 0.3, 0.1]), PrescribedDisplacements("G", [0, 1, 2], [0, "30 cm", 0.1])),
]

SLIDER = f"""{STEEL}{rectangle()}{link("arm", 0.1)}{link("hand", 0.1)}{hinge("arm")}[[mechanism.joints]]
name = "C"
kind = "cylindrical"
parent = "arm"
child = "hand"
[simulation]
duration = 0.5
step = 1e-4
"""
PUSH = '[[drives]]\njoint = "C"\nmotion = "T_y"\nkind = "force_ramp"\nforce = "5 N"\nrise_time = 0.1\n'
ROTATION = '[[drives]]\njoint = "C"\nmotion = "R_y"\nkind = "prescribed_rate"\nrate = "60 rpm"\n'
MOMENT = '[[drives]]\njoint = "A"\nkind = "moment_ramp"\nmoment = 1\nrise_time = 0.2\n'


@pytest.fixture
def load(tmp_path):
    """Load the study with drives."""

    def load_text(drives):
        path = tmp_path / "study.toml"
        path.write_text(SLIDER + drives, encoding="utf-8")
        return load_study(path)

    return load_text


@pytest.mark.parametrize(("about", "along"), PAIRS, ids=lambda drive: type(drive).__name__)
def test_laws_of_translations_are_those_of_rotations(about, along):
    assert (about.rotation, along.rotation) == (True, False)
    assert about.breakpoints() == along.breakpoints()
    for t in (0.0, 0.07, 0.2, 0.35):
        phase = sum(t > end for end in about.breakpoints())
        both = [
            one.force_at(t, phase) if hasattr(one, "force_at") else one.motion_at(t, phase) for one in (about, along)
        ]
        np.testing.assert_array_equal(*both)


def test_phases_of_several_drives():
    first, second = MomentRamp("A", 1.0, 0.3), ForceTable("G", [0, 0.1, 0.1, 0.1 + 0.2], [1.0, 1.0, 0.0, 0.0])
    # 0.1 + 0.2 is 0.3 up to rounding: one jump.
    drives = [first, second, PrescribedRate("B", 1.0)]
    assert all_breakpoints(drives) == pytest.approx((0.1, 0.3), rel=1e-12)
    assert [own_breakpoints(one, (0.1, 0.3)) for one in drives] == [(1,), (0, 1), ()]
    assert each_drive(None) == () and each_drive(first) == (first,)


def test_a_study_file_with_several_drives(load):
    study = load(PUSH + MOMENT + ROTATION)
    assert study.drive_labels == ("C.T_y", "A", "C.R_y")
    # Prescribed motions are held first.
    assert study.mechanism.driven_joint == ("C.R_y", "C.T_y", "A")
    assert study.drive_jumps == (0.1, 0.2)
    assert study.drives[0].force == 5.0 and float(study.drives[2].rate) == pytest.approx(2.0 * np.pi)
    beside = load(MOMENT.replace("[[drives]]", "[drive]") + PUSH + ROTATION)
    assert beside.drive_labels == ("A", "C.T_y", "C.R_y"), "that of [drive] is the first"
    alone = load(PUSH)
    assert isinstance(alone.drive, ForceRamp) and alone.mechanism.driven_joint == "C.T_y"


@pytest.mark.parametrize(
    ("drives", "pieces"),
    [
        (PUSH.replace("5 N", "5 N m"), ("[[drives]] number 1", "`force`", "a force (N)")),
        (PUSH.replace('"T_y"', '"R_y"'), ("motion R_y of joint `C`", "ForceRamp is of forces", "MomentRamp")),
        (MOMENT.replace('"A"', '"C"\nmotion = "T_y"'), ("T_y", "MomentRamp is of moments", "ForceRamp")),
        (PUSH.replace('motion = "T_y"\n', ""), ("`motion` of the drive on `C`", "cylindrical", '"R_y", "T_y"')),
        (PUSH.replace('"T_y"', '"T_q"'), ("`motion` of the drive", "T_q")),
        (PUSH + "moment = 1\n", ('number 1 of kind "force_ramp"', "`moment`")),
        (PUSH + PUSH, ("each motion once", "T_y of joint `C` twice")),
        (MOMENT.replace("[[drives]]", "[drive]") + MOMENT, ("each motion once", "R_y of joint `A` twice")),
        ("[drives]\n" + PUSH.partition("\n")[2], ("[[drives]]", "must be a list of tables")),
        (
            '[[drives]]\njoint = "A"\nkind = "prescribed_table"\ntimes = [0, 0.1]\nangles = [0, 1]\n' + PUSH,
            ("`times` of the drive", "reach the duration"),
        ),
    ],
)
def test_wrong_drives_are_refused(load, refused, drives, pieces):
    with refused(*pieces):
        load(drives)


@pytest.mark.parametrize(
    ("build", "pieces"),
    [
        (lambda: ForceRamp("G", "1 N m", 0.1), ("`force`", "a moment")),
        (lambda: ForceTable("G", [0, 1], [1, "1 deg"]), ("`forces` (entry 2)", "an angle")),
        (lambda: ForceFunction("G", lambda t, phase: 1.5), ("`function`", "scalar")),
        (lambda: PrescribedSpeed("G", "60 rpm"), ("`speed`", "a rate")),
        (lambda: PrescribedRunUp("G", 0.1, 0.0), ("`rise_time`", "greater than 0")),
        (lambda: PrescribedDisplacements("G", [0, 1], [0.1, 1]), ("`displacements`", "changes of the displacement")),
        (lambda: PrescribedSpeed("G", 0.1, motion=3), ("`motion` of the drive", "3")),
        (lambda: each_drive([PrescribedSpeed("G", 0.1), 3.0]), ("`drive`", "a list of drives", "3.0")),
    ],
)
def test_wrong_arguments_are_refused(refused, build, pieces):
    with refused(*pieces):
        build()


def test_speeds_and_forces_are_differentiable():
    for make in (
        lambda x: ForceRamp("G", x, 0.1).force_at(0.05, 0),
        lambda x: PrescribedSpeed("G", x).motion_at(0.5, 0)[0],
    ):
        assert float(jax.grad(make)(3.0)) == pytest.approx(0.5)
