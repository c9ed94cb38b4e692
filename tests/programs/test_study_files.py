"""The study files in `studies`: each is valid as it is, and its commands run on a reduced copy.

Copies are short, with few rfes and samples.  Second derivatives of the four-bar take minutes to compile: copies of
studies that need them have a double pendulum of rigid links instead, whose joints are A and D.
"""

import csv
import json
import math
import tomllib

import numpy as np
import pytest

from rfem_jax import discretise, load_study
from tests.programs.conftest import ROOT

STUDIES = ROOT / "studies"
FILES = sorted(path.relative_to(STUDIES).as_posix() for path in STUDIES.rglob("*.toml"))
JOINTS = {
    "straight_line": ("A", "B", "D", "C"),
    "slider_crank": ("A", "B", "G", "P"),
    "connecting_rod": ("A", "B", "G", "P"),
    "rocker_from_mesh": ("A", "B", "D", "C"),
    "toggle": ("A", "B", "G", "C"),
    "six_bar_press": ("A", "B", "D", "C", "E", "G", "F"),
    "balancing/slider_crank.toml": ("A", "B", "G", "P"),
    "balancing": ("A", "B", "D", "C"),
}
HINGES = [
    {"name": "A", "parent": "base", "child": "crank", "angle": "90 deg"},
    {"name": "D", "parent": "crank", "child": "coupler"},
]


