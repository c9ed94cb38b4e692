"""One mistake in a study file is told in one sentence, or in very few: files with one mistake each, of all shipped
studies, are read without a traceback."""

import re
import shutil
from collections import Counter
from pathlib import Path

import pytest

from rfem_jax import InputError, load_study
from rfem_jax.description.basics.errors import condensed, with_short_quotes
from rfem_jax.description.study_file.plausibility import doubtful_numbers

from .mutated_studies import KINDS, mutations

ROOT = Path(__file__).parents[2]
SHIPPED = sorted([*ROOT.glob("studies/*/*.toml"), *ROOT.glob("rfem_jax/report/starting_studies/*.toml")])
EACH, SEED = 10, 7
LONGEST = 1100  # characters of a sentence, most of them names to choose from


def told(text, path):
    """Sentences that reading a file gives; none where it is right."""
    path.write_text(text, encoding="utf-8")
    try:
        list(doubtful_numbers(load_study(path)))
    except InputError as error:
        assert all(problem.strip() == problem and problem[-1] in ".?)" for problem in error.problems), error.problems
        return error.problems
    return ()


@pytest.mark.wrong_types
def test_one_mistake_gives_one_sentence(tmp_path):
    numbers, kinds = Counter(), Counter()
    assert len(SHIPPED) > 10
    for number, study in enumerate(SHIPPED):
        for body in study.parent.glob("*.npz"):  # that the study names
            shutil.copy(body, tmp_path)
        for what, text in mutations(study.read_text(encoding="utf-8"), EACH, SEED + number):
            problems = told(text, tmp_path / "study.toml")
            assert len(problems) <= 3, (study, what, problems)
            assert all(len(one) <= LONGEST for one in problems), (study, what, problems)
            numbers[len(problems)] += 1
            kinds[what.partition(":")[0]] += 1
    assert numbers[1] > 0.75 * numbers.total(), numbers  # what is left is right after all
    assert numbers[2] + numbers[3] < 0.03 * numbers.total(), numbers
    assert len(kinds) > 0.5 * len(KINDS)


def test_the_same_seed_makes_the_same_files():
    text = SHIPPED[0].read_text(encoding="utf-8")
    assert list(mutations(text, 20, 3)) == list(mutations(text, 20, 3)) != list(mutations(text, 20, 4))


TEXT = """
[simulation]
duration = 1.0
[mechanism.materials.steel]
youngs_modulus = "210 GPa"
poisson_ratio = 0.3
density = 7850.0
[mechanism.sections.bar]
shape = "rectangle"
width = "10 mm"
height = "10 mm"
[[mechanism.links]]
name = "one"
length = 0.1
section = "bar"
material = "steel"
rigid = true
[[mechanism.links]]
name = "two"
length = 0.2
section = "bar"
material = "steel"
rigid = true
[[mechanism.links]]
name = "three"
length = 0.2
section = "bar"
material = "steel"
rigid = true
[[mechanism.joints]]
name = "A"
parent = "base"
child = "one"
[[mechanism.joints]]
name = "B"
parent = "one"
child = "two"
position = [0.1, 0, 0]
[[mechanism.joints]]
name = "C"
parent = "two"
child = "three"
position = [0.2, 0, 0]
[design]
"bar.width" = ["8 mm", "12 mm"]
[sweep]
metrics = ["A.rms_force"]
levels = 2
[sweep.bounds]
"bar.height" = ["8 mm", "12 mm"]
"bar.width" = ["8 mm", "12 mm"]
"""


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("", "", ()),  # the file is right
        ('"10 mm"', '"10 kg"', ("`width`", "which is a mass")),  # and nothing on the bounds of the sweep
        ("density", "densty", ("`densty`", "`density`?")),
        ("[mechanism.materials.steel]", "[mechanism.materials.iron]", ("`one`", "`two`", "`three`", '"iron"')),
        ('name = "two"', 'name = "zwei"', ("`child` of joint `B`", "`parent` of `C`", "no link `two`")),
        (
            '[[mechanism.joints]]\nname = "C"\nparent = "two"\nchild = "three"\nposition = [0.2, 0, 0]\n',
            "",
            ("`three`", "child"),
        ),
        ('name = "A"\nparent = "base"\nchild = "one"\n', "", ("number 1", "`name`, `parent`, `child`", "empty")),
        ("duration = 1.0", f"duration = {[0.1] * 3000}", ("`duration`", "number", "characters")),
        ("duration = 1.0", f"duration = '{'x' * 3000}'", ("`duration`", "number", "characters")),
        ('["A.rms_force"]', f"{['A.rms_forc'] * 500}", ("`metrics`", "A.rms_forc")),
        ('child = "one"', 'child = "one"\nstiffnes = { radial = 1e6 }', ("`stiffnes`", "`stiffness`?")),
        ("[design]", '[monte_carlo]\nn = 8\nlimits = { "A.end_anle" = "3 deg" }\n[design]', ("A.end_anle",)),
    ],
)
def test_what_follows_from_a_mistake_is_not_told(tmp_path, old, new, words):
    assert old in TEXT
    problems = told(TEXT.replace(old, new, 1), tmp_path / "study.toml")
    assert len(problems) == bool(words), problems
    assert all(word in problems[0] for word in words), problems
    assert not problems or len(problems[0]) < 500


