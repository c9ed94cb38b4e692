"""188 wrong study files and the sentences that reading them gives, word for word.

`wrong_studies.json` holds, for each, which study it is made of, by which edits, and what is told; a sentence that
changes on purpose is changed there by hand. Lists that grow with every new force, drive, section, method or key of a
long table are not written out there (`CATALOGUES`, `LONG_LIST`).
"""

import copy
import json
import re
import tomllib
from pathlib import Path

import pytest

from rfem_jax import InputError, load_study
from rfem_jax.description.methods import METHOD_CLASSES, setting_names
from rfem_jax.description.study_file.force_reader import FORCES
from rfem_jax.description.study_file.study_reader import DRIVES, SHAPES

from .mutated_studies import toml_of

HERE = Path(__file__).parent
STARTING = HERE.parents[1] / "rfem_jax" / "report" / "starting_studies"
WRONG = json.loads((HERE / "wrong_studies.json").read_text(encoding="utf-8"))
CATALOGUES = {
    ", ".join(f'"{name}"' for name in known): f"({words})"
    for words, known in (("forces", FORCES), ("drives", DRIVES), ("shapes", SHAPES), ("methods", METHOD_CLASSES))
} | {", ".join(f"`{name}`" for name in setting_names()): "(settings of methods)"}
LONG_LIST = re.compile(r"known are `.*` and more")

# The study `whole` is the four-bar, and this.
ADDED = """
metrics = ["A.rms_force", "*.rms_moment"]
note = "of a test"
[mechanism.materials.bronze]
youngs_modulus = "110 GPa"
shear_modulus = "41 GPa"
density = "8.8 g/cm^3"
[mechanism.sections.round]
shape = "circle"
diameter = "10 mm"
[mechanism.sections.pipe]
shape = "tube"
outer_diameter = "20 mm"
wall = "2 mm"
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
[[mechanism.links]]
name = "flap"
length = "80 mm"
body = { mass = "0.2 kg", centre = ["40 mm", 0, 0], inertia = [1e-4, 1e-4, 1e-4] }
point_masses = [{ mass = "20 g", position = "5 cm" }]
[[mechanism.joints]]
name = "F"
parent = "base"
child = "flap"
position = [1.0, 0.0, 0.0]
bearing = { dynamic_capacity = "10 kN", static_capacity = "5 kN" }
stiffness = { radial = "1e6 N/m", axial = "1e6 N/m" }
damping = { radial = 100.0 }
spring = { stiffness = "2 N m/rad", damping = 0.01 }
friction = { constant = "0.1 N m", sliding_rate = "1 rad/s" }
[[mechanism.links]]
name = "lever"
length = "80 mm"
section = "round"
material = "bronze"
rigid = true
[[mechanism.joints]]
name = "L"
parent = "base"
child = "lever"
position = [2.0, 0.0, 0.0]
clearance = { radial = "0.1 mm", length = "10 mm", stiffness = "60 kN/mm^1.5" }
[[mechanism.springs]]
name = "pull"
links = ["base", "flap"]
points = [[1.0, 0.0, 0.2], [0.08, 0.0, 0.0]]
stiffness = "100 N/m"
free_length = "0.1 m"
[[mechanism.forces]]
name = "stop"
kind = "joint_table"
joint = "F"
positions = ["-10 deg", "10 deg"]
forces = [1.0, -1.0]
[[mechanism.forces]]
name = "push"
link = "flap"
position = [0.04, 0.0, 0.0]
force = [0.0, 0.0, "-2 N"]
[design]
"bar.width" = ["8 mm", "12 mm"]
"bronze.density" = "8.7 g/cm^3"
[tolerances]
"D.delta_x" = "0.25 deg"
"D.delta_z" = { half_width = "0.5 deg", distribution = "truncated_normal", deviations = 2 }
"D.d_y" = { interval = ["-0.1 mm", "0.3 mm"], distribution = "triangular" }
"C.position" = "0.1 mm"
[[tolerances.correlated]]
half_widths = { "B.d_x" = "0.3 mm", "B.d_z" = "0.6 mm" }
correlation = 0.5
[sensitivity]
metrics = ["*.mean_square_moment", "D.mean_square_moment", "end_energy"]
at = { "D.delta_x" = "0.1 deg" }
half_step = true
[monte_carlo]
n = 64
limits = { "*.rms_moment" = 3.0, "angle_error" = [-1.0, inf] }
[worst_case]
metrics = "D.mean_square_force"
starts = { corners = 2 }
[sweep]
metrics = ["A.rms_force"]
levels = 2
[reliability]
limits = { "D.rms_moment" = 3.0 }
[allocation]
limits = { "D.mean_square_moment" = 10.0 }
scales = [0.5, 2]
[allocation.bounds]
"D.delta_x" = ["0.05 deg", "1 deg"]
"B.d_x" = ["0.05 mm", "1 mm"]
[allocation.cost]
model = "reciprocal"
price = 2
"B.d_x" = { model = "exponential", at = "0.2 mm" }
[optimise]
robust = "nominal"
objective = { "mass" = 1.0 }
limits = { "A.rms_force" = 100.0 }
"""


def together(one, other):
    """Two documents as one: tables with the keys of both, lists with the entries of both."""
    if isinstance(one, dict) and isinstance(other, dict):
        return {**one, **{key: together(one[key], other[key]) if key in one else other[key] for key in other}}
    return one + other


@pytest.fixture(scope="module")
def studies():
    found = {path.stem: tomllib.loads(path.read_text(encoding="utf-8")) for path in STARTING.glob("*.toml")}
    return found | {"whole": together(found["four_bar"], tomllib.loads(ADDED))}


def edited(content, edits):
    """The document after edits (what is done, where, and with which key or value)."""
    content = copy.deepcopy(content)
    for act, (*owners, key), *new in edits:
        owner = content
        for one in owners:
            owner = owner[one]
        if act == "set":
            owner[key] = new[0]
        elif act == "delete":
            del owner[key]
        elif act == "twice":
            owner.insert(key, owner[key])
        else:
            items = [(new[0] if name == key else name, value) for name, value in owner.items()]
            owner.clear()
            owner.update(items)
    return content


def told(content, path):
    """The sentences that reading a file gives, without the name of the file."""
    path.write_text(toml_of(content), encoding="utf-8")
    try:
        load_study(path)
    except InputError as error:
        return [without_lists(one.removeprefix(f"Study file `{path}`: ")) for one in error.problems]
    return []


def without_lists(sentence):
    """A sentence whose lists of all that is known are replaced by words in brackets."""
    for listed, words in CATALOGUES.items():
        sentence = sentence.replace(listed, words)
    return LONG_LIST.sub("known are (many)", sentence)


def test_the_studies_are_right_before_they_are_edited(studies, tmp_path):
    assert [told(content, tmp_path / "study.toml") for content in studies.values()] == [[]] * len(studies)


@pytest.mark.wrong_types
@pytest.mark.parametrize("number", range(len(WRONG)))
def test_sentences_of_a_wrong_study(number, studies, tmp_path):
    wrong = WRONG[number]
    assert told(edited(studies[wrong["study"]], wrong["edits"]), tmp_path / "study.toml") == wrong["told"], wrong[
        "edits"
    ]
