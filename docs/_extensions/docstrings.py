"""Docstrings of this package as Sphinx reads them: sections, code and names of other packages become markup.

The docstrings are plain text with Markdown's backticks and one of two forms of sections, "Args:" with a block of names
or a paragraph that begins with "**Arguments:**".
"""

import re
from collections.abc import Iterator

import rfem_jax

SECTION = re.compile(r"(?:\*\*)?(Args|Arguments|Returns|Raises)(?::\*\*|:)\s*(.*)")
WORDS = {"Args": "Arguments"}
CODE = re.compile(r"``?([^`]+)``?")
ENTRY = re.compile(r"([\w ,*.]+): (.*)")
_AUTOSUMMARY = "https://docs.jax.dev/en/latest/_autosummary"
ELSEWHERE = {
    **{f"jax.{name}": f"{_AUTOSUMMARY}/jax.{name}.html" for name in ("jit", "vmap", "grad", "jvp", "jacfwd", "jacrev")},
    "jax.random.key": f"{_AUTOSUMMARY}/jax.random.key.html",
    "diffrax.RecursiveCheckpointAdjoint()": "https://docs.kidger.site/diffrax/api/adjoints/",
    "equinox.Module": "https://docs.kidger.site/equinox/api/module/module/",
}


def setup(app):
    app.connect("autodoc-process-docstring", _process)
    app.connect("autodoc-skip-member", _skip)
    return {"parallel_read_safe": True}


def _process(app, what, name, obj, options, lines):
    lines[:] = [*rest(lines), ""]


def _skip(app, what, name, obj, skip, options):
    """Fields of named tuples have docstrings that say nothing."""
    return True if str(getattr(obj, "__doc__", "") or "").startswith("Alias for field") else None


def rest(lines: list[str]) -> list[str]:
    """reStructuredText of a docstring."""
    found: list[str] = []
    for block in _blocks(lines):
        head = SECTION.match(block[0])
        if head is not None:
            found += _section(WORDS.get(head[1], head[1]), head[2], block[1:])
        elif all(line.startswith("    ") for line in block):
            joins = bool(found) and found[-1] == "" and len(found) > 1 and found[-2].startswith("    ")
            found += [*([] if joins else ["::", ""]), *("    " + line for line in block), ""]
        else:
            found += [*map(marked, block), ""]
    return found


def _blocks(lines: list[str]) -> Iterator[list[str]]:
    """Paragraphs; a section begins one of its own."""
    block: list[str] = []
    for line in lines:
        if block and (not line.strip() or (not line.startswith(" ") and SECTION.match(line))):
            yield block
            block = []
        if line.strip():
            block.append(line)
    if block:
        yield block


def _section(word: str, first: str, rest_of: list[str]) -> list[str]:
    """A paragraph, or a list of the names that a block explains."""
    if first or not rest_of:
        return [f"**{word}:** {marked(first)}", *(marked(line.strip()) for line in rest_of), ""]
    depth = min(len(line) - len(line.lstrip()) for line in rest_of)
    items: list[list[str]] = []
    for line in rest_of:
        if len(line) - len(line.lstrip()) == depth or not items:
            items.append([line.strip()])
        else:
            items[-1].append(line.strip())
    found = [f"**{word}:**", ""]
    for item in items:
        text = " ".join(item)
        entry = ENTRY.fullmatch(text)
        names = "" if entry is None else ", ".join(f"``{one.strip()}``" for one in entry[1].split(","))
        found.append(f"- {marked(text)}" if entry is None else f"- {names}: {marked(entry[2])}")
    return [*found, ""]


def marked(line: str) -> str:
    """Code, and names that lead somewhere; all other characters that mean something to Sphinx as they are."""
    parts = CODE.split(line)
    text = ""
    for i, part in enumerate(parts):
        text += _code(part) if i % 2 else _escaped(part)
        after = parts[i + 1] if i + 1 < len(parts) else ""
        if (text[-1:].isalnum() and not i % 2 and after) or (i % 2 and after[:1].isalnum()):
            text += "\\ "  # markup ends at a word's end, or at an escaped space
    return text


def _escaped(text: str) -> str:
    text = re.sub(r"([\\*|])", r"\\\1", text)
    return re.sub(r"(?<=\w)_(?!\w)", r"\\_", text)


def _code(text: str) -> str:
    if text in ELSEWHERE:
        return f"`{text} <{ELSEWHERE[text]}>`__"
    name = text.removeprefix("rfem_jax.")
    return f":py:obj:`~rfem_jax.{name}`" if name in rfem_jax.__all__ else f"``{text}``"
