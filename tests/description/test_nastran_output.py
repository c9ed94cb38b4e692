"""Reduced bodies in binary files of Nastran: those that Nastran wrote, and what is wrong with others in a sentence."""

import struct
import tomllib
from itertools import count
from pathlib import Path

import numpy as np
import pytest

from rfem_jax import Joint, Link, Mechanism, discretise, load_body, natural_frequencies
from rfem_jax.description.study_file import study_reader

pytest.importorskip("pyyeti.nastran")

import pyyeti
from pyyeti.nastran import op4

WRITTEN = Path(pyyeti.__file__).parent / "tests"  # files of Nastran that the package has for its own tests
ASSEMBLY = """$ the second interface has its displacements along axes of its own
SEBULK,102,EXTOP4,,MANUAL,,,102
CORD2R,10,0,0.,0.,0.,1.,0.,0.
,0.,1.,0.
SECONCT,102,0,,NO
,20,20,10,10,31,31,32,32
GRID,20,0,300.,0.,10.,10
GRID,10,0,0.,0.,0.,0
SPOINT,31,32
"""
LABELS = [(grid, component) for grid in (20, 10) for component in range(1, 7)] + [(31, 0), (32, 0)]


@pytest.fixture(scope="module")
def wanted():
    """Interfaces, mass and stiffness of a beam between two grids and two modes [mm, t], along basic axes."""
    places = np.array([[0.0, 0.0, 0.0], [300.0, 0.0, 10.0]])
    rigid = np.eye(12, 6)
    x, y, z = places[1]
    rigid[6:, :3], rigid[9:, 3:] = np.eye(6, 3), np.eye(3)
    rigid[6:9, 3:] = -np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    free = np.eye(12) - rigid @ np.eye(6, 12)
    shape = np.random.default_rng(1).normal(size=(12, 12))
    stiffness = np.diag([1e3] * 14)
    stiffness[:12, :12] = free.T @ (shape @ shape.T + 9.0 * np.eye(12)) @ free
    ends = np.diag([1e-3] * 3 + [2.0] * 3)
    mass = np.eye(14) * 1e-3
    mass[:6, :6] = mass[6:12, 6:12] = ends
    return places, mass, stiffness


def as_written(matrix):
    """Rows in the order of the assembly file; displacements of grid 20 along its axes: y, z and x of the basic ones."""
    turned, own = np.eye(14), np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
    turned[6:9, 6:9] = turned[9:12, 9:12] = own
    order = [*range(6, 12), *range(6), 12, 13]
    return (turned @ matrix @ turned.T)[np.ix_(order, order)]


def records(*content):
    """Records of a file of OUTPUT2: each its length, its content, and its length."""
    return b"".join(struct.pack("<i", len(one)) + one + struct.pack("<i", len(one)) for one in content)


def keys(*numbers):
    return records(*(struct.pack("<i", number) for number in numbers))


def block(name, trailer, kind, body):
    """A data block: its name, its trailer, its kind (0 a table, 1 a matrix), and what is in it."""
    named = name.ljust(8).encode()
    head = keys(2) + records(named) + keys(-1, 7) + records(struct.pack("<7i", *trailer))
    return head + keys(-2, 1, 0, 2) + records(named) + keys(-3, 1, kind) + body


def matrix_block(name, matrix):
    rows, body, number = len(matrix), b"", count(-4, -1)
    for k, column in enumerate(matrix.T):
        body += (
            keys(1 + 2 * rows)
            + records(struct.pack(f"<i{rows}d", 1, *column))
            + keys(next(number), 1, int(k < rows - 1))
        )
    return block(name, (101, rows, rows, 6, 2, rows, 0), 1, body + keys(0))


def table_block(name, matrix, labels=LABELS):
    """A symmetric matrix of entries with their points, as DMIG has them."""
    words = struct.pack("<3i8s7i", 114, 1, 120, name.ljust(8).encode(), 0, 6, 2, 0, 0, 0, 0)
    for j, (grid, component) in enumerate(labels):
        words += struct.pack("<2i", grid, component)
        words += b"".join(struct.pack("<2id", *labels[i], matrix[i, j]) for i in range(j, len(labels)))
        words += struct.pack("<2i", -1, -1)
    words += struct.pack("<2i", -1, -1)
    body = keys(len(words) // 4) + records(words) + keys(-4, 1, 0, 0)
    return block(f"M{name}", (101, 32768, 0, 0, 0, 0, 0), 0, body)


def assert_same(found, wanted):
    for name, one in zip(("interfaces", "mass", "stiffness"), wanted, strict=True):
        value = getattr(found, name)
        np.testing.assert_allclose(value, one, rtol=1e-12, atol=1e-12 * np.abs(one).max(), err_msg=name)


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "arm.asm").write_text(ASSEMBLY, encoding="utf-8")
    return tmp_path


