"""Files that are written whole or not at all: beside their final place, and then renamed; arrays with a checksum.

Place in the pipeline: beside all packages, and imports none of them; results, pictures and what interrupted commands
leave are written so; kept programs are, too, but by descriptors of a folder that others may write
(`compilation.cache`).
"""

import hashlib
import io
import os
import platform
import re
import secrets
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

UNFINISHED = ".tmp"
PATIENCE = 3600.0  # s after which a file that nobody finished is nobody's
# Where a file that a program has open cannot be replaced: scanners and indexes let go of new files soon.
HELD_WHILE_OPEN = sys.platform == "win32"
PAUSES = (0.05, 0.1, 0.2, 0.4, 0.8)  # s


@contextmanager
def replacing(path: str | Path) -> Iterator[Path]:
    """Give a temporary path beside `path`; rename it to `path` when the block ends well."""
    path = Path(path)
    temporary = path.with_name(f"{path.name}.{_machine()}-{os.getpid()}-{secrets.token_hex(4)}{UNFINISHED}")
    try:
        yield temporary
        _rename(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def _rename(temporary: Path, path: Path) -> None:
    for pause in PAUSES if HELD_WHILE_OPEN else ():
        try:
            os.replace(temporary, path)
            return
        except PermissionError:
            time.sleep(pause)
    os.replace(temporary, path)


def write_text(path: str | Path, text: str) -> Path:
    """Write a text whole or not at all, with the same bytes on all systems: UTF-8, lines that end with one character.
    Returns the path."""
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8", newline="\n")
    return Path(path)


def write_whole(path: Path, payload: bytes) -> None:
    """Write bytes so that `path` either does not change or holds all of them, and stays so if the machine stops.
    Raises OSError."""
    with replacing(path) as temporary, open(temporary, "wb") as file:
        file.write(payload)
        file.flush()
        os.fsync(file.fileno())
    _synchronise_folder(path.parent)


class Damaged(ValueError):
    """The content of a file is not what was written, or belongs to something else."""


def pack_arrays(arrays: dict[str, np.ndarray], owner: str) -> bytes:
    """The content of a file of named arrays, with a checksum that covers them and what they belong to, `owner`. Pickled
    objects are neither written nor read."""
    buffer = io.BytesIO()
    named = {"checksum": np.array(_checksum(arrays, owner)), **arrays}
    np.savez(buffer, **named)  # pyright: ignore[reportArgumentType] - the stub takes names for `allow_pickle`
    return buffer.getvalue()


def unpack_arrays(content: bytes, owner: str) -> dict[str, np.ndarray]:
    """The arrays {name: array} of such a content. Raises Damaged."""
    try:
        with np.load(io.BytesIO(content), allow_pickle=False) as stored:
            arrays = {name: stored[name] for name in stored.files}
        checksum = str(arrays.pop("checksum"))
    except Exception as error:
        # NumPy, zipfile and zlib raise ten kinds of errors and more, depending on the byte that is wrong.
        raise Damaged(str(error)) from error
    if checksum != _checksum(arrays, owner):
        raise Damaged("its checksum does not fit")
    return arrays


def _checksum(arrays: dict[str, np.ndarray], owner: str) -> str:
    digest = hashlib.sha256(owner.encode())
    for name in sorted(arrays):
        array = np.ascontiguousarray(arrays[name])
        digest.update(f" {name} {array.dtype.str} {array.shape} ".encode())
        digest.update(array.tobytes())
    return digest.hexdigest()


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
