"""The page as a file: what it holds, what it lets through, and from which files. `tests/browser` opens it."""

import base64
import hashlib
import json
import re
import shutil
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rfem_jax import InputError, load_study
from rfem_jax.report.command_line import main
from rfem_jax.report.commands.steps import write_page
from rfem_jax.report.page.animation import FILE, pack_animation, quaternions_of, read_animation, rotation_vectors
from rfem_jax.report.page.document import ASSETS, LIBRARY, SCRIPTS, page_text, write_folder
from rfem_jax.report.page.histories import quantities_of, read_table
from rfem_jax.report.page.packing import MISSING, pack_floats, pack_integers, some_rows

from .conftest import STUDY, synthetic_run
from .page_folder import BEND, animation, content_of, write_results

HOSTILE = '</script><script>alert(1)</script><!-- <img src=x onerror=alert(2)> & "\u2028'


@pytest.fixture
def folder(written, tmp_path):
    return Path(shutil.copytree(written, tmp_path / "out"))


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """The synthetic study of `conftest`, written once."""
    folder = tmp_path_factory.mktemp("written")
    (folder / "study.toml").write_text(STUDY, encoding="utf-8")
    runs = {f"P{i}": synthetic_run(size) for i, size in ((1, 0.0), (2, 2.0), (3, 1.0))}
    return write_results(folder / "out", load_study(folder / "study.toml"), runs)


class Elements(HTMLParser):
    """All start tags of a page with their attributes, and the texts of scripts and styles."""

    def __init__(self, text):
        super().__init__()
        self.tags, self.texts, self.open = [], [], None
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        self.open = tag if tag in ("script", "style") else None
        if self.open:
            self.texts.append([tag, dict(attrs), ""])

    def handle_endtag(self, tag):
        self.open = None

    def handle_data(self, data):
        if self.open:
            self.texts[-1][2] += data


def unpacked(packed):
    """A packed array as the script reads it."""
    raw = base64.b64decode(packed["data"])
    if packed["type"] == "f4":
        return np.frombuffer(raw, "<f4").reshape(packed["shape"])
    numbers = np.frombuffer(raw, "<i2").reshape(packed["shape"])
    return np.where(numbers == MISSING, np.nan, numbers * packed["scale"])


def test_the_page_has_the_numbers_of_the_files(folder):
    content = content_of(write_folder(folder))
    results = json.loads((folder / "results.json").read_text(encoding="utf-8"))
    assert [case["name"] for case in content["cases"]] == list(results["cases"])
    for case in content["cases"]:
        joints = {row["name"]: row for row in case["joints"]}
        for joint, row in results["cases"][case["name"]]["joints"].items():
            assert {key: joints[joint][key] for key in row} == row
        assert case["numbers"]["energy_balance_error"] == results["cases"][case["name"]]["energy_balance_error"]
    assert content["cases"][2]["errors"] == [["D.d_y", 0.0005, "m"], ["coupler.length", -0.0001, "m"]]
    table = read_table(folder / "P2.csv")
    assert table is not None
    quantities = {one["label"]: one for one in content["histories"]["quantities"]}
    values = unpacked(content["histories"]["cases"][1]["values"])
    for label, unit, names in (
        ("Force in D", "N", ["D_force_x_N", "D_force_y_N", "D_force_z_N"]),
        ("Moment in C", "N m", ["C_moment_x_Nm", "C_moment_y_Nm", "C_moment_z_Nm"]),
        ("Rate", "rad/s", ["rate_rad_s"]),
        ("D angle", "rad", ["D_angle_rad"]),
        ("Kinetic energy", "J", ["kinetic_J"]),
        ("Drive moment", "N m", ["drive_moment_Nm"]),
    ):
        assert quantities[label]["unit"] == unit, label
        for column, name in zip(quantities[label]["columns"], names, strict=True):
            np.testing.assert_allclose(values[column], table[name], rtol=1e-6)