def test_what_nastran_wrote_has_the_mass_that_it_printed():
    """Its own sum of masses, and the centre of mass: NX 9, lengths in inches, one interface along turned axes."""
    folder = WRITTEN / "nas2cam_extseout"
    body = load_body(folder / "inboard.op4")
    assert body.total_mass == pytest.approx(1.755052, rel=1e-6)
    # From grid 3, which is at (600, 0, 300): that of the lowest number.
    np.testing.assert_allclose(body.interfaces, [[0, 0, 0], [0, 300, 0], [0, 300, -300], [0, 0, -300]])
    moved, turned = np.tile(np.eye(6, 3), (4, 1)), np.zeros((24, 3))
    for k, (x, y, z) in enumerate(body.interfaces):
        turned[6 * k : 6 * k + 6] = [[0, z, -y], [-z, 0, x], [y, -x, 0], *np.eye(3)]
    first = moved.T @ body.mass[:24, :24] @ turned / 1.755052
    centre = 600.0 + first[1, 2], first[2, 0], 300.0 + first[0, 1]
    np.testing.assert_allclose(centre, [1039.998, 150.0, 150.0], rtol=1e-6)
    # Its masses, lumped at nodes, leave a motion without inertia.
    model = discretise(Mechanism([Link("part", body=body)], [Joint("A", "base", "part", kind="fixed")]))
    squares = np.linalg.eigvals(np.linalg.solve(body.mass[6:, 6:], body.stiffness[6:, 6:])).real
    slowest = np.sqrt(np.sort(squares)[:4]) / (2.0 * np.pi)
    np.testing.assert_allclose(natural_frequencies(model, count=4).frequency, slowest, rtol=1e-5)
    assert len(body.mass) == 24 + 8 and load_body(folder / "outboard.op4").total_mass == pytest.approx(
        1.59038, rel=1e-5
    )


@pytest.mark.parametrize("names", [("KXX", "MXX"), ("KAAX", "MAAX")])
def test_matrices_without_names_of_rows(folder, wanted, names):
    op4.write(folder / "arm.op4", dict(zip(names, map(as_written, wanted[:0:-1]), strict=True)))
    assert_same(load_body(folder / "arm.op4"), wanted)
    blocks = [matrix_block(name, as_written(one)) for name, one in zip(names, wanted[:0:-1], strict=True)]
    (folder / "arm.op2").write_bytes(b"".join(blocks) + keys(0))
    assert_same(load_body(folder / "arm.op2"), wanted)


def test_matrices_with_their_points(folder, wanted):
    blocks = [table_block(name, as_written(one)) for name, one in zip(("KAAX", "MAAX"), wanted[:0:-1], strict=True)]
    (folder / "arm.op2").write_bytes(b"".join(blocks) + keys(0))
    assert_same(load_body(folder / "arm.op2"), wanted)


