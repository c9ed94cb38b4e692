"""A scene as glTF 2.0 with an animation, all in one file: for Blender, viewers in browsers, slides.

Place in the pipeline: scene -> **gltf_writer** -> a `.gltf` file.

Format: Khronos Group, glTF 2.0 Specification (ISO/IEC 12113:2022). One node for each rigid finite element, named
LINK.NUMBER, moves with its frame, so that a part of a CAD program can be hung into it; in it a bar from end to end.
One node for each joint, with a ball. The root turns our z up to glTF's y up; metres; numbers are 32-bit floats, in
which errors of micrometres cannot be seen beside places of metres.
"""

import base64
import json
from typing import Any

import numpy as np
from jaxtyping import Float

from rfem_jax.exchange.rigid_frames import quaternion_of
from rfem_jax.exchange.scene import Scene

_FLOAT, _SHORT = 5126, 5123  # types of components
_VERTICES, _INDICES = 34962, 34963  # targets of buffer views
_THICKNESS, _BALL = 0.02, 0.016  # of the size of the mechanism: width of bars, radius of balls
_COLOURS = ("#4477aa", "#ee6677", "#228833", "#ccbb44", "#66ccee", "#aa3377", "#bbbbbb")  # P. Tol's bright scheme
_OF_JOINTS = "#333333"
_UPRIGHT = [-np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)]  # x, y, z, w: z becomes y


class _Buffer:
    """Arrays in one buffer, with what describes them."""

    def __init__(self) -> None:
        self.content = bytearray()
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []

    def add(self, values: np.ndarray, kind: str, target: int | None = None, bounds: bool = False) -> int:
        """The number of the accessor of an array, which is kept as 32-bit floats or as 16-bit integers."""
        component = _SHORT if np.issubdtype(values.dtype, np.integer) else _FLOAT
        stored = np.ascontiguousarray(values, dtype="<u2" if component == _SHORT else "<f4")
        self.content += bytes(-len(self.content) % 4)
        view = {"buffer": 0, "byteOffset": len(self.content), "byteLength": stored.nbytes}
        self.views.append(view if target is None else {**view, "target": target})
        self.content += stored.tobytes()
        accessor = {"bufferView": len(self.views) - 1, "componentType": component, "count": len(stored), "type": kind}
        if bounds:
            rows = stored.reshape(len(stored), -1)
            accessor |= {"min": rows.min(axis=0).tolist(), "max": rows.max(axis=0).tolist()}
        self.accessors.append(accessor)
        return len(self.accessors) - 1


def gltf_text(scene: Scene) -> str:
    """The file. Instants at which a run that failed has no numbers are left out."""
    rows = _rows(scene)
    buffer, size = _Buffer(), scene.size
    links = list(dict.fromkeys(part.link for part in scene.parts))
    meshes = [_mesh(buffer, *_bar(), material) for material in range(len(links))]
    meshes.append(_mesh(buffer, *_ball(), len(links)))
    nodes: list[dict[str, Any]] = [{"name": scene.title, "rotation": _UPRIGHT, "children": []}]
    animated: list[tuple[int, np.ndarray, np.ndarray | None]] = []
    for part in scene.parts:
        begin, end = part.ends
        length = max(float(np.linalg.norm(end - begin)), 1e-9)
        shape = {
            "mesh": links.index(part.link), "translation": (0.5 * (begin + end)).tolist(),
            "rotation": _from_x((end - begin) / length), "scale": [length, _THICKNESS * size, _THICKNESS * size],
        }  # fmt: skip
        nodes += [{"name": f"{part.link}.{part.number}", "children": [len(nodes) + 1]}, shape]
        animated.append((len(nodes) - 2, part.point[rows], _quaternions(part.rotation[rows])))
    for joint in scene.joints:
        nodes.append({"name": joint.name, "mesh": len(links), "scale": [_BALL * size] * 3})
        animated.append((len(nodes) - 1, joint.centre[rows], None))
    nodes[0]["children"] = [number for number, *_ in animated]
    for number, places, turns in animated:
        nodes[number]["translation"] = places[0].tolist()
        if turns is not None:
            nodes[number]["rotation"] = turns[0].tolist()
    content = {
        "asset": {"version": "2.0", "generator": "rfem_jax"},
        "scene": 0,
        "scenes": [{"name": scene.title, "nodes": [0]}],
        "nodes": nodes,
        "meshes": meshes,
        "materials": [_material(name, _COLOURS[n % len(_COLOURS)]) for n, name in enumerate(links)]
        + [_material("joints", _OF_JOINTS)],
        **({"animations": [_animation(buffer, scene.times[rows], animated)]} if len(rows) > 1 else {}),
        "accessors": buffer.accessors,
        "bufferViews": buffer.views,
    }
    data = base64.b64encode(bytes(buffer.content)).decode("ascii")
    uri = f"data:application/octet-stream;base64,{data}"
    content["buffers"] = [{"byteLength": len(buffer.content), "uri": uri}]
    return json.dumps(content, ensure_ascii=False, allow_nan=False, separators=(",", ":")) + "\n"


