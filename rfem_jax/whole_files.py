"""Files that are written whole or not at all: beside their final place, and then renamed.

Place in the pipeline: beside all packages, and imports none of them; results, pictures and the samples of Monte Carlo
studies are written so; kept programs are, too, but by descriptors of a folder that others may write
(`compilation.cache`).
"""

import os
import platform
import re
import secrets
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

UNFINISHED = ".tmp"
PATIENCE = 3600.0  # s after which a file that nobody finished is nobody's


@contextmanager
def replacing(path: str | Path) -> Iterator[Path]:
    """Give a temporary path beside `path`; rename it to `path` when the block ends well."""
    path = Path(path)
    temporary = path.with_name(f"{path.name}.{_machine()}-{os.getpid()}-{secrets.token_hex(4)}{UNFINISHED}")
    try:
        yield temporary
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def write_whole(path: Path, payload: bytes) -> None:
    """Write bytes so that `path` either does not change or holds all of them, and stays so if the machine stops.
    Raises OSError."""
    with replacing(path) as temporary, open(temporary, "wb") as file:
        file.write(payload)
        file.flush()
        os.fsync(file.fileno())
    _synchronise_folder(path.parent)


def remove_abandoned(path: Path) -> None:
    """Remove unfinished files of `path` that killed processes have left. Those of a process of this machine that lives,
    and new ones of other machines, are being written: several processes may have one folder. Raises OSError."""
    for left in path.parent.glob(f"{path.name}.*{UNFINISHED}"):
        if _is_abandoned(left):
            left.unlink(missing_ok=True)


def _is_abandoned(file: Path) -> bool:
    try:
        if time.time() - file.stat().st_mtime > PATIENCE:
            return True
    except OSError:  # it is finished now
        return False
    named = re.search(r"\.([^.]*)-(\d+)-[0-9a-f]+\.tmp$", file.name)
    if os.name != "posix" or named is None or named[1] != _machine():
        return False
    try:
        os.kill(int(named[2]), 0)
    except ProcessLookupError:
        return True
    except (OSError, OverflowError):  # it is of another user
        return False
    return False


def _machine() -> str:
    """Name of this machine, as a part of a file's name."""
    return re.sub(r"[^A-Za-z0-9_]", "_", platform.node())[:40] or "unnamed"


def _synchronise_folder(folder: Path) -> None:
    """Make a rename durable; systems that cannot open folders do without."""
    try:
        descriptor = os.open(folder, os.O_RDONLY)
    except OSError:
        return
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
