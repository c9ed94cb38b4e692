"""Scripts for Exudyn: what is in them, what is refused; and, where it is installed, their loads beside ours."""

import json
import os
import re
from dataclasses import replace
from importlib.util import find_spec

import numpy as np
import pytest

from rfem_jax import (
    Case,
    Compliance,
    ForceRamp,
    GeneralisedAlpha,
    InputError,
    Joint,
    JointForceFunction,
    JointForceTable,
    JointFriction,
    JointSpring,
    Link,
    Material,
    Mechanism,
    MomentRamp,
    Point,
    PointForce,
    PointMoment,
    PrescribedRate,
    PrescribedRunUp,
    Rectangle,
    RigidBody,
    Station,
)
from rfem_jax.description import Study
from rfem_jax.exchange.exudyn_writer import exudyn_text
from rfem_jax.mechanics.model.status import STATUS
from rfem_jax.report.command_line import main
from rfem_jax.simulation import run_cases

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
    return json.loads(re.search(r'r"""(\{.*?\})"""', script, re.DOTALL)[1])


def text_of(study, case=None):
    text, left = exudyn_text(study, case, "a test")
    assert not left
    return text


@pytest.mark.long
def test_the_script_holds_the_numbers():
    """Of rfes with all mass, of the frames with errors, of the drive at the ends of its pieces; in Exudyn's axes."""
    script = text_of(flexible(MomentRamp("A", 2.0, 0.05)), "askew")
    compile(script, "script", "exec")
    assert "rfem_jax" not in script
    content = content_of(script)
    assert len(content["bodies"]) == 3 + 2 and len(content["elements"]) == 2
    assert sum(one["mass"] for one in content["bodies"]) == pytest.approx(0.0942 + 2 * 0.2355)
    assert content["drive"] == "force" and [piece["end"] for piece in content["pieces"]] == [0.05, 0.1]
    first, second = (np.array(piece["values"]) for piece in content["pieces"])
    np.testing.assert_allclose(first[[0, -1]], [[0.0, 40.0, 0.0], [2.0, 40.0, 0.0]], atol=1e-9)
    assert not second.any()
    seat = next(one["seat"] for one in content["joints"] if one["name"] == "D")
    assert seat["point"] == pytest.approx([0.0, 0.3, 1e-3])
    assert np.degrees(np.arctan2(seat["rotation"][0][2], seat["rotation"][2][2])) == pytest.approx(0.5)
    still = max(abs(x) for one in content["bodies"] for x in (*one["velocity"], *one["angular"]))
    assert still == 0.0 and content["no_statics"] == ""


def test_velocities_of_a_prescribed_start_fit_the_poses():
    """The ends of both halves of a bending link move as the joints between them."""
    content = content_of(text_of(flexible(PrescribedRate("A", 12.0))))

    def speed(side):
        one = content["bodies"][side["body"]]
        return np.array(one["velocity"]) + np.cross(one["angular"], np.array(one["rotation"]) @ side["point"])

    for joint in content["joints"]:
        if joint["seat"]["body"] >= 0:
            np.testing.assert_allclose(speed(joint["seat"]), speed(joint["bore"]), atol=1e-6)
    assert content["bodies"][0]["angular"] == pytest.approx([0.0, 0.0, 12.0]) and content["drive"] == "motion"


TILTED = {"orientation": (0.2, 0.1, 0.3)}


def chain(kind, *forces, drive=None, **joint):
    """A body on an arm that swings, with a joint of a kind between them whose axes are askew, as a study."""
    arm, plate = (
        Link(name, length, body=RigidBody(mass, centre, moments))
        for name, length, mass, centre, moments in (
            ("arm", 0.3, 0.8, (0.14, 0.01, 0.02), (1e-3, 7e-3, 7e-3)),
            ("plate", 0.1, 0.5, (0.03, 0.02, -0.01), (8e-4, 1.5e-3, 9e-4)),
        )
    )
    joints = Joint("A", "base", "arm", angle=-0.4), Joint("X", "arm", "plate", kind=kind, **(TILTED | joint))
    points = (Point("tip", "plate", (0.1, 0.0, 0.02)),)
    mechanism = Mechanism((arm, plate), joints, forces=forces, gravity=(0.5, 1.0, -9.81), points=points)
    return Study("x", mechanism, drive, 0.15, GeneralisedAlpha(step=1e-4))


def spring(motion):
    size = (2.0, 5e-3, 0.1, 0.05) if motion[0] == "R" else (300.0, 0.5, 0.02, 0.3)
    return JointSpring(f"along_{motion}", "X", *size, motion=motion)


