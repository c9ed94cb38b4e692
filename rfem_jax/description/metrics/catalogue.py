"""Which metrics exist: the numbers of a run that tolerance studies differentiate, sample and limit.

Place in the pipeline: `tasks.settings` checks the names in a study file against this catalogue before anything is
simulated; `tolerancing.metrics` makes metrics of a run of its entries.

A metric of a joint is named "JOINT.KIND" ("A.rms_force"), a metric of a link "LINK.KIND" ("coupler.peak_stress"; of a
point of it "LINK@FRACTION.KIND", as "coupler@0.5.peak_deflection" in its middle), a metric of the path of a point
"POINT.KIND" ("P.max_deviation"; of an instant "POINT@INSTANT.KIND", as "P@90deg.x"), a metric of the whole run by its
kind ("end_energy"). An entry holds everything about its kind, so that a new metric is one call of `register_metric`,
here, in `design_metrics` or in a program of the user. The functions read attributes of a run
(`rfem_jax.simulation.Run`); nothing is imported from there. What a run records for a metric alone is said by `records`:
no other run has it.

A joint of the tree with one angle, or one displacement, has its value at the end and its range over the saved times,
the swing of a rocker or the stroke of a slider.

Mean squares are smooth. RMS values are their square roots and have a kink where the load vanishes (theory (8.5),
(9.5)). The maximum of a load over all steps has a kink where another instant becomes that of the maximum (theory
(8.6)). `peak_force` and `peak_moment` are p-norms over the saved times, smooth, and a lower bound of the maximum
(theory (8.7)).
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from rfem_jax.description.basics.errors import InputError, nearest, require_name
from rfem_jax.description.basics.joint_kinds import JointKind

PEAK_POWER = 16  # of the p-norm


Refusal = Callable[[Any], str | None]


@dataclass(frozen=True)
class MetricKind:
    """An entry of the catalogue, with the arguments of `register_metric`; `of` is "run", "joint", "link", "point" or
    "coupling";
    `refusal`: of a `JointSubject`, `LinkSubject` or `MetricSubjects` why it has no such metric and what to do, None if
    it has; `equation`: its number in the theory; `instant`: whether a metric of a point is of one instant, which its
    owner may name; `at_rest`: whether a mechanism at rest has it, too, by the attributes that its loads share with a
    run."""

    name: str
    unit: str
    function: Callable[..., Any]
    label: str
    even: bool | None
    of: str
    nonnegative: bool
    had_by: Callable[[JointKind, bool], bool] | None = None
    records: tuple[str, ...] = ()
    description: str = ""
    refusal: Refusal | None = None
    at_start: bool = False
    note: str = ""
    kinked: bool = False
    equation: str = ""
    instant: bool = False
    at_rest: bool = False

    def labelled(self, owners: Mapping[str, str]) -> str:
        """The label with {kind of owner: its name} put in."""
        label = self.label
        for of, owner in owners.items():
            label = label.replace(f"{{{of}}}", owner)
        return label

    def recorded_for(self, owner: str) -> tuple[str, ...]:
        """What a run has to record for this metric of a joint, a link or a point."""
        if self.of == "point":  # what is recorded is of all instants
            owner = owner.partition("@")[0]
        return tuple(name.replace("{owner}", owner) for name in self.records)


JOINT_METRICS: dict[str, MetricKind] = {}
LINK_METRICS: dict[str, MetricKind] = {}
POINT_METRICS: dict[str, MetricKind] = {}
COUPLING_METRICS: dict[str, MetricKind] = {}
RUN_METRICS: dict[str, MetricKind] = {}
CATALOGUES = {
    "joint": JOINT_METRICS,
    "link": LINK_METRICS,
    "point": POINT_METRICS,
    "run": RUN_METRICS,
    "coupling": COUPLING_METRICS,
}
OWNED = JOINT_METRICS, LINK_METRICS, POINT_METRICS, COUPLING_METRICS


def register_metric(
    name: str,
    unit: str,
    function: Callable[..., Any],
    *,
    label: str = "",
    even: bool | None = None,
    of_joints: bool = False,
    of_links: bool = False,
    of_points: bool = False,
    nonnegative: bool = False,
    had_by: Callable[[JointKind, bool], bool] | None = None,
    records: tuple[str, ...] = (),
    description: str = "",
    at_start: bool = False,
    note: str = "",
    kinked: bool = False,
    equation: str = "",
    at_rest: bool = False,
    replace: bool = False,
) -> None:
    """Add a metric to the catalogue: its name is known everywhere then, in study files that are loaded afterwards, too.

        register_metric("swing", "rad", lambda run: jnp.max(run.motion.angle), label="largest crank angle")
        register_metric("end_force", "N", lambda run, joint: run.loads[joint].force[-1, 0], of_joints=True)

        problem = Problem(simulation, ("swing", "A.end_force"))

    Args:
        name: letters, digits, "_" and "-"; a metric of joints is then named "JOINT.name", one of links "LINK.name",
            one of points "POINT.name".
        unit: of the value, such as "N" or "rad"; "" for a plain number.
        function: `function(run)`, or with `of_joints`, `of_links` and `of_points` `function(run, name)` with the name
            of the joint, the link or the point, returns a scalar in that unit. It is traced and differentiated: write
            it with `jax.numpy`.
        label: for tables and pictures; "{joint}" ("{link}", "{point}") stands for the name. Left out: made of the name.
        even: True if the value does not change with the sign of all out-of-plane errors (theory (9.3)), else None.
        of_joints, of_links, of_points: True for a metric that every joint, link or point (`run.points[name]`) has.
        nonnegative: True if the value is never negative; a limit in a study file must then be positive.
        had_by: `had_by(kind, cut)`, whether a joint of a kind, cut or not, has this metric of joints; all if left out.
        records: what the function reads of `run.recorded`, as `simulate` names it ("{owner}" stands for the joint, the
            link or the point), as ("{owner}.sections",); runs for other metrics do not record it.
        description: a sentence about what it is.
        at_start: True for what the start at rest decides alone, such as a preload; no step has a part in it.
        note: what a reader of the value must know, as "below the maximum"; it is told wherever values are.
        kinked: True where the derivative jumps, as that of a maximum over time; sensitivities say so.
        equation: its number in the theory, as "(8.6)".
        at_rest: True if `function` may read a `StaticLoads`, too, which has positions in the place of saved times.
        replace: True to replace a metric of the same name.
    Raises: InputError for a name that is no plain word or is taken, for a function that cannot be called, and for a
        metric that is of several of joints, links and points.
    """
    of = _fitting_owner(name, function, {"joint": of_joints, "link": of_links, "point": of_points})
    if not replace:
        _require_new(name)
    label = label or name.replace("_", " ") + ("" if of == "run" else f" {'of' if of_points else 'in'} {{{of}}}")
    for catalogue in CATALOGUES.values():
        catalogue.pop(name, None)
    about = had_by, tuple(records), description, None, at_start, note, kinked, equation
    add_metric(MetricKind(name, unit, function, label, even, of, nonnegative, *about, at_rest=at_rest))


def _fitting_owner(name: str, function: Callable[..., Any], asked: Mapping[str, bool]) -> str:
    """What a metric is of, "run" if nothing is `asked`. Raises InputError for arguments of `register_metric` that do
    not fit."""
    owners = [one for one, true in asked.items() if true]
    require_name(name, "name")
    if not callable(function):
        raise InputError(
            f"Argument `function` of the metric `{name}` must be a function of a run, but is {function!r}; "
            "write for example `lambda run: run.motion.angle[-1]`."
        )
    if len(owners) > 1:
        raise InputError(
            f"Argument `of_{owners[1]}s` of the metric `{name}` must be left out for a metric of {owners[0]}s, but "
            "both are true; register two metrics."
        )
    return (*owners, "run")[0]


def _require_new(name: str) -> None:
    """Raise InputError for a name that is taken."""
    if any(name in catalogue for catalogue in CATALOGUES.values()):
        raise InputError(
            f"Argument `name` of a metric must be a new one, but `{name}` is registered already; "
            "choose another name, or pass replace=True."
        )


def add_metric(kind: MetricKind) -> None:
    """Put an entry into the catalogue; one of the whole run may have the name of one of joints or links."""
    CATALOGUES[kind.of][kind.name] = kind


def kind_and_owner(name: str) -> tuple[MetricKind | None, str]:
    """The kind of a metric and what it is of, as "A" of "A.rms_force", "" of the whole run; None of an unknown one."""
    owner, _, kind = name.rpartition(".")
    if not owner:
        return RUN_METRICS.get(name), ""
    return next((known[kind] for known in OWNED if kind in known), None), owner


def only_at_start(names: Iterable[str]) -> bool:
    """Whether the start at rest decides metrics alone, by their names."""
    kinds = [kind_and_owner(name)[0] for name in names]
    return all(kind is not None and kind.at_start for kind in kinds)


def at_rest(names: Iterable[str]) -> tuple[str, ...]:
    """Of metrics by their names those that a mechanism at rest has, too."""
    return tuple(name for name in names if _why_not_at_rest(name) is None)


def require_at_rest(names: Iterable[str], whose: str) -> None:
    """Raise InputError for metrics that a mechanism at rest has not; `whose`: as " of the task `NAME`,"."""
    reasons = {name: reason for name in names if (reason := _why_not_at_rest(name)) is not None}
    if reasons:
        raise InputError(
            *(
                f"Argument `metrics`{whose} must name metrics of a mechanism at rest, but `{name}` {reason}."
                for name, reason in reasons.items()
            )
        )


def _why_not_at_rest(name: str) -> str | None:
    kind, owner = kind_and_owner(name)
    if kind is None or not kind.at_rest:
        return "is of a motion; `rfem-jax keys metrics` tells which are of a mechanism at rest, too"
    if kind.of == "point" and "@" in owner:
        return f"names an instant; write `{owner.partition('@')[0]}.{kind.name}`, which is of the last position"
    return None


def records_for(names: Iterable[str]) -> tuple[str, ...]:
    """What a run has to record for metrics of the catalogue, by their names."""
    pairs = [kind_and_owner(name) for name in names]
    return tuple(dict.fromkeys(one for kind, owner in pairs if kind is not None for one in kind.recorded_for(owner)))


def metric_of(run: Any, name: str) -> Any:
    """The value of a metric of the catalogue, by its name, in a run."""
    kind, owner = kind_and_owner(name)
    assert kind is not None, "names of metrics are checked where they enter"
    return kind.function(run, owner) if owner else kind.function(run)


def notes_on(names: Iterable[str]) -> dict[str, str]:
    """{kind, as "peak_force": what a reader of its values must know} of metrics by their names."""
    kinds = [kind_and_owner(name)[0] for name in names]
    return {kind.name: kind.note for kind in kinds if kind is not None and kind.note}


def note_sentences(names: Iterable[str]) -> list[str]:
    """`notes_on` in sentences."""
    return [f"{kind}: {note}." for kind, note in notes_on(names).items()]


def kinked(names: Iterable[str]) -> tuple[str, ...]:
    """Of metrics by their names those whose derivatives jump where another instant, or place, is that of the
    maximum."""
    pairs = [(name, kind_and_owner(name)[0]) for name in names]
    return tuple(name for name, kind in pairs if kind is not None and kind.kinked)


def known_names(owner: str) -> list[str]:
    """Names of all metrics, those of joints, links, points and couplings with an owner as "A" or "*"."""
    return [f"{owner}.{kind}" for known in OWNED for kind in known] + list(RUN_METRICS)


def suggested_metric(name: str, owner: str) -> str:
    """What to do about an unknown metric, with the nearest name; `owner`: as of `known_names`."""
    match = nearest(name, known_names(owner))
    return f"did you mean `{match}`?" if match else "`rfem-jax keys metrics` prints all."


def never_negative(name: str) -> bool:
    """Whether the metric `name`, as "A.rms_force", is never negative."""
    kind = kind_and_owner(name)[0]
    return kind is not None and kind.nonnegative


def unit_of(name: str) -> str | None:
    """Unit of the metric `name`, as "A.rms_force"; None for an unknown one."""
    kind = kind_and_owner(name)[0]
    return None if kind is None else kind.unit


def p_norm(vectors: Float[Array, "times 3"], power: int = PEAK_POWER) -> Float[Array, ""]:
    """Smooth maximum of the lengths of vectors: (mean of |v|^p)^(1/p), with a finite derivative where all vanish.

    With N vectors, p-norm <= largest length <= N^(1/p) p-norm.
    """
    return norm_of_squares(jnp.sum(vectors**2, axis=1), vectors.shape[0], power)


def norm_of_squares(squares: Float[Array, "..."], count: int, power: int = PEAK_POWER) -> Float[Array, ""]:
    """Smooth maximum of the roots of squares, (sum of squares^(p/2) / count)^(1/p), with p even; its derivative is zero
    where all vanish.

    With N squares, count^(-1/p) times the largest root <= norm <= (N / count)^(1/p) times it (theory (8.12)).
    """
    largest = jnp.max(squares)
    vanish = largest <= 0.0
    safe = jnp.where(vanish, 1.0, largest)  # a root of zero has no derivative
    mean = jnp.where(vanish, 1.0, jnp.sum((squares / safe) ** (power // 2)) / count)
    return jnp.where(vanish, 0.0, jnp.sqrt(safe)) * mean ** (1.0 / power)


BELOW = f"smooth {PEAK_POWER}-norm over the saved times, a lower bound of the maximum"
_OF_LOADS: dict[str, Any] = {"even": True, "of_joints": True, "nonnegative": True, "at_rest": True}


def _register_loads(load: str, unit: str, squared: str) -> None:
    """Metrics of the force or the moment of joints."""
    register_metric(
        f"mean_square_{load}", squared, lambda run, joint: getattr(run.metrics, f"mean_square_{load}")[joint],
        label=f"mean square {load} in {{joint}}", equation="(8.5)",
        description=f"mean square over the whole run of the resultant {load}", **_OF_LOADS,
    )  # fmt: skip
    register_metric(
        f"rms_{load}", unit, lambda run, joint: getattr(run.metrics, f"rms_{load}")[joint],
        label=f"RMS {load} in {{joint}}", equation="(8.5)",
        description=f"root of the mean square over the whole run of the resultant {load}", **_OF_LOADS,
    )  # fmt: skip
    register_metric(
        f"max_{load}", unit, lambda run, joint: getattr(run.metrics, f"max_{load}")[joint],
        label=f"largest {load} in {{joint}}", equation="(8.6)", kinked=True,
        description=f"largest resultant {load} of all steps of the run", **_OF_LOADS,
    )  # fmt: skip
    register_metric(
        f"peak_{load}", unit, lambda run, joint: p_norm(getattr(run.loads[joint], load)),
        label=f"{PEAK_POWER}-norm of the {load} in {{joint}}, below its maximum", equation="(8.7)",
        description=f"{BELOW}, of the resultant {load}", note=f"{BELOW}, which is `max_{load}`", **_OF_LOADS,
    )  # fmt: skip
    register_metric(
        f"preload_{load}_square", squared, lambda run, joint: jnp.sum(getattr(run.preload[joint], load) ** 2),
        label=f"squared preload {load} in {{joint}}", at_start=True,
        description=f"square of the resultant {load} at the start", **_OF_LOADS,
    )  # fmt: skip


def _without_axis(joint: Any) -> str | None:
    return None if joint.kind.axis is not None else "its kind has no axis (`max_force` is that of the resultant)"


def _add_component(name: str, words: str, description: str) -> None:
    """The maximum of a part of a joint's force, by the axis of the joint."""
    add_metric(
        MetricKind(
            name, "N", lambda run, joint: getattr(run.metrics, name)[joint], f"largest {words} force in {{joint}}",
            True, "joint", True, description=description, refusal=_without_axis, kinked=True, equation="(8.6)",
            at_rest=True,
        )
    )  # fmt: skip


