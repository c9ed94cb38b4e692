"""Metrics that designs are judged by: mass, stress, deflection, bearings, friction loss and power.

Place in the pipeline: metric_catalogue -> **design_metrics**, which registers them when the package is imported.

What they read of `run.recorded` is recorded for them alone (`rfem_jax.simulation.outcome.records`). Largest values are
p-norms over the saved times: smooth, and near the maximum within the bounds of theory (8.12) and (8.13).
"""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from rfem_jax.description.metrics.catalogue import BELOW, MetricKind, add_metric, norm_of_squares, p_norm

STRESS_POWER = 64  # of the p-norm of stresses, whose bound has sections and points in it, too
MILLION_REVOLUTIONS = 2.0e6 * jnp.pi  # rad


def _add(
    of: str,
    name: str,
    unit: str,
    label: str,
    function: Callable[..., Any],
    description: str,
    records: tuple[str, ...] = (),
    refusal: Callable[[Any], str | None] | None = None,
    **more: Any,
) -> None:
    """A metric that is never negative and does not change with the sign of out-of-plane errors."""
    add_metric(MetricKind(name, unit, function, label, True, of, True, None, records, description, refusal, **more))


def _without_edge(link: Any) -> str | None:
    if link.edge:
        return None
    return (
        "the edge of its section is not known (a rigid body has none): write `edge_y`, `edge_z`, `edge_modulus` and "
        "`torsion_modulus` into a section of given stiffnesses"
    )


def _without_capacity(name: str) -> Callable[[Any], str | None]:
    def refusal(joint: Any) -> str | None:
        return None if name in joint.capacities else f"its `bearing` has no `{name}`: write one into the joint"

    return refusal


def _without_friction(subject: Any) -> str | None:
    return None if subject.friction else "it has no friction"


def _without_drive(subject: Any) -> str | None:
    return None if subject.driven else "it is not driven"


def power_of(base: Float[Array, "*n"], numerator: int, denominator: int) -> Float[Array, "*n"]:
    """base^(numerator / denominator) of numbers that are not negative, zero with its derivatives at zero."""
    vanish = base <= 0.0
    return jnp.where(vanish, 0.0, jnp.where(vanish, 1.0, base) ** (numerator / denominator))


def peak_stress(run: Any, link: str, power: int = STRESS_POWER) -> Float[Array, ""]:
    """Smooth maximum of the von Mises stress [Pa] in a link, from `run.recorded["LINK.sections"]`.

    The p-norm with mean over T saved times and sums over S sections and P points of the edge: at least T^(-1/p) and at
    most (S P)^(1/p) times the largest stress (theory (8.13)).
    """
    squares = run.recorded[f"{link}.sections"].stress_squares
    return norm_of_squares(squares, squares.shape[0], power)


def _largest_stress(run: Any, link: str) -> Float[Array, ""]:
    return power_of(jnp.max(run.recorded[f"{link}.sections"].stress_squares), 1, 2)


_add(
    "run", "mass", "kg", "mass", lambda run: jnp.sum(jnp.stack(list(run.recorded["masses"].values()))),
    "mass of all links, point masses and bodies", ("masses",), at_rest=True,
)  # fmt: skip
_add(
    "link", "mass", "kg", "mass of {link}", lambda run, link: run.recorded["masses"][link.partition("@")[0]],
    "mass of a link with its point masses", ("masses",), at_rest=True,
)  # fmt: skip
_add(
    "link", "peak_stress", "Pa", f"{STRESS_POWER}-norm of the stress in {{link}}", peak_stress,
    f"smooth {STRESS_POWER}-norm over time and section of the von Mises stress of axial force, bending and torsion at "
    "the section's edge", ("{owner}.sections",), _without_edge, equation="(8.13)",
    note=f"smooth {STRESS_POWER}-norm over time and section, near the maximum but not it, which is `max_stress`",
    at_rest=True,
)  # fmt: skip
_add(
    "link", "max_stress", "Pa", "largest stress in {link}", _largest_stress,
    "largest saved von Mises stress, with a kink where time or place of the maximum changes",
    ("{owner}.sections",), _without_edge, kinked=True, at_rest=True,
)  # fmt: skip
_add(
    "link", "peak_deflection", "m", "16-norm of the deflection of {link}, below its maximum",
    lambda run, link: p_norm(run.recorded[f"{link}.deflection"]),
    f"{BELOW}, of the distance of a point from its place on the undeformed link",
    ("{owner}.deflection",), equation="(8.7)", note=BELOW, at_rest=True,
)  # fmt: skip
_add(
    "link", "end_deflection", "m", "deflection of {link} at the end",
    lambda run, link: power_of(jnp.sum(run.recorded[f"{link}.deflection"][-1] ** 2), 1, 2),
    "distance of a point from its place on the undeformed link at the end of the run", ("{owner}.deflection",),
    at_rest=True,
)  # fmt: skip


