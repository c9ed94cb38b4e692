"""Couplings of two joint coordinates: what is described, what is refused, and in study files."""

import tomllib
from pathlib import Path

import numpy as np
import pytest

from rfem_jax import Compliance, Coupling, Joint, Link, Mechanism, Rectangle, load_study
from rfem_jax.description.parameters.parameters import parameters_of
from tests.mechanisms import STEEL

from .test_study_files import FULL

BAR = Rectangle(0.01, 0.01)

COUPLINGS = """
[[mechanism.couplings]]
name = "mesh"
joints = ["A", "B"]
ratio = -0.5
stiffness = "2 kN m/rad"
damping = "0.1 N m s/rad"
offset = "90 deg"
pitch_error = "0.1 deg"
eccentricity = "0.02 deg"
eccentricity_phase = "30 deg"
waves = 2
[[mechanism.couplings]]
name = "lift"
joints = ["A", "B"]
positions = [0, "90 deg", "180 deg", "360 deg"]
values = [0, "3 deg", "5 deg", 0]
periodic = true
stiffness = 30.0
exponent = 1.5
backlash = "0.1 deg"
contact_damping = "0.2 s/rad"
motions = ["R_y", "R_y"]
"""


def mechanism(*forces, **of_first):
    links = [Link(name, 0.1, BAR, STEEL, rigid=True) for name in "abcd"]
    joints = [
        Joint("A", "base", "a", **of_first),
        Joint("P", "a", "b", kind="prismatic"),
        Joint("C", "b", "c", kind="cylindrical"),
        Joint("S", "c", "d", kind="spherical"),
        Joint("F", "a", "c", kind="fixed", cut=True),
    ]
    return Mechanism(links, joints, forces=list(forces))


def coupling(joints=("A", "P"), **settings):
    return Coupling("k", joints, **({"ratio": 0.1, "stiffness": 1e4} | settings))


def test_units_follow_the_two_coordinates():
    made = mechanism(
        coupling(ratio="20 mm/rev", stiffness="3 kN/mm", damping="5 N s/m", eccentricity="10 um"),
        Coupling("screw", ("C", "C"), ratio="5 mm/rev", stiffness=1e6, motions=("R_y", "T_y")),
        Coupling("pinion", ("P", "A"), ratio="1 rad/mm", stiffness="2 N m/deg", backlash="1 deg"),
        Coupling("cam", ("A", "P"), positions=["0 deg", "90 deg", "180 deg"], values=[0, "5 mm", 0], stiffness=1e5),
    )
    rack, screw, pinion, cam = made.couplings
    np.testing.assert_allclose([rack.ratio, rack.stiffness, rack.eccentricity], [0.01 / np.pi, 3e6, 1e-5])
    np.testing.assert_allclose([screw.ratio, pinion.ratio, pinion.backlash], [5e-3 / (2 * np.pi), 1e3, np.pi / 180])
    np.testing.assert_allclose(pinion.stiffness, 360.0 / np.pi)
    np.testing.assert_allclose([*cam.positions, *cam.values], [0.0, np.pi / 2.0, np.pi, 0.0, 5e-3, 0.0])
    assert (rack.motions, screw.motions) == (("R_y", "T_x"), ("R_y", "T_y"))
    known = parameters_of(made)
    assert known["k.ratio"].unit == "m/rad" and known["k.eccentricity"].unit == "m"
    assert known["pinion.pitch_error"].unit == "m" and "pinion.eccentricity" not in known
    assert "cam.factor" in known and "cam.ratio" not in known


@pytest.mark.parametrize(
    "settings, pieces",
    [
        ({"joints": ("A", "B")}, ("`joints` of coupling `k`", "`B` is not a joint")),
        ({"joints": ("A", "F")}, ("joint of the tree", "`F` is cut", "cut another joint")),
        ({"joints": ("A", "A")}, ("`joints` of coupling `k`", "both are R_y of joint `A`")),
        ({"joints": ("A", "C")}, ("`motion` of coupling `k`", "cylindrical", '"R_y", "T_y"')),
        ({"joints": ("A", "S")}, ("`motion` of coupling `k`", "spherical", "not offered")),
        ({"ratio": "0.5 mm"}, ("`ratio` of coupling `k`", "a length per angle (m/rad)", "a length")),
        ({"joints": ("A", "C"), "motions": ("R_y", "R_y"), "ratio": "5 mm/rev"}, ("`ratio`", "a plain number")),
        ({"ratio": 0.0}, ("`ratio` of coupling `k`", "follows nothing")),
        ({"stiffness": 0.0}, ("`stiffness` of coupling `k`", "greater than 0")),
        ({"stiffness": "2 N m/rad"}, ("`stiffness` of coupling `k`", "a stiffness")),
        ({"joints": ("P", "A"), "eccentricity": 0.1}, ("`eccentricity` of coupling `k`", "T_x of `P`")),
        (
            {"ratio": None, "positions": [0, 2, 1], "values": [0, 1, 2]},
            ("`positions` of coupling `k`", "increasing"),
        ),
        ({"ratio": None, "positions": [0, 1], "values": [0, 1]}, ("`positions` of coupling `k`", "three")),
        ({"ratio": None, "positions": [0, 1, 2], "values": [0, 1]}, ("`values` of coupling `k`", "has 2")),
        (
            {"ratio": None, "positions": [0, 1, 2], "values": [0, 1, 2], "periodic": True},
            ("`values` of coupling `k`", "end as it begins"),
        ),
    ],
)
def test_couplings_that_do_not_fit_their_joints_are_refused(refused, settings, pieces):
    with refused(*pieces):
        mechanism(coupling(**settings))