def to_toml(value):
    """Nested tables and lists in TOML's inline form."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{json.dumps(key)} = {to_toml(entry)}" for key, entry in value.items()) + "}"
    if isinstance(value, list):
        return f"[{', '.join(map(to_toml, value))}]"
    return json.dumps(value)


def reduced(name, pendulum=False, change=None):
    """Text of a smaller study; `change` is called with its content."""
    content = tomllib.loads((STUDIES / name).read_text(encoding="utf-8"))
    simulation = {"duration": 5e-3, "save_every": 2.5e-3}
    if "simulation" not in content:
        simulation = {}  # of a mechanism at rest
    elif content["simulation"]["method"] in ("auto", "generalised_alpha"):
        simulation |= {"method": "generalised_alpha", "step": 6.25e-4}
    else:
        simulation |= {key: content["simulation"][key] for key in ("method", "step")}
    mechanism = content["mechanism"]
    for link in mechanism["links"]:
        link |= {"rfes": 1 if pendulum or link.get("rigid") or "body" in link else 2}
    if pendulum:
        mechanism["links"], mechanism["joints"] = mechanism["links"][:2], HINGES
        bounds = content.get("allocation", {}).get("bounds", {})
        for error in [name for name in bounds if name.split(".")[0] not in ("A", "D", "crank", "coupler")]:
            del bounds[error]
    for task, sizes in {
        "monte_carlo": {"n": 8, "batch": 4},
        "worst_case": {"evaluations": 4, "batch": 16},
        "allocation": {"samples": 16, "verify_samples": 16, "batch": 16},
    }.items():
        if task in content:
            content[task] |= {key: size for key, size in sizes.items() if key in content[task]}
    if change is not None:
        change(content)
    if simulation:
        content["simulation"] = simulation
    return "\n".join(f"{key} = {to_toml(value)}" for key, value in content.items())


@pytest.mark.parametrize("name", FILES)
def test_every_file_is_valid(name):
    study = load_study(STUDIES / name)
    model = discretise(study.mechanism_at_rest)
    names = JOINTS.get(name) or JOINTS.get(name.partition("/")[0], ("A", "B", "D", "C"))
    assert study.statics is not None or study.drive.joint == "A"
    assert model.driven_joint == "A" and model.joint_names == names
    folders = ("four_bar", "spatial_linkage", "bearing_stiffness", "clearance", *DESIGNS, *JOINTS, *COMMANDS)
    assert any(name.startswith(f"{folder}/") for folder in folders), "no test runs this file"


@pytest.fixture
def run_command(run_program, tmp_path):
    """Run a command on a text of a study; its output folder and what it prints."""

    def run(command, text, *arguments, **options):
        file, out = tmp_path / "study.toml", tmp_path / "out"
        file.write_text(text, encoding="utf-8")
        said = run_program("rfem_jax.report.command_line", command, file, "--out", out, *arguments, **options)
        return out, said

    return run


@pytest.mark.long
def test_undamped_four_bar(run_command):
    """`test_main_study.py` has the study beside it."""
    out, said = run_command("run", reduced("four_bar/undamped.toml"))
    cases = json.loads((out / "results.json").read_text())["cases"]
    assert list(cases) == ["P1", "P2", "P3", "P4", "P5"]
    assert all(case["status"] == "ok" for case in cases.values())
    # A tilt loads all joints from the start.
    forces = [case["joints"]["A"]["rms_force"] for case in cases.values()]
    assert forces[1] > 5.0 * forces[0] and "P5" in said


@pytest.mark.long
def test_monte_carlo(run_command):
    out, said = run_command("monte-carlo", reduced("monte_carlo/study.toml"))
    with open(out / "monte_carlo.csv", newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 8
    assert "D.rms_force" in said


DESIGNS = ("design_sweep", "robust_four_bar")
COMMANDS = {
    "monte_carlo": (("study.toml", "monte-carlo"),),
    "tolerance_sensitivity": (("study.toml", "sensitivity"),),
    "tolerance_allocation": (
        ("study.toml", "worst-case"),
        ("study.toml", "allocate"),
        ("yield.toml", "allocate"),
        ("all_joints.toml", "allocate"),
    ),
    "identify_misassembly": (("study.toml", "identify"),),
}
ON_THEIR_OWN = ("monte_carlo", "identify_misassembly")


@pytest.mark.long
@pytest.mark.parametrize(
    ("name", "command"),
    [
        (f"{folder}/{file}", command)
        for folder in COMMANDS
        for file, command in COMMANDS[folder]
        if folder not in ON_THEIR_OWN
    ],
)
def test_tolerance_studies(run_command, name, command):
    out, said = run_command(command, reduced(name, pendulum=True))
    written = {path.suffix for path in out.iterdir()}
    assert {".json", ".csv", ".png"} <= written
    assert "D.delta_x" in said


@pytest.mark.long
def test_identify_misassembly(run_program, run_command, tmp_path):
    """The machine is measured by a finer model over a shorter time with less noise, and its tilt is found."""

    content = tomllib.loads(reduced("identify_misassembly/study.toml"))
    content["simulation"] |= {"duration": 0.15, "save_every": 1e-3, "step": 5e-4}
    for link in content["mechanism"]["links"][1:]:
        link["rfes"] = 4
    # So few rfes would be too coarse, as the study's test with `long` shows that its own are not.
    content["identification"] |= {"starts": 4, "samples": 64, "candidates": {}, "check_model": False}
    del content["identification"]["correction"]
    sensors = {"rate_rad_s": {"noise": 0.15}, "D_moment_z_Nm": {"noise": 0.1, "offset": 0.2}}
    content["identification"]["signals"] = sensors
    text = "\n".join(f"{key} = {to_toml(value)}" for key, value in content.items())
    (tmp_path / "study.toml").write_text(text, encoding="utf-8")
    said = run_program("studies/identify_misassembly/measure.py", "--study", tmp_path / "study.toml", "--out", tmp_path)
    assert "is written" in said
    measured = (tmp_path / "measured.csv").read_text(encoding="utf-8")
    assert "nan" not in measured and len(measured.splitlines()) > 50
    out, said = run_command("identify", text)
    found = json.loads((out / "identification.json").read_text())
    assert found["status"] in ("ok", "ambiguous"), said
    tilt = next(row for row in found["errors"] if row["error"] == "D.delta_x")
    sign = np.sign(tilt["estimate"])  # over so short a time it is open
    assert sign * tilt["estimate"] == pytest.approx(np.radians(0.2), abs=3.0 * tilt["deviation"])
    assert tilt["deviation"] < 0.3 * tilt["prior_deviation"]


@pytest.mark.exhaustive
def test_identify_misassembly_corrects_the_machine(run_program, run_command):
    """The study with fewer samples of what is known; the true machine, which the estimate does not know, keeps what
    every correction promises."""
    content = tomllib.loads((STUDIES / "identify_misassembly" / "study.toml").read_text(encoding="utf-8"))
    content["identification"]["samples"] = 128
    content["identification"]["correction"]["points"] = 4
    text = "\n".join(f"{key} = {to_toml(value)}" for key, value in content.items())
    data = STUDIES / "identify_misassembly" / "measured.csv"
    out, _ = run_command("identify", text, "--data", data)
    correction = json.loads((out / "identification.json").read_text())["correction"]
    before, *_, together = correction["outcomes"]
    assert correction["status"] == "ok" and together["mean"] < 0.1 * before["mean"]
    assert before["broken"]["D.rms_moment"] > 0.99 and together["broken"]["D.rms_moment"] < 0.01
    said = run_program("studies/identify_misassembly/verify.py", out)
    assert said.count(": kept") == 5 and "not kept" not in said


@pytest.mark.long
def test_clearance(run_command):
    """Its mechanism over a turn; derivatives for its tasks take most of a minute to compile, and
    `tests/tolerancing/test_allocation_with_clearance.py` has such tasks."""
    out, said = run_command("turn", reduced("clearance/allocation.toml"), "--positions", 2)
    assert "Shares of positions at which contacts carry" in said
    with open(out / "turn.csv", newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert [row["status"] for row in rows] == ["ok"] * 2
    for row in rows:
        assert row["D_carrying"] == "start+end" and float(row["D_contact_force_start_N"]) > 0.1


@pytest.mark.slow
def test_design_sweep(run_command):
    """Of the pendulum: its mass is that of its sections."""

    def few(content):
        content["sweep"] |= {"levels": 3, "batch": 9}
        content["sweep"]["metrics"] = ["mass", "A.mean_square_force"]

    out, said = run_command("sweep", reduced("design_sweep/study.toml", pendulum=True, change=few))
    with open(out / "sweep.csv", newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 9 and {row["status"] for row in rows} == {"0"}
    for row in rows:
        area = (0.01 + float(row["bar.height_m"])) * (0.01 + float(row["bar.width_m"]))
        assert float(row["mass_kg"]) == pytest.approx(7850.0 * area * (0.12 + 0.3), rel=1e-9)
    assert "bar.height" in said and (out / "sweep_contours.png").exists()


def of_few_errors(*names):
    """A change of a study to a few of its tolerances, with derivatives of first order."""

    def change(content):
        for table in (content["tolerances"], content["allocation"]["bounds"]):
            for name in set(table) - set(names):
                del table[name]
        content["sensitivity"]["order"] = 1

    return change


def without_tasks(text):
    tasks = ("tolerances", "sensitivity", "monte_carlo", "worst_case", "allocation")
    return "\n".join(line for line in text.splitlines() if line.split(" = ")[0] not in tasks)


def straight_line(t, coupler=0.25, rocker=0.25, base=0.2):
    """Path (times, 2) in x and z of the point of Chebyshev's linkage, twice as far from the crank's pin as C."""
    turn = np.pi / 2 + 2.0 * np.pi * t
    pin = 0.1 * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    to_base = np.array([base, 0.0]) - pin
    distance = np.linalg.norm(to_base, axis=1)
    slope = np.arctan2(to_base[:, 1], to_base[:, 0])
    slope = slope + np.arccos((coupler**2 - rocker**2 + distance**2) / (2.0 * coupler * distance))
    return pin + 2.0 * coupler * np.stack([np.cos(slope), np.sin(slope)], axis=1)


@pytest.mark.long
def test_straight_line(run_command):
    """The whole stroke, against closed kinematics and a line by singular values; what README.md says of the cases."""
    content = tomllib.loads((STUDIES / "straight_line" / "study.toml").read_text(encoding="utf-8"))
    for task in ("sensitivity", "monte_carlo", "worst_case"):
        del content[task]
    out, _ = run_command("run", "\n".join(f"{key} = {to_toml(value)}" for key, value in content.items()))
    cases = json.loads((out / "results.json").read_text())["cases"]
    times, perfect = np.linspace(0.0, 0.5, 101), straight_line(np.linspace(0.0, 0.5, 101))
    lengths = {"long_coupler": {"coupler": 0.2501}, "long_rocker": {"rocker": 0.2501}, "wide_base": {"base": 0.2001}}
    for name, changed in {"perfect": {}, **lengths}.items():
        path = straight_line(times, **changed)
        centred = path - path.mean(axis=0)
        straightness = 2.0 * np.abs(centred @ np.linalg.svd(centred)[2][1]).max()
        away = path - perfect
        found = cases[name]["metrics"]
        assert found["P.straightness"] == pytest.approx(straightness, rel=1e-7)
        assert found["P.max_deviation"] == pytest.approx(np.linalg.norm(away, axis=1).max(), abs=1e-9)
        assert found["P@-180deg.deviation_z"] == pytest.approx(away[50, 1], abs=1e-9)
    assert cases["perfect"]["metrics"]["P.straightness"] == pytest.approx(0.994e-3, rel=1e-3)
    for name, moved, bent in (("long_coupler", 0.25, 0.046), ("wide_base", 0.2, 0.054)):
        metrics = cases[name]["metrics"]
        assert metrics["P.max_deviation"] == pytest.approx(1e-3 * moved, rel=1e-2)
        assert metrics["P.straightness"] - 0.99417e-3 == pytest.approx(1e-3 * bent, rel=1e-2)


@pytest.mark.long
def test_connecting_rod(run_command):
    """A bow sideways: the pins hold the ends of the rod parallel, each by 2 N b / pi; in the plane they turn."""

    def without(content):
        del content["sensitivity"], content["monte_carlo"]

    out, _ = run_command("run", reduced("connecting_rod/study.toml", change=without))
    cases = json.loads((out / "results.json").read_text())["cases"]
    assert all(case["status"] == "ok" for case in cases.values())
    loads = cases["bowed_sideways"]["joints"]
    force, moment = (0.5 * (loads["B"][kind] + loads["P"][kind]) for kind in ("rms_force", "rms_moment"))
    assert moment == pytest.approx(2.0 / np.pi * force * 2e-4, rel=1e-2)
    assert cases["bowed_in_plane"]["joints"]["P"]["rms_moment"] < 1e-3 * moment


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "preload"),
    [
        ("study", (26.84, 18.57, 25.91)),
        pytest.param("beam", (27.90, 18.38, 26.21), marks=pytest.mark.long),
    ],
)
def test_rocker_from_mesh(run_command, name, preload):
    """The body of the study is found beside it; preloads of D by its three errors, weights included."""

    def beside(content):
        coupler, rocker = content["mechanism"]["links"][1:]
        coupler["rfes"] = rocker["rfes"] = 5
        if "body" in rocker:
            rocker["body"]["file"] = str(STUDIES / "rocker_from_mesh" / rocker["body"]["file"])

    out, _ = run_command("run", reduced(f"rocker_from_mesh/{name}.toml", change=beside))
    cases = json.loads((out / "results.json").read_text())["cases"]
    assert all(case["status"] == "ok" for case in cases.values())
    found = [np.linalg.norm(cases[one]["joints"]["D"]["preload_force"]) for one in [*cases][1:4]]
    np.testing.assert_allclose(found, preload, atol=0.3 if name == "beam" else 0.01)


def balancing(name):
    """Text of a study of balancing without its sweep."""
    content = tomllib.loads((STUDIES / "balancing" / name).read_text(encoding="utf-8"))
    content.pop("sweep", None)
    return "\n".join(f"{key} = {to_toml(value)}" for key, value in content.items())


def slider_crank_shakes(counterweight, crank=0.06, rod=0.2, rate=20.0 * np.pi):
    """RMS of the shaking force over a revolution: the rod's mass is shared between its ends as its centre has it."""
    at_crank, at_piston = 0.8 * 0.13 / 0.2, 0.9 + 0.8 * 0.07 / 0.2
    turning, sliding = 1.2 * 0.02 + at_crank * crank - counterweight * 0.05, at_piston * crank
    turn = np.linspace(0.0, 2.0 * np.pi, 720, endpoint=False)
    sine, cosine = np.sin(turn), np.cos(turn)
    height = np.sqrt(rod**2 - crank**2 * sine**2)  # the rod's part of the piston's place, twice differentiated
    second = -(crank**2) * (cosine**2 - sine**2) / height - crank**4 * sine**2 * cosine**2 / height**3
    along = (turning + sliding) * cosine - at_piston * second
    return rate**2 * np.sqrt(np.mean(along**2 + (turning * sine) ** 2))


