"""`rfem-jax export`: a study as a file of another program.

Place in the pipeline: `load_study` -> `exchange` -> **export** -> a file.
"""

import argparse
from pathlib import Path
from typing import Any

from rfem_jax.report.commands.command import CASE_FAILED, DONE, Answer, Command, add_study
from rfem_jax.report.commands.folders import write_new
from rfem_jax.report.commands.steps import announce, read_study, settle_method
from rfem_jax.report.contents.annotations import Study
from rfem_jax.report.terminal.messages import remark, show

ENDINGS = {"frames": ".csv", "mjcf": ".xml", "urdf": ".urdf", "exudyn": ".py", "drawing": "_drawing.csv"}


def command() -> Command:
    """The subcommand."""
    return Command(
        name="export",
        purpose="write a study as a file of another program",
        description="Write the mechanism of a study, with the errors of a case, as MJCF, as URDF or as a table of "
        "frames (CSV), all of rigid links, or as a script for Exudyn with the flexible links, the drive and the start; "
        "or its tolerances as a table for drawings (CSV) with the symbols of ISO 1101. "
        "What cannot be taken over is listed. A file that exists is not overwritten.",
        add_arguments=_add_arguments,
        act=act,
    )


def _add_arguments(parser: argparse.ArgumentParser) -> None:
    add_study(parser)
    parser.add_argument("--to", choices=tuple(ENDINGS), required=True, help="the format")
    parser.add_argument("--case", metavar="NAME", help="the case whose errors are put in (default: no errors)")
    parser.add_argument(
        "--answer",
        metavar="FILE",
        help="allocation.json or optimise.json of the study, whose tolerances are in the table (drawing only)",
    )
    parser.add_argument("-o", "--out", dest="target", metavar="FILE", help="the file (default: named as the study)")
    parser.add_argument(
        "--verify", action="store_true", help="run the file and the study, and show both: loads (exudyn), motion (mjcf)"
    )


def act(arguments: argparse.Namespace) -> Answer:
    """Read the study, write the file, verify it. Raises InputError."""
    _require_used(arguments)
    study = read_study(arguments.study)
    path = Path(arguments.target or Path(arguments.study).stem + ENDINGS[arguments.to])
    # Names of files may have line ends, and characters that no encoding has.
    named = "".join(letter if letter.isprintable() else "?" for letter in Path(arguments.study).name)
    source = f"{named}, {'perfect' if arguments.case is None else f'case {arguments.case}'}"
    text, left = _text(study, arguments, source)
    write_new(path, text, "--out")
    show(f"{path} written: {source}.")
    if left:
        show("Not in it:")
    for one in left:
        show(f"- {one}")
    document: dict[str, Any] = {
        "files": [str(path)],
        "to": arguments.to,
        "case": arguments.case,
        "left_out": list(left),
    }
    if arguments.verify and arguments.to == "exudyn":
        document["rms_loads"] = _verify_loads(text, study, arguments.case)
    if arguments.verify and arguments.to == "mjcf":
        document["motion"] = _verify_motion(text, study, arguments.case)
        return Answer(DONE if document["motion"]["agree"] else CASE_FAILED, document)
    return Answer(document=document)


def _require_used(arguments: argparse.Namespace) -> None:
    """No argument that this format does not use. Raises InputError."""
    told = {
        "--verify": (arguments.verify, ("exudyn", "mjcf"), "which another program runs"),
        "--answer": (arguments.answer is not None, ("drawing",), "which has tolerances"),
        "--case": (arguments.case is not None, tuple(one for one in ENDINGS if one != "drawing"), "which has errors"),
    }
    for name, (given, formats, why) in told.items():
        if given and arguments.to not in formats:
            from rfem_jax.description.basics.errors import InputError

            raise InputError(
                f"Argument `{name}` must be left out unless --to is {' or '.join(formats)}, {why}, but --to is "
                f'"{arguments.to}"; leave it out.'
            )


