"""`rfem-jax check`: what a study says, and what it costs, without simulating.

Place in the pipeline: `load_study` (description) -> `describe` (mechanics), `check_step` (simulation) -> `overview`,
`tasks.task_overview`, `study_cost`.
"""

import argparse
from pathlib import Path
from typing import Any

from rfem_jax.report.annotations import Model, Study
from rfem_jax.report.commands.command import Answer, Command, add_cache, add_study
from rfem_jax.report.commands.folders import open_folder, require_folder, writing_into
from rfem_jax.report.commands.steps import announce, discretise_study, read_study, settle_method
from rfem_jax.report.progress_line import show

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
    add_cache(parser)


def act(arguments: argparse.Namespace) -> Answer:
    """Read, describe, look for the largest stable step. Raises InputError."""
    picture = None if arguments.picture is None else _picture_file(arguments.picture)
    study = read_study(arguments.study)

    from rfem_jax.mechanics import describe
    from rfem_jax.report.overview import closed_text, design_text, opening_text, study_text
    from rfem_jax.report.study_cost import cost_text, times_text
    from rfem_jax.report.tasks.task_overview import tasks_text
    from rfem_jax.simulation import check_step, drive_limit

    model = discretise_study(study)
    structure = describe(model)
    show(study_text(study, structure), end="\n\n")
    if text := closed_text(model):
        show(text, end="\n\n")
    if text := opening_text(study, model):
        show(text, end="\n\n")
    if picture is not None:
        _draw_start(study, model, picture)
    if text := design_text(study):
        show(text, end="\n\n")
    if text := tasks_text(study):
        show(text, end="\n\n")
    show(cost_text(study), end="\n\n")
    step = None
    if model.topology.massless:
        names = ", ".join(model.link_names[l] for l in model.topology.massless)
        show(f"Links without mass ({names}): only positions at rest can be computed, as by `rfem-jax turn`.")
        return Answer(document=_document(study, structure, step, None))
    if study.duration is None:
        return Answer(document=_document(study, structure, step, None))
    if study.method.name == "auto":
        study = settle_method(study)
    else:
        announce("Looking for the largest stable step")
        step = check_step(model, study.method, study.drive)
        found = "any, chosen by the method, or not known" if step is None else f"{float(step):.3g} s"
        found = found if step is None or float(step) < study.duration else "longer than the simulation"
        show(f"Largest stable step of {study.method.name}: {found}.")
    if text := times_text(study):
        show(text)
    limit = drive_limit(model, study.designed_drive, study.duration)
    if limit is not None:
        show(f"The drive prescribes what the loops do not let it: they stop closing {limit.text}; a run is lost there.")
    return Answer(document=_document(study, structure, step, limit))


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
    from rfem_jax.report.pictures import drawn, write_pictures

    def write() -> list[Path]:
        from rfem_jax.report.shapes import start_figure

        return write_pictures(file.parent, {file.stem: start_figure(study, model)})

    with writing_into(open_folder(file.parent)):
        for written in drawn(write):
            show(f"The start is drawn in {written}.", end="\n\n")


def _document(study: Study, structure: Any, step: float | None, limit: Any) -> dict[str, Any]:

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
        "largest_stable_step": None if step is None else float(step),
        "drive_limit": None if limit is None else {"time": limit.time, "of": limit.label, "position": limit.position},
        "design": study.design,
        "cases": {case.name: {error: float(value) for error, value in case.errors.items()} for case in study.cases},
        "tasks": list(study.tasks.declared),
        "units": {"length": "m", "mass": "kg", "gap": "m", "duration": "s", "largest_stable_step": "s"},
    }