STIFF = {f"R_{axis}": 100.0 * (n + 1) for n, axis in enumerate("xyz")} | {f"R_{axis}_damping": 0.03 for axis in "xyz"}
REFUSED = {
    "neither springs nor tables, but the study has `own`": chain(
        "revolute", JointForceFunction("own", "X", lambda position, rate: -rate)
    ),
    "several rotations, but the study has the drive of X.R_y": chain(
        "universal", drive=MomentRamp("X", 0.1, 0.05, motion="R_y")
    ),
    "slides, but the study has `along_T_x`": chain("planar", spring("T_x")),
    "that slide on moving links, but the study has `X`": chain(
        "prismatic", spring("T_x"), compliance=Compliance(normal=2e4)
    ),
    "some of the rotations are sprung": chain("fixed", compliance=Compliance(R_x=100.0)),
    "whose axes they do not have": chain("revolute", compliance=Compliance(tilt=30.0)),
    "both ends of a bearing.* but the study has `rub`": chain(
        "revolute", JointFriction("rub", "X", coefficient=0.2, radius=0.01, length=0.03, load_scale=0.1,
                                  sliding_rate=0.5),
    ),
    "between points, and loads at points that change, but the study has `push`": chain(
        "revolute", PointForce("push", "plate", (0.1, 0.0, 0.0), ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0)), times=(0.0, 1.0))
    ),
    "redundant constraints": study("slider_crank"),
}  # fmt: skip


@pytest.mark.parametrize("words", REFUSED)
def test_what_is_not_translated_is_refused(words):
    with pytest.raises(InputError, match=f"A script for Exudyn must do without .*?{words}"):
        exudyn_text(REFUSED[words], None, "x")


def test_links_that_are_not_translated_are_refused():
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
    with pytest.raises(InputError, match="neither stretch nor shear, but the study has `rocker`, `coupler`"):
        exudyn_text(replace(one, mechanism=replace(one.mechanism, links=thin)), None, "x")


@pytest.mark.long
def test_a_tapered_link_is_what_its_stations_say():
    one = flexible(MomentRamp("A", 2.0, 0.05))
    small = Rectangle(0.006, 0.008)
    links = [
        replace(link, stations=[Station(section=small)]) if link.name == "coupler" else link
        for link in one.mechanism.links
    ]
    tapered = replace(one, mechanism=replace(one.mechanism, links=links))
    plain, other = (content_of(text_of(study)) for study in (one, tapered))
    weights = [sum(body["mass"] for body in content["bodies"]) for content in (plain, other)]
    expected = [sum(float(link.mass) for link in study.mechanism.links) for study in (one, tapered)]
    assert weights == pytest.approx(expected, rel=1e-9) and weights[1] < weights[0]
    # Elements of the coupler are weaker, those of the rocker as they were.
    bending = [np.array([one["stiffness"][5] for one in content["elements"]]) for content in (plain, other)]
    weaker, same = sorted(bending[1] / bending[0])
    assert weaker < 0.8 and same == pytest.approx(1.0)


@pytest.mark.long
@pytest.mark.skipif(os.name != "posix", reason="other systems have no such names")
@pytest.mark.parametrize("name", ["a \"\"\" \\x '''.toml", "two\nlines.toml", "bad\udcff.toml"])
def test_names_of_files_are_no_code(name, tmp_path):
    """And files can be written that name them."""
    path = tmp_path / name
    assert main(["init", str(tmp_path / "mine.toml")]) == 0
    os.replace(tmp_path / "mine.toml", path)
    table, script = tmp_path / "made.csv", tmp_path / "made.py"
    assert main(["export", str(path), "--to", "frames", "-o", str(table)]) == 0
    assert main(["import", str(table), "-o", str(tmp_path / "back.toml")]) == 0
    assert main(["export", str(path), "--to", "exudyn", "-o", str(script)]) == 0
    compile(script.read_text(encoding="utf-8"), "made.py", "exec")


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
    for joint, loads in verified(text_of(one, "askew"), one, "askew").items():
        force, theirs, moment, their_moment = loads
        assert force > 1.0 and moment > 1e-3, joint
        assert theirs == pytest.approx(force, rel=1e-3) and their_moment == pytest.approx(moment, rel=1e-3), joint


@needs_exudyn
@pytest.mark.slow
def test_loads_of_rigid_links():
    """Balls, hinges that are not parallel, a spring between points, let go as they stand."""
    from rfem_jax.exchange.exudyn_writer import verified

    one = replace(study("double_wishbone"), duration=0.1, method=GeneralisedAlpha(step=1e-4))
    for joint, (force, theirs, moment, their_moment) in verified(text_of(one), one, None).items():
        assert theirs == pytest.approx(force, rel=2e-3, abs=1e-6), joint
        assert their_moment == pytest.approx(moment, rel=2e-3, abs=1e-3 * force * 0.1), joint


