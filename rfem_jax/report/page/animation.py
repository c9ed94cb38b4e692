"""What is needed to draw the moving mechanism: `animation.npz` in the folder of a study.

Place in the pipeline: after `rfem_jax.simulation.run_cases`; `folder` reads it for the page.

The file has, for case number i, arrays named "i_...": times [s]; points (times, P, 3) [m] along the links, link by
link; rotation (times, J, 3, 3) of the frames in which joint loads are, centre (times, J, 3) [m]; the same with
"nominal_" of the perfect, rigid mechanism whose driven joints stand as those of the case do (`nominal_path`), and of
that seat_rotation, seat_centre, bore_rotation: the frames of the joints on parent and child; the arrays of forces at
points (`acting`); path_place and nominal_path_place (times, F, 3) [m] of the points whose paths are followed, in global
axes (files of older versions have none of the last two). "description" is a JSON text: names of cases, links, joints
and points, and what acts.
"""

import io
import json
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from rfem_jax.mechanics.model.topology import BASE
from rfem_jax.report.contents.annotations import Run
from rfem_jax.report.page.acting import ACTING, acting_arrays, describe_acting, owner_of
from rfem_jax.report.page.packing import Packed, pack_integers, some_rows
from rfem_jax.report.page.task_results import damaged
from rfem_jax.whole_files import replacing

FILE = "animation.npz"
MOST_FRAMES = 251  # of a case
MOST_NUMBERS = 4_000_000  # of the file, or 16 MB
MOST_PACKED = 500_000  # numbers in the page, two bytes each
PARTS = ("points", "rotation", "centre")
PATHS = ("path_place", "nominal_path_place")
ALL_PARTS = (
    *("times", *PARTS, *(f"nominal_{part}" for part in PARTS)),
    *("seat_rotation", "seat_centre", "bore_rotation"),
)
LARGEST = 200_000_000  # bytes of a file that is read
FARTHEST = 1e30  # m

Arrays = dict[str, np.ndarray]


