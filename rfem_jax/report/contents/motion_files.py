"""The motion of all cases for programs that draw: VTK's files, glTF.

Place in the pipeline: the runs, and the records that the page has of them -> **motion_files** -> `exchange` -> files.
"""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from rfem_jax.exchange.gltf_writer import gltf_text
from rfem_jax.exchange.scene import Scene, parts_of, scene_of
from rfem_jax.exchange.vtk_writer import collection_text, poly_data_texts
from rfem_jax.report.contents.annotations import Run
from rfem_jax.whole_files import write_text

FORMATS = ("vtp", "gltf")


def write_motions(
    folder: Path,
    runs: Mapping[str, Run],
    records: tuple[dict[str, Any], list[dict[str, np.ndarray]]],
    formats: Sequence[str],
) -> list[Path]:
    """Write the motion of every case in the formats (of FORMATS): `motion_CASE.gltf`; `motion_CASE.pvd` with a folder
    `motion_CASE` of one file for each instant. `records`: what `record_animation` returned for these runs. Returns the
    paths, of a folder alone that of the collection."""
    written = []
    for scene in _scenes(runs, *records):
        name = f"motion_{scene.title}"
        if "gltf" in formats:
            written.append(write_text(folder / f"{name}.gltf", gltf_text(scene)))
        if "vtp" in formats:
            written.append(_write_series(folder, name, scene))
    return written


def _write_series(folder: Path, name: str, scene: Scene) -> Path:
    inner = folder / name
    inner.mkdir(exist_ok=True)
    files = [f"{number:04d}.vtp" for number in range(len(scene.times))]
    for file, text in zip(files, poly_data_texts(scene), strict=True):
        write_text(inner / file, text)
    for left in inner.glob("[0-9][0-9][0-9][0-9].vtp"):  # of a longer motion before
        if left.name not in files:
            left.unlink()
    return write_text(folder / f"{name}.pvd", collection_text(scene, (f"{name}/{file}" for file in files)))


def _scenes(
    runs: Mapping[str, Run], description: dict[str, Any], cases: list[dict[str, np.ndarray]]
) -> Iterator[Scene]:
    from rfem_jax.mechanics.dynamics.centre_lines import trace_bodies

    for (name, run), arrays in zip(runs.items(), cases, strict=True):
        assert run.model is not None and run.motion.positions is not None
        rows = np.searchsorted(np.asarray(run.times), arrays["times"])
        shown = jax.tree.map(lambda x, rows=rows: np.asarray(x)[rows], run.motion.positions)
        parts = parts_of(run.model.topology, trace_bodies(run.model, run.errors, shown))
        loads = {
            joint: (np.asarray(load.force)[rows], np.asarray(load.moment)[rows]) for joint, load in run.loads.items()
        }
        yield scene_of(name, description, arrays, parts, loads)
