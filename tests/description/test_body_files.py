"""Reduced bodies in files: what is written is read, in all formats and units; what is wrong is said in a sentence."""

import sys
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.io import mmwrite
from scipy.sparse import coo_array

from rfem_jax import (
    AxisPoint,
    Interface,
    Joint,
    Link,
    Mechanism,
    Problem,
    Rectangle,
    ReducedBody,
    RungeKutta4,
    Simulation,
    craig_bampton,
    discretise,
    load_body,
    save_body,
)
from rfem_jax.compilation import keys
from rfem_jax.description.bodies.body_files import read_matrices
from rfem_jax.description.study_file import study_reader
from rfem_jax.tolerancing.problems.kept_evaluations import known_content
from tests.mechanisms import STEEL

_read_body = study_reader._read_body

MM = ("mm", "t", "s")


@pytest.fixture(scope="module")
def body():
    """A bar of beads: two interfaces, three modes, one place of stress."""
    nodes = np.array([[x, y, z] for x in range(4) for y in (0.0, 0.1) for z in (0.0, 0.1)]) / 10.0
    stiffness = np.zeros((48, 48))
    for i in range(16):
        for j in range(i):
            row, apart = np.zeros(48), nodes[i] - nodes[j]
            if np.linalg.norm(apart) < 0.15:
                row[3 * i : 3 * i + 3], row[3 * j : 3 * j + 3] = apart, -apart
                stiffness += 1e9 * np.outer(row, row)
    ends = [Interface((0.0, 0.0, 0.0), [0, 1, 2, 3]), Interface((0.3, 0.0, 0.01), [12, 13, 14, 15])]
    rows = np.vstack([stiffness[:6]]) * 1e4
    return craig_bampton(np.eye(48) * 0.01, stiffness, nodes, ends, 3, 1e-5, rows, ("fillet",))


def assert_same(one, other, rtol=1e-12):
    for name in ("interfaces", "mass", "stiffness", "moments", "stresses"):
        found, wanted = getattr(one, name), getattr(other, name)
        assert (found is None) == (wanted is None), name
        if wanted is not None:
            np.testing.assert_allclose(found, wanted, rtol=rtol, atol=rtol * np.abs(wanted).max(), err_msg=name)
    assert one.stress_names == other.stress_names and float(one.damping) == pytest.approx(float(other.damping))


def in_mm_and_t(body):
    """The arguments of the body, in mm, t and s; amplitudes of modes in mm, as displacements."""
    row = np.tile([1e3] * 3 + [1.0] * 3, 3)[: len(body.mass)]
    row[12:] = 1e3
    matrices = {"mass": 1e-3, "stiffness": 1e-3}  # t and N/mm by displacements
    scaled = {name: getattr(body, name) * by * 1e6 / row[:, None] / row for name, by in matrices.items()}
    return {
        **scaled,
        "interfaces": 1e3 * body.interfaces,
        "moments": body.moments * 1e-3 * 1e6 / row,
        "stresses": body.stresses * 1e-6 / row,
        "damping": body.damping,
        "stress_names": body.stress_names,
    }


def test_what_is_written_is_read(body, tmp_path):
    path = save_body(body, tmp_path / "bar.npz")
    assert load_body(path) == body and load_body(str(path), "20 us").damping == pytest.approx(2e-5)
    bare = ReducedBody(body.interfaces, body.mass, body.stiffness)
    assert load_body(save_body(bare, tmp_path / "bare.npz")) == bare


def test_an_archive_in_other_units(body, tmp_path):
    np.savez(tmp_path / "bar.npz", **in_mm_and_t(body))
    assert_same(load_body(tmp_path / "bar.npz", units=MM), body)
    # Forces per 1 ms^2 are a million times those per 1 s^2.
    faster = replace(body, stiffness=1e6 * body.stiffness, stresses=1e6 * body.stresses, damping=1e-8)
    assert_same(load_body(tmp_path / "bar.npz", units=("mm", "t", "ms")), faster)


