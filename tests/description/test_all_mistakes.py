"""Several mistakes in one table of a study file, or in one object, are told together: one line for each."""

import re

import pytest

from rfem_jax import InputError, Joint, Link, Material, MomentTable, PointMass, Rectangle, load_study
from rfem_jax.description.basics.errors import ABSENT, Checks, Problems
from rfem_jax.description.basics.tables import build
from rfem_jax.description.tasks import MonteCarloTask, Task

from .test_study_files import FULL, TEXT
from .test_tasks import TASKS

MAIN = TEXT + TASKS
OTHER_DRIVE = '[drive]\njoint = "A"\nkind = "moment_table"\n'

# What is changed (in which text), and the keys or arguments that the lines are about, one for each mistake.
CASES = {
    "top level": (
        MAIN,
        {'title = "Steel': 'title = 3 # "', "[mechanism]\n": "note_ = 4\nplots = 5\n[mechanism]\n"},
        "title note_ plots",
    ),
    "mechanism": (
        TEXT,
        {
            "gravity = [0.0, 0.0, -9.81]": 'gravity = 9.81\nelements = "lin"\nredundant_reactions = 1\nsize = 1',
            "length = 0.12": "length = -0.12",
        },
        "gravity elements redundant_reactions size length",
    ),
    "material": (
        TEXT,
        {'"210 GPa"': '"210 GN"', "7850.0": "-1", "damping = 1e-5": "dmping = 1e-5\nshear_modulus = true"},
        "youngs_modulus density dmping shear_modulus poisson_ratio",
    ),
    "section": (
        TEXT,
        {'width = "10 mm"': 'width = "10 s"', 'height = "10 mm"': "heigth = 0", 'shape = "r': 'wall = 1\nshape = "r'},
        "width heigth wall",
    ),
    "tube": (
        FULL,
        {'outer_diameter = "20 mm"': "outer_diameter = 0", 'wall = "2 mm"': "", "factor = 1.9": "factor = -1"},
        "outer_diameter wall shear_factor",
    ),
    "given section": (
        FULL,
        {"line_density = 1.997": "", '"1 us"': "-1", "torsion_stiffness = 733.5": "", "1131\n": "0\n"},
        "line_density damping torsion_stiffness bending_stiffness_y",
    ),
    "links": (
        FULL,
        {
            'name = "one"\nlength = "12 cm"': 'name = "o.ne"\nlenght = "12 cm"\nrfes = 3',
            'section = "round"\nmaterial = "steel"': 'section = "rond"\nmaterial = "stee"',
            'mass = "20 g", position = "5 cm"': 'mass = "20 m", position = "5 g"',
            'name = "two"\nlength = 0.3': 'name = "two"\nlength = 0',
            "rfes = 9": "rfes = 0\nrigid = 1",
        },
        "name lenght rfes section material mass position length rfes rigid",
    ),
    "a link of a material and a section with mistakes": (
        TEXT,
        {"density": "densty", 'width = "10 mm"': "width = -1", "rfes = 5": "rfes = 0", "rigid = true": "rigid = 1"},
        "densty width rigid rfes",
    ),
    "joint": (
        FULL,
        {
            'name = "A"\nparent = "base"\nchild = "one"': 'name = "A"\nchild = "base"\nsize = 1',
            'position = ["1 mm", 0, 0]\norientation = [0, 0, "5 deg"]': "position = 1\norientation = [0]",
            "angle = 0.5": 'angle = "1 m"\ncut = 0',
        },
        "parent child size position orientation angle cut",
    ),
    "drive": (
        TEXT,
        {'joint = "A"\n': 'joint = "A.B"\n', "moment = 1.5": 'moment = "1.5 N"', "rise_time = 0.1": "rise_times = 0.1"},
        "joint moment rise_times",
    ),
    "drive of another kind": (
        TEXT[: TEXT.index("[drive]")] + OTHER_DRIVE + TEXT[TEXT.index("[simulation]") :],
        {OTHER_DRIVE: f'{OTHER_DRIVE}times = [1, 2]\nmoments = "1 N m"\nrate = 2\n'},
        "times moments rate",
    ),
    "drive of an unknown kind": (TEXT, {'"moment_ramp"': '"moment_rmp"\nrise = 1'}, "kind rise"),
    "simulation": (
        TEXT,
        {
            "duration = 0.5": "duration = -1\nstabilisation = -1\ncorrections = 3\nplots = 1",
            "step = 1e-5": 'step = "1 mm"',
            "save_every = 1e-3": 'save_every = "1"',
        },
        "duration stabilisation corrections plots step save_every",
    ),
    "simulation with a key that is misspelt": (
        FULL,
        {"rtol = 1e-8": "rtoll = 1e-8", "atol = 1e-10": "atol = -1", 'duration = "1 s"': ""},
        "rtoll atol duration",
    ),
    "case": (
        TEXT,
        {'name = "P2"\nerrors = { "D.delta_x" = "0.5 deg" }': 'name = "P/2"\nnote = 1\nerrors = { "D.d_x" = "m" }'},
        "name note D.d_x",
    ),
    "case without a name": (TEXT, {'name = "P4"\n': "", '"0.5 mm"': '"0.5 deg"'}, "name D.d_y"),
    "metrics that are no words": (MAIN, {'metrics = "D.mean_square_force"': "metrics = [[1], 2]"}, "metrics metrics"),
    "a mistake in one table and others in the rest": (
        TEXT,
        {'"D.delta_x" =': '"E.delta_x" =', "step = 1e-5": "step = 0", 'joint = "A"\nkind': 'joint = "E"\nkind'},
        "errors step joint",
    ),
    "tolerances": (
        MAIN,
        {
            '"D.delta_x" = "0.25 deg"': '"D.delta_x" = { half_width = 0, distribution = "x", deviations = -1, at = 0 }',
            '["-0.1 mm", "0.3 mm"], distribution = "triangular"': '[1], distribution = "flat"',
            '"B.d_x" = "0.3 mm", "B.d_z"': '"B.d_x" = "0.3 deg", "B.d_q"',
            "correlation = 0.5": "correlation = 2\ndeviations = 0",
        },
        "half_width distribution deviations at interval distribution B.d_x name correlation deviations",
    ),
    "a tolerance of no error": (
        MAIN,
        {'"D.delta_x" = "0.25 deg"': '"D.delta_q" = { half_width = 0, distribution = "x" }'},
        "name distribution",
    ),
    "sensitivity": (
        MAIN,
        {
            '"D.mean_square_moment", "end_energy"]': '"D.force", "end_engy"]\norder = 3\nmode = "x"\nbatch = 0',
            'at = { "D.delta_x" = "0.1 deg" }': 'at = { "D.delta_x" = "0.1 mm", "D.x" = 0 }\nsteps = 1',
        },
        "metrics metrics order mode batch D.delta_x name steps",
    ),
    "monte_carlo": (
        MAIN,
        {
            "n = 64": 'seed = -1\nbatch = 0\nquantiles = 0.5\nconfidence = 2\nsampling = "x"\nlanes = 0',
            '"*.rms_moment" = 3.0': '"*.rms_moment" = -1.0, "*.rms" = 1.0',
        },
        "n seed batch quantiles confidence sampling lanes limits metrics",
    ),
    "worst_case": (
        MAIN,
        {
            'metrics = "D.mean_square_force"': 'metrics = []\nregion = "x"\nsense = "x"\ncorners = 1\nevaluations = 0',
            "starts = { corners = 2 }": "starts = { corners = -2, randm = 1 }",
        },
        "metrics region sense corners evaluations starts.corners starts",
    ),
    "allocation": (
        MAIN,
        {
            "scales = [0.5, 2]": 'scales = 2\nrounds = 0\ncriterion = "rs"\ntarget = 1\nprices = 1',
            'limits = { "D.mean_square_moment" = 10.0 }': "",
            '["0.05 deg", "1 deg"]': '["1 deg", "0.05 deg"]',
            '["0.05 mm", "1 mm"]': '["0.05 s", "1 mm"]',
            "price = 2": "price = 2\nworth = 1",
            'at = "0.2 mm"': 'at = "0.2 deg", fixed = "x"',
        },
        "scales rounds criterion target prices limits bounds B.d_x worth at fixed",
    ),
    "settings of another criterion": (
        MAIN,
        {"scales = [0.5, 2]": "target = 0.9\ncoverage = 2\nsamples = 64"},
        "target coverage samples",
    ),
    "tasks that do not fit the mechanism": (
        MAIN,
        {
            '"D.mean_square_moment", "end': '"E.rms_force", "F.rms_force", "end',
            'at = { "D.delta_x"': 'at = { "E.delta_x"',
        },
        "metrics metrics sensitivity",
    ),
    "headers that are misspelt, of which nothing follows": (
        MAIN,
        {
            "[mechanism.materials.": "[mechanism.material.",
            "[mechanism.sections.": "[mechanism.section.",
            "[allocation.bounds]": "[allocation.bound]",
            "[allocation.cost]": "[allocation.costs]",
            "[simulation]": "[simulations]",
        },
        "material section bound costs simulations",
    ),
    "bounds that are no table, and a cost": (
        MAIN,
        {"[allocation.bounds]": "bounds = 3\n[allocation.bound]", "price = 2": "price = -2"},
        "bound bounds price",
    ),
    "a key that only another kind has, misspelt": (TEXT, {"moment = 1.5": "angle = 1"}, "angle moment"),
    "a header of tolerances that is misspelt": (
        MAIN,
        {"[tolerances]\n": "[tolerance]\n", "[[tolerances": "[[tolerance"},
        "tolerance",
    ),
}


