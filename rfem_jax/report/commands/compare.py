"""`rfem-jax compare`: two results side by side.

Place in the pipeline: two folders with results -> `contents.comparison`, `task_comparison` -> **compare**.
"""

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rfem_jax.report.commands.command import Answer, Command
from rfem_jax.report.commands.folders import open_folder, writing_into
from rfem_jax.report.terminal.messages import paint, show

if TYPE_CHECKING:
    from rfem_jax.report.contents.comparison import Comparison
else:
    Comparison = Any  # takes long to import


def command() -> Command:
    """The subcommand."""
    return Command(
        name="compare",
        purpose="compare the results of two runs, joint by joint, and of their tasks",
        description="Print the loads of two folders that `rfem-jax run` has written side by side, with their absolute "
        "and relative differences, for all cases and joints that both have, and the numbers of all tasks and analyses "
        "that both have; say what only one of them has. The exit code is 0 whether they differ or not.",
        add_arguments=_add_arguments,
        act=act,
        computes=False,
    )


def _add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("folders", metavar="DIR", nargs=2, help="folders with results")
    parser.add_argument("--out", metavar="DIR", help="folder for comparison.json, comparison.csv, comparison_tasks.csv")


def act(arguments: argparse.Namespace) -> Answer:
    """Read, compare, print, write. Raises InputError."""
    from rfem_jax.report.contents.output import write_csv, write_json
    from rfem_jax.report.task_comparison import compare_tasks

    folders = [Path(one) for one in arguments.folders]
    tasks = compare_tasks(*folders)
    found = _compare_results(folders, bool(tasks.differences))
    rows, of_tasks = [one.row() for one in found.differences], tasks.rows()
    document = {
        "folders": list(arguments.folders), "remarks": [*found.remarks, *tasks.remarks], "differences": rows,
        "tasks": of_tasks,
    }  # fmt: skip
    show(found.text(arguments.folders), end="\n\n")
    if text := tasks.text():
        show(text, end="\n\n")
    show(paint(found.largest(), "bold", sys.stdout))
    if arguments.out is None:
        return Answer(document=document)
    folder = open_folder(arguments.out)
    written: list[Path] = []
    with writing_into(folder):
        written.append(write_json(folder / "comparison.json", document))
        for name, table in (("comparison", rows), ("comparison_tasks", of_tasks)):
            if table:
                written.append(write_csv(folder / f"{name}.csv", table))
    show(f"{len(written)} file{'s' if len(written) > 1 else ''} written to {folder}.")
    return Answer(document=document | {"files": [str(one) for one in written]})


def _compare_results(folders: list[Path], tasks: bool) -> Comparison:
    """The loads; nothing where neither folder has any, but both have results of tasks. Raises InputError."""
    from rfem_jax.report.contents.comparison import RESULTS, Comparison, compare_results, read_results

    if tasks and not any((folder / RESULTS).exists() for folder in folders):
        return Comparison((), ("Neither has loads of cases.",))
    return compare_results(*map(read_results, folders))
