"""Study files: the project's own, every key, and every way to get one wrong."""

import math
import re
import tomllib
from dataclasses import replace
from pathlib import Path

import jax
import pytest

from rfem_jax import (
    Case,
    Circle,
    GivenSection,
    InputError,
    MomentRamp,
    MomentTable,
    PrescribedRate,
    PrescribedSpinUp,
    PrescribedTable,
    Rectangle,
    Study,
    Tube,
    load_study,
)
from rfem_jax.description import nearest

STUDIES = Path(__file__).parents[2] / "studies" / "four_bar"
TEXT = (STUDIES / "study.toml").read_text(encoding="utf-8")

FULL = """
title = "Everything a file may hold"
[mechanism]
gravity = [0, 0, "-9.81 m/s^2"]
redundant_reactions = "minimum_norm"
reaction_length = "150 mm"
[mechanism.materials.steel]
youngs_modulus = 2.1e11
shear_modulus = "81 GPa"
density = "7.85 g/cm^3"
[mechanism.sections.round]
shape = "circle"
diameter = "10 mm"
[mechanism.sections.pipe]
shape = "tube"
outer_diameter = "20 mm"
wall = "2 mm"
shear_factor = 1.9
[mechanism.sections.own]
shape = "given"
axial_stiffness = 52.99e6
shear_stiffness_y = 16.88e6
shear_stiffness_z = 16.88e6
torsion_stiffness = 733.5
bending_stiffness_y = 1131
bending_stiffness_z = "1131 N m^2"
line_density = 1.997
rotary_inertia_x = 85.2e-6
rotary_inertia_y = 42.6e-6
rotary_inertia_z = 42.6e-6
damping = "1 us"
[[mechanism.links]]
name = "one"
length = "12 cm"
section = "round"
material = "steel"
rigid = true
point_masses = [{mass = "20 g", position = "5 cm"}, {mass = 0.1, position = [0, 0, 1e-3]}]
[[mechanism.links]]
name = "two"
length = 0.3
section = "pipe"
material = "steel"
rfes = 9
[[mechanism.links]]
name = "three"
length = 0.3
section = "own"
[[mechanism.joints]]
name = "A"
parent = "base"
child = "one"
position = ["1 mm", 0, 0]
orientation = [0, 0, "5 deg"]
child_position = [0.01, 0, 0]
child_orientation = ["1 deg", 0, 0]
angle = 0.5
[[mechanism.joints]]
name = "B"
parent = "one"
child = "two"
[[mechanism.joints]]
name = "C"
parent = "two"
child = "three"
[[mechanism.joints]]
name = "D"
parent = "base"
child = "three"
cut = true
[drive]
joint = "A"
kind = "prescribed_rate"
rate = "60 rpm"
rise_time = "10 ms"
[simulation]
duration = "1 s"
method = "dopri8"
rtol = 1e-8
atol = 1e-10
stabilisation = 0.1
save_every = "1 ms"
[[cases]]
name = "tilt-1.5_deg"
[cases.errors]
"A.pin_tilt_x" = "1.5 deg"
"two.length" = 1e-4
"B.child.d_y" = "-0.1 mm"
"""


@pytest.fixture
def load(tmp_path):
    """Load a study from text."""

    def load_text(text):
        path = tmp_path / "study.toml"
        path.write_text(text, encoding="utf-8")
        return load_study(path)

    return load_text


def test_the_main_study():
    study = load_study(str(STUDIES / "study.toml"))
    assert study.title == "Steel four-bar with assembly errors at joint D"
    assert study.path == STUDIES / "study.toml"
    assert [link.name for link in study.mechanism.links] == ["crank", "coupler", "rocker"]
    assert [link.length for link in study.mechanism.links] == [0.12, 0.30, 0.30]
    assert [link.elements for link in study.mechanism.links] == [1, 5, 5]
    assert study.mechanism.link("rocker").section == Rectangle(0.01, 0.01, 1.2)
    assert study.mechanism.link("crank").material.youngs_modulus == 210e9
    assert study.mechanism.link("coupler").properties.damping == 1e-5
    assert [joint.name for joint in study.mechanism.cut_joints] == ["C"]
    angles = [math.degrees(joint.angle) for joint in study.mechanism.tree_joints]
    assert angles == pytest.approx([-90.0, -100.8, 54.4], rel=1e-15)
    assert study.mechanism.driven_joint == "A"
    assert isinstance(study.drive, MomentRamp) and study.drive.breakpoints() == (0.1,)
    assert float(study.drive.moment) == 1.5
    assert (study.duration, study.save_every) == (0.5, 1e-3)
    assert (study.method.name, study.method.step) == ("rk4", 1e-5)
    half = math.radians(0.5)
    assert {case.name: case.errors for case in study.cases} == {
        "P1": {},
        "P2": {"D.delta_x": half},
        "P3": {"D.delta_z": half},
        "P4": {"D.d_y": 5e-4},
        "P5": {"D.delta_x": half, "D.delta_z": half, "D.d_y": 5e-4},
    }
    assert study.case("P4").errors == {"D.d_y": 5e-4}