def subject(line):
    """The key or argument that a line is about."""
    unknown = re.search(r"must have known keys only, but has `(\w+)`; ", line)
    return (unknown or re.search(r"(?:must have the key|Argument) `([\w.]+)`", line))[1]


@pytest.mark.parametrize("name", CASES)
def test_mistakes_of_one_table_are_told_together(tmp_path, name):
    text, changes, expected = CASES[name]
    for old, new in changes.items():
        assert old in text, old
        text = text.replace(old, new, 1)
    path = tmp_path / "study.toml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(InputError) as caught:
        load_study(path)
    lines = caught.value.problems
    assert sorted(map(subject, lines)) == sorted(expected.split()), lines
    assert all(re.search(r"\bmust\b.*\bbut\b", line) for line in lines)


@pytest.mark.parametrize(
    ("make", "arguments"),
    [
        (
            lambda: Material("a b", 0.0, "1 m", poisson_ratio=0.6, damping=-1),
            "name youngs_modulus density damping poisson_ratio",
        ),
        (lambda: Rectangle(0.0, "1 s", shear_factor=None), "width height shear_factor"),
        (lambda: PointMass(0.0, "1 kg", (0, 0)), "mass position inertia"),
        (lambda: Link("base", 0.0, None, rigid=1, rfes=0), "name length section rigid rfes"),
        (lambda: Joint("a", "b.c", "base", position=1, angle="1 m"), "parent child position angle"),
        (lambda: MomentTable("a b", [1.0, 2.0], ["1 N"]), "joint times moments"),
        (lambda: MonteCarloTask(0, ("x",), quantiles=1, seed=0.5), "n metrics quantiles seed"),
        (lambda: MonteCarloTask(None, ("x",), quantiles=None, seed=None, lanes=None), "n metrics quantiles seed"),
    ],
)
def test_an_object_made_in_python_tells_all_mistakes(make, arguments):
    with pytest.raises(InputError) as caught:
        make()
    assert sorted(map(subject, caught.value.problems)) == sorted(arguments.split())


