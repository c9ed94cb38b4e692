"""The simulator as a problem: named errors in, metrics and a status out.

Place in the pipeline: model, drive, metrics, method -> **Problem** -> all studies of this room.
The only place where tolerance studies meet the mechanics.
"""

from collections.abc import Mapping

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import Array

from rfem_jax.description.drives import MomentDrive, PrescribedDrive
from rfem_jax.description.errors import InputError, suggestion
from rfem_jax.description.methods import Method
from rfem_jax.mechanics.model import Model
from rfem_jax.mechanics.model_with_errors import AssemblyErrors, assembly_errors, error_dimension
from rfem_jax.mechanics.status import STATUS
from rfem_jax.simulation.accuracy import choose_method
from rfem_jax.simulation.integration import simulate
from rfem_jax.simulation.run import RESIDUAL_LIMIT
from rfem_jax.tolerancing import metrics as catalogue
from rfem_jax.tolerancing.metrics import Metric


class Problem(eqx.Module):
    """A mechanism under a drive as a pure function of its assembly errors.

    `problem(errors)` takes {error name: number in rad or m} (or `AssemblyErrors`) and returns
    ({metric name: scalar}, status); it works under jit, vmap, jacfwd, grad, jacrev and their
    compositions.  Memory: forward mode stores nothing along the way; reverse mode with a fixed-step
    method keeps the integrated state at every saved time and at every stage of one interval between
    them, with an implicit method also the solution of every step (accelerations, multipliers), and
    recomputes the rest (`benchmarks/gradients.py` measures both).

    **Arguments:** `metrics`: `Metric`s or their names ("A.rms_force", "end_energy"); `duration` [s];
    `save_every` [s]: interval of the balances and checkpoints, and of the times that p-norms see.

    **Raises:** `InputError` for metrics of joints that do not exist, and repeated names.
    """

    model: Model
    drive: MomentDrive | PrescribedDrive | None
    duration: float = eqx.field(static=True)
    metrics: tuple[Metric, ...] = eqx.field(static=True)
    method: Method = eqx.field(static=True)
    save_every: float | None = eqx.field(static=True)

    def __init__(self, model, drive, duration, metrics, method, save_every=None):
        self.model, self.drive = model, drive
        self.method = choose_method(model, method, drive, float(duration), save_every=save_every)
        self.duration, self.save_every = float(duration), save_every
        metrics = (metrics,) if isinstance(metrics, (str, Metric)) else tuple(metrics)
        self.metrics = tuple(_known_metric(model, m) for m in metrics)
        names = [m.name for m in self.metrics]
        if not names or len(set(names)) < len(names):
            raise InputError(f"Argument `metrics` must hold distinct metrics, but is {names}.")

    # `jax.jit(problem)` keys its cache by the function's identity.
    def __hash__(self) -> int:
        return id(self)

    def __eq__(self, other) -> bool:
        return self is other

    @property
    def error_names(self) -> tuple[str, ...]:
        """Names of all errors that it accepts."""
        return self.model.topology.error_names

    def error_unit(self, name: str) -> str:
        """Unit of an error, "rad" or "m"."""
        if name not in self.error_names:
            raise InputError(
                f"Argument `name` must be an error of the model, but is {name!r}; {suggestion(name, self.error_names)}"
            )
        return {"angle": "rad", "length": "m"}[error_dimension(name)]

    def describe_status(self, code: int) -> str:
        """Short name of a status code; "ok" for 0."""
        return STATUS[int(code)].name

    @property
    def undamped(self) -> bool:
        """True if no flexible link has damping: derivatives of mean-square forces then depend on
        the phase of undamped vibrations (MODEL section 8)."""
        flexible = np.array(self.model.topology.elements) > 1
        return bool(flexible.any() and not np.asarray(self.model.section.damping)[flexible].any())

    def with_method(self, method: Method) -> "Problem":
        """The same problem by another method, for example with a finer step."""
        return Problem(self.model, self.drive, self.duration, self.metrics, method, self.save_every)

    @property
    def derivative_limit(self) -> float | None:
        """Residual of the differentiated equations above which a derivative has not converged (see
        `derivative_residual`); None where none is left: explicit methods."""
        return RESIDUAL_LIMIT if self.method.implicit else None

    def __call__(self, errors: Mapping | AssemblyErrors) -> tuple[dict[str, Array], Array]:
        return self.with_residual(errors)[:2]

    def with_residual(self, errors: Mapping | AssemblyErrors):
        """Metrics, status, forces [N] left over in the equations of motion (times, n), and joint forces [N]
        (joints, times, 3): the derivatives of these two say how accurate derivatives are."""
        if not isinstance(errors, AssemblyErrors):
            errors = assembly_errors(self.model, dict(errors))
        run = simulate(
            self.model,
            errors,
            drive=self.drive,
            duration=self.duration,
            method=self.method,
            save_every=self.save_every,
        )
        forces = jnp.stack([load.force for load in run.loads.values()])
        values = {m.name: jnp.asarray(m(run)) for m in self.metrics}
        return values, run.status, run.equation_residual, forces


def _known_metric(model: Model, metric) -> Metric:
    metric = catalogue.metric(metric) if isinstance(metric, str) else metric
    joint, _, kind = metric.name.rpartition(".")
    if kind in catalogue.OF_JOINTS and joint not in model.joint_names:
        raise InputError(
            f"Argument `metrics` must be of joints of the model, but {metric.name!r} is not; "
            f"{suggestion(joint, model.joint_names)}"
        )
    return metric
