"""Scripts for Exudyn: what is in them, what is refused; and, where it is installed, their loads beside ours."""

import json
import re
from dataclasses import replace
from importlib.util import find_spec

import numpy as np
import pytest

from rfem_jax import (
    Case,
    GeneralisedAlpha,
    InputError,
    JointFriction,
    Material,
    MomentRamp,
    PrescribedRate,
    Rectangle,
    Station,
)
from rfem_jax.description import Study
from rfem_jax.exchange.exudyn_writer import exudyn_text
from rfem_jax.report.command_line import main

from .machines import MACHINES, study

needs_exudyn = pytest.mark.skipif(find_spec("exudyn") is None, reason="the package exudyn is not installed")
ERRORS = {"D.delta_x": "0.5 deg", "D.d_y": "1 mm", "C.child.delta_z": "0.2 deg"}


def flexible(drive):
    """The four-bar whose coupler and rocker bend, with errors and a spring."""
    steel = Material("steel", youngs_modulus=210e9, density=7850.0, poisson_ratio=0.3, damping=1e-5)
    mechanism = MACHINES["four_bar"]()
    bars = {"section": Rectangle(0.01, 0.01), "material": steel, "rfes": 2, "body": None}
    links = [link if link.name == "crank" else replace(link, **bars) for link in mechanism.links]
    mechanism = replace(mechanism, links=links, elements="geometrically_exact")
    method = GeneralisedAlpha(step=2e-4)
    return Study("x", mechanism, drive, 0.1, method, cases=(Case("askew", ERRORS),))


def content_of(script):
    return json.loads(re.search(r'r"""\n(.*?)\n"""', script, re.DOTALL)[1])


def test_the_script_holds_the_numbers():
    """Of rfes with all mass, of the frames with errors, of the drive at the ends of its pieces."""
    script = exudyn_text(flexible(MomentRamp("A", 2.0, 0.05)), "askew", "a test")
    compile(script, "script", "exec")
    content = content_of(script)
    assert len(content["bodies"]) == 3 + 2 and len(content["elements"]) == 2
    assert sum(one["mass"] for one in content["bodies"]) == pytest.approx(0.0942 + 2 * 0.2355)
    assert [piece["end"] for piece in content["pieces"]] == [0.05, 0.1]
    assert content["pieces"][0]["values"][-1] == pytest.approx(2.0) and not any(content["pieces"][1]["values"])
    seat = next(one["seat"] for one in content["joints"] if one["name"] == "D")
    assert seat["point"] == pytest.approx([0.3, 1e-3, 0.0])
    assert np.degrees(np.arctan2(seat["rotation"][2][1], seat["rotation"][1][1])) == pytest.approx(0.5)
    still = max(abs(x) for one in content["bodies"] for x in (*one["velocity"], *one["angular"]))
    assert still == 0.0 and content["known"]


def test_velocities_of_a_prescribed_start_fit_the_poses():
    """The ends of both halves of a bending link move as the joints between them."""
    script = exudyn_text(flexible(PrescribedRate("A", 12.0)), None, "a test")
    content = content_of(script)

    def speed(side):
        one = content["bodies"][side["body"]]
        return np.array(one["velocity"]) + np.cross(one["angular"], np.array(one["rotation"]) @ side["point"])

    for joint in content["joints"]:
        if joint["seat"]["body"] >= 0:
            np.testing.assert_allclose(speed(joint["seat"]), speed(joint["bore"]), atol=1e-6)
    crank = content["bodies"][0]
    assert crank["angular"] == pytest.approx([0.0, 12.0, 0.0]) and not content["known"]