def test_the_undamped_study_differs_in_title_and_damping_only():
    damped = tomllib.loads(TEXT)
    undamped = tomllib.loads((STUDIES / "undamped.toml").read_text(encoding="utf-8"))
    assert undamped["mechanism"]["materials"]["steel"].pop("damping") == 0.0
    assert damped["mechanism"]["materials"]["steel"].pop("damping") == 1e-5
    assert undamped.pop("title") != damped.pop("title")
    assert undamped == damped
    assert load_study(STUDIES / "undamped.toml").mechanism.link("rocker").properties.damping == 0.0


def test_both_files_say_that_they_are_a_substitute():
    for path in STUDIES.glob("*.toml"):
        assert "SUBSTITUTE" in path.read_text(encoding="utf-8").split("title")[0]


def test_every_key(load):
    study = load(FULL)
    mechanism = study.mechanism
    assert mechanism.redundant_reactions == "minimum_norm" and mechanism.norm_length == 0.15
    assert mechanism.gravity == (0.0, 0.0, -9.81)
    assert mechanism.link("one").section == Circle(0.01)
    assert mechanism.link("two").section == Tube(0.02, 0.002, 1.9)
    assert isinstance(mechanism.link("three").section, GivenSection)
    assert mechanism.link("three").properties.damping == 1e-6
    assert mechanism.link("one").material.modulus_of_rigidity == 81e9
    assert [mass.mass for mass in mechanism.link("one").point_masses] == [0.02, 0.1]
    assert mechanism.link("two").elements == 9
    joint = mechanism.joint("A")
    assert joint.position == (0.001, 0.0, 0.0) and joint.child_position == (0.01, 0.0, 0.0)
    assert joint.orientation[2] == math.radians(5) and joint.angle == 0.5
    assert joint.child_orientation[0] == math.radians(1)
    assert isinstance(study.drive, PrescribedRate) and study.drive.breakpoints() == (0.01,)
    assert float(study.drive.rate) == pytest.approx(2 * math.pi)
    assert study.method.adaptive and study.method.stabilisation == 0.1
    assert study.case("tilt-1.5_deg").errors == {
        "A.pin_tilt_x": math.radians(1.5),
        "two.length": 1e-4,
        "B.child.d_y": -1e-4,
    }


def test_other_drives_and_what_may_be_left_out(load):
    start, end = FULL.index("[drive]"), FULL.index("[simulation]")
    head = FULL[:start] + '[drive]\njoint = "A"\n'
    table = 'kind = "moment_table"\ntimes = [0, 1]\nmoments = [0, "1 N m"]\n'
    assert isinstance(load(head + table + FULL[end:]).drive, MomentTable)
    table = 'kind = "prescribed_table"\ntimes = [0, 2]\nangles = [0, "1 rev"]\n'
    assert isinstance(load(head + table + FULL[end:]).drive, PrescribedTable)
    table = 'kind = "prescribed_spin_up"\nrate = "60 rpm"\nrise_time = 0.2\n'
    assert isinstance(load(head + table + FULL[end:]).drive, PrescribedSpinUp)
    bare = FULL[:start] + "[simulation]\nduration = 1\nstep = 1e-5\n"
    study = load(bare.replace('title = "Everything a file may hold"', ""))
    assert study.drive is None and study.mechanism.driven_joint is None
    assert study.save_every is None and study.title == "study"
    assert study.cases == (Case("nominal"),)
    assert study.method.name == "rk4"
    assert load(bare.replace("step = 1e-5\n", "")).method.name == "auto"
    with jax.enable_x64(False):
        assert load(bare).drive is None


