"""Compiled programs kept on disk for the next process.

Place in the pipeline: `program` reads and writes them here, through `keeping`.

Loading a program runs its code, so the folder must belong to the user (mode 0700, no link) or it is not used; every
operation uses the descriptor of the folder that was checked.  A file is written under another name and renamed, so
several processes may read and write at once.  Its first 32 bytes are the SHA-256 of the others; a damaged file is
deleted.  When the files exceed the limit, the least recently used ones are deleted.
"""

import hashlib
import os
import secrets
import stat
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

LIMIT = 2**30  # bytes of all files
ENDING, UNFINISHED = ".program", ".part"
PATIENCE = 3600.0  # s after which a file that nobody finished is deleted
OFF = "RFEM_JAX_NO_CACHE"


def user_cache_folder() -> Path:
    """The platform's folder for files that may be deleted at any time, `.../rfem_jax`."""
    if sys.platform == "win32":
        base = os.environ.get("LOCALAPPDATA") or Path.home() / "AppData" / "Local"
    elif sys.platform == "darwin":
        base = Path.home() / "Library" / "Caches"
    else:
        base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "rfem_jax"


class Folder:
    """The folder `path` of kept programs; made if it is missing.

    **Arguments:** `limit`: of the size of all files [bytes]; `ending`: of their names.

    **Raises:** `UnsafeFolder` if another user could write there, OSError if it cannot be used.
    """

    def __init__(self, path: str | os.PathLike, limit: int = LIMIT, ending: str = ENDING):
        self.path, self.limit, self.ending = Path(path), limit, ending
        self.path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        with suppress(FileExistsError):
            self.path.mkdir(mode=0o700)
        with self._opened():
            pass

    def read(self, key: str) -> bytes | None:
        """What was written under a key (hexadecimal), or None; marks it as used."""
        with self._opened() as folder:
            content = _content(key + self.ending, folder)
            if content is None:
                return None
            if hashlib.sha256(content[32:]).digest() != content[:32]:
                with suppress(FileNotFoundError):
                    os.unlink(key + self.ending, dir_fd=folder)
                return None
            with suppress(OSError):
                os.utime(key + self.ending, dir_fd=folder)
            return content[32:]

    def write(self, key: str, content: bytes) -> None:
        """Keep `content` under a key, and delete older files while all are larger than the limit."""
        with self._opened() as folder:
            name = f"{key}.{secrets.token_hex(8)}{UNFINISHED}"
            new = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW
            try:
                with open(os.open(name, new, 0o600, dir_fd=folder), "wb") as file:
                    file.write(hashlib.sha256(content).digest() + content)
                os.replace(name, key + self.ending, src_dir_fd=folder, dst_dir_fd=folder)
            except BaseException:
                with suppress(FileNotFoundError):
                    os.unlink(name, dir_fd=folder)
                raise
            self._evict(folder, key + self.ending)

    def delete(self, key: str) -> None:
        """Delete what was kept under a key."""
        with self._opened() as folder, suppress(FileNotFoundError):
            os.unlink(key + self.ending, dir_fd=folder)

    def trim(self) -> None:
        """Delete the files that were used least recently, while all are larger than the limit."""
        with self._opened() as folder:
            self._evict(folder)

    def require_parent(self) -> None:
        """Raise UnsafeFolder if another user could put another folder in this one's place: for a library that opens
        its files by their paths."""
        found = os.stat(self.path.parent)
        if found.st_uid not in (os.geteuid(), 0) or (found.st_mode & 0o022 and not found.st_mode & stat.S_ISVTX):
            raise UnsafeFolder(f"{self.path.parent} is open to others; set its mode to 0700")

    @contextmanager
    def _opened(self) -> Iterator[int]:
        """Descriptor of the folder after the checks."""
        try:
            folder = os.open(self.path, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
        except NotADirectoryError:
            raise UnsafeFolder(f"{self.path} is a link or no folder; delete it") from None
        try:
            found = os.fstat(folder)
            if found.st_uid != os.geteuid():
                raise UnsafeFolder(f"{self.path} belongs to somebody else; delete it")
            if stat.S_IMODE(found.st_mode) & 0o077:
                raise UnsafeFolder(f"{self.path} is open to others; set its mode to 0700")
            yield folder
        finally:
            os.close(folder)

    def _evict(self, folder: int, newest: str = "") -> None:
        files = []
        for entry in os.scandir(folder):
            with suppress(FileNotFoundError):
                found = os.stat(entry.name, dir_fd=folder, follow_symlinks=False)
                age = time.time() - found.st_mtime
                if entry.name.endswith(UNFINISHED) and age > PATIENCE:
                    os.unlink(entry.name, dir_fd=folder)
                elif entry.name.endswith(self.ending) and stat.S_ISREG(found.st_mode):
                    used = max(found.st_mtime_ns, found.st_atime_ns)
                    files.append((entry.name == newest, used, entry.name, found.st_size))
        total = sum(size for *_, size in files)
        for is_newest, _, name, size in sorted(files):
            if total <= self.limit or is_newest:
                break
            with suppress(FileNotFoundError):
                os.unlink(name, dir_fd=folder)
            total -= size


class UnsafeFolder(Exception):
    """Another user could write to the folder of kept programs."""


def _content(name: str, folder: int) -> bytes | None:
    """Bytes of a regular file of the user, or None."""
    try:
        descriptor = os.open(name, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK, dir_fd=folder)
    except OSError:
        return None
    with open(descriptor, "rb") as file:
        found = os.fstat(descriptor)
        if not stat.S_ISREG(found.st_mode) or found.st_uid != os.geteuid():
            return None
        return file.read()
