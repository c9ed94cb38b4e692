"""`rfem-jax report`: the page `report.html` from the files of a folder.

Place in the pipeline: a folder that other commands have written -> `report.page` -> **report**.
"""

import argparse

from rfem_jax.report.commands.command import Answer, Command
from rfem_jax.report.commands.folders import writing_into
from rfem_jax.report.terminal.messages import show


def command() -> Command:
    """The subcommand."""
    return Command(
        name="report",
        purpose="write report.html from the files of a folder",
        description="Write report.html, a page for any browser, from the files that other commands have written into "
        "a folder: the mechanism as it moves, loads over time, tables, tasks, checks. Nothing is computed.",
        add_arguments=_add_arguments,
        act=act,
        computes=False,
    )


def _add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("folder", metavar="DIR", help="the folder that was given to --out")


def act(arguments: argparse.Namespace) -> Answer:
    """Read the files, write the page. Raises InputError."""
    from rfem_jax.report.page.document import write_folder

    with writing_into(arguments.folder):
        path = write_folder(arguments.folder)
    show(f"1 file written: {path}.")
    return Answer(document={"folder": str(arguments.folder), "files": [str(path)]})
