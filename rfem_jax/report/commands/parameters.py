"""`rfem-jax parameters`: the numbers of a study that [design] may set and [tolerances] may scatter.

Place in the pipeline: `load_study` (description) -> **parameters**.
"""

import argparse

from rfem_jax.report.commands.command import Answer, Command, add_study
from rfem_jax.report.commands.steps import read_study
from rfem_jax.report.terminal.messages import show


def command() -> Command:
    """The subcommand."""
    return Command(
        name="parameters",
        purpose="print the numbers of a study that may be set, scattered and optimised",
        description="Print name, value and SI unit of every number of a study's mechanism and drives. [design] sets "
        "them or gives them bounds, [tolerances] lets them deviate.",
        add_arguments=_add_arguments,
        act=act,
    )


def _add_arguments(parser: argparse.ArgumentParser) -> None:
    add_study(parser)
    parser.add_argument("word", metavar="WORD", nargs="?", default="", help='names with this word, such as "rocker"')


def act(arguments: argparse.Namespace) -> Answer:
    """Print the table. Raises InputError."""
    study = read_study(arguments.study)

    from rfem_jax.description.drives.numbers_by_name import drive_number_unit, drive_number_value, each_drive_number
    from rfem_jax.description.parameters.parameters import parameters_of
    from rfem_jax.description.parameters.parts import parts_of
    from rfem_jax.report.contents.tables import format_table

    parts = parts_of(study.mechanism)
    found = {one.name: (one.value_in(parts), one.unit) for one in parameters_of(study.mechanism).all}
    for name, index in each_drive_number(study.drives, study.drive_labels).items():
        found[name] = float(drive_number_value(study.drives[index])), drive_number_unit(name)
    found = {name: one for name, one in found.items() if arguments.word in name}
    rows = [[name, f"{value:.10g}", unit] for name, (value, unit) in found.items()]
    show(format_table(["parameter", "value", "unit"], rows))
    return Answer(document={"parameters": {name: {"value": x, "unit": unit} for name, (x, unit) in found.items()}})
