"""Documents: links lead somewhere, the reference has all public names, the theory's equations are numbered in order,
and those that it or the code refers to exist."""

import re
from pathlib import Path
from xml.etree import ElementTree

import pytest

import rfem_jax
from rfem_jax.description.methods import METHOD_CLASSES
from rfem_jax.description.study_file.force_reader import FORCES
from rfem_jax.description.study_file.study_reader import DRIVES, SHAPES

ROOT = Path(__file__).parents[1]
THEORY = ROOT / "docs" / "theory"
DOCUMENTS = sorted(
    path
    for folder in ("docs", "benchmarks", "studies")
    for path in (ROOT / folder).rglob("*.md")
    if "_build" not in path.parts
) + sorted(ROOT.glob("*.md"))
PICTURES = sorted((ROOT / "docs" / "theory").rglob("*.svg"))
CHAPTERS = sorted(THEORY.glob("[0-9]*.md"))
PROGRAMS = sorted(
    path
    for folder in ("rfem_jax", "tests", "benchmarks", "studies")
    for ending in ("py", "toml")
    for path in (ROOT / folder).rglob(f"*.{ending}")
    if path != Path(__file__)
)

LINK = re.compile(r"\[[^\]]*\]\(([^)\s]+)\)")
TAG = re.compile(r"\\tag\{(\d+\.\d+)\}")
NUMBER = re.compile(r"\((\d{1,2}\.\d{1,2})\)")
CITATION = re.compile(r"\btheory ((?:(?:, | and | to )?\(\d+\.\d+\))+)", flags=re.IGNORECASE)
FILE = re.compile(r"\bdocs/[\w./]*\w")
# Notes that are not in the repository, and the paper's numbers, which docs/theory/README.md translates.
ELSEWHERE = re.compile(
    r"\bMODEL(\.md)?\b|\brfem_theory\b|\bbauchau_four_bar\b|\bfour_bar_study\.md\b"
    r"|\b(JOINTS|CONTRACT|DESIGN|HOUSE)\.md\b|\b[Ee]quations? \(\d+\)"
)


def prose(text: str) -> str:
    """A document without its code and its displayed equations."""
    text = re.sub(r"^```.*?^```", "", text, flags=re.DOTALL | re.MULTILINE)
    return re.sub(r"^\$\$.*?^\$\$", "", text, flags=re.DOTALL | re.MULTILINE)