def record_animation(runs: Mapping[str, Run]) -> tuple[dict[str, Any], list[Arrays]] | None:
    """Description and arrays of every case; None where the runs do not say where the mechanism is."""
    known = [run for run in runs.values() if run.motion.positions is not None]
    if len(known) < len(runs) or not known or known[0].model is None:
        return None
    topology = known[0].model.topology
    counts = [
        len(topology.drawn(l)[0]) if topology.shaped else 2 if n == 1 else n + 1
        for l, n in enumerate(topology.elements)
    ]
    acting = describe_acting(known[0])
    paths = [
        {"name": name, "link": topology.links[topology.link_of(one.node)]}
        for name, one in sorted((known[0].model.points or {}).items())
        if one.observer == BASE
    ]
    per_time = 6 * (sum(counts) + len(paths)) + 39 * len(topology.joints) + 9 * len(acting["forces"])
    most = max(2, min(MOST_FRAMES, MOST_NUMBERS // (per_time * len(runs))))
    description = {
        "cases": list(runs),
        "links": [{"name": name, "points": n} for name, n in zip(topology.links, counts, strict=True)],
        "joints": _joints(topology),
        "paths": paths,
        **({} if topology.plane == "xz" else {"plane": topology.plane}),
        **acting,
    }
    return description, [_arrays(run, most, description) for run in runs.values()]


def _joints(topology: Any) -> list[dict[str, Any]]:
    """Of every joint in the order of the arrays: name, kind, links on both sides, place in the description."""
    sides = zip(topology.joints, topology.kinds, topology.parents, topology.children, strict=True)
    return [
        {
            "name": name, "kind": kind, "parent": owner_of(topology, parent), "child": owner_of(topology, child),
            "cut": j >= topology.n_links,
        }
        for j, (name, kind, parent, child) in enumerate(sides)
    ]  # fmt: skip


def _arrays(run: Run, most: int, description: dict[str, Any]) -> Arrays:
    from rfem_jax.mechanics.dynamics.centre_lines import trace_shapes
    from rfem_jax.mechanics.model.nominal_path import nominal_shapes

    model, errors, positions = run.model, run.errors, run.motion.positions
    assert model is not None and errors is not None and positions is not None
    rows = some_rows(len(run.times), most)
    shown = jax.tree.map(lambda x: np.asarray(x)[rows], positions)
    real = trace_shapes(model, errors, shown)
    nominal = nominal_shapes(model, shown.joints)
    found = {"times": np.asarray(run.times)[rows]}
    found |= {part: np.asarray(getattr(real, part)) for part in PARTS}
    found |= {f"nominal_{part}": getattr(nominal, part) for part in PARTS}
    found |= {part: getattr(nominal, part) for part in ALL_PARTS[-3:]}
    every = sorted(model.points or {})
    shown_paths = [every.index(one["name"]) for one in description["paths"]]
    found["nominal_path_place"] = nominal.followed[:, shown_paths]
    found["path_place"] = np.zeros((len(rows), 0, 3))
    if shown_paths:
        places = [np.asarray(run.points[one["name"]].position)[rows] for one in description["paths"]]
        found["path_place"] = np.stack(places, axis=1)
    return found | acting_arrays(run, description["forces"], rows)


def write_arrays(folder: str | Path, description: dict[str, Any], cases: list[Arrays]) -> Path:
    """Write what `record_animation` returns; deviations of micrometres beside places of metres need doubles."""
    arrays = {f"{i}_{part}": values for i, case in enumerate(cases) for part, values in case.items()}
    path = Path(folder) / FILE
    with replacing(path) as temporary, open(temporary, "wb") as file:
        np.savez_compressed(file, description=np.array(json.dumps(description)), **arrays)  # pyright: ignore[reportArgumentType]
    return path


def read_animation(folder: str | Path) -> tuple[dict[str, Any], list[Arrays]] | None:
    """What `write_arrays` has written; None where there is no such file, or a larger one.

    Nothing in the file is executed: arrays of objects are refused.
    Raises: InputError for a file that is damaged.
    """
    path = Path(folder) / FILE
    try:
        if path.stat().st_size > LARGEST:
            return None
        content = io.BytesIO(path.read_bytes())
    except FileNotFoundError:
        return None
    description, cases = {}, []
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # on headers that NumPy has not written
            with np.load(content, allow_pickle=False) as file:
                description = json.loads(str(file["description"]))
                cases = [_read_case(file, i) for i in range(len(description["cases"]))]
        good = _fits(description, cases)
    except Exception:  # NumPy, zipfile and zlib raise ten kinds of errors, depending on the byte that is wrong
        good = False
    if not good:
        raise damaged(path, "is damaged")
    return description, cases


def _read_case(file: Any, i: int) -> Arrays:
    """The arrays of case number i; none of forces and paths in files of older versions."""
    case = {part: _readable(file[f"{i}_{part}"]) for part in ALL_PARTS}
    none = np.zeros((len(case["times"]), 0, 3))
    return case | {part: _readable(file.get(f"{i}_{part}", none)) for part in (*ACTING, *PATHS)}


def _readable(values: np.ndarray) -> np.ndarray:
    """An array of the file, without places that no mechanism has."""
    if not np.issubdtype(values.dtype, np.floating):
        return values  # which is refused
    return np.where(np.abs(values) < FARTHEST, values, np.nan)


def _fits(description: Any, cases: list[Arrays]) -> bool:
    """Whether arrays have the shapes that the description says."""
    try:
        links, joints = description["links"], len(description["joints"])
        points = sum(link["points"] for link in links)
        names = all(isinstance(one["name"], str) for part in ("links", "joints") for one in description[part])
        names = names and all(isinstance(link["points"], int) and link["points"] > 1 for link in links)
        forces = description.setdefault("forces", [])
        names = names and all(isinstance(one["name"], str) and isinstance(one["links"], list) for one in forces)
        paths = description.setdefault("paths", [])
        names = names and all(isinstance(one[key], str) for one in paths for key in ("name", "link"))
        laws = description.setdefault("laws", [])
        names = names and all(isinstance(one[key], str) for one in laws for key in ("name", "joint", "motion"))
    except (TypeError, KeyError, AttributeError):
        return False
    shapes = {"points": (points, 3), "centre": (joints, 3), "rotation": (joints, 3, 3)}
    counts = {**dict.fromkeys(map(str, ACTING), len(forces)), **dict.fromkeys(map(str, PATHS), len(paths))}
    of_parts = {part: (count, 3) for part, count in counts.items()}
    return names and all(
        values.shape == (len(case["times"]), *(of_parts.get(part) or shapes.get(part.rpartition("_")[2]) or ()))
        and np.issubdtype(values.dtype, np.floating)
        for case in cases
        for part, values in case.items()
    )


def pack_animation(description: dict[str, Any], cases: list[Arrays]) -> dict[str, Any]:
    """The animation as the page holds it: places of the perfect mechanism and deviations from them, frames as
    quaternions (w, x, y, z), deviations of frames as rotation vectors [rad]."""
    per_time = 6 * sum(link["points"] for link in description["links"]) + 26 * len(description["joints"])
    per_time += 9 * len(description["forces"]) + 6 * len(description["paths"])
    most = max(2, MOST_PACKED // (per_time * max(len(cases), 1)))
    found = [_packed(case, most) for case in cases]
    return {**description, "motions": found}


def _packed(case: Arrays, most: int) -> dict[str, Packed]:
    rows = some_rows(len(case["times"]), most)
    case = {part: values[rows] for part, values in case.items()}
    turned = np.einsum("tjik,tjlk->tjil", case["rotation"], case["nominal_rotation"])
    quaternions = {part: quaternions_of(case[part]) for part in ("rotation", "seat_rotation", "bore_rotation")}
    packed = {
        "nominal": case["nominal_points"],
        "deviation": case["points"] - case["nominal_points"],
        "nominal_centre": case["nominal_centre"],
        "deviation_centre": case["centre"] - case["nominal_centre"],
        "deviation_rotation": rotation_vectors(quaternions_of(turned)),
        "seat_centre": case["seat_centre"],
        "nominal_path": case["nominal_path_place"],
        "deviation_path": case["path_place"] - case["nominal_path_place"],
        **{part: case[part] for part in ACTING},
        **quaternions,
    }
    return {"times": pack_integers(case["times"]), **{name: pack_integers(x) for name, x in packed.items()}}


def quaternions_of(rotation: Float[np.ndarray, "*n 3 3"]) -> Float[np.ndarray, "*n 4"]:
    """Unit quaternions (w, x, y, z), w >= 0, of rotations, as eigenvectors (I. Y. Bar-Itzhack, J. Guid. Control Dyn. 23
    (2000) 1085-1087)."""
    # A matrix that is no rotation has no eigenvalues that could be found.
    known = np.all(np.abs(rotation) < 2.0, axis=(-2, -1), keepdims=True)
    m = np.where(known, rotation, 0.0)
    xx, yy, zz = m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]
    xy, xz, yz = (m[..., i, j] + m[..., j, i] for i, j in ((0, 1), (0, 2), (1, 2)))
    wx, wy, wz = (m[..., i, j] - m[..., j, i] for i, j in ((2, 1), (0, 2), (1, 0)))
    rows = [
        [xx - yy - zz, xy, xz, wx],
        [xy, yy - xx - zz, yz, wy],
        [xz, yz, zz - xx - yy, wz],
        [wx, wy, wz, xx + yy + zz],
    ]
    _, vectors = np.linalg.eigh(np.stack([np.stack(row, axis=-1) for row in rows], axis=-2))
    x, y, z, w = np.moveaxis(vectors[..., -1], -1, 0)
    found = np.stack([w, x, y, z], axis=-1) * np.where(w < 0.0, -1.0, 1.0)[..., None]
    return np.where(known[..., 0], found, np.nan)


def rotation_vectors(quaternions: Float[np.ndarray, "*n 4"]) -> Float[np.ndarray, "*n 3"]:
    """Rotation vectors [rad] of unit quaternions with w >= 0."""
    vector = quaternions[..., 1:]
    size = np.linalg.norm(vector, axis=-1, keepdims=True)
    angle = 2.0 * np.arctan2(size, quaternions[..., :1])
    return vector * np.where(size > 0.0, angle / np.where(size > 0.0, size, 1.0), 2.0)
