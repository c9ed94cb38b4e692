"""All subcommands in the order of `--help`.

Place in the pipeline: the files of this package -> **catalogue** -> `report.command_line`.
A new one is a file of this package with a function `command() -> Command`, and its name in
`rfem_jax.task_kinds.COMMANDS`.
"""

from importlib import import_module

from rfem_jax.report.commands.command import Command
from rfem_jax.report.commands.tasks import task_commands
from rfem_jax.task_kinds import COMMANDS


def all_commands() -> list[Command]:
    """Those of files, with those of the kinds of tasks after `run`."""
    of_files = [import_module(f"{__package__}.{name.replace('-', '_')}").command() for name in COMMANDS]
    first = 1 + COMMANDS.index("run")
    return [*of_files[:first], *task_commands(), *of_files[first:]]
