"""Running many samples: lanes, devices, processes, chunks.

Place in the pipeline: evaluation -> **execution** -> studies of samples (`sampling.sampled_studies`).

    launch   `lanes` samples on each local device: one compiled program, whatever the batch
    chunk    `batch` samples, the unit that is stored; chunks are launched together as far as they fit, and the last
             launch is filled up
    process  chunk c belongs to process c modulo their number (`sharing`)

Every launch has the same shape and a device sees only its own lanes (`shard_map`: no loop waits for another device).
The numbers of a sample therefore do not depend on batch, devices or processes, to the last bit. Processes share
nothing but the folder of chunks: each computes its own chunks with local programs and then waits for the files of the
others, as long as these give signs of life.

Several CPU devices need spare threads. The program of a device occupies a thread of XLA's pool, and its batched matrix
factorisations wait for others of the same pool; with as many threads as devices (XLA's own choice) all of them may
wait for ever. A study that could is refused (`require_threads`). It is not moved to one device instead: the user asked
for speed, and an error with a remedy of one line is better than a long run that is silently slower.

Symbols: N samples, d coordinates, m metrics; points (N, d) of the unit cube, errors (N, d) [rad or m], values (N, m)
[units of the metrics], status (N,) int32.
Source: none; the layout is this library's own.
"""

import time
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from rfem_jax.compilation.program import Program
from rfem_jax.description.basics.errors import InputError
from rfem_jax.tolerancing.problems import sharing
from rfem_jax.tolerancing.problems.evaluation import run_in_chunks
from rfem_jax.tolerancing.problems.named_tolerances import Tolerances
from rfem_jax.tolerancing.problems.problem import ToleranceProblem, values_form
from rfem_jax.tolerancing.problems.results_store import ResultsStore
from rfem_jax.tolerancing.problems.sample_values import (
    Device,
    divided,
    evaluate_lanes,
    mesh_of,
    too_few_threads,
)
from rfem_jax.tolerancing.progress import ProgressBar, ProgressOption
from rfem_jax.usable_cores import usable_cores

POLL = 0.05  # s
PATIENCE = 3600.0  # s without a new chunk of another process

Arrays = dict[str, np.ndarray]  # "errors", "values", "status" of some samples, and checks of their problem


def require_threads(devices: Sequence[Device]) -> None:
    """Refuse several CPU `devices` that share too few threads. Raises InputError."""
    threads, count = too_few_threads(devices), len(devices)
    if threads is not None:
        raise InputError(
            f"Argument `jax_num_cpu_devices` must leave two threads for each device, but {count} "
            f"CPU devices share {threads}, and samples could wait for each other without end; put "
            f'os.environ["NPROC"] = "{2 * max(count, usable_cores())}" before the first array, or use one '
            "device."
        )


@Program
def _draw(tolerances, points):
    """Errors (n, d) of points (n, d), columns in the order of the tolerances' names; traced."""

    def of_one(point):
        errors = tolerances.errors(point)
        return jnp.stack([errors[name] for name in tolerances.names])

    return jax.vmap(of_one)(points)


def evaluate(problem: ToleranceProblem, tolerances: Tolerances, points: Float[np.ndarray, "N d"], lanes: int) -> Arrays:
    """Evaluate points (N, d) on all local devices, launch by launch.

    The program of the values is that of `evaluate_points`, and serves distributions of any kind.
    Returns: {"errors": (N, d), "values": (N, m), "status": (N,)}, and the problem's checks (N,) by their names.
    """
    mesh, (form, metrics, checks) = mesh_of(jax.local_devices()), values_form(problem)
    (errors,) = run_in_chunks(lambda block: (_draw(tolerances, block),), lanes, points, of=None)

    def launch(rows):
        return evaluate_lanes(form, tolerances.names, {}, divided(mesh, rows), mesh)

    values, status = run_in_chunks(launch, lanes * mesh.size, errors, of=None)
    watched = {name: values[:, row] for name, row in checks.items()}
    return {"errors": errors, "values": values[:, metrics], "status": status, **watched}


