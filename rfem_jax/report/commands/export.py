"""`rfem-jax export`: a study as a file of another program.

Place in the pipeline: `load_study` -> `exchange` -> **export** -> a file.
"""

import argparse
from pathlib import Path

from rfem_jax.report.annotations import Study
from rfem_jax.report.commands.command import Answer, Command, add_study
from rfem_jax.report.commands.folders import write_new
from rfem_jax.report.commands.steps import announce, read_study, settle_method
from rfem_jax.report.progress_line import show

ENDINGS = {"frames": ".csv", "mjcf": ".xml", "urdf": ".urdf", "exudyn": ".py"}


def command() -> Command:
    """The subcommand."""
    return Command(
        name="export",
        purpose="write a study as a file of another program",
        description="Write the mechanism of a study, with the errors of a case, as MJCF, as URDF or as a table of "
        "frames (CSV), all of rigid links, or as a script for Exudyn with the flexible links, the drive and the start. "
        "What cannot be taken over is listed. A file that exists is not overwritten.",
        add_arguments=_add_arguments,
        act=act,
    )


def _add_arguments(parser: argparse.ArgumentParser) -> None:
    add_study(parser)
    parser.add_argument("--to", choices=tuple(ENDINGS), required=True, help="the format")
    parser.add_argument("--case", metavar="NAME", help="the case whose errors are put in (default: no errors)")
    parser.add_argument("-o", "--out", dest="target", metavar="FILE", help="the file (default: named as the study)")
    parser.add_argument(
        "--verify", action="store_true", help="run the script and the study, and show the loads of both (exudyn only)"
    )


def act(arguments: argparse.Namespace) -> Answer:
    """Read the study, write the file, verify it. Raises InputError."""
    _require_verifiable(arguments)
    study = read_study(arguments.study)
    path = Path(arguments.target or Path(arguments.study).stem + ENDINGS[arguments.to])
    source = f"{Path(arguments.study).name}, {'perfect' if arguments.case is None else f'case {arguments.case}'}"
    text, left = _text(study, arguments, source)
    write_new(path, text, "--out")
    show(f"{path} written: {source}.")
    if left:
        show("Not in it:")
    for one in left:
        show(f"- {one}")
    document = {"files": [str(path)], "to": arguments.to, "case": arguments.case, "left_out": list(left)}
    if arguments.verify:
        document["rms_loads"] = _verify(text, study, arguments.case)
    return Answer(document=document)


def _require_verifiable(arguments: argparse.Namespace) -> None:
    if arguments.verify and arguments.to != "exudyn":
        from rfem_jax.description.basics.errors import InputError

        raise InputError(
            f"Argument `--verify` must be left out unless --to is exudyn, whose loads are compared, but --to is "
            f'"{arguments.to}"; leave it out.'
        )


def _text(study: Study, arguments: argparse.Namespace, source: str) -> tuple[str, tuple[str, ...]]:
    """The file, and sentences on what it does not hold."""
    if arguments.to == "exudyn":
        from rfem_jax.exchange.exudyn_writer import exudyn_text

        announce("Assembling the mechanism")
        return exudyn_text(study, arguments.case, source), ()
    from rfem_jax.exchange.frame_table import table_text
    from rfem_jax.exchange.mjcf_writer import mjcf_text
    from rfem_jax.exchange.study_layout import layout_of
    from rfem_jax.exchange.urdf_writer import urdf_text

    writers = {"frames": table_text, "mjcf": mjcf_text, "urdf": urdf_text}
    return writers[arguments.to](layout_of(study, arguments.case), source)


def _verify(text: str, study: Study, case: str | None) -> dict[str, dict[str, float]]:
    """Run the script and the study, and show the RMS loads of both."""
    from rfem_jax.exchange.exudyn_writer import verified
    from rfem_jax.report.tables import format_table

    settled = study if study.method.name != "auto" else settle_method(study)
    announce("Running both")
    found = verified(text, settled, case)
    header = ["joint", "force, N", "by Exudyn", "moment, N m", "by Exudyn"]
    rows = [[name, *(f"{value:.7g}" for value in loads)] for name, loads in found.items()]
    show(f"\nRMS loads over the whole time, by us and by Exudyn\n{format_table(header, rows)}")
    names = "force", "force_exudyn", "moment", "moment_exudyn"
    return {joint: dict(zip(names, loads, strict=True)) for joint, loads in found.items()}
