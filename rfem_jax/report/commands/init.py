"""`rfem-jax init`: a commented study to start from.

Place in the pipeline: files of `report/starting_studies`, `schema` -> **init** -> the user's own study file.
"""

import argparse
from importlib import resources
from pathlib import Path

from rfem_jax.report.commands.command import Answer, Command
from rfem_jax.report.commands.folders import write_study
from rfem_jax.report.terminal.messages import show

KINDS = ("four-bar", "slider-crank", "six-bar", "cam", "geared-five-bar", "planetary")


def command() -> Command:
    """The subcommand."""
    return Command(
        name="init",
        purpose="write a commented study to start from",
        description="Write NAME.toml, a complete study of a mechanism with comments, to change into your own. "
        "A file that exists is not overwritten. Beside it rfem_jax.schema.json, by which editors complete and check "
        "study files.",
        add_arguments=_add_arguments,
        act=act,
        computes=False,
    )


def _add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("name", metavar="NAME", help="name of the file, with .toml or without")
    parser.add_argument("--kind", choices=KINDS, default=KINDS[0], help="the mechanism (default: %(default)s)")


def act(arguments: argparse.Namespace) -> Answer:
    """Write the file and say what to do with it. Raises InputError."""
    name = arguments.name
    path = Path(name if name.endswith(".toml") else f"{name}.toml")
    kept = resources.files("rfem_jax.report") / "starting_studies" / f"{arguments.kind.replace('-', '_')}.toml"
    text = kept.read_text(encoding="utf-8").replace("@FILE@", path.name).replace("@NAME@", path.stem)
    schema = write_study(path, text, "NAME")
    show(f"{path} written: a {arguments.kind}. Go on with\n")
    show(f"  rfem-jax check {path}\n  rfem-jax run {path} --out results/{path.stem}")
    show(f"\n{schema} beside it lets editors of TOML complete and check studies.")
    return Answer(document={"files": [str(path), str(schema)], "kind": arguments.kind})