def test_what_is_not_translated_is_refused():
    rubbing = MACHINES["four_bar"]()
    rubbing = replace(rubbing, forces=(JointFriction("rub", "A", constant=0.1, sliding_rate=0.1),))
    with pytest.raises(InputError, match="must do without forces other than springs, but the study has `rub`"):
        exudyn_text(Study("x", rubbing, duration=1.0), None, "x")
    with pytest.raises(InputError, match="without joints of these kinds"):
        exudyn_text(study("stewart"), None, "x")
    with pytest.raises(InputError, match="without redundant constraints"):
        exudyn_text(study("slider_crank"), None, "x")
    one = flexible(MomentRamp("A", 2.0, 0.05))
    warm = {"temperature_gradient_z": "100 K/m"}
    links = [
        replace(link, material=replace(link.material, thermal_expansion=1.2e-5), **warm) if link.flexible else link
        for link in one.mechanism.links
    ]
    with pytest.raises(InputError, match="without temperature gradients"):
        exudyn_text(replace(one, mechanism=replace(one.mechanism, links=links)), None, "x")
    thin = [
        replace(link, flexibility=["bending", "torsion"]) if link.flexible else link for link in one.mechanism.links
    ]
    with pytest.raises(InputError, match="neither stretch nor shear"):
        exudyn_text(replace(one, mechanism=replace(one.mechanism, links=thin)), None, "x")


def test_a_tapered_link_is_what_its_stations_say():
    one = flexible(MomentRamp("A", 2.0, 0.05))
    small = Rectangle(0.006, 0.008)
    links = [
        replace(link, stations=[Station(section=small)]) if link.name == "coupler" else link
        for link in one.mechanism.links
    ]
    tapered = replace(one, mechanism=replace(one.mechanism, links=links))
    plain, other = (content_of(exudyn_text(study, None, "x")) for study in (one, tapered))
    weights = [sum(body["mass"] for body in content["bodies"]) for content in (plain, other)]
    expected = [sum(float(link.mass) for link in study.mechanism.links) for study in (one, tapered)]
    assert weights == pytest.approx(expected, rel=1e-9) and weights[1] < weights[0]
    # Elements of the coupler are weaker, those of the rocker as they were.
    bending = [np.array([one["stiffness"][4] for one in content["elements"]]) for content in (plain, other)]
    weaker, same = sorted(bending[1] / bending[0])
    assert weaker < 0.8 and same == pytest.approx(1.0)


def test_only_scripts_are_verified(tmp_path, capsys):
    path = tmp_path / "mine.toml"
    assert main(["init", str(path)]) == 0
    assert main(["export", str(path), "--to", "urdf", "--verify"]) == 2
    assert "must be left out unless --to is exudyn or mjcf" in capsys.readouterr().err


@needs_exudyn
@pytest.mark.slow
@pytest.mark.parametrize("drive", [MomentRamp("A", 2.0, 0.05), PrescribedRate("A", 12.0)], ids=["moment", "rate"])
def test_loads_are_those_of_exudyn(drive):
    """Geometrically exact elements: within the error of the steps of both."""
    from rfem_jax.exchange.exudyn_writer import verified

    one = flexible(drive)
    for joint, loads in verified(exudyn_text(one, "askew", "a test"), one, "askew").items():
        force, theirs, moment, their_moment = loads
        assert force > 1.0 and moment > 1e-3, joint
        assert theirs == pytest.approx(force, rel=1e-3) and their_moment == pytest.approx(moment, rel=1e-3), joint


@needs_exudyn
@pytest.mark.slow
def test_loads_of_rigid_links():
    """Balls, hinges that are not parallel, a spring between points, let go as they stand."""
    from rfem_jax.exchange.exudyn_writer import verified

    one = replace(study("double_wishbone"), duration=0.1, method=GeneralisedAlpha(step=1e-4))
    for joint, (force, theirs, moment, their_moment) in verified(exudyn_text(one, None, "x"), one, None).items():
        assert theirs == pytest.approx(force, rel=2e-3, abs=1e-6), joint
        assert their_moment == pytest.approx(moment, rel=2e-3, abs=1e-3 * force * 0.1), joint
