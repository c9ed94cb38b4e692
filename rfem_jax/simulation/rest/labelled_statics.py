"""Loads at rest as labelled data: tables, DataFrames, Datasets.

Place in the pipeline: statics -> **labelled_statics** -> notebooks, report.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np
from jaxtyping import Int

from rfem_jax.description.metrics.catalogue import kind_and_owner, metric_of
from rfem_jax.description.metrics.shaking_metrics import RECORD
from rfem_jax.labelled_data import COMPONENTS, Arrays, Labelled, LabelledResult, Parts, Table, column_name
from rfem_jax.mechanics.model.status import STATUS, UNSTABLE
from rfem_jax.mechanics.statics.equilibrium_stability import Stability
from rfem_jax.simulation.outcome.remarks import leaving_text, linear_remark

DEGREE = np.pi / 180.0
_LOADS = (("force", "N"), ("moment", "N m"))
_RESULTANTS = (("N", "N"), ("Q_y", "N"), ("Q_z", "N"), ("T", "N m"), ("M_y", "N m"), ("M_z", "N m"))


@dataclass(frozen=True, eq=False)
class LabelledStatics(LabelledResult):
    """Static loads of several cases of one model.

    cases: their names, of a result that stands for itself one without a name; results: `StaticLoads` of NumPy arrays;
    metrics: names of metrics that are told of every case.
    """

    cases: tuple[str, ...]
    results: tuple[Any, ...]
    metrics: tuple[str, ...] = ()
    index = ("case", "number")

    @classmethod
    def of(cls, result: Any) -> "LabelledStatics":
        """A result that stands for itself."""
        return cls(("",), (jax.tree.map(np.asarray, result),))

    @property
    def statuses(self) -> tuple[str, ...]:
        """Status of every case: ok, or that of its first position with another one."""
        return tuple(status_name(one.status) for one in self.results)

    @property
    def labels(self) -> tuple[str, ...]:
        """Names of the coordinates that are held."""
        return tuple(self.results[0].position)

    def turns(self, label: str) -> bool:
        """Whether a held coordinate, "A" or "C.T_y", is an angle."""
        joint, _, motion = label.partition(".")
        return motion.startswith("R") if motion else joint in self.results[0].angles

    def units(self, label: str) -> tuple[str, str]:
        """Units of a held coordinate, and of what holds it."""
        return ("rad", "N m") if self.turns(label) else ("m", "N")

    @property
    def moves(self) -> bool:
        """Whether held coordinates move."""
        results = [values for one in self.results for of in (one.rate, one.acceleration) for values in of.values()]
        return any(np.any(values) for values in results)

    def _units_of_motion(self, label: str) -> tuple[str, str]:
        """Units of the rate and of the acceleration of a held coordinate."""
        return ("rad/s", "rad/s^2") if self.turns(label) else ("m/s", "m/s^2")

    def values_of_metrics(self, case: int) -> dict[str, tuple[float, str]]:
        """{metric: (value, unit)} of one case."""
        found = {}
        for name in self.metrics:
            kind = kind_and_owner(name)[0]
            assert kind is not None, "names of metrics are checked where they enter"
            found[name] = float(metric_of(self.results[case], name)), kind.unit
        return found

    def arrays(self) -> Arrays:
        """Loads, what holds, sections, places, by case and position."""
        joints = self.results[0].loads.joints
        coordinates: dict[str, Any] = {"case": self.cases, "joint": joints, "component": COMPONENTS}
        at = ("case", "number")
        variables: dict[str, Labelled] = {}

        def put(name, dims, get, unit, meaning):
            values = np.stack([np.asarray(get(one)) for one in self.results])
            variables[name] = Labelled((*at[: 1 + (dims is not None)], *(dims or ())), values, unit, meaning)

        for what, unit in _LOADS:
            put(what, ("joint", "component"), lambda r, w=what: getattr(r.loads, w), unit, f"joint {what}, frame H")
        for label in self.labels:
            of_place, of_load = self.units(label)
            put(f"position_{label}", (), lambda r, n=label: r.position[n], of_place, f"held coordinate {label}")
            for what, unit in zip(("rate", "acceleration"), self._units_of_motion(label)):
                if self.moves:
                    put(f"{what}_{label}", (), lambda r, w=what, n=label: getattr(r, w)[n], unit, f"{what} of {label}")
            put(f"holding_{label}", (), lambda r, n=label: r.holding[n], of_load, f"what holds {label} from outside")
        for name in self.results[0].stress:
            put(f"stress_{name}", (), lambda r, n=name: r.stress[n], "Pa", f"largest von Mises stress in {name}")
        for record in self.results[0].recorded:
            owner, _, kind = record.rpartition(".")
            if kind == "sections":
                section = f"section_{owner}"
                place = Labelled((section,), np.atleast_1d(self.results[0].recorded[record].place), "m", "place")
                coordinates |= {"resultant": [name for name, _ in _RESULTANTS], f"place_{owner}": place}
                put(f"section_loads_{owner}", ("resultant", section), lambda r, n=record: r.recorded[n].resultants, "",
                    f"internal forces [N] and moments [N m] of {owner}")  # fmt: skip
            if kind == "deflection":
                put(f"deflection_{owner}", ("component",), lambda r, n=record: r.recorded[n], "m",
                    f"deflection of {owner}, frame of the link")  # fmt: skip
            if record == RECORD:
                for what, unit in _LOADS:
                    put(f"{RECORD}_{what}", ("component",), lambda r, w=what: getattr(r.recorded[RECORD], w), unit,
                        f"{what} of the mechanism on its base, global axes")  # fmt: skip
        for name in self.results[0].points:
            put(f"place_{name}", ("component",), lambda r, n=name: r.points[n].position, "m", f"place of {name}")
            put(f"angles_{name}", ("component",), lambda r, n=name: r.points[n].angles_where(r.status == 0), "rad",
                f"angles of the link at {name}, of R_y R_z R_x")  # fmt: skip
        for name in self.results[0].couplings:
            put(f"coupling_load_{name}", ("coupled",), lambda r, n=name: r.couplings[n].loads, "N m or N",
                f"load of coupling {name} along its two coordinates")  # fmt: skip
            coordinates |= {"coupled": ("first", "second")}
        for part in ("elastic", "gravity"):
            put(f"{part}_energy", (), lambda r, n=part: getattr(r.energy, n), "J", f"{part} energy")
        put("status", (), lambda r: r.status, "1", "what happened to the assembly")
        attributes = {"title": "rfem_jax: loads at rest", "status_meanings": " ".join(one.name for one in STATUS)}
        return variables, coordinates, attributes

    def rows(self) -> list[dict[str, Any]]:
        """A row for every case and position."""
        return [row for c in range(len(self.cases)) for row in self._rows_of(c)]

    def _rows_of(self, c: int) -> Iterator[dict[str, Any]]:
        result, case = self.results[c], self.cases[c]
        angles = {name: path.angles_where(result.status == 0) for name, path in result.points.items()}
        for i, code in enumerate(result.status):
            row: dict[str, Any] = {"case": case, "number": i, "status": STATUS[int(code)].name}
            for label in self.labels:
                of_place, of_load = self.units(label)
                row[column_name(f"{label}_position", of_place)] = float(result.position[label][i])
                for what, unit in zip(("rate", "acceleration"), self._units_of_motion(label)):
                    if self.moves:
                        row[column_name(f"{label}_{what}", unit)] = float(getattr(result, what)[label][i])
                row[column_name(f"{label}_holding", of_load)] = float(result.holding[label][i])
            for joint, load in result.loads.items():
                for what, unit in _LOADS:
                    row |= components_of(f"{joint}_{what}", getattr(load, what)[i], unit)
            for name, path in result.points.items():
                row |= components_of(name, np.asarray(path.position[i]), "m")
                row |= components_of(f"{name}_angle", angles[name][i], "rad")
            for name, record in result.recorded.items():
                owner, _, kind = name.rpartition(".")
                if kind == "deflection":
                    row |= components_of(f"{owner}_deflection", record[i], "m")
                if name == RECORD:
                    for what, unit in _LOADS:
                        row |= components_of(f"{RECORD}_{what}", getattr(record, what)[i], unit)
            row |= {column_name(f"{name}_stress", "Pa"): float(values[i]) for name, values in result.stress.items()}
            row |= {"elastic_energy_J": float(result.energy.elastic[i])}
            yield row | {"gravity_energy_J": float(result.energy.gravity[i])}

    def section_rows(self) -> list[dict[str, Any]]:
        """A row for every section of the flexible links, by case and position."""
        rows = []
        for case, result in zip(self.cases, self.results, strict=True):
            for name, record in result.recorded.items():
                link, _, kind = name.rpartition(".")
                if kind != "sections":
                    continue
                stress = np.full(record.resultants[:, 0].shape, np.nan)
                if record.edge is not None:
                    stress = np.asarray(record.stress)
                for i, resultants in enumerate(record.resultants):
                    for s in np.argsort(record.place, kind="stable"):
                        row: dict[str, Any] = {"case": case, "number": i, "link": link, "x_m": float(record.place[s])}
                        named = zip(_RESULTANTS, resultants[:, s], strict=True)
                        row |= {column_name(of, unit): float(value) for (of, unit), value in named}
                        rows.append(row | {"stress_Pa": float(stress[i, s])})
        return rows

    def parts(self) -> Parts:
        """Loads of all joints, what holds, stresses and places, of every case."""
        parts: list[str | Table] = ["Loads in given motion" if self.moves else "Loads at rest"]
        for c, case in enumerate(self.cases):
            parts += ["", *self._parts_of(c, f" of case {case}" if case else "")]
        return parts

    def _parts_of(self, c: int, of_case: str) -> Parts:
        result, status = self.results[c], self.statuses[c]
        parts: list[str | Table] = []
        if status != "ok":
            bad = int(np.sum(np.asarray(result.status) != 0))
            message = next(one.message for one in STATUS if one.name == status)
            what = "stable equilibrium" if status == STATUS[UNSTABLE].name else "equilibrium"
            parts.append(f"{bad} of {len(result.status)} positions{of_case} have no {what}: {message}")
        parts += [f"Joint loads{of_case}", Table(*self._joint_rows(result), words=(0,))]
        if self.labels:
            what = "What drives" if self.moves else "What holds"
            parts += ["", f"{what} the mechanism{of_case}", Table(*self._holding_rows(result), words=())]
        shaking = result.recorded.get(RECORD)
        on_base = {} if shaking is None else {f"{what}, {unit}": getattr(shaking, what) for what, unit in _LOADS}
        tables = (
            (f"What the mechanism exerts on its base{of_case}", "load", on_base),
            (f"Places of points{of_case}, mm", "point", {n: one.position for n, one in result.points.items()}),
            (f"Deflections{of_case}, mm", "link", {n.rpartition(".")[0]: one for n, one in result.recorded.items()
                                                   if n.endswith(".deflection")}),
        )  # fmt: skip
        for title, of, vectors in tables:
            if vectors:
                parts += ["", title, Table(*self._vector_rows(of, vectors, 1.0 if of == "load" else 1e3), words=(0,))]
        if result.stress:
            rows = [[name, f"{1e-6 * np.max(values):.5g}"] for name, values in result.stress.items()]
            parts += ["", Table(["link", "max stress, MPa"], rows)]
        if self.metrics:
            rows = [[name, f"{value:.6g}", unit or "1"] for name, (value, unit) in self.values_of_metrics(c).items()]
            parts += ["", Table(["metric", "value", "unit"], rows, words=(0, 2))]
        return [*parts, *self.remarks_on(c)]

    def remarks_on(self, c: int) -> list[str]:
        """Sentences on one case: how equilibria are left, and the error of linear elements."""
        result = self.results[c]
        remark = linear_remark(float(np.max(result.checks.linear_error)))
        found = leaving_sentences(result.stability, result.status)
        return [*found, remark[0].upper() + remark[1:]] if remark else found

    def _at(self, i: int) -> list[str]:
        """The first column of a table with a row for a position, where there are several."""
        return [str(i)] if len(self.results[0].status) > 1 else []

    def _joint_rows(self, result: Any) -> tuple[Sequence[str], list[list[str]]]:
        numbers = ["position"] if self._at(0) else []
        header = ["joint", *numbers, "F_x, N", "F_y", "F_z", "|F|", "M_x, N m", "M_y", "M_z", "|M|"]
        rows = []
        sizes = [float(np.abs(getattr(result.loads, what)).max()) for what, _ in _LOADS]
        for name, load in result.loads.items():
            for i in range(len(result.status)):
                cells = []
                for part, size in zip((load.force[i], load.moment[i]), sizes, strict=True):
                    cells += [_cell(value, size) for value in (*part, float(np.linalg.norm(part)))]
                rows.append([name, *self._at(i), *cells])
        return header, rows

    def _holding_rows(self, result: Any) -> tuple[Sequence[str], list[list[str]]]:
        header = ["position"] if self._at(0) else []
        for label in self.labels:
            header += [
                f"{label}, {'deg' if self.turns(label) else 'm'}",
                f"{'driven' if self.moves else 'held'} by, {self.units(label)[1]}",
            ]
        rows = []
        for i in range(len(result.status)):
            cells = []
            for label in self.labels:
                place = float(result.position[label][i]) / (DEGREE if self.turns(label) else 1.0)
                cells += [f"{place:.5g}", f"{float(result.holding[label][i]):.6g}"]
            rows.append([*self._at(i), *cells])
        return header, rows

    def _vector_rows(self, of: str, vectors: dict[str, Any], factor: float) -> tuple[Sequence[str], list[list[str]]]:
        numbers = ["position"] if self._at(0) else []
        header = [of, *numbers, *COMPONENTS]
        rows = [
            [name, *self._at(i), *(f"{factor * float(x) + 0.0:.6g}" for x in values[i])]
            for name, values in vectors.items()
            for i in range(len(values))
        ]
        return header, rows


def status_name(codes: Int[np.ndarray, " positions"]) -> str:
    """Status of all positions: ok, or that of the first one with another."""
    return STATUS[int(codes[np.argmax(codes != 0)])].name


def leaving_sentences(stability: Stability | None, codes: Int[np.ndarray, " positions"]) -> list[str]:
    """A sentence on how the worst of the unstable equilibria is left; none if all are stable."""
    if stability is None or not (codes == UNSTABLE).any():
        return []
    worst = int(np.argmax(np.where(codes == UNSTABLE, stability.growth, -1.0)))
    text = leaving_text(jax.tree.map(lambda x: x[worst], stability))
    return [f"{text[0].upper()}{text[1:]}" + ("." if len(codes) == 1 else f", at position {worst}.")]


def _cell(value: float, size: float) -> str:
    """A component; what is rounding beside the others is zero."""
    return "0" if abs(value) <= 1e-12 * size else f"{value:.5g}"


def components_of(name: str, vector: Iterable[float], unit: str) -> dict[str, float]:
    """Columns of the components of a vector along x, y and z."""
    return {column_name(f"{name}_{axis}", unit): float(x) for axis, x in zip(COMPONENTS, vector, strict=True)}