@pytest.mark.parametrize(
    "settings, pieces",
    [
        ({"joints": "A"}, ("`joints` of coupling `k`", "two names")),
        ({"joints": ("A", "B", "C")}, ("`joints` of coupling `k`", "two names")),
        ({"motions": ("R_y",)}, ("`motions` of coupling `k`", "two names")),
        ({"ratio": None}, ("`ratio` of coupling `k`", "neither is")),
        ({"positions": [0, 1, 2], "values": [0, 1, 2]}, ("`ratio` of coupling `k`", "both are")),
        ({"ratio": None, "positions": [0, 1, 2]}, ("`values` of coupling `k`", "is missing")),
        ({"ratio": None, "values": [0, 1, 2]}, ("`positions` of coupling `k`", "is missing")),
        ({"periodic": True}, ("`periodic` of coupling `k`", "without a table")),
        ({"backlash": 0.1, "one_sided": True}, ("`backlash` of coupling `k`", "one flank has no play")),
        ({"backlash": 0.1, "damping": 1.0}, ("`damping` of coupling `k`", "`contact_damping`")),
        ({"contact_damping": 1.0}, ("`contact_damping` of coupling `k`", "not used")),
        ({"exponent": 1.5}, ("`exponent` of coupling `k`", "not used")),
        ({"exponent": 4, "backlash": 0.1}, ("`exponent` of coupling `k`", "from 1 to 3")),
    ],
)
def test_couplings_are_checked_alone(refused, settings, pieces):
    with refused(*pieces):
        coupling(**settings)


def test_a_rotation_whose_tilt_is_sprung_is_refused(refused):
    with refused("`joints` of coupling `k`", "the tilt of `A` is sprung"):
        mechanism(coupling(), compliance=Compliance(tilt=10.0))


def study_with(text, tmp_path):
    path = tmp_path / "study.toml"
    path.write_text(FULL.replace("[drive]", f"{text}[drive]", 1), encoding="utf-8")
    return load_study(path)


def test_couplings_of_a_study_file(tmp_path):
    mesh, cam = study_with(COUPLINGS, tmp_path).mechanism.couplings
    found = [mesh.ratio, mesh.stiffness, mesh.offset, mesh.pitch_error, mesh.eccentricity_phase, mesh.waves]
    np.testing.assert_allclose(found, [-0.5, 2e3, np.pi / 2, np.pi / 1800, np.pi / 6, 2.0])
    np.testing.assert_allclose([*cam.values, cam.backlash], [0.0, np.pi / 60, np.pi / 36, 0.0, np.pi / 1800])
    assert (cam.periodic, cam.exponent, cam.contact_damping) == (True, 1.5, 0.2)


@pytest.mark.parametrize(
    "old, new, pieces",
    [
        ("ratio", "raito", ("[[mechanism.couplings]] `mesh`", "`raito`", "`ratio`?")),
        ('joints = ["A", "B"]', 'joints = ["A", "D"]', ("`mesh`", "`D` is cut")),
        ("stiffness", "# stiffness", ("[[mechanism.couplings]] `mesh`", "`stiffness`")),
        ("-0.5", '"5 mm/rev"', ("`ratio` of coupling `mesh`", "a plain number")),
    ],
)
def test_mistakes_in_a_study_file_are_named(refused, tmp_path, old, new, pieces):
    with refused(*pieces):
        study_with(COUPLINGS.replace(old, new, 1), tmp_path)


def test_the_guide_has_a_coupling():
    """Its block is read as it is written there."""
    guide = (Path(__file__).parents[2] / "docs" / "guides" / "own_mechanism.md").read_text(encoding="utf-8")
    block = guide.split("```toml\n[[mechanism.couplings]]\n")[1].split("```")[0]
    assert Coupling(**tomllib.loads(block)).name == "mesh"
