"""A file of another program as a layout, whatever its format.

Place in the pipeline: frame_table and the readers of XML -> **files** -> study_writer; `rfem-jax import` calls it.
"""

from pathlib import Path

from rfem_jax.description.basics.errors import InputError, located
from rfem_jax.exchange.fcstd import SIGNATURE, read_fcstd
from rfem_jax.exchange.frame_table import read_table
from rfem_jax.exchange.laying import finished
from rfem_jax.exchange.layout import Layout
from rfem_jax.exchange.mjcf_reader import read_mjcf
from rfem_jax.exchange.sdf import read_sdf
from rfem_jax.exchange.urdf import read_urdf
from rfem_jax.exchange.xml_trees import LARGEST, read_tree

FORMATS = {"robot": "URDF", "mujoco": "MJCF", "sdf": "SDF"}  # by the first tag


def read_layout(path: Path) -> tuple[Layout, str]:
    """The layout of a file, ready to be written as a study, and the name of its format.

    **Raises:** `InputError` for a file that cannot be read or whose mechanism cannot become a study.
    """
    content = _content(path)
    with located(f"File `{path}`"):
        if content.startswith(SIGNATURE):
            return finished(read_fcstd(content, path.stem)), "FreeCAD"
    text = _text(path, content)
    with located(f"File `{path}`"):
        if not text.lstrip().startswith("<"):
            return finished(read_table(text, path.stem)), "a table of frames"
        root = read_tree(text)
        if root.tag not in FORMATS:
            known = ", ".join(f"<{tag}> ({name})" for tag, name in FORMATS.items())
            raise InputError(f"The first element of the file must be one of {known}, but is <{root.tag[:60]}>.")
        if root.tag == "mujoco":
            return finished(read_mjcf(path)), FORMATS[root.tag]
        read = {"robot": read_urdf, "sdf": read_sdf}[root.tag]
        return finished(read(root, path.stem)), FORMATS[root.tag]


def _content(path: Path) -> bytes:
    try:
        content = path.read_bytes()
    except FileNotFoundError:
        raise InputError(f"Argument `FILE` must be a file, but there is none `{path}`; correct the path.") from None
    except (OSError, ValueError) as problem:
        reason = getattr(problem, "strerror", None) or problem
        raise InputError(f"Argument `FILE` must be a file that can be read, but `{path}` cannot ({reason}).") from None
    if len(content) > LARGEST:
        raise InputError(f"Argument `FILE` must be a file below {LARGEST / 1e6:g} MB, but `{path}` is larger.")
    return content


def _text(path: Path, content: bytes) -> str:
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as problem:
        raise InputError(
            f"Argument `FILE` must be UTF-8 text, but byte {problem.start} of `{path}` is not; save it again as UTF-8."
        ) from None
