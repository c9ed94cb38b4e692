"""The folder of a study: its manifest and its chunks of samples, safe against every interruption.

Place in the pipeline: whole_files -> **results_store** -> studies of samples, and the evaluations of all others
(`kept_evaluations`); knows nothing of problems and tolerances.

    FOLDER/manifest.json     identifies the study: if anything but the number of samples differs, it is another one;
                             beside that, a description of its problem, which is no part of the identity
    FOLDER/chunk-000042.npz  samples of one chunk: named arrays and their checksum

A process that dies at any instant leaves finished chunks and at most one ".tmp" file, which the next run removes; those
of processes that live stay, as several may have one folder. The checksum covers the study's fingerprint, the chunk's
index and every array, so that a damaged chunk, and a chunk of another study, are found when they are read.
"""

import hashlib
import json
import os
import warnings
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from rfem_jax.description.basics.errors import InputError
from rfem_jax.whole_files import UNFINISHED, Damaged, pack_arrays, remove_abandoned, unpack_arrays, write_whole

MANIFEST, DESCRIPTION = "manifest.json", "description"


class CorruptChunkWarning(UserWarning):
    """A chunk's file is damaged; its samples are computed again."""


class ChunkWriteError(OSError):
    """A chunk could not be written (a full disk, most often); finished chunks are kept."""


class StudyFolderError(InputError):
    """A folder that cannot hold this study: `finding` is the reason, `remedy` the way to correct it.

    The sentence names the library's argument; the command line words its own.
    """

    def __init__(self, finding: str, remedy: str):
        self.finding, self.remedy = finding, remedy
        super().__init__(f"Argument `resume` must be a new folder or one of this study, but {finding}; {remedy}.")


class ResultsStore:
    """The chunks of one study in `folder`.

    Args: folder, path (made if missing); study, a JSON-able dict that identifies the study; counts {name: number},
        numbers that may grow from one run to the next, such as that of the samples: the manifest keeps the largest;
        description {name: text}, kept for `require_study`.
    Raises: StudyFolderError when the folder belongs to another study (with the differences) or
        holds other files; ChunkWriteError when the folder cannot be written.
    """

    def __init__(
        self,
        folder: str | Path,
        study: dict[str, Any],
        counts: dict[str, int] | None = None,
        description: Mapping[str, str] | None = None,
    ):
        self.folder = Path(folder)
        text = json.dumps(study, indent=2, sort_keys=True)
        self.fingerprint = hashlib.sha256(text.encode()).hexdigest()
        self._described = {} if description is None else {DESCRIPTION: dict(description)}
        _require_no_file(self.folder)
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            self._write_manifest(json.loads(text), counts or {})
        except OSError as error:
            raise ChunkWriteError(
                error.errno,
                f"The folder of the study cannot be used ({error.strerror}); free space or choose another folder",
                str(self.folder),
            ) from error

    def _write_manifest(self, study: dict[str, Any], counts: dict[str, int]) -> None:
        """Write the manifest unless it is there already. Raises StudyFolderError."""
        found = _read_manifest(self.folder)
        if found is not None:
            _require_same(self.folder, found, study, {*counts, DESCRIPTION})
            past = {name: found[name] for name in counts if isinstance(found.get(name), int)}
            counts = {name: max(number, past.get(name, 0)) for name, number in counts.items()}
        manifest = study | counts | self._described
        if found != manifest:
            write_whole(self.folder / MANIFEST, json.dumps(manifest, indent=2, sort_keys=True).encode())

    def path(self, index: int) -> Path:
        """The file of chunk `index`."""
        return self.folder / f"chunk-{index:06d}.npz"

    def write(self, index: int, arrays: dict[str, np.ndarray], of: str = "") -> None:
        """Store the arrays {name: NumPy array} of a chunk; `of`: what else must be the same where they are read. Raises
        ChunkWriteError."""
        try:
            remove_abandoned(self.path(index))
            write_whole(self.path(index), pack_arrays(arrays, self._owner(index, of)))
        except OSError as error:
            raise ChunkWriteError(
                error.errno,
                f"Chunk {index} could not be written ({error.strerror}); {count_chunks(self.folder)} finished chunks "
                "are kept: free space and start the same study again to continue",
                str(self.folder),
            ) from error

    def read(self, index: int, warn: bool = True, of: str = "") -> dict[str, np.ndarray] | None:
        """The arrays of a finished chunk, None where there is none.

        A damaged chunk, and one that is of something else, counts as none, with a CorruptChunkWarning (unless `warn` is
        False).
        """
        try:
            return unpack_arrays(self.path(index).read_bytes(), self._owner(index, of))
        except (Damaged, OSError) as error:
            if warn and not isinstance(error, FileNotFoundError):
                warnings.warn(
                    f"Chunk {index} in `{self.folder}` is damaged (its checksum does not fit); "
                    "its samples are computed again.",
                    CorruptChunkWarning,
                    stacklevel=2,
                )
        return None

    def _owner(self, index: int, of: str) -> str:
        return f"{self.fingerprint} {index} {of}"


