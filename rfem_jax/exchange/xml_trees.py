"""XML of strangers as a tree: no document types, so no entities that grow or read other files; neither too deep.

Place in the pipeline: **xml_trees** -> urdf, and the choice of a reader in `files`.
"""

from collections.abc import Iterable
from xml.etree import ElementTree as Xml
from xml.parsers import expat

from rfem_jax.description.basics.errors import InputError

DEEPEST = 200
LARGEST = 50_000_000  # bytes of a file that is read


def read_tree(text: str) -> Xml.Element:
    """The first element of a text. Raises InputError."""
    builder, depth = Xml.TreeBuilder(), 0
    parser = expat.ParserCreate()

    def start(tag: str, attributes: dict[str, str]) -> None:
        nonlocal depth
        depth += 1
        if depth > DEEPEST:
            raise InputError(f"The elements of the file must be nested at most {DEEPEST} deep, but are deeper.")
        builder.start(tag, attributes)

    def end(tag: str) -> None:
        nonlocal depth
        depth -= 1
        builder.end(tag)

    def refuse(*_: object) -> None:
        raise InputError("The file must be without a document type (DTD), but has one; remove <!DOCTYPE ...>.")

    parser.StartElementHandler, parser.EndElementHandler = start, end
    parser.CharacterDataHandler = builder.data
    parser.StartDoctypeDeclHandler = refuse
    try:
        parser.Parse(text.encode("utf-8"), True)
        return builder.close()
    except expat.ExpatError as error:
        raise InputError(f"The file must be XML, but is not ({error}); correct it.") from None


def numbers_text(values: Iterable[float]) -> str:
    """Numbers as attributes have them; what is rounding beside one is zero."""
    return " ".join(repr(0.0 if abs(x) < 1e-16 else float(x)) for x in values)