@pytest.mark.parametrize(
    "text",
    [
        f"{'.'.join(['a'] * 5000)} = 1\n",
        f"[{'.'.join(['a'] * 5000)}]\n",
        f"a = {'[' * 5000}{']' * 5000}\n",
        f"a = {'{a=' * 5000}1{'}' * 5000}\n",
        f"a = {'9' * 5000}\n",
        f"a = {'[' * 60}{']' * 60}\n",
        TEXT.replace("0.1", f"0x{'f' * 5000}", 1),
        TEXT.replace("0.1", f'"{"9" * 5000} m"', 1),
        TEXT.replace("0.1", '"3 km^9999"', 1),
        TEXT.replace("1.0", f"1.0\nmethod = 'generalised_alpha'\nstep = 1e-3\ncorrections = {'9' * 400}", 1),
        TEXT.replace("rigid = true", "rigid = true\npoint_masses = [{ mass = 1, position = [[1], 2] }]", 1),
    ],
)
def test_what_is_nested_too_deep_or_too_long_is_refused(tmp_path, text):
    (problem,) = told(text, tmp_path / "study.toml")
    words = "nest|be valid TOML|have numbers|be finite|have a known unit|be a whole number|be a number"
    assert re.search(f"must ({words})", problem)
    assert len(problem) < 500


@pytest.mark.parametrize(
    ("name", "word"),
    [
        *((name, "other results") for name in ("monte_carlo", "Sweep", "turn", "allocation_front", "comparison")),
        *((name, "device of Windows") for name in ("con", "NUL", "aux.1", "com1", "Lpt9")),
        *((name, "file name") for name in ("a/b", "a\\\\b", "..", "a.", "a ", " a", "", "ä")),
    ],
)
def test_the_name_of_a_case_must_make_a_file_of_its_own(tmp_path, name, word):
    (problem,) = told(f'{TEXT}\n[[cases]]\nname = "{name}"\n', tmp_path / "study.toml")
    assert word in problem


def test_names_of_cases_near_those_are_none_of_files(tmp_path):
    cases = "".join(f'[[cases]]\nname = "{name}"\n' for name in ("sweep_1", "console", "com10", "com", "results"))
    assert told(TEXT + cases, tmp_path / "study.toml") == ()


def test_every_table_that_the_reports_write_is_known_by_name():
    """A case of such a name would take its file."""
    from rfem_jax.task_kinds import names_of_tables

    written = {
        name
        for path in (ROOT / "rfem_jax" / "report").rglob("*.py")
        for name in re.findall(r'folder / "(\w+)\.csv"', path.read_text(encoding="utf-8"))
    }
    assert {"monte_carlo", "turn", "allocation_front"} <= written
    assert written <= set(names_of_tables())


def test_quotations_are_cut_and_the_rest_stays():
    whole = "Argument `x` must be one of `a`, `b` (as the guide's list says), but was 'c'; it's the user's: write `a`."
    assert with_short_quotes(whole * 3) == whole * 3
    for quote in (str(list(range(400))), repr({"k": [1] * 400}), repr("'" + "w" * 400), repr(((0.5,) * 40,) * 40)):
        short = with_short_quotes(f"Argument `x` must be a number, but was {quote}; write `x` = 1.")
        assert len(short) < 160 and short.endswith("; write `x` = 1.")
        assert f"({len(quote)} characters)" in short
    open_end = "(" + "so it is, " * 50  # nothing is quoted
    assert with_short_quotes(open_end) == open_end
    path = "must be a file, but `/home/" + "folder/" * 30 + "study.toml` is none"
    assert with_short_quotes(path) == path
    assert len(with_short_quotes("must be finite, but was " + "9" * 5000 + "; write less.")) < 160


def test_sentences_that_differ_in_names_alone_are_told_once():
    few = ["[x] `a` must not.", "[x] `b` must not."]
    assert condensed(few) == tuple(few)
    many = [f"[x] `n{i}` must not." for i in range(12)]
    (one,) = condensed(many)
    assert one == "[x] `n0` must not (so for " + ", ".join(f"`n{i}`" for i in range(1, 9)) + " and more; 12 in all)."
    assert condensed(["[y] must.", *many]) == ("[y] must.", one)
    numbers = [f"[x] must be 1, but was {i}." for i in range(9)]
    assert condensed(numbers[:8]) == tuple(numbers[:8]) and condensed(numbers) == (
        "[x] must be 1, but was 0 (9 in all).",
    )
    different = [f"[x{'y' * i}] must not." for i in range(100)]
    assert condensed(different) == (*different[:40], "There are 60 more mistakes; correct these first.")
