"""What a subcommand is: its words for `--help`, its options, and what it does.

Place in the pipeline: **command** -> the files of this package -> `catalogue` -> `command_line`, which prints the
answer as one JSON document where `--json` asks for it.
"""

import argparse
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

DONE, UNREAD, WRONG_INPUT, CASE_FAILED, INTERRUPTED = 0, 1, 2, 3, 130
EXIT_CODES = {
    DONE: "done",
    UNREAD: "the output is no longer read (as in a pipe to head)",
    WRONG_INPUT: "the input is wrong",
    CASE_FAILED: "a case or a task failed",
    INTERRUPTED: "interrupted",
}


@dataclass(frozen=True)
class Answer:
    """What a subcommand has done.

    Args:
        code: exit code.
        document: what `--json` prints: names, strings, numbers, lists and dicts of them, SI units.
    """

    code: int = DONE
    document: Mapping[str, Any] = field(default_factory=dict)


class Interrupted(KeyboardInterrupt):
    """A subcommand was interrupted: `sentence` says what is done and kept, and how to go on; `document` as of an
    answer."""

    def __init__(self, sentence: str, document: Mapping[str, Any] | None = None):
        super().__init__(sentence)
        self.sentence, self.document = sentence, dict(document or {})


@dataclass(frozen=True)
class Command:
    """A subcommand.

    Args:
        name: as it is called, `rfem-jax NAME`.
        purpose: a few words for `rfem-jax --help`.
        description: sentences for `rfem-jax NAME --help`.
        act: does it, with the parsed arguments. What it raises: InputError for what the user has to change.
        add_arguments: gives the parser its arguments and options.
            Interrupted where something is done when it is interrupted.
        epilog: what stands below the options in the help.
        computes: False if neither JAX nor a device is needed.
    """

    name: str
    purpose: str
    description: str
    act: Callable[[argparse.Namespace], Answer]
    add_arguments: Callable[[argparse.ArgumentParser], None] = lambda parser: None
    epilog: str | None = None
    computes: bool = True


def add_study(parser: argparse.ArgumentParser) -> None:
    """The study file."""
    parser.add_argument("study", metavar="STUDY.toml", help="the study file")


def add_axes(parser: argparse.ArgumentParser) -> None:
    """Further axes for the loads of joints."""
    parser.add_argument(
        "--axes",
        choices=("joint", "parent", "child", "global"),
        default="joint",
        help="write the loads of all joints in these axes, too: of the parent's link, of the child's, or global ones "
        "(default: each in the frame of its joint alone)",
    )


def add_motion(parser: argparse.ArgumentParser) -> None:
    """Files of the motion for other programs."""
    parser.add_argument(
        "--motion",
        nargs="+",
        choices=("vtp", "gltf"),
        default=[],
        help="write the motion of every case for other programs, too: vtp for ParaView, with the loads in the joints; "
        "gltf for Blender and viewers in browsers",
    )


def add_pictures(parser: argparse.ArgumentParser) -> None:
    """Whether pictures are drawn."""
    parser.add_argument(
        "--no-pictures",
        dest="pictures",
        action="store_false",
        help="draw no pictures, which take longer than a simulation whose programs are kept; tables, files and "
        "report.html are the same",
    )


def add_study_and_folder(parser: argparse.ArgumentParser) -> None:
    """The study file, the folder for the results, devices, and whether programs are kept."""
    add_study(parser)
    parser.add_argument("--out", metavar="DIR", required=True, help="folder for the results")
    parser.add_argument("--devices", metavar="K", type=int, help="CPU devices for samples (default: all cores)")
    add_cache(parser)


def add_cache(parser: argparse.ArgumentParser) -> None:
    """Whether programs are kept."""
    parser.add_argument(
        "--no-cache", dest="cache", action="store_false", help="keep no compiled programs, and use none"
    )


def add_processes(parser: argparse.ArgumentParser) -> None:
    """Several processes for one task."""
    group = parser.add_argument_group(
        "several processes or machines",
        "Start the same command once per process; they share the folder DIR, and need nothing else of each other.",
    )
    group.add_argument("--coordinator", metavar="HOST:PORT", help="not needed any more")
    group.add_argument("--processes", metavar="N", type=int, help="number of processes")
    group.add_argument("--process-id", metavar="I", type=int, help="number of this process, from 0")
