"""`rfem-jax keys`: all keys of study files, and all metrics.

Place in the pipeline: `rfem_jax.description.study_file.key_reference` -> `keys_text` -> **keys**.
"""

import argparse

from rfem_jax.report.commands.command import Answer, Command
from rfem_jax.report.terminal.messages import show


def command() -> Command:
    """The subcommand."""
    return Command(
        name="keys",
        purpose="print all keys of study files, and all metrics",
        description="Print all tables and keys that a study file may have, their defaults, and what they mean. "
        'Numbers are in SI units and radians, or strings with a unit such as "0.5 deg". `rfem-jax keys metrics` '
        "prints all metrics, their units, meanings, what has them, and their equations.",
        add_arguments=_add_arguments,
        act=act,
        computes=False,
    )


def _add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "table",
        metavar="WORD",
        nargs="?",
        help='tables with this word in their header, such as "joints"; "metrics" for all metrics, '
        "or a word in the names of some",
    )
    parser.add_argument(
        "--schema", action="store_true", help="print a JSON Schema of study files, by which editors complete them"
    )


def act(arguments: argparse.Namespace) -> Answer:
    """Print the reference. Raises InputError."""
    from dataclasses import asdict

    from rfem_jax.description.study_file.schema import schema_text, study_schema
    from rfem_jax.report.contents.keys_text import chosen_metrics, chosen_tables, reference_text

    if arguments.schema:
        show(schema_text().rstrip())
        return Answer(document=study_schema())
    show(reference_text(arguments.table))
    if metrics := chosen_metrics(arguments.table):
        return Answer(document={"metrics": [asdict(table) for table in metrics]})
    return Answer(document={"tables": [asdict(table) for table in chosen_tables(arguments.table)]})
