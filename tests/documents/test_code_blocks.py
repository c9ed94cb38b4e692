"""Every code block of the README, the first steps and the guides runs: Python as it stands, fragments of study files in
a study, commands on studies that are small.  The notebooks of the gallery are executed by the build of the site.

What sets an environment up is left out (SET_UP).  Commands on the files of `studies`, and its programs, are run on
small copies by tests/programs, so that here it is only seen that it does so, and that their arguments are read; so are
those of several machines.
"""

import re
import shlex

import pytest

from rfem_jax.report.command_line import build_parser, main
from tests.programs.test_study_files import COMMANDS, ROOT

DOCUMENTS = [ROOT / "README.md", ROOT / "docs" / "first_steps.md", *sorted((ROOT / "docs" / "guides").glob("*.md"))]
FENCE = re.compile(r"^```(\w*)\n(.*?)^```$", flags=re.DOTALL | re.MULTILINE)
INDENTED = re.compile(r"(?<=\n\n)(?: {4}\S.*\n)+", flags=re.MULTILINE)
SET_UP = re.compile(r"(python3?|\.) -m (venv|pip|pytest)\b.*|\. \.venv/bin/activate")
ELSEWHERE = {
    ("run", "studies/four_bar/study.toml"),
    ("check", "studies/four_bar/study.toml"),
    ("validate", "--out"),
} | {
    (command, f"studies/{folder}/{file}") for folder, entries in COMMANDS.items() for file, command in entries
}  # tests/programs/test_study_files.py runs these
SMALLER = (
    ("rfes = 5", "rfes = 2"), ('method = "auto"', 'method = "generalised_alpha"'), ("accuracy = 1e-3", 'step = "2 ms"'),
    ("duration = 0.2 ", "duration = 0.01 "), ("n = 256", "n = 8"), ('"1 ms"', '"2 ms"'),
)  # fmt: skip


def blocks(path):
    """(language, text) of all blocks of a document; indented ones are commands."""
    text = path.read_text(encoding="utf-8")
    found = [(at.start(), at[1], at[2]) for at in FENCE.finditer(text)]
    rest = FENCE.sub(lambda at: "x" * len(at[0]), text)
    found += [(at.start(), "console", at[0]) for at in INDENTED.finditer(rest)]
    return [block[1:] for block in sorted(found)]


def commands(path):
    """Single commands of a document, without comments."""
    lines = [line for language, text in blocks(path) if language == "console" for line in text.splitlines()]
    parts = [part for line in lines for part in line.strip().removeprefix("$ ").split("&&")]
    return [shlex.split(part, comments=True) for part in parts if not SET_UP.fullmatch(part.strip())]


def name(path):
    return path.relative_to(ROOT).as_posix()


def documents_with(*languages):
    return [path for path in DOCUMENTS if {language for language, _ in blocks(path)} & set(languages)]


def test_blocks_are_of_languages_that_are_run():
    found = {(name(path), language) for path in DOCUMENTS for language, _ in blocks(path)}
    assert {language for _, language in found} == {"python", "toml", "console"}
    assert len(found) > 8


@pytest.mark.parametrize("path", documents_with("python"), ids=name)
def test_python(path, in_workplace):
    """The blocks of a document, one after the other."""
    names = {"__name__": "__main__"}
    for number, (language, text) in enumerate(blocks(path)):
        if language == "python":
            exec(compile(text, f"{name(path)}, block {number + 1}", "exec"), names)


@pytest.mark.parametrize(
    ("path", "text"),
    [
        (path, text)
        for path in DOCUMENTS
        for language, text in blocks(path)
        # Whole mechanisms are read by tests/description/test_force_reader.py.
        if language == "toml" and "[[mechanism.links]]" not in text
    ],
    ids=lambda one: "" if isinstance(one, str) else name(one),
)
def test_fragments_of_study_files(path, text, load_with):
    assert load_with(text).cases


def of_first_steps(arguments, in_workplace):
    """What the reader does in the editor, and what makes the study small."""
    if arguments[1] not in ("check", "monte-carlo"):
        return
    file = in_workplace / "my_crank.toml"
    text = file.read_text(encoding="utf-8")
    for old, new in SMALLER:
        text = text.replace(old, new)
    if arguments[1] == "monte-carlo":
        head, mark, tasks = text.partition("# [tolerances]")
        assert mark
        text = head + re.sub(r"^# ?", "", mark + tasks, flags=re.MULTILINE)
    file.write_text(text, encoding="utf-8")


@pytest.mark.parametrize("path", documents_with("console"), ids=name)
def test_commands(path, in_workplace, capsys):
    for arguments in commands(path):
        if arguments[0] == "python":
            program = ROOT / arguments[1]
            assert program.exists(), arguments
            assert arguments[1] in (ROOT / "tests" / "programs" / "test_studies.py").read_text(encoding="utf-8")
            continue
        assert arguments[0] == "rfem-jax", arguments
        if "--processes" in arguments or tuple(arguments[1:3]) in ELSEWHERE:
            build_parser().parse_args(arguments[1:])
            continue
        if path.name == "first_steps.md":
            of_first_steps(arguments, in_workplace)
        assert main(arguments[1:]) == 0, capsys.readouterr().err
        if "--out" in arguments and arguments[1] in ("run", "monte-carlo"):
            assert (in_workplace / arguments[arguments.index("--out") + 1] / "report.html").exists()
