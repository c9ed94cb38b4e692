"""The reference of all keys: what the reader asks for, table by table, with a meaning for each."""

import re
import tomllib

import pytest

from rfem_jax import Circle, Coupling, GivenSection, InputError, load_study
from rfem_jax.description.basics import tables
from rfem_jax.description.study_file import force_reader, study, study_reader
from rfem_jax.description.study_file.key_reference import NEEDED, argument_meanings, key_tables
from rfem_jax.description.study_file.statics import Statics
from rfem_jax.description.tasks import costs
from rfem_jax.description.tolerances import tolerances

from .test_bearings import BEARING
from .test_clearance import CLEARANCE
from .test_compliance import COMPLIANCE
from .test_couplings import COUPLINGS
from .test_distributed_forces import LINES
from .test_force_reader import IN_JOINTS, SPRINGS
from .test_forces import FORCES
from .test_point_forces import FORCES as POINT_FORCES
from .test_study_files import FULL
from .test_tasks import TASKS

POINTS = """
[[mechanism.points]]
name = "P"
link = "one"
position = 0.01
"""
BASE = """
[mechanism.base]
thermal_expansion = "23e-6 1/K"
temperature = "5 K"
"""
MORE = FORCES + POINT_FORCES + LINES + SPRINGS + POINTS + BASE
DRIVES = """
[drive]
joint = "A"
kind = "moment_ramp"
moment = 1
rise_time = 1
[drive]
joint = "A"
kind = "moment_table"
times = [0, 1]
moments = [0, 1]
[drive]
joint = "A"
kind = "prescribed_spin_up"
rate = 1
rise_time = 1
[drive]
joint = "A"
kind = "prescribed_table"
times = [0, 1]
angles = [0, 1]
"""
SLIDES = """
[[drives]]
joint = "G"
kind = "force_ramp"
force = 1
rise_time = 1
[[drives]]
joint = "G"
kind = "force_table"
times = [0, 1]
forces = [0, 1]
[[drives]]
joint = "G"
kind = "prescribed_speed"
speed = 1
[[drives]]
joint = "G"
kind = "prescribed_run_up"
speed = 1
rise_time = 1
[[drives]]
joint = "G"
kind = "prescribed_displacements"
times = [0, 1]
displacements = [0, 1]
"""
OPTIMISE = """
[optimise]
objective = { cost = 1, end_energy = 1 }
[optimise.bounds]
"D.delta_x" = ["0.05 deg", "1 deg"]
"B.d_x" = ["0.05 mm", "1 mm"]
"C.d_x" = [1e-5, 1e-3]
[optimise.cost]
"D.delta_x" = { at = "0.2 deg" }
"""
RECTANGLE = '[mechanism.sections.flat]\nshape = "rectangle"\nwidth = 1e-2\nheight = 1e-2\n'
WALLS = {"hollow_rectangle": "wall", "i_section": "web flange", "channel": "web flange", "tee": "web flange"}
WALLED = "".join(
    f'[mechanism.sections.{shape}]\nshape = "{shape}"\nwidth = 2e-2\nheight = 3e-2\n'
    + "".join(f"{name} = 2e-3\n" for name in names.split())
    for shape, names in {**WALLS, "angle": "wall"}.items()
)
POLYGON = """[mechanism.sections.outline]
shape = "polygon"
points = [[0, 0], ["20 mm", 0], [0, "30 mm"]]
torsion = "9000 mm^4"
shear_factor_y = 1.2
shear_factor_z = 1.2
shear_centre = ["7 mm", "9 mm"]
"""
COMPOSITE = f"""[mechanism.sections.laminate]
shape = "composite"
stiffness = {[[1e6 * (i == j) for j in range(6)] for i in range(6)]}
line_density = 1.0
rotary_inertia_x = 2e-4
rotary_inertia_y = 1e-4
rotary_inertia_z = 1e-4
"""


ZONE = '"A.position" = { diameter = "0.1 mm" }\n'
MORE_TASKS = """
[sweep]
metrics = ["*.rms_moment"]
[reliability]
limits = { "D.mean_square_moment" = 20.0 }
[identification]
data = "measured.csv"
signals = { rate_rad_s = { noise = 0.1 } }
candidates = { A_force_x_N = { noise = "2 N" } }
[identification.measured.fast]
data = "fast.csv"
[identification.correction]
metric = "D.rms_moment"
adjustments = { "D.d_y" = ["-1 mm", "1 mm"] }
"""
ALL_TASKS = TASKS.replace("[[tolerances.correlated]]", f"{ZONE}[[tolerances.correlated]]") + MORE_TASKS


