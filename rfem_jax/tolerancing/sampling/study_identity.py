"""What identifies a Monte Carlo study: the content of its folder's manifest, apart from the numbers that may grow.

Place in the pipeline: problem, tolerances -> **study_identity** -> `results_store`.

Most of it is known before the problem is built, so that a folder of another study is refused before any work is done
for it (`require_folder`).
"""

from collections.abc import Mapping, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

import jax
import numpy as np

from rfem_jax.description.study_file.study import Study
from rfem_jax.tolerancing.problems.execution import fingerprint_problem
from rfem_jax.tolerancing.problems.named_tolerances import Tolerances, distributions_of
from rfem_jax.tolerancing.problems.problem import ToleranceProblem
from rfem_jax.tolerancing.problems.results_store import require_study
from rfem_jax.tolerancing.problems.sample_values import default_lanes
from rfem_jax.tolerancing.sampling.sequences import RandomKey, key_words

FORMAT = 3  # of the content of a chunk, and of the order and drawing of points


def identify_request(
    metrics: Sequence[str],
    tolerances: Tolerances,
    key: RandomKey,
    *,
    batch: int,
    lanes: int,
    sampling: str,
    sobol_indices: bool,
) -> dict[str, Any]:
    """Everything that distinguishes a study from others but its problem; arguments as of `monte_carlo`."""
    return {
        "study": "monte_carlo",
        "format": FORMAT,
        "metrics": list(metrics),
        "tolerances": _tolerance_table(tolerances),
        "key": key_words(key),
        "device": jax.default_backend(),
        "versions": {name: _version(name) for name in ("jax", "jaxlib", "numpy", "scipy", "rfem-jax")},
        "batch": batch,
        "lanes": lanes,
        "sampling": sampling,
        "sobol_indices": sobol_indices,
    }


def identify(problem: ToleranceProblem, tolerances: Tolerances, key: RandomKey, **settings: Any) -> dict[str, Any]:
    """Everything that distinguishes a study from others; settings as of `identify_request`."""
    request = identify_request([metric.name for metric in problem.metrics], tolerances, key, **settings)
    return request | {"problem": fingerprint_problem(problem)}


def require_folder(
    folder: str | Path,
    metrics: Sequence[str],
    tolerances: Tolerances | Study,
    key: RandomKey,
    *,
    batch: int = 64,
    lanes: int | None = None,
    sampling: str = "sobol",
    sobol_indices: bool = False,
    description: Mapping[str, str] | None = None,
) -> None:
    """See that a study can start or continue in `folder`, without its problem and without writing anything.

    Args:
        folder: what `monte_carlo` shall have as `resume`.
        metrics: names of the problem's metrics, in its order.
        tolerances, key, batch, lanes, sampling, sobol_indices, description: as of `monte_carlo`.
    Raises: StudyFolderError for a folder of another study, one that holds other files, and one that cannot be written.
    """
    request = identify_request(
        metrics, distributions_of(tolerances), key, batch=batch, lanes=default_lanes() if lanes is None else lanes,
        sampling=sampling, sobol_indices=sobol_indices,
    )  # fmt: skip
    require_study(folder, request, description)


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
