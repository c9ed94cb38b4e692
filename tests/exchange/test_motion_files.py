"""Motions for programs that draw: VTK's files and glTF, by the rules of their formats and against the records."""

import base64
import json
import struct
from dataclasses import replace
from importlib.util import find_spec
from itertools import pairwise
from xml.etree import ElementTree as Xml

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rfem_jax import Case, GeneralisedAlpha, Material, Rectangle, assembly_errors, discretise
from rfem_jax.description import Study
from rfem_jax.exchange.gltf_writer import _from_x, gltf_text
from rfem_jax.exchange.scene import parts_of
from rfem_jax.mechanics.dynamics.centre_lines import link_lines, trace_bodies
from rfem_jax.mechanics.model.model import Coordinates
from rfem_jax.mechanics.model.with_errors import apply_errors
from rfem_jax.report.contents.motion_files import write_motions
from rfem_jax.report.page.animation import record_animation
from rfem_jax.simulation import run_cases
from tests.mechanisms import curved_four_bar, four_bar

from .machines import MACHINES

NAME = "Stange <1> & \u201eÖse\u201c"  # a title as a case may have it


@pytest.fixture(scope="module")
def moved(tmp_path_factory):
    """A four-bar with a link that bends and an error, let go: its runs, their records, and all files."""
    mechanism = MACHINES["four_bar"]()
    steel = Material("steel", youngs_modulus=210e9, density=7850.0, poisson_ratio=0.3, damping=1e-5)
    bars = {"section": Rectangle(0.01, 0.01), "material": steel, "rfes": 3, "body": None}
    links = [replace(link, **bars) if link.name == "coupler" else link for link in mechanism.links]
    cases = Case("askew", {"D.delta_x": "0.5 deg"}), Case("perfect", {})
    study = Study(NAME, replace(mechanism, links=links), None, 0.02, GeneralisedAlpha(step=5e-4), cases=cases)
    runs = dict(run_cases(study)[1])
    records = record_animation(runs)
    folder = tmp_path_factory.mktemp("motion")
    files = write_motions(folder, runs, records, ["vtp", "gltf"])
    return runs, records, folder, files


def arrays_of(root):
    """All arrays of a file of VTK, by names."""
    found = {}
    for element in root.iter("DataArray"):
        parts = int(element.get("NumberOfComponents", "1"))
        values = np.array([float(word) for word in (element.text or "").split()])
        found[element.get("Name")] = values.reshape(-1, parts) if parts > 1 else values
    return found


@pytest.mark.long
def test_a_collection_has_all_instants(moved):
    runs, _, folder, files = moved
    assert [file.name for file in files] == [
        "motion_askew.gltf", "motion_askew.pvd", "motion_perfect.gltf", "motion_perfect.pvd",
    ]  # fmt: skip
    for case, run in runs.items():
        sets = list(Xml.parse(folder / f"motion_{case}.pvd").getroot().iter("DataSet"))
        np.testing.assert_array_equal([float(one.get("timestep")) for one in sets], np.asarray(run.times))
        assert all((folder / one.get("file")).exists() and "\\" not in one.get("file") for one in sets)


def test_points_loads_and_names_of_an_instant(moved):
    """Joints first, then the lines; forces on the child in global axes are those of the run."""
    runs, (description, (arrays, _)), folder, _ = moved
    t = len(arrays["times"]) - 1
    root = Xml.parse(folder / "motion_askew" / f"{t:04d}.vtp").getroot()
    piece = root.find("PolyData/Piece")
    found, names = arrays_of(root), [joint["name"] for joint in description["joints"]]
    joints, points = len(names), arrays["points"].shape[1]
    assert int(piece.get("NumberOfPoints")) == joints + points and piece.get("NumberOfVerts") == "4"
    np.testing.assert_array_equal(found["points"][:joints], arrays["centre"][t])
    np.testing.assert_array_equal(found["points"][joints:], arrays["points"][t])
    np.testing.assert_array_equal(found["deviation_m"][joints:], (arrays["points"] - arrays["nominal_points"])[t])
    offsets = [one for one in root.iter("DataArray") if one.get("Name") == "offsets"]
    counts = [link["points"] for link in description["links"]]
    assert [one.text.split() for one in offsets] == [list("1234"), [str(n) for n in np.cumsum(counts)]]
    through = [one.text.split() for one in root.iter("DataArray") if one.get("Name") == "connectivity"]
    assert [int(word) for word in (*through[0], *through[1])] == list(range(joints + points))
    in_global = runs["askew"].loads_in("global")
    for j, name in enumerate(names):
        np.testing.assert_allclose(found["force_N"][j], np.asarray(in_global[name].force)[t], atol=1e-9)
        np.testing.assert_allclose(found["moment_Nm"][j], np.asarray(in_global[name].moment)[t], atol=1e-9)
    assert np.abs(found["force_N"][:joints]).max() > 0.1 and not found["force_N"][joints:].any()
    texts = {one.get("Name"): bytes(int(word) for word in one.text.split()) for one in root.iter("Array")}
    assert texts["joints"] == b"".join(name.encode() + b"\0" for name in names)


