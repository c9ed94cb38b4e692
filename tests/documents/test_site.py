"""What the build of the site adds to Sphinx: docstrings as markup, links of GitHub's documents, the check of links."""

import sys
from pathlib import PurePosixPath

import pytest

from tests.programs.test_study_files import ROOT


@pytest.fixture(autouse=True)
def _extensions(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "docs" / "_extensions"))
    yield
    for name in ("docstrings", "repository_links", "check_links"):
        sys.modules.pop(name, None)


def test_docstrings_of_both_forms_become_markup():
    from docstrings import rest

    block = rest(
        [
            "A link.",
            "",
            "Args:",
            "    name: a word,",
            "        or two.",
            "    length: L [m], *.x",
            "Raises:",
            "    InputError: no.",
        ]
    )
    assert block == [
        "A link.", "", "**Arguments:**", "", "- ``name``: a word, or two.", "- ``length``: L [m], \\*.x", "",
        "**Raises:**", "", "- ``InputError``: no.", "",
    ]  # fmt: skip
    inline = rest(["**Arguments:** `drive`: a `Run`s;", "others |x|.", "", "    call(1)"])
    assert inline[0] == "**Arguments:** ``drive``: a :py:obj:`~rfem_jax.Run`\\ s;"
    assert inline[1] == "others \\|x\\|." and inline[3:5] == ["::", ""] and inline[5] == "        call(1)"
    assert rest(["`jax.vmap` of `x_`_"])[0].startswith("`jax.vmap <https://docs.jax.dev/")


def test_links_lead_to_pages_of_the_site():
    from repository_links import rewritten

    page = PurePosixPath("docs", "guides", "speed")
    assert rewritten("[a](../../studies/slider_crank/README.md)", page) == "[a](../studies/slider_crank.md)"
    assert rewritten("[a](../../benchmarks/README.md)", page) == "[a](../benchmarks.md)"
    assert rewritten("[a](../../rfem_jax/tolerancing) [b](../theory/README.md#x)", page) == (
        "[a](../../rfem_jax/tolerancing/__init__.py) [b](../theory/README.md#x)"
    )


def test_links_that_lead_nowhere_and_what_a_network_would_have_to_bring_are_found(tmp_path):
    from check_links import problems

    (tmp_path / "a.html").write_text('<a href="b.html#here">x</a><a href="https://x.org">y</a><img src="c.png">')
    (tmp_path / "b.html").write_text(
        '<p id="here"><a href="a.html#no">x</a><script src="https://cdn.org/x.js"></script>'
    )
    assert problems(tmp_path) == [
        "a.html leads to c.png, which is not there",
        "b.html leads to a.html#no, a place that is not on that page",
        "b.html loads https://cdn.org/x.js",
    ]


def test_every_page_of_the_documentation_is_in_the_contents():
    """Every Markdown file but the folder's own README is named in a table of contents."""
    docs = ROOT / "docs"
    pages = {
        path.relative_to(docs).with_suffix("").as_posix() for path in docs.rglob("*.md") if "_build" not in path.parts
    }
    listed = {"index"}
    for index in (path for path in docs.rglob("*.md") if "_build" not in path.parts):
        text = index.read_text(encoding="utf-8")
        for entry in [
            line for block in text.split("```{toctree}")[1:] for line in block.partition("```")[0].splitlines()
        ]:
            if entry and not entry.startswith(":"):
                listed.add((index.parent / entry).relative_to(docs).as_posix())
    assert pages - {"README"} == listed
