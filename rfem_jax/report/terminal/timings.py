"""How long a task will take: from what the same task has taken on this machine before.

Place in the pipeline: the subcommands say it before a task begins, and record what it took; the progress line tells
what remains once a part of the work is done.

A file in the user's cache folder holds seconds by a digest of what the task depends on (mechanism, drive, method,
duration, what is asked, processors), with and without compilation, and the number of samples. It is written and read
only where programs are kept, too. Whether programs are kept is known by the digest of all sources, versions and options
with which the task ran last. Nothing is known of a study with a function of the user.
"""

import json
import os
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax

from rfem_jax.compilation import keeping, keys
from rfem_jax.compilation.cache import user_cache_folder
from rfem_jax.description.study_file.study import Study
from rfem_jax.tolerancing.problems.sharing import process_count
from rfem_jax.whole_files import write_text

MOST = 500  # entries; the oldest go
UNKNOWN = (
    "how long is not known before a part is done; what was not compiled on this machine before takes from half a "
    "minute to some minutes more"
)


def timings_file() -> Path | None:
    """The file, None where nothing is kept."""
    return user_cache_folder() / "timings.json" if keeping.wanted() else None


def key_of(study: Study, task: str) -> str | None:
    """Digest of what a task of the study ("" for its cases) depends on, but the number of samples; None where that is
    not known."""
    asked = study.tasks.asked[task] if task else study.cases
    if hasattr(asked, "n") and not isinstance(asked, tuple):
        asked = replace(asked, n=64)
    method = study.method if study.asked_method is None else study.asked_method
    tolerances = study.tasks.tolerances if task else None
    try:
        return keys.digest_value(
            (task, asked, tolerances, study.mechanism, study.drive, study.duration, method, study.save_every)
            + (() if study.statics is None else (study.statics,))
            + (jax.local_device_count(), process_count(), os.cpu_count() or 1)
        )
    except keys.NotDigestible:
        return None


def samples_of(study: Study, task: str) -> int:
    """Number with which the time of a task grows: its samples, 1 where it has none."""
    return int(getattr(study.tasks.asked[task], "n", 1)) if task else 1


def estimate(key: str | None, samples: int) -> tuple[float, str] | None:
    """Seconds that a task will take, and the reason in words; None where nothing is known."""
    found = _read().get(key or "")
    if found is None:
        return None
    compiled = found.get("surroundings") == _surroundings()
    again, first = found.get("again"), found.get("first")
    if compiled and again is not None:
        return again * samples, "as last time on this machine"
    if first is not None:
        scaled = first * max(1.0, samples / max(found.get("samples", 1), 1))
        words = "at most, as last time, which included compilation" if compiled else "as when it was compiled last"
        return scaled, words
    return (again or 0.0) * samples, "as last time on this machine, and compilation, as the program has changed since"


def estimate_text(what: str, key: str | None, samples: int) -> str:
    """One sentence to say before a task begins; `what` is to be done."""
    known = estimate(key, samples)
    if known is None:
        return f"{what}; {UNKNOWN}."
    seconds, reason = known
    return f"{what}; about {duration_text(seconds)} {reason}; other work on this machine makes it longer."


def record(key: str | None, seconds: float, samples: int, compiled: bool) -> None:
    """Keep what a task took; `compiled`: whether programs were compiled within it."""
    path = timings_file()
    if path is None or key is None:
        return
    entries = _read()
    entry = dict(entries.pop(key, {}))
    if compiled:
        entry |= {"first": seconds, "samples": samples}
    else:
        entry["again"] = seconds / samples
    entries[key] = entry | {"surroundings": _surroundings()}
    kept = dict(list(entries.items())[-MOST:])
    try:
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        write_text(path, json.dumps(kept, indent=1))
    except OSError:
        return  # only an estimate is lost


def duration_text(seconds: float) -> str:
    """A time in s, min or h, as exact as an estimate is."""
    if seconds < 90.0:
        return f"{max(seconds, 1.0):.0f} s"
    return f"{seconds / 60.0:.0f} min" if seconds < 5400.0 else f"{seconds / 3600.0:.1f} h"


def _surroundings() -> str:
    return keys.digest_value(repr(keys.surroundings()))


def _read() -> dict[str, Mapping[str, Any]]:
    path = timings_file()
    if path is None:
        return {}
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
        good = all(isinstance(x, (int, float)) for one in found.values() for k, x in one.items() if k != "surroundings")
    except (OSError, ValueError, AttributeError):
        return {}
    return found if good else {}
