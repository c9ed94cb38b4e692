"""Metrics: the numbers of a run that tolerance studies differentiate, sample and limit.

Place in the pipeline: Run -> **metric** -> Problem.

Every metric has a name, a unit, a label and a function of a run.  Mean squares are smooth; RMS
values are their roots and have a cone where the load vanishes (theory (8.5), (9.5)); a p-norm is a
smooth stand-in for a maximum (theory (8.7)).  A metric of your own:

    Metric("A.swing", "rad", "largest crank angle", function=lambda run: jnp.max(run.angle))
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache

import jax.numpy as jnp

from rfem_jax.description.errors import InputError, suggestion
from rfem_jax.simulation.equations import guarded_root
from rfem_jax.tolerancing.problem import Metric as NamedMetric


@dataclass(frozen=True)
class Metric(NamedMetric):
    """A number of a run: name, unit, label, and the function Run -> scalar that computes it.

    `even`: unchanged when all out-of-plane errors of a planar mechanism change sign (None:
    unknown).
    """

    function: Callable | None = field(default=None, kw_only=True)

    def __post_init__(self):
        super().__post_init__()
        if not callable(self.function):
            raise InputError(
                f"Argument `function` of metric {self.name!r} must be a function of a run, but is "
                f"{self.function!r}; give for example `lambda run: run.angle[-1]`."
            )

    def __call__(self, run):
        return self.function(run)


def mean_square_force(joint: str) -> Metric:
    """Mean square of the resultant force [N^2]; smooth everywhere."""
    return Metric(
        f"{joint}.mean_square_force", "N^2", f"mean square force in {joint}", even=True,
        function=lambda run: run.metrics.mean_square_force[joint],
    )


def mean_square_moment(joint: str) -> Metric:
    """Mean square of the resultant moment [(N m)^2]; smooth everywhere."""
    return Metric(
        f"{joint}.mean_square_moment", "N^2 m^2", f"mean square moment in {joint}", even=True,
        function=lambda run: run.metrics.mean_square_moment[joint],
    )


def rms_force(joint: str) -> Metric:
    """Root mean square of the resultant force [N]."""
    return Metric(
        f"{joint}.rms_force", "N", f"RMS force in {joint}", even=True,
        function=lambda run: run.metrics.rms_force[joint],
    )


def rms_moment(joint: str) -> Metric:
    """Root mean square of the resultant moment [N m]; a cone where it vanishes."""
    return Metric(
        f"{joint}.rms_moment", "N m", f"RMS moment in {joint}", even=True,
        function=lambda run: run.metrics.rms_moment[joint],
    )


def peak_force(joint: str, power: int = 16) -> Metric:
    """Smooth maximum of the resultant force [N]: the p-norm over the saved times.

    With N saved times, p-norm <= largest saved value <= N^(1/p) p-norm.
    """
    return Metric(
        f"{joint}.peak_force", "N", f"{power}-norm of the force in {joint}", even=True,
        function=lambda run: _p_norm(run.loads[joint].force, power),
    )


def peak_moment(joint: str, power: int = 16) -> Metric:
    """Smooth maximum of the resultant moment [N m], as `peak_force`."""
    return Metric(
        f"{joint}.peak_moment", "N m", f"{power}-norm of the moment in {joint}", even=True,
        function=lambda run: _p_norm(run.loads[joint].moment, power),
    )


def preload_force(joint: str) -> Metric:
    """Square of the resultant preload force [N^2] after assembly; smooth everywhere."""
    return Metric(
        f"{joint}.preload_force_square", "N^2", f"squared preload force in {joint}", even=True,
        function=lambda run: jnp.sum(run.preload[joint].force ** 2),
    )


def preload_moment(joint: str) -> Metric:
    """Square of the resultant preload moment [(N m)^2] after assembly; smooth everywhere."""
    return Metric(
        f"{joint}.preload_moment_square", "N^2 m^2", f"squared preload moment in {joint}",
        even=True, function=lambda run: jnp.sum(run.preload[joint].moment ** 2),
    )


def end_angle(reference: float = 0.0) -> Metric:
    """Driven joint's angle at the end minus a reference [rad]: with the perfect mechanism's angle
    as the reference, the angle error."""
    return Metric(
        "angle_error", "rad", "angle error at the end", even=True,
        function=lambda run: run.driven_joint.angle_end - reference,
    )


def end_energy() -> Metric:
    """Mechanical energy at the end [J]."""
    return Metric(
        "end_energy", "J", "energy at the end", even=True,
        function=lambda run: run.energy.total[-1],
    )


OF_JOINTS = {
    "mean_square_force": mean_square_force,
    "mean_square_moment": mean_square_moment,
    "rms_force": rms_force,
    "rms_moment": rms_moment,
    "peak_force": peak_force,
    "peak_moment": peak_moment,
    "preload_force_square": preload_force,
    "preload_moment_square": preload_moment,
}
OF_RUNS = {"angle_error": end_angle, "end_energy": end_energy}


@cache
def metric(name: str) -> Metric:
    """The metric of a name as "A.rms_force" or "end_energy"; the same object each time (equal
    problems then share their compiled programs).

    **Raises:** `InputError` for an unknown one, with the nearest.
    """
    if name in OF_RUNS:
        return OF_RUNS[name]()
    joint, _, kind = name.rpartition(".")
    if not joint or kind not in OF_JOINTS:
        known = [f"{joint or 'A'}.{kind}" for kind in OF_JOINTS] + list(OF_RUNS)
        raise InputError(
            f"Argument `metrics` must name metrics, but {name!r} is none; {suggestion(name, known)}"
        )
    return OF_JOINTS[kind](joint)


def _p_norm(vectors, power):
    square = jnp.sum(vectors**2, axis=1)
    largest = jnp.max(square)
    safe = jnp.where(largest > 0.0, largest, 1.0)
    mean = jnp.mean((square / safe) ** (power // 2))
    mean = jnp.where(largest > 0.0, mean, 1.0)  # a root of zero has no derivative
    return guarded_root(largest) * mean ** (1.0 / power)