def _force_ratio(run: Any, joint: str) -> Float[Array, ""]:
    return p_norm(run.loads[joint].force) / run.recorded[f"{joint}.bearing"].static


def _moment_ratio(run: Any, joint: str) -> Float[Array, ""]:
    return p_norm(run.loads[joint].moment) / run.recorded[f"{joint}.bearing"].moment


_add(
    "joint", "force_ratio", "", "16-norm of the force in {joint} over its capacity", _force_ratio,
    "`peak_force` over the static capacity of the bearing", ("{owner}.bearing",),
    _without_capacity("static_capacity"), note="by `peak_force`, a lower bound of the maximum, which is `max_force`",
    at_rest=True,
)  # fmt: skip
_add(
    "joint", "moment_ratio", "", "16-norm of the moment in {joint} over its capacity", _moment_ratio,
    "`peak_moment` over the moment capacity of the bearing", ("{owner}.bearing",),
    _without_capacity("moment_capacity"), note="by `peak_moment`, a lower bound of the maximum, which is `max_moment`",
    at_rest=True,
)  # fmt: skip


def _swept(run: Any, joint: str) -> tuple[Float[Array, ""], Float[Array, ""], tuple[int, int]]:
    """Integral of (F/C)^q |w| dt [rad], swept angle [rad], and q (theory (8.15))."""
    bearing, squares = run.recorded[f"{joint}.bearing"], jnp.sum(run.loads[joint].force ** 2, axis=1)
    over, under = bearing.exponent
    rate = jnp.abs(run.recorded[f"{joint}.turning"])
    loaded = power_of(squares / bearing.dynamic**2, over, 2 * under) * rate
    return integral(loaded, run.times), integral(rate, run.times), (over, under)


def integral(values: Float[Array, " times"], times: Float[Array, " times"]) -> Float[Array, ""]:
    """Trapezoidal rule over the saved times."""
    return jnp.sum(0.5 * (values[1:] + values[:-1]) * (times[1:] - times[:-1]))


def _bearing_damage(run: Any, joint: str) -> Float[Array, ""]:
    return _swept(run, joint)[0] / MILLION_REVOLUTIONS


def _bearing_life(run: Any, joint: str) -> Float[Array, ""]:
    damage = _bearing_damage(run, joint)
    none = damage <= 0.0
    return jnp.where(none, jnp.inf, (run.times[-1] - run.times[0]) / jnp.where(none, 1.0, damage))


def _equivalent_load(run: Any, joint: str) -> Float[Array, ""]:
    loaded, swept, (over, under) = _swept(run, joint)
    mean = jnp.where(swept > 0.0, loaded / jnp.where(swept > 0.0, swept, 1.0), 0.0)
    return power_of(mean, under, over) * run.recorded[f"{joint}.bearing"].dynamic