def test_the_length_of_a_link_with_a_body_or_an_axis_may_be_said_in_any_unit(refused, body):
    """It is known already: the same one is taken, another refused."""
    along = np.hypot(0.3, 0.01)
    bent = {"axis": [AxisPoint((0.3, 0.0, 0.01))], "section": Rectangle(0.01, 0.01), "material": STEEL}
    for more in ({"body": body}, bent):
        assert Link("bar", f"{1e3 * along} mm", **more).length == pytest.approx(along)
        for wrong, words in (("310 mm", "left out"), ("310 kg", "a mass"), (0.31, "left out")):
            with refused("`length`", words):
                Link("bar", wrong, **more)


@pytest.mark.parametrize("sparse", [True, False])
@pytest.mark.parametrize("symmetry", ["symmetric", "general"])
def test_matrices_of_matrix_market(body, tmp_path, sparse, symmetry):
    content = in_mm_and_t(body)
    for name in ("mass", "stiffness"):
        own = coo_array(content[name]) if sparse else content[name]
        mmwrite(tmp_path / f"{name}.mtx", own, symmetry=symmetry, precision=16)
    assert ("coordinate" if sparse else "array") in (tmp_path / "mass.mtx").read_text(encoding="utf-8")
    paths = tmp_path / "mass.mtx", tmp_path / "stiffness.mtx"
    places = [[0, 0, 0], ["300 mm", 0, "1 cm"]]
    wanted = ReducedBody(body.interfaces, body.mass, body.stiffness, 1e-5)
    assert_same(read_matrices(*paths, places, "10 us", MM), wanted)
    table = {"mass": "mass.mtx", "stiffness": "stiffness.mtx", "interfaces": places, "units": list(MM)}
    assert_same(_read_body(table | {"damping": 1e-5}, "body", tmp_path), wanted)


# Two GRIDs of a beam, a mode, in fields of 8 characters, of 16, and between commas; symmetric, half given.
HEAD = """$ a comment
GRID          20        300.    0.0          10.
GRID*                 10                              0.              0.
*                     0.
SPOINT  7
"""


def as_bulk_data(content, form="large", order=(10, 20), symmetric=True):
    """DMIG entries of the matrices of a body with two interfaces and one mode a scalar point from 7 on."""
    count = len(content["mass"]) - 12
    rows = [(grid, c) for grid in order for c in range(1, 7)] + [(7 + k, 0) for k in range(count)]
    text = f"SPOINT,{7 + count - 1}\n" if count else ""
    for name, matrix in (("KAAX", content["stiffness"]), ("MAAX", content["mass"])):
        text += f"DMIG    {name}           0{6 if symmetric else 1:8d}       2       0{'':16s}{len(rows):8d}\n"
        for j, (grid, component) in enumerate(rows):
            entries = [(*rows[i], matrix[i, j]) for i in range(j if symmetric else 0, len(rows)) if matrix[i, j] != 0.0]
            if form == "large":
                text += f"DMIG*   {name:16s}{grid:16d}{component:16d}\n"
                values = [(g, c, f"{v:.9e}".replace("e", "D")) for g, c, v in entries]
                text += "".join(f"*       {g:16d}{c:16d}{v:>16s}\n" for g, c, v in values)
            else:
                flat = "".join(f",{g},{c},{v:.15e}," for g, c, v in entries)
                fields = f"{name},{grid},{component},{flat}".split(",")
                lines = [",".join(fields[k : k + 8]) for k in range(0, len(fields), 8)]
                text += f"DMIG,{lines[0]}\n" + "".join(f",{line}\n" for line in lines[1:])
    return text


@pytest.mark.parametrize(
    ("form", "symmetric", "rtol"), [("large", True, 1e-8), ("free", True, 1e-12), ("free", False, 1e-12)]
)
def test_bulk_data(body, tmp_path, form, symmetric, rtol):
    content = in_mm_and_t(body)
    (tmp_path / "bar.pch").write_text(as_bulk_data(content, form, symmetric=symmetric), encoding="utf-8")
    path = tmp_path / "bar.bdf"
    path.write_text(f"{HEAD}INCLUDE 'bar.pch'\nENDDATA\n", encoding="utf-8")
    wanted = ReducedBody(body.interfaces, body.mass, body.stiffness, 1e-5)
    assert_same(load_body(path, "10 us", MM), wanted, rtol)
    if form == "large":  # a study names the file from its folder
        table = {"file": "bar.bdf", "units": list(MM), "damping": "10 us"}
        assert_same(_read_body(table, "body", tmp_path), wanted, rtol)