def run_chunks(
    problem: ToleranceProblem,
    tolerances: Tolerances,
    points: Float[np.ndarray, "N d"],
    *,
    batch: int,
    lanes: int,
    store: ResultsStore | None,
    progress: ProgressOption,
) -> tuple[Arrays, int]:
    """Evaluate all points chunk by chunk; samples that `store` holds are not computed again.

    A chunk that was the last one of a smaller study is completed: its samples stay, those after them are added.
    Returns: the arrays of `evaluate` and the number of chunks that this process wrote.
    Raises: InputError when several processes have no common folder and when several CPU devices lack threads;
        ChunkWriteError; TimeoutError.
    """
    require_threads(jax.local_devices())
    process, processes = sharing.process_index(), sharing.process_count()
    if processes > 1 and store is None:
        raise InputError(
            f"Argument `resume` must name a folder that all {processes} processes share, but it is "
            "None; they hand their samples over in it."
        )
    parts = [points[first : first + batch] for first in range(0, len(points), batch)]
    mine = range(process, len(parts), processes)
    with sharing.SignsOfLife(None if store is None else store.folder) as signs:
        chunks, computed = _compute_own(problem, tolerances, parts, mine, batch, lanes, store, progress)
        if store is not None:
            chunks |= _wait_for(store, {c: len(part) for c, part in enumerate(parts) if c not in chunks}, signs)
    return {name: np.concatenate([chunks[c][name] for c in range(len(parts))]) for name in chunks[0]}, computed


def _compute_own(
    problem: ToleranceProblem,
    tolerances: Tolerances,
    parts: list[np.ndarray],
    mine: range,
    batch: int,
    lanes: int,
    store: ResultsStore | None,
    progress: ProgressOption,
) -> tuple[dict[int, Arrays], int]:
    """The chunks {index: arrays} of this process, and the number of those that were computed."""
    chunks = {} if store is None else _read(store, {c: len(parts[c]) for c in mine})
    done = sum(_rows(arrays) for arrays in chunks.values())
    computed = 0
    shown = progress if mine.start == 0 else False
    with ProgressBar(shown, sum(len(parts[c]) for c in mine), done) as bar:
        missing = [c for c in mine if c not in chunks or _rows(chunks[c]) < len(parts[c])]
        together = max(1, lanes * jax.local_device_count() // batch)
        for some in (missing[i : i + together] for i in range(0, len(missing), together)):
            rest = [parts[c][_rows(chunks[c]) if c in chunks else 0 :] for c in some]
            found = evaluate(problem, tolerances, np.concatenate(rest), lanes)
            first = 0
            for c, points in zip(some, rest, strict=True):
                added = {name: array[first : first + len(points)] for name, array in found.items()}
                if c in chunks:
                    added = {name: np.concatenate([chunks[c][name], array]) for name, array in added.items()}
                chunks[c] = added
                if store is not None:
                    store.write(c, added)
                first, computed = first + len(points), computed + 1
                bar.advance(len(points))
    return chunks, computed


def _rows(arrays: Arrays) -> int:
    return len(arrays["status"])


def _read(store: ResultsStore, sizes: dict[int, int], warn: bool = True) -> dict[int, Arrays]:
    """The stored chunks {index: arrays}, at most `sizes` {index: samples} of each."""
    found = {}
    for c, size in sizes.items():
        arrays = store.read(c, warn)
        if arrays is not None:
            found[c] = {name: array[:size] for name, array in arrays.items()}
    return found


def _wait_for(store: ResultsStore, missing: dict[int, int], signs: sharing.SignsOfLife) -> dict[int, Arrays]:
    """Chunks {index: arrays} of other processes, `missing` {index: samples}, from their files. Raises TimeoutError."""
    processes = sharing.process_count()
    chunks, last = {}, time.monotonic()
    while len(chunks) < len(missing):
        # A damaged file is replaced by its owner, who warns; a chunk of too few samples is completed by its owner.
        found = _read(store, {c: size for c, size in missing.items() if c not in chunks}, warn=False)
        found = {c: arrays for c, arrays in found.items() if _rows(arrays) == missing[c]}
        if found:
            chunks, last = chunks | found, time.monotonic()
        owners = {c % processes for c in missing if c not in chunks}
        stopped = [process for process in signs.stopped() if process in owners]
        if stopped:
            raise TimeoutError(
                f"Process {stopped[0]} has stopped: it gave no sign of life for {sharing.SILENCE:.0f} s in "
                f"`{store.folder}`; {len(missing) - len(chunks)} chunks are missing. Find out why, and start again, "
                "with fewer processes if need be: finished chunks are kept."
            )
        if time.monotonic() - last > PATIENCE:
            raise TimeoutError(
                f"No new chunk of the other processes for {PATIENCE:.0f} s in `{store.folder}`; "
                f"{len(missing) - len(chunks)} are missing. Find out why they stopped and start again: "
                "finished chunks are kept."
            )
        if len(chunks) < len(missing):
            time.sleep(POLL)
    return chunks
