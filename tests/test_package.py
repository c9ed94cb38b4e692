"""What is shipped: the README on the package index. `.ci/package` builds the distributions and takes first steps."""

import importlib.util
import re
from pathlib import Path

ROOT = Path(__file__).parents[1]


def for_the_index(*arguments):
    spec = importlib.util.spec_from_file_location("setup_of_package", ROOT / "setup.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.for_the_index(*arguments)


def test_links_on_the_index_lead_somewhere():
    """Without an address of the repository words stay; with one, all links are addresses, and files are there."""
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    links = re.findall(r"\]\(([^)#]+)[^)]*\)", readme)
    relative = [link for link in links if not link.startswith("http")]
    assert len(relative) > 20 and all((ROOT / link).exists() for link in relative)
    bare = for_the_index(readme, None)
    assert all(link.startswith("https://") for link in re.findall(r"\]\(([^)]+)\)", bare))
    assert "first steps" in bare and "![" not in bare and "(docs/first_steps.md)" not in bare
    whole = for_the_index(readme, "https://example.org/rfem")
    found = re.findall(r"\]\(([^)#]+)[^)]*\)", whole)
    assert len(found) == len(links) and all(link.startswith("https://") for link in found)
    assert "[first steps](https://example.org/rfem/blob/main/docs/first_steps.md)" in whole
    assert "](https://example.org/rfem/raw/main/docs/pictures/" in whole
    assert for_the_index("[a](https://x.org/b) [c](#d)", None) == "[a](https://x.org/b) [c](#d)"
