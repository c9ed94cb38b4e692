"""Clearance in joints: what it frees, its parameters, what is refused."""

import dataclasses

import pytest

from rfem_jax import (
    Clearance,
    Compliance,
    Joint,
    JointFriction,
    Link,
    Mechanism,
    RigidBody,
    assemble,
    assembly_errors,
    describe,
    discretise,
    load_study,
    parameters,
)
from rfem_jax.description.tolerances.tolerances import SpecifiedTolerance
from rfem_jax.report.contents.overview import _clearance_text, joint_rows

from .test_study_files import FULL

PLAY = Clearance(radial=1e-4, length=0.02, stiffness=5e7, exponent=1, axial_stiffness=2e7)
BODY = Link("body", 0.1, body=RigidBody(2.0, (0.0, 0.0, 0.0), (0.01, 0.01, 0.01)))


def hung(clearance):
    return discretise(Mechanism([BODY], [Joint("D", "base", "body", clearance=clearance)], driven_joint="D"))


CLEARANCE = """clearance = { radial = "0.05 mm", length = "20 mm", stiffness = "60 kN/mm^1.5", restitution = 0.9 }
"""


def test_in_a_study_file(tmp_path, refused):
    path = tmp_path / "study.toml"
    path.write_text(FULL.replace('name = "D"\n', f'name = "D"\n{CLEARANCE}', 1), encoding="utf-8")
    study = load_study(path)
    clearance = study.mechanism.joint("D").clearance
    assert (clearance.radial, clearance.length, clearance.restitution) == (5e-5, 0.02, 0.9)
    text = _clearance_text(study.mechanism)
    assert "Joint D has clearance, pin on its child: radial 0.05 mm, axial 0 mm, length 20 mm" in text
    assert "N/m^1.5, restitution 0.9." in text
    assert any(row[0] == "D" and "clearance" in row[-1] for row in joint_rows(study))
    path.write_text(
        FULL.replace('name = "D"\n', 'name = "D"\nclearance = { radal = 1, length = 1, stiffness = 1 }\n', 1),
        encoding="utf-8",
    )
    with refused("clearance must have known keys only, but has `radal`", "radial"):
        load_study(path)


def test_a_fit_is_the_middle_of_its_clearances_and_scatters_about_it(tmp_path, refused):
    """20 H7/f7: the hole from 0 to 21 um, the pin from -41 to -20 um, the diametral clearance from 20 to 62 um."""
    path = tmp_path / "study.toml"
    play = CLEARANCE.replace('"0.05 mm"', '"20 H7/f7"')
    text = FULL.replace('name = "D"\n', f'name = "D"\n{play}', 1)
    scatter = '[tolerances]\n"D.clearance.radial" = { iso = "20 H7/f7" }\n'
    path.write_text(text.partition("[tolerances]")[0] + scatter, encoding="utf-8")
    study = load_study(path)
    assert study.mechanism.joint("D").clearance.radial == pytest.approx(20.5e-6)
    assert study.tolerances.half_widths() == {"D.clearance.radial": pytest.approx(10.5e-6)}
    with refused("`radial` must have a clearance in every pair", "'20 H7/p6' interferes by up to 35 um"):
        dataclasses.replace(PLAY, radial="20 H7/p6")
    with refused("`iso` of the tolerance `D.d_x` must be one size", "'20 H7/f7' is a fit"):
        SpecifiedTolerance("D.d_x", iso="20 H7/f7")


class TestDescription:
    def test_a_joint_with_play_is_free_but_for_its_contacts(self):
        model, of_hertz = hung(PLAY), hung(dataclasses.replace(PLAY, stiffness="60 kN/mm^1.5", exponent=1.5))
        assert describe(model).mobility == 6 and describe(model).rigid_mobility == 1
        numbers = parameters(model)
        assert numbers["D.clearance.radial"].value == 1e-4
        assert numbers["D.clearance.stiffness"].unit == "N/m"
        assert parameters(of_hertz)["D.clearance.stiffness"].unit == "N/m^1.5"
        assert parameters(of_hertz)["D.clearance.stiffness"].value == pytest.approx(6e4 * 1e3**1.5)

    @pytest.mark.parametrize(
        ("settings", "pieces"),
        [
            ({"radial": -1e-6}, ("`radial`", "negative")),
            ({"length": 0.0}, ("`length`", "greater than 0")),
            ({"exponent": 0.5}, ("`exponent`", "from 1 to 3")),
            ({"stiffness": "5 N"}, ("`stiffness`", "N/m")),
            ({"axial_exponent": 1.5, "axial_stiffness": None}, ("`axial_stiffness`", "given")),
            ({"damping": 0.1, "restitution": 0.5}, ("`restitution`", "left out")),
            ({"restitution": 1.2}, ("`restitution`", "at most 1")),
            ({"friction": 0.1}, ("`diameter`", "given")),
            ({"sliding_speed": 0.1}, ("`sliding_speed`", "left out")),
            ({"pin": "bush"}, ("`pin`", "child")),
            ({"centring": 0.0}, ("`centring`", "greater than 0")),
        ],
    )
    def test_what_cannot_be_is_refused(self, settings, pieces, refused):
        with refused(*pieces):
            dataclasses.replace(PLAY, **settings)

    def test_of_joints(self, refused):
        with refused("`clearance`", "prismatic"):
            Joint("G", "base", "body", kind="prismatic", clearance=PLAY)
        with refused("`clearance`", "compliance"):
            Joint("G", "base", "body", compliance=Compliance(radial=1e7), clearance=PLAY)
        with refused("`clearance`", "Clearance("):
            Joint("G", "base", "body", clearance=1e-4)
        friction = JointFriction("rub", "D", constant=0.1, sliding_rate=0.1)
        with refused("`friction`", "clearance"):
            Mechanism([BODY], [Joint("D", "base", "body", clearance=PLAY)], forces=[friction])
        with refused("`hold`"):
            model = hung(PLAY)
            assemble(model, assembly_errors(model), {"E": 0.0})