@pytest.mark.parametrize("ending", [".op2", ".OP4"])
def test_binary_files_of_nastran_need_their_reader(refused, monkeypatch, ending):
    monkeypatch.setitem(sys.modules, "pyyeti.nastran", None)
    with refused("rfem_jax[nastran]", "EXTSEOUT"):
        load_body(f"bar{ending}")


def test_a_file_that_is_cut_short_is_refused(refused, body, tmp_path):
    path = tmp_path / "bar.bdf"
    text = HEAD + as_bulk_data(in_mm_and_t(body), "free")
    path.write_text(text[: text.rindex("DMIG,MAAX")], encoding="utf-8")
    with refused("mass and stiffness of every mode", "point 9"):
        load_body(path, units=MM)


def test_grids_stand_in_the_order_of_their_numbers(body, tmp_path):
    """The matrices are of grids 20 and 10; the body is that of 10 and 20."""
    content, path = in_mm_and_t(body), tmp_path / "bar.bdf"
    path.write_text(f"{HEAD}{as_bulk_data(content, 'free', (20, 10))}", encoding="utf-8")
    swapped = [*range(6, 12), *range(6), 12, 13, 14]
    places = np.array([[0.3, 0.0, 0.01], [0.0, 0.0, 0.0]])
    with pytest.raises(ValueError, match="rigid motions"):  # as the places are not those of the matrices
        load_body(path, units=MM)
    path.write_text(
        path.read_text("utf-8").replace("300.    0.0          10.", "-300.   0.0         -10."), encoding="utf-8"
    )
    matrices = [np.asarray(one)[np.ix_(swapped, swapped)] for one in (body.mass, body.stiffness)]
    assert_same(load_body(path, units=MM), ReducedBody(places, *matrices))


SHORT = "GRID,1,,0.,0.,0.\nDMIG,KAAX,0,6,2,0,,,6\nDMIG,KAAX,1,1,,1,1,1.0\nDMIG,MAAX,0,6,2,0,,,6\nDMIG,MAAX,1,1,,1,1,1."