def test_an_absent_value_is_not_judged_and_makes_no_object():
    with pytest.raises(InputError) as caught:
        Rectangle(ABSENT, 0.0)
    (line,) = caught.value.problems
    assert "`height`" in line
    with pytest.raises(InputError) as caught:
        Rectangle(ABSENT, 1.0)
    assert caught.value.problems == ()
    checks = Checks(object.__new__(Rectangle))
    assert checks.value("width", ABSENT, float) is ABSENT
    assert not checks.passed("width") and checks.passed("height")


class Own(Task):
    """A kind of task from outside the package, which tells its first mistake."""

    def __init__(self, first=1, second=1):
        for name, value in (("first", first), ("second", second)):
            if value != 1:
                raise InputError(f"Argument `{name}` must be 1, but was {value}; write 1.")

    def __post_init__(self):
        raise NotImplementedError


@pytest.mark.parametrize(
    ("settings", "told"),
    [
        ({"first": 2}, ["first"]),
        ({"first": 2, "second": 3}, ["first"]),
        ({"second": 3}, ["second"]),
        ({"first": ABSENT, "second": 3}, []),
    ],
)
def test_a_class_with_checks_of_its_own_tells_its_first_mistake_unless_an_argument_is_absent(settings, told):
    with pytest.raises(InputError) as caught:
        build(Own, settings, "[own]", Problems())
    assert [subject(line) for line in caught.value.problems] == told
    assert all(line.startswith("[own]: ") for line in caught.value.problems)


def test_a_class_that_takes_all_is_built_and_faults_of_its_own_are_no_input():
    assert isinstance(build(Own, {"first": 1}, "[own]", Problems()), Own)
    with pytest.raises(TypeError, match="third"):
        build(Own, {"third": 1}, "[own]", Problems())
