"""Studies of many samples: what identifies them and their folder, and how they are run.

Place in the pipeline: problem, tolerances, points -> **sampled_studies** -> the Monte Carlo study and sweeps, by
`execution` and `results_store`.

Most of what identifies a study is known before its problem is built, so that a folder of another study is refused
before any work is done for it (`require_folder`).

Symbols: N samples, d errors, m metrics; points (N, d) of the unit cube, errors (N, d) [rad or m], values (N, m) [units
of the metrics], status (N,) int32 (0 good).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from rfem_jax.description.tasks.settings import whole_number
from rfem_jax.tolerancing.problems.execution import Arrays, run_chunks
from rfem_jax.tolerancing.problems.kept_evaluations import fingerprint_problem
from rfem_jax.tolerancing.problems.named_tolerances import Tolerances
from rfem_jax.tolerancing.problems.problem import ToleranceProblem
from rfem_jax.tolerancing.problems.results_store import ResultsStore, require_study
from rfem_jax.tolerancing.problems.sample_values import default_lanes
from rfem_jax.tolerancing.progress import ProgressOption
from rfem_jax.tolerancing.sampling.sequences import RandomKey, key_words

FORMAT = 3  # of the content of a chunk, and of the order and drawing of points
NOT_FINITE = -1  # status of a sample of status 0 with a value that is not finite


@dataclass(frozen=True, eq=False)
class SampleStudy:
    """A study whose samples are drawn from tolerances at points of the unit cube; made by `sample_study`."""

    kind: str
    tolerances: Tolerances
    key: RandomKey
    batch: int
    lanes: int
    settings: dict[str, Any]

    def identity(self, metrics: Sequence[str]) -> dict[str, Any]:
        """Everything that distinguishes it from other studies but its problem, of which it has the names of the
        metrics: the manifest of its folder, apart from numbers that may grow."""
        return {
            "study": self.kind,
            "format": FORMAT,
            "metrics": list(metrics),
            "tolerances": _tolerance_table(self.tolerances),
            "key": key_words(self.key),
            "device": jax.default_backend(),
            "versions": {name: _version(name) for name in ("jax", "jaxlib", "numpy", "scipy", "rfem-jax")},
            "batch": self.batch,
            "lanes": self.lanes,
            **self.settings,
        }

    def require_folder(
        self, folder: str | Path, metrics: Sequence[str], description: Mapping[str, str] | None = None
    ) -> None:
        """See that the study can start or continue in `folder`, without its problem and without writing anything.

        Args: folder, `resume` of `run`; metrics, names of the problem's metrics, in its order; description, as of
            `run`.
        Raises: StudyFolderError for a folder of another study, one that holds other files, and one that cannot be
            written.
        """
        require_study(folder, self.identity(metrics), description)

    def run(
        self,
        problem: ToleranceProblem,
        points: Float[np.ndarray, "N d"],
        counts: dict[str, int],
        *,
        resume: str | Path | None,
        progress: ProgressOption,
        description: Mapping[str, str] | None,
    ) -> tuple[Arrays, int]:
        """Evaluate the problem at all points.

        Args: points (N, d) in the order of the tolerances' errors; counts {name: number} that may grow from run to run;
            resume, folder of chunks (None: nothing is kept); description, kept there.
        Returns: {"errors": (N, d), "values": (N, m), NaN where the sample failed, "status": (N,)}, and the problem's
            checks (N,) by their names; and the number of chunks that this process computed.
        Raises: as `run_chunks`; StudyFolderError.
        """
        store = None
        if resume is not None:
            whole = self.identity([metric.name for metric in problem.metrics])
            whole["problem"] = fingerprint_problem(problem)
            store = ResultsStore(resume, whole, counts, description)
        samples, computed = run_chunks(
            problem, self.tolerances, points, batch=self.batch, lanes=self.lanes, store=store, progress=progress
        )
        finite = np.all(np.isfinite(samples["values"]), axis=1)
        status = np.where((samples["status"] == 0) & ~finite, NOT_FINITE, samples["status"])
        values = np.where((status == 0)[:, None], samples["values"], np.nan)
        return samples | {"values": values, "status": status}, computed


def sample_study(
    kind: str, tolerances: Tolerances, key: RandomKey, *, batch: int, lanes: int | None, **settings: Any
) -> SampleStudy:
    """A study of samples.

    Args:
        kind: "monte_carlo" or "sweep".
        tolerances: of the errors that vary; all other errors are zero.
        key: JAX random key of the points.
        batch: samples per chunk, the unit that is stored.
        lanes: samples that each device computes at once; None: `default_lanes`.
        settings: what else the points depend on, as JSON has it.
    Raises: InputError for a batch and lanes that are no whole numbers from 1 on.
    """
    batch = whole_number(as_int(batch), "batch", 1)
    lanes = default_lanes() if lanes is None else whole_number(as_int(lanes), "lanes", 1)
    return SampleStudy(kind, tolerances, key, batch, lanes, settings)


def as_int(value: Any) -> Any:
    """A whole number of NumPy as one of Python; anything else as it is."""
    return int(value) if isinstance(value, np.integer) else value


def _version(package: str) -> str | None:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


def _tolerance_table(tolerances: Tolerances) -> dict[str, Any]:
    """Kind and numbers of every tolerance; JSON keeps every bit of a float."""
    single = [
        [name, type(tol).__name__, [float(leaf) for leaf in jax.tree.leaves(tol)]]
        for name, tol in ((name, tolerances.independent.get(name)) for name in tolerances.names)
        if tol is not None
    ]
    groups = [
        [list(group.names), np.asarray(group.covariance).tolist(), np.asarray(group.mean).tolist()]
        for group in tolerances.correlated
    ]
    zones = [[list(zone.names), np.asarray(zone.matrix).tolist(), list(zone.balls)] for zone in tolerances.zones]
    return {"independent": single, "correlated": groups} | ({"zones": zones} if zones else {})
