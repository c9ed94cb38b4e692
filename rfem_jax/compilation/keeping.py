"""Whether compiled programs are kept, and where.

Place in the pipeline: `program` asks; the command and the user choose.

Programs are kept in the user's cache folder, unless the environment variable RFEM_JAX_NO_CACHE is set or the command
has the option `--no-cache`; `keep_programs` chooses another folder, or none.  Programs that cannot be kept are
compiled in every process.
"""

import os
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from rfem_jax.compilation import cache
from rfem_jax.compilation.cache import OFF, Folder, UnsafeFolder, user_cache_folder
from rfem_jax.kernels import is_available, registry

DEFAULT = "the user's cache folder"


@dataclass
class Statistics:
    """Counts of this process: programs traced, loaded from disk and written to disk; `unkept`: the reason by name of
    those that could not be kept."""

    traced: int = 0
    loaded: int = 0
    written: int = 0
    unkept: dict[str, str] = field(default_factory=dict)


@dataclass
class _Choice:
    """The folder asked for, and the one that is used; None with a reason."""

    asked: str | os.PathLike | None = DEFAULT
    folder: Folder | None = None
    reason: str = ""
    opened: bool = False


statistics = Statistics()
_choice = _Choice()
_results: list[Path] = []


def keep_programs(folder: str | os.PathLike | None) -> None:
    """Keep compiled programs in `folder`, which must belong to the user (mode 0700); None keeps none."""
    global _choice
    _choice = _Choice(folder)


def keep_apart_from(folder: str | os.PathLike) -> None:
    """Do not keep programs inside of a folder for results, which may be given to other users."""
    _results.append(Path(folder))


def state() -> dict[str, str | int]:
    """For `results.json`: whether kernels have machine code, and whether kept programs were used."""
    on = wanted()
    return {
        "kernels": "machine code" if is_available() else "compiled by XLA: llvmlite is not installed",
        "kept_programs": "used" if on else f"not used: {_choice.reason}",
        "programs_loaded": statistics.loaded,
        "programs_traced": statistics.traced,
    }


def folder_for_jax() -> Path | None:
    """A folder for JAX's own cache, in which nobody else can write and which is not larger than the limit when a
    process begins; None where nothing is to be kept, or there is no such folder."""
    if os.environ.get(OFF):
        return None
    try:
        path = user_cache_folder() / "jax"
        if not hasattr(os, "geteuid"):
            path.mkdir(parents=True, exist_ok=True)
            return path
        folder = Folder(path, cache.LIMIT, ending="")
        folder.require_parent()
        folder.trim()
    except (OSError, RuntimeError, UnsafeFolder):  # no home, or none of the user's own: compiling again is all it costs
        return None
    return path


def wanted() -> bool:
    """Whether programs are kept; opens the folder at the first call."""
    if not _choice.opened:
        _choice.opened = True
        _open()
    return _choice.folder is not None


def read(key: str) -> bytes | None:
    """The program kept under a key, or None."""
    if _choice.folder is not None:
        with suppress(OSError, UnsafeFolder):
            return _choice.folder.read(key)
    return None


def write(key: str, content: bytes) -> bool:
    """Keep a program; returns whether that was done. Where the disk is full, say, the next process compiles it."""
    if _choice.folder is not None:
        with suppress(OSError, UnsafeFolder):
            _choice.folder.write(key, content)
            return True
    return False


def forget(key: str) -> None:
    """Delete the program kept under a key."""
    if _choice.folder is not None:
        with suppress(OSError, UnsafeFolder):
            _choice.folder.delete(key)


def note_unkept(name: str, reason: str) -> None:
    """Record why a program cannot be kept."""
    statistics.unkept[name] = reason.splitlines()[0] if reason else ""


def _open() -> None:
    if _choice.asked is None:
        _choice.reason = "switched off"
    elif _choice.asked is DEFAULT and os.environ.get(OFF):
        _choice.reason = f"{OFF} is set"
    elif not hasattr(os, "geteuid"):
        _choice.reason = "this system does not say who owns a folder"
    else:
        try:
            path = user_cache_folder() / "programs" if _choice.asked is DEFAULT else Path(_choice.asked)
            _require_apart(path)
            _choice.folder = Folder(path)
        except (OSError, RuntimeError, UnsafeFolder) as problem:
            _choice.reason = str(problem)


def _read_code(name: str) -> bytes | None:
    return read(name) if wanted() else None


def _write_code(name: str, code: bytes) -> bool:
    return wanted() and write(name, code)


registry.keep_with(_read_code, _write_code)


def _require_apart(path: Path) -> None:
    """Raises UnsafeFolder if the folder is inside of results or of JAX's cache, which users may share."""
    from rfem_jax.compilation import keys

    for results in _results:
        if path.resolve().is_relative_to(results.resolve()):
            raise UnsafeFolder(f"{path} is in the folder for results")

    shared = keys.read_setting("jax_compilation_cache_dir")
    if shared is not None and path.resolve().is_relative_to(Path(shared).resolve()):
        raise UnsafeFolder(f"{path} is in JAX_COMPILATION_CACHE_DIR, which others may write")