def anchors(path: Path) -> set[str]:
    """What a link to a heading of a document may end in, as GitHub makes it."""
    headings = re.findall(r"^#+ (.*)$", prose(path.read_text(encoding="utf-8")), flags=re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def equations() -> set[str]:
    """Numbers of all equations of the theory."""
    return {number for path in CHAPTERS for number in TAG.findall(path.read_text(encoding="utf-8"))}


@pytest.mark.parametrize("path", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_relative_links_resolve(path):
    for link in LINK.findall(prose(path.read_text(encoding="utf-8"))):
        if re.match(r"[a-z]+:", link):
            continue
        target, _, heading = link.partition("#")
        target = (path.parent / target).resolve() if target else path
        assert target.exists(), f"{path} links to {link}, which does not exist"
        assert not heading or heading in anchors(target), f"{path} links to {link}, which is no heading there"


def test_files_that_the_map_of_the_house_names_exist():
    """In CONTRIBUTING, from the root or from the package."""
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    named = re.findall(r"`((?:\w+/)+\w+(?:\.\w+)?)`", text)
    assert len(named) > 30
    missing = [name for name in named if not any((folder / name).exists() for folder in (ROOT, ROOT / "rfem_jax"))]
    assert not missing


def test_the_reference_has_every_public_name_once():
    pages = [path.read_text(encoding="utf-8") for path in (ROOT / "docs" / "reference").glob("*.md")]
    blocks = [block for page in pages for block in re.findall(r"```{public-names}\n(.*?)```", page, flags=re.DOTALL)]
    names = " ".join(blocks).split()
    assert set(names) == set(rfem_jax.__all__)
    assert len(names) == len(set(names))


def test_what_study_files_choose_by_a_name_is_public():
    classes = {*FORCES.values(), *DRIVES.values(), *SHAPES.values(), *METHOD_CLASSES.values()}
    assert {one.__name__ for one in classes} <= set(rfem_jax.__all__)


def test_the_readme_counts_as_the_page_of_the_validation():
    readme, page = (ROOT / "README.md").read_text("utf-8"), (ROOT / "docs" / "validation.md").read_text("utf-8")
    counted = re.search(r"(\d+) values of published problems[^:]*: (\d+) pass, (\d+) are not met", readme)
    of_page = re.search(r"Of (\d+) values\s+- (\d+) pass;\s+- (\d+) are not met", page)
    assert counted and of_page and counted.groups() == of_page.groups()


def test_the_index_of_the_theory_leads_to_every_chapter_and_every_picture_is_shown():
    assert len(CHAPTERS) == 19 and PICTURES
    index = LINK.findall((THEORY / "README.md").read_text(encoding="utf-8"))
    assert {path.name for path in CHAPTERS} <= set(index)
    shown = {link for path in CHAPTERS for link in LINK.findall(path.read_text(encoding="utf-8"))}
    assert {path.name for path in PICTURES} <= shown


@pytest.mark.parametrize("path", CHAPTERS, ids=lambda path: path.name)
def test_equations_are_numbered_in_order(path):
    chapter = path.name.partition("_")[0]
    text = path.read_text(encoding="utf-8")
    found = TAG.findall(text)
    assert found == [f"{chapter}.{i}" for i in range(1, len(found) + 1)] and found
    assert len(found) == len(re.findall(r"^\$\$$", text, flags=re.MULTILINE)) / 2, "an equation has no number"


@pytest.mark.parametrize("path", [*CHAPTERS, THEORY / "README.md", *PICTURES], ids=lambda path: path.name)
def test_equations_referred_to_in_the_theory_exist(path):
    missing = set(NUMBER.findall(prose(path.read_text(encoding="utf-8")))) - equations()
    assert not missing, f"{path} refers to {sorted(missing)}"


@pytest.mark.parametrize("path", PICTURES, ids=lambda path: path.name)
def test_pictures_have_a_title_and_a_white_background(path):
    space = "{http://www.w3.org/2000/svg}"
    picture = ElementTree.parse(path).getroot()
    assert picture.findtext(f"{space}title")
    ground = picture.find(f"{space}rect")
    assert ground is not None and ground.get("fill") == "#ffffff"
    assert [ground.get(side) for side in ("width", "height")] == picture.get("viewBox").split()[2:]


def running_text(path: Path) -> str:
    """A program with the line breaks of its docstrings and comments taken out."""
    return re.sub(r"\s+(?:# )?\s*", " ", path.read_text(encoding="utf-8"))


def cited(text: str) -> set[str]:
    """Numbers of the theory's equations that a program cites, as "theory (3.4), (3.5)" or "theory (3.1) to (3.4)"."""
    return {number for numbers in CITATION.findall(text) for number in NUMBER.findall(numbers)}


@pytest.mark.parametrize("path", PROGRAMS, ids=lambda path: str(path.relative_to(ROOT)))
def test_what_programs_cite_is_in_the_repository(path):
    text = running_text(path)
    missing = cited(text) - equations()
    assert not missing, f"{path} cites equations {sorted(missing)}, which the theory does not have"
    for file in FILE.findall(text):
        assert (ROOT / file).exists(), f"{path} cites {file}, which does not exist"
    found = ELSEWHERE.search(text)
    assert not found, f"{path} cites {found[0] if found else ''}, which is not in the repository"


def test_the_package_cites_every_chapter():
    """Otherwise the pattern of citations, or a chapter, has lost its use."""
    numbers = {number for path in (ROOT / "rfem_jax").rglob("*.py") for number in cited(running_text(path))}
    assert {number.partition(".")[0] for number in numbers} == {path.name.partition("_")[0] for path in CHAPTERS}