def _text(study: Study, arguments: argparse.Namespace, source: str) -> tuple[str, tuple[str, ...]]:
    """The file, and sentences on what it does not hold."""
    if arguments.to == "drawing":
        from rfem_jax.exchange.drawing_table import drawing_text

        found = None if arguments.answer is None else _answer(Path(arguments.answer))
        return drawing_text(study, found)
    if arguments.to == "exudyn":
        from rfem_jax.exchange.exudyn_writer import exudyn_text

        announce("Assembling the mechanism")
        return exudyn_text(study, arguments.case, source)
    from rfem_jax.exchange.frame_table import table_text
    from rfem_jax.exchange.mjcf_writer import mjcf_text
    from rfem_jax.exchange.study_layout import layout_of
    from rfem_jax.exchange.urdf_writer import urdf_text

    writers = {"frames": table_text, "mjcf": mjcf_text, "urdf": urdf_text}
    return writers[arguments.to](layout_of(study, arguments.case), source)


def _answer(path: Path) -> dict[str, float]:
    """The tolerances that a task has found. Raises InputError."""
    from rfem_jax.description.basics.errors import InputError
    from rfem_jax.report.page.task_results import read_json

    content = read_json(path) or {}
    found = content.get("tolerances")
    good = isinstance(found, dict) and all(isinstance(x, int | float) and x > 0.0 for x in found.values())
    if not good or not found:
        raise InputError(
            f"Argument `--answer` must be the file allocation.json or optimise.json of a task, but `{path}` has no "
            "tolerances; name that which `rfem-jax allocate` or `optimise` has written."
        )
    if content.get("status") != "ok":
        remark(f"The answer in {path} has the status {content.get('status')}.")
    return {str(name): float(x) for name, x in found.items()}


def _verify_motion(text: str, study: Study, case: str | None) -> dict[str, Any]:
    """Run the file in MuJoCo and the study with rigid links, and show the motions of both."""
    from rfem_jax.exchange.mujoco_motion import compared, rigid_study
    from rfem_jax.exchange.study_layout import layout_of
    from rfem_jax.report.contents.output import plain
    from rfem_jax.report.contents.tables import format_table

    layout = layout_of(study, case)
    rigid = settle_method(rigid_study(study, case, layout))
    announce("Running both")
    found = compared(text, rigid, layout)
    header = ["joint", "unit", "start", "end", "by MuJoCo", "largest difference"]
    rows = [
        [name, unit, *(f"{x:.7g}" for x in (found.ours[name][0], found.ours[name][-1], found.theirs[name][-1])),
         f"{abs(found.ours[name] - found.theirs[name]).max():.2g}"]
        for name, unit in found.units.items()
    ]  # fmt: skip
    show(f"\nMotion of rigid links without drive over {found.times[-1]:g} s\n{format_table(header, rows, (0, 1))}")
    largest, agree = found.largest(), found.largest() <= found.tolerance
    soft = "; loops and couplings are soft in MuJoCo" if found.tolerance > 1e-3 else ""
    show(f"{'Equal' if agree else 'NOT equal'} within {found.tolerance:g} of the longest way ({largest:.2g}{soft}).")
    names = {"times": found.times, "ours": found.ours, "mujoco": found.theirs}
    return {"agree": agree, "largest": largest, "tolerance": found.tolerance, **plain(names)}


def _verify_loads(text: str, study: Study, case: str | None) -> dict[str, dict[str, float]]:
    """Run the script and the study, and show the RMS loads of both."""
    from rfem_jax.exchange.exudyn_writer import verified
    from rfem_jax.report.contents.tables import format_table

    settled = study if study.method.name != "auto" else settle_method(study)
    announce("Running both")
    found = verified(text, settled, case)
    header = ["joint", "force, N", "by Exudyn", "moment, N m", "by Exudyn"]
    rows = [[name, *(f"{value:.7g}" for value in loads)] for name, loads in found.items()]
    show(f"\nRMS loads over the whole time, by us and by Exudyn\n{format_table(header, rows)}")
    names = "force", "force_exudyn", "moment", "moment_exudyn"
    return {joint: dict(zip(names, loads, strict=True)) for joint, loads in found.items()}
