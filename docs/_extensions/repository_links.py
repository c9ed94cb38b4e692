"""Links of documents to the repository, which GitHub follows, on the site: to its page where a file has one, to a copy
of the file otherwise."""

import re
from pathlib import Path, PurePosixPath

ROOT = Path(__file__).parents[2]
LINK = re.compile(r"(?<=\]\()(\.\./[^)#\s]+)")


def setup(app):
    app.connect("source-read", _rewrite)
    return {"parallel_read_safe": True}


def _rewrite(app, page, source):
    source[0] = rewritten(source[0], PurePosixPath("docs") / page)


def rewritten(text: str, page: PurePosixPath) -> str:
    """A page's text with links to READMEs of studies led to their pages, and links to packages to their first file."""

    def target(found: re.Match[str]) -> str:
        path = (ROOT / page.parent / found[1]).resolve()
        try:
            place = path.relative_to(ROOT)
        except ValueError:
            return found[1]
        up = "../" * (len(page.parent.parts) - 1)
        if place.parts[0] == "studies" and place.name == "README.md":
            return f"{up}studies/{place.parts[1]}.md"
        if place.as_posix() == "benchmarks/README.md":
            return f"{up}benchmarks.md"
        return f"{found[1]}/__init__.py" if (path / "__init__.py").exists() else found[1]

    return LINK.sub(target, text)
