"""A mechanism at rest as a problem: named errors in, metrics of its static loads and a status out.

Place in the pipeline: model, positions, metrics -> **StaticProblem** -> all tolerance studies.

A sample costs one static equilibrium for every position: milliseconds, where a simulation takes seconds. Metrics are
those of runs that a mechanism at rest has, too, with the positions in the place of saved times: of one position mean,
maximum and last value are the same.
"""

import functools
from collections.abc import Iterable, Sequence

import equinox as eqx
import jax.numpy as jnp

from rfem_jax.compilation.program import Program
from rfem_jax.description.basics.precision import require_float64
from rfem_jax.description.metrics.catalogue import kind_and_owner, require_at_rest
from rfem_jax.mechanics.model.errors import Deviations, Errors, deviations_of
from rfem_jax.mechanics.model.model import Model
from rfem_jax.mechanics.statics.designs import Design
from rfem_jax.simulation.outcome.records import require_records
from rfem_jax.simulation.rest.poses import ClosedPose, Positions, poses_at
from rfem_jax.simulation.rest.statics import first_status, static_loads_at
from rfem_jax.tolerancing.checks import check_distinct
from rfem_jax.tolerancing.problems.mechanism_problem import (
    LINEAR_ERROR,
    MechanismProblem,
    following_metrics,
    known_metric,
    records_of,
)
from rfem_jax.tolerancing.problems.metrics import metric
from rfem_jax.tolerancing.problems.problem import Metric, Status, Values


class StaticProblem(MechanismProblem):
    """A mechanism, or a structure, at rest as a pure function of its assembly errors.

    `problem(errors)` takes what a `Problem` takes and returns ({metric name: scalar}, status); it works under jit,
    vmap, jacfwd, grad, jacrev and their compositions.

    Args:
        model: from `discretise`.
        metrics: `Metric`s with functions of `StaticLoads`, or names of metrics that are also of a mechanism at rest
            (`rfem-jax keys metrics` tells which), as "A.max_force", "A.end_drive_moment", "P.deviation_z".
        positions: as of `static_loads` (None: the start).
        design: from `rfem_jax.design`.
        rates, accelerations: as of `inverse_dynamics`, of a mechanism of rigid links (both None: at rest).
    Raises: InputError as `static_loads`, for unknown and repeated metrics, and for metrics of a motion.
    """

    model: Model
    metrics: tuple[Metric, ...] = eqx.field(static=True)
    poses: ClosedPose | None
    design: Design | None = None

    def __init__(
        self,
        model: Model,
        metrics: str | Metric | Iterable[str | Metric],
        positions: Positions | None = None,
        design: Design | None = None,
        rates: Positions | None = None,
        accelerations: Positions | None = None,
    ):
        require_float64()
        metrics = (metrics,) if isinstance(metrics, (str, Metric)) else tuple(metrics)
        model = following_metrics(model, metrics)
        self.model, self.design, self.poses = model, design, poses_at(model, positions, rates, accelerations)
        self.metrics = tuple(known_metric(model, one) for one in metrics)
        check_distinct((one.name for one in self.metrics), "metrics")
        require_at_rest((one.name for one in self.metrics if kind_and_owner(one.name)[0] is not None), "")

    def __repr__(self) -> str:
        links, names = ", ".join(self.model.topology.links), ", ".join(one.name for one in self.metrics)
        return f"<StaticProblem of {links}: {names}>"

    def with_checks(self) -> tuple["StaticProblem", tuple[str, ...]]:
        """The problem with its checks beside the metrics, and their names: the estimated error of linear elements,
        where links have such."""
        topology = self.model.topology
        if topology.exact or not topology.n_rfes:
            return self, ()
        named = {one.name: one for one in (*self.metrics, metric(LINEAR_ERROR))}
        whole = StaticProblem(self.model, list(named.values()), design=self.design)
        return eqx.tree_at(lambda one: one.poses, whole, self.poses, is_leaf=lambda x: x is None), (LINEAR_ERROR,)

    def __call__(self, errors: Errors) -> tuple[Values, Status]:
        """Values {metric name: scalar} and status (scalar int32) of one sample."""
        asked = require_records(self.model, records_of(self.metrics))
        return _values(self.metrics, self.model, deviations_of(self.model, errors), self.poses, asked, self.design)


@functools.partial(Program, nameless=True)
def _values(
    metrics: Sequence[Metric],
    model: Model,
    errors: Deviations,
    poses: ClosedPose | None,
    asked: Sequence[str],
    design: Design | None,
) -> tuple[Values, Status]:
    found = static_loads_at(model, errors, poses, asked, design)
    return {one.name: jnp.asarray(one(found)) for one in metrics}, first_status(found.status)