def values_of(content, number):
    """An accessor's numbers; that it lies within its view, and the view within the buffer."""
    accessor = content["accessors"][number]
    view, buffer = content["bufferViews"][accessor["bufferView"]], content["buffers"][0]
    data = base64.b64decode(buffer["uri"].partition("base64,")[2], validate=True)
    width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor["type"]]
    letter, size = {5126: ("f", 4), 5123: ("H", 2)}[accessor["componentType"]]
    assert len(data) == buffer["byteLength"] and view["byteOffset"] % size == 0
    assert view["byteOffset"] + view["byteLength"] <= len(data)
    assert view["byteLength"] == accessor["count"] * width * size
    raw = data[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]
    found = np.array(struct.unpack(f"<{accessor['count'] * width}{letter}", raw)).reshape(-1, width)
    if "min" in accessor:
        np.testing.assert_array_equal(found.min(axis=0), accessor["min"])
        np.testing.assert_array_equal(found.max(axis=0), accessor["max"])
    return found


def turned(quaternion, vector):
    """A vector turned by a quaternion (x, y, z, w)."""
    xyz, w = quaternion[..., :3], quaternion[..., 3:]
    return vector + 2.0 * np.cross(xyz, np.cross(xyz, vector) + w * vector)


def test_gltf_by_the_rules_of_the_format(moved):
    """References that lead somewhere, a tree, bounds of what needs them, unit quaternions, times that grow."""
    content = json.loads((moved[2] / "motion_askew.gltf").read_text(encoding="utf-8"))
    assert content["asset"]["version"] == "2.0" and content["scenes"][content["scene"]]["nodes"] == [0]
    children = [child for node in content["nodes"] for child in node.get("children", [])]
    assert sorted(children) == list(range(1, len(content["nodes"])))  # a tree: each the child of one
    for mesh in content["meshes"]:
        (primitive,) = mesh["primitives"]
        points = values_of(content, primitive["attributes"]["POSITION"])
        normals = values_of(content, primitive["attributes"]["NORMAL"])
        triangles = values_of(content, primitive["indices"]).reshape(-1, 3).astype(int)
        assert "min" in content["accessors"][primitive["attributes"]["POSITION"]]
        np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-6)
        a, b, c = (points[triangles[:, k]] for k in range(3))
        outwards = np.einsum("ti,ti->t", np.cross(b - a, c - a), a + b + c)
        assert triangles.max() < len(points) and np.all(outwards > 0.0)  # counterclockwise, convex about the origin
        assert 0 <= primitive["material"] < len(content["materials"])
    (animation,) = content["animations"]
    for sampler in animation["samplers"]:
        times, values = values_of(content, sampler["input"]), values_of(content, sampler["output"])
        assert "min" in content["accessors"][sampler["input"]] and len(times) == len(values)
        assert np.all(np.diff(times[:, 0]) > 0.0) and times[0, 0] >= 0.0
        if values.shape[1] == 4:
            np.testing.assert_allclose(np.linalg.norm(values, axis=1), 1.0, atol=1e-6)
            assert np.all(np.einsum("ti,ti->t", values[1:], values[:-1]) > 0.0)
    targets = [(one["target"]["node"], one["target"]["path"]) for one in animation["channels"]]
    assert len(set(targets)) == len(targets)


def test_bars_of_gltf_are_where_the_lines_are(moved):
    """From the origin of a link through its elements to its end, at every instant."""
    _, (description, (arrays, _)), folder, _ = moved
    content = json.loads((folder / "motion_askew.gltf").read_text(encoding="utf-8"))
    (animation,) = content["animations"]
    moves = {}
    for channel in animation["channels"]:
        values = values_of(content, animation["samplers"][channel["sampler"]]["output"])
        name = content["nodes"][channel["target"]["node"]]["name"]
        moves.setdefault(name, {})[channel["target"]["path"]] = values
    shapes = {
        node["name"]: content["nodes"][node["children"][0]] for node in content["nodes"] if "." in node.get("name", "")
    }
    first = 0
    for link in description["links"]:
        points = arrays["points"][:, first : first + link["points"]]
        first += link["points"]
        names = [name for name in moves if name.startswith(f"{link['name']}.")]
        ends = {}
        for name in names:
            middle, length = np.array(shapes[name]["translation"]), shapes[name]["scale"][0]
            along = turned(np.array(shapes[name]["rotation"]), np.array([length, 0.0, 0.0]))
            ends[name] = [
                moves[name]["translation"] + turned(moves[name]["rotation"], middle + s * along) for s in (-0.5, 0.5)
            ]
        np.testing.assert_allclose(ends[names[0]][0], points[:, 0], atol=2e-7)
        np.testing.assert_allclose(ends[names[-1]][1], points[:, -1], atol=2e-7)
        for one, two in pairwise(names):  # both sides of an element, which is stiff
            assert np.abs(ends[one][1] - ends[two][0]).max() < 1e-5
        lengths = sum(shapes[name]["scale"][0] for name in names)
        assert lengths == pytest.approx({"crank": 0.12, "coupler": 0.3, "rocker": 0.3}[link["name"]])
    for j, joint in enumerate(description["joints"]):
        np.testing.assert_allclose(moves[joint["name"]]["translation"], arrays["centre"][:, j], atol=2e-7)