_LIFE = ("{owner}.bearing", "{owner}.turning")
_add(
    "joint", "bearing_damage", "", "share of the life of {joint} that a run takes", _bearing_damage,
    "share of the basic rating life L10 that one run takes, by the swept angle", _LIFE,
    _without_capacity("dynamic_capacity"), equation="(8.15)",
)  # fmt: skip
_add(
    "joint", "bearing_life", "s", "life of {joint}", _bearing_life,
    "basic rating life L10 of runs one after another, infinite without load or motion", _LIFE,
    _without_capacity("dynamic_capacity"), equation="(8.15)",
)  # fmt: skip
_add(
    "joint", "equivalent_load", "N", "equivalent load of {joint}", _equivalent_load,
    "constant force of the same life: mean of the force's power 3 (roller: 10/3) over the swept angle", _LIFE,
    _without_capacity("dynamic_capacity"), equation="(8.15)",
)  # fmt: skip


def _friction_loss(run: Any) -> Float[Array, ""]:
    return jnp.sum(jnp.stack([losses[-1] for losses in run.friction_losses.values()]))


def _power(run: Any, joint: str = "") -> Float[Array, " times"]:
    """Power [W] of all drives, or of those of one joint."""
    names = [name for name in run.motion.drives if not joint or name == joint or name.startswith(f"{joint}.")]
    return jnp.sum(jnp.stack([run.motion.drives[name].force * run.motion.drives[name].rate for name in names]), axis=0)


def _peak_power(run: Any, joint: str = "") -> Float[Array, ""]:
    return norm_of_squares(_power(run, joint) ** 2, run.times.shape[0])


_add("run", "friction_loss", "J", "friction loss", _friction_loss,
     "energy that all friction dissipates in the run", (), _without_friction)  # fmt: skip
_add("joint", "friction_loss", "J", "friction loss in {joint}",
     lambda run, joint: run.recorded[f"{joint}.friction_loss"][-1],
     "energy that friction in a joint dissipates in the run", ("{owner}.friction_loss",),
     _without_friction)  # fmt: skip
_add("run", "peak_drive_power", "W", "16-norm of the power of the drives, below its maximum", _peak_power,
     f"{BELOW}, of the power of all drives together", (), _without_drive, note=BELOW)  # fmt: skip
_add("joint", "peak_drive_power", "W", "16-norm of the power of the drive of {joint}, below its maximum", _peak_power,
     f"{BELOW}, of the power of the drives of a joint", (), _without_drive, note=BELOW)  # fmt: skip


def _drive_loads(run: Any, joint: str, rotation: bool) -> Float[Array, " times"]:
    """Moments [N m] or forces [N] of the drive on a coordinate of a joint; of one that does not drive such a
    coordinate none, NaN."""
    for name, drive in run.motion.drives.items():
        owner, _, motion = name.partition(".")
        if owner == joint and (not motion or motion.startswith("R") is rotation):
            return jnp.asarray(drive.force)
    return jnp.full((1,), jnp.nan)


def _add_drive_load(what: str, unit: str, rotation: bool, count: Callable[[Any], int]) -> None:
    """The last and the largest load of a drive, at rest of what holds its coordinate."""

    def had_by(kind: Any, cut: bool) -> bool:
        return not cut and count(kind) == 1

    def add(name: str, label: str, function: Callable[..., Any], description: str, nonnegative: bool, kinked: bool):
        kind = MetricKind(name, unit, function, label, True, "joint", nonnegative, had_by, (), description,
                          lambda joint: None if joint.driven else "it is not driven, nor held by [statics]",
                          kinked=kinked, at_rest=True)  # fmt: skip
        add_metric(kind)

    of = f"{what} of the drive, or at rest of what holds the coordinate,"
    add(f"end_drive_{what}", f"{what} of the drive of {{joint}} at the end",
        lambda run, joint: _drive_loads(run, joint, rotation)[-1], f"{of} at the end of the run", False,
        False)  # fmt: skip
    add(f"max_drive_{what}", f"largest {what} of the drive of {{joint}}",
        lambda run, joint: jnp.max(jnp.abs(_drive_loads(run, joint, rotation))), f"largest saved {of} in size", True,
        True)  # fmt: skip


_add_drive_load("moment", "N m", True, lambda kind: kind.angles)
_add_drive_load("force", "N", False, lambda kind: kind.displacements)