@pytest.mark.parametrize("line", [line for line in FULL.splitlines() if re.match(r"\w+ = ", line)])
def test_every_misspelt_key_is_refused_with_the_nearest(load, refused, line):
    """Each key of the full file in turn, with a letter doubled."""
    key = line.split(" = ")[0]
    misspelt = key + key[-1]
    with refused("Study file", f"`{misspelt}`", f"did you mean `{key}`?"):
        load(FULL.replace(f"\n{line}\n", f"\n{misspelt}{line[len(key) :]}\n", 1))


def changed(old, new):
    assert TEXT.count(old) >= 1, old
    return TEXT.replace(old, new, 1)


@pytest.mark.parametrize(
    ("text", "pieces"),
    [
        # keys
        (TEXT + "[plots]\nsize = 1\n", ("The top level", "`plots`")),
        (TEXT + "[driv]\n", ("`driv`", "did you mean `drive`?")),
        (TEXT + "[tolerances]\n", ("[tolerances]", "no error is named")),
        (TEXT.split("[simulation]")[0], ("The top level", "`simulation`", "missing")),
        ("title = 'x'\n[simulation]\nduration = 1\n", ("`mechanism`", "missing")),
        (changed("duration = 0.5\n", ""), ("[simulation]", "`duration`", "missing")),
        (changed('kind = "moment_ramp"\n', ""), ("[drive]", "`kind`", "missing")),
        (changed('joint = "A"\n', ""), ("[drive]", "moment_ramp", "`joint`", "missing")),
        (changed("rise_time = 0.1\n", ""), ("[drive]", "`rise_time`", "missing")),
        (changed('shape = "rectangle"\n', ""), ("[mechanism.sections.bar]", "`shape`", "missing")),
        (changed("length = 0.12\n", ""), ("links]] `crank`", "`length`", "missing")),
        (changed('parent = "crank"\n', ""), ("joints]] `B`", "`parent`", "missing")),
        (changed('name = "P3"\n', ""), ("[[cases]] number 3", "`name`", "missing")),
        (changed('name = "crank"\n', ""), ("[[mechanism.links]] number 1", "`name`", "missing")),
        # kinds of tables
        ("cases = 3\n" + TEXT.split("[[cases]]")[0], ("[[cases]]", "list of tables")),
        ("drive = 3\n" + TEXT[: TEXT.index("[drive]")] + TEXT[TEXT.index("[simulation]") :], ("[drive]", "table")),
        (changed("[drive]", "[[drive]]"), ("[drive]", "table")),
        (TEXT.replace("[[mechanism.links]]", "[mechanism.links.x]", 1), ("TOML", "line")),
        ("title = 3\n" + TEXT.replace("title =", "#", 1), ("`title`", "3")),
        # values
        (changed('"rectangle"', '"square"'), ("[mechanism.sections.bar]", "`shape`", "square")),
        (changed('"moment_ramp"', '"moment_rmp"'), ("[drive]", "did you mean `moment_ramp`?")),
        (changed('section = "bar"', 'section = "baar"'), ("`crank`", "did you mean `bar`?")),
        (changed('material = "steel"', 'material = "stel"'), ("`crank`", "`steel`?")),
        (changed('material = "steel"\n', ""), ("`crank`", "`material`")),
        (changed('"10 mm"', '"10 mmm"'), ("[mechanism.sections.bar]", "`width`", "mmm")),
        (changed('"10 mm"', '"-10 mm"'), ("`width`", "greater than 0")),
        (changed('"210 GPa"', '"210 GN"'), ("[mechanism.materials.steel]", "known unit", "GN")),
        (changed("length = 0.12", "length = -0.12"), ("links]] `crank`", "greater than 0")),
        (changed("length = 0.12", "length = nan"), ("`crank`", "finite")),
        (changed("length = 0.12", "length = 2020-01-01"), ("`crank`", "number")),
        (changed("rfes = 5", "rfes = 0"), ("`coupler`", "`rfes`")),
        (changed("rigid = true", "rigid = true\nrfes = 5"), ("`crank`", "`rfes`", "rigid")),
        (changed("rigid = true", "rigid = 1"), ("`crank`", "`rigid`", "true or false")),
        (changed("cut = true", 'cut = true\nangle = "1 deg"'), ("joints]] `C`", "`angle`")),
        (changed("cut = true", "cut = false"), ("[mechanism]", "cut = true")),
        (changed('parent = "crank"', 'parent = "krank"'), ("[mechanism]", "`B`", "`crank`?")),
        (changed("step = 1e-5", "step = 1.0"), ("`step`", "duration")),
        (changed("step = 1e-5\n", ""), ("[simulation]", "`step`")),
        (changed('"rk4"', '"rk5"'), ("[simulation]", "did you mean `rk4`?")),
        (changed("save_every = 1e-3", "save_every = 1e-6"), ("`save_every`", "less than the step")),
        (changed("save_every = 1e-3", "save_every = 1"), ("`save_every`", "duration")),
        (changed("save_every = 1e-3", "save_every = 0"), ("`save_every`", "greater than 0")),
        (changed("duration = 0.5", 'duration = "0.5 m"'), ("`duration`", "a length")),
        (changed('joint = "A"', 'joint = "E"'), ("`joint` of the drive", "`E`")),
        (changed('joint = "A"', 'joint = "C"'), ("`joint` of the drive", "cut joint")),
        # cases
        (changed('"D.delta_x" =', '"D.delta_y" ='), ("`P2`", "`D.delta_y`", "`D.delta_")),
        (changed('"D.delta_x" =', '"E.delta_x" ='), ("case `P2`", "did you mean `")),
        (changed('"D.delta_x" =', '"croupler.twist" ='), ("`P2`", "did you mean `coupler.twist`?")),
        (changed('"D.delta_x" =', "D.delta_x ="), ("`P2`", "dot")),
        (changed('"0.5 deg"', '"0.5 mm"'), ("`D.delta_x` of case `P2`", "an angle", "a length")),
        (changed('"0.5 deg"', '"0.5"'), ("`D.delta_x` of case `P2`", "without quotes")),
        (changed('errors = { "D.d_y" = "0.5 mm" }', "errors = 3"), ("`P4`", "table")),
        (changed('name = "P3"', 'name = "P2"'), ("`P2`", "twice")),
        (changed('name = "P3"', 'name = "p2"'), ("`p2`", "upper and lower case")),
        (changed('name = "P3"', 'name = "P/3"'), ("'P/3'", "file name")),
        (changed('name = "P3"', 'name = "../P3"'), ("file name",)),
        (changed('name = "P3"', 'name = ""'), ("file name",)),
        # TOML itself
        (changed("rise_time = 0.1", "rise_time = 0.1 s"), ("valid TOML", "line")),
        (changed("rise_time = 0.1", "rise_time = 0.1\nrise_time = 0.1"), ("valid TOML",)),
    ],
)
def test_what_is_wrong_in_a_file_is_refused_in_one_sentence(load, refused, text, pieces):
    with refused(*pieces):
        load(text)