@pytest.mark.long
@pytest.mark.parametrize("make", [four_bar, curved_four_bar], ids=["straight", "curved"])
def test_elements_follow_the_axes_of_links(make):
    """At rest each begins where the one before ends, from the links' origins to their ends, also along curves."""
    model = discretise(make())
    errors = assembly_errors(model, {"coupler.length": 1e-3})
    rest = Coordinates(model.start_joints, jnp.zeros((6, model.topology.n_rfes)))
    at_once = jax.tree.map(lambda x: x[None], rest)
    parts = parts_of(model.topology, trace_bodies(model, errors, at_once))
    lines = link_lines(model, apply_errors(model, errors), rest)
    for link, line in lines.items():
        own = [part for part in parts if part.link == link]
        ends = [part.point[0] + part.ends @ part.rotation[0].T for part in own]
        np.testing.assert_allclose(ends[0][0], line[0], atol=1e-12)
        np.testing.assert_allclose(ends[-1][1], line[-1], atol=1e-12)
        for one, two in pairwise(ends):
            np.testing.assert_allclose(one[1], two[0], atol=1e-12)
    for part in parts:
        along = part.ends[1] - part.ends[0]
        shown = turned(np.array(_from_x(along / np.linalg.norm(along))), np.array([np.linalg.norm(along), 0.0, 0.0]))
        np.testing.assert_allclose(shown, along, atol=1e-12)


def test_a_run_without_numbers_at_its_end(moved):
    """Instants without numbers are no part of glTF, and are nan in VTK's files."""
    from rfem_jax.exchange.scene import JointPlace, Line, Part, Scene
    from rfem_jax.exchange.vtk_writer import poly_data_texts

    point = np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [np.nan] * 3])
    part = Part("bar", 0, np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]), np.stack([np.eye(3)] * 3), point)
    line = Line("bar", point[:, None] + [[[0.0] * 3, [1.0, 0.0, 0.0]]], np.zeros((3, 2, 3)))
    scene = Scene(NAME, np.array([0.0, 0.1, 0.2]), (part,), (line,), (JointPlace("A", point, point, point, point),))
    content = json.loads(gltf_text(scene))
    assert content["nodes"][0]["name"] == NAME
    assert content["accessors"][content["animations"][0]["samplers"][0]["input"]]["count"] == 2
    assert "nan nan nan" in list(poly_data_texts(scene))[2]


@pytest.mark.skipif(find_spec("vtk") is None, reason="the package vtk is not installed")
def test_vtk_reads_its_files(moved):
    import vtk
    from vtk.util.numpy_support import vtk_to_numpy

    _, (description, (arrays, _)), folder, _ = moved
    reader = vtk.vtkXMLPolyDataReader()
    reader.SetFileName(str(folder / "motion_askew" / "0003.vtp"))
    reader.Update()
    data = reader.GetOutput()
    assert reader.GetErrorCode() == 0 and data.GetNumberOfLines() == len(description["links"])
    np.testing.assert_array_equal(vtk_to_numpy(data.GetPoints().GetData())[4:], arrays["points"][3])
    assert data.GetFieldData().GetAbstractArray("joints").GetValue(0) == description["joints"][0]["name"]
    importer = vtk.vtkGLTFImporter()
    importer.SetFileName(str(folder / "motion_askew.gltf"))
    importer.Update()
    assert importer.GetNumberOfAnimations() == 1


@pytest.mark.skipif(find_spec("pygltflib") is None, reason="the package pygltflib is not installed")
def test_another_reader_of_gltf(moved):
    import pygltflib

    content = pygltflib.GLTF2().load(str(moved[2] / "motion_askew.gltf"))
    assert content.nodes[1].name == "crank.0" and len(content.animations) == 1