def header_of(place):
    """The header in the reference of a place that the reader names."""
    place = re.sub(r"^The top level$", "top level", place)
    place = re.sub(r"^\[\[mechanism\.links\]\] .* point_masses.*", "point_masses of [[mechanism.links]]", place)
    place = re.sub(r"^\[\[mechanism\.links\]\] .* (stations|axis|camber).*", r"\1 of [[mechanism.links]]", place)
    place = re.sub(r"^\[\[mechanism\.joints\]\] `\w+` (\w+)$", r"\1 of [[mechanism.joints]]", place)
    place = re.sub(r"^\[\[mechanism\.links\]\] .* body$", "body of [[mechanism.links]]", place)
    place = re.sub(r"^\[\[mechanism\.links\]\] .* body (of \w+ files?)$", r"body of [[mechanism.links]], \1", place)
    place = re.sub(r"\[mechanism\.(materials|sections)\.\w+\]", r"[mechanism.\1.NAME]", place)
    place = re.sub(r"^(\[\[[\w.]+\]\]) (`[^`]+`|number \d+)", r"\1", place)
    place = re.sub(r"^(\[drive\]|\[\[drives\]\])", "[drive] or [[drives]]", place)
    place = re.sub(r"^\[tolerances\] `\w+\.position`$", "[tolerances] JOINT.position", place)
    place = re.sub(r"^\[tolerances\] `.*", "[tolerances] ERROR", place)
    place = re.sub(r"^(\[identification\.measured)\.\w+\]$", r"\1.NAME]", place)
    place = re.sub(r"^(\[identification\.(?:signals|candidates))\.\w+\]$", r"\1.COLUMN]", place)
    return re.sub(r"^\[(allocation|optimise)\.cost\] `.*", r"[\1.cost]", place)


@pytest.fixture
def asked(tmp_path, monkeypatch):
    """{header: (required, optional keys)} of all tables that are checked while complete studies are read."""
    found = {}

    def recorded(checked_table):
        def check(data, place, required, optional, problems):
            found[header_of(place)] = set(required), set(optional)
            return checked_table(data, place, required, optional, problems)

        return check

    for module in (study, study_reader, force_reader, tables, tolerances, costs):
        monkeypatch.setattr(module, "checked_table", recorded(module.checked_table))
    sections = f"{RECTANGLE}{WALLED}{COMPOSITE}{POLYGON}"
    full = FULL.replace("[mechanism.sections.round]", f"{sections}[mechanism.sections.round]")
    full = full.replace('name = "A"\n', f'name = "A"\n{COMPLIANCE}{BEARING}', 1)
    full = full.replace('name = "C"\n', f'name = "C"\n{CLEARANCE}', 1)
    full = full.replace('name = "B"\n', f'name = "B"\n{IN_JOINTS}', 1)
    start, end = full.index("[drive]"), full.index("[simulation]")
    for drive in [full[start:end], *(f"[drive]{part}" for part in DRIVES.split("[drive]")[1:])]:
        path = tmp_path / "study.toml"
        path.write_text(
            full[:start]
            + FORCES
            + POINT_FORCES
            + LINES
            + SPRINGS
            + POINTS
            + BASE
            + drive
            + full[end:]
            + ALL_TASKS
            + OPTIMISE,
            encoding="utf-8",
        )
        load_study(path)
        full = full.replace('section = "own"\n', "body = {mass = 1, centre = [0, 0, 0], inertia = [1, 1, 1]}\n")
        start, end = full.index("[drive]"), full.index("[simulation]")
    study_reader.read_drives(tomllib.loads(SLIDES)["drives"])
    tables.read_table(Coupling, tomllib.loads(COUPLINGS)["mechanism"]["couplings"][0], "[[mechanism.couplings]]")
    study_reader._read_station({"section": "bar"}, "[[mechanism.links]] `rod` stations number 1", {"bar": Circle(0.01)})
    rod = {"name": "rod", "length": 0.2, "section": "own", "camber": [{"x": 0.1, "y": "5 um"}]}
    study_reader._read_link(rod, "[[mechanism.links]] `rod`", {}, {"own": GivenSection(*[1.0] * 10)})
    bent = {"name": "bent", "section": "own", "axis": [{"to": [0.1, 0, 0]}, {"to": [0.2, 0, 0.1], "roll": "5 deg"}]}
    study_reader._read_link(bent, "[[mechanism.links]] `bent`", {}, {"own": GivenSection(*[1.0] * 10)})
    for table in ({"file": "absent.npz"}, {"mass": "m.mtx", "stiffness": "k.mtx", "interfaces": [[0, 0, 0]]}):
        with pytest.raises(InputError, match="there is none"):
            study_reader._read_body(table, "[[mechanism.links]] `rocker` body", tmp_path)
    tables.read_table(Statics, {"hold": "A", "rates": {"A": 1.0}}, "[statics]")
    return found


def test_the_reference_holds_what_the_reader_asks_for(asked):
    reference = {}
    for table in key_tables():
        # The reader asks at once for the settings of all methods.
        reference.setdefault(table.header.partition(", settings of the method")[0], {}).update(
            {key.name: key.default for key in table.keys if not key.name.startswith(("ERROR", "JOINT"))}
        )
    # Asked before the shape and the kind are known, or by names of the user.
    for place in (
        "[mechanism.sections.NAME]",
        "[drive] or [[drives]]",
        "[[mechanism.springs]]",
        "[[mechanism.forces]]",
    ):
        asked.pop(place)
    assert set(reference) == set(asked)
    for header, (required, optional) in asked.items():
        keys = reference[header]
        assert {name for name, default in keys.items() if default == NEEDED} == required, header
        assert set(keys) - required == optional - {"D.delta_x", "B.d_x", "C.d_x"}, header


def test_every_key_has_a_meaning():
    for table in key_tables():
        assert all(len(key.meaning) > 4 for key in table.keys), table
        assert not any(re.search(r"\b(None|True|False)\b", key.meaning) for key in table.keys), table


def test_meanings_come_from_docstrings():
    class Documented:
        """A class.

        Args:
            one: first line
                and second.
            two, three: both.
        Raises:
            four: no argument.
        """

    assert argument_meanings(Documented) == {"one": "first line and second.", "two": "both.", "three": "both."}
