"""`rfem-jax export`: a study as a file of another program.

Place in the pipeline: `load_study` -> `exchange` -> **export** -> a file.
"""

import argparse
from pathlib import Path

from rfem_jax.report.commands.command import Answer, Command, add_study
from rfem_jax.report.commands.folders import write_new
from rfem_jax.report.commands.steps import read_study
from rfem_jax.report.progress_line import show

ENDINGS = {"frames": ".csv", "mjcf": ".xml", "urdf": ".urdf"}


def command() -> Command:
    """The subcommand."""
    return Command(
        name="export",
        purpose="write a study as a file of another program",
        description="Write the mechanism of a study, with the errors of a case, as MJCF, as URDF or as a table of "
        "frames (CSV). Links are rigid there. "
        "What cannot be taken over is listed. A file that exists is not overwritten.",
        add_arguments=_add_arguments,
        act=act,
    )


def _add_arguments(parser: argparse.ArgumentParser) -> None:
    add_study(parser)
    parser.add_argument("--to", choices=tuple(ENDINGS), required=True, help="the format")
    parser.add_argument("--case", metavar="NAME", help="the case whose errors are put in (default: no errors)")
    parser.add_argument("-o", "--out", dest="target", metavar="FILE", help="the file (default: named as the study)")


def act(arguments: argparse.Namespace) -> Answer:
    """Read the study, write the file. Raises InputError."""
    study = read_study(arguments.study)

    from rfem_jax.exchange.frame_table import table_text
    from rfem_jax.exchange.mjcf_writer import mjcf_text
    from rfem_jax.exchange.study_layout import layout_of
    from rfem_jax.exchange.urdf_writer import urdf_text

    writers = {"frames": table_text, "mjcf": mjcf_text, "urdf": urdf_text}
    named = Path(arguments.study).stem + ENDINGS[arguments.to]
    path = Path(arguments.target or named)
    layout = layout_of(study, arguments.case)
    source = f"{Path(arguments.study).name}, {'perfect' if arguments.case is None else f'case {arguments.case}'}"
    text, left = writers[arguments.to](layout, source)
    write_new(path, text, "--out")
    show(f"{path} written: {source}.")
    if left:
        show("Not in it:")
    for one in left:
        show(f"- {one}")
    return Answer(document={"files": [str(path)], "to": arguments.to, "case": arguments.case, "left_out": list(left)})
