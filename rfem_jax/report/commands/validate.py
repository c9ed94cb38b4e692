"""`rfem-jax validate`: published problems beside their reference values.

Place in the pipeline: `report.validation.validation_command` computes and prints; **validate** has its options.
"""

import argparse

from rfem_jax.report.commands.command import CASE_FAILED, DONE, Answer, Command, Interrupted, add_cache
from rfem_jax.report.commands.folders import cannot_write, open_folder
from rfem_jax.report.commands.steps import announce, files_document
from rfem_jax.report.terminal.console import work_begins
from rfem_jax.report.terminal.messages import show


def command() -> Command:
    """The subcommand."""
    return Command(
        name="validate",
        purpose="compute published benchmarks and compare with their reference values",
        description="Compute published benchmarks and print every value beside its reference; exit "
        "code 3 if one fails.",
        add_arguments=_add_arguments,
        act=act,
    )


def _add_arguments(parser: argparse.ArgumentParser) -> None:
    add_cache(parser)
    parser.add_argument("--full", action="store_true", help="fine discretisations too (slow)")
    parser.add_argument("--only", metavar="NAME", nargs="+", help="these benchmarks only")
    parser.add_argument("--out", metavar="DIR", help="folder for tables and pictures")


def act(arguments: argparse.Namespace) -> Answer:
    """Compute, print, write. Raises InputError."""
    from rfem_jax.report.validation.validation_command import Stopped, validate
    from rfem_jax.report.validation.validation_tables import has_failed, line_rows

    folder = None if arguments.out is None else open_folder(arguments.out)
    work_begins()
    try:
        lines, written = validate(arguments.only, arguments.full, folder, announce)
    except OSError as problem:
        if folder is None:
            raise
        raise cannot_write(folder, problem) from problem
    except Stopped as end:
        kept = f", in {folder}" if folder is not None and end.done else ""
        out = "" if folder is None else f" --out {folder}_rest"
        full = " --full" if arguments.full else ""
        rest = f"rfem-jax validate{full} --only {' '.join(end.left)}{out}"
        raise Interrupted(f"{end.done} benchmarks are done{kept}. Go on with: {rest}") from None
    if written:
        show(f"{len(written)} files written to {folder}.")
    code = CASE_FAILED if has_failed(lines) else DONE
    return Answer(code, {"lines": line_rows(lines)} | files_document(folder, written))