@pytest.mark.long
def test_balancing_of_a_slider_crank(run_command):
    """Shaking forces are those of the closed form; the best counterweight balances what turns and half of what
    slides."""
    out, _ = run_command("run", balancing("slider_crank.toml"))
    cases = json.loads((out / "results.json").read_text())["cases"]
    for case, mass in {"as_drawn": 0.1, "rotating": 1.104, "half": 1.812, "all": 2.52}.items():
        assert cases[case]["metrics"]["rms_shaking_force"] == pytest.approx(slider_crank_shakes(mass), rel=1e-6)
    found = json.loads((out / "optimise.json").read_text())
    turning, sliding = 1.2 * 0.02 + 0.52 * 0.06, (0.9 + 0.28) * 0.06
    best = (turning + 0.5 * sliding) / 0.05
    assert found["status"] == "ok" and found["designs"]["crank.point_masses.1.mass"] == pytest.approx(best, rel=1e-6)
    assert found["objective"] == pytest.approx(slider_crank_shakes(best) ** 2, rel=1e-6)
    for case, shown in {"as_drawn": 370.7, "rotating": 206.8, "half": 152.4, "all": 206.8}.items():  # of README.md
        assert cases[case]["metrics"]["rms_shaking_force"] == pytest.approx(shown, rel=5e-4)


