"""Files that are damaged: each becomes a study that can be read, or is refused in one sentence."""

import random
from copy import deepcopy
from xml.etree import ElementTree as Xml

import pytest

from rfem_jax import InputError, load_study
from rfem_jax.exchange.files import read_layout
from rfem_jax.exchange.frame_table import table_text
from rfem_jax.exchange.mjcf_writer import mjcf_text
from rfem_jax.exchange.study_layout import layout_of
from rfem_jax.exchange.study_writer import study_text
from rfem_jax.exchange.urdf_writer import urdf_text

from .machines import study
from .test_fcstd import document_of, zipped
from .test_mjcf import needs_mujoco
from .test_sdf import FOREIGN as DOOR
from .test_sdf import sdf_of
from .test_urdf import FOREIGN, arm

VALUES = (
    "nan",
    "inf",
    "-1",
    "1e400",
    "0",
    "",
    "x",
    "1 2",
    "base",
    "é",
    "\x00",
    '"',
    "<",
    "1e-300",
    "99999999999999999999",
)


def mutated(text, seed):
    """A text with one to three pieces lost, doubled, exchanged or replaced."""
    chance = random.Random(seed)
    for _ in range(chance.randint(1, 3)):
        pieces = [piece for piece in text.replace(">", ">\n").split("\n") if piece]
        kind, at = chance.randrange(6), chance.randrange(len(pieces))
        if kind == 0:
            del pieces[at]
        elif kind == 1:
            pieces.insert(at, pieces[chance.randrange(len(pieces))])
        elif kind == 2:
            other = chance.randrange(len(pieces))
            pieces[at], pieces[other] = pieces[other], pieces[at]
        else:
            mark = chance.choice(' ",=')
            words = pieces[at].split(mark)
            words[chance.randrange(len(words))] = chance.choice(VALUES)
            pieces[at] = mark.join(words)
        text = "\n".join(pieces)
    return text


def with_mutated_tree(text, seed):
    """XML that stays well-formed: one to three elements lost, doubled or moved, or with another value."""
    chance, root = random.Random(seed), Xml.fromstring(text)
    for _ in range(chance.randint(1, 3)):
        pairs = [(parent, child) for parent in root.iter() for child in parent]
        if not pairs:
            break
        parent, child = chance.choice(pairs)
        kind = chance.randrange(5)
        if kind == 0:
            parent.remove(child)
        elif kind == 1:
            parent.append(deepcopy(child))
        elif kind == 2:
            chance.choice(pairs)[0].append(deepcopy(child))
        elif (child.attrib and kind == 3) or not (child.text or "").strip():
            if child.attrib:
                child.set(chance.choice(sorted(child.attrib)), chance.choice(VALUES).replace("\x00", "?"))
        else:
            child.text = chance.choice(VALUES).replace("\x00", "?")
    return Xml.tostring(root, encoding="unicode")


@pytest.fixture(scope="module")
def texts():
    return {
        "csv": table_text(layout_of(study("slider_crank")), "a test")[0],
        "urdf": urdf_text(layout_of(arm()), "a test")[0],
        "foreign": FOREIGN,
        "sdf": DOOR,
        "loop": sdf_of(layout_of(study("four_bar"))),
        "fcstd": document_of(layout_of(study("slider_crank"))),
        "mjcf": mjcf_text(layout_of(study("four_bar")), "a test")[0],
    }


def outcome(name, text, folder):
    """None for a study, else the sentences that refuse."""
    path, toml = folder / "file.xml", folder / "study.toml"
    if name == "fcstd":
        zipped(path, text)
    else:
        path.write_text(text, encoding="utf-8")
    try:
        layout, kind = read_layout(path)
        toml.write_text(study_text(layout, kind, toml.name), encoding="utf-8")
        load_study(toml)
    except InputError as error:
        return error.problems
    return None


def check(name, texts, folder, seeds):
    ways = (mutated,) if name == "csv" else (mutated, with_mutated_tree)
    found = [outcome(name, way(texts[name], seed), folder) for seed in seeds for way in ways]
    refused = [one for one in found if one is not None]
    assert 0 < len(refused) < len(found)
    for problems in refused:
        assert len(problems) == 1 and "\n" not in problems[0] and problems[0].rstrip().endswith((".", "?")), problems
    return refused


@pytest.mark.parametrize("name", ["csv", "urdf", "foreign", "sdf", "loop", "fcstd"])
def test_a_study_or_one_sentence(name, texts, tmp_path):
    check(name, texts, tmp_path, range(40))


@needs_mujoco
def test_mjcf(texts, tmp_path):
    check("mjcf", texts, tmp_path, range(70))


def test_a_damaged_zip(texts, tmp_path):
    """Bytes that are lost or changed, in the archive and in its directory."""
    whole = zipped(tmp_path / "whole", texts["fcstd"]).read_bytes()
    path = tmp_path / "file"
    for seed in range(30):
        chance, content = random.Random(seed), bytearray(whole)
        for _ in range(chance.randint(1, 4)):
            content[chance.randrange(4, len(content))] = chance.randrange(256)
        path.write_bytes(content[: chance.randrange(10, len(content))] if seed % 3 == 0 else content)
        try:
            read_layout(path)
        except InputError as error:
            assert len(error.problems) == 1


def test_neither_binary_nor_missing_nor_folders(tmp_path):
    for content in (b"\xff\xfe\x00", b"", b"\x00" * 100, b"<", b"\xef\xbb\xbf"):
        path = tmp_path / "file"
        path.write_bytes(content)
        with pytest.raises(InputError) as found:
            read_layout(path)
        assert len(found.value.problems) == 1
    with pytest.raises(InputError, match="can be read"):
        read_layout(tmp_path)
