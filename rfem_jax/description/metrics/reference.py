"""All metrics with their units, what they mean and what has them: the reference that `rfem-jax keys metrics` prints.

Place in the pipeline: metric_catalogue, design_metrics, metric_subjects -> **metric_reference** ->
`rfem_jax.report.contents.keys_text`, docs/reference/metrics.md. What has a metric is asked of the functions that refuse
it.
"""

from dataclasses import dataclass

from rfem_jax.description.basics.joint_kinds import DEFAULT, KINDS
from rfem_jax.description.mechanism.bearings import CAPACITIES
from rfem_jax.description.metrics.catalogue import CATALOGUES, MetricKind
from rfem_jax.description.metrics.design_metrics import STRESS_POWER as STRESS_POWER  # registers the metrics of designs
from rfem_jax.description.metrics.subjects import CouplingSubject, JointSubject, LinkSubject, MetricSubjects, refusal_of

CALLED = {
    "joint": 'of a joint, "JOINT.NAME", of all that have it "*.NAME"',
    "link": 'of a link, "LINK.NAME", of a point of it "LINK@0.5.NAME", of all links "*.NAME"',
    "point": 'of the path of a point, "POINT.NAME", at an instant "POINT@0.3s.NAME", "POINT@90deg.NAME" of the drive',
    "run": 'of the whole run, "NAME"',
    "coupling": 'of a coupling, "COUPLING.NAME", of all that have it "*.NAME"',
}


@dataclass(frozen=True)
class MetricRow:
    """A metric: its name; its unit ("" for a plain number); what it means; what has it, "" where all have; the number
    of its equation in the theory, "" where words suffice."""

    name: str
    unit: str
    meaning: str
    needs: str
    equation: str
    at_rest: bool = False

    @property
    def text(self) -> str:
        """Meaning, what has it, equation, and whether it is also of a mechanism at rest, in one."""
        equation = f", theory {self.equation}" if self.equation else ""
        rest = "; also at rest" if self.at_rest else ""
        return f"{self.meaning}{equation}{f'; {self.needs}' if self.needs else ''}{rest}"


@dataclass(frozen=True)
class MetricTable:
    """Metrics of one owner: its header, how they are called, and a row for each."""

    header: str
    rows: tuple[MetricRow, ...]


def metric_tables() -> list[MetricTable]:
    """All metrics that study files and `Problem` may name, those registered from outside the package included."""
    return [
        MetricTable(f"metrics {CALLED[of]}", tuple(_row(kind) for kind in catalogue.values()))
        for of, catalogue in CATALOGUES.items()
        if catalogue
    ]


def _row(kind: MetricKind) -> MetricRow:
    the = {of: f"the {of}" for of in CATALOGUES if of != "run"}
    meaning = kind.description or kind.labelled(the)
    return MetricRow(kind.name, kind.unit, meaning, needs_of(kind), kind.equation, kind.at_rest)


def _of_rotation_refused(kind: MetricKind) -> bool:
    return refusal_of(kind, CouplingSubject(turns=True)) is not None


def needs_of(kind: MetricKind) -> str:
    """What has a metric, in words, "" where all have: the kinds of joints, and what a joint, a link or a mechanism must
    have besides."""
    if kind.of == "link":
        return "only where the section's edge is known" if refusal_of(kind, LinkSubject(edge=False)) else ""
    if kind.of == "point":
        return ""
    if kind.of == "coupling":
        return f"only where its second coordinate is a {'translation' if _of_rotation_refused(kind) else 'rotation'}"
    if kind.of == "run":
        lacking = {word: MetricSubjects({"A": joint}, {}) for word, joint in _without(_joint(DEFAULT)).items()}
        needs = [word for word, one in lacking.items() if refusal_of(kind, one)]
        return f"only where a joint is {', '.join(needs)}" if needs else ""
    names = [name for name in KINDS if not refusal_of(kind, _joint(name))]
    if not names:
        return "of no joint"
    needs = [word for word, one in _without(_joint(names[0])).items() if refusal_of(kind, one)]
    kinds = [] if len(names) == len(KINDS) else [f"of kinds {', '.join(names)}"]
    return f"only {', '.join(kinds + needs)}" if kinds or needs else ""


def _joint(kind: str) -> JointSubject:
    """A joint of a kind that has everything."""
    return JointSubject(KINDS[kind], False, True, True, tuple(CAPACITIES))


def _without(joint: JointSubject) -> dict[str, JointSubject]:
    """{what a metric may need of a joint: the joint without it}."""
    capacities = {
        f"with `bearing.{name}`": joint._replace(capacities=tuple(one for one in CAPACITIES if one != name))
        for name in CAPACITIES
    }
    return {
        "not cut": joint._replace(cut=True),
        "driven": joint._replace(driven=False),
        "with friction": joint._replace(friction=False),
        **capacities,
    }
