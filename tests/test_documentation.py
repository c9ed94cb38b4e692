"""Documents: links lead somewhere, the theory's equations are numbered in order, and those referred to exist."""

import re
from pathlib import Path
from xml.etree import ElementTree

import pytest

ROOT = Path(__file__).parents[1]
THEORY = ROOT / "docs" / "theory"
DOCUMENTS = sorted(
    path for folder in ("docs", "benchmarks", "studies") for path in (ROOT / folder).rglob("*.md")
) + sorted(ROOT.glob("*.md"))
PICTURES = sorted((ROOT / "docs").rglob("*.svg"))
CHAPTERS = sorted(THEORY.glob("[0-9]*.md"))

LINK = re.compile(r"\[[^\]]*\]\(([^)\s]+)\)")
TAG = re.compile(r"\\tag\{(\d+\.\d+)\}")
NUMBER = re.compile(r"\((\d{1,2}\.\d{1,2})\)")


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


def test_the_index_of_the_theory_leads_to_every_chapter_and_every_picture_is_shown():
    assert len(CHAPTERS) == 11 and PICTURES
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
