"""Evaluations of an interrupted study, so that the same study goes on from there.

Place in the pipeline: `evaluation` and `quadratic_model` ask before they run a program; the reports on tasks open the
folder (`kept_in`). Without one nothing is kept, and nothing is asked.

A study is deterministic: it evaluates the same points in the same order each time. Its evaluations are numbered, and
each is stored with a digest of what it was of (the problem with the sources, names, points, kind of derivative). The
study that is started again reads them in that order, and computes from the first one on that is not there or is of
something else; its result is the same, to the last bit. Chunks of a Monte Carlo study have a folder of their own.

A problem with a function of the user, whose content is not known, is computed again.
"""

import errno
import hashlib
import re
import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rfem_jax.compilation import keys
from rfem_jax.tolerancing.problems.problem import ToleranceProblem
from rfem_jax.tolerancing.problems.results_store import ChunkWriteError, ResultsStore

STUDY = {"kept": "evaluations"}

Results = Sequence[Any]  # arrays, None in the place of one


class KeptEvaluations:
    """The numbered evaluations in a folder, which is made when the first one is written."""

    def __init__(self, folder: Path):
        self.folder = folder
        self.count = self.read = 0
        self._store: ResultsStore | None = ResultsStore(folder, STUDY) if folder.exists() else None
        # Problems are large: each is digested once. They are held, as an `id` may be used again.
        self._problems: dict[int, tuple[ToleranceProblem, str | None]] = {}

    def results(self, problem: ToleranceProblem, inputs: Any, compute: Callable[[], Results]) -> Results:
        """The stored results of the evaluation whose turn it is, or those of `compute`, which are stored."""
        digest = self._digest(problem)
        if digest is None:
            return compute()
        number, self.count = self.count, self.count + 1
        known = hashlib.sha256(repr((digest, keys.digest_value(inputs))).encode()).hexdigest()
        found = None if self._store is None else self._store.read(number, warn=False, of=known)
        if found is not None:
            self.read += 1
            return [found.get(f"result_{i}") for i in range(int(found["length"]))]
        results = [None if one is None else np.asarray(one) for one in compute()]
        arrays = {f"result_{i}": one for i, one in enumerate(results) if one is not None}
        arrays["length"] = np.array(len(results))
        if self._store is None:
            self._store = ResultsStore(self.folder, STUDY)
        try:
            self._store.write(number, arrays, known)
        except ChunkWriteError as error:
            if error.errno != errno.ENOENT:
                raise
            # Another process did the same, was done, and removed the folder.
            self._store = ResultsStore(self.folder, STUDY)
            self._store.write(number, arrays, known)
        return results

    def _digest(self, problem: ToleranceProblem) -> str | None:
        if id(problem) not in self._problems:
            self._problems[id(problem)] = problem, known_content(problem)
        return self._problems[id(problem)][1]


def known_content(problem: ToleranceProblem) -> str | None:
    """SHA-256 of a problem: of its own `fingerprint()` if it has one; else of all its numbers, its structure and the
    sources of this package. None where it contains a function of the user, whose content is not known."""
    own = getattr(problem, "fingerprint", None)
    if callable(own):
        return hashlib.sha256(str(own()).encode()).hexdigest()
    try:
        return keys.digest_content(problem)
    except keys.NotDigestible:
        return None


def fingerprint_problem(problem: ToleranceProblem) -> str:
    """`known_content`, and SHA-256 of the program of a problem that has none.

    The program (StableHLO of one sample, with all constants) changes with every number and every operation of the
    model, and not from run to run; so do numbers and sources, which need no tracing.
    """
    known = known_content(problem)
    if known is not None:
        return known
    scalar = jax.ShapeDtypeStruct((), jnp.float64)
    text = jax.jit(lambda e: problem(e)).lower(dict.fromkeys(problem.error_names, scalar)).as_text()
    text = re.sub(r"index = \d+ : ui64", "", text)  # callbacks are counted per Python process
    return hashlib.sha256(text.encode()).hexdigest()


_open: list[KeptEvaluations] = []


@contextmanager
def kept_in(folder: str | Path) -> Iterator[KeptEvaluations]:
    """In which evaluations are kept in `folder`, and read from there. It is removed at the end, but stays where the
    block is interrupted (KeyboardInterrupt) or a file cannot be written (OSError)."""
    kept = KeptEvaluations(Path(folder))
    _open.append(kept)
    try:
        yield kept
    except (KeyboardInterrupt, OSError):
        raise
    except BaseException:
        shutil.rmtree(kept.folder, ignore_errors=True)
        raise
    else:
        shutil.rmtree(kept.folder, ignore_errors=True)
    finally:
        _open.remove(kept)


def remembered(problem: ToleranceProblem, inputs: Any, compute: Callable[[], Results]) -> Results:
    """What `compute` gives, or what is kept of it.

    Args: problem that is evaluated; inputs, all else that the results depend on: nested tuples of names, numbers and
        arrays; compute, returns arrays, or None in the place of one.
    """
    if not _open:
        return compute()
    inputs = jax.tree.map(lambda one: np.asarray(one) if isinstance(one, jax.Array) else one, inputs)
    return _open[-1].results(problem, inputs, compute)
