"""Folders for results: refused before anything is computed where they cannot be written; new files.

Place in the pipeline: used by the subcommands that write.
"""

import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from rfem_jax.report.terminal.console import work_begins

FIX = "choose another one or free some space"


def require_folder(out: str | Path) -> None:
    """See that a folder for the results can be made, without making it. Raises InputError."""
    if not str(out).strip():
        from rfem_jax.description.basics.errors import InputError

        raise InputError("Argument `--out` must name a folder, but is empty; write . for the current one.")
    folder = Path(out).absolute()
    existing = next(path for path in (folder, *folder.parents) if path.exists())
    if not existing.is_dir():
        raise cannot_write(folder, NotADirectoryError(20, f"{existing} is a file"))
    if not os.access(existing, os.W_OK | os.X_OK):
        raise cannot_write(folder, PermissionError(13, "permission denied"))


def open_folder(out: str | Path) -> Path:
    """Make the folder for the results and see that files can be written into it.

    Raises InputError before anything is simulated, not after.
    """
    work_begins()
    folder = Path(out)
    with writing_into(folder):
        folder.mkdir(parents=True, exist_ok=True)
        probe = folder / f".{secrets.token_hex(8)}.part"
        probe.touch()
        probe.unlink()
    return folder


@contextmanager
def writing_into(folder: str | Path) -> Iterator[None]:
    """In which files that cannot be written are an InputError."""
    try:
        yield
    except OSError as problem:
        raise cannot_write(folder, problem) from problem


def cannot_write(folder: str | Path, problem: OSError) -> ValueError:
    """The InputError for a folder into which the results cannot be written."""
    from rfem_jax.description.basics.errors import InputError
    from rfem_jax.whole_files import HELD_WHILE_OPEN

    held = HELD_WHILE_OPEN and isinstance(problem, PermissionError)
    fix = "close programs that have its files open, or choose another one" if held else FIX
    return InputError(
        f"Argument `--out` must be a folder that can be written, but {folder} is not "
        f"({problem.strerror or problem}); {fix}."
    )


def write_new(path: Path, text: str, argument: str) -> None:
    """Write a file that does not exist yet; `argument` named it. Raises InputError."""
    from rfem_jax.description.basics.errors import InputError

    try:
        with open(path, "x", encoding="utf-8", newline="\n") as file:
            file.write(text)
    except FileExistsError:
        raise InputError(
            f"Argument `{argument}` must name a new file, but `{path}` exists; choose another name, or remove the file."
        ) from None
    except (OSError, ValueError) as problem:
        raise _unwritable(path, argument, problem) from problem


def write_study(path: Path, text: str, argument: str) -> Path:
    """Write a new study file, and beside it the schema, whose path is returned. Raises InputError."""
    from rfem_jax.description.study_file.schema import FILE, schema_text
    from rfem_jax.whole_files import write_text

    write_new(path, text, argument)
    schema = path.with_name(FILE)
    try:
        write_text(schema, schema_text())
    except OSError as problem:
        raise _unwritable(path, argument, problem) from problem
    return schema


def _unwritable(path: Path, argument: str, problem: Exception) -> ValueError:
    from rfem_jax.description.basics.errors import InputError

    reason = getattr(problem, "strerror", None) or problem
    return InputError(
        f"Argument `{argument}` must name a file that can be written, but `{path}` cannot ({reason}); choose another."
    )