MOVED = {
    "revolute": chain("revolute", spring("R_y")),
    "cylindrical": chain("cylindrical", spring("R_y"), spring("T_y")),
    "planar": chain("planar", spring("R_y")),
    "prismatic": chain("prismatic", spring("T_x"), JointFriction("rub", "X", coefficient=0.3, load_scale=0.1,
                                                                  sliding_rate=0.05)),
    "universal": chain("universal"),
    "spherical": chain("spherical"),
    "fixed": chain("fixed"),
    "free": chain("free"),
    "table": chain("prismatic", JointForceTable("gas", "X", (-0.1, 0.0, 0.05, 0.2), (5.0, 0.0, -2.0, -20.0))),
    "friction": chain("revolute", JointFriction("rub", "X", constant=0.05, static_constant=0.08, viscous=1e-3,
                                                sliding_rate=0.5, law="brown_mcphee")),
    "friction by load": chain("revolute", JointFriction(
        "rub", "X", coefficient=0.2, static_coefficient=0.3, radius=0.01, load_scale=0.1, sliding_rate=0.5,
        law="brown_mcphee")),
    "loads": chain("revolute", PointForce("push", "plate", (0.05, 0.0, 0.01), (0.1, 0.2, 0.3)),
                   PointMoment("turn", "arm", (0.1, 0.0, 0.0), (0.01, 0.02, 0.03), axes="link")),
    "force between links": chain("prismatic", drive=ForceRamp("X", 5.0, 0.05)),
    "moment between links": chain("cylindrical", drive=MomentRamp("X", 0.1, 0.05, motion="R_y")),
    "speed": chain("cylindrical", drive=PrescribedRunUp("X", 0.5, 0.05, motion="T_y")),
    "rate": chain("revolute", drive=PrescribedRate("X", 5.0)),
    "bushing": chain("revolute", compliance=Compliance(radial=2e4, radial_damping=5.0, axial=3e4, axial_damping=4.0)),
    "tilts": chain("revolute", orientation=(0.0, 0.0, 0.0), compliance=Compliance(
        radial=2e4, radial_damping=5.0, tilt=30.0, tilt_damping=0.01)),
    "all sprung": chain("fixed", compliance=Compliance(T_x=2e4, T_x_damping=5.0, **STIFF)),
}  # fmt: skip


@needs_exudyn
@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # of names that later versions have otherwise
@pytest.mark.parametrize(
    "name", [name if name in ("prismatic", "speed") else pytest.param(name, marks=pytest.mark.long) for name in MOVED]
)
def test_motion_and_loads_are_those_of_exudyn(name):
    """In a joint of every kind on a body that moves, of every force: vectors in hinge frames, and the path of a point,
    after the first 20 ms, in which springs that begin at once ring in the first steps."""
    from rfem_jax.exchange.exudyn_program import move

    one = MOVED[name]
    theirs = move(content_of(text_of(one)), 1e-4, track=("tip",)).histories
    run = next(iter(run_cases(one)[1].values()))
    times = np.asarray(run.times)
    at = np.searchsorted(theirs.times, times - 1e-6)
    assert STATUS[int(run.status)].name == "ok"
    np.testing.assert_allclose(theirs.places["tip"][at], run.points["tip"].position, atol=2e-6)
    for kind in ("force", "moment"):
        found, later = getattr(theirs, kind), times > 0.02
        largest = max(np.abs(values).max() for values in found.values())
        for joint, values in found.items():
            ours = getattr(run.loads[joint], kind)
            np.testing.assert_allclose(values[at][later], ours[later], atol=6e-4 * largest, err_msg=f"{kind} {joint}")


@needs_exudyn
@pytest.mark.slow
def test_options_of_the_script(tmp_path, capsys):
    """Its own static start and other nodes and iterations give the same loads; tables hold loads and places."""
    script = text_of(flexible(MomentRamp("A", 2.0, 0.05)), "askew")
    names = {"__name__": "script"}
    exec(compile(script, "script", "exec"), names)

    def loads(*arguments):
        names["main"](arguments)
        return np.array([line.split()[1:] for line in capsys.readouterr().out.splitlines()[1:]], float)

    plain = loads("--step", "2e-4")
    table = tmp_path / "table.csv"
    for options in (
        ["--statics", "--csv", str(table), "--track", "C"],
        ["--nodes", "angles", "--newton", "fresh"],
        ["--nodes", "rotation_vector", "--newton", "full", "--dense"],
        ["--tait-bryan", "--radius", "0.7"],
    ):
        np.testing.assert_allclose(loads("--step", "2e-4", *options), plain, rtol=1e-3)
    columns = np.genfromtxt(table, delimiter=",", names=True)
    force = np.sqrt(sum(columns[f"C_force_{axis}_N"] ** 2 for axis in "xyz"))
    mean = np.sqrt(np.trapezoid(force**2, columns["time_s"]) / 0.1)
    np.testing.assert_allclose(mean, plain[3, 0], rtol=1e-4)
    across = [columns[f"C_{axis}_m"] - centre for axis, centre in zip("xyz", (0.3, 1e-3, 0.0))]
    np.testing.assert_allclose(np.sqrt(sum(x**2 for x in across)), 0.3, atol=2e-4)


@needs_exudyn
def test_drives_between_rows():
    """A polynomial of fifth degree is exact."""
    from rfem_jax.exchange.exudyn_program import drive_values

    given = np.polynomial.Polynomial([1.0, -2.0, 0.5, 3.0, -1.0, 2.0])
    times = np.linspace(0.5, 2.0, 4)
    rows = np.stack([given(times), given.deriv()(times), given.deriv(2)(times)], axis=1)
    between = np.linspace(0.5, 2.0, 37)
    found = drive_values({"begin": 0.5, "end": 2.0, "values": rows}, between)
    np.testing.assert_allclose(found, given(between), rtol=1e-13)