def count_chunks(folder: str | Path) -> int:
    """Number of finished chunks in a folder, 0 where there is none."""
    return len(list(Path(folder).glob("chunk-*.npz")))


def require_study(folder: str | Path, study: dict[str, Any], description: Mapping[str, str] | None = None) -> None:
    """See that a folder can hold a study of which a part of its identity is known, without making or writing anything.

    Args: folder, path; study, some of the entries that identify the study; description {name: text}, compared where
        the folder has one.
    Raises: StudyFolderError as `ResultsStore`, and for a folder that cannot be written.
    """
    folder = Path(folder)
    _require_no_file(folder)
    if not folder.exists():
        return
    if not os.access(folder, os.R_OK | os.W_OK | os.X_OK):
        raise StudyFolderError(f"`{folder}` cannot be read and written", "name a new folder, or change its permissions")
    found = _read_manifest(folder)
    if found is None:
        return
    described = found.get(DESCRIPTION)
    if isinstance(described, dict):
        found, study = found | described, study | dict(description or {})
    _require_same(folder, found, study, found.keys() - study.keys())


def _require_no_file(folder: Path) -> None:
    if folder.exists() and not folder.is_dir():
        raise StudyFolderError(f"`{folder}` is a file", "name a new folder")


def _read_manifest(folder: Path) -> dict[str, Any] | None:
    """The manifest in the folder, None where there is none. Raises StudyFolderError."""
    try:
        found = json.loads((folder / MANIFEST).read_text(encoding="utf-8"))
    except FileNotFoundError:
        others = [p.name for p in folder.iterdir() if not p.name.endswith(UNFINISHED)]
        if others and not (folder / MANIFEST).exists():
            raise StudyFolderError(
                f"`{folder}` holds `{sorted(others)[0]}` and no manifest of a study",
                "name a new folder",
            ) from None
        return None
    except ValueError:
        raise StudyFolderError(f"`{folder / MANIFEST}` cannot be read", "name a new folder") from None
    return found if isinstance(found, dict) else {}


def _require_same(folder: Path, found: dict[str, Any], study: dict[str, Any], ignored: Collection[str]) -> None:
    """Raise StudyFolderError where the entries `found` in a folder differ from those of the study."""
    differing = [
        f"{key} (there {_brief(found.get(key))}, here {_brief(study.get(key))})"
        for key in sorted({*found, *study} - {*ignored})
        if found.get(key) != study.get(key)
    ]
    if differing:
        raise StudyFolderError(
            f"`{folder}` holds another study, which differs in {'; '.join(differing)}",
            "name a new folder, or specify the same study",
        )


def _brief(value: Any) -> str:
    """A manifest entry short enough for a message."""
    text = json.dumps(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