@pytest.mark.long
def test_balancing_of_a_four_bar(run_command):
    """The conditions of Berkof and Lowen for links whose mass centres lie on their lines."""
    out, _ = run_command("run", balancing("four_bar.toml"))
    shared = 0.6 * 0.1 / 0.24  # of the coupler's mass, that the rocker carries
    wanted = {
        "crank.point_masses.1.mass": (0.5 * 0.04 + (0.6 - shared) * 0.08) / 0.06,
        "rocker.point_masses.1.mass": (0.7 * 0.09 + shared * 0.2) / 0.08,
    }
    found = json.loads((out / "optimise.json").read_text())
    assert found["status"] == "ok" and found["designs"] == pytest.approx(wanted, rel=1e-6)
    drawn, balanced = (
        json.loads((out / "results.json").read_text())["cases"][name] for name in ("as_drawn", "balanced")
    )
    metrics = [case["metrics"] for case in (drawn, balanced)]
    assert metrics[1]["max_shaking_force"] < 1e-6 * metrics[0]["max_shaking_force"]
    # What it costs, as README.md says.
    assert [one["rms_shaking_moment"] for one in metrics] == pytest.approx([6.27, 9.96], rel=1e-3)
    assert [one["D.max_force"] for one in metrics] == pytest.approx([90.2, 197.3], rel=1e-3)


