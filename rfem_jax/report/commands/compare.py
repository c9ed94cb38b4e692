"""`rfem-jax compare`: two results side by side.

Place in the pipeline: two folders that `rfem-jax run` has written -> `report.comparison` -> **compare**.
"""

import argparse
import sys
from pathlib import Path

from rfem_jax.report.commands.command import Answer, Command
from rfem_jax.report.commands.folders import cannot_write, open_folder
from rfem_jax.report.progress_line import paint, show


def command() -> Command:
    """The subcommand."""
    return Command(
        name="compare",
        purpose="compare the results of two runs, joint by joint",
        description="Print the loads of two folders that `rfem-jax run` has written side by side, with their absolute "
        "and relative differences, for all cases and joints that both have; say what only one of them has. The exit "
        "code is 0 whether they differ or not.",
        add_arguments=_add_arguments,
        act=act,
        computes=False,
    )


def _add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("folders", metavar="DIR", nargs=2, help="folders with results.json")
    parser.add_argument("--out", metavar="DIR", help="folder for comparison.json and comparison.csv")


def act(arguments: argparse.Namespace) -> Answer:
    """Read, compare, print, write. Raises InputError."""
    from rfem_jax.report.comparison import compare_results, read_results
    from rfem_jax.report.output import write_csv, write_json

    found = compare_results(*(read_results(one) for one in arguments.folders))
    rows = [one.row() for one in found.differences]
    document = {"folders": list(arguments.folders), "remarks": list(found.remarks), "differences": rows}
    show(found.text(arguments.folders), end="\n\n")
    show(paint(found.largest(), "bold", sys.stdout))
    if arguments.out is None:
        return Answer(document=document)
    folder = open_folder(arguments.out)
    written: list[Path] = []
    try:
        written.append(write_json(folder / "comparison.json", document))
        if rows:
            written.append(write_csv(folder / "comparison.csv", rows))
    except OSError as problem:
        raise cannot_write(folder, problem) from problem
    show(f"{len(written)} file{'s' if len(written) > 1 else ''} written to {folder}.")
    return Answer(document=document | {"files": [str(one) for one in written]})
