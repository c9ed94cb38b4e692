"""Files that are written whole or not at all: beside their final place, and then renamed.

Place in the pipeline: beside all packages, and imports none of them; results, pictures and the samples of Monte Carlo
studies are written so; kept programs are, too, but by descriptors of a folder that others may write
(`compilation.cache`).
"""

import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

UNFINISHED = ".tmp"


@contextmanager
def replacing(path: str | Path) -> Iterator[Path]:
    """Give a temporary path beside `path`; rename it to `path` when the block ends well."""
    path = Path(path)
    temporary = path.with_name(f"{path.name}.{secrets.token_hex(4)}{UNFINISHED}")
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