@pytest.mark.long
def test_slider_crank(run_command):
    """And its tasks, with a limit for the short run, which the allocation comes to."""

    def change(content):
        of_few_errors("G.delta_z", "P.delta_x")(content)
        content["sensitivity"]["metrics"] = ["G.mean_square_moment"]
        content["allocation"]["limits"] = {"G.mean_square_moment": 1e6}

    out, said = run_command("run", reduced("slider_crank/study.toml", change=change))
    check_tasks(out, said, 8, more={"worst_case"})
    allocated = json.loads((out / "allocation.json").read_text())
    assert allocated["status"] == "ok" and allocated["at_bounds"] == {}
    assert allocated["limits"][0]["predicted"] == pytest.approx(1e6, rel=1e-2)
    cases = json.loads((out / "results.json").read_text())["cases"]
    assert all(case["status"] == "ok" for case in cases.values())
    moments = {name: case["joints"]["G"]["rms_moment"] for name, case in cases.items()}
    assert moments["perfect"] < 1e-6 and all(value > 1.0 for name, value in moments.items() if name != "perfect")
    with open(out / "perfect.csv", newline="", encoding="utf-8") as file:
        last = list(csv.DictReader(file))[-1]
    crank = float(last["angle_rad"])
    slide = 0.06 * math.cos(crank) + math.sqrt(0.2**2 - (0.06 * math.sin(crank)) ** 2) - 0.2
    assert float(last["G_displacement_m"]) == pytest.approx(slide, abs=1e-6)
    assert "displacement_G.png" in {path.name for path in out.iterdir()}


