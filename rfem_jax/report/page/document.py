"""The page as one HTML file: content, script and style put together.

Place in the pipeline: content (a dict) -> **document** -> report.html.

Everything in the content may come from files of others. It stands in the page as JSON in an element that browsers do
not execute, with every `<` as an escape, so that no text can end the element; the script puts texts into the page as
text nodes only; and the page's content security policy allows no script and no style but those of this package, by
their hashes, and no connection to anywhere.
"""

import base64
import hashlib
import json
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any

from rfem_jax.report.contents.output import without_nan
from rfem_jax.whole_files import write_text

ASSETS = Path(__file__).parent / "assets"
LIBRARY = "vendor/uPlot.iife.min.js"
SCRIPTS = (
    *("data.js", "numbers.js", "elements.js", "theme.js", "geometry.js", "tables.js", "charts.js"),
    *("camera.js", "motion.js", "symbols.js", "acting.js", "mechanism.js", "player.js", "histories.js"),
    *("overview.js", "sensitivity.js", "bands.js", "samples.js", "corners.js", "allocation.js"),
    *(
        "sweep.js",
        "reliability.js",
        "design.js",
        "identification.js",
        "analyses.js",
        "statics.js",
        "checks.js",
        "main.js",
    ),
)
STYLES = ("vendor/uPlot.min.css", "page.css")
FILE = "report.html"


def write_folder(folder: str | Path) -> Path:
    """Write `report.html` from the files of a folder. Raises: InputError as `folder.folder_content`; OSError."""
    from rfem_jax.report.page.folder import folder_content

    return write_document(Path(folder) / FILE, folder_content(folder))


def write_document(path: str | Path, content: dict[str, Any]) -> Path:
    """Write the page with this content."""
    return write_text(path, page_text(content))


def page_text(content: dict[str, Any]) -> str:
    """The page as HTML."""
    script, style = _script(), _style()
    policy = (
        f"default-src 'none'; script-src {_hash(script)}; style-src {_hash(style)}; img-src data:; "
        "base-uri 'none'; form-action 'none'"
    )
    text = (ASSETS / "page.html").read_text(encoding="utf-8")
    parts = {"policy": policy, "style": style, "script": script, "content": embedded_json(content)}
    for name in ("policy", "style", "script", "content"):  # last what is not ours: nothing is replaced within it
        head, mark, tail = text.partition(f"@@{name}@@")
        assert mark, name
        text = head + parts[name] + tail
    return text


def embedded_json(content: dict[str, Any]) -> str:
    """JSON that cannot end the element it stands in, and is also JavaScript."""
    text = json.dumps(without_nan(content | {"generator": _generator()}), allow_nan=False, separators=(",", ":"))
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def _generator() -> str:
    try:
        return f"rfem_jax {metadata.version('rfem_jax')}"
    except metadata.PackageNotFoundError:
        return "rfem_jax"


def _hash(text: str) -> str:
    """Source expression of a content security policy for an inline element with this text."""
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"


@cache
def _script() -> str:
    """uPlot, then the page's own script in one function, whose files see each other's names and nobody else does."""
    library = (ASSETS / LIBRARY).read_text(encoding="utf-8").strip()
    own = "\n".join((ASSETS / name).read_text(encoding="utf-8").strip() for name in SCRIPTS)
    return f'\n{library}\n(function () {{\n"use strict";\n{own}\n}})();\n'


@cache
def _style() -> str:
    return "\n" + "\n".join((ASSETS / name).read_text(encoding="utf-8").strip() for name in STYLES) + "\n"
