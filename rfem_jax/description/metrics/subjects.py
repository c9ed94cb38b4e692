"""What metrics can be of: joints, links, points, couplings, bearings, drives of a mechanism, described or as a model.

Place in the pipeline: metric_catalogue -> **metric_subjects** -> tasks (of a `Mechanism`), tolerancing (of a `Model`).
"""

from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

from rfem_jax.description.basics.errors import InputError, suggestion
from rfem_jax.description.basics.joint_kinds import KINDS, JointKind
from rfem_jax.description.mechanism.forces import JointFriction
from rfem_jax.description.mechanism.links import Link
from rfem_jax.description.mechanism.mechanism import Mechanism
from rfem_jax.description.mechanism.reduced_bodies import ReducedBody
from rfem_jax.description.metrics.catalogue import MetricKind, kind_and_owner, suggested_metric
from rfem_jax.description.metrics.path_metrics import path_instant


class JointSubject(NamedTuple):
    """A joint: its kind, whether it is cut and driven, has friction, and which capacities its bearing has."""

    kind: JointKind
    cut: bool
    driven: bool = False
    friction: bool = False
    capacities: tuple[str, ...] = ()


class LinkSubject(NamedTuple):
    """A link: whether the stresses at its section's edge are known; reduced: whether it has a reduced body, which has
    interfaces and no sections between them."""

    edge: bool
    reduced: bool = False


class PointSubject(NamedTuple):
    """A point whose path is followed: whether the mechanism has a drive, whose coordinate may name an instant."""

    driven: bool


class CouplingSubject(NamedTuple):
    """A coupling: whether its second coordinate is a rotation."""

    turns: bool


class MetricSubjects(NamedTuple):
    """All joints, links, points and couplings by their names; named: names of the points that have names already."""

    joints: dict[str, JointSubject]
    links: dict[str, LinkSubject]
    points: dict[str, PointSubject] = {}  # noqa: RUF012  # never changed
    couplings: dict[str, CouplingSubject] = {}  # noqa: RUF012  # never changed
    named: tuple[str, ...] = ()

    @property
    def friction(self) -> bool:
        """Whether any joint has friction."""
        return any(joint.friction for joint in self.joints.values())

    @property
    def driven(self) -> bool:
        """Whether any joint is driven."""
        return any(joint.driven for joint in self.joints.values())


Subject = JointSubject | LinkSubject | PointSubject | CouplingSubject | MetricSubjects


def subjects_of(mechanism: Mechanism) -> MetricSubjects:
    """What the metrics of a described mechanism can be of."""
    with_friction = {force.joint for force in mechanism.forces if isinstance(force, JointFriction)}
    driven = {name for name, _ in mechanism.driven_motions}
    joints = {
        one.name: JointSubject(
            KINDS[one.kind],
            one.cut,
            one.name in driven,
            one.name in with_friction,
            () if one.bearing is None else one.bearing.capacities,
        )
        for one in mechanism.joints
    }
    links = {one.name: LinkSubject(_edge_known(one), one.reduced) for one in mechanism.links}
    points = {one.name: PointSubject(bool(driven)) for one in mechanism.points}
    couplings = {one.name: CouplingSubject(one.turns[1]) for one in mechanism.couplings}
    return MetricSubjects(joints, links, points, couplings, tuple(mechanism.named_points))


def _edge_known(link: Link) -> bool:
    if isinstance(link.body, ReducedBody):
        return link.body.stresses is not None
    return link.section is not None and all(section.edge_stresses() for section in link.sections)


def points_of(names: Iterable[str]) -> tuple[str, ...]:
    """The points that metrics by their names are of, each once."""
    pairs = map(kind_and_owner, names)
    return tuple(dict.fromkeys(path_instant(owner).point for kind, owner in pairs if kind and kind.of == "point"))


def divided(owner: str) -> tuple[str, float]:
    """Link and fraction of its length of "LINK@FRACTION"; the far end of "LINK". Raises InputError."""
    link, at, fraction = owner.partition("@")
    if not at:
        return link, 1.0
    try:
        value = float(fraction)
    except ValueError:
        value = -1.0
    if not 0.0 <= value <= 1.0:
        raise InputError(
            f"Argument `metrics` must name a point of a link by a fraction of its length from 0 to 1, but {owner!r} "
            f"has {fraction!r}; write for example {link}@0.5."
        )
    return link, value