def at_work(content):
    """Near the end of the stroke; rigid links, and the two cut joints are the bearings that give way."""
    starts = {"A": {"angle": "-15 deg"}, "B": {"angle": "16 deg"}, "D": {"angle": "92 deg"}, "E": {"angle": "-4 deg"}}
    starts["G"] = {"displacement": "-0.6 mm"}
    mechanism = content["mechanism"]
    content["cases"] = [case for case in content["cases"] if case["name"] in ("square", "guide_tilted", "long_toggle")]
    for link in mechanism["links"]:
        link["rfes"] = 1
    for joint in mechanism["joints"]:
        if not joint.get("cut"):
            for key in ("stiffness", "damping"):
                joint.pop(key, None)
        joint |= starts.get(joint["name"], {})


@pytest.mark.long
def test_six_bar_press(run_command):
    """With the crank held, the ram is in equilibrium between work, weight, pin and guide."""
    text = without_tasks(reduced("six_bar_press/study.toml", change=at_work))
    out, _ = run_command("run", text)
    cases = json.loads((out / "results.json").read_text())["cases"]
    assert all(case["status"] == "ok" for case in cases.values())
    table = tomllib.loads(text)["mechanism"]["forces"][0]
    positions = [float(one.removesuffix(" mm")) for one in table["positions"]]
    forces = [1e3 * float(one.removesuffix(" kN")) for one in table["forces"]]
    pushes = {}
    for name, case in cases.items():
        with open(out / f"{name}.csv", newline="", encoding="utf-8") as file:
            slide = 1e3 * float(next(csv.DictReader(file))["G_displacement_m"])
        pushes[name] = -np.interp(slide, positions, forces)
        pin, guide = (np.linalg.norm(case["joints"][joint]["preload_force"]) for joint in "FG")
        weight = 9.81 * 7850.0 * 0.24 * 0.16**2
        assert math.sqrt(pin**2 - guide**2) == pytest.approx(pushes[name] - weight, rel=1e-4)
    # A toggle that is longer by 0.05 mm presses harder, by what the springs of the pins leave of it.
    assert 1.02 < pushes["long_toggle"] / pushes["square"] < 1.3
    moments = {name: case["joints"]["F"]["rms_moment"] for name, case in cases.items()}
    assert moments["square"] < 1e-6 * moments["guide_tilted"] and moments["guide_tilted"] > 10.0


