"""`rfem-jax check`: what a study says, and what it costs, without simulating.

Place in the pipeline: `load_study` (description) -> `describe` (mechanics), `check_step` (simulation) -> `overview`,
`tasks.task_overview`, `study_cost`.
"""

import argparse
from pathlib import Path
from typing import Any

from rfem_jax.report.commands.command import CASE_FAILED, DONE, Answer, Command, add_cache, add_study
from rfem_jax.report.commands.folders import open_folder, require_folder, writing_into
from rfem_jax.report.commands.steps import announce, discretise_study, read_study, settle_method
from rfem_jax.report.contents.annotations import Model, Study
from rfem_jax.report.terminal.messages import show

STRUCTURE = (
    "coordinates",
    "constraints",
    "rank",
    "mobility",
    "rigid_mobility",
    "redundant",
    "gap",
    "idle",
    "reactions",
)


def command() -> Command:
    """The subcommand."""
    return Command(
        name="check",
        purpose="validate a study and print what was understood",
        description="Validate a study file and print what was understood (links, joints, "
        "coordinates, mobility, rank, largest stable step, cases, tasks, what they cost) without simulating.",
        add_arguments=_add_arguments,
        act=act,
    )


def _add_arguments(parser: argparse.ArgumentParser) -> None:
    add_study(parser)
    parser.add_argument("--picture", metavar="FILE.png", help="draw the mechanism at its start, without a run")
    parser.add_argument(
        "--converge", metavar="ACCURACY", nargs="?", const="1 %", type=_no_study,
        help="simulate the cases with half and twice as many rfes, too: how far the loads are off, and how many rfes "
        'an accuracy takes (default: "1 %%")',
    )  # fmt: skip
    add_cache(parser)


def act(arguments: argparse.Namespace) -> Answer:
    """Read, describe, look for the largest stable step, compare numbers of rfes if asked to. Raises InputError."""
    picture = None if arguments.picture is None else _picture_file(arguments.picture)
    accuracy = None if arguments.converge is None else _accuracy(arguments.converge)
    study = read_study(arguments.study)
    model = discretise_study(study)
    document = _describe(study, model, picture)
    study, document = _look_at_motion(study, model, document)
    if accuracy is None:
        return Answer(document=document)

    from rfem_jax.report.tasks.mesh_report import convergence_document, convergence_text, study_convergence

    found = study_convergence(study, accuracy)
    show("\n" + convergence_text(found))
    return Answer(DONE if found.ok else CASE_FAILED, document | {"convergence": convergence_document(found)})


def _describe(study: Study, model: Model, picture: Path | None) -> dict[str, Any]:
    """Show what was understood and what it costs, and draw the start; what of it goes into the document."""
    from rfem_jax.mechanics import describe
    from rfem_jax.report.contents.overview import closed_text, design_text, opening_text, study_text
    from rfem_jax.report.tasks.study_cost import cost_text
    from rfem_jax.report.tasks.task_overview import tasks_text

    structure = describe(model)
    show(study_text(study, structure), end="\n\n")
    if text := closed_text(model):
        show(text, end="\n\n")
    if text := opening_text(study, model):
        show(text, end="\n\n")
    if picture is not None:
        _draw_start(study, model, picture)
    for text in (design_text(study), tasks_text(study), cost_text(study)):
        if text:
            show(text, end="\n\n")
    return _document(study, structure)


def _look_at_motion(study: Study, model: Model, document: dict[str, Any]) -> tuple[Study, dict[str, Any]]:
    """Show the largest stable step, the time that the cases take, and where the drive's motion ends; the study with the
    method that "auto" stands for, and the document with these."""
    from rfem_jax.report.tasks.study_cost import times_text
    from rfem_jax.simulation import check_step, drive_limit

    if model.topology.massless:
        names = ", ".join(model.link_names[l] for l in model.topology.massless)
        show(f"Links without mass ({names}): only positions at rest can be computed, as by `rfem-jax turn`.")
        return study, document
    if study.duration is None:
        return study, document
    if study.method.name == "auto":
        study = settle_method(study)
    else:
        announce("Looking for the largest stable step")
        step = check_step(model, study.method, study.drive)
        found = "any, chosen by the method, or not known" if step is None else f"{float(step):.3g} s"
        found = found if step is None or float(step) < study.duration else "longer than the simulation"
        show(f"Largest stable step of {study.method.name}: {found}.")
        document["largest_stable_step"] = None if step is None else float(step)
    document["method"] = study.method.as_table()
    if text := times_text(study):
        show(text)
    limit = drive_limit(model, study.designed_drive, study.duration)
    if limit is not None:
        show(f"The drive prescribes what the loops do not let it: they stop closing {limit.text}; a run is lost there.")
        document["drive_limit"] = {"time": limit.time, "of": limit.label, "position": limit.position}
    return study, document


def _no_study(text: str) -> str:
    """What follows `--converge` on the command line, where a study would be taken for the accuracy."""
    if text.lower().endswith(".toml"):
        raise argparse.ArgumentTypeError(
            f"must be followed by an accuracy or nothing, but was by {text!r}; write the study first: "
            f"rfem-jax check {text} --converge"
        )
    return text


def _accuracy(text: str) -> float:
    """A share, of a number or a percentage. Raises InputError."""
    number, percent, rest = text.partition("%")
    try:
        value = float(number) * (0.01 if percent else 1.0)
    except ValueError:
        value = 0.0
    if rest.strip() or not 0.0 < value < 1.0:
        from rfem_jax.description.basics.errors import InputError

        raise InputError(
            f'Argument `--converge` must be an accuracy between 0 and 1, but was {text!r}; write for example "1 %" or '
            "0.01."
        )
    return value


def _picture_file(path: str) -> Path:
    """The file of the picture. Raises InputError, before anything is read, for one that is no PNG or cannot be made."""
    file = Path(path)
    if file.suffix.lower() != ".png" or not file.stem:
        from rfem_jax.description.basics.errors import InputError

        raise InputError(
            f'Argument `--picture` must be a file that ends with ".png", but was {path!r}; write for example start.png.'
        )
    require_folder(file.parent)
    return file


def _draw_start(study: Study, model: Model, file: Path) -> None:
    """Draw the mechanism at its start into a file."""
    from rfem_jax.report.drawings.pictures import drawn, write_pictures

    def write() -> list[Path]:
        from rfem_jax.report.drawings.shapes import start_figure

        return write_pictures(file.parent, {file.stem: start_figure(study, model)})

    with writing_into(open_folder(file.parent)):
        for written in drawn(write):
            show(f"The start is drawn in {written}.", end="\n\n")


def _document(study: Study, structure: Any) -> dict[str, Any]:
    mechanism = study.mechanism
    joints = [
        {"name": one.name, "kind": one.kind, "parent": one.parent, "child": one.child, "cut": one.cut}
        for one in mechanism.joints
    ]
    found = {name: getattr(structure, name) for name in STRUCTURE}
    return {
        "title": study.title,
        "links": [{"name": one.name, "length": one.length, "mass": one.mass} for one in mechanism.links],
        "joints": joints,
        "structure": found,
        "start": structure.start._asdict(),
        "duration": study.duration,
        "method": study.method.as_table(),
        "largest_stable_step": None,
        "drive_limit": None,
        "design": study.design,
        "cases": {case.name: {error: float(value) for error, value in case.errors.items()} for case in study.cases},
        "tasks": list(study.tasks.declared),
        "units": {"length": "m", "mass": "kg", "gap": "m", "duration": "s", "largest_stable_step": "s"},
    }