@pytest.mark.parametrize(
    ("name", "content", "pieces"),
    [
        ("absent.npz", None, ("absent.npz", "there is none")),
        ("absent.bdf", None, ("absent.bdf", "No such file")),
        ("bar.txt", b"", ("`.txt`", ".npz, .bdf, .pch, .op2 or .op4")),
        ("bar.npz", b"", ("an archive of NumPy",)),
        ("bar.npz", b"PK\x03\x04rubbish", ("an archive of NumPy",)),
        ("bar.npz", {"masses": np.eye(12)}, ("`masses`", "did you mean `mass`?")),
        ("bar.npz", {"mass": np.eye(12)}, ("array `interfaces`", "none")),
        ("bar.npz", {"mass": 1j * np.eye(12)}, ("complex numbers",)),
        ("bar.npz", {"mass": np.array([{}], dtype=object)}, ("Object arrays cannot be loaded",)),
        (
            "bar.npz",
            {"interfaces": ["a"], "mass": np.eye(12), "stiffness": np.eye(12)},
            ("`interfaces`", "n x 3 numbers"),
        ),
        ("bar.npz", {"interfaces": np.eye(3), "mass": np.eye(12), "stiffness": np.eye(12)}, ("`mass`", "six rows")),
        ("bar.bdf", "GRID,1", ("DMIG KAAX", "no DMIG entry")),
        ("bar.bdf", b"\0\1\2", ("binary file",)),
        ("bar.bdf", "INCLUDE 'bar.bdf'", ("levels deep", "circle")),
        ("bar.bdf", SHORT, ("component 2 of GRID 1", "six rows")),
        ("bar.bdf", SHORT.replace("GRID,1,,", "GRID,1,5,"), ("basic coordinate system", "GRID 1")),
        ("bar.bdf", SHORT.replace("GRID,1,", "GRID,2,"), ("GRID entry for point 1",)),
        ("bar.bdf", SHORT.replace("KAAX,1,1,", "KAAX,1,7,"), ("components 1 to 6 of GRID 1", "7")),
        ("bar.bdf", SHORT.replace("1.0", "one"), ("numbers in all fields", "one")),
        ("bar.bdf", SHORT.replace("KAAX,0,6,2", "KAAX,0,6,4"), ("KAAX is of form 6 and type 4",)),
        ("bar.bdf", SHORT.replace("DMIG,MAAX,0,6,2,0,,,6\n", ""), ("head of a matrix", "MAAX has none")),
        ("bar.bdf", SHORT.replace("MAAX", "KBBX"), ("one mass matrix", "KAAX, KBBX")),
        ("bar.bdf", f"{SHORT}\nDMIG,KAAX,0,6,2,0,,,6", ("second head of KAAX",)),
        ("bar.bdf", f"{SHORT}\nDMIG,KAAX,1,1,,1,1,2.0", ("row (1, 1) of column (1, 1)", "twice")),
        ("bar.bdf", f"{SHORT}\nGRID,1,,1.,0.,0.", ("each GRID once",)),
        ("bar.bdf", f"{SHORT}\nSPOINT,1,THRU,999999999", ("SPOINT",)),
    ],
)
def test_wrong_files_are_refused(refused, tmp_path, name, content, pieces):
    path = tmp_path / name
    if isinstance(content, dict):
        np.savez(path, **content)
    elif content is not None:
        path.write_bytes(content.encode() if isinstance(content, str) else content)
    with refused(*pieces):
        load_body(path)


def test_damping_of_a_file_is_not_forgotten(refused, body, tmp_path):
    path = tmp_path / "bar.bdf"
    text = HEAD + as_bulk_data(in_mm_and_t(body), "free") + "DMIG,BAAX,0,6,2,0,,,15\nDMIG,BAAX,10,1,,10,1,1.0\n"
    path.write_text(text, encoding="utf-8")
    with refused("damping matrix", "BAAX"):
        load_body(path, units=MM)
    assert load_body(path, 0.0, MM).damping == 0.0


MATRICES = {"mass": "m.mtx", "stiffness": "k.mtx", "interfaces": [[0, 0, 0]]}


@pytest.mark.wrong_types
@pytest.mark.parametrize(
    ("table", "pieces"),
    [
        ({"file": 3}, ("`file` of a reduced body", "a path")),
        ({"file": "a.npz", "unit": "mm"}, ("of a file", "`unit`", "did you mean `units`?")),
        ({"file": "a.npz", "interfaces": [[0, 0, 0]]}, ("of a file", "`interfaces`")),
        ({"file": "a.npz", "units": "mm"}, ("`units`", "mm")),
        ({"file": "a.npz", "units": ["mm", "m", "s"]}, ("`units`", "a mass")),
        ({"file": "a.npz", "units": ["mm", "0 kg", "s"]}, ("`units`", "greater than 0")),
        ({"stiffness": "k.mtx", "interfaces": [[0, 0, 0]]}, ("of two files", "the key `mass`")),
        (MATRICES | {"mass": 1.0}, ("`mass` of a reduced body", "a path")),
        (MATRICES | {"interfaces": 3}, ("`interfaces`", "list of places")),
        (MATRICES | {"interfaces": [[0, 0]]}, ("`interfaces` (place 1)", "three components")),
        (MATRICES, ("m.mtx", "there is none")),
        (MATRICES | {"mass": "rubbish.mtx"}, ("rubbish.mtx", "Matrix Market")),
        (MATRICES | {"mass": "complex.mtx"}, ("complex.mtx", "real matrix")),
        (MATRICES | {"mass": "huge.mtx"}, ("huge.mtx", "at most 3000 rows")),
        (MATRICES | {"mass": "short.mtx"}, ("short.mtx", "9 numbers, not 10")),
        (MATRICES | {"mass": "fewer.mtx"}, ("fewer.mtx", "1 entries, of 2")),
    ],
)
def test_wrong_tables_are_refused(refused, tmp_path, table, pieces):
    (tmp_path / "rubbish.mtx").write_text("%%MatrixMarket\nno", encoding="utf-8")
    mmwrite(tmp_path / "complex.mtx", np.eye(12) * 1j)
    huge = "%%MatrixMarket matrix coordinate real symmetric\n1000000 1000000 1\n1 1 1.0\n"
    short = "%%MatrixMarket matrix array real symmetric\n4 4\n" + "1.0\n" * 9
    (tmp_path / "short.mtx").write_text(short, encoding="utf-8")
    fewer = "%%MatrixMarket matrix coordinate real general\n4 4 2\n1 1 1.0\n"
    (tmp_path / "fewer.mtx").write_text(fewer, encoding="utf-8")
    (tmp_path / "huge.mtx").write_text(huge, encoding="utf-8")
    with refused(*pieces):
        _read_body(table, "[[mechanism.links]] `bar` body", tmp_path)