def test_the_line_of_a_syntax_error_is_named(load):
    line = TEXT[: TEXT.index("rise_time")].count("\n") + 1
    with pytest.raises(InputError, match=f"line {line}, column"):
        load(changed("rise_time = 0.1", "rise_time = 0.1 s"))


def test_a_mark_of_an_editor_is_no_text(load):
    assert load("\ufeff" + TEXT).title == load(TEXT).title


def test_files_that_cannot_be_read(refused, tmp_path):
    with refused("`path`", "there is no file", "absent.toml"):
        load_study(tmp_path / "absent.toml")
    with refused("readable", "directory"):
        load_study(tmp_path)
    (tmp_path / "latin.toml").write_bytes("title = 'Gr\u00fc\u00dfe'".encode("latin-1"))
    with refused("UTF-8"):
        load_study(tmp_path / "latin.toml")


def test_a_prescribed_table_must_reach_the_end(load, refused):
    start, end = TEXT.index("[drive]"), TEXT.index("[simulation]")
    table = '[drive]\njoint = "A"\nkind = "prescribed_table"\ntimes = [0, 0.4]\nangles = [0, 1]\n'
    with refused("`times` of the drive", "0.5 s", "0.4 s"):
        load(TEXT[:start] + table + TEXT[end:])


def test_a_study_in_python_is_checked_too(refused):
    study = load_study(STUDIES / "study.toml")
    assert isinstance(replace(study, duration="100 ms"), Study)
    for name, value in (("drive", "A"), ("method", "rk4"), ("mechanism", None), ("cases", ["P1"])):
        with refused(f"`{name}`"):
            replace(study, **{name: value})
    with refused("`P1`", "twice"):
        replace(study, cases=[Case("P1"), Case("P1")])
    with refused("`P6`", "known are `P1`, `P2`"):
        study.case("P6")
    with refused("`errors` of case `P1`", "`D.d_y`?"):
        replace(study, cases=[Case("P1", {"DD.d_y": 1e-3})])