def test_the_guide_names_a_file_and_its_assembly_file(folder, wanted):
    guide = (Path(__file__).parents[2] / "docs" / "guides" / "own_mechanism.md").read_text(encoding="utf-8")
    text = guide.split("## Links from a finite element program")[1].split("```toml\n")[1].split("```")[0]
    (link,) = [one for one in tomllib.loads(text)["mechanism"]["links"] if one["name"] == "lever"]
    assert link["body"]["grids"] == "lever.asm"
    op4.write(folder / "lever.op4", {"KXX": as_written(wanted[2]), "MXX": as_written(wanted[1])})
    (folder / "arm.asm").rename(folder / "lever.asm")
    read = study_reader._read_link(link, "lever", {}, {}, folder)
    assert read.body.total_mass == pytest.approx(2.0) and read.length == pytest.approx(np.hypot(0.3, 0.01))
    (folder / "lever.asm").rename(folder / "rows.asm")
    renamed = link["body"] | {"grids": "rows.asm"}
    assert study_reader._read_body(renamed, "body", folder) == read.body


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("absent.op4", None, ("absent.op4", "but there is none")),
        ("arm.op2", b"", ("OUTPUT2", "empty")),
        ("arm.op2", b"\4\0\0\0\3\0\0\0\4\0\0\0" + b"x" * 50, ("OUTPUT2",)),
        ("arm.op2", b"text, not a binary file", ("OUTPUT2",)),
        ("arm.op2", table_block("KAAX", np.eye(14)) + keys(0), ("one mass matrix", "has KAAX")),
        ("arm.op4", {"KXX": np.eye(14)}, ("one mass matrix", "has KXX")),
        ("arm.op4", {"K1": np.eye(14), "K2": np.eye(14), "MXX": np.eye(14)}, ("one stiffness matrix", "K1, K2")),
        ("arm.op4", {"KXX": np.eye(13), "MXX": np.eye(14)}, ("14 rows", "KXX is 13 x 13", "same run")),
        ("arm.op4", {"KXX": np.eye(14), "MXX": np.eye(14), "BXX": np.eye(14)}, ("damping matrix", "BXX")),
        ("arm.op4", {"KXX": np.eye(14), "MXX": np.eye(14)}, ("rigid motions",)),
    ],
)
def test_what_is_wrong_is_said(refused, folder, name, content, said):
    path = folder / name
    if isinstance(content, dict):
        op4.write(path, content)
    elif content is not None:
        path.write_bytes(content)
    with refused(*said):
        load_body(path)


def test_files_that_are_cut_short_are_refused(refused, folder, wanted):
    path = folder / "arm.op4"
    op4.write(path, {"KXX": as_written(wanted[2]), "MXX": as_written(wanted[1])})
    whole = path.read_bytes()
    for missing in (4, 12, 40, 800):
        path.write_bytes(whole[:-missing])
        with refused("OUTPUT4"):
            load_body(path)


def test_points_without_entries_have_no_mass(refused, folder, wanted):
    bare = np.array(as_written(wanted[1]))
    bare[13] = bare[:, 13] = 0.0
    blocks = [table_block("KAAX", as_written(wanted[2])), table_block("MAAX", bare, LABELS[:13])]
    (folder / "arm.op2").write_bytes(b"".join(blocks) + keys(0))
    with refused("`mass`", "leave out rows without any"):
        load_body(folder / "arm.op2")


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        (ASSEMBLY, "", ("assembly file",)),
        ("SPOINT,31,32\n", "", ("assembly file",)),
        ("10.,10\n", "10.,11\n", ("assembly file",)),
        ("GRID,10", "GRID,11", ("assembly file",)),
        ("GRID,20,0,300.", "GRID,20,0,310.", ("rigid motions",)),
        ("GRID,20,0,300.,0.,10.,10", "GRID,20,0,300.,0.,10.,0", ("rigid motions",)),
    ],
)
def test_another_assembly_file_is_refused(refused, folder, wanted, old, new, said):
    op4.write(folder / "arm.op4", {"KXX": as_written(wanted[2]), "MXX": as_written(wanted[1])})
    (folder / "arm.asm").write_text(ASSEMBLY.replace(old, new), encoding="utf-8")
    with refused(*said):
        load_body(folder / "arm.op4")


def test_a_punched_file_beside_it_may_tell_components(refused, folder, wanted):
    op4.write(folder / "arm.op4", {"KXX": as_written(wanted[2]), "MXX": as_written(wanted[1])})
    punched = folder / "arm.pch"
    punched.write_text("$TITLE   = results of another run\n", encoding="utf-8")
    assert_same(load_body(folder / "arm.op4"), wanted)
    punched.write_text("EXTRN,20,123456,10,123456,31,0,32,0\n", encoding="utf-8")
    assert_same(load_body(folder / "arm.op4"), wanted)
    punched.write_text("EXTRN,20,123456,10,123,31,0,32,0\n", encoding="utf-8")
    with refused("six components", "keep all six"):
        load_body(folder / "arm.op4")


def test_folders_are_no_files(refused, folder):
    (folder / "bar.op2").mkdir()
    with refused("bar.op2", "but there is none"):
        load_body(folder / "bar.op2", grids=folder / "arm.asm")


def test_the_assembly_file_is_of_binary_files_alone(refused, folder):
    with refused("`grids`", "remove it"):
        load_body(folder / "arm.pch", grids=folder / "arm.asm")
    with refused("arm2.asm", "but there is none"):
        op4.write(folder / "arm2.op4", {"KXX": np.eye(14), "MXX": np.eye(14)})
        load_body(folder / "arm2.op4")
