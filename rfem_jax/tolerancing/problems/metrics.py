"""Metrics of a run: names as "A.rms_force" turned into functions Run -> scalar.

Place in the pipeline: Run -> **metric** -> Problem.

`rfem_jax.description.metrics.catalogue` holds the kinds of metrics that names stand for. `register_metric`, which is
imported from there, adds a kind of your own; a metric that needs no name of its own in study files is a `Metric` with
a function.
"""

from rfem_jax.description.basics.errors import InputError
from rfem_jax.description.metrics.catalogue import (
    PEAK_POWER,
    MetricKind,
    kind_and_owner,
    p_norm,
    register_metric,
    suggested_metric,
)
from rfem_jax.description.metrics.design_metrics import STRESS_POWER
from rfem_jax.description.metrics.design_metrics import peak_stress as stress_norm
from rfem_jax.tolerancing.problems.problem import Metric

__all__ = ["Metric", "end_angle", "metric", "peak_force", "peak_moment", "peak_stress", "register_metric"]

_made: dict[str, tuple[MetricKind, Metric]] = {}


def metric(name: str) -> Metric:
    """The metric that a name stands for, as "A.rms_force" or "end_energy"; the same object each time, so that equal
    problems share their compiled programs.

    Raises: InputError for an unknown name, with the nearest.
    """
    entry, owner = kind_and_owner(name)
    if entry is None:
        fix = suggested_metric(name, owner or "A")
        raise InputError(f"Argument `metrics` must name metrics, but {name!r} is not a metric; {fix}")
    # A kind that was replaced is another entry.
    if name not in _made or _made[name][0] is not entry:
        _made[name] = entry, _made_of(entry, owner)
    return _made[name][1]


def peak_force(joint: str, power: int = PEAK_POWER) -> Metric:
    """Lower bound of the largest resultant force [N], smooth: its p-norm over the saved times, with the given power.

    With N saved times, p-norm <= largest saved value <= N^(1/p) p-norm.
    """
    return Metric(
        f"{joint}.peak_force",
        "N",
        f"{power}-norm of the force in {joint}, below its maximum",
        even=True,
        function=lambda run: p_norm(run.loads[joint].force, power),
    )


def peak_moment(joint: str, power: int = PEAK_POWER) -> Metric:
    """Smooth maximum of the resultant moment [N m], as `peak_force`."""
    return Metric(
        f"{joint}.peak_moment",
        "N m",
        f"{power}-norm of the moment in {joint}, below its maximum",
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
        function=lambda run: run.motion.angle_end - reference,
    )


def peak_stress(link: str, power: int = STRESS_POWER) -> Metric:
    """Smooth maximum of the von Mises stress [Pa] in a link, with the given even power (theory (8.13))."""
    return Metric(
        f"{link}.peak_stress",
        "Pa",
        f"{power}-norm of the stress in {link}",
        even=True,
        function=lambda run: stress_norm(run, link, power),
        records=(f"{link}.sections",),
    )


def _made_of(kind: MetricKind, owner: str) -> Metric:
    """The metric of a kind, of a joint or link, or "" for the whole run."""
    label = kind.labelled({kind.of: owner})
    function = kind.function if kind.of == "run" else lambda run: kind.function(run, owner)
    records = kind.recorded_for(owner)
    return Metric(
        kind.name if not owner else f"{owner}.{kind.name}", kind.unit, label, kind.even, function=function,
        records=records, description=kind.description, by_name=metric,
    )  # fmt: skip