def test_nearest():
    assert nearest("lenght", ["width", "length"]) == "length"
    assert nearest("LENGTH", ["width", "length"]) == "length"
    assert nearest("xyz", ["width", "length"]) is None
    assert nearest("a", []) is None


WRONG = (  # what is changed in the main study, and what the line about it holds
    ("gravity = [0.0, 0.0, -9.81]", "gravty = [0.0, 0.0, -9.81]", ("[mechanism]", "`gravty`", "`gravity`?")),
    ('joint = "A"\nkind', 'joint = "A"\nrise = 1\nkind', ("[drive]", "`rise`")),
    ("step = 1e-5\n", 'step = "1 mm"\n', ("[simulation]", "`step`", "time")),
    ('name = "P3"', 'name = "P/3"', ("'P/3'", "file name")),
    ('"D.d_y" = "0.5 mm"', '"D.d_y" = "0.5 deg", "D.delta" = 1', ("`D.d_y` of case `P4`", "a length")),
    ("", '\n[tolerances]\n"D.d_y" = -1\n"D.d_q" = 1\n[monte_carlo]\nn = 1', ("`half_width`", "-1")),
)


def test_all_mistakes_are_reported_at_once(load):
    text = TEXT
    for old, new, _ in WRONG:
        text = text.replace(old, new, 1) if old else text + new
    with pytest.raises(InputError) as caught:
        load(text)
    lines = str(caught.value).splitlines()
    assert lines == list(caught.value.problems)
    assert all(line.startswith("Study file `") for line in lines)
    for pieces in (*(pieces for *_, pieces in WRONG), ("Case `P4`", "`delta`"), ("`d_q`",), ("[monte_carlo]", "`n`")):
        assert len([line for line in lines if all(piece in line for piece in pieces)]) == 1, (pieces, lines)
    assert len(lines) == len(WRONG) + 3


def test_mistakes_of_the_mechanism_are_reported_together(load):
    text = changed('width = "10 mm"', 'width = "-10 mm"').replace('"210 GPa"', '"210 GN"', 1)
    text = text.replace("length = 0.12", "length = -0.12", 1).replace("cut = true", "cut = 1", 1)
    with pytest.raises(InputError) as caught:
        load(text)
    # Links of a section with a mistake tell their own mistakes only.
    places = [line.split(": ")[1] for line in caught.value.problems]
    links = ["[[mechanism.links]] `crank`", "[[mechanism.joints]] `C`"]
    assert places == ["[mechanism.materials.steel]", "[mechanism.sections.bar]", *links]
    with pytest.raises(InputError) as caught:
        load(changed("length = 0.12", "length = -0.12").replace("rfes = 5", "rfes = 0", 2))
    assert [line.split(": ")[1].split("`")[1] for line in caught.value.problems] == ["crank", "coupler", "rocker"]


def test_a_wrong_shape_is_told_with_all_keys_that_do_not_fit(load):
    with pytest.raises(InputError) as caught:
        load(changed('shape = "rectangle"', 'shape = "circle"'))
    keys = [re.search("`(width|height|diameter)`", line).group(1) for line in caught.value.problems]
    assert keys == ["width", "height", "diameter"]
    assert all('[mechanism.sections.bar] of shape "circle"' in line for line in caught.value.problems)


def test_parts_that_do_not_fit_are_reported_together(load):
    text = changed('joint = "A"\nkind', 'joint = "C"\nkind').replace("save_every = 1e-3", "save_every = 1", 1)
    text = text.replace('"D.delta_x" =', '"E.delta_x" =', 1).replace('"D.d_y" =', '"E.d_y" =', 1)
    with pytest.raises(InputError) as caught:
        load(text + '[tolerances]\n"Q.d_y" = "1 mm"\n')
    for word in ("`save_every`", "cut joint", "`E.delta_x`", "`E.d_y`", "`Q.d_y`"):
        assert sum(word in line for line in caught.value.problems) == 1, word
    assert len(caught.value.problems) == 5
