"""Where an interrupted simulation of cases stopped, so that the same one goes on from there.

Place in the pipeline: `cases.run_cases` writes and reads it; nothing else does.

One file holds the integrator's state before a piece of time and what the pieces before it have given. Its checksum
covers a digest of everything that they depend on (mechanism, drive, method, errors, sources, versions): a file of
anything else, or a damaged one, is not used. It is written when the simulation is interrupted, and once a minute. The
numbers that a continued simulation gives are those of one that was not interrupted, to the last bit.
"""

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rfem_jax.compilation import keys
from rfem_jax.whole_files import Damaged, pack_arrays, unpack_arrays, write_whole

EVERY = 60.0  # s

Parts = list[list[np.ndarray]]  # leaves of what each piece has given


class Unfinished:
    """The file of one simulation.

    Args: path, of the file (None: nothing is kept); content, everything that the simulation depends on. Where this has
        a function of the user, whose content is not known, nothing is kept.
    """

    def __init__(self, path: Path | None, content: Any):
        self.path, self.digest = path, ""
        if path is not None:
            try:
                self.digest = keys.digest_content(content)
            except keys.NotDigestible:
                self.path = None
        self._reached: tuple[int, Any, Parts] | None = None
        self._written, self._time = 0, time.monotonic()

    def restore(self, carry: Any) -> tuple[int, Any, Parts]:
        """Number of the piece to go on with, the state before it (at first `carry`), and what was given before."""
        start = 0, carry, []
        if self.path is None or not self.path.exists():
            return start
        leaves, tree = jax.tree.flatten(carry)
        try:
            stored = unpack_arrays(self.path.read_bytes(), self.digest)
        except (Damaged, OSError):
            return start
        number, width = (int(n) for n in stored["counts"])
        state = [stored[f"carry_{i}"] for i in range(len(leaves))]
        parts = [[stored[f"part_{n}_{i}"] for i in range(width)] for n in range(number)]
        state = [jnp.asarray(one, jnp.asarray(leaf).dtype) for one, leaf in zip(state, leaves, strict=True)]
        self._written = number
        return number, jax.tree.unflatten(tree, state), parts

    def reach(self, number: int, carry: Any, parts: Sequence[list[np.ndarray]]) -> None:
        """`number` pieces are done; `carry` is the state after them."""
        self._reached = number, carry, list(parts)
        if time.monotonic() - self._time > EVERY:
            self.write()

    def write(self) -> None:
        """Write what was reached last."""
        if self.path is None or self._reached is None or self._reached[0] == self._written:
            return
        number, carry, parts = self._reached
        arrays = {"counts": np.array([number, len(parts[0])])}
        arrays |= {f"carry_{i}": np.asarray(leaf) for i, leaf in enumerate(jax.tree.leaves(carry))}
        arrays |= {f"part_{n}_{i}": leaf for n, part in enumerate(parts) for i, leaf in enumerate(part)}
        write_whole(self.path, pack_arrays(arrays, self.digest))
        self._written, self._time = number, time.monotonic()

    def remove(self) -> None:
        """The simulation is done."""
        if self.path is not None:
            self.path.unlink(missing_ok=True)
