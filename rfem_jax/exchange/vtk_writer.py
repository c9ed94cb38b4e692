"""A scene as VTK's XML files, one for each instant, and a collection of them: for ParaView, VisIt, PyVista.

Place in the pipeline: scene -> **vtk_writer** -> `.pvd` and `.vtp` files.

Format: The VTK User's Guide, 11th ed., chapter "VTK XML formats": PolyData of points, vertices (the joints) and lines
(the links); numbers as text, so that they can be read without VTK. In every point: its deviation from the perfect
mechanism [m]; in the joints force [N] and moment [N m] on the child in global axes, elsewhere zero.
"""

from collections.abc import Iterable, Iterator
from xml.sax.saxutils import quoteattr

import numpy as np

from rfem_jax.exchange.scene import Scene

_HEAD = '<?xml version="1.0" encoding="utf-8"?>\n'


def collection_text(scene: Scene, files: Iterable[str]) -> str:
    """The `.pvd` file that says which file is of which time; `files`: their paths from its folder, with slashes."""
    sets = "".join(
        f'    <DataSet timestep="{float(time)!r}" group="" part="0" file={quoteattr(file)}/>\n'
        for time, file in zip(scene.times, files, strict=True)
    )
    return (
        f'{_HEAD}<VTKFile type="Collection" version="1.0" byte_order="LittleEndian">\n'
        f"  <Collection>\n{sets}  </Collection>\n</VTKFile>\n"
    )


def poly_data_texts(scene: Scene) -> Iterator[str]:
    """The `.vtp` file of every instant."""
    counts = [line.points.shape[1] for line in scene.lines]
    joints, on_lines = len(scene.joints), sum(counts)
    connectivity = {
        "Verts": (np.arange(joints), np.arange(1, joints + 1)),
        "Lines": (joints + np.arange(on_lines), np.cumsum(counts, dtype=int)),
    }
    numbers = np.concatenate([np.arange(joints), np.arange(len(counts))])
    of_link = np.repeat([0, 1], [joints, len(counts)])
    cells = _array("is_link", of_link, "Int64") + _array("number", numbers, "Int64")
    topology = "".join(
        f"      <{tag}>\n{_array('connectivity', points, 'Int64')}{_array('offsets', ends, 'Int64')}      </{tag}>\n"
        for tag, (points, ends) in connectivity.items()
    )
    names = _names("joints", [one.name for one in scene.joints]) + _names("links", [one.link for one in scene.lines])
    for t, time in enumerate(scene.times):
        points = np.concatenate(
            [*(one.centre[t, None] for one in scene.joints), *(one.points[t] for one in scene.lines)]
        )
        away = [*(one.deviation[t, None] for one in scene.joints), *(one.deviation[t] for one in scene.lines)]
        data = _array("deviation_m", np.concatenate(away), "Float64")
        for name, load in (("force_N", "force"), ("moment_Nm", "moment")):
            values = np.zeros_like(points)
            values[:joints] = [getattr(one, load)[t] for one in scene.joints]
            data += _array(name, values, "Float64")
        yield (
            f'{_HEAD}<VTKFile type="PolyData" version="1.0" byte_order="LittleEndian" header_type="UInt64">\n'
            f"  <PolyData>\n    <FieldData>\n{_one('TimeValue', float(time))}{names}    </FieldData>\n"
            f'    <Piece NumberOfPoints="{len(points)}" NumberOfVerts="{joints}" NumberOfLines="{len(counts)}" '
            f'NumberOfStrips="0" NumberOfPolys="0">\n'
            f"      <Points>\n{_array('points', points, 'Float64')}      </Points>\n{topology}"
            f'      <PointData Vectors="force_N">\n{data}      </PointData>\n'
            f"      <CellData>\n{cells}      </CellData>\n"
            "    </Piece>\n  </PolyData>\n</VTKFile>\n"
        )


def _array(name: str, values: np.ndarray, kind: str) -> str:
    """Numbers as text, a row a line; nan where a run that failed has none."""
    rows = values.reshape(len(values), -1)
    text = "\n".join(" ".join(_number(x) for x in row) for row in rows)
    parts = f' NumberOfComponents="{rows.shape[1]}"' if values.ndim > 1 else ""
    return f'        <DataArray type="{kind}" Name="{name}"{parts} format="ascii">\n{text}\n        </DataArray>\n'


def _one(name: str, value: float) -> str:
    return f'      <DataArray type="Float64" Name="{name}" NumberOfTuples="1" format="ascii">{value!r}</DataArray>\n'


def _names(name: str, words: list[str]) -> str:
    """Texts are numbers of their UTF-8 bytes, each ended by a zero."""
    codes = " ".join(str(code) for word in words for code in (*word.encode("utf-8"), 0))
    return f'      <Array type="String" Name="{name}" NumberOfTuples="{len(words)}" format="ascii">{codes}</Array>\n'


def _number(value: float) -> str:
    return str(int(value)) if isinstance(value, np.integer) else repr(0.0 + float(value))
