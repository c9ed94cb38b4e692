"""Which metrics exist: the numbers of a run that tolerance studies differentiate, sample and limit.

Place in the pipeline: `tasks.settings` checks the names in a study file against this catalogue before anything is
simulated; `tolerancing.metrics` makes metrics of a run of its entries.

A metric of a joint is named "JOINT.KIND" ("A.rms_force"), a metric of the whole run by its kind ("end_energy").
An entry holds everything about its kind, so that a new metric is one call of `register_metric`, here or in a program
of the user. The functions read attributes of a run (`rfem_jax.simulation.Run`); nothing is imported from there.

A joint of the tree with one angle, or one displacement, has its value at the end and its range over the saved times,
the swing of a rocker or the stroke of a slider.

Mean squares are smooth. RMS values are their square roots and have a kink where the load vanishes (theory (8.5),
(9.5)). The peak of a load is a p-norm over the saved times, a smooth approximation of the maximum (theory (8.7)).
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from rfem_jax.description.errors import InputError, require_name
from rfem_jax.description.joint_kinds import JointKind

PEAK_POWER = 16  # of the p-norm


@dataclass(frozen=True)
class MetricKind:
    """An entry of the catalogue, with the arguments of `register_metric`."""

    name: str
    unit: str
    function: Callable[..., Any]
    label: str
    even: bool | None
    of_joints: bool
    nonnegative: bool
    had_by: Callable[[JointKind, bool], bool] | None = None

    def is_had_by(self, kind: JointKind, cut: bool) -> bool:
        """Whether a joint of a kind, cut or not, has this metric."""
        return self.had_by is None or self.had_by(kind, cut)


JOINT_METRICS: dict[str, MetricKind] = {}
RUN_METRICS: dict[str, MetricKind] = {}


def register_metric(
    name: str,
    unit: str,
    function: Callable[..., Any],
    *,
    label: str = "",
    even: bool | None = None,
    of_joints: bool = False,
    nonnegative: bool = False,
    had_by: Callable[[JointKind, bool], bool] | None = None,
    replace: bool = False,
) -> None:
    """Add a metric to the catalogue. From then on its name is known everywhere: in `Problem`, in all tolerance
    studies and their tables, and in study files that are loaded afterwards.

        register_metric("swing", "rad", lambda run: jnp.max(run.angle), label="largest crank angle")
        register_metric("end_force", "N", lambda run, joint: run.loads[joint].force[-1, 0], of_joints=True)

        problem = Problem(model, drive, duration, ("swing", "A.end_force"), method)

    Args:
        name: letters, digits, "_" and "-"; a metric of joints is then named "JOINT.name".
        unit: of the value, such as "N" or "rad"; "" for a plain number.
        function: `function(run)`, or with `of_joints` `function(run, joint)`, returns a scalar in that unit. It is
            traced and differentiated: write it with `jax.numpy`.
        label: for tables and pictures; "{joint}" stands for the joint's name. Made of the name if left out.
        even: True if the value does not change when all out-of-plane errors of a planar mechanism change sign
            (theory (9.3)), None if unknown.
        of_joints: True for a metric that every joint has.
        nonnegative: True if the value is never negative; a limit in a study file must then be positive.
        had_by: `had_by(kind, cut)`, whether a joint of a kind, cut or not, has this metric of joints; all if left out.
        replace: True to replace a metric of the same name.
    Raises: InputError for a name that is no plain word or is taken, and for a function that cannot be called.
    """
    require_name(name, "name")
    if not callable(function):
        raise InputError(
            f"Argument `function` of the metric `{name}` must be a function of a run, but is {function!r}; "
            "write for example `lambda run: run.angle[-1]`."
        )
    taken = name in JOINT_METRICS or name in RUN_METRICS
    if taken and not replace:
        raise InputError(
            f"Argument `name` of a metric must be a new one, but `{name}` is registered already; "
            "choose another name, or pass replace=True."
        )
    label = label or name.replace("_", " ") + (" in {joint}" if of_joints else "")
    for catalogue in (JOINT_METRICS, RUN_METRICS):
        catalogue.pop(name, None)
    kind = MetricKind(name, unit, function, label, even, of_joints, nonnegative, had_by)
    (JOINT_METRICS if of_joints else RUN_METRICS)[name] = kind


def never_negative(name: str) -> bool:
    """Whether the metric `name`, as "A.rms_force", is never negative."""
    kind = _kind_of(name)
    return kind is not None and kind.nonnegative


def unit_of(name: str) -> str | None:
    """Unit of the metric `name`, as "A.rms_force"; None for an unknown one."""
    kind = _kind_of(name)
    return None if kind is None else kind.unit


def _kind_of(name: str) -> MetricKind | None:
    return JOINT_METRICS.get(name.rpartition(".")[2]) or RUN_METRICS.get(name)


def has_metric(name: str, kind: JointKind, cut: bool) -> bool:
    """Whether a joint of a kind, cut or not, has the metric `name` of joints, as "end_angle"."""
    return name not in JOINT_METRICS or JOINT_METRICS[name].is_had_by(kind, cut)


def p_norm(vectors: Float[Array, "times 3"], power: int = PEAK_POWER) -> Float[Array, ""]:
    """Smooth maximum of the lengths of vectors: (mean of |v|^p)^(1/p), with a finite derivative where all vanish.

    With N vectors, p-norm <= largest length <= N^(1/p) p-norm.
    """
    square = jnp.sum(vectors**2, axis=1)
    largest = jnp.max(square)
    vanish = largest <= 0.0
    safe = jnp.where(vanish, 1.0, largest)  # a root of zero has no derivative
    mean = jnp.where(vanish, 1.0, jnp.mean((square / safe) ** (power // 2)))
    return jnp.where(vanish, 0.0, jnp.sqrt(safe)) * mean ** (1.0 / power)


def _register_load(name, unit, label, function) -> None:
    label = f"{label} in {{joint}}"
    register_metric(name, unit, function, label=label, even=True, of_joints=True, nonnegative=True)


_register_load("mean_square_force", "N^2", "mean square force", lambda run, joint: run.metrics.mean_square_force[joint])
_register_load(
    "mean_square_moment", "(N m)^2", "mean square moment", lambda run, joint: run.metrics.mean_square_moment[joint]
)
_register_load("rms_force", "N", "RMS force", lambda run, joint: run.metrics.rms_force[joint])
_register_load("rms_moment", "N m", "RMS moment", lambda run, joint: run.metrics.rms_moment[joint])
_register_load("peak_force", "N", f"{PEAK_POWER}-norm of the force", lambda run, joint: p_norm(run.loads[joint].force))
_register_load(
    "peak_moment", "N m", f"{PEAK_POWER}-norm of the moment", lambda run, joint: p_norm(run.loads[joint].moment)
)
_register_load(
    "preload_force_square",
    "N^2",
    "squared preload force",
    lambda run, joint: jnp.sum(run.preload[joint].force ** 2),
)
_register_load(
    "preload_moment_square",
    "(N m)^2",
    "squared preload moment",
    lambda run, joint: jnp.sum(run.preload[joint].moment ** 2),
)


def _register_motion(what: str, unit: str, range_name: str, count: Callable[[JointKind], int]) -> None:
    def values(run, joint):
        return getattr(run, f"{what}s")[joint]

    def one(kind: JointKind, cut: bool) -> bool:
        return not cut and count(kind) == 1

    of = {"even": True, "of_joints": True, "had_by": one}
    register_metric(
        f"end_{what}", unit, lambda run, joint: values(run, joint)[-1], label=f"{what} of {{joint}} at the end", **of
    )
    register_metric(
        f"{what}_range", unit, lambda run, joint: jnp.max(values(run, joint)) - jnp.min(values(run, joint)),
        label=f"{range_name} of {{joint}}", nonnegative=True, **of,
    )  # fmt: skip


_register_motion("angle", "rad", "swing", lambda kind: kind.angles)
_register_motion("displacement", "m", "stroke", lambda kind: kind.displacements)
register_metric("angle_error", "rad", lambda run: run.driven_joint.angle_end, label="angle error at the end", even=True)
register_metric("end_energy", "J", lambda run: run.energy.total[-1], label="energy at the end", even=True)
