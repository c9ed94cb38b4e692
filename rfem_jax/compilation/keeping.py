"""Whether programs are kept, and where.

Place in the pipeline: `program` asks; the command and the user choose.

They are kept in the user's cache folder, unless the environment variable RFEM_JAX_NO_CACHE is set or the
command has the option `--no-cache`; `keep_programs` chooses another folder, or none.  What cannot be kept is
compiled as ever.
"""

import os
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from rfem_jax.compilation.cache import OFF, Folder, UnsafeFolder
from rfem_jax.compilation.options import user_cache_folder

DEFAULT = "the user's cache folder"


@dataclass
class Statistics:
    """Of this process: programs traced, loaded from disk, written to disk, and why others were not kept."""

    traced: int = 0
    loaded: int = 0
    written: int = 0
    unkept: dict[str, str] = field(default_factory=dict)


class _Choice:
    def __init__(self):
        self.asked, self.folder, self.reason = DEFAULT, None, ""
        self.opened = False


statistics = Statistics()
_choice = _Choice()
_results: list[Path] = []


def keep_programs(folder) -> None:
    """Keep compiled programs in `folder`, which must be the user's own (mode 0700); None keeps none."""
    _choice.__init__()
    _choice.asked = folder


def keep_apart_from(folder) -> None:
    """Keep no programs inside of a folder for results, which is passed on to others."""
    _results.append(Path(folder))


def state() -> dict:
    """For `results.json`: whether kept programs were used, and what became of the options of XLA."""
    from rfem_jax.compilation import options

    compilation = options.settle_quietly()
    on = wanted()
    return {
        "xla_options": "set" if compilation.set else f"not set: {compilation.reason}",
        "kept_programs": "used" if on else f"not used: {_choice.reason}",
        "programs_loaded": statistics.loaded,
        "programs_traced": statistics.traced,
    }


def wanted() -> bool:
    """Whether programs are kept; opens the folder at the first question."""
    if not _choice.opened:
        _choice.opened = True
        _open()
    return _choice.folder is not None


def read(key: str) -> bytes | None:
    with suppress(OSError, UnsafeFolder):
        return _choice.folder.read(key)


def write(key: str, content: bytes) -> None:
    with suppress(OSError, UnsafeFolder):  # a full disk costs the next process its time, no more
        _choice.folder.write(key, content)
        statistics.written += 1


def forget(key: str) -> None:
    with suppress(OSError, UnsafeFolder):
        _choice.folder.delete(key)


def note_unkept(name: str, reason: str) -> None:
    statistics.unkept[name] = reason.splitlines()[0] if reason else ""


def _open() -> None:
    if _choice.asked is None:
        _choice.reason = "switched off"
    elif _choice.asked is DEFAULT and os.environ.get(OFF):
        _choice.reason = f"{OFF} is set"
    elif not hasattr(os, "geteuid"):
        _choice.reason = "this system does not tell whose a folder is"
    else:
        try:
            path = user_cache_folder() / "programs" if _choice.asked is DEFAULT else Path(_choice.asked)
            _require_apart(path)
            _choice.folder = Folder(path)
        except (OSError, RuntimeError, UnsafeFolder) as problem:
            _choice.reason = str(problem)


def _require_apart(path: Path) -> None:
    """Raises UnsafeFolder where JAX's cache, which others may share, or results are or contain the folder."""
    import jax

    for results in _results:
        if path.resolve().is_relative_to(results.resolve()):
            raise UnsafeFolder(f"{path} is in the folder for results")

    shared = jax.config.jax_compilation_cache_dir
    if shared is not None and path.resolve().is_relative_to(Path(shared).resolve()):
        raise UnsafeFolder(f"{path} is in JAX_COMPILATION_CACHE_DIR, which others may write")
