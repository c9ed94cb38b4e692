"""What problems of a mechanism have in common, simulated or at rest: errors and parameters by their names, metrics.

Place in the pipeline: model, metrics -> **mechanism_problem** -> simulated_problem, static_problem.
"""

from collections.abc import Iterable

import equinox as eqx
from jaxtyping import Array

from rfem_jax.description.basics.errors import InputError
from rfem_jax.description.drives.numbers_by_name import drive_number_unit
from rfem_jax.description.metrics.catalogue import kind_and_owner
from rfem_jax.description.metrics.subjects import (
    CouplingSubject,
    JointSubject,
    LinkSubject,
    MetricSubjects,
    PointSubject,
    points_of,
    require_metric,
)
from rfem_jax.description.parameters.parameters import Parameter
from rfem_jax.description.tolerances.error_catalogue import error_unit
from rfem_jax.mechanics.model.model import Model
from rfem_jax.mechanics.model.named_points import following, named_points_of
from rfem_jax.mechanics.model.planar_loops import opening, require_closable
from rfem_jax.mechanics.model.status import STATUS
from rfem_jax.mechanics.statics.designs import Design, parameters
from rfem_jax.tolerancing.checks import check_known
from rfem_jax.tolerancing.problems.metrics import metric
from rfem_jax.tolerancing.problems.problem import Metric

LINEAR_ERROR = "linear_error"


class MechanismProblem(eqx.Module):
    """A mechanism as a function of its assembly errors: `model`, whose errors and parameters may deviate from its
    `design`, and `metrics`."""

    model: eqx.AbstractVar[Model]
    metrics: eqx.AbstractVar[tuple[Metric, ...]]
    design: eqx.AbstractVar[Design | None]

    # `jax.jit(problem)` keys its cache by the function's identity.
    def __hash__(self) -> int:
        return id(self)

    def __eq__(self, other: object) -> bool:
        return self is other

    @property
    def own_names(self) -> tuple[str, ...]:
        """Names of the things of its model, which are no part of programs."""
        return self.model.own_names

    @property
    def error_names(self) -> tuple[str, ...]:
        """Names of all errors that it accepts, of the parameters of the description and of the numbers of the drives,
        which may deviate, too."""
        errors, named = self.model.topology.error_names, self._parameters
        return (*errors, *(name for name in named if name not in errors), *self.drive_numbers)

    @property
    def _parameters(self) -> dict[str, Parameter]:
        source = self.model.source
        return {} if source is None else {one.name: one for one in source.blueprint.names.all}

    @property
    def drive_numbers(self) -> dict[str, Array | float]:
        """Numbers of the drives [their units] that no parameter has the name of; none where nothing drives."""
        return {}

    def error_unit(self, name: str) -> str:
        """SI unit of an error, a parameter or a number of a drive. Raises InputError for an unknown name."""
        check_known((name,), self.error_names, "name")
        if name in self.model.topology.error_names:
            return error_unit(name)
        known = self._parameters
        return known[name].unit if name in known else drive_number_unit(name)

    def nominal_value(self, name: str) -> float:
        """What a deviation of zero means: the value of a parameter or of a number of a drive in the design or the
        description, 0 for an error.

        Raises InputError for an unknown name.
        """
        check_known((name,), self.error_names, "name")
        if name not in self._parameters:
            return float(self.drive_numbers.get(name, 0.0))
        known = parameters(self.model)[name]
        set_to = {} if self.design is None else self.design.values
        return float(set_to.get(known.full, known.value))

    def require_closable(self, names: Iterable[str], what: str) -> None:
        """Raise InputError for an error that opens a planar loop of rigid links across its plane; `what`: the argument
        that names it."""
        require_closable(self.model, [*self._full_names(names)], what)

    @property
    def variable_names(self) -> tuple[str, ...]:
        """`error_names` without those that open a planar loop of rigid links across its plane, which have no
        derivatives."""
        full = self._full_names(self.error_names)
        opened = set(opening(self.model, [*full]))
        return tuple(name for name in self.error_names if name not in {full[one] for one in opened})

    def _full_names(self, names: Iterable[str]) -> dict[str, str]:
        """{full name: name} of errors and parameters, as `planar_loops` knows them; none without such loops."""
        if not self.model.topology.across:
            return {}
        known, errors = self._parameters, self.model.topology.error_names
        return {name if name in errors else known[name].full: name for name in names if name in errors or name in known}

    @property
    def records(self) -> tuple[str, ...]:
        """What runs record beside their loads, because a metric reads it."""
        return records_of(self.metrics)

    def describe_status(self, code: int) -> str:
        """Short name of a status code; "ok" for 0."""
        return STATUS[int(code)].name


def records_of(metrics: Iterable[Metric]) -> tuple[str, ...]:
    """What runs record beside their loads, because a metric reads it."""
    return tuple(dict.fromkeys(name for one in metrics for name in one.records))


def following_metrics(model: Model, asked: Iterable[str | Metric]) -> Model:
    """The model, which follows the centres of joints and the ends of links, too, that metrics are of."""
    return following(model, points_of(one if isinstance(one, str) else one.name for one in asked))


def known_metric(model: Model, asked: str | Metric) -> Metric:
    """The metric of a name, or the one given, if the simulator can compute it. Raises InputError."""
    one = metric(asked) if isinstance(asked, str) else asked
    if kind_and_owner(one.name)[0] is not None:
        require_metric(one.name, _subjects_of(model), "model")
    if one.function is None:
        raise InputError(
            f"Argument `metrics` must hold metrics with a function of a run, but {one.name!r} has no function; write "
            f"for example Metric({one.name!r}, function=lambda run: run.motion.angle[-1])."
        )
    return one


def _subjects_of(model: Model) -> MetricSubjects:
    """What the metrics of a model can be of."""
    topology, edges = model.topology, model.section.edges
    with_friction = {law.joint for law in (model.friction or {}).values()}
    driven, bearings = {topology.link_of_freedom[k] for k in topology.drives}, model.bearings or {}
    joints = {
        name: JointSubject(
            topology.kind(j).nominal,
            j in topology.cuts,
            j in driven,
            j in with_friction,
            bearings[name].given if name in bearings else (),
        )
        for name, j in ((name, topology.joints.index(name)) for name in model.joint_names)
    }
    reduced = {one.link for one in topology.reduced}
    links = {
        name: LinkSubject(bool(edges) and edges[l] is not None, l in reduced) for l, name in enumerate(topology.links)
    }
    points = {name: PointSubject(bool(driven)) for name in model.points or {}}
    turns = {name: not topology.slides[one.coordinates[1]] for name, one in (model.couplings or {}).items()}
    couplings = {name: CouplingSubject(turn) for name, turn in turns.items()}
    return MetricSubjects(joints, links, points, couplings, named_points_of(topology))