def test_the_guide_names_files_in_all_formats(body, tmp_path):
    guide = (Path(__file__).parents[2] / "docs" / "guides" / "own_mechanism.md").read_text(encoding="utf-8")
    text = guide.split("## Links from a finite element program")[1].split("```toml\n")[1].split("```")[0]
    save_body(body, tmp_path / "rocker.npz")
    content = in_mm_and_t(body)
    (tmp_path / "fork.bdf").write_text(HEAD + as_bulk_data(content, "free"), encoding="utf-8")
    for name, letter in (("mass", "m"), ("stiffness", "k")):
        mmwrite(tmp_path / f"arm_{letter}.mtx", getattr(body, name), precision=16)
    links = tomllib.loads(text)["mechanism"]["links"]
    assert [link["name"] for link in links] == ["rocker", "fork", "lever", "arm"]
    for link in links[:2] + links[3:]:  # the lever, for which another package is needed: test_nastran_output
        read = study_reader._read_link(link, f"[[mechanism.links]] `{link['name']}`", {}, {}, tmp_path)
        np.testing.assert_allclose(read.body.stiffness, body.stiffness, rtol=1e-9, atol=1e-6)
        np.testing.assert_allclose(read.body.interfaces, body.interfaces, atol=1e-12)
        assert read.length == pytest.approx(np.hypot(0.3, 0.01))


def test_another_body_is_another_problem(body):
    """What an interrupted study compares: the content of the file, not its name."""
    other = replace(body, stiffness=body.stiffness * (1.0 + 1e-9))
    joints, method = [Joint("A", "base", "bar")], RungeKutta4(step=1e-5)
    mechanisms = [Mechanism([Link("bar", body=one)], joints) for one in (body, replace(body), other)]
    simulations = [Simulation(discretise(one), drive=None, duration=0.1, method=method) for one in mechanisms]
    problems = [Problem(one, ["A.rms_force"]) for one in simulations]
    for kinds in (map(known_content, problems), map(keys.digest_content, mechanisms)):
        first, again, changed = kinds
        assert first == again != changed and first is not None


def test_where_a_body_cannot_be_written(refused, body, tmp_path):
    with refused('".npz"'):
        save_body(body, tmp_path / "bar.txt")
    with refused("cannot", "No such file"):
        save_body(body, tmp_path / "none" / "bar.npz")


def test_in_si_units_of_pounds_and_inches(body, tmp_path):
    """A unit of mass without a name: 1 lbf s^2/in."""
    content = in_mm_and_t(body)
    np.savez(tmp_path / "bar.npz", **content)
    slow = load_body(tmp_path / "bar.npz", units=("1 mm", "1000 kg", "s"))
    assert_same(slow, body)
    assert load_body(tmp_path / "bar.npz", units=("in", "175.126836 kg", "s")).total_mass == pytest.approx(
        body.total_mass * 175.126836 / 1000.0
    )