def test_policy_lets_nothing_run_but_this_package(folder):
    elements = Elements(write_folder(folder).read_text(encoding="utf-8"))
    policy = next(attrs["content"] for tag, attrs in elements.tags if attrs.get("http-equiv"))
    assert policy.startswith("default-src 'none'; ")
    allowed = dict(part.split(" ", 1) for part in policy.split("; "))
    executed = [text for tag, attrs, text in elements.texts if tag == "script" and "type" not in attrs]
    styles = [text for tag, _, text in elements.texts if tag == "style"]
    for texts, directive in ((executed, "script-src"), (styles, "style-src")):
        assert len(texts) == 1
        digest = base64.b64encode(hashlib.sha256(texts[0].encode()).digest()).decode()
        assert allowed[directive] == f"'sha256-{digest}'"
    assert not [(tag, attrs) for tag, attrs in elements.tags if {"src", "href", "style", "onload"} & set(attrs)]
    assert not re.search(r"@import|url\(", styles[0])
    own = "".join((ASSETS / name).read_text(encoding="utf-8") for name in SCRIPTS)
    unsafe = r"outerHTML|insertAdjacentHTML|document\.write|eval\(|new Function|fetch\(|XMLHttpRequest|import\("
    assert not re.search(rf"innerHTML|{unsafe}", own)
    assert not re.search(unsafe, (ASSETS / LIBRARY).read_text(encoding="utf-8"))


def test_every_script_of_the_folder_is_part_of_the_page():
    assert sorted(SCRIPTS) == sorted(path.name for path in ASSETS.glob("*.js"))


def test_hostile_texts_stay_data(folder):
    path = folder / "results.json"
    results = json.loads(path.read_text(encoding="utf-8"))
    results |= {"title": HOSTILE, "note": {"a": [HOSTILE]}, "versions": {HOSTILE: HOSTILE}, "method": [HOSTILE]}
    case = results["cases"].pop("P2")
    case |= {"status": HOSTILE, "message": HOSTILE, "errors": {HOSTILE: HOSTILE}, "branch": HOSTILE}
    case["joints"] |= {HOSTILE: {"rms_force": HOSTILE}, "no dict": HOSTILE}
    results["cases"] |= {HOSTILE: case, "no dict": 3, "__proto__": {}}
    path.write_text(json.dumps(results), encoding="utf-8")
    page = write_folder(folder)
    elements = Elements(page.read_text(encoding="utf-8"))
    assert [tag for tag, _ in elements.tags].count("script") == 2
    assert not [tag for tag, _ in elements.tags if tag == "img"]
    content = content_of(page)
    assert content["title"] == HOSTILE and content["method"] == []
    assert [case["name"] for case in content["cases"]] == ["P1", "P3", HOSTILE, "__proto__"]
    assert content["animation"] is None  # it is of other cases


@pytest.mark.parametrize("name", ["../secret", "/etc/x", "..", "", "a\0b"])
def test_cases_are_not_read_from_outside_the_folder(folder, name):
    (folder.parent / "secret.csv").write_text("time_s,rate_rad_s\n0,1\n", encoding="utf-8")
    results = {"cases": {name: {"joints": {}}}}
    (folder / "results.json").write_text(json.dumps(results), encoding="utf-8")
    assert content_of(write_folder(folder))["histories"] is None


def test_other_files_than_ours_are_left_out(folder):
    (folder / "P1.csv").write_text("time_s,rate_rad_s\n0,one\n", encoding="utf-8")
    (folder / "P2.csv").write_bytes(b"\xff\xfe\x00")
    (folder / "sensitivity.json").write_text("[1, 2]", encoding="utf-8")
    content = content_of(write_folder(folder))
    assert content["tasks"] == []
    assert [one["case"] for one in content["histories"]["cases"]] == ["P3"]


def pickled(path):
    with path.open("wb") as file:
        np.savez(file, description=np.array({"cases": []}, dtype=object))


def cut(path):
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])


def overwritten(path):
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 0xFF
    path.write_bytes(content)


