"""The command `rfem-jax`: from a study file to tables, files and pictures.

Place in the pipeline: the outermost layer; it parses the arguments, sets up the process and calls a subcommand of
`report.commands`; `messages` shows what is being done. Exit codes: 0 done; 2 the input
is wrong (one sentence on standard error); 3 a case or a task failed (results are written all the same); 1 what is
printed could not be (nobody reads it any more; files are written all the same); 130 interrupted.

With `--json` standard output has one JSON document and nothing else: `command`, `exit_code`, `problems` (a list of
sentences, empty where the input is right), and what the subcommand answers. All else is on standard error.

Imports that take seconds (JAX, matplotlib) are inside the functions: `--help` is instant.
"""

import argparse
import gc
import json
import os
import signal
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from typing import Any, NoReturn

from rfem_jax.report.commands.catalogue import all_commands
from rfem_jax.report.commands.command import (
    DONE,
    EXIT_CODES,
    INTERRUPTED,
    UNREAD,
    WRONG_INPUT,
    Answer,
    Command,
    Interrupted,
)
from rfem_jax.report.terminal.console import (
    Reading,
    end_early_by,
    ends_early,
    flush,
    open_closed_streams,
    printable,
    write,
)
from rfem_jax.report.terminal.messages import ProgressLine, clear_lines, output_mode, paint, print_document, say
from rfem_jax.report.terminal.process import count_devices, require_platform, set_up_jax, sharing

NOTHING_DONE = "nothing was done yet; start the same command again."


class _Parser(argparse.ArgumentParser):
    """A parser whose complaints are one sentence, like all others of this command."""

    def error(self, message: str) -> NoReturn:
        self.exit(WRONG_INPUT, f"{message} (see `{self.prog} --help`)\n")


def _version() -> str:
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version("rfem-jax")
    except PackageNotFoundError:
        return "(not installed)"


def build_parser() -> argparse.ArgumentParser:
    """Parser of the command with its subcommands."""
    codes = "; ".join(f"{code} {meaning}" for code, meaning in sorted(EXIT_CODES.items()))
    parser = _Parser(
        prog="rfem-jax",
        description="Loads in the joints of mechanisms with flexible links and assembly errors.",
        epilog=f"Exit codes: {codes}.",
    )
    parser.add_argument("--version", action="version", version=f"rfem-jax {_version()}")
    commands = parser.add_subparsers(title="commands", dest="command", required=True)
    for one in all_commands():
        added = commands.add_parser(one.name, help=one.purpose, description=one.description, epilog=one.epilog)
        one.add_arguments(added)
        words = added.add_argument_group("what is printed")
        words.add_argument(
            "--json", action="store_true", help="one JSON document on standard output, all else on standard error"
        )
        words.add_argument("--quiet", action="store_true", help="no progress and no remarks")
        added.set_defaults(chosen=one)
    return parser


@contextmanager
def _rare_collections() -> Iterator[None]:
    """Hundreds of thousands of objects of JAX and matplotlib live as long as the command: looking through them for
    garbage as often as Python does by itself takes a tenth of the time."""
    before = gc.get_threshold()
    gc.set_threshold(50_000, 200, 100)
    try:
        yield
    finally:
        gc.set_threshold(*before)


def _act(arguments: argparse.Namespace, line: ProgressLine) -> Answer:
    command: Command = arguments.chosen
    if not command.computes:
        return command.act(arguments)
    set_up_jax(count_devices(arguments), getattr(arguments, "cache", True), getattr(arguments, "out", None))
    require_platform()
    from rfem_jax.compilation.stages import listening

    with listening(line), sharing(arguments):
        return command.act(arguments)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command with the arguments `argv` (default: those of the process).

    Returns the exit code; wrong input, an interruption and files that cannot be written become
    one sentence on standard error, anything else is a fault of this program and raises.
    """
    Reading.ends = False
    with printable():
        try:
            code = _main(argv)
        except KeyboardInterrupt:  # before or after the subcommand
            say(f"Interrupted: {NOTHING_DONE}")
            code = INTERRUPTED
        return code if flush() or code != DONE else UNREAD


def run_process() -> int:
    """`main` as all that a process does."""
    open_closed_streams()
    end_early_by(partial(_end_at_once, None))
    code = main()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # all is done
    # What is left is not looked through for garbage: half a second, for nothing.
    gc.freeze()
    return code


def _leave(code: int) -> NoReturn:
    """End the process without waiting for its threads."""
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError, ValueError):
            stream.flush()
    os._exit(code)


def _end_at_once(arguments: argparse.Namespace | None) -> NoReturn:
    """End the process, which is interrupted before anything is done."""
    sentence = f"Interrupted: {NOTHING_DONE}"
    clear_lines()
    write(sys.stderr, f"{paint(sentence, 'yellow', sys.stderr)}\n")
    if arguments is not None and arguments.json:
        content = {"command": arguments.command, "exit_code": INTERRUPTED, "problems": [sentence]}
        write(sys.stdout, f"{json.dumps(content, indent=2)}\n")
    _leave(INTERRUPTED)


def _main(argv: Sequence[str] | None) -> int:
    try:
        arguments = build_parser().parse_args(argv)
    except SystemExit as end:
        return int(end.code or 0)
    if ends_early():
        end_early_by(partial(_end_at_once, arguments))
    with output_mode(document=arguments.json, quiet=arguments.quiet):
        answer, problems = _answer(arguments)
    if arguments.json:
        head = {"command": arguments.command, "exit_code": answer.code, "problems": problems}
        print_document(_document(head | dict(answer.document)))
    return answer.code


def _answer(arguments: argparse.Namespace) -> tuple[Answer, list[str]]:
    """The subcommand's answer, and what was wrong."""
    command: Command = arguments.chosen
    try:
        with _rare_collections(), ProgressLine(sys.stderr) as line:
            if command.computes:
                line("Loading JAX")
            from rfem_jax.description.basics.errors import InputError

            try:
                return _act(arguments, line), []
            except InputError as problem:
                problems = [" ".join(sentence.split()) for sentence in problem.problems]
                for sentence in problems:
                    say(paint(sentence, "red", sys.stderr))
                return Answer(WRONG_INPUT), problems
    except KeyboardInterrupt as end:
        interrupted = end if isinstance(end, Interrupted) else Interrupted(NOTHING_DONE)
        sentence = f"Interrupted: {interrupted.sentence}"
        say(paint(sentence, "yellow", sys.stderr))
        return Answer(INTERRUPTED, interrupted.document), [sentence]


def _document(content: dict[str, Any]) -> str:
    from rfem_jax.report.contents.output import plain, without_nan

    return json.dumps(without_nan(plain(content)), indent=2, allow_nan=False)


if __name__ == "__main__":
    sys.exit(run_process())