def toggles_alone(content):
    """The rigid toggles, driven in the crown, and the ram, whose pin alone gives way."""
    mechanism = content["mechanism"]
    starts = {"D": {"angle": "92 deg"}, "E": {"angle": "-4 deg"}, "G": {"displacement": "-0.6 mm"}, "F": {}}
    mechanism["links"] = [
        link | {"rfes": 1} for link in mechanism["links"] if link["name"] in ("upper", "lower", "ram")
    ]
    joints = [joint | starts[joint["name"]] for joint in mechanism["joints"] if joint["name"] in starts]
    mechanism["joints"] = [
        joint if joint.get("cut") else without(without(joint, "stiffness"), "damping") for joint in joints
    ]
    content["drive"]["joint"] = "D"
    content["sensitivity"]["metrics"] = [name.replace("A.", "E.") for name in content["sensitivity"]["metrics"]]
    for task in ("monte_carlo", "allocation"):
        content[task]["limits"]["G.end_displacement"] = ["-2 mm", "1 mm"]
    content["allocation"]["limits"]["E.mean_square_moment"] = 1e8  # hinges and guide that do not give way


@pytest.mark.long
def test_tasks_of_the_press(run_command):
    out, said = run_command("run", reduced("six_bar_press/study.toml", change=toggles_alone))
    check_tasks(out, said, 8)
    with open(out / "sensitivity.csv", newline="", encoding="utf-8") as file:
        rows = [row for row in csv.DictReader(file) if row["metric"].startswith("G.end_displacement")]
    gradients = {row["error"]: float(row["gradient"]) for row in rows}
    # Both toggles stand nearly along the stroke, on which no tilt has an effect of first order.
    assert gradients["upper.length"] == pytest.approx(gradients["lower.length"], rel=1e-2)
    assert 0.3 < gradients["upper.length"] < 1.0
    assert max(abs(value) for error, value in gradients.items() if "length" not in error) < 1e-6
    assert json.loads((out / "allocation.json").read_text())["status"] == "ok"