def _rows(scene: Scene) -> np.ndarray:
    """Instants that 32-bit floats tell apart, and at which all places are known."""
    places = [part.point for part in scene.parts] + [joint.centre for joint in scene.joints]
    known = np.flatnonzero(np.all([np.isfinite(one).all(axis=1) for one in places], axis=0))
    return known[np.unique(scene.times[known].astype(np.float32), return_index=True)[1]]


def _animation(buffer: _Buffer, times: np.ndarray, animated: list[tuple[int, np.ndarray, np.ndarray | None]]) -> dict:
    """All nodes over the same times."""
    instants = buffer.add(times, "SCALAR", bounds=True)
    samplers, channels = [], []
    for node, places, turns in animated:
        for path, kind, values in (("translation", "VEC3", places), ("rotation", "VEC4", turns)):
            if values is not None:
                samplers.append({"input": instants, "interpolation": "LINEAR", "output": buffer.add(values, kind)})
                channels.append({"sampler": len(samplers) - 1, "target": {"node": node, "path": path}})
    return {"name": "motion", "samplers": samplers, "channels": channels}


def _quaternions(rotation: Float[np.ndarray, "T 3 3"]) -> Float[np.ndarray, "T 4"]:
    """Unit quaternions (x, y, z, w), each on the side of the one before, with the short way between them."""
    found = np.stack([quaternion_of(one) for one in rotation])
    signs = np.cumprod(np.where(np.einsum("ti,ti->t", found[1:], found[:-1]) < 0.0, -1.0, 1.0))
    found[1:] *= signs[:, None]
    return found[:, [1, 2, 3, 0]]


def _from_x(direction: Float[np.ndarray, "3"]) -> list[float]:
    """The unit quaternion (x, y, z, w) that turns x into a direction by the shortest way."""
    x, y, z = (float(one) for one in direction)
    turn = np.array([0.0, -z, y, 1.0 + x])
    size = np.linalg.norm(turn)
    return (turn / size).tolist() if size > 1e-6 else [0.0, 0.0, 1.0, 0.0]


def _mesh(buffer: _Buffer, points: np.ndarray, normals: np.ndarray, triangles: np.ndarray, material: int) -> dict:
    attributes = {
        "POSITION": buffer.add(points, "VEC3", _VERTICES, bounds=True),
        "NORMAL": buffer.add(normals, "VEC3", _VERTICES),
    }
    indices = buffer.add(triangles.ravel(), "SCALAR", _INDICES)
    return {"primitives": [{"attributes": attributes, "indices": indices, "material": material}]}


def _material(name: str, colour: str) -> dict[str, Any]:
    share = [int(colour[k : k + 2], 16) / 255 for k in (1, 3, 5)]
    linear = [x / 12.92 if x <= 0.04045 else ((x + 0.055) / 1.055) ** 2.4 for x in share]  # of sRGB
    return {"name": name, "pbrMetallicRoughness": {"baseColorFactor": [*linear, 1.0], "metallicFactor": 0.1}}


def _bar() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A cube of edge 1 about the origin: points, normals, triangles, counterclockwise from outside."""
    points, normals, triangles = [], [], []
    for axis in range(3):
        for sign in (-0.5, 0.5):
            u, v = np.eye(3)[(axis + 1) % 3], np.eye(3)[(axis + 2) % 3]
            corners = [sign * np.eye(3)[axis] + 0.5 * (a * u + b * v) for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
            first = len(points)
            points += corners if sign > 0 else corners[::-1]
            normals += [2.0 * sign * np.eye(3)[axis]] * 4
            triangles += [[first, first + 1, first + 2], [first, first + 2, first + 3]]
    return np.array(points), np.array(normals), np.array(triangles)


def _ball() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A sphere of radius 1: an octahedron whose faces are divided twice."""
    corners = [np.eye(3)[k] * s for k in range(3) for s in (1.0, -1.0)]
    faces = [(corners[a], corners[2 + b], corners[4 + c]) for a in range(2) for b in range(2) for c in range(2)]
    faces = [face if np.linalg.det(face) > 0 else face[::-1] for face in faces]
    for _ in range(2):
        divided = []
        for a, b, c in faces:
            ab, bc, ca = (x / np.linalg.norm(x) for x in (a + b, b + c, c + a))
            divided += [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
        faces = divided
    points = np.array(faces).reshape(-1, 3)
    return points, points, np.arange(len(points))
