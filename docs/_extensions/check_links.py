"""Check that every link within the built site leads to a page, and to a place on it: `check_links.py SITE`."""

import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit


class Page(HTMLParser):
    """Links and places of a page, and what it would load from elsewhere."""

    def __init__(self, text: str):
        super().__init__()
        self.links: list[str] = []
        self.places: set[str] = set()
        self.loaded: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        found = dict(attrs)
        self.places |= {value for value in (found.get("id"), found.get("name")) if value}
        if tag == "a" and found.get("href"):
            self.links.append(found["href"] or "")
        elif tag in ("img", "script", "iframe") and found.get("src"):
            self.loaded.append(found["src"] or "")
        elif tag == "link" and found.get("href") and found.get("rel") in ("stylesheet", "preload", "icon"):
            self.loaded.append(found["href"] or "")


def problems(site: Path) -> list[str]:
    """A sentence for every link that leads nowhere, and for everything that a page would load from a network."""
    pages = {path.resolve(): Page(path.read_text(encoding="utf-8")) for path in sorted(site.rglob("*.html"))}
    found = []
    for path, page in pages.items():
        where = path.relative_to(site.resolve())
        for link in page.links + page.loaded:
            parts = urlsplit(link)
            if parts.scheme in ("http", "https", "mailto", "data"):
                if link in page.loaded and parts.scheme != "data":
                    found.append(f"{where} loads {link}")
                continue
            target = (path.parent / unquote(parts.path)).resolve() if parts.path else path
            if not target.exists():
                found.append(f"{where} leads to {link}, which is not there")
            elif parts.fragment and target in pages and unquote(parts.fragment) not in pages[target].places:
                found.append(f"{where} leads to {link}, a place that is not on that page")
    return found


if __name__ == "__main__":
    site = Path(sys.argv[1])
    wrong = problems(site)
    print("\n".join(wrong) or f"{len(list(site.rglob('*.html')))} pages: every link within the site leads somewhere")
    sys.exit(bool(wrong))
