"""Metrics of a run: names as "A.rms_force" turned into functions Run -> scalar.

Place in the pipeline: Run -> **metric** -> Problem.

`rfem_jax.description.metric_catalogue` holds the kinds of metrics that names stand for. `register_metric`, which is
imported from there, adds a kind of your own; a metric that needs no name of its own in study files is a `Metric` with
a function.
"""

from rfem_jax.description.errors import InputError, suggestion
from rfem_jax.description.metric_catalogue import (
    JOINT_METRICS,
    PEAK_POWER,
    RUN_METRICS,
    MetricKind,
    p_norm,
    register_metric,
)
from rfem_jax.tolerancing.problems.problem import Metric

__all__ = ["Metric", "end_angle", "joint_of", "metric", "peak_force", "peak_moment", "register_metric"]

_made: dict[str, tuple[MetricKind, Metric]] = {}


def metric(name: str) -> Metric:
    """The metric that a name stands for, as "A.rms_force" or "end_energy"; the same object each time, so that equal
    problems share their compiled programs.

    Raises: InputError for an unknown name, with the nearest.
    """
    joint, _, kind = name.rpartition(".")
    entry = JOINT_METRICS.get(kind) if joint else RUN_METRICS.get(name)
    if entry is None:
        known = [f"{joint or 'A'}.{kind}" for kind in JOINT_METRICS] + list(RUN_METRICS)
        raise InputError(f"Argument `metrics` must name metrics, but {name!r} is none; {suggestion(name, known)}")
    # A kind that was replaced is another entry.
    if name not in _made or _made[name][0] is not entry:
        _made[name] = entry, _of_joint(entry, joint) if joint else _of_run(entry)
    return _made[name][1]


def joint_of(one: Metric) -> str | None:
    """The joint that a metric of the catalogue is of; None for a metric of the whole run and one of the user."""
    joint, _, kind = one.name.rpartition(".")
    return joint if joint and kind in JOINT_METRICS else None


def peak_force(joint: str, power: int = PEAK_POWER) -> Metric:
    """Smooth maximum of the resultant force [N]: its p-norm over the saved times, with the given power.

    With N saved times, p-norm <= largest saved value <= N^(1/p) p-norm.
    """
    return Metric(
        f"{joint}.peak_force",
        "N",
        f"{power}-norm of the force in {joint}",
        even=True,
        function=lambda run: p_norm(run.loads[joint].force, power),
    )


def peak_moment(joint: str, power: int = PEAK_POWER) -> Metric:
    """Smooth maximum of the resultant moment [N m], as `peak_force`."""
    return Metric(
        f"{joint}.peak_moment",
        "N m",
        f"{power}-norm of the moment in {joint}",
        even=True,
        function=lambda run: p_norm(run.loads[joint].moment, power),
    )


def end_angle(reference: float = 0.0) -> Metric:
    """Angle of the driven joint at the end minus a reference [rad]; with the angle of the perfect mechanism as the
    reference it is the angle error."""
    return Metric(
        "angle_error",
        "rad",
        "angle error at the end",
        even=True,
        function=lambda run: run.driven_joint.angle_end - reference,
    )


def _of_joint(kind: MetricKind, joint: str) -> Metric:
    label = kind.label.replace("{joint}", joint)
    return Metric(f"{joint}.{kind.name}", kind.unit, label, kind.even, function=lambda run: kind.function(run, joint))


def _of_run(kind: MetricKind) -> Metric:
    return Metric(kind.name, kind.unit, kind.label, kind.even, function=kind.function)