@pytest.mark.long
def test_spatial_linkage(run_command):
    """All tasks, with a rigid coupler, which compiles in half the time."""

    middle, half_width = -1.4634947, 1e-4  # of the rocker's angle at the end of the short run

    def change(content):
        of_few_errors("B.d_x", "B.d_z", "C.child.d_x")(content)
        content["sensitivity"]["metrics"] = ["D.end_angle"]
        content["allocation"]["limits"] = {"D.end_angle": [middle - half_width, middle + half_width]}

    text = reduced("spatial_linkage/study.toml", change=change)
    assert text.count('"rfes" = 2') == 1
    out, said = run_command("run", text.replace('"rfes" = 2', '"rfes" = 1'))
    check_tasks(out, said, 8)
    with open(out / "monte_carlo.csv", newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    # Nothing is bent to fit: errors of the ball centres move the rocker, and hardly change the loads.
    angle, force = (np.array([float(row[name]) for row in rows]) for name in ("D.end_angle_rad", "D.rms_force_N"))
    assert 1e-4 < np.ptp(angle) < 1e-2 and np.ptp(force) < 0.05 * force.min()
    # What the samples have is what the gradients g say, and tolerances t that are cheapest by 1/t for an angle that is
    # linear in them have the same g^2 t^3.
    with open(out / "sensitivity.csv", newline="", encoding="utf-8") as file:
        gradients = {row["error"]: float(row["gradient"]) for row in csv.DictReader(file)}
    gradient = np.array(list(gradients.values()))
    errors = np.array([[float(row[f"{name}_m"]) for name in gradients] for row in rows])
    np.testing.assert_allclose(np.ptp(angle), np.ptp(errors @ gradient), rtol=1e-3)
    allocated = json.loads((out / "allocation.json").read_text())
    assert allocated["status"] == "ok"
    tolerances = np.array([allocated["tolerances"][name] for name in gradients])
    np.testing.assert_allclose(gradient**2 * tolerances**3, gradient[0] ** 2 * tolerances[0] ** 3, rtol=1e-2)
    assert np.linalg.norm(gradient * tolerances) == pytest.approx(half_width, rel=1e-2)
    assert "D.end_angle" in said


def shaft_in_two_bearings(content):
    """The crank alone, in the bearing A and, 50 mm beside it, in D: one loop of one rigid link."""
    mechanism = content["mechanism"]
    joints = {joint["name"]: joint for joint in mechanism["joints"]}
    beside = [0.0, "50 mm", 0.0]
    second = {"position": beside, "child_position": beside, "child": "crank", "cut": True}
    content["sensitivity"]["order"] = 1
    mechanism["links"] = mechanism["links"][:1]
    mechanism["joints"] = [joints["A"], {**without(joints["D"], "angle"), **second}]


def without(table, key):
    return {name: value for name, value in table.items() if name != key}


@pytest.mark.long
def test_bearing_stiffness(run_command):
    """All tasks, one after the other."""
    out, said = run_command("run", reduced("bearing_stiffness/study.toml", change=shaft_in_two_bearings))
    cases = json.loads((out / "results.json").read_text())["cases"]
    assert all(case["status"] == "ok" for case in cases.values())
    # Tilting springs of both bearings, and the shaft between springs across: it turns by a part of the tilt.
    radial, tilt, angle = 1e8, 1200.0, math.radians(0.5)
    turned = tilt * angle / (2.0 * tilt + 0.5 * radial * 0.05**2)
    for case in ("tilted_x", "tilted_z"):
        moment = cases[case]["joints"]["D"]["preload_moment"]
        assert math.hypot(*moment) == pytest.approx(tilt * (angle - turned), rel=1e-4)
    check_tasks(out, said, 8)
    rows = json.loads((out / "allocation.json").read_text())
    assert rows["status"] == "ok"


def check_tasks(out, said, samples, more=frozenset()):
    """Every task wrote its files; no sample failed."""
    files = {path.stem for path in out.glob("*.json")}
    assert files == {"results", "sensitivity", "monte_carlo", "allocation", *more}
    with open(out / "monte_carlo.csv", newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == samples and {row["status"] for row in rows} == {"0"}
    for word in ("Sensitivities of order", "limit", "Allocation ("):
        assert word in said


@pytest.mark.slow
def test_check(run_program, tmp_path):
    """What was understood, what it will cost, and the largest stable step."""
    file = tmp_path / "study.toml"
    file.write_text(reduced("four_bar/study.toml"), encoding="utf-8")
    said = run_program("rfem_jax.report.command_line", "check", file)
    for word in ("crank", "coupler", "rocker", "P5", "rank", "computed together", "Largest stable step"):
        assert word in said
    assert [path.name for path in tmp_path.iterdir()] == ["study.toml"]


def test_keys(run_program):
    """All keys that the study files of this repository use are in the reference."""
    said = run_program("rfem_jax.report.command_line", "keys")
    for name in FILES:
        for table, content in tomllib.loads((STUDIES / name).read_text(encoding="utf-8")).items():
            keys = content if isinstance(content, dict) and table not in ("tolerances", "design") else ()
            assert [key for key in (table, *keys) if key not in said] == []


@pytest.mark.slow
def test_validate(run_program, tmp_path):
    said = run_program("rfem_jax.report.command_line", "validate", "--only", "elastica", "--out", tmp_path)
    assert "Elastica" in said and "0 not met for a known reason, 0 fail" in said
    assert {".json", ".csv", ".png"} <= {path.suffix for path in tmp_path.iterdir()}
