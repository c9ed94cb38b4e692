"""How many rigid finite elements (rfes): every metric on finer and finer links, and what it tends to.

Place in the pipeline: problems of one mechanism, divided into more and more rfes -> **refinement** -> report.

A metric of links of m = n - 1 spring-damping elements (sdes) is off by a constant over m^2 where m is large. With the
numbers of all links doubled twice the observed order shows whether it is that large yet, and Richardson's value is what
the metric tends to (theory (11.20), (11.21)).

Symbols: n rfes, m sdes of a link; L meshes, c cases, v metrics.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from rfem_jax.description.basics.errors import InputError
from rfem_jax.labelled_data import Arrays, Labelled, LabelledResult, Parts, Table
from rfem_jax.mechanics.model.model import Model
from rfem_jax.tolerancing.checks import ErrorValues
from rfem_jax.tolerancing.problems.evaluation import describe_status, evaluate_points, read_point
from rfem_jax.tolerancing.problems.problem import Metric
from rfem_jax.tolerancing.problems.sample_values import local_mesh
from rfem_jax.tolerancing.problems.simulated_problem import Problem
from rfem_jax.tolerancing.problems.static_problem import StaticProblem
from rfem_jax.tolerancing.progress import ProgressBar, ProgressOption

ORDER = 2.0  # of the differences between links of m sdes and those of many
ORDERS = 1.6, 2.4  # observed ones that count as this
FEWEST = 4  # sdes of a link whose half still tells something
MOST_MESHES = 4
SMALL = 1.0 / 20.0  # of the largest metric of its unit and case, to which the error of a smaller one is relative
ROUNDING = 1e-9
Mesh = dict[str, int]
MakeProblem = Callable[[Mesh | None], Problem | StaticProblem]


@dataclass(frozen=True, eq=False)
class MeshConvergence(LabelledResult):
    """Metrics of c cases on L meshes, the coarsest first.

    cases; metrics; rfes {flexible link: n} as described; refinements (L,): sdes of every link over those as described;
    values (L, c, v) [unit of the metric], NaN where a case has failed, with statuses (c,); limit (c, v): Richardson's
    value of the two finest meshes; order (c, v): that of the last two differences, NaN where these are rounding; error
    (c, v): of the mesh as described, relative to the limit, or to a twentieth of the largest one of its unit and case
    if that is more; settled (c, v): whether the order is nearly 2, or the last difference far below the accuracy;
    accuracy: the relative one asked for.
    """

    cases: tuple[str, ...]
    metrics: tuple[Metric, ...]
    rfes: Mesh
    refinements: tuple[float, ...]
    values: Float[np.ndarray, "L c v"]
    statuses: tuple[str, ...]
    limit: Float[np.ndarray, "c v"]
    order: Float[np.ndarray, "c v"]
    error: Float[np.ndarray, "c v"]
    settled: Bool[np.ndarray, "c v"]
    accuracy: float
    index = ("case", "metric")

    @property
    def ok(self) -> bool:
        """Whether every case has its values on all meshes."""
        return all(status == "ok" for status in self.statuses)

    @property
    def worst(self) -> tuple[str, str] | None:
        """Case and metric with the largest error of the mesh as described; None where nothing has one."""
        if np.isnan(self.error).all():
            return None
        c, v = np.unravel_index(np.nanargmax(np.abs(self.error)), self.error.shape)
        return self.cases[c], self.metrics[v].name

    def rfes_for(self, accuracy: float | None = None) -> Mesh:
        """{link: rfes} with which all metrics are within a relative accuracy (None: that asked for)."""
        accuracy = self.accuracy if accuracy is None else accuracy
        return {} if self.worst is None else self._mesh_for(float(np.nanmax(np.abs(self.error))), accuracy)

    def _mesh_for(self, error: float, accuracy: float) -> Mesh:
        finer = (error / accuracy) ** (1.0 / ORDER)
        # A whole number plus rounding is that number.
        return {name: max(1, math.ceil(finer * (n - 1) - 1e-6)) + 1 for name, n in self.rfes.items()}

    def _meshes(self) -> list[str]:
        return ["/".join(map(str, dict.fromkeys(refined(self.rfes, r).values()))) for r in self.refinements]

    def arrays(self) -> Arrays:
        """Values over `mesh`, what they tend to, and how far off they are."""
        dims = ("case", "metric")
        units = [one.unit or "1" for one in self.metrics]
        variables = {
            "value": Labelled(("mesh", *dims), self.values, "", "value on a mesh, in metric_unit"),
            "limit": Labelled(dims, self.limit, "", "Richardson's value, in metric_unit"),
            "order": Labelled(dims, self.order, "1", "observed order of convergence"),
            "error": Labelled(dims, self.error, "1", "relative error of the mesh as described"),
            "settled": Labelled(dims, self.settled, "1", "whether the error is known, or small"),
            "refinement": Labelled(("mesh",), self.refinements, "1", "sdes of a link over those as described"),
            "rfes": Labelled(("link",), list(self.rfes.values()), "1", "rfes as described"),
            "wanted_rfes": Labelled(("link",), list((self.rfes_for() or self.rfes).values()), "1", "for the accuracy"),
        }
        coordinates: dict[str, Any] = {"case": self.cases, "metric": [one.name for one in self.metrics]}
        coordinates |= {"link": list(self.rfes), "metric_unit": Labelled(("metric",), units)}
        return variables, coordinates, {"title": "rfem_jax: metrics over rfes", "accuracy": self.accuracy}

    def rows(self) -> list[dict[str, Any]]:
        """A row for every case and metric."""
        return [self._row(c, v) for c in range(len(self.cases)) for v in range(len(self.metrics))]

    def _row(self, c: int, v: int) -> dict[str, Any]:
        row: dict[str, Any] = {
            "case": self.cases[c],
            "metric": self.metrics[v].name,
            "unit": self.metrics[v].unit or "1",
        }
        row |= {f"value_{r:g}": float(self.values[l, c, v]) for l, r in enumerate(self.refinements)}
        row |= {name: float(getattr(self, name)[c, v]) for name in ("limit", "order", "error")}
        return row | {"settled": bool(self.settled[c, v]), "status": self.statuses[c]}

    def parts(self) -> Parts:
        """A table for every case, and how many rfes the accuracy takes."""
        meshes = self._meshes()
        own = self.refinements.index(1.0)
        parts: list[str | Table] = [f"Metrics on links of {', '.join(meshes[:-1])} and {meshes[-1]} rfes"]
        header = ["metric", "unit", *(f"{mesh} rfes" for mesh in meshes), "limit", f"error of {meshes[own]}", "order"]
        header += [f"rfes for {_percent(self.accuracy)}"]
        for c, case in enumerate(self.cases):
            if self.statuses[c] != "ok":
                parts += ["", f"Case {case} has no values on all of them ({self.statuses[c]})."]
                continue
            parts += ["", *([f"Case {case}"] if case else []), Table(header, [*self._cells(c)], words=(0, 1))]
        return [*parts, "", *self._sentences(meshes[own])]

    def _cells(self, c: int):
        for v, metric in enumerate(self.metrics):
            error, order = self.error[c, v], self.order[c, v]
            zero = ROUNDING * np.max(np.abs(self.limit[:, [one.unit == metric.unit for one in self.metrics]]))
            values = [f"{x:.5g}" if abs(x) > zero else "0" for x in (*self.values[:, c, v], self.limit[c, v])]
            wanted = self._mesh_for(abs(error), self.accuracy)
            yield [
                metric.name, metric.unit or "1", *values, f"{100.0 * error:+.2g} %",
                ("" if np.isnan(order) else f"{order:.2f}") + ("" if self.settled[c, v] else "*"),
                "/".join(map(str, dict.fromkeys(wanted.values()))),
            ]  # fmt: skip

    def _sentences(self, own: str) -> list[str]:
        if self.worst is None:
            return ["No case has values on all of them."]
        case, metric = self.worst
        largest = float(np.nanmax(np.abs(self.error)))
        of_case = f" of case {case}" if case else ""
        wanted = ", ".join(f"{name} {n}" for name, n in self.rfes_for().items())
        said = [
            f"With {own} rfes everything here is within {_percent(largest)} of links of many rfes (the worst: "
            f"{metric}{of_case}). For {_percent(self.accuracy)}: {wanted} rfes."
        ]
        if not self.settled.all():
            said.append(
                "* The order is not yet 2, so that limit and error are rough: the metric does not follow the number of "
                "rfes smoothly (a peak of a vibration, an impact, a step that is too long), or the meshes are coarse."
            )
        return said


def rfes_of(model: Model) -> Mesh:
    """Rfes of the flexible links of a model."""
    topology = model.topology
    return {name: n for name, n in zip(topology.links, topology.elements, strict=True) if n > 1}


def refined(rfes: Mapping[str, int], refinement: float) -> Mesh:
    """Rfes of links whose numbers of sdes are multiplied."""
    return {name: max(1, round(refinement * (n - 1))) + 1 for name, n in rfes.items()}


def mesh_convergence(
    make: MakeProblem,
    cases: Mapping[str, ErrorValues] | None = None,
    *,
    accuracy: float = 0.01,
    progress: ProgressOption = True,
) -> MeshConvergence:
    """How far metrics are from those of links of many rigid finite elements, and how many an accuracy takes.

        def make(rfes):
            return Problem(Simulation(discretise(mechanism, rfes), drive=drive, duration=0.5), ["B.rms_force"])

        print(mesh_convergence(make, {"tilted": {"D.delta_x": "0.5 deg"}}))

    The numbers of spring-damping elements of all flexible links are halved and doubled, or doubled twice, and once more
    where the differences do not fall as they should. All meshes should have the same method and step, so that the error
    of the steps is the same: give `method` one that is stable on the finest, such as `GeneralisedAlpha`.

    **Arguments:** `make`: {link: number of rfes}, or None for those of the description -> a `Problem` or
    `StaticProblem` with the metrics; `cases`: {name: errors} (None: the perfect mechanism); `accuracy`: relative, below
    1; `progress`: as of `monte_carlo`.

    **Returns:** `MeshConvergence`.

    **Raises:** `InputError` for a mechanism without flexible links, and for an accuracy that is none.
    """
    if not isinstance(accuracy, (int, float)) or not 0.0 < accuracy < 1.0:
        raise InputError(f"Argument `accuracy` must be a share between 0 and 1, but is {accuracy!r}; 0.01 is usual.")
    first = make(None)
    rfes = rfes_of(first.model)
    if not rfes:
        raise InputError(
            "Argument `make` must make problems with flexible links, but all links are rigid, and exact: there is "
            "nothing to refine."
        )
    halves = min(rfes.values()) - 1 >= FEWEST and all((n - 1) % 2 == 0 for n in rfes.values())
    refinements = [0.5, 1.0, 2.0] if halves else [1.0, 2.0, 4.0]
    cases = {"": {}} if cases is None else cases
    values, statuses = [], dict.fromkeys(cases, "ok")
    with ProgressBar(progress, len(refinements) * len(cases), unit="simulation") as bar:
        for refinement in refinements:
            values.append(_evaluate(make, first, rfes, refinement, cases, statuses, bar))
        found = _concluded(first, rfes, refinements, values, cases, statuses, accuracy)
        if found.ok and not found.settled.all() and len(refinements) < MOST_MESHES:
            bar.total += len(cases)
            finer, of_finer = [*refinements, 2.0 * refinements[-1]], dict(statuses)
            values.append(_evaluate(make, first, rfes, finer[-1], cases, of_finer, bar))
            further = _concluded(first, rfes, finer, values, cases, of_finer, accuracy)
            # A step that is too long for the finest mesh costs only what that would have told.
            found = further if further.ok else found
    return found


def _evaluate(make, first, rfes, refinement, cases, statuses, bar) -> Float[np.ndarray, "c v"]:
    """Metrics of all cases on one mesh; a case that fails gets its status."""
    problem = first if refinement == 1.0 else make(refined(rfes, refinement))
    points = [read_point(problem, errors, "cases") for errors in cases.values()]
    names = tuple(dict.fromkeys(name for point in points for name in point)) or problem.error_names[:1]
    rows = [[point.get(name, 0.0) for name in names] for point in points]
    values, codes = evaluate_points(problem, names, {}, rows, -(-len(rows) // local_mesh().size), bar.advance)
    for name, code in zip(cases, codes, strict=True):
        if code != 0:
            statuses[name] = describe_status(problem, code)
    return values


def _concluded(first, rfes, refinements, values, cases, statuses, accuracy) -> MeshConvergence:
    values = np.stack(values)
    found = extrapolated(values, refinements.index(1.0), [metric.unit for metric in first.metrics], accuracy)
    return MeshConvergence(
        tuple(cases), first.metrics, rfes, tuple(refinements), values, tuple(statuses.values()), *found, float(accuracy)
    )


class Extrapolated(NamedTuple):
    """As of `MeshConvergence`."""

    limit: Float[np.ndarray, "c v"]
    order: Float[np.ndarray, "c v"]
    error: Float[np.ndarray, "c v"]
    settled: Bool[np.ndarray, "c v"]


def extrapolated(values: Float[np.ndarray, "L c v"], own: int, units: Sequence[str], accuracy: float) -> Extrapolated:
    """What values on meshes, each twice as fine, tend to, and how far off mesh `own` is (theory (11.20), (11.21))."""
    coarse, middle, fine = values[-3:]
    last, before = fine - middle, middle - coarse
    limit = fine + last / (2.0**ORDER - 1.0)
    same = np.array(units)[:, None] == np.array(units)[None, :]
    largest = np.max(np.where(same, np.abs(limit)[:, None, :], 0.0), axis=-1)
    scale = np.maximum(np.abs(limit), SMALL * largest)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio, change = before / last, np.nan_to_num(np.abs(last / scale))
        error = np.where(scale == 0.0, 0.0, (values[own] - limit) / scale)
        order = np.where((ratio > 0.0) & (change > ROUNDING), np.log2(np.abs(ratio)), np.nan)
    as_it_should = (order > ORDERS[0]) & (order < ORDERS[1])
    return Extrapolated(limit, order, error, as_it_should | (change < 0.1 * accuracy))


def _percent(share: float) -> str:
    return f"{100.0 * share:.2g} %"
