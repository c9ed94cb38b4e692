"""`rfem-jax import`: a file of another program as a study.

Place in the pipeline: the file -> `exchange` -> **import** -> the user's own study file.
"""

import argparse
from pathlib import Path

from rfem_jax.report.commands.command import Answer, Command
from rfem_jax.report.commands.folders import write_study
from rfem_jax.report.terminal.messages import show


def command() -> Command:
    """The subcommand."""
    return Command(
        name="import",
        purpose="make a study of a file of another program",
        description="Write a study with comments from a file in MJCF (read by the package mujoco), in URDF, in SDF, "
        "from an assembly of FreeCAD 1.0 or later (.FCStd), or from a table of frames (CSV). "
        "What cannot be taken over is listed, here and in the study. A file that exists is not overwritten.",
        add_arguments=_add_arguments,
        act=act,
        computes=False,
    )


def _add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("file", metavar="FILE", help="the file to import")
    parser.add_argument(
        "-o", "--out", dest="target", metavar="STUDY.toml", required=True, help="the study file to write"
    )


def act(arguments: argparse.Namespace) -> Answer:
    """Read the file, write the study, read that. Raises InputError."""
    from rfem_jax.description.basics.errors import InputError
    from rfem_jax.description.study_file.study import load_study
    from rfem_jax.exchange.files import read_layout
    from rfem_jax.exchange.study_writer import study_text

    path = Path(arguments.target)
    layout, kind = read_layout(Path(arguments.file))
    schema = write_study(path, study_text(layout, f"{Path(arguments.file).name}, {kind}", path.name), "--out")
    try:
        load_study(path)
    except InputError as error:
        path.unlink(missing_ok=True)
        reasons = (one.removeprefix(f"Study file `{path}`: ") for one in error.problems)
        raise InputError(*(f"File `{arguments.file}` cannot become a study: {one}" for one in reasons)) from None
    show(f"{path} written: {len(layout.bodies)} links and {len(layout.joints)} joints of {kind}.")
    for remark in layout.remarks:
        show(f"- {remark}")
    show(f"Go on with\n\n  rfem-jax check {path}")
    return Answer(
        document={
            "files": [str(path), str(schema)],
            "format": kind,
            "links": [body.name for body in layout.bodies],
            "joints": [joint.name for joint in layout.joints],
            "remarks": list(layout.remarks),
        }
    )