def require_metric(name: str, subjects: MetricSubjects, whole: str, of: str = "") -> tuple[str, ...]:
    """The metrics that a name stands for, several where its joint or link is "*"; `whole`: "model" or "mechanism";
    `of`: " of the task `NAME`".

    Raises: InputError for a joint or link that is not there or has no such metric.
    """
    kind, owner = kind_and_owner(name)
    if kind is None:
        raise InputError(
            f"Argument `metrics`{of} must name metrics, but {name!r} is not a metric; "
            f"{suggested_metric(name, owner or '*')}"
        )
    if kind.of == "run":
        refusal = kind.refusal and kind.refusal(subjects)
        if refusal:
            raise InputError(
                f"Argument `metrics`{of} must fit the {whole}, but `{name}` does not: {refusal}; leave it out."
            )
        return (name,)
    by_kind = {"joint": subjects.joints, "link": subjects.links, "point": subjects.points}
    known: Mapping[str, Any] = (by_kind | {"coupling": subjects.couplings})[kind.of]
    wanted, _, _ = owner.partition("@")
    if kind.of == "link":
        _require_divisible(name, owner, subjects, of)
    if kind.of == "point" and wanted in subjects.named:
        known = {**known, wanted: PointSubject(subjects.driven)}
    if kind.of == "point" and "@" in owner and not kind.instant:
        raise InputError(
            f"Argument `metrics`{of} must name an instant of a metric that has one, but `{name}` is of the whole path; "
            f"write `{wanted}.{kind.name}`, or for example `{owner}.deviation`."
        )
    if kind.of == "point" and path_instant(owner).kind == "drive" and not subjects.driven:
        raise InputError(
            f"Argument `metrics`{of} must name an instant of a mechanism without a drive by a time, but `{name}` names "
            f"it by a coordinate of the drive; write for example {wanted}@0.3s."
        )
    if kind.of == "point" and not known:
        raise InputError(
            f"Argument `metrics`{of} must fit the {whole}, but `{name}` is of a point and it has none of this "
            "name; name a joint or an end of a link, as `B` and `coupler.end`, add a table [[mechanism.points]] with "
            "`name`, `link` and `position`, or `Point` objects."
        )
    if kind.of == "coupling" and not known:
        raise InputError(
            f"Argument `metrics`{of} must fit the {whole}, but `{name}` is of a coupling and it has none; add a table "
            "[[mechanism.couplings]], or `Coupling` objects among its `forces`."
        )
    if wanted not in (*known, "*"):
        near = (*known, *subjects.named) if kind.of == "point" else known
        raise InputError(
            f"Argument `metrics`{of} must be of {kind.of}s of the {whole}, but it has no {kind.of} `{owner}` for "
            f"`{name}`; {suggestion(wanted, near)}"
        )
    having = [one for one, subject in known.items() if refusal_of(kind, subject) is None]
    if wanted == "*" and having:
        return tuple(f"{owner.replace('*', one, 1)}.{kind.name}" for one in having)
    if wanted not in having:
        raise InputError(_not_had(name, kind, None if wanted == "*" else known[wanted], having, of))
    return (name,)


def _require_divisible(name: str, owner: str, subjects: MetricSubjects, of: str) -> None:
    """Raise InputError for a wrong fraction, and for a place within a reduced body, which has no sections there."""
    link, fraction = divided(owner)
    if fraction != 1.0 and link in subjects.links and subjects.links[link].reduced:
        raise InputError(
            f"Argument `metrics`{of} must be of the end of link `{link}`, whose reduced body has no sections between "
            f"its interfaces, but is `{name}`; write `{name.replace(owner, link, 1)}`, or follow a point there."
        )


def refusal_of(kind: MetricKind, subject: Subject) -> str | None:
    """Why a joint, a link, a coupling or a mechanism has no such metric, None if it has."""
    if isinstance(subject, JointSubject) and kind.had_by is not None and not kind.had_by(subject.kind, subject.cut):
        return "a cut joint has no coordinate, and a joint of another kind has other coordinates"
    return kind.refusal and kind.refusal(subject)


def _not_had(
    name: str,
    kind: MetricKind,
    subject: Subject | None,
    having: Iterable[str],
    of: str,
) -> str:
    """The sentence that says why a joint or link has no such metric, and which have it."""
    reason = subject and refusal_of(kind, subject)
    return (
        f"Argument `metrics`{of} must be of {kind.of}s that have them, but there is no `{name}`"
        + (f": {reason}; " if reason else "; ")
        + (f"{kind.of}s that have it are {', '.join(having)}." if having else f"no {kind.of} has it, leave it out.")
    )