_register_loads("force", "N", "N^2")
_register_loads("moment", "N m", "(N m)^2")
_add_component("max_axial_force", "axial", "largest force along the joint's axis of all steps of the run")
_add_component("max_normal_force", "normal", "largest resultant force across the joint's axis of all steps of the run")


def _register_motion(what: str, unit: str, range_name: str, count: Callable[[JointKind], int]) -> None:
    def values(run, joint):
        return getattr(run.motion, f"{what}s")[joint]

    def one(kind: JointKind, cut: bool) -> bool:
        return not cut and count(kind) == 1

    of = {"even": True, "of_joints": True, "had_by": one, "at_rest": True}
    register_metric(
        f"end_{what}", unit, lambda run, joint: values(run, joint)[-1], label=f"{what} of {{joint}} at the end",
        description=f"{what} of the joint at the end of the run", **of,
    )  # fmt: skip
    register_metric(
        f"{what}_range", unit, lambda run, joint: jnp.max(values(run, joint)) - jnp.min(values(run, joint)),
        label=f"{range_name} of {{joint}}", nonnegative=True, kinked=True,
        description=f"{range_name}: largest less smallest {what} at the saved times", **of,
    )  # fmt: skip


_register_motion("angle", "rad", "swing", lambda kind: kind.angles)
_register_motion("displacement", "m", "stroke", lambda kind: kind.displacements)
register_metric(
    "angle_error", "rad", lambda run: run.motion.angle_end, label="angle error at the end", even=True,
    description="angle of the driven joint at the end of the run",
)  # fmt: skip
register_metric(
    "end_energy", "J", lambda run: run.energy.total[-1], label="energy at the end", even=True,
    at_rest=True, description="kinetic, elastic and potential energy at the end of the run",
)  # fmt: skip
register_metric(
    "linear_error", "", lambda run: run.checks.linear_error, label="estimated error of linear elements",
    nonnegative=True, at_rest=True,
    description="estimated, relative to the deflections of the link that is worst; it has no derivatives",
)  # fmt: skip