@pytest.mark.parametrize(
    ("name", "damage"),
    [
        *((FILE, damage) for damage in (pickled, cut, overwritten, lambda path: path.write_bytes(b""))),
        ("results.json", cut),
        ("results.json", overwritten),  # then it is no UTF-8
        ("sensitivity.json", lambda path: path.write_text("[1, 2", encoding="utf-8")),
        ("allocation.json", lambda path: path.write_text("[" * 100_000, encoding="utf-8")),
    ],
)
def test_damaged_files_are_named_in_one_sentence(folder, capsys, name, damage):
    damage(folder / name)
    assert main(["report", str(folder)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert f"`{folder / name}` is damaged" in line and "compute it again" in line
    if name != FILE:
        assert main(["compare", str(folder), str(folder)]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert name in line


def test_a_damaged_file_of_another_task_loses_no_results(folder, capsys):
    (folder / "sensitivity.json").write_text("[1, 2", encoding="utf-8")
    assert write_page(folder) == []
    assert "report.html is not written" in capsys.readouterr().err


def test_arrays_of_another_size_are_refused(folder, study, runs):
    description, cases = animation(study, runs)
    assert read_animation(folder) is not None
    cases[1]["points"] = cases[1]["points"][:, :-1]
    arrays = {f"{i}_{part}": values for i, case in enumerate(cases) for part, values in case.items()}
    np.savez(folder / FILE, description=np.array(json.dumps(description)), **arrays)
    with pytest.raises(InputError, match="is damaged"):
        read_animation(folder)


def test_the_command_writes_the_page_again(folder, capsys):
    path = write_folder(folder)
    before = path.read_bytes()
    path.unlink()
    assert main(["report", str(folder)]) == 0
    assert path.read_bytes() == before and str(path) in capsys.readouterr().out


@pytest.mark.parametrize("name", [".", "missing"])
def test_the_command_refuses_a_folder_without_results(tmp_path, capsys, name):
    assert main(["report", str(tmp_path / name)]) == 2
    message = capsys.readouterr().err
    assert "results.json" in message and "--out" in message and not list(tmp_path.iterdir())


def test_a_page_of_the_size_of_the_main_study_is_below_three_megabytes(study, runs):
    """Five cases with 501 saved times and 35 columns, 251 frames of 14 points and 4 joints."""
    description, cases = animation(study, runs)
    long = {part: np.resize(values, (251, *values.shape[1:])) for part, values in cases[2].items()}
    noise = np.random.default_rng(0).normal(size=(35, 501))
    packed = pack_animation({**description, "cases": list("12345")}, 5 * [long])
    content = {"animation": packed, "histories": 5 * [{"times": pack_floats(noise[0]), "values": pack_floats(noise)}]}
    size = len(page_text({"tasks": [], "cases": [], **content}))
    assert 0.5e6 < size < 3e6


def test_deviations_are_those_of_the_arrays(study, runs):
    description, cases = animation(study, runs)
    motion = pack_animation(description, cases)["motions"][2]
    deviation = unpacked(motion["deviation"])
    assert np.abs(deviation).max() == pytest.approx(BEND, rel=1e-2)
    np.testing.assert_allclose(deviation, cases[2]["points"] - cases[2]["nominal_points"], rtol=0, atol=2e-5 * BEND)
    nominal = unpacked(motion["nominal"])
    np.testing.assert_allclose(nominal, cases[2]["nominal_points"], rtol=0, atol=2e-5)
    turned = Rotation.from_quat(unpacked(motion["seat_rotation"]), scalar_first=True).as_matrix()
    np.testing.assert_allclose(turned, cases[2]["seat_rotation"].reshape(turned.shape), rtol=0, atol=2e-4)


def test_quaternions_and_rotation_vectors_are_those_of_scipy():
    vectors = np.random.default_rng(3).normal(size=(200, 3))
    vectors *= np.minimum(1.0, 3.1 / np.linalg.norm(vectors, axis=1, keepdims=True))
    vectors[:3] = [[0.0, 0.0, 0.0], [1e-9, 0.0, 0.0], [0.0, 0.0, 3.1]]
    rotation = Rotation.from_rotvec(vectors)
    q = quaternions_of(rotation.as_matrix())
    wanted = rotation.as_quat(canonical=True, scalar_first=True)
    np.testing.assert_allclose(q, wanted, rtol=0, atol=1e-12)
    np.testing.assert_allclose(rotation_vectors(q), vectors, rtol=0, atol=1e-12)
    assert np.isnan(quaternions_of(np.full((2, 3, 3), np.nan))).all()


def test_missing_numbers_and_rows_in_steps():
    values = np.array([1.0, np.nan, -2.0, np.inf])
    np.testing.assert_allclose(unpacked(pack_integers(values)), [1.0, np.nan, -2.0, np.nan], rtol=1e-4)
    np.testing.assert_array_equal(unpacked(pack_integers(np.zeros(2))), 0.0)
    assert some_rows(10, 4).tolist() == [0, 3, 6, 9] and some_rows(0, 4).tolist() == []
    assert some_rows(11, 4).tolist() == [0, 3, 6, 9, 10]


def test_columns_of_all_kinds_have_names_and_units():
    names = [
        "time_s",
        "coil_length_m",
        "coil_tension_N",
        "G_displacement_m",
        "G_drive_speed_m_s",
        "odd",
        "bearing_dissipation_J",
    ]
    found = {one["label"]: (one["unit"], one["group"]) for one in quantities_of(names, ["A"])}
    assert found == {
        "Coil length": ("m", "Motion"), "Coil tension": ("N", "Drives and forces"), "G displacement": ("m", "Motion"),
        "G drive speed": ("m/s", "Motion"), "Odd": ("", "Drives and forces"), "Bearing dissipation": ("J", "Energy"),
    }  # fmt: skip
