"""A kinetostatic turn as labelled data: tables, DataFrames, Datasets.

Place in the pipeline: turn -> **labelled_turn** -> notebooks, report.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from rfem_jax.description.metrics.shaking_metrics import RECORD
from rfem_jax.labelled_data import COMPONENTS, Arrays, Labelled, LabelledResult, Parts, Table, column_name
from rfem_jax.mechanics.dynamics.load_axes import AXES
from rfem_jax.mechanics.model.status import STATUS
from rfem_jax.simulation.rest.labelled_statics import components_of, leaving_sentences

ON_BASE = "on the base"
_LOADS = (("force", "N"), ("moment", "N m"))


@dataclass(frozen=True, eq=False)
class LabelledTurn(LabelledResult):
    """The turn of several cases of one model.

    cases: their names, of a turn that stands for itself one without a name; turn: a `Turn` of NumPy arrays, whose first
    axis are the cases; joints: in the order that tables have.
    """

    cases: tuple[str, ...]
    turn: Any
    joints: tuple[str, ...]
    index = ("case", "number")

    @classmethod
    def of(cls, turn: Any) -> "LabelledTurn":
        """A turn that stands for itself."""
        turn = jax.tree.map(lambda values: np.asarray(values)[None], turn)
        return cls(("",), turn, tuple(turn.loads))

    @property
    def units(self) -> tuple[str, str]:
        """Units of the positions, and of what holds there."""
        return ("m", "N") if self.turn.slides else ("rad", "N m")

    @cached_property
    def angles(self) -> dict[str, Float[np.ndarray, "cases positions 3"]]:
        """Angles [rad] of the links at the points that are followed, NaN at positions that were not assembled."""

        def over_cases(path: Any) -> Float[np.ndarray, "cases positions 3"]:
            one = (jax.tree.map(lambda values, c=c: values[c], path) for c in range(len(self.cases)))
            return np.stack([path.angles_where(codes == 0) for path, codes in zip(one, self.turn.status, strict=True)])

        return {name: over_cases(path) for name, path in self.turn.points.items()}

    def statuses(self) -> list[str]:
        """Status of every case: ok, or that of its first position that was not assembled."""
        return [STATUS[int(codes[codes != 0][0]) if (codes != 0).any() else 0].name for codes in self.turn.status]

    def peaks(self, c: int) -> dict[str, Any]:
        """Largest resultants of one case over its assembled positions, and where they are."""
        turn, good = self.turn, self.turn.status[c] == 0

        def largest(name: str, values: Float[np.ndarray, " positions"]) -> dict[str, float]:
            values = np.where(good, np.abs(values), -np.inf)
            at = int(values.argmax())
            found = (float(values[at]), float(turn.position[c, at])) if good.any() else (float("nan"),) * 2
            return dict(zip((f"max_{name}", f"max_{name}_at"), found, strict=True))

        def of_load(load: Any) -> dict[str, float]:
            force, moment = (np.linalg.norm(getattr(load, what)[c], axis=-1) for what, _ in _LOADS)
            return largest("force", force) | largest("moment", moment)

        held = turn.holding[c][good]
        return {
            "joints": {name: of_load(turn.loads[name]) for name in self.joints},
            **({} if turn.shaking is None else {RECORD: of_load(turn.shaking)}),
            "stress": {name: largest("stress", values[c]) for name, values in turn.stress.items()},
            "holding": {"min": float(held.min()), "max": float(held.max())} if good.any() else None,
        }

    def arrays(self) -> Arrays:
        """Loads, what holds, stresses, places and angles of points, by case and position."""
        turn, at, (unit, held) = self.turn, ("case", "number"), self.units
        coordinates: dict[str, Any] = {"case": self.cases, "joint": self.joints, "component": COMPONENTS}
        variables = {
            "position": Labelled(at, turn.position, unit, "position of the drive"),
            "holding": Labelled(at, turn.holding, held, "what holds the drive from outside"),
            "energy": Labelled(at, turn.energy, "J", "elastic energy and that of gravity"),
            "status": Labelled(at, turn.status, "1", "what happened to the assembly"),
            "linear_error": Labelled(at, turn.linear_error, "1", "estimated error of linear elements"),
        }
        for what, of in _LOADS:
            values = np.stack([getattr(turn.loads[name], what) for name in self.joints], axis=2)
            variables[what] = Labelled((*at, "joint", "component"), values, of, f"joint {what}, frame H")
            if turn.in_axes:
                values = np.stack([getattr(turn.in_axes[name], what) for name in self.joints], axis=2)
                meaning = f"joint {what}, {AXES[turn.axes]}"
                variables[f"{what}_{turn.axes}"] = Labelled((*at, "joint", "component"), values, of, meaning)
            if turn.shaking is not None:
                meaning = f"{what} of the mechanism on its base, global axes"
                variables[f"{RECORD}_{what}"] = Labelled((*at, "component"), getattr(turn.shaking, what), of, meaning)
        for name, values in turn.stress.items():
            variables[f"stress_{name}"] = Labelled(at, values, "Pa", f"largest von Mises stress in {name}")
        for name, one in turn.points.items():
            variables[f"place_{name}"] = Labelled((*at, "component"), one.position, "m", f"place of {name}")
            meaning = f"angles of the link at {name}, of R_y R_z R_x"
            variables[f"angles_{name}"] = Labelled((*at, "component"), self.angles[name], "rad", meaning)
        attributes = {"title": "rfem_jax: a mechanism held still over the range of its drive"}
        return variables, coordinates, attributes | {"status_meanings": " ".join(one.name for one in STATUS)}

    def rows(self) -> list[dict[str, Any]]:
        """A row for every case and position."""
        return [self._row(c, i) for c in range(len(self.cases)) for i in range(self.turn.position.shape[1])]

    def _row(self, c: int, i: int) -> dict[str, Any]:
        turn, (unit, held) = self.turn, self.units
        row: dict[str, Any] = {"case": self.cases[c], "number": i}
        row |= {
            column_name("position", unit): float(turn.position[c, i]),
            "status": STATUS[int(turn.status[c, i])].name,
        }
        row |= {column_name("holding", held): float(turn.holding[c, i]), "energy_J": float(turn.energy[c, i])}
        shaking = {} if turn.shaking is None else {RECORD: turn.shaking}
        for name, load in {**{name: turn.loads[name] for name in self.joints}, **shaking}.items():
            for what, of in _LOADS:
                row |= components_of(f"{name}_{what}", getattr(load, what)[c, i], of)
        for name, load in turn.in_axes.items():
            for what, of in _LOADS:
                row |= components_of(f"{name}_{what}_{turn.axes}", getattr(load, what)[c, i], of)
        for name, one in turn.points.items():
            row |= components_of(name, one.position[c, i], "m")
            row |= components_of(f"{name}_angle", self.angles[name][c, i], "rad")
        return row | {f"{name}_stress_Pa": float(values[c, i]) for name, values in turn.stress.items()}

    def parts(self) -> Parts:
        """The largest loads and stresses of every case, and what holds."""
        parts: list[str | Table] = ["Loads of the mechanism held still over the range of its drive"]
        for c, case in enumerate(self.cases):
            parts += ["", *([f"Case {case}"] if case else []), *self.parts_of(c)]
        return parts

    def parts_of(self, c: int) -> Parts:
        """The largest loads and stresses of one case, and what holds."""
        scale, unit = (1.0, "m") if self.turn.slides else (180.0 / np.pi, "deg")
        peaks, failed = self.peaks(c), int((self.turn.status[c] != 0).sum())

        def cells(found: dict[str, float], what: str) -> list[str]:
            return [f"{found[f'max_{what}']:.5g}", f"{scale * found[f'max_{what}_at']:.5g}"]

        loads = peaks["joints"] | ({ON_BASE: peaks[RECORD]} if RECORD in peaks else {})
        rows = [[name, *cells(one, "force"), *cells(one, "moment")] for name, one in loads.items()]
        header = ["joint", "max force, N", f"at, {unit}", "max moment, N m", f"at, {unit}"]
        parts: list[str | Table] = [Table(header, rows)]
        if peaks["stress"]:
            rows = [[name, *cells(one | {"max_stress": one["max_stress"] / 1e6}, "stress")]
                    for name, one in peaks["stress"].items()]  # fmt: skip
            parts += ["", Table(["link", "max stress, MPa", f"at, {unit}"], rows)]
        if peaks["holding"] is not None:
            low, high = peaks["holding"]["min"], peaks["holding"]["max"]
            parts += ["", f"The drive holds with {low:.5g} to {high:.5g} {self.units[1]}."]
        if failed:
            parts += [f"* {failed} of {self.turn.status.shape[1]} positions were not assembled ({self.statuses()[c]})."]
            parts += leaving_sentences(jax.tree.map(lambda x: x[c], self.turn.stability), self.turn.status[c])
        return parts
