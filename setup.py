"""What pyproject.toml cannot say: the README on the package index, where paths of the repository lead nowhere.

With `Repository` among the `project.urls` of pyproject.toml they become addresses there; without one, which is so as
long as the repository has no public address, words stay and pictures are left out.
"""

import re
import tomllib
from pathlib import Path

HERE = Path(__file__).parent
LINK = re.compile(r"(!?)\[([^\]]*)\]\((?!https?://|mailto:|#)([^)\s]+)\)")


def for_the_index(text: str, repository: str | None) -> str:
    """The README whose links all lead somewhere.

    Args:
        repository: address of the repository without a slash at its end; None = unknown.
    """

    def absolute(found: re.Match[str]) -> str:
        picture, words, path = found.groups()
        if repository is None:
            return "" if picture else words
        kind = "raw" if picture else "blob"
        return f"{picture}[{words}]({repository}/{kind}/main/{path})"

    return LINK.sub(absolute, text)


if __name__ == "__main__":
    from setuptools import setup  # which tests of the links do without

    urls = tomllib.loads((HERE / "pyproject.toml").read_text(encoding="utf-8"))["project"].get("urls", {})
    setup(
        long_description=for_the_index((HERE / "README.md").read_text(encoding="utf-8"), urls.get("Repository")),
        long_description_content_type="text/markdown",
    )
